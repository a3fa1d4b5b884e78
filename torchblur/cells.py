"""Cut each ray's time into cells: within a cell the same surfaces cover the ray, in one fixed order of depth.

Before: intervals.py, sort.py.  After: nodes.py, resolve.py.
Symbols: N intervals, X crossings, C cells, L layers (one interval in one cell); F = M_i D_j - M_j D_i has the sign of
nearness_i - nearness_j (both D have one sign over their interval).
Source: Ronnow et al. 2021, sec. 4.3 and alg. 1 (the event sweep), as tensor operations. Differs: any number of
crossings, any number at one instant, ties and equal starts: the order is taken at the cell's midpoint and certified
over the cell by Bernstein coefficients (ours).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import bernstein, packed
from torchblur.intervals import Intervals, attach_gradient, nearness_at
from torchblur.prisms import Prisms
from torchblur.sort import argsort_by, argsort_descending_in, inverse, is_tied, reorder_ties
from torchblur.stopwatch import spent_on

CROSSING_NOISE = 1e-12  # of the largest product: smaller coefficients of F are rounding
MIN_CELL = 1e-12  # of the window: shorter cells are not searched for crossings; a pixel changes by at most as much


@dataclass(frozen=True)
class Cells:
    """Slices of time per ray with their layers, nearest first, ended by the first opaque one."""

    offsets: Tensor  # (pixels + 1,) int64 cells of each pixel, in time order
    t_start: Tensor  # (C,) float64 shutter time
    t_end: Tensor  # (C,) float64
    layer_offsets: Tensor  # (C + 1,) int64
    layer_interval: Tensor  # (L,) int64
    n_crossings: int

    def of_pixels(self, intervals: Intervals, pixels: Tensor) -> tuple[Intervals, Cells]:
        """Return the `intervals`, which these cells cut, and the cells of `pixels` (C,), which become 0 to C - 1."""
        chosen, offsets = packed.select(self.offsets, pixels)
        layers, layer_offsets = packed.select(self.layer_offsets, chosen)
        own, _ = packed.select(intervals.offsets, pixels)
        place = torch.zeros_like(intervals.prism)
        place[own] = torch.arange(len(own), device=own.device)
        ends = self.t_start[chosen], self.t_end[chosen]
        cells = Cells(offsets, *ends, layer_offsets, place[self.layer_interval[layers]], self.n_crossings)
        return intervals.of_pixels(pixels), cells


@dataclass(frozen=True)
class Crossings:
    """Instants at which two surfaces change places along a ray."""

    pixel: Tensor  # (X,) int64
    t: Tensor  # (X,) float64 shutter time
    pair: Tensor  # (2, X) int64 the two intervals


@dataclass(frozen=True)
class _Layers:
    """Layers sorted by cell, then nearest first; cell k lies between the instants k and k + 1."""

    cell: Tensor  # (L,) int64, not all numbers occur
    interval: Tensor  # (L,) int64
    last_seen: Tensor  # (L,) int64 place of the first opaque layer of the cell, or of the cell's last layer
    instant_t: Tensor  # (G,) float64 distinct event times of all pixels end to end
    instant_pixel: Tensor  # (G,) int64


def count_layers(intervals: Intervals) -> Tensor:
    """Return (pixels,) how many layers the cells of each pixel will hold before crossings are added. Source: ours."""
    with torch.no_grad():
        first, last, _, _ = _instants(intervals, None)
        total = packed.offsets_from_counts(last - first)
    return total[intervals.offsets].diff()


def cut_cells(prisms: Prisms, intervals: Intervals, may_cross: bool = True) -> Cells:
    """Return the cells of every pixel, each with its layers in depth order.

    Args:
        prisms: of the scene.
        intervals: of some pixels.
        may_cross: whether surfaces may change places in depth; otherwise crossings are not looked for.

    Returns:
        Cells that cover exactly the times at which something covers the ray.

    Accuracy: the order within a cell is certified; crossings are found to about 1e-12 of the shutter time.
    Gradient: to vertices and camera through the times, those of crossings included.
    Source: Ronnow et al. 2021, sec. 4.3.
    """
    layers = _stack_layers(prisms, intervals, None)
    if not may_cross:
        return _pack(intervals, layers, 0)
    crossings = found = _find_crossings(prisms, intervals, layers)
    if len(crossings.pixel) == 0:
        return _pack(intervals, layers, 0)
    while len(found.pixel):
        pixels = torch.unique(found.pixel)  # only these can hold more: they have new neighbours in depth
        with torch.no_grad():
            pending = intervals.of_pixels(pixels)
            layers = _stack_layers(prisms, pending, _of_pixels(crossings, pixels))
        found = _find_crossings(prisms, pending, layers)
        own, _ = packed.select(intervals.offsets, pixels)
        found = Crossings(pixels[found.pixel], found.t, own[found.pair])
        crossings = _join(crossings, found)
    crossings = _attach(prisms, intervals, crossings)
    return _pack(intervals, _stack_layers(prisms, intervals, crossings), len(crossings.pixel))


def _instants(intervals: Intervals, crossings: Crossings | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the first and last instant of each interval (N,), and the time and pixel of all instants (G,).

    Equal times become one instant through their places in the sort, so that the ends of an interval cannot be
    assigned to the wrong cell.
    """
    pixel = packed.owners(intervals.offsets)
    t = torch.cat([intervals.t_start, intervals.t_end])
    pixel = torch.cat([pixel, pixel])
    if crossings is not None:
        t, pixel = torch.cat([t, crossings.t]), torch.cat([pixel, crossings.pixel])
    order = argsort_by(pixel, t.detach())
    t_sorted, pixel_sorted = t[order], pixel[order]
    is_new = torch.ones_like(order, dtype=torch.bool)
    is_new[1:] = (t_sorted[1:] != t_sorted[:-1]) | (pixel_sorted[1:] != pixel_sorted[:-1])
    place = (torch.cumsum(is_new.long(), 0) - 1)[inverse(order)]
    n = intervals.count
    return place[:n], place[n : 2 * n], t_sorted[is_new], pixel_sorted[is_new]


