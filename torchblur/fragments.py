"""Fragments: which faces each ray sees at given instants, by ordinary rasterisation.

Before: scene.py, surfaces.py.  After: instant.py.
Symbols: B instants at once, T triangles (F faces at B instants), n fragments; e_i edge function opposite corner i,
bary_i = e_i / sum e. Owner of a fragment: instant * H * W + pixel. Shares nothing with the interval code but the
camera, the motion of vertices, the appearance of faces, and the rules that make an image unambiguous (edges on a ray,
coplanar faces).
Source: Olano & Greer 1997 (homogeneous rasterisation).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import packed
from torchblur.camera import Ray
from torchblur.scene import Scene
from torchblur.shading import weight_slopes
from torchblur.sort import argsort_by, is_tied, reorder_ties
from torchblur.surfaces import Surfaces

MAX_PAIRS = 500_000  # pairs of triangle and pixel looked at together: a few hundred MB of working memory
MIN_W = 1e-300  # against division by zero where a corner is discarded anyway


@dataclass(frozen=True)
class Fragments:
    """Surfaces seen by rays, by owner, nearest first."""

    offsets: Tensor  # (owners + 1,)
    face: Tensor  # (n,) int64 face of the scene
    bary: Tensor  # (3, n) float64
    depth_view: Tensor  # (n,) float64
    side: Tensor  # (n,) float64 +1 where the face turns counter-clockwise on screen, else -1
    slope: Tensor  # (2, 3, n) float64 change of `bary` from one ray to the next along x and y; (2, 3, 0) without mips
    t: Tensor  # (n,) float64 shutter time


def find_fragments(scene: Scene, surfaces: Surfaces, t: Tensor, ray: Ray) -> Iterator[Fragments]:
    """Yield what the rays of all pixels see at the instants `t` (B,), some instants or a rectangle of pixels at a time.

    Args:
        scene: what to look at.
        surfaces: of its faces; those of opacity 0 are left out unless opacity asks for gradients.
        t: shutter times.
        ray: place of the ray inside each pixel.

    Source: Olano & Greer 1997.
    """
    camera = scene.camera
    parts = [scene.clip_at(m, t)[:, m.faces] for m in scene.meshes]
    if not parts:
        return
    clip = torch.cat(parts, dim=1)  # (B, F, 3, 4)
    box = _boxes(clip.detach().flatten(0, 1), camera.width, camera.height, ray).reshape(4, *clip.shape[:2])
    if not surfaces.opacity.requires_grad:
        box[2] = torch.where(surfaces.opacity > 0, box[2], -1)
    for instants, rectangle in _portions(box, (0, len(t)), (0, 0, camera.width - 1, camera.height - 1)):
        clipped = _clip_boxes(box[:, slice(*instants)], rectangle).flatten(1)
        triangles = clip[slice(*instants)].flatten(0, 1)
        yield _rasterise(scene, surfaces, (triangles, clipped), (t, instants[0], ray))


def _portions(
    box: Tensor, instants: tuple[int, int], rectangle: tuple[int, int, int, int]
) -> Iterator[tuple[tuple[int, int], tuple[int, int, int, int]]]:
    """Yield runs of instants and rectangles x0 y0 x1 y1 (inclusive) that hold at most MAX_PAIRS pairs, or one pixel."""
    x0, y0, x1, y1 = rectangle
    clipped = _clip_boxes(box[:, slice(*instants)], rectangle)
    total = int(((clipped[2] - clipped[0] + 1) * (clipped[3] - clipped[1] + 1)).sum())
    if total == 0:
        return
    if total <= MAX_PAIRS or (instants[1] - instants[0] == 1 and (x0, y0) == (x1, y1)):
        yield instants, rectangle
        return
    if instants[1] - instants[0] > 1:
        half = (instants[0] + instants[1]) // 2
        parts = [((instants[0], half), rectangle), ((half, instants[1]), rectangle)]
    elif x1 - x0 >= y1 - y0:
        half = (x0 + x1) // 2
        parts = [(instants, (x0, y0, half, y1)), (instants, (half + 1, y0, x1, y1))]
    else:
        half = (y0 + y1) // 2
        parts = [(instants, (x0, y0, x1, half)), (instants, (x0, half + 1, x1, y1))]
    for part in parts:
        yield from _portions(box, *part)


def _clip_boxes(box: Tensor, rectangle: tuple[int, int, int, int]) -> Tensor:
    """Return boxes x0 y0 x1 y1 (4, ...) inside `rectangle`; an empty one ends just before it starts."""
    low = torch.stack([box[0].clamp(min=rectangle[0]), box[1].clamp(min=rectangle[1])])
    high = torch.stack([box[2].clamp(max=rectangle[2]), box[3].clamp(max=rectangle[3])])
    return torch.cat([low, torch.maximum(high, low - 1)])


def _boxes(clip: Tensor, width: int, height: int, ray: Ray) -> Tensor:
    """Return x0 y0 x1 y1 (4, T) int64, inclusive, of the pixels that a triangle (T, 3, 4) may cover."""
    near = clip[..., 2] + clip[..., 3]
    points, valid = [clip], [near >= 0]
    following = clip.roll(-1, dims=1)
    near_following = near.roll(-1, dims=1)
    apart = (near >= 0) != (near_following >= 0)
    share = near / torch.where(apart, near - near_following, 1.0)
    points.append(clip + share.unsqueeze(-1) * (following - clip))
    valid.append(apart)
    point, ok = torch.cat(points, dim=1), torch.cat(valid, dim=1)
    w = torch.where(ok, point[..., 3], 1.0)
    everywhere = (w <= 0).any(1)
    w = w.clamp(min=MIN_W)
    first, last = [], []
    for axis, size, sign in ((0, width, 1), (1, height, -1)):
        place = (sign * point[..., axis] / w + 1) * (size / 2) - ray[axis]
        low = torch.where(ok, place, torch.inf).amin(1)
        high = torch.where(ok, place, -torch.inf).amax(1)
        low = torch.where(everywhere, -torch.inf, low - 1e-6).clamp(0, size).ceil()
        high = torch.where(everywhere, torch.inf, high + 1e-6).clamp(-1, size - 1).floor()
        first.append(low.long())
        last.append(high.long())
    return torch.stack([*first, *last])


def _rasterise(
    scene: Scene,
    surfaces: Surfaces,
    triangles: tuple[Tensor, Tensor],
    instants: tuple[Tensor, int, Ray],
) -> Fragments:
    """Return the fragments of triangles (T, 3, 4) in their boxes (4, T), from instant `instants[1]` on."""
    clip, box = triangles
    t, first_instant, ray = instants
    n_columns = box[2] - box[0] + 1
    count = n_columns * (box[3] - box[1] + 1)
    local, which = packed.expand(torch.zeros_like(count), count)
    column = box[0][which] + local % n_columns[which]
    row = box[1][which] + local // n_columns[which]
    number = torch.arange(len(clip), device=clip.device) + first_instant * len(surfaces.opacity)
    return fragments_of(scene, surfaces, (clip, number), (which, row, column), (t, ray))


def fragments_of(
    scene: Scene,
    surfaces: Surfaces,
    triangles: tuple[Tensor, Tensor],
    pairs: tuple[Tensor, Tensor, Tensor],
    instants: tuple[Tensor, Ray],
) -> Fragments:
    """Return the fragments among pairs of a triangle and a ray.

    Args:
        scene: what to look at.
        surfaces: of its faces.
        triangles: clip space (T, 3, 4), and instant * F + face of each (T,).
        pairs: which of these (n,), and row and column of the pixel.
        instants: shutter times (B,), and the place of the ray inside each pixel.

    Source: Olano & Greer 1997.
    """
    clip, number = triangles
    which, row, column = pairs
    t, ray = instants
    camera = scene.camera
    n_faces, n_pixels = len(surfaces.opacity), camera.width * camera.height
    x_ndc = 2 * (column.to(torch.float64) + ray.x_px) / camera.width - 1
    y_ndc = 1 - 2 * (row.to(torch.float64) + ray.y_px) / camera.height
    sign = _inside(clip.detach(), which, (x_ndc, y_ndc))
    front_only = surfaces.is_one_sided[number[which] % n_faces]
    kept = ((sign != 0) & ~(front_only & (sign < 0))).nonzero().flatten()
    which, row, column, x_ndc, y_ndc, sign = (a[kept] for a in (which, row, column, x_ndc, y_ndc, sign))
    corner = clip[which]  # (n, 3, 4)
    z, w = corner[..., 2].T, corner[..., 3].T
    x, y = corner[..., 0].T - x_ndc * w, corner[..., 1].T - y_ndc * w
    e = _edge_values(x, y)
    bary = e / e.sum(0)
    z_hit, w_hit = (bary * z).sum(0), (bary * w).sum(0)
    kept = ((z_hit + w_hit >= 0) & (w_hit - z_hit >= 0) & torch.isfinite(bary).all(0)).nonzero().flatten()
    z_hit, w_hit, which = z_hit[kept], w_hit[kept], which[kept]
    instant, face = number[which] // n_faces, number[which] % n_faces
    owner = instant * n_pixels + row[kept] * camera.width + column[kept]
    nearness = 1 / w_hit if camera.orders_by_w else 2 - z_hit / w_hit
    order = argsort_by(owner, -nearness.detach())
    tied = is_tied(owner[order], nearness.detach()[order])
    order = reorder_ties(order, tied, surfaces.tie_rank[face])
    depth = w_hit
    if not camera.is_perspective:
        scale = camera.world_to_clip_at(t)[instant][:, 2, :3].norm(dim=1)
        depth = camera.depth_at_near + (z_hit / w_hit + 1) / scale
    slope = bary.new_zeros(2, 3, 0)
    if surfaces.has_mipmaps:
        step = 2 * ray.spacing_px / camera.width, -2 * ray.spacing_px / camera.height
        slopes = _edge_values(y, w), _edge_values(w, x)
        slope = weight_slopes(e, slopes, step)[..., kept][..., order]
    return Fragments(
        offsets=packed.offsets_from_owners(owner[order], len(t) * n_pixels),
        face=face[order],
        bary=bary[:, kept][:, order],
        depth_view=depth[order],
        side=sign[kept][order].to(torch.float64),
        slope=slope,
        t=t[instant[order]],
    )


def _edge_values(x: Tensor, y: Tensor) -> Tensor:
    """Return e (3, n) of reduced corners x, y (3, n), e_i opposite corner i."""
    return x.roll(-1, 0) * y.roll(-2, 0) - y.roll(-1, 0) * x.roll(-2, 0)


def _inside(clip: Tensor, triangle: Tensor, ray_ndc: tuple[Tensor, Tensor]) -> Tensor:
    """Return +1 where the ray is inside and the face turns counter-clockwise, -1 where clockwise, 0 outside (n,)."""
    w = clip[:, :, 3].T[:, triangle]
    x = clip[:, :, 0].T[:, triangle] - ray_ndc[0] * w
    y = clip[:, :, 1].T[:, triangle] - ray_ndc[1] * w
    e = _edge_values(x, y)
    if (e == 0).any():  # an edge on the ray counts as if the ray were moved by (eps, eps^2)
        along_x, along_y = _edge_values(y, w), _edge_values(w, x)
        e = torch.where(e != 0, e, torch.where(along_x != 0, along_x, along_y))
    return (e > 0).all(0).long() - (e < 0).all(0).long()
