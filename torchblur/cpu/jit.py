"""The one door to Numba: compiled functions that release the interpreter's lock and stay on disk between runs.

Before: nothing.  After: all of torchblur/cpu.
Source: ours.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

SOURCES_NAME = "compiled_sources.sha256"


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` compiled at its first call, without fused multiply-adds: results are those of plain float64.

    Where nothing can be written it is compiled anew in each process. Source: ours.
    """
    options = {"nogil": True, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder to store it in
        return numba.njit(**options)(function)


def forget_other_sources(folder: Path) -> None:
    """Delete the compiled code stored beside the sources of `folder` that was made of other sources than these.

    Numba looks only at the file of a function itself, not at those of the functions compiled into it. Source: ours.
    """
    found = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(folder.glob("*.py")))).hexdigest()
    store = folder / "__pycache__"
    known = store / SOURCES_NAME
    with contextlib.suppress(OSError):  # read-only, or another process was faster
        if known.exists() and known.read_text(encoding="utf-8") == found:
            return
        for index in store.glob("*.nbi"):
            index.unlink()
        store.mkdir(exist_ok=True)
        known.write_text(found, encoding="utf-8")


forget_other_sources(Path(__file__).parent)
