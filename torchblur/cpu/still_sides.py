"""What sides.py tells of a pair, where the light and the receiver rest and only the caster moves: of degree 3, not 5.

Before: sides.py.  After: blocked.py.
Symbols: as in blocking.py, with S = 1.
Source: as blocking.py.
"""

from __future__ import annotations

import numpy as np

from torchblur.blocking import NOISE
from torchblur.cpu.jit import inlined, jit
from torchblur.cpu.sides import FIRST, along, corners_at, cross_linear, dot_2_1, is_excluded, largest, largest_corner

N_COEFFICIENTS = 4


@jit
def still_polynomials(pair, shared, arrays, room):
    """Write the polynomials of a pair (receiver, caster) over the time that they share to `room`, as
    `sides.polynomials` does, of N_COEFFICIENTS each.
    """
    r, c = pair
    (place, scale, _, _), (world, slices, gap, _), (shines, is_directional, _) = arrays
    (p, _), corner, lamp, (signs, noise), scratch = room
    for d in range(3):
        p[0, d] = place[r, 0, d] / scale[r, 0]
    corners_at(world[c], slices[c], shared, corner)
    along(shines, shared[0], lamp[0])
    out = signs[0], noise
    if is_directional:
        return _along_direction(corner, lamp[0], (p[0], gap), scratch, out)
    return _from_position(corner, lamp[0], (p[0], gap), scratch, out)


@inlined
def _dot_2(a, b, out):
    """Write the dot product of vectors of degree 2, (3, 3), and 0, (3,), to `out` (4,), as degree 3."""
    first = a[0, 0] * b[0] + a[0, 1] * b[1] + a[0, 2] * b[2]
    middle = a[1, 0] * b[0] + a[1, 1] * b[1] + a[1, 2] * b[2]
    last = a[2, 0] * b[0] + a[2, 1] * b[1] + a[2, 2] * b[2]
    out[0], out[1], out[2], out[3] = first, (first + 2 * middle) / 3, (2 * middle + last) / 3, last


@jit
def _from_position(corner, lamp, point, scratch, out):
    """Write the polynomials of a lamp at a place, and their rounding, to `out`; return how many, 0 if excluded."""
    x, gap = point
    normals, vector, _, _, _ = scratch
    signs, noise = out
    away, way, square = largest_corner(corner), vector[0], 0.0
    reach_x, reach_lamp = 0.0, 0.0
    for d in range(3):
        reach_x, reach_lamp = max(reach_x, abs(x[d])), max(reach_lamp, abs(lamp[d]))
        way[d] = x[d] - lamp[d]
        square += way[d] ** 2
        for i in range(3):
            corner[0, i, d] -= lamp[d]
            corner[1, i, d] -= lamp[d]
    size0, size1, size2 = largest(corner[:, 0]), largest(corner[:, 1]), largest(corner[:, 2])
    sizes = size0 * size1, size1 * size2, size2 * size0
    for e in range(3):
        i, j = e, FIRST[e]
        cross_linear(corner[0, i], corner[1, i], corner[0, j], corner[1, j], normals[e])
        _dot_2(normals[e], way, signs[e])
        noise[e] = NOISE * (reach_x + reach_lamp) * sizes[e]
        if e > 0 and is_excluded(signs, noise, e + 1, N_COEFFICIENTS):
            return 0
    dot_2_1(normals[1], corner[0, 0], corner[1, 0], signs[3])
    bias = min(gap * max(away, reach_x) / np.sqrt(square), 1.0) if square > 0 else 1.0
    for k in range(N_COEFFICIENTS):
        signs[4, k] = (1 - bias) * (signs[0, k] + signs[1, k] + signs[2, k]) - signs[3, k]
    noise[3] = NOISE * size0 * size1 * size2
    noise[4] = noise[0] + noise[1] + noise[2] + noise[3]
    return 5


@jit
def _along_direction(corner, way, point, scratch, out):
    """Write the polynomials of a direction, and their rounding, to `out`; return how many, 0 if excluded."""
    x, gap = point
    normals, moved, side, rest, area = scratch
    signs, noise = out
    away, reach, speed, square, span = largest_corner(corner), 0.0, 0.0, 0.0, 0.0
    for d in range(3):
        reach, speed = max(reach, abs(x[d])), max(speed, abs(way[d]))
        square += way[d] ** 2
    size = largest(corner[:, 0]), largest(corner[:, 1]), largest(corner[:, 2])
    constant = rest[0, 0]
    for e in range(3):
        i, j = e, FIRST[e]
        for a in range(2):
            for d in range(3):
                side[a, d] = corner[a, j, d] - corner[a, i, d]
                span = max(span, abs(side[a, d]))
        cross_linear(way, way, side[0], side[1], normals[e])
        cross_linear(corner[0, i], corner[1, i], corner[0, j], corner[1, j], area)
        _dot_2(normals[e], x, signs[e])
        _dot_2(area, way, constant)
        for k in range(N_COEFFICIENTS):
            signs[e, k] += constant[k]
        noise[e] = NOISE * speed * (reach * (size[i] + size[j]) + size[i] * size[j])
        if e > 0 and is_excluded(signs, noise, e + 1, N_COEFFICIENTS):
            return 0
    first, second = rest[1], rest[2]
    for d in range(3):
        for a in range(2):
            first[a, d], second[a, d] = corner[a, 1, d] - corner[a, 0, d], corner[a, 2, d] - corner[a, 0, d]
            moved[a, d] = x[d] - corner[a, 0, d]
    cross_linear(first[0], first[1], second[0], second[1], area)
    dot_2_1(area, moved[0], moved[1], signs[3])
    _dot_2(area, way, constant)
    bias = gap * max(away, reach) / np.sqrt(square) if square > 0 else gap * max(away, reach)
    for k in range(N_COEFFICIENTS):
        signs[3, k] -= bias * constant[k]
    noise[3] = NOISE * span * span * (reach + size[0])
    return 4
