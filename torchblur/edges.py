"""The quadratics in time by which a pixel's ray decides whether it is inside a moving triangle.

Before: prisms.py (corners).  After: intervals.py.
Symbols: m pairs of prism and ray; corner A(t) = (x - x_ray w, y - y_ray w), the reduced vertex, linear in the local
time u of the prism; edge i lies opposite corner i; e_i = A_j x A_k; S = e_0 + e_1 + e_2; D = sum e_i w_i; N the value
of a plane at the hit, sum e_i n_i. Inside is where all e_i have one sign; that sign is the facing.
Source: Ronnow et al. 2021, sec. 3 (the same quadratics as bilinear patches); Reshetov 2019; reduced form and tie
rule: ours.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import bernstein

FIRST, SECOND = (1, 0, 0), (2, 2, 1)  # edge i joins these corners, always from lower place to higher
EDGE_SIGN = (1.0, -1.0, 1.0)  # and this turns edge 1 the way of the cycle
CLIP_NOISE = 1e-15  # of the largest coefficient: float64 rounding of a sum of three products


@dataclass(frozen=True)
class Corners:
    """Three moving corners seen from a ray, at both ends of a slice of time; m pairs of prism and ray."""

    x: Tensor  # (2, 3, m) float64 reduced: x - x_ray w
    y: Tensor  # (2, 3, m) float64 reduced: y - y_ray w
    w: Tensor  # (2, 3, m) float64 clip w

    def at(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return x, y, w (3, m) at the local time `u` (m,); at u = 0 and 1 the ends, bit for bit."""
        v = 1 - u
        return tuple(v * c[0] + u * c[1] for c in (self.x, self.y, self.w))

    def between(self, u_start: Tensor, u_end: Tensor) -> Corners:
        """Return the corners on the slice [u_start, u_end] (m,)."""
        ends = zip(self.at(u_start), self.at(u_end), strict=True)
        return Corners(*(torch.stack(pair) for pair in ends))

    def __getitem__(self, chosen: Tensor) -> Corners:
        return Corners(*(c.index_select(-1, chosen) for c in (self.x, self.y, self.w)))


def reduce_corners(clip: Tensor, prism: Tensor, ray_ndc: Tensor) -> Corners:
    """Return the corners of prisms `prism` (m,) of `clip` (2, 3, 4, P) as seen by rays `ray_ndc` (2, m). Ours."""
    w = clip[:, :, 3].index_select(-1, prism)
    x = clip[:, :, 0].index_select(-1, prism) - ray_ndc[0] * w
    y = clip[:, :, 1].index_select(-1, prism) - ray_ndc[1] * w
    return Corners(x, y, w)


def cross(ax: Tensor, ay: Tensor, bx: Tensor, by: Tensor) -> Tensor:
    """Return the 2-D cross product a x b."""
    return ax * by - ay * bx


def edges_of(x: Tensor, y: Tensor) -> Tensor:
    """Return e (3, m) of corners x, y (3, m)."""
    return torch.stack([s * cross(x[i], y[i], x[j], y[j]) for i, j, s in zip(FIRST, SECOND, EDGE_SIGN, strict=True)])


