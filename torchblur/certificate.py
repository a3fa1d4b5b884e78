"""How many of Gauss's nodes a slice of time needs, certified.

Before: bernstein.py.  After: nodes.py.
Symbols: p panels, slices of spans in which no look bends; q vectors of polynomials that looks divide by; x = X / S
places on textures [texels]; c_k Chebyshev coefficients on a panel; rho the sum of the semi-axes of an ellipse about the
panel whose foci are its ends.

On the ellipse, q leaves c_0 by at most tail(q) = sum_k>0 |c_k| (rho^k + rho^-k) / 2. Where the tails of all q are at
most set shares of their |c_0|, looks are analytic inside; there a place leaves its middle by D <= 2 tail(X - x_0 S) /
|S_0|, a bilinear lookup grows to at most (1 + D_x) (1 + D_y) times its contrast, a shutter's weight to 1 + rho / 2
times, and what light and mip levels do to at most GROWTH times. Gauss's rule with n nodes then errs by at most
64 / 15 / 2 of the product of these, times rho^(-2 n) / (1 - rho^-2) (Trefethen, theorem 19.3).

A slope of the integral, for gradients, is the integral of a look's slope by some q or X times how that moves: any
polynomial of its degree d, which on the ellipse is at most rho^d times what it is on the panel (Bernstein and Walsh).
So light that rests on a sliding face takes one node, and its slope more. Slopes by q itself are some ten times looks.
Source: Trefethen 2013, Approximation Theory and Approximation Practice; its use here: ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from torchblur import bernstein, packed
from torchblur.stopwatch import spent_on

TOLERANCE = 1e-6  # of what is looked at: the contrast of a texture between neighbours, the light on a facing surface
RHO = (1.6, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0, 15.0, 25.0, 50.0, 100.0, 300.0, 1e3, 1e4, 1e6, 1e8)
LEVELS = 3.0  # what the share of a mip level grows by
GROWTH = 20.0 * LEVELS  # S^2 (N V) / (|N| |V|^3), with N and V within a quarter of their middles and S within a half
SCALE_LIMIT = 0.5  # share of |c_0| by which S may vary
VECTOR_LIMIT = 0.25  # and by which other q may
ROUNDING = 1e-13  # of c_0: smaller coefficients are rounding


@dataclass(frozen=True)
class Divider:
    """Vectors of polynomials that looks divide by."""

    span: Tensor  # (m,) int64, sorted
    q: Tensor  # (d + 1, c, m) float64 Bernstein coefficients over the span
    limit: float | Callable[[Tensor, Tensor], Tensor]  # share of |c_0| by which they may vary; or of which of the m, at
    # what time in the span, for all of a panel


@dataclass(frozen=True)
class Lookup:
    """Places on textures."""

    span: Tensor  # (m,) int64, sorted
    place: Tensor  # (3, 2, m) float64 Bernstein coefficients of X over the span [texels]
    scale: Tensor  # (3, m) of S
    multiplies: Tensor  # (m,) bool: its opacity multiplies what is behind


@spent_on("curvature")
def nodes_needed(
    dividers: list[Divider], lookup: Lookup, panels: tuple[Tensor, Tensor, Tensor], n_spans: int, slopes: bool = False
) -> Tensor:
    """Return how many nodes (p,) bring each panel below the tolerance; infinite where none are certain to.

    Args:
        dividers: all q of the spans.
        lookup: all places of the spans.
        panels: span, start and end (p,) of each, as shares of the span.
        n_spans: number of spans.
        slopes: whether gradients too shall be right, to ten times the tolerance for a q or X that moves by its size.

    Source: Trefethen 2013, theorem 19.3; ours.
    """
    _, start, end = panels
    sized = []
    degree = torch.zeros_like(start)  # of how what is looked at may move
    for divider in dividers:
        index, of = _on_panels(divider.span, panels, n_spans)
        q = _chebyshev(bernstein.restrict(divider.q[..., index], start[of], end[of]))
        q = bernstein.length(q, 1)
        limit = divider.limit(index, 0.5 * (start + end)[of]) if callable(divider.limit) else divider.limit
        sized.append((of, _significant(q, q[0]), limit))
        degree[of] = degree[of].clamp(min=len(q) - 1)
    index, of = _on_panels(lookup.span, panels, n_spans)
    scale, place = (
        _chebyshev(bernstein.restrict(c[..., index], start[of], end[of])) for c in (lookup.scale, lookup.place)
    )
    middle = torch.where(scale[0] != 0, scale[0], 1.0)
    ratio = place[0] / middle
    away = _significant((place - ratio * scale.unsqueeze(1)).abs(), place.abs().amax(0))
    multiplies = lookup.multiplies[index]
    degree[of] = degree[of].clamp(min=len(scale) - 1)
    needed = torch.full_like(start, torch.inf)
    for rho in RHO:
        fits = torch.ones_like(start, dtype=torch.bool)
        for owner, sizes, limit in sized:
            fits[owner[_tail(sizes, rho) > limit * sizes[0]]] = False
        grown = torch.log1p(2 * _tail(away, rho) / middle.abs()).sum(0)
        growth = torch.zeros_like(start).scatter_reduce(0, of, grown, "amax")  # colour, one at a time, times opacities
        growth = growth.index_add(0, of[multiplies], grown[multiplies] + math.log(LEVELS)) + math.log1p(rho / 2)
        growth = growth + degree * math.log(rho) if slopes else growth
        bound = growth + math.log(64 / 15 / 2 * GROWTH / (1 - rho**-2) / TOLERANCE)
        needed = torch.where(fits, torch.minimum(needed, bound / (2 * math.log(rho))), needed)
    return needed


def _on_panels(owner: Tensor, panels: tuple[Tensor, Tensor, Tensor], n_spans: int) -> tuple[Tensor, Tensor]:
    """Return which of the sorted owners' values lie on each panel, and the panel of each."""
    offsets = packed.offsets_from_owners(owner, n_spans)
    return packed.expand(offsets[panels[0]], offsets.diff()[panels[0]])


def _chebyshev(c: Tensor) -> Tensor:
    """Return the Chebyshev coefficients of polynomials given by Bernstein coefficients (d + 1, ...)."""
    return torch.tensordot(torch.as_tensor(_to_chebyshev(len(c) - 1), device=c.device), c, dims=1)


@cache
def _to_chebyshev(degree: int) -> np.ndarray:
    """Return the (d + 1, d + 1) matrix from Bernstein to Chebyshev coefficients on the same range."""
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    u = 0.5 * (nodes + 1)
    binomials = [math.comb(degree, k) for k in range(degree + 1)]
    values = np.stack([b * u**k * (1 - u) ** (degree - k) for k, b in enumerate(binomials)], axis=1)
    chebyshev = np.stack([np.cos(k * np.arccos(nodes)) for k in range(degree + 1)], axis=1)
    return np.linalg.solve(chebyshev, values)


def _significant(sizes: Tensor, like: Tensor) -> Tensor:
    """Return sizes (d + 1, ...) of coefficients, those that are rounding next to `like` as 0."""
    return torch.where(sizes > ROUNDING * like, sizes, 0.0)


def _tail(sizes: Tensor, rho: float) -> Tensor:
    """Return the most by which polynomials with Chebyshev coefficients of `sizes` (d + 1, ...) leave their middle."""
    return sum(sizes[k] * (0.5 * (rho**k + rho**-k)) for k in range(1, len(sizes)))
