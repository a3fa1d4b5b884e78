"""Samples in time: looks at a scene at times and places that every pixel has for itself.

Before: prisms.py, edges.py, shading.py, shadows.py.  After: sampling.py.
Symbols: N samples a pixel, P pixels of some rows of the image; m pairs of a prism and a ray. The samples of a pixel are
in the order of their times; those of one rank in all pixels, which lie in a short slice of the exposure, are done
together, so that a triangle meets only the pixels that it sweeps over in that slice.
Source: Akenine-Moller et al. 2007 and McGuire et al. 2010 (time-continuous triangles: the edge test with corners at the
ray's own time); ranks: ours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import edges, packed
from torchblur.camera import Ray
from torchblur.prisms import Prisms, build_prisms
from torchblur.scene import Scene
from torchblur.shading import Points, look, needing_points, weight_slopes
from torchblur.shadows import with_shadows
from torchblur.shutter import Shutter
from torchblur.sort import argsort_by, is_tied, reorder_ties
from torchblur.surfaces import Surfaces

MAX_PAIRS = 500_000  # pairs of prism and ray looked at together: a few hundred MB of working memory
MAX_SAMPLES = 4_000_000  # of some rows of pixels, whose times and places are drawn together
HALTON_BITS = 24  # of the number of samples


@dataclass(frozen=True)
class Samples:
    """When and where P pixels are looked at."""

    share: Tensor  # (N, P) float64 of the shutter's weight that has passed, in [0, 1), rising along N
    x_px: Tensor  # (N, P) or (1, 1) float64 place inside the pixel, in [0, 1)
    y_px: Tensor  # as `x_px`
    spacing_px: float  # side of the square that a ray stands for


@dataclass(frozen=True)
class SampleRays:
    """One ray for each of P pixels."""

    t: Tensor  # (P,) float64 shutter time
    x_px: Tensor  # (P,) float64 on screen
    y_px: Tensor  # (P,)
    first_row: int
    spacing_px: float


def stratified(count: int, is_spread: bool, generator: torch.Generator) -> Callable[[int], Samples]:
    """Return what draws, for a number of pixels, one time in each of `count` parts of the exposure.

    Args:
        count: N.
        is_spread: one place in each of N rectangles of the pixel, at the times in random order; else the centre.
        generator: on the CPU.

    Source: jittered sampling; the rectangles are as square as N's factors allow.
    """
    n_y = next(k for k in range(int(count**0.5), 0, -1) if count % k == 0)
    n_x = count // n_y

    def draw(n_pixels: int) -> Samples:
        def random() -> Tensor:
            return torch.rand(count, n_pixels, dtype=torch.float64, generator=generator)

        share = (torch.arange(count, dtype=torch.float64).unsqueeze(1) + random()) / count
        if not is_spread:
            centre = torch.full((1, 1), 0.5, dtype=torch.float64)
            return Samples(share, centre, centre, 1.0)
        cell = torch.sort(random(), dim=0, stable=True).indices
        return Samples(share, (cell % n_x + random()) / n_x, (cell // n_x + random()) / n_y, count**-0.5)

    return draw


def rotated_halton(count: int, ray: Ray, generator: torch.Generator) -> Callable[[int], Samples]:
    """Return what draws, for a number of pixels, the first `count` numbers of Halton's sequence in base 2, moved round
    the exposure by a random amount for each pixel.

    Args:
        count: N, below 2**HALTON_BITS.
        ray: place of the ray inside each pixel.
        generator: on the CPU.

    Source: Halton 1960; Cranley & Patterson 1976.
    """
    number, value = torch.arange(count), torch.zeros(count, dtype=torch.float64)
    for bit in range(HALTON_BITS):
        value = value + (number >> bit & 1) * 0.5 ** (bit + 1)
    x, y = (torch.full((1, 1), place, dtype=torch.float64) for place in (ray.x_px, ray.y_px))

    def draw(n_pixels: int) -> Samples:
        turn = torch.rand(1, n_pixels, dtype=torch.float64, generator=generator)
        share = torch.sort((value.unsqueeze(1) + turn) % 1.0, dim=0, stable=True).values
        return Samples(share, x, y, ray.spacing_px)

    return draw


def sum_of_samples(
    scene: Scene, surfaces: Surfaces, shutter: Shutter, count: int, draw: Callable[[int], Samples]
) -> Tensor:
    """Return (H, W, 4) float64, the mean of the meshes' premultiplied colour and opacity in `count` samples a pixel.

    Args:
        scene: what to look at.
        surfaces: of its faces.
        shutter: whose weight is the density of the samples' times.
        count: N.
        draw: returns the samples of so many pixels.

    Source: ours.
    """
    parts = []
    for ranks in blocks_of_rows(scene, shutter, count, draw):
        parts.append(sum(weight.unsqueeze(1) * _see(scene, surfaces, rays) for rays, weight in ranks))
    return torch.cat(parts).reshape(scene.camera.height, scene.camera.width, 4)


def blocks_of_rows(
    scene: Scene, shutter: Shutter, count: int, draw: Callable[[int], Samples]
) -> Iterator[Iterator[tuple[SampleRays, Tensor]]]:
    """Yield, for each block of rows, its samples rank by rank: one ray for each pixel, and its weight (P,).

    Args:
        scene, shutter, count, draw: as in `sum_of_samples`.

    Source: ours.
    """
    camera = scene.camera
    size = camera.width, camera.height
    shutter.span(shutter.n_lines(*size))  # raises if the last line closes after the exposure
    rows = max(1, MAX_SAMPLES // (count * camera.width))
    for first_row in range(0, camera.height, rows):
        pixel = torch.arange(first_row * camera.width, min(first_row + rows, camera.height) * camera.width)
        column, row = (c.to(scene.device) for c in (pixel % camera.width, pixel // camera.width))
        yield _ranks(shutter, count, draw(len(pixel)), (column, row, size))


def _ranks(
    shutter: Shutter, count: int, samples: Samples, pixels: tuple[Tensor, Tensor, tuple[int, int]]
) -> Iterator[tuple[SampleRays, Tensor]]:
    """Yield the rays and weights of pixels, columns and rows (P,) of an image of a size, rank by rank."""
    column, row, size = pixels
    line = shutter.line_of(column, row, size)
    for n in range(count):
        parts = samples.share, samples.x_px, samples.y_px
        share, x, y = (s[min(n, len(s) - 1)].to(column.device) for s in parts)
        t = (shutter.time_of(share) + shutter.line_delay * line).clamp(max=1.0)
        weight = torch.full_like(t, 1 / count)
        yield SampleRays(t, column + x, row + y, int(row[0]), samples.spacing_px), weight


def _see(scene: Scene, surfaces: Surfaces, rays: SampleRays) -> Tensor:
    """Return (P, 4) the meshes' premultiplied colour and opacity along the rays."""
    prisms = build_prisms(scene, surfaces, (float(rays.t.min()), float(rays.t.max())))
    hits = [_hit(prisms, rays, scene, *pairs) for pairs in _pairs(prisms, rays, scene.camera.width)]
    if not hits:
        return torch.zeros(len(rays.t), 4, dtype=torch.float64, device=rays.t.device)
    prism, pixel, nearness, weight, side, slope, u = (torch.cat(part, dim=-1) for part in zip(*hits, strict=True))
    face = prisms.face_of[prism]
    order = argsort_by(pixel, -nearness.detach())
    tied = is_tied(pixel[order], nearness.detach()[order])
    order = reorder_ties(order, tied, surfaces.tie_rank[face])
    prism, pixel, face, weight, side, slope, u = (
        part[..., order] for part in (prism, pixel, face, weight, side, slope, u)
    )
    which = needing_points(surfaces, face)
    own = prism[which]
    mips = which if slope.shape[1] else which[:0]
    points = Points(
        face=face[which],
        weight=weight[:, which],
        slope=slope[..., mips],
        uv=prisms.corner_uv(own),
        world=_between(prisms.world, own, u[which]),
        normal=_between(prisms.normal, own, u[which]),
        turn=prisms.parity[own],
        side=side[which],
        t=rays.t[pixel[which]],
    )
    seen = look(surfaces, face, which, with_shadows(surfaces, points))
    offsets = packed.offsets_from_owners(pixel, len(rays.t))
    before, after = packed.transmittance(seen.alpha, offsets)
    light = packed.sum_by_owner((before * seen.alpha).unsqueeze(1) * seen.rgb, offsets)
    return torch.cat([light, (1 - after).unsqueeze(1)], dim=1)


