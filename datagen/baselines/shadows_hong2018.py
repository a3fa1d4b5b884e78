"""The depth-time ranges shadow map of Hong & Oh, as published.

Before: shadow_samples.py, shadow_maps.py.  After: scripts.
Symbols: M prisms, a face of corners P Q R that moves to P' Q' R'; PDP(a, b) = a_x b_y - a_y b_x; T triangles.
Light pass: each moving edge becomes four triangles about the mean of its four ends (time 0.5), or two where the edges
before and after cross on screen; with the two faces themselves they are rasterised into {depth, time, id} lists.
Two fragments of a face in a texel make a range {t, t', d, d'}; of four, sorted by depth, the first and the last two.
Camera pass: samples at random times; one is in shadow if a range of its texel, of another face, holds its time at a
depth that is nearer to the light.

What is wrong or weak in the paper, and what becomes of it here:
1. Equation (1) has the wrong sign with vectors as the paper names them: for A + s AB = C + u CD it is
   s = PDP(AC, CD) / PDP(AB, CD), u = PDP(AC, AB) / PDP(AB, CD). Repaired: as printed no true crossing is found.
2. Of four fragments, sorting by depth pairs the wrong ones. Kept. One, three and more than four fragments (edges
   between patches, several visits) have no rule: they are left out, and counted.
3. Time is linear in the patches: right where an edge is only displaced, off by up to 0.5 where it turns about one end;
   where the edges cross, part of the swept area is missed. Kept; the time at a crossing is not defined, 0.5 here.
   An end that rests exactly is a crossing by the paper's test, and then the error is smaller.
4. Prisms are dropped where the three corners of the last frame are out of view, or the face turns its back to the light
   in both frames, though in between, or as a whole, they may cast. Kept; a point light's six views hold everything.
5. Leaving out the own face does not protect from its neighbours: a bias is still needed. It is an argument, 0 in the
   paper.
6. t_s names the start of a range and the time of a sample. No consequence.
Beyond the paper: several linear pieces of a motion are as many prisms, point lights have six views.
Source: Hong & Oh 2018.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

import torchblur as tb
from datagen.baselines.shadow_maps import LightViews, rasterise, view_from_light
from datagen.baselines.shadow_samples import (
    Hits,
    MovingFaces,
    ShadowedImage,
    average_samples,
    gather_faces,
    stratified_times,
)
from torchblur import check, packed

FRAGMENT_BYTES, RANGE_BYTES, INDEX_BYTES = 16, 24, 8  # equation (2)
EDGES = ((0, 1), (1, 2), (2, 0))
CENTRE_TIME = 0.5


@dataclass(frozen=True, eq=False)
class Patches:
    """Triangles of the surfaces of prisms in light space."""

    corners: Tensor  # (T, 3, 4) x y w depth
    time: Tensor  # (T, 3) of the corners, 0 at the prism's first face and 1 at its last
    prism: Tensor  # (T,) int64


@dataclass(frozen=True, eq=False)
class RangeMap:
    """When and at what depth faces cover the texels."""

    views: LightViews
    offsets: Tensor  # (texels + 1,)
    time: Tensor  # (ranges, 2) shutter time of start and end
    depth: Tensor  # (ranges, 2)
    face: Tensor  # (ranges,) int64
    n_fragments: int
    n_unpaired: int  # fragments for which the paper has no rule

    @property
    def n_bytes(self) -> int:
        """Memory by the paper's equation (2)."""
        n_ranges = len(self.face)
        return FRAGMENT_BYTES * self.n_fragments + RANGE_BYTES * n_ranges + INDEX_BYTES * self.views.n_texels


