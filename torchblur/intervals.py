"""Find, for every ray of a block of pixels, the slices of time in which each prism covers it.

Before: pairs.py, edges.py.  After: cells.py.
Symbols: P prisms, n pairs of prism and pixel, N intervals; t shutter time; u local time of a prism, 0 at its open end.
Nearness = M / D orders surfaces along the ray, larger in front: 1 / w or 2 - z / w, see `Camera.orders_by_w`; M and D
are cubics in time, kept by their Bernstein coefficients over the interval.
Source: Ronnow et al. 2021, sec. 4 (intervals), 2022, eq. 1-3 (depth); signs over pieces of time instead of paired hits,
clip planes as cubics, tie rule: ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import bernstein, edges, packed
from torchblur.edges import Corners
from torchblur.pairs import Block, find_pairs
from torchblur.prisms import Prisms

FIXED = -1  # kind of an interval's end: end of the prism's slice of time
NEAR, FAR = 3, 4  # 0, 1, 2 are the edges
SHORTEST = 1e-13  # of the window: faces that are lines cover rays for so long, by rounding; a pixel misses as much


@dataclass(frozen=True)
class Intervals:
    """When each prism covers each ray; those of pixel p are offsets[p]:offsets[p + 1], in the prisms' order."""

    offsets: Tensor  # (pixels + 1,) int64
    prism: Tensor  # (N,) int64
    t_start: Tensor  # (N,) float64 shutter time, before t_end by more than SHORTEST
    t_end: Tensor  # (N,) float64
    near_num: Tensor  # (4, N) float64 Bernstein coefficients of M over the interval; no gradient
    near_den: Tensor  # (4, N) float64 of D
    ray_ndc: Tensor  # (2, pixels) float64
    spacing_ndc: tuple[float, float]  # from one ray to the next, along x and y

    @property
    def count(self) -> int:
        """Number of intervals."""
        return len(self.prism)

    def pixel_of(self, interval: Tensor) -> Tensor:
        """Return the pixel of each `interval` (K,)."""
        return packed.owners(self.offsets)[interval]

    def of_pixels(self, pixels: Tensor) -> Intervals:
        """Return the intervals of `pixels` (C,), which become pixels 0 to C - 1."""
        chosen, offsets = packed.select(self.offsets, pixels)
        return Intervals(
            offsets=offsets,
            prism=self.prism[chosen],
            t_start=self.t_start[chosen],
            t_end=self.t_end[chosen],
            near_num=self.near_num[:, chosen],
            near_den=self.near_den[:, chosen],
            ray_ndc=self.ray_ndc[:, pixels],
            spacing_ndc=self.spacing_ndc,
        )


def find_intervals(prisms: Prisms, block: Block, candidates: Tensor) -> tuple[Intervals, int]:
    """Return the intervals of all rays of `block`, and the number of pairs of prism and ray that were looked at.

    Args:
        prisms: of the scene.
        block: pixels and ray.
        candidates: (C,) int64 prisms whose bounds may touch the block.

    Returns:
        N intervals sorted by pixel, then prism, then time.

    Accuracy: times to about 1e-12 in float64 away from tangencies, where an error e in the discriminant changes the
        covered time by 2 sqrt(e) / |c2|. Neighbours that share an edge share its times bit for bit.
    Gradient: to the vertices and the camera through t_start and t_end (implicit function theorem).
    Source: Ronnow et al. 2021, sec. 4.1, repaired: coverage by signs, not by pairing hits.
    """
    with torch.no_grad():
        prism, pixel = find_pairs(prisms, block, candidates)
    return solve_pairs(prisms, block, prism, pixel), len(prism)


def solve_pairs(prisms: Prisms, block: Block, prism: Tensor, pixel: Tensor) -> Intervals:
    """Return the intervals of pairs of a prism (n,) and a pixel (n,) of `block`, which come prism by prism.

    Source: as `find_intervals`.
    """
    with torch.no_grad():
        corners = edges.reduce_corners(prisms.clip, prism, block.ray_ndc(pixel))
        keep = _may_cover(prisms, prism, corners).nonzero().flatten()
        prism, pixel, corners = prism[keep], pixel[keep], corners[keep]
        is_clipped = prisms.is_clipped[prism]
        found = []
        for chosen in ((~is_clipped).nonzero().flatten(), is_clipped.nonzero().flatten()):
            if len(chosen):
                pair, *rest = _covered_pieces(prisms, prism[chosen], corners[chosen])
                found.append((chosen[pair], *rest))
        if not found:
            none = torch.zeros(0, dtype=torch.float64, device=prism.device)
            found = [(prism[:0], none, none, prism[:0], prism[:0])]
        pair, u_start, u_end, kind_start, kind_end = (torch.cat(p) for p in zip(*found, strict=True))
        t_start, t_end = (_to_shutter_time(prisms, prism[pair], u) for u in (u_start, u_end))
        order = torch.sort(pixel[pair], stable=True).indices
        order = order[(t_end - t_start > SHORTEST * (prisms.window[1] - prisms.window[0]))[order]]
        pair, u_start, u_end, kind_start, kind_end, t_start, t_end = (
            a[order] for a in (pair, u_start, u_end, kind_start, kind_end, t_start, t_end)
        )
        near_num, near_den = nearness_coefficients(
            prisms, prism[pair], corners[pair].between(u_start, u_end), torch.stack([u_start, u_end])
        )
    prism, pixel = prism[pair], pixel[pair]
    if prisms.clip.requires_grad:
        ray = block.ray_ndc(pixel)
        t_start = _attach(prisms, prism, ray, (t_start, u_start, kind_start))
        t_end = _attach(prisms, prism, ray, (t_end, u_end, kind_end))
    all_pixels = torch.arange(block.n_pixels, device=prism.device)
    offsets = packed.offsets_from_owners(pixel, block.n_pixels)
    return Intervals(
        offsets=offsets,
        prism=prism,
        t_start=t_start,
        t_end=t_end,
        near_num=near_num,
        near_den=near_den,
        ray_ndc=block.ray_ndc(all_pixels),
        spacing_ndc=block.spacing_ndc,
    )