def polar_edges(x: Tensor, y: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
    """Return A_j x dA_k + dA_j x A_k (3, m): the slope of e at corners x, y (3, m) that move by dx, dy. Ours."""
    return torch.stack(
        [
            s * (cross(x[i], y[i], dx[j], dy[j]) + cross(dx[i], dy[i], x[j], y[j]))
            for i, j, s in zip(FIRST, SECOND, EDGE_SIGN, strict=True)
        ]
    )


def edge_coefficients(corners: Corners) -> Tensor:
    """Return the Bernstein coefficients (3 coefficients, 3 edges, m) of the e_i on the corners' slice. Ours."""
    x, y = corners.x, corners.y
    middle = 0.5 * polar_edges(x[0], y[0], x[1], y[1])
    return torch.stack([edges_of(x[0], y[0]), middle, edges_of(x[1], y[1])])


def edge_roots(corners: Corners) -> Tensor:
    """Return the (6, m) local times at which an e_i may change sign: row i and row i + 3 for edge i.

    No thresholds: a vanishing leading coefficient sends its root to infinity. Roots that are absent, or outside
    (0, 1), become 1: a piece of no length. Source: the stable quadratic formula in half-b form.
    """
    x0, y0 = corners.x[0], corners.y[0]
    dx, dy = corners.x[1] - x0, corners.y[1] - y0
    t1, t2 = [], []
    for i, j in zip(FIRST, SECOND, strict=True):  # the sign of an edge does not move its roots
        c0 = cross(x0[i], y0[i], x0[j], y0[j])
        h = 0.5 * (cross(x0[i], y0[i], dx[j], dy[j]) + cross(dx[i], dy[i], x0[j], y0[j]))
        c2 = cross(dx[i], dy[i], dx[j], dy[j])
        size = torch.maximum(torch.maximum(c0.abs(), h.abs()), c2.abs())
        size = torch.where(size > 0, size, 1.0)
        c0, h, c2 = c0 / size, h / size, c2 / size
        disc = h * h - c2 * c0
        q = -(h + torch.copysign(torch.sqrt(disc.clamp(min=0)), h))
        t1.append(torch.where(disc > 0, q / c2, 1.0))
        t2.append(torch.where(disc > 0, c0 / q, 1.0))
    both = torch.stack(t1 + t2)
    return torch.where((both > 0) & (both < 1), both, 1.0)  # NaN and infinities fail the comparison


def plane_roots(edge: Tensor, plane: Tensor) -> Tensor:
    """Return the (3, m) local times at which the hit may cross a clip plane; 1 where there is none.

    Args:
        edge: (3, 3, m) Bernstein coefficients of the e_i.
        plane: (2, 3, m) value of the plane at the corners, both ends.

    Source: ours (the value at the hit is a cubic in time, not linear).
    """
    n = plane.shape[-1]
    cubic = bernstein.product(edge, plane).sum(1)
    which, u = bernstein.roots(cubic, cubic.abs().amax(0) * CLIP_NOISE)
    order = torch.sort(which, stable=True).indices
    which, u = which[order], u[order]
    first = torch.searchsorted(which, which)  # of the equal ones before it
    slot = torch.arange(len(which), device=which.device) - first
    table = torch.ones(3, n, dtype=cubic.dtype, device=cubic.device)
    table[slot, which] = u
    return table


def edge_signs(corners: Corners, roots: Tensor) -> Tensor:
    """Return the sign of each e_i before, between and after its own two roots, (3 slices, 3 edges, m) int8.

    The sign is that of the mean over the slice: unlike the value at one point it cannot vanish for an edge that
    merely touches the ray. It depends on the edge alone, so that both faces at an edge take opposite signs, whatever
    rounding makes of an edge that slides along itself. An edge whose mean is exactly 0 lies on the ray throughout and
    counts as if the ray were moved by (eps, eps^2): of the faces around it exactly one then covers the ray.

    Args:
        corners: m pairs.
        roots: (6, m) of `edge_roots`.

    Source: ours.
    """
    early, late = torch.minimum(roots[:3], roots[3:]), torch.maximum(roots[:3], roots[3:])
    ends = [torch.zeros_like(early), early, late, torch.ones_like(early)]
    coefficient = edge_coefficients(corners)
    steady = (coefficient > 0).all(0).to(torch.int8) - (coefficient < 0).all(0).to(torch.int8)
    bend = edges_of(corners.x[1] - corners.x[0], corners.y[1] - corners.y[0]) / 12
    i, j = list(FIRST), list(SECOND)
    turn = torch.tensor(EDGE_SIGN, dtype=bend.dtype, device=bend.device).unsqueeze(1)
    signs = []
    for start, end in itertools.pairwise(ends):
        u = 0.5 * (start + end)
        a, b = (tuple((1 - u) * c[0, k] + u * c[1, k] for c in (corners.x, corners.y, corners.w)) for k in (i, j))
        e = turn * cross(a[0], a[1], b[0], b[1]) + bend * (end - start).square()  # mean: middle plus bend / 12
        e = _break_ties(e, a, b) if (e == 0).any() else e
        signs.append(torch.where(steady != 0, steady, e.sign().to(torch.int8)))
    return torch.stack(signs)


def still_sign(corners: Corners) -> Tensor:
    """Return the common sign of the e_i (m,) int8 of corners at rest: +1 or -1 inside, 0 outside.

    Bit for bit what `edge_signs` and `inside_sign` say of them. Source: as `edge_signs`.
    """
    x, y, w = corners.x[0], corners.y[0], corners.w[0]
    e = edges_of(x, y)
    if (e == 0).any():
        a, b = (tuple(c[list(k)] for c in (x, y, w)) for k in (FIRST, SECOND))
        e = _break_ties(e, a, b)
    return (e > 0).all(0).to(torch.int8) - (e < 0).all(0).to(torch.int8)


def _break_ties(e: Tensor, a: tuple[Tensor, ...], b: tuple[Tensor, ...]) -> Tensor:
    """Return `e` (3, m) with each zero replaced by the first of its slopes along the ray's x and y that is not; `a` and
    `b` are x, y, w (3, m) of the edges' corners.
    """
    turn = torch.tensor(EDGE_SIGN, dtype=e.dtype, device=e.device).unsqueeze(1)
    slope_x, slope_y = turn * cross(a[1], a[2], b[1], b[2]), turn * cross(a[2], a[0], b[2], b[0])
    return torch.where(e != 0, e, torch.where(slope_x != 0, slope_x, slope_y))


def inside_sign(signs: Tensor, roots: Tensor, u: Tensor) -> Tensor:
    """Return the common sign of the e_i (m,) int8 at local times `u` away from the roots: +1 or -1 inside, 0 outside.

    Args:
        signs: (3, 3, m) of `edge_signs`.
        roots: (6, m) of `edge_roots`.
        u: (m,).

    Source: Ronnow et al. 2021, sec. 3.
    """
    early, late = torch.minimum(roots[:3], roots[3:]), torch.maximum(roots[:3], roots[3:])
    index = (u > early).long() + (u > late).long()
    sign = signs.gather(0, index.unsqueeze(0)).squeeze(0)
    return (sign > 0).all(0).to(torch.int8) - (sign < 0).all(0).to(torch.int8)


def plane_mean(corners: Corners, plane: Tensor, u_start: Tensor, u_end: Tensor) -> Tensor:
    """Return the mean (m,) of a clip plane's N over pieces of time.

    Args:
        corners: m pairs.
        plane: (2, 3, m) value of the plane at the corners.
        u_start, u_end: (m,) the piece, in local time.

    Source: Gauss's rule with two points, exact for the cubic.
    """
    middle, length = 0.5 * (u_start + u_end), u_end - u_start
    mean = torch.zeros_like(middle)
    for side in (-0.5, 0.5):
        u = middle + side * length / math.sqrt(3)
        x, y, _ = corners.at(u)
        mean = mean + 0.5 * (edges_of(x, y) * ((1 - u) * plane[0] + u * plane[1])).sum(0)
    return mean
