"""How much of a light reaches a point at an instant past a few casters, compiled: each of them is looked at.

Before: jit.py, casters.py.  After: lambert.py.
Symbols: C casters, X the point, L the place of a light or d the way that it travels; n_ij, e_ij as in blocking.py,
whose tests these are, for degree 0.
Source: as blocking.py.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchblur.cpu.jit import jit
from torchblur.surfaces import Surfaces

MOST = 512  # casters, slices of time counted, up to which all are looked at
NOISE = 1e-14  # of the product of the factors' sizes


class Blockers(NamedTuple):
    """What may come between lights and points."""

    world: np.ndarray  # (C, 2, 3, 3) float64: start and end of the slice, corner, x y z
    times: np.ndarray  # (C, 2) float64
    face: np.ndarray  # (C,) int64
    opacity: np.ndarray  # (C,) float64
    gap: float  # share of coordinates that a caster must be away from what it blocks
    casts: np.ndarray  # (L,) bool: whether each light casts shadows


def can_look_at_all(surfaces: Surfaces) -> bool:
    """Return whether casters are none, or few of even opacity. Source: ours."""
    casters = surfaces.casters
    if casters is None:
        return True
    return casters.count <= MOST and not bool(surfaces.has_varying_opacity[casters.face].any())


def find_blockers(surfaces: Surfaces) -> Blockers:
    """Return the casters of a scene; none where there are more than are looked at. Source: ours."""
    casts = np.array([light.casts_shadows for light in surfaces.lights], dtype=np.bool_)
    casters = surfaces.casters
    if casters is None or not can_look_at_all(surfaces):
        none = np.zeros(0)
        return Blockers(none.reshape(0, 2, 3, 3), none.reshape(0, 2), none.astype(np.int64), none, 0.0, casts)
    times = np.stack([casters.t_open.numpy(), casters.t_close.numpy()], axis=1)
    world = np.ascontiguousarray(casters.world.numpy().transpose(3, 0, 1, 2))
    opacity = surfaces.opacity.detach()[casters.face].numpy()
    return Blockers(world, times, casters.face.numpy(), opacity, casters.gap, casts)


@jit
def cross(a, b):
    """Return the cross product of vectors; swapped, to the bit its negative."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@jit
def dot(a, b):
    """Return the scalar product of vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def minus(a, b):
    """Return the difference of vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@jit
def largest(a):
    """Return the largest coordinate of a vector."""
    return max(abs(a[0]), abs(a[1]), abs(a[2]))


@jit
def edge_side(value, noise, normal):
    """Return +1 or -1: the sign of an edge's e, or if it is 0 but for rounding of the first slope that is not; or 0."""
    if abs(value) > noise:
        return np.sign(value)
    for k in range(3):
        if normal[k] != 0:
            return np.sign(normal[k])
    return 0.0


@jit
def reaching(blockers, light, point, t, f):
    """Return the share of a light that reaches a point on face `f` at shutter time `t`; `light` is its place, or where
    it travels to if it is directional.
    """
    place, is_directional = light
    share = 1.0
    for c in range(len(blockers.face)):
        start, end = blockers.times[c, 0], blockers.times[c, 1]
        if t < start or (t >= end and end != 1) or blockers.face[c] == f:
            continue
        u = (t - start) / (end - start)
        corners = corner_at(blockers, c, 0, u), corner_at(blockers, c, 1, u), corner_at(blockers, c, 2, u)
        size = max(largest(corners[0]), largest(corners[1]), largest(corners[2]))
        away = blockers.gap * max(size, largest(point))
        if is_directional:
            is_blocked = blocks_way(place, point, corners, away)
        else:
            is_blocked = blocks_place(place, point, corners, away)
        if is_blocked:
            share *= 1 - blockers.opacity[c]
            if share <= 0:
                return 0.0
    return share


@jit
def corner_at(blockers, c, i, u):
    """Return x, y, z of corner `i` of caster `c` at part time `u`."""
    keep, world = 1 - u, blockers.world
    return (
        keep * world[c, 0, i, 0] + u * world[c, 1, i, 0],
        keep * world[c, 0, i, 1] + u * world[c, 1, i, 1],
        keep * world[c, 0, i, 2] + u * world[c, 1, i, 2],
    )


@jit
def blocks_place(place, point, corners, away):
    """Return whether a triangle is between a light at a place and a point."""
    a, b, c = minus(corners[0], place), minus(corners[1], place), minus(corners[2], place)
    vector = minus(point, place)
    reach = NOISE * (largest(point) + largest(place))
    size_a, size_b, size_c = largest(a), largest(b), largest(c)
    noise_ab, noise_bc, noise_ca = reach * size_a * size_b, reach * size_b * size_c, reach * size_c * size_a
    ab, bc = cross(a, b), cross(b, c)
    e_ab, e_bc = dot(ab, vector), dot(bc, vector)
    side = edge_side(e_ab, noise_ab, ab)
    if side == 0 or edge_side(e_bc, noise_bc, bc) != side:
        return False
    ca = cross(c, a)
    e_ca = dot(ca, vector)
    if edge_side(e_ca, noise_ca, ca) != side:
        return False
    volume, volume_noise = dot(bc, a), NOISE * size_a * size_b * size_c
    if not side * volume > volume_noise:
        return False
    distance = np.sqrt(dot(vector, vector))
    bias = min(away / distance, 1.0)
    nearer = (1 - bias) * (e_ab + e_bc + e_ca) - volume
    return side * nearer > noise_ab + noise_bc + noise_ca + volume_noise


@jit
def blocks_way(way, point, corners, away):
    """Return whether a triangle is before a point on the way of a directional light."""
    a, b, c = corners
    speed, reach = NOISE * largest(way), largest(point)
    size_a, size_b, size_c = largest(a), largest(b), largest(c)
    side = 0.0
    for k in range(3):
        if k == 0:
            first, second, size_1, size_2 = a, b, size_a, size_b
        elif k == 1:
            first, second, size_1, size_2 = b, c, size_b, size_c
        else:
            first, second, size_1, size_2 = c, a, size_c, size_a
        normal = cross(way, minus(second, first))
        value = dot(normal, point) + dot(cross(first, second), way)
        own = edge_side(value, speed * (reach * (size_1 + size_2) + size_1 * size_2), normal)
        if own == 0 or (k > 0 and own != side):
            return False
        side = own
    ab, ac = minus(b, a), minus(c, a)
    area, length = cross(ab, ac), np.sqrt(dot(way, way))
    bias = away / length if length > 0 else away
    value = dot(area, minus(point, a)) - bias * dot(area, way)
    span = max(largest(ab), largest(ac))
    return side * value > NOISE * span * span * (reach + size_a)