@torch.no_grad()
def render_hong2018(
    scene: tb.Scene, *, n_samples: int, size_px: int, bias: float = 0.0, generator: torch.Generator
) -> ShadowedImage:
    """Return the scene with `n_samples` samples a pixel, one at a random time in each of as many parts of the exposure.

    Args:
        scene: opaque meshes and one light that rests, whose shadows these are.
        n_samples: of a pixel.
        size_px: texels along each side of the map (of each of the six of a point light).
        bias: by how much a range must be nearer to the light than a point to shade it [scene units].
        generator: gives the times.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Source: Hong & Oh 2018.
    """
    faces = gather_faces(scene)
    check.positive_int("n_samples", n_samples)
    check.number("bias", bias, 0.0)
    found = build_range_map(view_from_light(scene, faces, size_px), faces, isinstance(scene.lights[0], tb.PointLight))

    def visible(hits: Hits) -> Tensor:
        return (~_is_blocked(found, hits, bias)).to(torch.float64)

    image, visibility = average_samples(scene, faces, stratified_times(scene, n_samples, generator), visible)
    counts = {"fragments": found.n_fragments, "ranges": len(found.face), "unpaired": found.n_unpaired}
    counts |= {"deepest": int(found.offsets.diff().max()), "texels": found.views.n_texels}
    return ShadowedImage(image, visibility, found.n_bytes, counts)


@torch.no_grad()
def build_range_map(views: LightViews, faces: MovingFaces, sees_all: bool = False) -> RangeMap:
    """Return the ranges of all texels; `sees_all` where the views together look everywhere."""
    n_moving = faces.world.shape[1]
    prisms = views.project(faces.world).transpose(0, 1).flatten(1, 2)  # (2, V * S, 3, 4)
    view, moving = (k.flatten() for k in _grid(len(views.matrix), n_moving, prisms.device))
    kept = (~_is_dropped(prisms, sees_all)).nonzero().flatten()
    patches = build_patches(prisms[:, kept])
    view, moving = view[kept], moving[kept]
    fragments = rasterise(views, patches.corners, view[patches.prism])
    local = (fragments.bary * patches.time[fragments.triangle]).sum(1)
    prism = patches.prism[fragments.triangle]
    owner = fragments.texel * len(kept) + prism
    first, second = pair_fragments(owner, fragments.depth)
    order = torch.sort(fragments.texel[first], stable=True).indices
    first, second = first[order], second[order]
    slice_of = moving[prism[first]]
    span = (faces.t_close - faces.t_open)[slice_of]
    time = torch.stack([faces.t_open[slice_of] + span * local[k] for k in (first, second)], dim=1)
    depth = torch.stack([fragments.depth[first], fragments.depth[second]], dim=1)
    swapped = time[:, 0] > time[:, 1]
    time, depth = (torch.where(swapped.unsqueeze(1), v.flip(1), v) for v in (time, depth))
    return RangeMap(
        views=views,
        offsets=packed.offsets_from_owners(fragments.texel[first], views.n_texels),
        time=time,
        depth=depth,
        face=faces.face[slice_of],
        n_fragments=len(owner),
        n_unpaired=len(owner) - 2 * len(first),
    )


def build_patches(prisms: Tensor) -> Patches:
    """Return the surface triangles of prisms (2 ends, M, 3 corners, 4) in light space, 14 at most of each."""
    start, end = prisms
    own = torch.arange(start.shape[0], device=prisms.device)
    zero, one = torch.zeros_like(start[:, 0, 0]), torch.ones_like(start[:, 0, 0])
    centre_time = CENTRE_TIME * one
    parts = [(start, torch.stack([zero] * 3, 1), own), (end, torch.stack([one] * 3, 1), own)]
    for i, j in EDGES:
        p, q, p_end, q_end = start[:, i], start[:, j], end[:, i], end[:, j]
        crossing, does_cross = _find_crossing(p, q, p_end, q_end)
        whole, crossed = (~does_cross).nonzero().flatten(), does_cross.nonzero().flatten()
        centre = (p + q + p_end + q_end) / 4
        times = {"p": zero, "q": zero, "p_end": one, "q_end": one}
        points = {"p": p, "q": q, "p_end": p_end, "q_end": q_end}
        for a, b in (("p", "q"), ("q", "q_end"), ("q_end", "p_end"), ("p_end", "p")):
            corners = torch.stack([points[a], points[b], centre], 1)
            time = torch.stack([times[a], times[b], centre_time], 1)
            parts.append((corners[whole], time[whole], own[whole]))
        for a, b in (("p", "p_end"), ("q", "q_end")):
            corners = torch.stack([points[a], points[b], crossing], 1)
            time = torch.stack([times[a], times[b], centre_time], 1)
            parts.append((corners[crossed], time[crossed], own[crossed]))
    return Patches(*(torch.cat(p) for p in zip(*parts, strict=True)))


