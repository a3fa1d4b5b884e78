"""Sharp images on the CPU: what instant.py and fragments.py do, by the compiled scan of raster.py and layers.py.

Before: raster.py, layers.py, fragments.py.  After: instant.py.
Symbols: B instants, P pixels. Where many casters throw shadows, the search is compiled, and shading.py and shadows.py
look at what is visible. Rows of pixels are handed out in bands to a pool of threads; each pixel is summed by one of
them, in the order of the instants, so that results do not depend on the number of threads.
Source: ours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from torchblur.camera import Ray
from torchblur.cpu import layers, raster
from torchblur.cpu.lambert import find_lit
from torchblur.cpu.motion import find_knots, vertices_at
from torchblur.cpu.shadow_rays import can_look_at_all
from torchblur.fragments import MAX_PAIRS, Fragments, fragments_of
from torchblur.scene import Scene
from torchblur.surfaces import Surfaces

MAX_BAND_ROWS, BANDS = 64, 8
Part = TypeVar("Part")
AT_REST = np.zeros((1, 2))


def compiles_looks(surfaces: Surfaces) -> bool:
    """Return whether the looks of all faces are compiled: not those with many casters of shadows. Ours."""
    return can_look_at_all(surfaces)


def find_fragments(scene: Scene, surfaces: Surfaces, t: Tensor, ray: Ray) -> Iterator[Fragments]:
    """Yield what `torchblur.fragments.find_fragments` does, but for what opaque faces hide. Source: ours."""
    knots, faces, corner = find_knots(scene), faces_of(surfaces), corners_of(scene)
    camera, n_faces = scene.camera, len(surfaces.opacity)
    rays, bounds = _grid(scene, ray), (ray.x_px, ray.x_px, ray.y_px, ray.y_px)
    size = camera.width, camera.height, camera.height
    clip: list[Tensor] = []
    pending: list[tuple[Tensor, Tensor]] = []
    n_pending = 0
    for k in range(len(t)):
        shape = _still(vertices_at(knots, float(t[k])), corner, n_faces)
        clip.append(torch.from_numpy(shape.clip_start))
        raster.find_boxes(shape, size, bounds)
        seen = on_threads(lambda rows, shape=shape: layers.find_visible(shape, faces, rays, rows), bands_of(size[1]))
        for pixel, face, _ in seen:
            pending.append((torch.from_numpy(pixel), torch.from_numpy(face) + k * n_faces))
            n_pending += len(pixel)
            if n_pending > MAX_PAIRS:
                yield _fragments(scene, surfaces, (torch.stack(clip), corner), pending, (t, ray))
                pending, n_pending = [], 0
    if pending:
        yield _fragments(scene, surfaces, (torch.stack(clip), corner), pending, (t, ray))


def sum_of_instants(scene: Scene, surfaces: Surfaces, t: Tensor, weight: Tensor, ray: Ray) -> Tensor:
    """Return what `torchblur.instant.sum_of_instants` does, of a scene whose looks are compiled. Source: ours."""
    camera = scene.camera
    knots, times = find_knots(scene), t.tolist()
    faces, looks, corner = faces_of(surfaces), looks_of(surfaces, scene, ray), corners_of(scene)
    rays, bounds = _grid(scene, ray), (ray.x_px, ray.x_px, ray.y_px, ray.y_px)
    lit, moments = find_lit(scene, surfaces), t.reshape(-1, 1).numpy()
    weights = weight.detach().to(torch.float64).numpy()

    def place(k: int) -> raster.Shape:
        shape = _still(vertices_at(knots, times[k]), corner, len(surfaces.opacity))
        raster.find_boxes(shape, (camera.width, camera.height, camera.height), bounds)
        return shape

    shapes = on_threads(place, list(range(len(t))))
    total = np.zeros((camera.height * camera.width, 4))

    def add(rows: tuple[int, int]) -> None:
        for shape, share, when in zip(shapes, weights, moments, strict=True):
            layers.add_seen(total, share, shape, (faces, looks, lit), rays._replace(t=when), rows)

    on_threads(add, bands_of(camera.height))
    return torch.from_numpy(total).reshape(camera.height, camera.width, 4)


def on_threads(work: Callable[[Any], Part], items: list[Any]) -> list[Part]:
    """Return `work` of each item, done by as many threads as torch is allowed. Source: ours."""
    n_threads = min(torch.get_num_threads(), len(items))
    if n_threads < 2:
        return [work(item) for item in items]
    with ThreadPoolExecutor(max_workers=n_threads) as pool:
        return list(pool.map(work, items))


def corners_of(scene: Scene) -> np.ndarray:
    """Return (F, 3) int32 the vertices of all faces, those of all meshes end to end."""
    first, parts = 0, [np.zeros((0, 3), dtype=np.int32)]
    for mesh in scene.meshes:
        parts.append((mesh.faces.numpy() + first).astype(np.int32))
        first += mesh.vertices.shape[-2]
    return np.concatenate(parts)


def faces_of(surfaces: Surfaces) -> raster.Faces:
    """Return what of the faces decides who is seen."""
    kind = torch.where(surfaces.is_opaque, raster.OPAQUE, raster.OTHER)
    kind = torch.where(surfaces.opacity.detach() > 0, kind, raster.HIDDEN)
    return raster.Faces(kind.to(torch.uint8).numpy(), surfaces.is_one_sided.numpy(), surfaces.tie_rank.numpy())


def looks_of(surfaces: Surfaces, scene: Scene, ray: Ray) -> layers.Looks:
    """Return what the faces look like to rays as far apart as `ray` is from the next."""
    atlas = surfaces.atlas
    step = 2 * ray.spacing_px / scene.camera.width, -2 * ray.spacing_px / scene.camera.height
    tensors = surfaces.rgb, surfaces.opacity, surfaces.is_textured, surfaces.mesh_of, surfaces.uv
    textures = atlas.texels, atlas.first, atlas.size, atlas.n_levels, atlas.repeats
    arrays = [part.detach().contiguous().numpy() for part in (*tensors, *textures)]
    return layers.Looks(*arrays, np.array(step))


def empty_box(n_faces: int) -> np.ndarray:
    """Return room for the boxes of so many faces."""
    return np.empty((n_faces, 4), dtype=np.int32)


def _still(clip: np.ndarray, corner: np.ndarray, n_faces: int) -> raster.Shape:
    """Return the shape of an instant without its boxes."""
    span, no_shift = np.array([[0, n_faces]]), np.zeros(1, dtype=np.int64)
    return raster.Shape(clip, clip, corner, span, no_shift, AT_REST, empty_box(n_faces))


def _grid(scene: Scene, ray: Ray) -> raster.Rays:
    """Return the rays of all pixels at one place in each."""
    width, height = scene.camera.width, scene.camera.height
    x_ndc = 2 * (np.arange(width, dtype=np.float64) + ray.x_px) / width - 1
    y_ndc = 1 - 2 * (np.arange(height, dtype=np.float64) + ray.y_px) / height
    return raster.Rays(x_ndc, y_ndc, np.zeros(1), True, width, scene.camera.orders_by_w, 0.0)


def bands_of(height: int) -> list[tuple[int, int]]:
    """Return first and last row (exclusive) of the bands of an image."""
    rows = min(max(-(-height // BANDS), 1), MAX_BAND_ROWS)
    return [(first, min(first + rows, height)) for first in range(0, height, rows)]


def _fragments(
    scene: Scene,
    surfaces: Surfaces,
    geometry: tuple[Tensor, np.ndarray],
    pending: list[tuple[Tensor, Tensor]],
    instants: tuple[Tensor, Ray],
) -> Fragments:
    """Return the fragments of pixels and triangles (instant * F + face)."""
    clip, corner = geometry
    t, ray = instants
    pixel, triangle = (torch.cat(part) for part in zip(*pending, strict=True))
    width, n_faces = scene.camera.width, len(surfaces.opacity)
    of = clip[(triangle // n_faces).unsqueeze(1), torch.from_numpy(corner).long()[triangle % n_faces]]
    which = torch.arange(len(pixel))
    return fragments_of(scene, surfaces, (of, triangle), (which, pixel // width, pixel % width), (t, ray))
