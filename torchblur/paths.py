"""Paths: what the layers of cells do over slices of time, as polynomials.

Before: cells.py.  After: texture_bends.py, light_bends.py, nodes.py.
Symbols: spans are slices of cells in which neither the shutter nor a light has a knot; K pairs of a span and one of the
layers in its cell whose look varies with time; tau in [0, 1] is time in the span; S = e_0 + e_1 + e_2. An attribute of
the point at the ray is sum(e_i s_i) / S. All polynomials are kept by their Bernstein coefficients over the span.
Source: Ronnow et al. 2022, eq. 1 and 2; polynomial form ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import bernstein, edges, packed
from torchblur.cells import Cells
from torchblur.edges import Corners
from torchblur.intervals import Intervals
from torchblur.prisms import Prisms
from torchblur.sort import between


@dataclass(frozen=True)
class Spans:
    """Slices of the cells in which something varies, in order of cell and time."""

    cell: Tensor  # (n,) int64
    start: Tensor  # (n,) float64 share of the cell at which the slice begins
    end: Tensor  # (n,) and ends
    t: Tensor  # (2, n) shutter times of both


@dataclass(frozen=True)
class Paths:
    """The layers of spans whose look varies with time."""

    span: Tensor  # (K,) int64, sorted
    prism: Tensor  # (K,) int64
    face: Tensor  # (K,) int64
    u: Tensor  # (2, K) local times of the prism at both ends of the span
    corners: Corners  # over the span
    e: Tensor  # (3 coefficients, 3 edges, K)
    scale: Tensor  # (3, K) coefficients of S
    t: Tensor  # (2, K) shutter times of both ends of the span
    spacing_ndc: tuple[float, float]  # from one ray to the next

    def choose(self, chosen: Tensor) -> Paths:
        """Return the pairs `chosen` (J,)."""
        parts = {k: getattr(self, k)[..., chosen] for k in ("span", "prism", "face", "u", "e", "scale", "t")}
        return Paths(corners=self.corners[chosen], spacing_ndc=self.spacing_ndc, **parts)

    def attribute(self, ends: Tensor) -> Tensor:
        """Return (4, c, K) coefficients of sum(e_i s_i) for s (2 ends of the prism, 3 corners, c, K)."""
        at_ends = torch.stack([(1 - u) * ends[0] + u * ends[1] for u in self.u])
        return bernstein.product(self.e.unsqueeze(2), at_ends).sum(1)


def cut_spans(prisms: Prisms, cells: Cells, is_varying: Tensor, knots: tuple[Tensor, Tensor]) -> Spans:
    """Return the spans of the cells in which a look depends on time.

    Args:
        prisms: of the scene.
        cells: with their visible layers.
        is_varying: (L,) bool of all layers, whether their look depends on time.
        knots: shutter times at which a shutter bends (J,), and by how much a line delays each for every pixel
            (J, pixels).

    Source: ours.
    """
    cell = torch.unique_consecutive(packed.owners(cells.layer_offsets)[is_varying])
    pixel = packed.owners(cells.offsets)[cell]
    times, delays = knots
    still = torch.tensor(sorted({t for light in prisms.surfaces.lights for t in light.knots}), dtype=torch.float64)
    rows = [time + delay[pixel] for time, delay in zip(times, delays, strict=True)]
    owner, start, end = _slices(cells, cell, [*rows, *still.to(cell.device)])
    t_start, t_end = cells.t_start[cell], cells.t_end[cell]
    ends = torch.stack([(1 - tau) * t_start[owner] + tau * t_end[owner] for tau in (start, end)])
    return Spans(cell[owner], start, end, ends)


def cut_at_knots(cells: Cells, knots: tuple[Tensor, Tensor]) -> Cells:
    """Return the cells cut where a shutter bends, with their layers; `knots` as in `cut_spans`. Source: ours."""
    pixel = packed.owners(cells.offsets)
    every = torch.arange(len(pixel), device=pixel.device)
    owner, start, end = _slices(cells, every, [time + delay[pixel] for time, delay in zip(*knots, strict=True)])
    counts = cells.layer_offsets.diff()[owner]
    layer, _ = packed.expand(cells.layer_offsets[owner], counts)
    ends = ((1 - tau) * cells.t_start[owner] + tau * cells.t_end[owner] for tau in (start, end))
    return Cells(
        packed.offsets_from_owners(pixel[owner], len(cells.offsets) - 1),
        *ends,
        packed.offsets_from_counts(counts),
        cells.layer_interval[layer],
        cells.n_crossings,
    )


def _slices(cells: Cells, cell: Tensor, times: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the place in `cell` (C,), start and end, as shares of it, of the slices of cells between shutter `times`,
    each for all or (C,).
    """
    t_start, t_end = cells.t_start[cell].detach(), cells.t_end[cell].detach()
    every = torch.arange(len(cell), device=cell.device)
    owners, taus = [every, every], [torch.zeros_like(t_start), torch.ones_like(t_start)]
    for time in times:
        tau = (time - t_start) / (t_end - t_start)
        inside = ((tau > 0) & (tau < 1)).nonzero().flatten()
        owners.append(inside)
        taus.append(tau[inside])
    return between(torch.cat(owners), torch.cat(taus))


def follow(prisms: Prisms, intervals: Intervals, cells: Cells, spans: Spans, is_followed: Tensor) -> Paths:
    """Return the paths of those layers in the cells of `spans` that, of all, `is_followed` (L,) tells. Source: ours."""
    counts = cells.layer_offsets.diff()[spans.cell]
    layer, span = packed.expand(cells.layer_offsets[spans.cell], counts)
    chosen = is_followed[layer].nonzero().flatten()
    interval, span = cells.layer_interval[layer[chosen]], span[chosen]
    prism = intervals.prism[interval]
    face = prisms.face_of[prism]
    t = spans.t[:, span]
    u = (t - prisms.t_open[prism]) / (prisms.t_close - prisms.t_open)[prism]
    ray = intervals.ray_ndc[:, intervals.pixel_of(interval)]
    corners = edges.reduce_corners(prisms.clip, prism, ray).between(*u)
    e = edges.edge_coefficients(corners)
    return Paths(span, prism, face, u, corners, e, e.sum(1), t, intervals.spacing_ndc)
