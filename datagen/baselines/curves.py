"""Curves: the ways that points take across the screen, through the few places where they are known.

Before: nothing.  After: guertin2015.py.
Symbols: n points; K instants s_k in [0, 1]; B_j control points of a Bezier curve of degree K - 1; o = 1 where a path
turns from x towards y, else -1.
Source: Guertin & Nowrouzezahrai 2015, sec. 3.2 and 5.1. Their middle control point is misprinted: a curve through
p(-1), p(0), p(1) at s = 0, 1/2, 1 has B_1 = 2 p(0) - (p(-1) + p(1)) / 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import check

KINDS = ("bezier", "arc")
STRAIGHT = 1e-3  # sine of a bend below which an arc is taken for the Bezier curve


@dataclass(frozen=True)
class Curves:
    """n curves of place on screen and depth; some of them circular arcs on screen."""

    control: Tensor  # (n, K, 3) of x [px], y [px] and view depth
    centre: Tensor  # (n, 2) of the arcs [px]; 0 rows where there are none
    radius: Tensor  # (n,) [px]
    angle: Tensor  # (n, K) control values of the angle on the arc [rad]
    is_arc: Tensor  # (n,) bool

    def at(self, curve: Tensor, s: Tensor) -> Tensor:
        """Return (m, 3) x, y [px] and depth of the curves numbered `curve` (m,) at the shutter times `s` (m,)."""
        basis = bernstein_basis(s, self.control.shape[1])
        place = (basis.unsqueeze(2) * self.control[curve]).sum(1)
        if not len(self.centre):
            return place
        angle = (basis * self.angle[curve]).sum(1)
        turned = torch.stack([angle.cos(), angle.sin()], dim=1) * self.radius[curve].unsqueeze(1)
        xy = torch.where(self.is_arc[curve].unsqueeze(1), self.centre[curve] + turned, place[:, :2])
        return torch.cat([xy, place[:, 2:]], dim=1)

    def speed_bound(self, curve: Tensor, start: Tensor, end: Tensor) -> Tensor:
        """Return (m,) a bound of the speed on screen [px per exposure] of the curves numbered `curve` (m,) between the
        shutter times `start` and `end` (m,).
        """
        bound = torch.linalg.vector_norm(_slopes(self.control[curve, :, :2], start, end), dim=2).amax(1)
        if not len(self.centre):
            return bound
        turning = _slopes(self.angle[curve].unsqueeze(2), start, end)[..., 0].abs().amax(1)
        return torch.where(self.is_arc[curve], self.radius[curve] * turning, bound)


def fit_curves(points: Tensor, times: tuple[float, ...], kind: str) -> Curves:
    """Return the curves through `points` (n, K, 3) at the shutter times `times`.

    Args:
        points: x [px], y [px] and view depth at each time.
        times: K different ones.
        kind: "bezier", of degree K - 1; or "arc", a circle through 3 points, at constant speed where that fits the
            times, and the Bezier curve where the points lie on a line.

    Raises:
        ValueError: another kind, or an arc through other than 3 points.

    Source: Guertin & Nowrouzezahrai 2015, corrected; arcs ours.
    """
    if kind not in KINDS:
        raise check.fail("curve", f"one of {', '.join(KINDS)}", kind)
    if kind == "arc" and len(times) != 3:
        raise check.fail("curve", "bezier for paths of 4 instants", kind)
    control = _solve(points, times)
    if kind == "bezier":
        none = points.new_zeros(0)
        return Curves(control, none.reshape(0, 2), none, none.reshape(0, 3), none.bool())
    first, middle, last = points[..., :2].unbind(1)
    before, after = first - middle, last - middle
    bend = before[:, 1] * after[:, 0] - before[:, 0] * after[:, 1]  # (middle - first) x (last - middle)
    size_before, size_after = before.square().sum(1), after.square().sum(1)
    is_arc = bend.abs() > STRAIGHT * (size_before * size_after).sqrt()
    twice = torch.where(is_arc, -2 * bend, 1.0)
    centre_x = (after[:, 1] * size_before - before[:, 1] * size_after) / twice
    centre_y = (before[:, 0] * size_after - after[:, 0] * size_before) / twice
    centre = middle + torch.stack([centre_x, centre_y], dim=1)
    spoke = points[..., :2] - centre.unsqueeze(1)
    angle = torch.atan2(spoke[..., 1], spoke[..., 0])
    turn = torch.where(bend >= 0, 1.0, -1.0).unsqueeze(1)
    travelled = torch.remainder(turn * angle.diff(dim=1), 2 * math.pi).cumsum(
        1
    )  # first to middle to last, this way round
    unwrapped = torch.cat([angle[:, :1], angle[:, :1] + turn * travelled], dim=1)
    radius = torch.linalg.vector_norm(spoke[:, 0], dim=1)
    return Curves(control, centre, radius, _solve(unwrapped.unsqueeze(2), times).squeeze(2), is_arc)


def bernstein_basis(s: Tensor, count: int) -> Tensor:
    """Return (m, count) the Bernstein polynomials of degree count - 1 at `s` (m,)."""
    n = count - 1
    return torch.stack([math.comb(n, j) * s**j * (1 - s) ** (n - j) for j in range(count)], dim=1)


def _slopes(control: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Return (m, K - 1, d) the control values of the derivative of Bezier curves (m, K, d) between two times (m,)."""
    slopes = (control.shape[1] - 1) * control.diff(dim=1)
    ends = [t.reshape(-1, 1, 1) for t in (start, end)]
    n = slopes.shape[1]
    found = []
    for k in range(n):  # blossoms: the times k times the end, else the start
        part = slopes
        for m in range(n - 1):
            t = ends[m < k]
            part = (1 - t) * part[:, :-1] + t * part[:, 1:]
        found.append(part[:, 0])
    return torch.stack(found, dim=1)


def _solve(values: Tensor, times: tuple[float, ...]) -> Tensor:
    """Return the control values (n, K, d) of the Bezier curves that pass through `values` (n, K, d) at the times."""
    at = torch.tensor(times, dtype=values.dtype, device=values.device)
    return torch.linalg.solve(bernstein_basis(at, len(times)), values)
