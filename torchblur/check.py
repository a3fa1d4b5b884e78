"""Argument checks with one message form: ``name: expected …, got …``.

Used by every public constructor and function before any work starts. ``ValueError`` for values and shapes,
``TypeError`` for types. Nothing is clamped, cast or moved here except integer indices, which widen to int64.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

FLOATS = (torch.float32, torch.float64)
INTEGERS = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)


def describe(value: Any) -> str:
    """Return a short text that says what `value` is: shape and dtype for arrays, the value itself for numbers."""
    if isinstance(value, Tensor):
        where = "" if value.device.type == "cpu" else f" on {value.device}"
        return f"{tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}{where}"
    if isinstance(value, np.ndarray):
        return f"{value.shape} {value.dtype}"
    text = repr(value)
    return f"{type(value).__name__} {text if len(text) <= 60 else text[:57] + '...'}"


def fail(name: str, expected: str, got: Any) -> ValueError:
    """Return the ValueError to raise; `got` is text as it is, anything else is described."""
    return ValueError(f"{name}: expected {expected}, got {got if isinstance(got, str) else describe(got)}")


def fail_type(name: str, expected: str, got: Any) -> TypeError:
    """Return the TypeError to raise for an argument of the wrong type, which `got` is."""
    return TypeError(f"{name}: expected {expected}, got {describe(got)}")


def shape_text(shape: Sequence[int | str]) -> str:
    """Return a shape such as ``("V", 3)`` as ``(V, 3)``."""
    return "(" + ", ".join(str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"


def matches(value: Tensor, shape: Sequence[int | str]) -> bool:
    """Tell whether `value` has `shape`, where text stands for any size."""
    return value.ndim == len(shape) and all(
        isinstance(s, str) or s == n for s, n in zip(shape, value.shape, strict=True)
    )


def as_tensor(name: str, value: Any) -> Tensor:
    """Return `value` as a tensor without changing its dtype; Python numbers become float64.

    Raises:
        TypeError: neither a dense tensor with data, nor a numeric array, nor (nested) Python numbers.
    """
    expected = "a dense tensor, a numeric array or numbers"
    if isinstance(value, Tensor):
        if value.layout != torch.strided or value.is_nested or value.is_quantized or value.is_meta:
            kind = "meta" if value.is_meta else "nested or quantized" if value.layout == torch.strided else value.layout
            raise TypeError(f"{name}: expected {expected}, got a tensor of kind {kind}")
        return value
    array = _as_array(name, value, expected)
    if not isinstance(value, np.ndarray):
        array = array.astype(np.float64)
    return torch.as_tensor(np.array(array, order="C"))  # a copy: arrays may be read-only or change later


def _as_array(name: str, value: Any, expected: str) -> np.ndarray:
    """Return `value` as a numeric array of at most 64 bits, refusing what numpy would silently turn into one."""
    if isinstance(value, (list, tuple)) and any(isinstance(part, Tensor) for part in value):
        raise TypeError(f"{name}: expected {expected}, got a {type(value).__name__} of tensors: torch.stack them")
    if isinstance(value, np.ma.MaskedArray):
        raise TypeError(f"{name}: expected {expected}, got a masked array, whose mask would be lost")
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, OverflowError):
        raise fail_type(name, expected, value) from None
    if array.size == 0 and not isinstance(value, np.ndarray):
        array = array.astype(np.int64)
    if array.dtype.kind not in "fiu" or array.dtype.itemsize > 8 or not array.dtype.isnative:
        raise fail_type(name, expected, value)
    return array


def floats(name: str, value: Any, *shapes: Sequence[int | str]) -> Tensor:
    """Return `value` as a finite float32 or float64 tensor of one of `shapes`.

    Raises:
        TypeError: not a tensor, an array or numbers, or not floating point.
        ValueError: wrong shape, NaN or inf.
    """
    tensor = as_tensor(name, value)
    expected = " or ".join(shape_text(s) for s in shapes) + " float32 or float64"
    if tensor.dtype not in FLOATS:
        raise fail_type(name, expected, tensor)
    if not any(matches(tensor, s) for s in shapes):
        raise fail(name, expected, tensor)
    bad = ~torch.isfinite(tensor.detach())
    if bad.any():
        where = tuple(int(i) for i in bad.nonzero()[0])
        raise fail(name, "finite values", f"{float(tensor.detach()[where])} at index {where}")
    return tensor


def unit_range(name: str, value: Tensor) -> Tensor:
    """Return `value` unchanged if all of it lies in [0, 1]."""
    inside = (value.detach() >= 0) & (value.detach() <= 1)
    if not inside.all():
        raise fail(name, "values in [0, 1]", f"{float(value.detach()[~inside].flatten()[0])}")
    return value


def at_most(name: str, value: Tensor, limit: float) -> Tensor:
    """Return `value` unchanged if none of it is beyond `limit`, to either side."""
    largest = float(value.detach().abs().amax()) if value.numel() else 0.0
    if largest > limit:
        raise fail(name, f"values of at most {limit:g}, to either side", f"{largest:g}")
    return value


def indices(name: str, value: Any, shape: Sequence[int | str], below: int) -> Tensor:
    """Return `value` as int64 indices of `shape`, each in [0, below); an empty list counts as no rows."""
    expected = f"{shape_text(shape)} integers"
    if isinstance(value, Tensor):
        tensor = as_tensor(name, value)
    else:
        array = _as_array(name, value, expected)
        if array.size == 0 and array.ndim == 1:
            array = array.reshape(0, *shape[1:])
        if array.dtype.kind == "u" and array.size and array.max() > np.iinfo(np.int64).max:
            raise fail(name, f"indices in [0, {below})", f"{array.max()}")
        tensor = torch.as_tensor(array.astype(np.int64) if array.dtype.kind in "iu" else np.array(array))
    if tensor.dtype not in INTEGERS:
        raise fail_type(name, expected, tensor)
    if not matches(tensor, shape):
        raise fail(name, expected, tensor)
    outside = (tensor < 0) | (tensor >= below)
    if outside.any():
        raise fail(name, f"indices in [0, {below})", f"{int(tensor[outside][0])}")
    return tensor.to(torch.int64)


def positive_int(name: str, value: Any, at_most: int | None = None) -> int:
    """Return `value` as an int of at least 1 (and at most `at_most`)."""
    expected = "a positive integer" + ("" if at_most is None else f" of at most {at_most}")
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise fail_type(name, expected, value)
    if value < 1 or (at_most is not None and value > at_most):
        raise fail(name, expected, value)
    return int(value)


def number(name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
    """Return `value` as a finite float in [low, high]."""
    bounds = "a finite number"
    if math.isfinite(low) or math.isfinite(high):
        bounds += f" in [{low:g}, {high:g}]"
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise fail_type(name, bounds, value)
    if not (math.isfinite(value) and low <= value <= high):
        raise fail(name, bounds, value)
    return float(value)


def flag(name: str, value: Any) -> bool:
    """Return `value`, which must be True or False."""
    if not isinstance(value, bool):
        raise fail_type(name, "True or False", value)
    return value


def same_device(**tensors: Tensor) -> torch.device:
    """Return the device that all the named tensors share."""
    found = {name: t.device for name, t in tensors.items()}
    if len(set(found.values())) > 1:
        raise ValueError(
            "devices: expected one device for all tensors, got " + ", ".join(f"{n} on {d}" for n, d in found.items())
        )
    return next(iter(found.values()))
