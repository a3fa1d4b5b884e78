"""Samples: what the pixels' centres see at random times, and the light on it, for shadows that are tested by sampling.

Before: nothing.  After: shadow_maps.py, shadow_rays.py, shadows_hong2018.py, shadows_tsm.py.
Symbols: S faces in slices of the exposure in which their corners move linearly on screen and in space; P pixels;
N samples of a pixel, each with its own time; J hits; u place of a time in its slice.
Only opaque meshes without textures and one light that rests: what the papers' methods speak of.
Source: McGuire et al. 2010 (stochastic rasterisation: each sample tests the moving triangle at its own time).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

import torchblur as tb
from torchblur import check, packed
from torchblur.lights import unit

NEAR = 1e-4  # nothing nearer is drawn
MAX_TESTS = 2_000_000  # samples and moving faces looked at together: a few hundred MB of working memory


@dataclass(frozen=True, eq=False)
class MovingFaces:
    """The faces of a scene over the exposure; the first axis is the end of the slice (open, close)."""

    clip: Tensor  # (2, S, 3 corners, 4) float64 for the camera
    world: Tensor  # (2, S, 3 corners, 3) float64
    normal: Tensor  # (2, S, 3 corners, 3) of the corners; 0 where the face is flat
    t_open: Tensor  # (S,) float64 shutter time
    t_close: Tensor  # (S,)
    face: Tensor  # (S,) int64 face of the scene (all meshes end to end)
    rgb: Tensor  # (S, 3) float64 linear
    is_lit: Tensor  # (S,) bool
    is_one_sided: Tensor  # (S,) bool

    def world_at(self, t: float) -> tuple[Tensor, Tensor]:
        """Return the corners (F, 3, 3) of the faces at a shutter time, and which faces (F,) these are."""
        now = ((self.t_open <= t) & (t < self.t_close) | (self.t_close == t) & (t == 1)).nonzero().flatten()
        u = ((t - self.t_open) / (self.t_close - self.t_open))[now].reshape(-1, 1, 1)
        return (1 - u) * self.world[0, now] + u * self.world[1, now], self.face[now]


@dataclass(frozen=True, eq=False)
class Hits:
    """The nearest surfaces that samples see."""

    sample: Tensor  # (J,) int64 which of a pixel's samples
    pixel: Tensor  # (J,) int64
    t: Tensor  # (J,) float64 shutter time
    face: Tensor  # (J,) int64 face of the scene
    world: Tensor  # (J, 3) float64
    normal: Tensor  # (J, 3) of length 1, on the viewer's side
    rgb: Tensor  # (J, 3)
    is_lit: Tensor  # (J,) bool


@dataclass(frozen=True, eq=False)
class ShadowedImage:
    """A motion-blurred image with shadows."""

    rgba: Tensor  # (H, W, 4) linear: RGB is what the pixel sees, background included; A the meshes' opacity
    visibility: Tensor  # (H, W) share of the direct light due to what the pixel sees that arrives; 1 where none is due
    n_bytes: int  # of the shadow map, by the paper's count
    counts: dict[str, int]  # what the map holds


@torch.no_grad()
def gather_faces(scene: tb.Scene) -> MovingFaces:
    """Return the moving faces of a scene.

    Raises:
        TypeError, ValueError: no scene; faces that are not opaque, textures, more or fewer than one light, or a light
            that moves; the argument is named.

    Source: ours.
    """
    if not isinstance(scene, tb.Scene):
        raise check.fail_type("scene", "a Scene", scene)
    if len(scene.lights) != 1:
        raise check.fail("lights", "one light", f"{len(scene.lights)}")
    if any(value.ndim == 2 and bool((value != value[:1]).any()) for value in scene.lights[0].tensors().values()):
        raise check.fail("lights[0]", "a light that rests", "one that moves")
    parts, first = [], 0
    for i, mesh in enumerate(scene.meshes):
        if bool((mesh.face_opacity() < 1).any()):
            raise check.fail(f"meshes[{i}].material.opacity", "1, as these methods know no transparency", "less")
        if mesh.material.texture is not None:
            raise check.fail(f"meshes[{i}].material.texture", "none", "a texture")
        knots = torch.tensor(scene.knot_times(mesh), dtype=torch.float64, device=scene.device)
        at_knots = (scene.clip_at(mesh, knots), mesh.vertices_at(knots), mesh.normals_at(knots))
        corners = [values[:, mesh.faces] for values in at_knots]  # (knots, F, 3, ...)
        flags = (mesh.material.shading == "lambert", not mesh.material.double_sided)
        face = torch.arange(first, first + mesh.n_faces, device=scene.device)
        for k, times in enumerate(itertools.pairwise(knots.tolist())):
            ends = [c[k : k + 2] for c in corners]
            slices = [torch.full_like(face, t, dtype=torch.float64) for t in times]
            looks = [mesh.face_rgb(), *(torch.full_like(face, flag, dtype=torch.bool) for flag in flags)]
            parts.append((*ends, *slices, face, *looks))
        first += mesh.n_faces
    if not parts:
        raise check.fail("meshes", "at least one mesh", "none")
    columns = list(zip(*parts, strict=True))
    return MovingFaces(*(torch.cat(c, dim=1) for c in columns[:3]), *(torch.cat(c) for c in columns[3:]))


def stratified_times(scene: tb.Scene, n: int, generator: torch.Generator) -> Tensor:
    """Return (N, P) shutter times: sample k of each pixel at a random time in [k / N, (k + 1) / N]. Source: TSM."""
    n_pixels = scene.camera.height * scene.camera.width
    jitter = torch.rand(n, n_pixels, dtype=torch.float64, generator=generator)
    return ((torch.arange(n, dtype=torch.float64).unsqueeze(1) + jitter) / n).to(scene.device)


@torch.no_grad()
def average_samples(
    scene: tb.Scene, faces: MovingFaces, times: Tensor, visible: Callable[[Hits], Tensor]
) -> tuple[Tensor, Tensor]:
    """Return the image (H, W, 4) and the visibility of the light (H, W), means over the samples.

    Args:
        scene: with one light.
        faces: of the scene.
        times: (N, P) shutter times.
        visible: gives the share (J,) of the light that reaches lit hits.

    Source: Lambert's law; McGuire et al. 2010.
    """
    n, n_pixels = times.shape
    total = torch.zeros(n_pixels, 4, dtype=torch.float64, device=scene.device)
    due, arriving = (torch.zeros(n_pixels, dtype=torch.float64, device=scene.device) for _ in range(2))
    pairs = _swept_pairs(scene, faces)
    step = max(1, MAX_TESTS // max(1, len(pairs[0])))
    for first in range(0, n, step):
        hits = _find_hits(scene, faces, pairs, (times[first : first + step], first))
        to_light, irradiance = scene.lights[0].arriving(hits.world.T, hits.t)
        cosine = (hits.normal * to_light.T).sum(1).clamp(min=0) * hits.is_lit
        direct = irradiance * (cosine / math.pi).unsqueeze(1)
        share = torch.ones_like(hits.t)
        asks = (direct.sum(1) > 0).nonzero().flatten()
        share[asks] = visible(_select(hits, asks))
        light = scene.ambient.to(direct) + direct * share.unsqueeze(1)
        rgb = hits.rgb * torch.where(hits.is_lit.unsqueeze(1), light, 1.0)
        total.index_add_(0, hits.pixel, torch.cat([rgb, torch.ones_like(rgb[:, :1])], dim=1) / n)
        due.index_add_(0, hits.pixel, direct.sum(1))
        arriving.index_add_(0, hits.pixel, direct.sum(1) * share)
    shape = (scene.camera.height, scene.camera.width)
    visibility = torch.where(due > 0, arriving / torch.where(due > 0, due, 1.0), 1.0).reshape(shape)
    return scene.over_background(total.reshape(*shape, 4)).to(scene.dtype), visibility.to(scene.dtype)


def boxes_px(xyw: Tensor, width: int, height: int) -> Tensor:
    """Return x0 y0 x1 y1 (4, T) int64, inclusive, of the pixels that hold the hull of corners (T, C, 3), x and y in NDC
    times w, as far as it lies beyond w = NEAR of the largest w.
    """
    near = NEAR * xyw[..., 2].abs().amax(1, keepdim=True)
    one, two = torch.combinations(torch.arange(xyw.shape[1], device=xyw.device)).unbind(1)
    start, step, depth = xyw[:, one], xyw[:, two] - xyw[:, one], xyw[..., 2]
    cuts = (depth[:, one] > near) != (depth[:, two] > near)
    share = (near - start[..., 2]) / torch.where(cuts, step[..., 2], 1.0)
    point = torch.cat([xyw, start + share.unsqueeze(2) * step], dim=1)
    counts = torch.cat([depth > near, cuts], dim=1)
    place = point[..., :2] / torch.where(counts, torch.maximum(point[..., 2], near), 1.0).unsqueeze(2)
    low, high = [], []
    for axis, size, sign in ((0, width, 1), (1, height, -1)):
        at = (sign * place[..., axis] + 1) * (size / 2) - 0.5
        low.append((torch.where(counts, at, torch.inf).amin(1) - 1e-6).clamp(0, size).ceil())
        high.append((torch.where(counts, at, -torch.inf).amax(1) + 1e-6).clamp(-1, size - 1).floor())
    return torch.stack([*low, *high]).long()


def pixels_in(box: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Return the pixels (row * width + column) of boxes (4, T), and whose they are."""
    columns = (box[2] - box[0] + 1).clamp(min=0)
    count = columns * (box[3] - box[1] + 1).clamp(min=0)
    local, owner = packed.expand(torch.zeros_like(count), count)
    return (box[1][owner] + local // columns[owner]) * width + box[0][owner] + local % columns[owner], owner


def centres_ndc(pixel: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Return x and y of the pixels' centres, y up."""
    column, row = (pixel % width).to(torch.float64), (pixel // width).to(torch.float64)
    return 2 * (column + 0.5) / width - 1, 1 - 2 * (row + 0.5) / height


def _swept_pairs(scene: tb.Scene, faces: MovingFaces) -> tuple[Tensor, Tensor]:
    """Return pixels and the moving faces (of S) that may cross them."""
    width, height = scene.camera.width, scene.camera.height
    corners = faces.clip[..., [0, 1, 3]].permute(1, 0, 2, 3).flatten(1, 2)
    return pixels_in(boxes_px(corners, width, height), width)


def _find_hits(scene: tb.Scene, faces: MovingFaces, pairs: tuple, samples: tuple[Tensor, int]) -> Hits:
    """Return what the samples `samples[0]` (N, P) see, the first of them being number `samples[1]`."""
    times, first = samples
    pixel, moving = pairs
    t = times[:, pixel]
    sample, pair = ((t >= faces.t_open[moving]) & (t <= faces.t_close[moving])).nonzero(as_tuple=True)
    pixel, moving, t = pixel[pair], moving[pair], t[sample, pair]
    u = (t - faces.t_open[moving]) / (faces.t_close - faces.t_open)[moving]
    x0, y0 = centres_ndc(pixel, scene.camera.width, scene.camera.height)
    part = [
        (1 - u) * faces.clip[0, :, c, k][moving] + u * faces.clip[1, :, c, k][moving]
        for c in range(3)
        for k in (0, 1, 3)
    ]
    x = [part[3 * c] - x0 * part[3 * c + 2] for c in range(3)]
    y = [part[3 * c + 1] - y0 * part[3 * c + 2] for c in range(3)]
    e = torch.stack([x[(c + 1) % 3] * y[(c + 2) % 3] - y[(c + 1) % 3] * x[(c + 2) % 3] for c in range(3)], dim=1)
    total = e.sum(1)
    inside = ((e >= 0).all(1) | ((e <= 0).all(1) & ~faces.is_one_sided[moving])) & (total != 0)
    kept = inside.nonzero().flatten()
    sample, pixel, moving, t, u, e, total = (v[kept] for v in (sample, pixel, moving, t, u, e, total))
    weight = e / total.unsqueeze(1)
    z, w = (_blend(faces.clip[..., k], moving, u, weight) for k in (2, 3))
    kept = ((w + z >= 0) & (w - z >= 0)).nonzero().flatten()
    owner = (sample * times.shape[1] + pixel)[kept]
    order = torch.sort((z / w)[kept], stable=True).indices
    order = order[torch.sort(owner[order], stable=True).indices]
    is_first = torch.ones_like(owner, dtype=torch.bool)
    is_first[1:] = owner[order][1:] != owner[order][:-1]
    kept = kept[order[is_first]]
    sample, pixel, moving, t, u, weight, total = (v[kept] for v in (sample, pixel, moving, t, u, weight, total))
    shift = u.reshape(-1, 1, 1)
    corner, own = ((1 - shift) * v[0, moving] + shift * v[1, moving] for v in (faces.world, faces.normal))
    flat = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal = torch.where((own == 0).all(-1).all(-1, keepdim=True), flat, (weight.unsqueeze(2) * own).sum(1))
    side = total.sign() * scene.camera.handedness
    return Hits(
        sample=sample + first,
        pixel=pixel,
        t=t,
        face=faces.face[moving],
        world=(weight.unsqueeze(2) * corner).sum(1),
        normal=unit(normal.T).T * side.unsqueeze(1),
        rgb=faces.rgb[moving],
        is_lit=faces.is_lit[moving],
    )


def _blend(values: Tensor, moving: Tensor, u: Tensor, weight: Tensor) -> Tensor:
    """Return (J,) values (2, S, 3 corners) of moving faces at places u of their slices, at barycentrics `weight`."""
    corner = (1 - u).unsqueeze(1) * values[0, moving] + u.unsqueeze(1) * values[1, moving]
    return (weight * corner).sum(1)


def _select(hits: Hits, chosen: Tensor) -> Hits:
    """Return some of the hits."""
    return Hits(**{name: value[chosen] for name, value in vars(hits).items()})