def join_intervals(prisms: Prisms, parts: list[Intervals]) -> Intervals:
    """Return the intervals of all `parts`, of the same pixels and of different prisms. Source: ours."""
    if len(parts) == 1:
        return parts[0]
    pixel = torch.cat([packed.owners(part.offsets) for part in parts])
    prism = torch.cat([part.prism for part in parts])
    order = torch.sort(pixel * max(prisms.count, 1) + prism, stable=True).indices
    return Intervals(
        offsets=sum(part.offsets for part in parts),
        prism=prism[order],
        t_start=torch.cat([part.t_start for part in parts])[order],
        t_end=torch.cat([part.t_end for part in parts])[order],
        near_num=torch.cat([part.near_num for part in parts], dim=1)[:, order],
        near_den=torch.cat([part.near_den for part in parts], dim=1)[:, order],
        ray_ndc=parts[0].ray_ndc,
        spacing_ndc=parts[0].spacing_ndc,
    )


def nearness_coefficients(prisms: Prisms, prism: Tensor, corners: Corners, u: Tensor) -> tuple[Tensor, Tensor]:
    """Return the Bernstein coefficients (4, m) of M and D over a slice of time; M / D is larger in front.

    By w: M = S, so that nearness is 1 / w. Else M = sum e_i (2 w_i - z_i): nearness 2 - z / w, which is positive
    inside the clip volume, so that relative tolerances mean something.

    Args:
        prisms: of the scene.
        prism: (m,) int64.
        corners: of these prisms over the slice.
        u: (2, m) local times at which the slice begins and ends.

    Source: Ronnow et al. 2022, eq. 1-3; polynomial form ours.
    """
    e = edges.edge_coefficients(corners)
    den = bernstein.product(e, corners.w).sum(1)
    if prisms.orders_by_w:
        s = e.sum(1)
        return torch.stack([s[0], (s[0] + 2 * s[1]) / 3, (2 * s[1] + s[2]) / 3, s[2]]), den
    z = prisms.clip[:, :, 2].index_select(-1, prism)
    z = torch.stack([(1 - end) * z[0] + end * z[1] for end in u])
    return bernstein.product(e, 2 * corners.w - z).sum(1), den


def _may_cover(prisms: Prisms, prism: Tensor, corners: Corners) -> Tensor:
    """Return whether the ray can be inside at all (n,): no edge function has the wrong sign throughout."""
    e = edges.edge_coefficients(corners)
    can_be_positive = ~(e < 0).all(0).any(0)
    can_be_negative = ~(e > 0).all(0).any(0)
    one_sided = prisms.surfaces.is_one_sided[prisms.face_of[prism]]
    parity = prisms.parity[prism]
    return (can_be_positive & ~(one_sided & (parity < 0))) | (can_be_negative & ~(one_sided & (parity > 0)))


