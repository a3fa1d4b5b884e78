"""How much of each light reaches points: exact ranges of time in which casters block it, and what these let through.

Before: shadow_pairs.py, blocking.py.  After: averages.py, instant.py (at instants), nodes.py (exact).
Symbols: K receivers (see blocking.py); R ranges of one light; a range of opaque casters is their union.
The depth-time ranges of Hong & Oh 2018 hold, for a texel of a map, the times at which triangles cover it; here they
hold, for each point that the camera sees, the times at which triangles block its light: there is no texel, no bias
against one and nothing to filter. Memory is that of the ranges found.
Source: Hong & Oh 2018 (ranges of time); Aila & Laine 2004 (points of view as samples of the light); ours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchblur import packed
from torchblur.blocking import Receivers, when_blocked
from torchblur.lights import DirectionalLight, Light, along
from torchblur.shading import Points
from torchblur.shadow_pairs import blocked_ranges, candidate_pairs
from torchblur.sort import SAME_TIME, argsort_by
from torchblur.stopwatch import spent_on
from torchblur.surfaces import Surfaces
from torchblur.texture import lookup

NOTHING = -1  # the caster of a range of opaque ones
MANY = 1 << 20  # receivers times casters; fewer are not worth loading compiled code
TEXTURED_SLICES = 64  # into which a range of a caster with varying opacity is cut: that is sampled, not certified


@dataclass(frozen=True)
class Ranges:
    """When one light is blocked."""

    offsets: Tensor  # (K + 1,) of the receivers
    start: Tensor  # (R,) float64 share of the receiver's slice of time
    end: Tensor  # (R,)
    caster: Tensor  # (R,) int64; NOTHING where opaque

    def choose(self, chosen: Tensor) -> Ranges:
        """Return the ranges of the receivers `chosen` (J,)."""
        index, offsets = packed.select(self.offsets, chosen)
        return Ranges(offsets, self.start[index], self.end[index], self.caster[index])


@dataclass(frozen=True)
class Shadows:
    """When which lights are blocked for K receivers."""

    ranges: tuple[Ranges | None, ...]  # light by light; None for one that casts no shadows
    n_pairs: int  # of receivers and casters that were looked at

    def choose(self, chosen: Tensor) -> Shadows:
        """Return what the receivers `chosen` (J,) get; of the pairs, all that were looked at."""
        return Shadows(tuple(r.choose(chosen) if r else None for r in self.ranges), self.n_pairs)

    @property
    def n_ranges(self) -> int:
        """Number of ranges of all lights."""
        return sum(len(r.start) for r in self.ranges if r)

    @property
    def n_bytes(self) -> int:
        """Memory that the ranges of all lights take."""
        kept = ((r.offsets, r.start, r.end, r.caster) for r in self.ranges if r)
        return sum(part.numel() * part.element_size() for parts in kept for part in parts)

    @property
    def deepest(self) -> int:
        """Most ranges of one receiver and light."""
        return max((int(r.offsets.diff().max()) for r in self.ranges if r and len(r.offsets) > 1), default=0)

    @spent_on("shadows")
    def ends(self, surfaces: Surfaces) -> tuple[Tensor, Tensor]:
        """Return the receivers (B,) and times (B,) at which a light on them is blocked or freed, and between which a
        blocked one varies by as much as one look may stand for.
        """
        receivers, times = [], []
        for ranges in self.ranges:
            if ranges is None:
                continue
            owner = packed.owners(ranges.offsets)
            receivers += [owner, owner]
            times += [ranges.start, ranges.end]
            varying = _varies(surfaces, ranges).nonzero().flatten()
            for k in range(1, TEXTURED_SLICES):
                share = k / TEXTURED_SLICES
                receivers.append(owner[varying])
                times.append((1 - share) * ranges.start[varying] + share * ranges.end[varying])
        if not receivers:
            empty = torch.zeros(0, dtype=torch.int64, device=surfaces.rgb.device)
            return empty, empty.to(torch.float64)
        return torch.cat(receivers), torch.cat(times)

    def visibility(self, surfaces: Surfaces, receiver: Tensor, tau: Tensor, at: tuple[Tensor, Tensor]) -> Tensor:
        """Return (lights, J) the share of each light that reaches points.

        Args:
            surfaces: of the scene.
            receiver: (J,) whose points these are.
            tau: (J,) time, as a share of the receiver's slice.
            at: place (3, J) and shutter time (J,) of each.

        Gradient: to the opacity and texture of the casters.
        """
        rows = []
        for light, ranges in zip(surfaces.lights, self.ranges, strict=True):
            if ranges is None or len(ranges.start) == 0:
                rows.append(torch.ones_like(tau))
                continue
            index, owner = packed.expand(ranges.offsets[receiver], ranges.offsets.diff()[receiver])
            inside = ((ranges.start[index] <= tau[owner]) & (tau[owner] < ranges.end[index])).nonzero().flatten()
            index, owner = index[inside], owner[inside]
            caster = ranges.caster[index]
            alpha = torch.ones_like(tau[owner])
            some = (caster != NOTHING).nonzero().flatten()
            if len(some):
                point, t = (c[..., owner[some]] for c in at)
                alpha = alpha.index_put((some,), _opacity(surfaces, light, caster[some], (point, t)))
            rows.append(packed.transmittance(alpha, packed.offsets_from_owners(owner, len(tau)))[1])
        return torch.stack(rows)


@spent_on("shadows")
@torch.no_grad()
def find_shadows(surfaces: Surfaces, receivers: Receivers, is_due: tuple[Tensor, ...]) -> Shadows:
    """Return when casters come between the lights and the receivers.

    Args:
        surfaces: with casters.
        receivers: K points over slices of time, in which no light has a knot.
        is_due: light by light (K,) bool, whether the light is due at all: not where the surface faces away throughout.

    Accuracy: times are exact; what passes a texture's opacity is sampled TEXTURED_SLICES times, not certified. A caster
        nearer to a point than casters.GAP of its coordinates does not block it.
    Source: ours.
    """
    found, n_pairs = [], 0
    for light, due in zip(surfaces.lights, is_due, strict=True):
        if not light.casts_shadows:
            found.append(None)
            continue
        own = due.nonzero().flatten()
        chosen = receivers.choose(own)
        (receiver, caster, start, end), n = _blocked(surfaces, light, chosen)
        n_pairs += n
        found.append(_united(surfaces, receivers.count, own[receiver], caster, start, end))
    return Shadows(tuple(found), n_pairs)


def _blocked(
    surfaces: Surfaces, light: Light, receivers: Receivers
) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor], int]:
    """Return receiver, caster, start and end (R,) of what blocks a light, and how many pairs were looked at."""
    casters = surfaces.casters
    if receivers.count * casters.count >= MANY and receivers.face.device.type == "cpu":
        return blocked_ranges(light, receivers, casters, surfaces.is_opaque[casters.face])
    parts, n_pairs = [(receivers.face[:0], receivers.face[:0], receivers.t[0, :0], receivers.t[0, :0])], 0
    for receiver, caster in candidate_pairs(light, receivers, casters):
        which, start, end = when_blocked(light, receivers, casters, (receiver, caster))
        parts.append((receiver[which], caster[which], start, end))
        n_pairs += len(receiver)
    return tuple(torch.cat(p) for p in zip(*parts, strict=True)), n_pairs


def visible_at(surfaces: Surfaces, point: Tensor, t: Tensor, face: Tensor) -> Tensor | None:
    """Return (lights, J) the share of each light that reaches points at instants; None where there are no shadows.

    Args:
        surfaces: of the scene.
        point: (3, J) float64 world positions.
        t: (J,) shutter times.
        face: (J,) on which they lie.

    Gradient: to the opacity and texture of the casters.
    Source: ours.
    """
    if surfaces.casters is None:
        return None
    now = t.detach()
    every = torch.ones_like(face, dtype=torch.bool)
    place, scale = point.detach().unsqueeze(0), torch.ones_like(now).unsqueeze(0)
    receivers = Receivers(place, scale, torch.stack([now, now]), face, every)
    shadows = find_shadows(surfaces, receivers, (every,) * len(surfaces.lights))
    return shadows.visibility(surfaces, torch.arange(len(t), device=t.device), torch.zeros_like(now), (point, t))


def with_shadows(surfaces: Surfaces, points: Points, known: tuple[Shadows, Tensor, Tensor] | None = None) -> Points:
    """Return points with the share of each light that reaches them.

    Args:
        surfaces: of the scene.
        points: J of them.
        known: shadows, of which receiver (J,) each point is or -1, and when (J,) as a share of its slice; those of no
            receiver, and all if None, are looked at as instants.

    Source: ours.
    """
    lit = surfaces.is_lit[points.face].nonzero().flatten()
    if surfaces.casters is None or len(lit) == 0:
        return points
    visible = torch.ones(len(surfaces.lights), len(points.t), dtype=torch.float64, device=points.t.device)
    place = (points.weight[:, lit].unsqueeze(1) * points.world[..., lit]).sum(0)
    t, face = points.t[lit], points.face[lit]
    receiver = torch.full_like(lit, -1) if known is None else known[1][lit]
    on, off = (chosen.nonzero().flatten() for chosen in (receiver >= 0, receiver < 0))
    if len(on):
        at = place[:, on], t[on]
        rows = known[0].visibility(surfaces, receiver[on], known[2][lit[on]], at)
        visible = visible.index_copy(1, lit[on], rows)
    if len(off):
        visible = visible.index_copy(1, lit[off], visible_at(surfaces, place[:, off], t[off], face[off]))
    return replace(points, visible=visible)


def _varies(surfaces: Surfaces, ranges: Ranges) -> Tensor:
    """Return whether the opacity of what blocks in each range (R,) depends on where it is hit."""
    some = ranges.caster != NOTHING
    return some & surfaces.has_varying_opacity[surfaces.casters.face[ranges.caster.clamp(min=0)]]


def _united(
    surfaces: Surfaces, n_receivers: int, receiver: Tensor, caster: Tensor, start: Tensor, end: Tensor
) -> Ranges:
    """Return the ranges (N,) of a light by receiver, those of the same face, or of opaque ones, that touch made one;
    faces whose opacity varies over them stay apart by their slices of time.
    """
    face = surfaces.casters.face[caster]
    n_faces = len(surfaces.opacity)
    key = torch.where(surfaces.has_varying_opacity[face], n_faces + caster, face)
    key = torch.where(surfaces.is_opaque[face], NOTHING, key)
    order = argsort_by(receiver, key, start)
    receiver, key, caster, start, end = (part[order] for part in (receiver, key, caster, start, end))
    if len(key) == 0:
        return Ranges(packed.offsets_from_owners(receiver, n_receivers), start, end, caster)
    is_new = torch.ones_like(receiver, dtype=torch.bool)
    is_new[1:] = (receiver.diff() != 0) | (key.diff() != 0)
    group = torch.cumsum(is_new.long(), 0)
    reach = torch.cummax(end + 2.0 * group, 0).values - 2.0 * group  # the furthest end so far in the group
    is_new[1:] |= start[1:] > reach[:-1] + SAME_TIME
    place = torch.cumsum(is_new.long(), 0) - 1
    first = is_new.nonzero().flatten()
    end = torch.zeros_like(start[first]).scatter_reduce(0, place, end, "amax", include_self=False)
    caster = torch.where(key[first] == NOTHING, NOTHING, caster[first])
    return Ranges(packed.offsets_from_owners(receiver[first], n_receivers), start[first], end, caster)


def _opacity(surfaces: Surfaces, light: Light, caster: Tensor, at: tuple[Tensor, Tensor]) -> Tensor:
    """Return the opacity (J,) of casters where the light's way to points (3, J) at times (J,) meets them."""
    casters = surfaces.casters
    face = casters.face[caster]
    alpha = surfaces.opacity[face]
    varying = surfaces.has_varying_opacity[face].nonzero().flatten()
    if len(varying) == 0:
        return alpha
    point, t = (c[..., varying].detach() for c in at)
    caster, face = caster[varying], face[varying]
    u = (t - casters.t_open[caster]) / (casters.t_close - casters.t_open)[caster]
    first, last = casters.world[..., caster]
    corner = (1 - u) * first + u * last
    if isinstance(light, DirectionalLight):
        way = along(light.direction, t)
        base = point
    else:
        base = along(light.position, t)
        way = point - base
    seen = (corner - base).detach()
    way = way.detach()
    e = torch.stack([(torch.linalg.cross(seen[i], seen[j], dim=0) * way).sum(0) for i, j in ((1, 2), (2, 0), (0, 1))])
    total = e.sum(0)
    weight = torch.where(total != 0, e / torch.where(total != 0, total, 1.0), 1 / 3)
    uv = (weight.unsqueeze(1) * surfaces.uv[face].permute(1, 2, 0)).sum(0)
    rgba = lookup(surfaces, face, uv, torch.zeros_like(t))
    return alpha.index_put((varying,), alpha[varying] * rgba[:, 3])
