"""Which triangles may come between a light and which points: candidates from bounds as the light sees them.

Before: casters.py, blocking.py, cpu/join.py.  After: shadows.py.
Symbols: a view is a flat picture of the scene from the light: one of the six sides of a cube around a place, or a plane
that a direction crosses between two knots of it. Both what casts and what receives sweep a rectangle in it. Level l of
a view has 2^l by 2^l cells; things lie in the finest level in whose cells they fit, and then touch at most 2 by 2.
Source: ours.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchblur import bernstein, packed
from torchblur.blocking import Receivers
from torchblur.casters import Casters
from torchblur.cpu.join import Found, join
from torchblur.cpu.sides import arrays_of
from torchblur.lights import DirectionalLight, Light, along, unit
from torchblur.prisms import swept_bounds_px

FINEST = 10  # level
AT_ONCE = 1 << 15  # pairs looked at together: 30 MB, which caches hold in part
FEW_PAIRS = 1 << 17  # below, all pairs are looked at; cells would take longer
PARTS = 8  # of a caster's time in which bounds are found, too: what moves fills little of what it sweeps
MANY = 1 << 15  # casters, of more of which no parts are looked at: 256 bytes each, and several times that on the way
SIDE = 2  # [-1, 1] is how wide the side of a cube is, from 0 to 2 in the units of `swept_bounds_px`
NEAR = 1e-12  # of the casters' extent: nothing is nearer to a light
SLACK = 1e-9  # of the casters' extent: widening of bounds against rounding


@dataclass(frozen=True)
class _Swept:
    """What casters or receivers sweep in a view."""

    which: Tensor  # (n,) int64
    low: Tensor  # (2, n) float64
    high: Tensor  # (2, n)
    depth: Tensor  # (n,) from the light: the least of a caster, the greatest of a receiver
    parts: Tensor  # (PARTS, 1 or 0, 4, n) least and greatest x and y of a caster in each part of its time

    def choose(self, chosen: Tensor) -> _Swept:
        """Return the things `chosen` (J,)."""
        return _Swept(*(getattr(self, name)[..., chosen] for name in ("which", "low", "high", "depth", "parts")))


def candidate_pairs(light: Light, receivers: Receivers, casters: Casters) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield receiver and caster (n,) of all pairs that may block the light and share some time, in portions; where both
    lie on a border between sides of the cube, more than once. Source: ours.
    """
    views = _directional_views if isinstance(light, DirectionalLight) else _cube_views
    kept: list[tuple[Tensor, Tensor]] = []
    for receiver, caster in views(light, receivers, casters):
        for pairs in _join(receiver, caster, receivers, casters):
            kept.append(pairs)
            if sum(len(r) for r, _ in kept) >= AT_ONCE:
                yield together(kept)
                kept = []
    if kept:
        yield together(kept)


def blocked_ranges(
    light: Light, receivers: Receivers, casters: Casters, hides: Tensor
) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor], int]:
    """Return receiver, caster, start and end (R,) of the shares of the receivers' slices in which `candidate_pairs`
    block the light, and how many pairs were looked at: compiled, for tensors on the CPU.

    Args:
        light: that shines.
        receivers: K points.
        casters: C triangles.
        hides: (C,) bool, which of them are opaque: what these block, others need not be looked at for.

    Source: ours.
    """
    views = _directional_views if isinstance(light, DirectionalLight) else _cube_views
    faces = receivers.face.contiguous().numpy(), casters.face.contiguous().numpy(), hides.contiguous().numpy()
    arrays = faces, arrays_of(light, receivers, casters)
    found, n_seen = Found.nothing(receivers.count, casters.count), 0
    for view in views(light, receivers, casters):
        things = _in_common_box(*view)
        n, m = (len(thing.which) for thing in things)
        if n * m:
            boxes = ((t.which, torch.cat([t.low, t.high, t.depth.unsqueeze(0)]), _level(t), t.parts) for t in things)
            found, more = join(*boxes, n * m <= FEW_PAIRS, arrays, found)
            n_seen += more
    return found.rows(), n_seen


