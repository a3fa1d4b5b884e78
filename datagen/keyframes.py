"""Keyframes: values at times between the keys of an animation, and where their rate of change jumps.

Before: nothing.  After: rigs.py.
Symbols: T keys, N times [s], C numbers of a value. Quaternions are (x, y, z, w).
Source: the glTF 2.0 specification, section 3.11 and appendix C.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

SMALLEST_NORM = 1e-9  # of a quaternion; below it there is no direction left
PARALLEL = 1 - 1e-9  # cosine from which a slerp is a lerp to rounding


@dataclass(frozen=True, eq=False)
class Curve:
    """A value over time: held before the first key and after the last."""

    times_s: Tensor  # (T,) float64, increasing, T >= 1
    values: Tensor  # (T, C) float64
    kind: str = "LINEAR"  # or STEP or CUBICSPLINE
    in_tangents: Tensor | None = None  # (T, C) [1/s], for CUBICSPLINE
    out_tangents: Tensor | None = None  # (T, C) [1/s], for CUBICSPLINE
    is_rotation: bool = False  # values are unit quaternions

    def at(self, times_s: Tensor) -> Tensor:
        """Return (N, C) float64 values at times (N,) [s]. Source: the glTF specification, appendix C."""
        last = len(self.times_s) - 1
        if last == 0:
            return self.values.expand(len(times_s), -1)
        times = times_s.clamp(self.times_s[0], self.times_s[-1])
        first = (torch.searchsorted(self.times_s, times, right=True) - 1).clamp(0, last - 1)
        span = self.times_s[first + 1] - self.times_s[first]
        share = ((times - self.times_s[first]) / span).clamp(0, 1).unsqueeze(-1)
        a, b = self.values[first], self.values[first + 1]
        if self.kind == "STEP":
            found = torch.where(share < 1, a, b)
        elif self.kind == "CUBICSPLINE":
            found = self._spline(first, share, span.unsqueeze(-1))
        elif self.is_rotation:
            return slerp(a, b, share)
        else:
            found = a * (1 - share) + b * share
        return _unit(found, a) if self.is_rotation else found

    def _spline(self, first: Tensor, s: Tensor, span: Tensor) -> Tensor:
        """Return Hermite's cubic at shares `s` (N, 1) of the spans [s] after the keys `first`."""
        assert self.in_tangents is not None
        assert self.out_tangents is not None
        leave, arrive = self.out_tangents[first] * span, self.in_tangents[first + 1] * span
        a, b = self.values[first], self.values[first + 1]
        s2, s3 = s * s, s * s * s
        return (2 * s3 - 3 * s2 + 1) * a + (s3 - 2 * s2 + s) * leave + (3 * s2 - 2 * s3) * b + (s3 - s2) * arrive


def slerp(a: Tensor, b: Tensor, share: Tensor) -> Tensor:
    """Return unit quaternions (N, 4) at shares (N, 1) of the shorter arc from `a` to `b`, both (N, 4), unit.

    Source: Shoemake 1985.
    """
    dot = (a * b).sum(-1, keepdim=True)
    b = torch.where(dot < 0, -b, b)
    dot = dot.abs().clamp(max=1)
    angle = torch.acos(dot)
    sine = torch.sin(angle)
    is_arc = dot < PARALLEL
    safe = torch.where(is_arc, sine, 1.0)
    wa = torch.where(is_arc, torch.sin((1 - share) * angle) / safe, 1 - share)
    wb = torch.where(is_arc, torch.sin(share * angle) / safe, share)
    return _unit(wa * a + wb * b, a)


def rotations(quaternions: Tensor) -> Tensor:
    """Return (N, 3, 3) rotation matrices of unit quaternions (N, 4). Source: Shoemake 1985."""
    x, y, z, w = quaternions.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _unit(quaternions: Tensor, instead: Tensor) -> Tensor:
    """Return quaternions (N, 4) scaled to 1; one without a direction (a spline through 0) is that of `instead`."""
    norm = quaternions.norm(dim=-1, keepdim=True)
    has_none = norm < SMALLEST_NORM
    other = instead / instead.norm(dim=-1, keepdim=True)
    return torch.where(has_none, other, quaternions / torch.where(has_none, 1.0, norm))