def _stack_layers(prisms: Prisms, intervals: Intervals, crossings: Crossings | None) -> _Layers:
    """Return the layers of all cells between the events, in depth order at the cells' midpoints."""
    first, last, instant_t, instant_pixel = _instants(intervals, crossings)
    with torch.no_grad():
        cell, interval = packed.expand(first, last - first)
        order = _depth_order(prisms, intervals, (cell, interval), (instant_t[cell], instant_t[cell + 1]))
        face = prisms.face_of[intervals.prism]
        cell, interval = cell[order], interval[order]

        is_last = torch.ones_like(cell, dtype=torch.bool)
        is_last[:-1] = cell[1:] != cell[:-1]
        ends = is_last | prisms.surfaces.is_opaque[face][interval]
        place = torch.where(ends, torch.arange(len(cell), device=cell.device), len(cell))
        last_seen = torch.full_like(instant_pixel, len(cell)).scatter_reduce(0, cell, place, "amin")[cell]
    return _Layers(cell, interval, last_seen, instant_t, instant_pixel)


def _depth_order(
    prisms: Prisms, intervals: Intervals, layers: tuple[Tensor, Tensor], times: tuple[Tensor, Tensor]
) -> Tensor:
    """Return the order of layers (cell, interval) by cell, then nearest first at the midpoint of the cell's `times`.

    Surfaces that meet at the midpoint may only touch there: a second point decides. Those that meet there too are
    coplanar, and the content of the faces decides.
    """
    cell, interval = layers
    nearness = _nearness(intervals, interval, 0.5 * (times[0] + times[1]))
    order = argsort_descending_in(cell, nearness)
    tied = is_tied(cell[order], nearness[order])
    if not tied.any():
        return order
    group = torch.cumsum((~tied).long(), 0)
    second = _nearness(intervals, interval, 0.75 * times[0] + 0.25 * times[1])
    inner = argsort_by(group, -second[order])
    order, group = order[inner], group[inner]
    rank = prisms.surfaces.tie_rank[prisms.face_of[intervals.prism[interval]]]
    return reorder_ties(order, is_tied(group, second[order]), rank)


def _nearness(intervals: Intervals, interval: Tensor, t: Tensor) -> Tensor:
    """Return the nearness (K,) of intervals at shutter times `t`, inf where an edge-on surface has none."""
    u = _local(intervals, interval, t)
    num, den = (bernstein.value(c[:, interval], u) for c in (intervals.near_num, intervals.near_den))
    return torch.where(den != 0, num / torch.where(den != 0, den, 1.0), torch.inf)


def _local(intervals: Intervals, interval: Tensor, t: Tensor) -> Tensor:
    """Return where in their interval the shutter times `t` (K,) lie, in [0, 1]."""
    start, end = intervals.t_start[interval], intervals.t_end[interval]
    return ((t - start) / (end - start)).clamp(0, 1)  # rounding only


