"""The one door to Numba: compiled functions that release the interpreter's lock and stay on disk between runs.

Before: nothing.  After: all of torchblur/cpu.
Source: ours.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` compiled at its first call, without fused multiply-adds: results are those of plain float64.

    Where nothing can be written it is compiled anew in each process. Source: ours.
    """
    options = {"nogil": True, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder to store it in
        return numba.njit(**options)(function)