def _covered_pieces(prisms: Prisms, prism: Tensor, corners: Corners) -> tuple[Tensor, ...]:
    """Return pair, u_start, u_end, kind_start, kind_end (N,) of the covered slices of m pairs, in pair and time order.

    The roots cut time into pieces; a piece is covered where the ray is inside in it, on the visible side, and between
    the clip planes. Neighbouring pieces that face the same way become one.
    """
    w = corners.w
    is_clipped = bool(prisms.is_clipped[prism[:1]].any())  # all pairs of one call are alike
    roots = edges.edge_roots(corners)
    edge_signs = edges.edge_signs(corners, roots)
    cuts = [roots]
    kinds = [0, 1, 2, 0, 1, 2]
    planes = []
    if is_clipped:
        z = prisms.clip[:, :, 2].index_select(-1, prism)
        planes = [z + w, w - z]
        e = edges.edge_coefficients(corners)
        cuts += [edges.plane_roots(e, plane) for plane in planes]
        kinds += [NEAR] * 3 + [FAR] * 3
    ends = w.new_zeros(1, len(prism))
    u, column = torch.sort(torch.cat([ends, *cuts, ends + 1]).T.contiguous(), dim=1)
    kind = torch.tensor([FIXED, *kinds, FIXED], device=w.device)[column]
    kind = torch.where((u > 0) & (u < 1), kind, FIXED)

    one_sided = prisms.surfaces.is_one_sided[prisms.face_of[prism]]
    hidden_sign = torch.where(one_sided, -prisms.parity[prism], 0).to(torch.int8)
    pieces = []
    for k in range(u.shape[1] - 1):
        start, end = u[:, k], u[:, k + 1]
        side = edges.inside_sign(edge_signs, roots, 0.5 * (start + end)) * (start < end)
        for plane in planes:
            side = side * (edges.plane_mean(corners, plane, start, end) * side >= 0)
        pieces.append(side)
    sign = torch.stack(pieces, dim=1)
    sign = torch.where(sign == hidden_sign.unsqueeze(1), 0, sign)
    nothing = torch.zeros_like(sign[:, :1])
    begins = (sign != 0) & (sign != torch.cat([nothing, sign[:, :-1]], dim=1))
    finishes = (sign != 0) & (sign != torch.cat([sign[:, 1:], nothing], dim=1))
    pair, first = begins.nonzero(as_tuple=True)
    _, last = finishes.nonzero(as_tuple=True)
    return pair, u[pair, first], u[pair, last + 1], kind[pair, first], kind[pair, last + 1]


def _to_shutter_time(prisms: Prisms, prism: Tensor, u: Tensor) -> Tensor:
    """Return shutter times (N,) of local times `u`; exact at both ends, so that abutting prisms share them."""
    return (1 - u) * prisms.t_open[prism] + u * prisms.t_close[prism]


def nearness_at(prisms: Prisms, prism: Tensor, ray_ndc: Tensor, t: Tensor) -> tuple[Tensor, ...]:
    """Return M, D and their slopes in shutter time (m,) for prisms seen by rays at times `t`, with their graph.

    Args:
        prisms: of the scene.
        prism, ray_ndc, t: (m,), (2, m), (m,) shutter time inside the prisms' slices.

    Source: as `nearness_coefficients`.
    """
    span = (prisms.t_close - prisms.t_open)[prism]
    u = (t - prisms.t_open[prism]) / span
    (e, de), (w, dw), (z, dz) = _moving(prisms, prism, ray_ndc, u)
    den, dden = (e * w).sum(0), (de * w + e * dw).sum(0)
    plane, dplane = (torch.ones_like(w), torch.zeros_like(w)) if prisms.orders_by_w else (2 * w - z, 2 * dw - dz)
    num, dnum = (e * plane).sum(0), (de * plane + e * dplane).sum(0)
    return num, den, dnum / span, dden / span


def attach_gradient(t: Tensor, which: Tensor, value: Tensor, slope: Tensor) -> Tensor:
    """Return `t` (N,) whose elements `which` (K,) carry the gradient of the root of a function: one Newton step
    that moves nothing but has the root's derivative.

    Args:
        t: shutter times without graph.
        which: (K,) int64, each once.
        value: (K,) the function that vanishes at t, with its graph.
        slope: (K,) its slope in shutter time, without graph; where it is 0 (a tangency) there is no gradient.

    Source: implicit function theorem.
    """
    usable = slope != 0
    step = torch.where(usable, -value / torch.where(usable, slope, 1.0), 0.0)
    return t.index_add(0, which, step - step.detach())


def _attach(prisms: Prisms, prism: Tensor, ray_ndc: Tensor, found: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Return the shutter times of ends with their gradient; `found` holds shutter time, local time, kind (N,)."""
    t, u, kind = found
    moving = (kind != FIXED).nonzero().flatten()
    if len(moving) == 0:
        return t
    prism, u, kind = prism[moving], u[moving], kind[moving]
    (e, de), (w, dw), (z, dz) = _moving(prisms, prism, ray_ndc[:, moving], u)
    rows, slopes = [*e], [*de]
    for plane, dplane in ((z + w, dz + dw), (w - z, dw - dz)):
        rows.append((e * plane).sum(0))
        slopes.append((de * plane + e * dplane).sum(0))
    value = torch.stack(rows).gather(0, kind.unsqueeze(0)).squeeze(0)
    slope = torch.stack(slopes).detach().gather(0, kind.unsqueeze(0)).squeeze(0)
    return attach_gradient(t, moving, value, slope / (prisms.t_close - prisms.t_open)[prism])


def _moving(prisms: Prisms, prism: Tensor, ray_ndc: Tensor, u: Tensor) -> tuple[tuple[Tensor, Tensor], ...]:
    """Return e, w, z (3, m) at local times `u`, each with its slope in local time."""
    corners = edges.reduce_corners(prisms.clip, prism, ray_ndc)
    x, y, w = corners.at(u)
    dx, dy, dw = (c[1] - c[0] for c in (corners.x, corners.y, corners.w))
    z = prisms.clip[:, :, 2].index_select(-1, prism)
    e, de = edges.edges_of(x, y), edges.polar_edges(x, y, dx, dy)
    return (e, de), (w, dw), ((1 - u) * z[0] + u * z[1], z[1] - z[0])
