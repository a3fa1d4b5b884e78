"""The one door to Numba: compiled functions that release the interpreter's lock and stay on disk between runs.

Before: nothing.  After: all of torchblur/cpu.
Source: ours.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba


def _digest() -> str:
    """Return a digest of all that may be compiled into a function: its folder, and the constants it takes from ours."""
    here = Path(__file__).resolve().parent
    texts = [path.read_bytes() for path in sorted([*here.glob("*.py"), *here.parent.glob("*.py")])]
    return hashlib.sha256(b"\0".join(texts)).hexdigest()


DIGEST = _digest()


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` compiled at its first call, without fused multiply-adds: results are those of plain float64.

    Where nothing can be written it is compiled anew in each process. Source: ours.
    """
    options = {"nogil": True, "error_model": "numpy"}
    try:
        compiled = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder to store it in
        return numba.njit(**options)(function)
    # Numba asks only whether the function's own file has changed, not those of the functions that it calls
    stored = compiled._cache._cache_file
    stored._source_stamp = (stored._source_stamp, DIGEST)
    return compiled