def together(parts: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Return pairs end to end."""
    r, c = (torch.cat(p) for p in zip(*parts, strict=True))
    return r, c


def _cube_views(light: Light, receivers: Receivers, casters: Casters) -> Iterator[tuple[_Swept, _Swept]]:
    """Yield what is seen on the six sides of a cube around a light."""
    times = receivers.t[:1] if receivers.are_instants else receivers.t
    position = torch.stack([along(light.position, t) for t in times])
    vector = receivers.place - bernstein.product(receivers.scale.unsqueeze(1), position)  # (4 or 1, 3, K)
    scale = _raised(receivers.scale, len(vector))
    if light not in casters.views:
        casters.views[light] = _casters_on_sides(light, casters)
    for (a, b, axis, side), caster in casters.views[light]:
        depth = side * vector[:, axis]
        is_ahead = (depth > 0).any(0).nonzero().flatten()
        depth = depth[:, is_ahead]
        low, high = (torch.stack(r) for r in zip(*(_ahead(vector[:, k, is_ahead], depth) for k in (a, b)), strict=True))
        furthest = bernstein.ratio_range(depth, scale[:, is_ahead])[1]
        yield _in_side(is_ahead, low + 1, high + 1, furthest), caster


def _casters_on_sides(light: Light, casters: Casters) -> list[tuple[tuple[int, int, int, float], _Swept]]:
    """Return the casters on those sides of a cube around a light that see some, with both axes across, the axis along
    and its sign.
    """
    ends = torch.stack([casters.t_open, casters.t_close])
    corners = casters.world - torch.stack([along(light.position, t) for t in ends]).unsqueeze(1)  # (2, 3, 3, C)
    every, found = torch.arange(casters.count, device=corners.device), []
    for axis, side in itertools.product(range(3), (1.0, -1.0)):
        axes = *(k for k in range(3) if k != axis), axis, side
        bounds = _on_side(corners, axes, casters.extent)
        caster = _in_side(every, bounds[:2], bounds[2:], (side * corners[:, :, axis]).amin((0, 1)))
        if len(caster.which):
            parts = _on_side(_in_parts(corners[..., caster.which]), axes, casters.extent)
            found.append((axes, replace(caster, parts=_by_part(parts, len(caster.which)))))
    return found


def _in_parts(linear: Tensor) -> Tensor:
    """Return (2, ..., parts * n) values at the ends of each part of a time in which (2, ..., n) change linearly."""
    n_parts = PARTS if linear.shape[-1] <= MANY else 1
    u = torch.linspace(0, 1, n_parts + 1, dtype=linear.dtype, device=linear.device).unsqueeze(1)
    at = (1 - u) * linear[0].unsqueeze(-2) + u * linear[1].unsqueeze(-2)  # (..., PARTS + 1, n)
    return torch.stack([at[..., :-1, :], at[..., 1:, :]]).flatten(-2)


def _by_part(bounds: Tensor, n: int) -> Tensor:
    """Return bounds (4, parts * n) as (parts, 4, n)."""
    return bounds.reshape(4, -1, max(n, 1)).transpose(0, 1)[..., :n]


def _on_side(corners: Tensor, axes: tuple[int, int, int, float], extent: float) -> Tensor:
    """Return the bounds (4, n) of corners (2, 3, 3, n) on a side of the cube: axes across, axis and sign along."""
    a, b, axis, side = axes
    w = side * corners[:, :, axis]
    clip = torch.stack([corners[:, :, a], -corners[:, :, b], w, w], dim=2)
    return swept_bounds_px(clip, w - NEAR * extent, SIDE, SIDE)


def _in_side(which: Tensor, low: Tensor, high: Tensor, depth: Tensor) -> _Swept:
    """Return what overlaps a side of the cube, cut to it."""
    met = ((low <= SIDE) & (high >= 0)).all(0).nonzero().flatten()
    return _Swept(which, low.clamp(min=0), high.clamp(max=SIDE), depth, _no_parts(which)).choose(met)


def _no_parts(which: Tensor) -> Tensor:
    """Return the bounds in parts of things `which` (n,) that are not divided."""
    return torch.zeros(0, 4, len(which), dtype=torch.float64, device=which.device)


def _ahead(numerator: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Return bounds (K,) of a quotient; infinite where the depth may be 0 or below."""
    low, high = bernstein.ratio_range(numerator, depth)
    is_behind = (depth <= 0).any(0)
    return torch.where(is_behind, -torch.inf, low), torch.where(is_behind, torch.inf, high)


def _directional_views(light: Light, receivers: Receivers, casters: Casters) -> Iterator[tuple[_Swept, _Swept]]:
    """Yield what is seen along a direction, between each two knots of it."""
    knots = torch.tensor([0.0, *light.knots, 1.0], dtype=torch.float64, device=casters.face.device)
    ends = torch.stack([casters.t_open, casters.t_close])
    times = receivers.t[:1] if receivers.are_instants else receivers.t
    corners = casters.world - casters.centre.reshape(3, 1)
    scale = _raised(receivers.scale, len(receivers.place))
    place = receivers.place - scale.unsqueeze(1) * casters.centre.unsqueeze(1)
    for k, (start, end) in enumerate(itertools.pairwise(knots)):
        until = torch.inf if k == len(knots) - 2 else end
        own, of = (((t.mean(0) >= start) & (t.mean(0) < until)).nonzero().flatten() for t in (receivers.t, ends))
        axes = _axes(along(light.direction, torch.stack([start, end])))
        way, slack = torch.stack([along(light.direction, t) for t in ends[:, of]]), SLACK * casters.extent
        bounds, least = _on_plane(corners[..., of], way, axes, slack)
        parts, _ = _on_plane(_in_parts(corners[..., of]), _in_parts(way), axes, slack)
        caster = _Swept(of, bounds[:2], bounds[2:], least, _by_part(parts, len(of)))
        way = torch.stack([along(light.direction, t) for t in times[:, own]])
        low, high, _, most = _sheared(place[..., own], receivers.scale[:, own], way, axes)
        yield _Swept(own, low, high, most, _no_parts(own)), caster


def _on_plane(corners: Tensor, way: Tensor, axes: Tensor, slack: float) -> tuple[Tensor, Tensor]:
    """Return the bounds (4, n) of corners (2, 3, 3, n) moved along the light's `way` (2, 3, n), and the least depth."""
    one = torch.ones(1, way.shape[-1], dtype=torch.float64, device=way.device)
    seen = [_sheared(corners[:, c], one, way, axes) for c in range(3)]
    low, high, least, _ = (torch.stack(s) for s in zip(*seen, strict=True))
    return torch.cat([low.amin(0) - slack, high.amax(0) + slack]), least.amin(0)


def _axes(directions: Tensor) -> Tensor:
    """Return (3, 3) unit vectors, row by row: two across and one along the mean of the `directions` (3, n)."""
    mean = unit(unit(directions).mean(1, keepdim=True))[:, 0]
    mean = torch.where(mean.norm() > 0, mean, unit(directions)[:, 0])  # opposite directions have none
    least = torch.eye(3, dtype=mean.dtype, device=mean.device)[mean.abs().argmin()]
    first = unit(torch.linalg.cross(mean, least).unsqueeze(1))[:, 0]
    return torch.stack([first, torch.linalg.cross(mean, first), mean])


def _sheared(place: Tensor, scale: Tensor, way: Tensor, axes: Tensor) -> tuple[Tensor, ...]:
    """Return bounds (2, n) and (2, n) of where points, moved along the light's `way` (2 or 1, 3, n), cross the plane of
    the first two axes, and (n,) and (n,) of how far they are along the third; infinite where the light may run across.
    """
    place, way = (torch.einsum("ak,dkn->dan", axes, c) for c in (place, way))
    across, height, drift, fall = place[:, :2], place[:, 2:], way[:, :2], way[:, 2:]
    at = bernstein.product(fall, across) - bernstein.product(drift, height)
    by = _raised(bernstein.product(fall[:, 0], scale), len(at))
    low, high = (torch.stack(r) for r in zip(*(_ahead(at[:, k], by) for k in range(2)), strict=True))
    least, most = bernstein.ratio_range(height[:, 0], _raised(scale, len(height)))
    runs_across = (fall[:, 0] <= 0).any(0)
    return low, high, torch.where(runs_across, -torch.inf, least), torch.where(runs_across, torch.inf, most)


def _raised(coefficients: Tensor, length: int) -> Tensor:
    """Return the same polynomials (n at the end) by `length` coefficients."""
    missing = length - len(coefficients)
    return bernstein.product(coefficients, coefficients.new_ones(missing + 1, 1)) if missing else coefficients


def _join(receiver: _Swept, caster: _Swept, receivers: Receivers, casters: Casters) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the pairs of a view whose rectangles, depths and times overlap."""
    receiver, caster = _in_common_box(receiver, caster)
    for a, b, meeting in _meetings(receiver, caster):
        for i, j in meeting:
            near = (a.low[:, i] <= b.high[:, j]).all(0) & (b.low[:, j] <= a.high[:, i]).all(0)
            near &= b.depth[j] <= a.depth[i]
            r, c = a.which[i[near]], b.which[j[near]]
            together = _share_time(receivers, casters, r, c) & (receivers.face[r] != casters.face[c])
            if together.any():
                yield r[together], c[together]


def _meetings(receiver: _Swept, caster: _Swept) -> Iterator[tuple[_Swept, _Swept, Iterator[tuple[Tensor, Tensor]]]]:
    """Yield parts of both, with the pairs of places in these that may overlap: all of them where there are few."""
    n, m = len(receiver.which), len(caster.which)
    if n * m <= FEW_PAIRS:
        every = torch.arange(n * m, device=receiver.which.device)
        yield receiver, caster, iter([(every // max(m, 1), every % max(m, 1))])
        return
    levels = [_level(thing) for thing in (receiver, caster)]
    for of_receiver in torch.unique(levels[0]).tolist():
        a = receiver.choose((levels[0] == of_receiver).nonzero().flatten())
        for of_caster in torch.unique(levels[1]).tolist():
            b = caster.choose((levels[1] == of_caster).nonzero().flatten())
            yield a, b, _meeting_in_cells(a, b, 2 ** min(of_receiver, of_caster))


def _share_time(receivers: Receivers, casters: Casters, r: Tensor, c: Tensor) -> Tensor:
    """Return whether pairs (n,) share more than an instant; instants belong to the slice that begins with them."""
    start, end = casters.t_open[c], casters.t_close[c]
    first, last = receivers.t[:, r]
    if receivers.are_instants:
        return (first >= start) & ((first < end) | (end == 1))
    return torch.maximum(first, start) < torch.minimum(last, end)


def _in_common_box(*things: _Swept) -> list[_Swept]:
    """Return of both what lies in the box of the other, with the common box as [0, 1] on both axes."""
    if any(len(t.which) == 0 for t in things):
        return [t.choose(t.which[:0]) for t in things]
    first = torch.maximum(*(t.low.amin(1) for t in things))
    last = torch.minimum(*(t.high.amax(1) for t in things))
    is_bound = (first < last) & torch.isfinite(first) & torch.isfinite(last)
    base, size = torch.where(is_bound, first, 0.0), torch.where(is_bound, last - first, 1.0)
    out = []
    for thing in things:
        met = ((thing.low <= last.unsqueeze(1)) & (thing.high >= first.unsqueeze(1))).all(0).nonzero().flatten()
        part = thing.choose(met)
        bounds = (
            (c - base.unsqueeze(1)) / size.unsqueeze(1) for c in (part.low, part.high, *part.parts.split(2, dim=1))
        )
        low, high, *parts = (b.clamp(0.0, 1.0) for b in bounds)
        out.append(_Swept(part.which, low, high, part.depth, torch.cat(parts, dim=1)))
    return out


def _level(thing: _Swept) -> Tensor:
    """Return the finest level (n,) in whose cells each thing fits."""
    extent = (thing.high - thing.low).amax(0).clamp(min=2.0**-FINEST)
    return (-torch.log2(extent)).floor().long().clamp(0, FINEST)


def _meeting_in_cells(a: _Swept, b: _Swept, n: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the pairs of places in `a` and `b`, each once, that touch a common one of n by n cells, in portions."""
    (of_a, cell_a, first_a), (of_b, cell_b, first_b) = (_cells(thing, n) for thing in (a, b))
    order = torch.sort(cell_b, stable=True).indices
    cell_b, of_b = cell_b[order], of_b[order]
    begin = torch.searchsorted(cell_b, cell_a)
    counts = torch.searchsorted(cell_b, cell_a, right=True) - begin
    some = counts.nonzero().flatten()
    portion = torch.cumsum(counts[some], 0) // AT_ONCE
    for chosen in some.split(torch.unique_consecutive(portion, return_counts=True)[1].tolist()):
        place, owner = packed.expand(begin[chosen], counts[chosen])
        i, j = of_a[chosen[owner]], of_b[place]
        common = torch.maximum(first_a[:, i], first_b[:, j])
        is_first = common[1] * n + common[0] == cell_a[chosen[owner]]
        yield i[is_first], j[is_first]


def _cells(thing: _Swept, n: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the things and cells (m,) that touch, and the first cell (2, things) of each."""
    first, last = ((c * n).floor().long().clamp(0, n - 1) for c in (thing.low, thing.high))
    things, cells = [], []
    for dy, dx in itertools.product(range(2), repeat=2):
        x, y = first[0] + dx, first[1] + dy
        touched = ((x <= last[0]) & (y <= last[1])).nonzero().flatten()
        things.append(touched)
        cells.append((y * n + x)[touched])
    return torch.cat(things), torch.cat(cells), first
