"""Samples at times and places of each pixel's own on the CPU: what time_samples.py does, by the compiled scan.

Before: raster.py, layers.py, motion.py, instant.py, time_samples.py.  After: sampling.py.
Symbols: N samples a pixel, P pixels of a block of rows; n layers. All samples of one rank in time are looked at
together; the numbers drawn, and how a ray's time is expressed in its slice, are those of time_samples.py. Scenes
of many casters of shadows take the hybrid way, as in instant.py.
Source: Akenine-Moller et al. 2007, McGuire et al. 2010.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchblur import packed
from torchblur.camera import Ray
from torchblur.cpu import layers, raster
from torchblur.cpu.instant import bands_of, compiles_looks, corners_of, faces_of, looks_of, on_threads
from torchblur.cpu.lambert import find_lit
from torchblur.cpu.motion import Knots, find_knots, vertices_at
from torchblur.edges import cross
from torchblur.prisms import window_times
from torchblur.scene import Scene
from torchblur.shading import Points, look, needing_points, weight_slopes
from torchblur.shadows import with_shadows
from torchblur.shutter import Shutter
from torchblur.surfaces import Surfaces
from torchblur.time_samples import SampleRays, Samples, blocks_of_rows

MAX_VERTICES = 1_000_000  # of the ranks that are done together


class _Rank(NamedTuple):
    """The samples of one rank in a block of rows."""

    shape: raster.Shape
    rays: raster.Rays
    weight: np.ndarray  # (P,)


def sum_of_samples(
    scene: Scene, surfaces: Surfaces, shutter: Shutter, count: int, draw: Callable[[int], Samples]
) -> Tensor:
    """Return what `torchblur.time_samples.sum_of_samples` does. Source: as there."""
    camera = scene.camera
    knots, corner, faces = find_knots(scene), corners_of(scene), faces_of(surfaces)
    lit = find_lit(scene, surfaces)
    together = max(1, MAX_VERTICES // max(1, int(knots.mesh[:, 1].sum())))
    parts = []
    for block in blocks_of_rows(scene, shutter, count, draw):
        total = None
        while chosen := list(itertools.islice(block, together)):
            ranks = on_threads(lambda one: _prepare(scene, knots, corner, *one), chosen)
            if total is None:
                total = np.zeros((len(chosen[0][1]), 4))
            n_rows = len(total) // camera.width
            if compiles_looks(surfaces):
                looks = looks_of(surfaces, scene, Ray(0.5, 0.5, chosen[0][0].spacing_px))

                def add(rows: tuple[int, int], ranks=ranks, looks=looks, total=total) -> None:
                    for rank in ranks:
                        layers.add_seen(total, rank.weight, rank.shape, (faces, looks, lit), rank.rays, rows)

                on_threads(add, bands_of(n_rows))
                continue
            for rank, (rays, weight) in zip(ranks, chosen, strict=True):
                found = on_threads(
                    lambda rows, rank=rank: layers.find_visible(rank.shape, faces, rank.rays, rows), bands_of(n_rows)
                )
                pixel, face, part = (torch.from_numpy(np.concatenate(f)) for f in zip(*found, strict=True))
                seen = _see(scene, surfaces, rank.shape, rays, (pixel, face, part))
                total += (weight.unsqueeze(1) * seen).numpy()
        parts.append(torch.from_numpy(total))
    return torch.cat(parts).reshape(camera.height, camera.width, 4)


def _prepare(scene: Scene, knots: Knots, corner: np.ndarray, rays: SampleRays, weight: Tensor) -> _Rank:
    """Return a rank's shape, with boxes, and rays."""
    camera = scene.camera
    x_px, y_px, t = rays.x_px.numpy(), rays.y_px.numpy(), rays.t.numpy()
    window = float(t.min()), float(t.max())
    columns = x_px % 1
    bounds = float(columns.min()), float(columns.max()), float((y_px % 1).min()), float((y_px % 1).max())
    shape = _moving(scene, knots, corner, window)
    size = camera.width, camera.height, len(t) // camera.width
    raster.find_boxes(shape, size, (*bounds[:2], bounds[2] + rays.first_row, bounds[3] + rays.first_row))
    x_ndc, y_ndc = 2 * x_px / camera.width - 1, 1 - 2 * y_px / camera.height
    compiled = raster.Rays(x_ndc, y_ndc, t, False, camera.width, camera.orders_by_w, window[1])
    return _Rank(shape, compiled, weight.numpy())