def _pack(intervals: Intervals, layers: _Layers, n_crossings: int) -> Cells:
    """Return the visible layers, cells without any left out."""
    seen = (torch.arange(len(layers.cell), device=layers.cell.device) <= layers.last_seen).nonzero().flatten()
    cell, counts = torch.unique_consecutive(layers.cell[seen], return_counts=True)
    return Cells(
        offsets=packed.offsets_from_owners(layers.instant_pixel[cell], len(intervals.offsets) - 1),
        t_start=layers.instant_t[cell],
        t_end=layers.instant_t[cell + 1],
        layer_offsets=packed.offsets_from_counts(counts),
        layer_interval=layers.interval[seen],
        n_crossings=n_crossings,
    )


@spent_on("crossings")
@torch.no_grad()
def _find_crossings(prisms: Prisms, intervals: Intervals, layers: _Layers) -> Crossings:
    """Return the crossings inside the cells between layers whose order matters.

    These are neighbours in depth down to the first opaque layer, and that layer with each one behind it: if their
    orders hold over the cell, what is seen holds.
    """
    place = torch.arange(len(layers.cell), device=layers.cell.device)
    has_upper = torch.zeros_like(place, dtype=torch.bool)
    has_upper[1:] = layers.cell[1:] == layers.cell[:-1]
    length = layers.instant_t[layers.cell + 1] - layers.instant_t[layers.cell]
    least = MIN_CELL * (prisms.window[1] - prisms.window[0])
    lower = (has_upper & (length > least)).nonzero().flatten()
    upper = torch.minimum(lower - 1, layers.last_seen[lower])
    pair = torch.stack([layers.interval[upper], layers.interval[lower]])
    low, high = bernstein.ratio_range(intervals.near_num, intervals.near_den)
    suspect = (low[pair[0]] <= high[pair[1]]).nonzero().flatten()
    pair, cell = pair[:, suspect], layers.cell[lower[suspect]]
    start, end = layers.instant_t[cell], layers.instant_t[cell + 1]
    (num_i, den_i), (num_j, den_j) = (
        [
            bernstein.restrict(c[:, i], _local(intervals, i, start), _local(intervals, i, end))
            for c in (intervals.near_num, intervals.near_den)
        ]
        for i in pair
    )
    f = bernstein.product(num_i, den_j) - bernstein.product(num_j, den_i)
    size = [c.abs().amax(0) for c in (num_i, den_i, num_j, den_j)]
    which, u = bernstein.roots(f, CROSSING_NOISE * (size[0] * size[3] + size[2] * size[1]))
    t = start[which] + u * (end - start)[which]
    inner = ((t - start[which] > least) & (end[which] - t > least)).nonzero().flatten()
    which = which[inner]
    return Crossings(layers.instant_pixel[cell[which]], t[inner], pair[:, which])


def _of_pixels(crossings: Crossings, pixels: Tensor) -> Crossings:
    """Return the crossings in the sorted `pixels` (C,), which become pixels 0 to C - 1."""
    place = torch.searchsorted(pixels, crossings.pixel).clamp(max=len(pixels) - 1)
    kept = (pixels[place] == crossings.pixel).nonzero().flatten()
    return Crossings(place[kept], crossings.t[kept], crossings.pair[:, kept])


def _join(a: Crossings, b: Crossings) -> Crossings:
    return Crossings(torch.cat([a.pixel, b.pixel]), torch.cat([a.t, b.t]), torch.cat([a.pair, b.pair], dim=1))


def _attach(prisms: Prisms, intervals: Intervals, crossings: Crossings) -> Crossings:
    """Return the crossings with the gradient of their times to vertices and camera."""
    if not prisms.clip.requires_grad:
        return crossings
    (m_i, d_i, dm_i, dd_i), (m_j, d_j, dm_j, dd_j) = (
        nearness_at(prisms, intervals.prism[i], intervals.ray_ndc[:, crossings.pixel], crossings.t)
        for i in crossings.pair
    )
    f = m_i * d_j - m_j * d_i
    slope = (dm_i * d_j + m_i * dd_j - dm_j * d_i - m_j * dd_i).detach()
    every = torch.arange(len(crossings.t), device=f.device)
    return Crossings(crossings.pixel, attach_gradient(crossings.t, every, f, slope), crossings.pair)
