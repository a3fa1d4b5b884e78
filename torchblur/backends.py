"""Which of the two implementations does the work: plain torch, or the compiled one on the CPU.

Before: scene.py.  After: instant.py, sampling.py.
Source: ours.
"""

from __future__ import annotations

from typing import Any

import torch

from torchblur import check
from torchblur.scene import Scene

BACKENDS = ("auto", "torch", "cpu")


def choose_backend(scene: Scene, backend: Any) -> str:
    """Return "torch" or "cpu".

    Args:
        scene: what to render.
        backend: "torch": any device, gradients; "cpu": compiled, for scenes on the CPU without gradients; "auto":
            "cpu" where it can be and results are float32, else "torch".

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Source: ours.
    """
    if not isinstance(backend, str):
        raise check.fail_type("backend", f"one of {', '.join(BACKENDS)}", backend)
    if backend not in BACKENDS:
        raise check.fail("backend", f"one of {', '.join(BACKENDS)}", backend)
    is_possible = scene.device.type == "cpu" and not scene.requires_grad
    if backend == "auto":
        return "cpu" if is_possible and scene.dtype == torch.float32 else "torch"
    if backend == "cpu" and scene.device.type != "cpu":
        raise check.fail("backend", f"torch or auto for a scene on {scene.device}", backend)
    if backend == "cpu" and scene.requires_grad:
        raise check.fail("backend", "torch or auto for a scene that asks for gradients", backend)
    return backend
