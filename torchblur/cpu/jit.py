"""The one door to Numba: compiled functions that release the interpreter's lock and stay on disk between runs.

Before: nothing.  After: all of torchblur/cpu.
Source: ours.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import types
from numba.extending import intrinsic


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
    return _compiled(function)


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` for compiled code alone: what lets the interpreter call it takes long to compile. Ours."""
    return _compiled(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` for others to be compiled into: a call hands over some eight numbers for each array. Ours."""
    return _compiled(function, forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)


@intrinsic
def borrowed(_context: Any, value: types.Type) -> Any:
    """Return an array, or a tuple of some, that counts no references: for compiled code only, whose caller holds on to
    the original. A call with counted arrays costs more than short functions do. Source: ours.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _without_owner(context, builder, signature.args[0], args[0])

    return value(value), generate


def _without_owner(context: Any, builder: Any, kind: types.Type, value: Any) -> Any:
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = array.meminfo.type(None)
        return array._getvalue()
    if isinstance(kind, types.BaseTuple):
        for place, part in enumerate(kind):
            inner = _without_owner(context, builder, part, builder.extract_value(value, place))
            value = builder.insert_value(value, inner, place)
    return value


def _compiled(function: Callable[..., Any], **more: Any) -> Callable[..., Any]:
    options = {"nogil": True, "error_model": "numpy", **more}
    try:
        compiled = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder to store it in
        return numba.njit(**options)(function)
    # Numba asks only whether the function's own file has changed, not those of the functions that it calls
    stored = compiled._cache._cache_file
    stored._source_stamp = (stored._source_stamp, DIGEST)
    stored.save = functools.partial(_save, stored)
    return compiled


def _save(stored: Any, key: Any, data: Any) -> None:
    """Store what was compiled for a signature under that signature's own name, and only then list it.

    Numba takes the next free number: of two processes that compile at once, one may list what the other has written
    for another signature. Here the worst is that an entry is lost from the list, and compiled again.
    """
    name = f"{Path(stored._index_name).stem}.{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.nbc"
    with contextlib.suppress(OSError):  # a full disk costs time, nothing else
        stored._save_data(name, data)
        stored._save_index(stored._load_index() | {key: name})


def announce(function: Callable[..., Any]) -> None:
    """Log a warning if a function was never compiled here, as its first call will then take its time. Source: ours."""
    stored = getattr(getattr(function, "_cache", None), "cache_path", None)
    if not function.signatures and not (stored and any(Path(stored).glob(f"*.{function.__name__}-*.nbi"))):
        logging.getLogger("torchblur").warning("compiling for the CPU, once: about a minute")
