"""What a scene with shadows looks like, by brute force in plain numpy float64; imports nothing of torchblur.

At each sub-frame every pixel's centre gets one ray to all surfaces in front of the first opaque one, and every lit hit
one shadow ray to each light against all triangles, each of which takes (1 - opacity) of the light. No map, no texels,
no time ranges: the error is that of the number of sub-frames alone.

Motion: clip-space vertices are linear in time between the knots of mesh and camera; under a still camera this is the
same as world-space vertices linear in time. Shadow rays run in world space, whose vertices are linear between the knots
of their mesh; a moving camera decides which point of a face is seen, as in torchblur.
Rules: as in oracle_looks.py. Faces cast shadows from both sides, lit or not, in view or not, whether or not their backs
are shown; a face never shades itself.

Symbols: F faces of all meshes; H hits (a pixel and a face); P pixels; N sub-frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from oracle_looks import LookScene, PlainLight, arriving, dot, knots_at, unit
from oracles import clip_at

NEXT, LAST = [1, 2, 0], [2, 0, 1]  # the corners whose edge lies opposite corners 0, 1, 2


@dataclass
class ShadowAnswer:
    """Means over the sub-frames, or values at one."""

    rgba: np.ndarray  # (H, W, 4) linear, with the background; opacity
    visibility: np.ndarray  # (H, W) share of the direct light due to what is seen that arrives; 1 where none is due
    due: np.ndarray  # (H, W) that light without shadows: sum over RGB, lights and layers of E / pi cos
    arriving: np.ndarray  # (H, W) that light with shadows


@dataclass
class Faces:
    """All faces of a scene at one instant."""

    world: np.ndarray  # (F, 3 corners, 3)
    clip: np.ndarray  # (F, 3 corners, 4)
    normal: np.ndarray  # (F, 3 corners, 3) the corners' own, or the face's
    color: np.ndarray  # (F, 3)
    alpha: np.ndarray  # (F,)
    lit: np.ndarray  # (F,) bool
    both_sides: np.ndarray  # (F,) bool


def midpoints(n: int, t_open: float = 0.0, t_close: float = 1.0) -> np.ndarray:
    """Return the middles of n equal parts of an exposure."""
    return t_open + (t_close - t_open) * (np.arange(n) + 0.5) / n


def mean_with_shadows(scene: LookScene, times, casting=None, tolerance: float = 1e-9) -> ShadowAnswer:
    """Return the mean over sub-frames at `times` (N,); see `instant_with_shadows`."""
    instants = [instant_with_shadows(scene, float(t), casting, tolerance) for t in times]
    rgba, due, arrived = (np.mean([getattr(i, k) for i in instants], axis=0) for k in ("rgba", "due", "arriving"))
    return ShadowAnswer(rgba, _share(arrived, due), due, arrived)


def instant_with_shadows(scene: LookScene, t: float, casting=None, tolerance: float = 1e-9) -> ShadowAnswer:
    """Return the scene at an instant.

    casting: which of the lights cast shadows; all of them if None. tolerance: share of the way to the light (of a sun:
    of the scene's size) that a shadow ray skips.
    """
    faces, n_pixels = faces_at(scene, t), scene.height * scene.width
    pixel, face, bary, front, layer_weight = find_layers(scene, faces)
    point = np.einsum("hc,hcd->hd", bary, faces.world[face])
    normal = unit(np.einsum("hc,hcd->hd", bary, faces.normal[face]))
    matrix = knots_at(scene.world_to_clip, np.array([t]), 2)[0]
    hand = -np.sign(np.linalg.det(matrix[:3, :3]))
    normal = normal * (np.where(front, 1.0, -1.0) * hand)[:, None]
    light_on = np.where(faces.lit[face, None], np.asarray(scene.ambient, dtype=np.float64), 1.0)
    due, arrived = np.zeros(len(face)), np.zeros(len(face))
    for k, light in enumerate(scene.lights):
        irradiance, way, _ = arriving(light, point, np.full(len(face), t))
        direct = irradiance / np.pi * np.maximum(dot(normal, way), 0)[:, None] * faces.lit[face, None]
        visible = np.ones(len(face))
        asks = np.flatnonzero(direct.sum(1) > 0)
        if casting is None or casting[k]:
            visible[asks] = visible_share(faces, light, t, (point[asks], face[asks]), tolerance)
        due += direct.sum(1)
        arrived += direct.sum(1) * visible
        light_on = light_on + direct * visible[:, None]

    def per_pixel(value):
        return np.bincount(pixel, layer_weight * value, n_pixels)

    rgb = np.stack([per_pixel((faces.color[face] * light_on)[:, c]) for c in range(3)], 1)
    alpha = per_pixel(np.ones(len(face)))[:, None]
    background = np.broadcast_to(scene.background, (scene.height, scene.width, 3)).reshape(-1, 3)
    rgba = np.concatenate([rgb + (1 - alpha) * background, alpha], 1)
    shape = (scene.height, scene.width)
    due, arrived = per_pixel(due).reshape(shape), per_pixel(arrived).reshape(shape)
    return ShadowAnswer(rgba.reshape(*shape, 4), _share(arrived, due), due, arrived)


def faces_at(scene: LookScene, t: float) -> Faces:
    """Return the scene's faces at an instant."""
    at, parts = np.array([t]), []
    for mesh in scene.meshes:
        assert getattr(mesh, "texture", None) is None, "textures are not of this oracle"
        world, n = knots_at(mesh.vertices, at, 2)[0][mesh.faces], len(mesh.faces)
        normal = np.cross(world[:, 1] - world[:, 0], world[:, 2] - world[:, 0])
        normal = np.repeat(normal[:, None], 3, axis=1)
        if mesh.normals is not None:
            normal = knots_at(mesh.normals, at, 2)[0][mesh.faces]
        looks = np.broadcast_to(mesh.color, (n, 3)), np.broadcast_to(mesh.opacity, (n,))
        flags = np.full(n, mesh.shading == "lambert"), np.full(n, mesh.double_sided)
        parts.append((world, clip_at(scene, mesh, t)[mesh.faces], normal, *looks, *flags))
    return Faces(*(np.concatenate(p) for p in zip(*parts, strict=True)))


def find_layers(scene: LookScene, faces: Faces) -> tuple[np.ndarray, ...]:
    """Return pixel, face, barycentrics (H, 3), whether the front is seen, and the share of the pixel that each hit
    makes up: its opacity behind those in front of it. Hits without a share are left out.
    """
    col, row = np.meshgrid(np.arange(scene.width), np.arange(scene.height))
    x, y = 2 * (col.ravel() + 0.5) / scene.width - 1, 1 - 2 * (row.ravel() + 0.5) / scene.height
    ray = np.stack([x, y, np.ones(len(x))], 1)
    xyw = faces.clip[..., [0, 1, 3]]
    # the edge function of vertices reduced by the ray is linear in the ray
    e, positive, negative = edges_and_signs(ray, np.cross(xyw[:, NEXT], xyw[:, LAST]))
    inside = positive | (negative & faces.both_sides)
    pixel, face = np.nonzero(inside & (faces.alpha > 0))
    e = e[pixel, face]
    total = e.sum(1)
    z, w = (dot(e, faces.clip[face, :, k]) for k in (2, 3))
    kept = np.flatnonzero((total * (w + z) >= 0) & (total * (w - z) >= 0))
    kept = kept[np.lexsort(((z / w)[kept], pixel[kept]))]  # nearest first in each pixel
    pixel, face, e, total = pixel[kept], face[kept], e[kept], total[kept]
    first = np.searchsorted(pixel, pixel)
    rank, left, weight = np.arange(len(pixel)) - first, np.ones(len(ray)), np.zeros(len(pixel))
    for k in range(rank.max() + 1 if len(rank) else 0):
        at = np.flatnonzero(rank == k)
        weight[at] = left[pixel[at]] * faces.alpha[face[at]]
        left[pixel[at]] *= 1 - faces.alpha[face[at]]
    seen = weight > 0
    return pixel[seen], face[seen], e[seen] / total[seen, None], total[seen] > 0, weight[seen]


def edges_and_signs(point: np.ndarray, side: np.ndarray, constant: np.ndarray | float = 0.0) -> tuple:
    """Return edge functions (N, F, 3) of points (N, 3), and (N, F) where all three are positive, and negative.

    On an edge itself (side (F, 3, 3) is its normal, negated in the face across) one of its two faces has the point.
    """
    e = (point @ side.reshape(-1, 3).T - np.ravel(constant)).reshape(len(point), len(side), 3)
    first = np.where(side[..., 0] != 0, side[..., 0], np.where(side[..., 1] != 0, side[..., 1], side[..., 2]))
    sign = np.where(e != 0, e, first)
    return e, (sign > 0).all(-1), (sign < 0).all(-1)


def visible_share(faces: Faces, light: PlainLight, t: float, hits: tuple, tolerance: float) -> np.ndarray:
    """Return (H,) the product of (1 - opacity) over the faces between `hits`, points (H, 3) on faces (H,), and a light.

    With the light as the origin, the ray to X passes the edge from A to B on the side that the sign of (A x B) X tells,
    and plane (A - X) n = 0 at X lies beyond that of the face where X n / A n > 1. A sun lies in a direction instead.
    """
    point, own = hits
    at = np.array([t])
    if light.kind == "directional":
        way = -unit(knots_at(light.direction, at, 1)[0])
        a = faces.world
        side = np.cross(way, a[:, NEXT] - a[:, LAST])  # edge function, linear in the point but for a constant
        constant = dot(side, (a[:, NEXT] + a[:, LAST]) / 2)
    else:
        origin = knots_at(light.position, at, 1)[0]
        point, a = point - origin, faces.world - origin
        side = np.cross(a[:, NEXT], a[:, LAST])
        constant = np.zeros(side.shape[:2])
    _, positive, negative = edges_and_signs(point, side, constant)
    crosses = positive | negative
    crosses[np.arange(len(point)), own] = False
    hit, face = np.nonzero(crosses)
    normal = np.cross(a[face, 1] - a[face, 0], a[face, 2] - a[face, 0])
    offset = dot(normal, a[face, 0] - point[hit])  # of the face's plane from the point
    with np.errstate(divide="ignore", invalid="ignore"):  # faces seen edge on block nothing
        if light.kind == "directional":
            size = np.ptp(faces.world.reshape(-1, 3), axis=0).max()
            between = offset / (normal @ way) > tolerance * size
        else:
            share = offset / -dot(normal, point[hit])  # of the way to the light
            between = (share > tolerance) & (share < 1)
    visible = np.ones(len(point))
    np.multiply.at(visible, hit[between], 1 - faces.alpha[face[between]])
    return visible


def _share(arrived: np.ndarray, due: np.ndarray) -> np.ndarray:
    """Return arrived / due; 1 where nothing is due."""
    return np.where(due > 0, arrived / np.where(due > 0, due, 1.0), 1.0)
