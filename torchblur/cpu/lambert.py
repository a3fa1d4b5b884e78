"""The light that a lit face sends to the viewer, compiled.

Before: jit.py, shadow_rays.py, surfaces.py.  After: layers.py.
Symbols: M meshes, L lights, R knots of all vertices; linear between knots at equally spaced shutter times.
Source: as lighting.py and lights.py: Lambert's law, inverse-square law, glTF's spots.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchblur.cpu import shadow_rays
from torchblur.cpu.jit import jit
from torchblur.lights import DirectionalLight, SpotLight
from torchblur.scene import Scene
from torchblur.surfaces import Surfaces

POINT, SPOT, DIRECTIONAL = 0, 1, 2


class Lit(NamedTuple):
    """What lit faces and lights are like, and how they move."""

    is_lit: np.ndarray  # (F,) bool
    has_normals: np.ndarray  # (F,) bool
    handedness: float
    ambient: np.ndarray  # (3,) float64
    world: np.ndarray  # (R, 3) float64 vertices, mesh by mesh, knot by knot
    normal: np.ndarray  # (R', 3) float64 normals, likewise
    mesh: np.ndarray  # (M, 7) int64: first vertex; first row, vertices and knots of world; the same of normal
    kind: np.ndarray  # (L,) int64
    power: np.ndarray  # (L, 3) float64
    cosines: np.ndarray  # (L, 2) float64 of the inner and outer angles
    path: np.ndarray  # (rows, 3) float64 knots of positions or directions, and of targets
    track: np.ndarray  # (L, 4) int64: first row and knots of the position, and of the target
    blockers: shadow_rays.Blockers


def find_lit(scene: Scene, surfaces: Surfaces) -> Lit:
    """Return what of a scene decides how its faces are lit. Source: ours."""
    world, normal, table, first = [np.zeros((0, 3))], [np.zeros((0, 3))], [], 0
    for mesh in scene.meshes:
        row = [first]
        for parts, knots in ((world, mesh.vertices), (normal, mesh.normals)):
            array = np.zeros((0, 0, 3)) if knots is None else knots.detach().double().numpy()
            array = array[None] if array.ndim == 2 else array
            row += [sum(len(p) for p in parts), array.shape[1], array.shape[0]]
            parts.append(array.reshape(-1, 3))
        table.append(row)
        first += mesh.vertices.shape[-2]
    kinds, powers, cosines, path, track = [], [], [], [np.zeros((0, 3))], []
    for light in scene.lights:
        is_spot, is_directional = isinstance(light, SpotLight), isinstance(light, DirectionalLight)
        kinds.append(DIRECTIONAL if is_directional else SPOT if is_spot else POINT)
        powers.append((light.irradiance if is_directional else light.intensity).detach().double().numpy())
        cosines.append(light.cosines if is_spot else (0.0, 0.0))
        row = []
        for knots in (light.direction if is_directional else light.position, light.target if is_spot else None):
            array = np.zeros((0, 3)) if knots is None else np.atleast_2d(knots.detach().double().numpy())
            row += [sum(len(p) for p in path), len(array)]
            path.append(array)
        track.append(row)
    return Lit(
        surfaces.is_lit.numpy(),
        surfaces.has_normals.numpy(),
        surfaces.handedness,
        surfaces.ambient.detach().numpy(),
        np.concatenate(world),
        np.concatenate(normal),
        np.array(table, dtype=np.int64).reshape(-1, 7),
        np.array(kinds, dtype=np.int64),
        np.array(powers, dtype=np.float64).reshape(-1, 3),
        np.array(cosines, dtype=np.float64).reshape(-1, 2),
        np.concatenate(path),
        np.array(track, dtype=np.int64).reshape(-1, 4),
        shadow_rays.find_blockers(surfaces),
    )


@jit
def along(rows, first, stride, count, t):
    """Return x, y, z at shutter time `t` of `count` knots, `stride` rows apart from row `first` on."""
    if count == 1:
        return rows[first, 0], rows[first, 1], rows[first, 2]
    scaled = t * (count - 1)
    segment = min(max(int(np.floor(scaled)), 0), count - 2)
    share = scaled - segment
    keep, a = 1 - share, first + segment * stride
    b = a + stride
    return (
        keep * rows[a, 0] + share * rows[b, 0],
        keep * rows[a, 1] + share * rows[b, 1],
        keep * rows[a, 2] + share * rows[b, 2],
    )


@jit
def unit(x, y, z):
    """Return a vector at length 1, or 0 if it is, however small or large it is."""
    largest = max(abs(x), abs(y), abs(z))
    if largest == 0:
        return 0.0, 0.0, 0.0
    x, y, z = x / largest, y / largest, z / largest
    length = np.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@jit
def lit_by(lit, shape, hit, f, t):
    """Return what to multiply the colour of face `f` by, where `hit` are its barycentrics and its mesh."""
    b0, b1, b2, side, mesh = hit
    table = lit.mesh[mesh]
    i, j, k = shape.corner[f, 0] - table[0], shape.corner[f, 1] - table[0], shape.corner[f, 2] - table[0]
    ax, ay, az = along(lit.world, table[1] + i, table[2], table[3], t)
    bx, by, bz = along(lit.world, table[1] + j, table[2], table[3], t)
    cx, cy, cz = along(lit.world, table[1] + k, table[2], table[3], t)
    px, py, pz = b0 * ax + b1 * bx + b2 * cx, b0 * ay + b1 * by + b2 * cy, b0 * az + b1 * bz + b2 * cz
    if lit.has_normals[f]:
        ux, uy, uz = along(lit.normal, table[4] + i, table[5], table[6], t)
        vx, vy, vz = along(lit.normal, table[4] + j, table[5], table[6], t)
        wx, wy, wz = along(lit.normal, table[4] + k, table[5], table[6], t)
        nx, ny, nz = b0 * ux + b1 * vx + b2 * wx, b0 * uy + b1 * vy + b2 * wy, b0 * uz + b1 * vz + b2 * wz
    else:
        bx, by, bz, cx, cy, cz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
        nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    turn = side * lit.handedness
    nx, ny, nz = unit(nx * turn, ny * turn, nz * turn)
    red, green, blue = lit.ambient[0], lit.ambient[1], lit.ambient[2]
    for m in range(len(lit.kind)):
        lx, ly, lz = along(lit.path, lit.track[m, 0], 1, lit.track[m, 1], t)
        share = 1.0
        if lit.kind[m] == DIRECTIONAL:
            tx, ty, tz = unit(-lx, -ly, -lz)
        else:
            tx, ty, tz = lx - px, ly - py, lz - pz
            square = tx * tx + ty * ty + tz * tz
            if square == 0:
                continue
            length = np.sqrt(square)
            tx, ty, tz, share = tx / length, ty / length, tz / length, 1 / square
        if lit.kind[m] == SPOT:
            gx, gy, gz = along(lit.path, lit.track[m, 2], 1, lit.track[m, 3], t)
            gx, gy, gz = unit(gx - lx, gy - ly, gz - lz)
            cosine = -(gx * tx + gy * ty + gz * tz)
            inner, outer = lit.cosines[m, 0], lit.cosines[m, 1]
            if inner > outer:
                share *= min(max((cosine - outer) / (inner - outer), 0.0), 1.0) ** 2
            elif not cosine >= outer:
                share = 0.0
        share *= max(nx * tx + ny * ty + nz * tz, 0.0) / math.pi
        if share > 0 and lit.blockers.casts[m]:
            light = (lx, ly, lz), lit.kind[m] == DIRECTIONAL
            share *= shadow_rays.reaching(lit.blockers, light, (px, py, pz), t, f)
        red += share * lit.power[m, 0]
        green += share * lit.power[m, 1]
        blue += share * lit.power[m, 2]
    return red, green, blue