def _between(ends: Tensor, prism: Tensor, u: Tensor) -> Tensor:
    """Return (3, 3, J) the values at corners of `prism` (J,) at times `u` inside them; (3, 3, 0) of no values."""
    if ends.shape[-1] == 0:
        return ends[0]
    return (1 - u) * ends[0][..., prism] + u * ends[1][..., prism]


def _pairs(prisms: Prisms, rays: SampleRays, width: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield prisms and pixels (m,) of the rays inside the prisms' bounds, up to MAX_PAIRS or one prism at a time."""
    n_rows = len(rays.t) // width
    low, high = prisms.bounds_px[:2], prisms.bounds_px[2:]
    x, y = rays.x_px % 1, rays.y_px % 1
    first_x = torch.ceil(low[0] - x.max()).clamp(0, width).long()
    last_x = torch.floor(high[0] - x.min()).clamp(-1, width - 1).long()
    first_y = torch.ceil(low[1] - y.max() - rays.first_row).clamp(0, n_rows).long()
    last_y = torch.floor(high[1] - y.min() - rays.first_row).clamp(-1, n_rows - 1).long()
    n_columns = (last_x - first_x + 1).clamp(min=0)
    count = n_columns * (last_y - first_y + 1).clamp(min=0)
    total = count.cumsum(0)
    first = 0
    while first < len(count):
        before = int(total[first - 1]) if first else 0
        last = max(int(torch.searchsorted(total, before + MAX_PAIRS, right=True)), first + 1)
        own = count[first:last]
        local, prism = packed.expand(torch.zeros_like(own), own)
        prism = prism + first
        if len(prism):
            column = first_x[prism] + local % n_columns[prism]
            yield prism, (first_y[prism] + local // n_columns[prism]) * width + column
        first = last


def _hit(prisms: Prisms, rays: SampleRays, scene: Scene, prism: Tensor, pixel: Tensor) -> tuple[Tensor, ...]:
    """Return what of the pairs (m,) is a hit: prism, pixel, nearness, barycentrics (3, n), side, their slopes
    (2, 3, n), or (2, 0, n) without mips, and the time inside the prism.
    """
    camera = scene.camera
    start, end, t = prisms.t_open[prism], prisms.t_close[prism], rays.t[pixel]
    is_last = end == prisms.window[1]  # a slice owns its start, the last one its end too
    kept = ((t >= start) & ((t < end) | is_last)).nonzero().flatten()
    prism, pixel, start, end, t = (part[kept] for part in (prism, pixel, start, end, t))
    u = torch.where(end > start, (t - start) / torch.where(end > start, end - start, 1.0), 0.0)
    ray_ndc = torch.stack([2 * rays.x_px[pixel] / camera.width - 1, 1 - 2 * rays.y_px[pixel] / camera.height])
    x, y, w = edges.reduce_corners(prisms.clip, prism, ray_ndc).at(u)
    sign = edges.still_sign(edges.Corners(*(c.detach().unsqueeze(0) for c in (x, y, w))))
    side = sign * prisms.parity[prism]
    front_only = prisms.surfaces.is_one_sided[prisms.face_of[prism]]
    kept = ((sign != 0) & ~(front_only & (side < 0))).nonzero().flatten()
    prism, pixel, side, u = (part[kept] for part in (prism, pixel, side, u))
    x, y, w = (c[:, kept] for c in (x, y, w))
    e = edges.edges_of(x, y)
    weight = e / e.sum(0)
    z = (1 - u) * prisms.clip[0, :, 2, prism] + u * prisms.clip[1, :, 2, prism]
    z_hit, w_hit = (weight * z).sum(0), (weight * w).sum(0)
    kept = ((z_hit + w_hit >= 0) & (w_hit - z_hit >= 0) & torch.isfinite(weight).all(0)).nonzero().flatten()
    nearness = 1 / w_hit if prisms.orders_by_w else 2 - z_hit / w_hit
    slope = e.new_zeros(2, 0, e.shape[1])
    if prisms.surfaces.has_mipmaps:
        step = 2 * rays.spacing_px / camera.width, -2 * rays.spacing_px / camera.height
        slope = weight_slopes(e, (edges.edges_of(y, w), edges.edges_of(w, x)), step)
    return tuple(part[..., kept] for part in (prism, pixel, nearness, weight, side, slope, u))