def _moving(scene: Scene, knots: Knots, corner: np.ndarray, window: tuple[float, float]) -> raster.Shape:
    """Return the shape of a slice of the exposure without its boxes: each mesh cut at the knots of its motion."""
    at: dict[float, np.ndarray] = {}
    starts, ends, span, shift, times = [np.zeros((0, 4))], [np.zeros((0, 4))], [], [], []
    n_rows = first_face = 0
    for mesh, (_, n_vertices, first) in zip(scene.meshes, knots.mesh, strict=True):
        rests = scene.is_still(mesh)
        own = list(window) if rests else window_times(scene, mesh, window)
        placed = []
        for t in own:
            if t not in at:
                at[t] = vertices_at(knots, t)
            placed.append(at[t][first : first + n_vertices])
        for k in range(len(own) - 1):
            starts.append(placed[k])
            ends.append(placed[k] if rests else placed[k + 1])
            span.append((first_face, first_face + mesh.n_faces))
            shift.append(n_rows - first)
            times.append((own[k], own[k + 1]))
            n_rows += n_vertices
        first_face += mesh.n_faces
    n_boxes = sum(b - a for a, b in span)
    return raster.Shape(
        np.concatenate(starts),
        np.concatenate(ends),
        corner,
        np.array(span, dtype=np.int64).reshape(-1, 2),
        np.array(shift, dtype=np.int64),
        np.array(times, dtype=np.float64).reshape(-1, 2),
        np.empty((n_boxes, 4), dtype=np.int32),
    )


def _see(
    scene: Scene, surfaces: Surfaces, shape: raster.Shape, rays: SampleRays, layers_of: tuple[Tensor, Tensor, Tensor]
) -> Tensor:
    """Return (P, 4) the meshes' premultiplied colour and opacity of layers, pixel, face and part (n,), in order."""
    pixel, face, part = layers_of
    which = needing_points(surfaces, face)
    points = _points(scene, surfaces, shape, rays, (pixel[which], face[which], part[which]))
    seen = look(surfaces, face, which, with_shadows(surfaces, points))
    offsets = packed.offsets_from_owners(pixel, len(rays.t))
    before, after = packed.transmittance(seen.alpha, offsets)
    light = packed.sum_by_owner((before * seen.alpha).unsqueeze(1) * seen.rgb, offsets)
    return torch.cat([light, (1 - after).unsqueeze(1)], dim=1)


def _points(
    scene: Scene, surfaces: Surfaces, shape: raster.Shape, rays: SampleRays, layers_of: tuple[Tensor, Tensor, Tensor]
) -> Points:
    """Return where rays meet faces."""
    pixel, face, part = layers_of
    camera, t = scene.camera, rays.t[pixel]
    start, end = torch.from_numpy(shape.times)[part].unbind(1)
    u = torch.where(end > start, (t - start) / torch.where(end > start, end - start, 1.0), 0.0)
    vertex = torch.from_numpy(shape.corner).long()[face] + torch.from_numpy(shape.shift)[part].unsqueeze(1)
    first, last = (torch.from_numpy(c)[vertex].permute(1, 2, 0) for c in (shape.clip_start, shape.clip_end))
    clip = (1 - u) * first + u * last  # (3, 4, n)
    w = clip[:, 3]
    x = clip[:, 0] - (2 * rays.x_px[pixel] / camera.width - 1) * w
    y = clip[:, 1] - (1 - 2 * rays.y_px[pixel] / camera.height) * w
    e, along_x, along_y = (
        cross(a.roll(-1, 0), b.roll(-1, 0), a.roll(-2, 0), b.roll(-2, 0)) for a, b in ((x, y), (y, w), (w, x))
    )
    slope = e.new_zeros(2, 3, 0)
    if surfaces.has_mipmaps:
        slope = weight_slopes(
            e, (along_x, along_y), (2 * rays.spacing_px / camera.width, -2 * rays.spacing_px / camera.height)
        )
    world, normal = _corners_world(scene, surfaces, face, t)
    return Points(
        face=face,
        weight=e / e.sum(0),
        slope=slope,
        uv=surfaces.uv[face].permute(2, 1, 0),
        world=world,
        normal=normal,
        turn=torch.ones_like(t),
        side=e.sum(0).sign(),
        t=t,
    )


def _corners_world(scene: Scene, surfaces: Surfaces, face: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return positions and normals (3 corners, 3, n) of the corners of `face` (n,) at shutter times `t` (n,)."""
    world, normal = (torch.zeros(len(face), 3, 3, dtype=torch.float64) for _ in range(2))
    mesh_of = surfaces.mesh_of[face]
    for i in torch.unique(mesh_of).tolist():
        mesh, own = scene.meshes[i], (mesh_of == i).nonzero().flatten()
        corner = mesh.faces[face[own] - surfaces.first_face[i]]
        world[own] = _along(mesh.vertices, corner, t[own])
        if mesh.normals is not None:
            normal[own] = _along(mesh.normals, corner, t[own])
    return world.permute(1, 2, 0), normal.permute(1, 2, 0)


def _along(knots: Tensor, corner: Tensor, t: Tensor) -> Tensor:
    """Return (n, 3, 3) float64 values of `knots` (V, 3) or (K+1, V, 3) at corners (n, 3) and shutter times (n,)."""
    knots = knots.detach().to(torch.float64)
    if knots.ndim == 2:
        return knots[corner]
    scaled = t * (len(knots) - 1)
    first = scaled.floor().clamp(0, len(knots) - 2)
    share = (scaled - first).reshape(-1, 1, 1)
    at = first.long().unsqueeze(1)
    return (1 - share) * knots[at, corner] + share * knots[at + 1, corner]