def pair_fragments(owner: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Return the fragments (R,) and (R,) that make ranges: both of an owner, or of four, sorted by depth, two and two.

    Args:
        owner: (N,) int64 the same for the fragments of one face in one texel.
        depth: (N,).
    """
    order = torch.sort(depth, stable=True).indices
    order = order[torch.sort(owner[order], stable=True).indices]
    _, count = torch.unique_consecutive(owner[order], return_counts=True)
    first = packed.offsets_from_counts(count)[:-1]
    pairs = torch.cat([first[count == 2], first[count == 4], first[count == 4] + 2])
    return order[pairs], order[pairs + 1]


def cross_edges(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Return s and u (M,) at which A + s AB = C + u CD for points (M, 2); inf or NaN for parallel edges."""
    ab, cd, ac = b - a, d - c, c - a
    area = _pdp(ab, cd)
    return _pdp(ac, cd) / area, _pdp(ac, ab) / area


def _pdp(a: Tensor, b: Tensor) -> Tensor:
    """Return the perp dot products of vectors (M, 2)."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _find_crossing(p: Tensor, q: Tensor, p_end: Tensor, q_end: Tensor) -> tuple[Tensor, Tensor]:
    """Return the point (M, 4) where edges cross on screen, halfway between both in depth, and whether (M,) they do."""
    all_w = torch.stack([v[:, 2] for v in (p, q, p_end, q_end)])
    w = torch.where(all_w > 0, all_w, 1.0).unsqueeze(2)
    # on screen, 1 / w and depth / w are linear along an edge
    screen = [
        torch.cat([v[:, :2], torch.ones_like(v[:, :1]), v[:, 3:]], 1) / k
        for v, k in zip((p, q, p_end, q_end), w, strict=True)
    ]
    s, u = cross_edges(*(v[:, :2] for v in screen))
    does_cross = (all_w > 0).all(0) & (s >= 0) & (s <= 1) & (u >= 0) & (u <= 1)
    ways = (torch.where(does_cross, k, 0.5).unsqueeze(1) for k in (s, u))
    before, after = (
        (1 - k) * one + k * two
        for k, one, two in zip(ways, (screen[0], screen[2]), (screen[1], screen[3]), strict=True)
    )
    before, after = before / before[:, 2:3], after / after[:, 2:3]
    return (before + after) / 2, does_cross


def _is_dropped(prisms: Tensor, sees_all: bool) -> Tensor:
    """Return (M,) the paper's early exits: the last face's corners all out of view, or both faces back to the light."""
    ndc = prisms[..., :2] / prisms[..., 2:3].clamp(min=1e-9)
    is_out = ((prisms[1, ..., 2] <= 0) | (ndc[1].abs() > 1).any(-1)).all(1)
    xyw = prisms[..., :3]
    turn = (xyw[:, :, 0] * torch.linalg.cross(xyw[:, :, 1], xyw[:, :, 2])).sum(-1)
    is_back = (turn < 0).all(0)
    return is_back | (is_out & (not sees_all))


def _is_blocked(found: RangeMap, hits: Hits, bias: float) -> Tensor:
    """Return (J,) whether a range of another face comes before the hits at their times."""
    texel, depth = found.views.find_texels(hits.world)
    own = (texel >= 0).nonzero().flatten()
    count = found.offsets.diff()[texel[own]]
    index, owner = packed.expand(found.offsets[texel[own]], count)
    hit = own[owner]
    t, (start, end) = hits.t[hit], found.time[index].unbind(1)
    share = (t - start) / torch.where(end > start, end - start, 1.0)
    at = found.depth[index, 0] * (1 - share) + found.depth[index, 1] * share
    blocks = (t >= start) & (t <= end) & (found.face[index] != hits.face[hit]) & (at < depth[hit] - bias)
    is_blocked = torch.zeros_like(texel, dtype=torch.bool)
    is_blocked[hit[blocks]] = True
    return is_blocked


def _grid(n: int, m: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return (n, m) the indices along both axes."""
    row, column = torch.arange(n, device=device), torch.arange(m, device=device)
    return row.unsqueeze(1).expand(n, m), column.unsqueeze(0).expand(n, m)
