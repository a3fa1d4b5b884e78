"""The polynomials whose signs tell when a caster blocks a light for a receiver, compiled, a pair at a time.

Before: jit.py, blocking.py.  After: still_sides.py, blocked.py.
Symbols: as in blocking.py, whose polynomials these are, all as degree 5.
Source: as blocking.py.
"""

from __future__ import annotations

import numpy as np
import torch

from torchblur.blocking import HALVINGS, NOISE, Receivers
from torchblur.casters import Casters
from torchblur.cpu.jit import inlined, jit
from torchblur.lights import DirectionalLight, Light

N_COEFFICIENTS = 6
FIVE_OF_2_3 = np.array([[1.0, 0.6, 0.3, 0.1, 0.0, 0.0], [0.0, 0.4, 0.6, 0.6, 0.4, 0.0], [0.0, 0.0, 0.1, 0.3, 0.6, 1.0]])
FIRST, SECOND = np.array([1, 2, 0]), np.array([2, 0, 1])  # of a cross product; also the corners of the edges


def arrays_of(light: Light, receivers: Receivers, casters: Casters) -> tuple[tuple, tuple, tuple]:
    """Return what is read of receivers, casters and a light; each thing's numbers lie side by side. Source: ours.

    Returns:
        place (K, 4 or 1, 3), scale (K, 3 or 1) and times (K, 2) of the receivers, and whether each rests (K,); corners
        (C, 2, 3, 3) and times (C, 2) of the casters, the gap, and whether each rests (C,); knots of the light (n, 3),
        whether it is directional, and whether it rests.
    """
    is_directional = isinstance(light, DirectionalLight)
    shines = (light.direction if is_directional else light.position).detach().to(torch.float64).reshape(-1, 3)
    thing = [a.contiguous().numpy() for a in (receivers.place.permute(2, 0, 1), receivers.scale.T, receivers.t.T)]
    slices = torch.stack([casters.t_open, casters.t_close], dim=1)
    world = casters.world.permute(3, 0, 1, 2).contiguous()
    stays = (casters.world[0] == casters.world[1]).all(0).all(0)
    of_light = shines.contiguous().numpy(), is_directional, bool((shines == shines[0]).all())
    return (
        (*thing, receivers.rests.contiguous().numpy()),
        (world.numpy(), slices.numpy(), casters.gap, stays.numpy()),
        of_light,
    )


def scratch_room():
    """Return what `polynomials` works in: the first of the signs, (6 levels, 5, 6), and the noise (5,) are its result,
    with the normals of the edges (3, 3, 3).
    """
    point = np.empty((4, 3)), np.empty(3)
    work = np.empty((3, 3, 3)), np.empty((4, 3)), np.empty((3, 3)), np.empty((3, 2, 4)), np.empty((3, 3))
    return point, np.empty((2, 3, 3)), np.empty((2, 3)), (np.empty((HALVINGS + 1, 5, 6)), np.empty(5)), work


@inlined
def shared_time(pair, arrays):
    """Return when a pair (receiver, caster) begins and ends to share time, and both as shares of the receiver's."""
    times, slices = arrays[0][2], arrays[1][1]
    r, c = pair
    t_start, t_end = max(times[r, 0], slices[c, 0]), min(times[r, 1], slices[c, 1])
    length = times[r, 1] - times[r, 0]
    if length == 0:
        return t_start, t_start, 0.0, 1.0
    u_end = 1.0 if t_end == times[r, 1] else (t_end - times[r, 0]) / length
    return t_start, t_end, (t_start - times[r, 0]) / length, u_end


@jit
def polynomials(pair, shared, arrays, room):
    """Write the polynomials of a pair (receiver, caster) over the time that they share to `room`; return how many, 0
    where their signs show that it never blocks.
    """
    r, c = pair
    (place, scale, _, _), (world, slices, gap, _), (shines, is_directional, _) = arrays
    (p, s), corner, lamp, (signs, noise), scratch = room
    t_start, t_end, u_start, u_end = shared
    p[:] = place[r]
    s[:] = scale[r]
    if u_start > 0 or u_end < 1:
        for d in range(3):
            _restrict(p[:, d], u_start, u_end)
        _restrict(s, u_start, u_end)
    corners_at(world[c], slices[c], shared, corner)
    along(shines, t_start, lamp[0])
    along(shines, t_end, lamp[1])
    if is_directional:
        return _along_direction(corner, lamp, (p, s, gap), scratch, (signs[0], noise))
    return _from_position(corner, lamp, (p, s, gap), scratch, (signs[0], noise))


@inlined
def corners_at(world, times, shared, out):
    """Write the corners of a caster, (2, 3, 3) at its own `times`, when it begins and ends to share time to `out`."""
    for e in range(2):
        u = (shared[e] - times[0]) / (times[1] - times[0])
        for i in range(3):
            for d in range(3):
                out[e, i, d] = (1 - u) * world[0, i, d] + u * world[1, i, d]


@inlined
def along(knots, t, out):
    """Write the value of knots (n, 3) at the shutter time `t` to `out` (3,)."""
    last = len(knots) - 1
    k = min(max(int(t * last), 0), max(last - 1, 0))
    u = t * last - k
    for d in range(3):
        out[d] = knots[0, d] if last == 0 else (1 - u) * knots[k, d] + u * knots[k + 1, d]


@inlined
def _restrict(c, start, end):
    """Turn Bernstein coefficients (n,) into those on [start, end]."""
    n = len(c)
    for m in range(n - 1, 0, -1):  # the part before `end`
        for i in range(n - 1, n - 1 - m, -1):
            c[i] = (1 - end) * c[i - 1] + end * c[i]
    share = start / end
    for m in range(n - 1, 0, -1):  # and of it the part after `start`
        for i in range(m):
            c[i] = (1 - share) * c[i] + share * c[i + 1]


@inlined
def cross_linear(a0, a1, b0, b1, out):
    """Write the coefficients (3, 3) of the cross product of linear vectors to `out`."""
    for d in range(3):
        i, j = FIRST[d], SECOND[d]
        out[0, d] = a0[i] * b0[j] - a0[j] * b0[i]
        out[1, d] = 0.5 * ((a0[i] * b1[j] - a0[j] * b1[i]) + (a1[i] * b0[j] - a1[j] * b0[i]))
        out[2, d] = a1[i] * b1[j] - a1[j] * b1[i]


@inlined
def _add_dot_2_3(a, b, sign, out):
    """Add the dot products of vectors of degree 2, (3, 3), and 3, (4, 3), to `out` (6,), `sign` times."""
    for i in range(3):
        for j in range(4):
            dot = a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]
            out[i + j] += sign * FIVE_OF_2_3[i, i + j] * dot


@inlined
def _add_2_3(a, b, sign, out):
    """Add the product of polynomials of degree 2, (3,), and 3, (4,), to `out` (6,), `sign` times."""
    for i in range(3):
        for j in range(4):
            out[i + j] += sign * FIVE_OF_2_3[i, i + j] * a[i] * b[j]


@inlined
def dot_2_1(a, b0, b1, out):
    """Write the dot product of vectors of degree 2, (3, 3), and 1 to `out` (4,)."""
    out[:] = 0.0
    for i in range(3):
        first = a[i, 0] * b0[0] + a[i, 1] * b0[1] + a[i, 2] * b0[2]
        last = a[i, 0] * b1[0] + a[i, 1] * b1[1] + a[i, 2] * b1[2]
        out[i] += first * (3 - i) / 3
        out[i + 1] += last * (i + 1) / 3


@inlined
def largest(rows):
    """Return the greatest absolute value of rows (n, 3)."""
    out = 0.0
    for i in range(len(rows)):
        for d in range(3):
            out = max(out, abs(rows[i, d]))
    return out


@inlined
def largest_corner(corner):
    """Return the greatest absolute value of corners (2, 3, 3)."""
    return max(largest(corner[0]), largest(corner[1]))


@jit
def _from_position(corner, lamp, point, scratch, out):
    """Write the polynomials of a lamp at a place, and their rounding, to `out`; return how many, 0 if excluded."""
    p, s, gap = point
    normals, vector, _, rest, _ = scratch
    signs, noise = out
    size = largest_corner(corner)
    reach = largest(p) + max(s[0], s[1], s[2]) * largest(lamp)
    for d in range(3):
        vector[0, d] = p[0, d] - s[0] * lamp[0, d]
        vector[1, d] = p[1, d] - (s[0] * lamp[1, d] + 2 * s[1] * lamp[0, d]) / 3
        vector[2, d] = p[2, d] - (2 * s[1] * lamp[1, d] + s[2] * lamp[0, d]) / 3
        vector[3, d] = p[3, d] - s[2] * lamp[1, d]
        for i in range(3):
            corner[0, i, d] -= lamp[0, d]
            corner[1, i, d] -= lamp[1, d]
    size0, size1, size2 = largest(corner[:, 0]), largest(corner[:, 1]), largest(corner[:, 2])
    sizes = size0 * size1, size1 * size2, size2 * size0
    signs[:] = 0.0
    volume = rest[0, 0]
    for e in range(3):
        i, j, normal = e, FIRST[e], normals[e]
        cross_linear(corner[0, i], corner[1, i], corner[0, j], corner[1, j], normal)
        _add_dot_2_3(normal, vector, 1.0, signs[e])
        if e == 1:
            dot_2_1(normal, corner[0, 0], corner[1, 0], volume)
        noise[e] = NOISE * reach * sizes[e]
        if e > 0 and is_excluded(signs, noise, e + 1, N_COEFFICIENTS):
            return 0
    scale, away, square = (s[0] + s[1] + s[2]) / 3, 0.0, 0.0
    for d in range(3):
        away = max(away, abs(p[0, d] + p[1, d] + p[2, d] + p[3, d]) / 4)
        square += ((vector[0, d] + vector[1, d] + vector[2, d] + vector[3, d]) / 4) ** 2
    away = gap * max(size, away / scale)
    distance = np.sqrt(square) / scale
    bias = min(away / distance, 1.0) if distance > 0 else 1.0
    for k in range(6):
        signs[4, k] = (1 - bias) * (signs[0, k] + signs[1, k] + signs[2, k])
    _add_2_3(s, volume, -1.0, signs[4])
    signs[3, 0], signs[3, 5] = volume[0], volume[3]  # degree 3 as degree 5
    signs[3, 1] = 0.4 * volume[0] + 0.6 * volume[1]
    signs[3, 2] = 0.1 * volume[0] + 0.6 * volume[1] + 0.3 * volume[2]
    signs[3, 3] = 0.3 * volume[1] + 0.6 * volume[2] + 0.1 * volume[3]
    signs[3, 4] = 0.6 * volume[2] + 0.4 * volume[3]
    noise[3] = NOISE * size0 * size1 * size2
    noise[4] = noise[0] + noise[1] + noise[2] + max(s[0], s[1], s[2]) * noise[3]
    return 5


@jit
def _along_direction(corner, way, point, scratch, out):
    """Write the polynomials of a direction, and their rounding, to `out`; return how many, 0 if excluded."""
    p, s, gap = point
    normals, vector, side, rest, area = scratch
    signs, noise = out
    scale, away, square, span = (s[0] + s[1] + s[2]) / 3, 0.0, 0.0, 0.0
    for d in range(3):
        away = max(away, abs(p[0, d] + p[1, d] + p[2, d] + p[3, d]) / 4)
        square += (0.5 * (way[0, d] + way[1, d])) ** 2
    away = gap * max(largest_corner(corner), away / scale)
    reach, speed, widest = largest(p), largest(way), max(s[0], s[1], s[2])
    size = largest(corner[:, 0]), largest(corner[:, 1]), largest(corner[:, 2])
    signs[:] = 0.0
    constant = rest[0, 0]
    for e in range(3):
        i, j, normal = e, FIRST[e], normals[e]
        for a in range(2):
            for d in range(3):
                side[a, d] = corner[a, j, d] - corner[a, i, d]
                span = max(span, abs(side[a, d]))
        cross_linear(way[0], way[1], side[0], side[1], normal)
        _add_dot_2_3(normal, p, 1.0, signs[e])
        cross_linear(corner[0, i], corner[1, i], corner[0, j], corner[1, j], area)
        dot_2_1(area, way[0], way[1], constant)
        _add_2_3(s, constant, 1.0, signs[e])
        noise[e] = NOISE * speed * (reach * (size[i] + size[j]) + widest * size[i] * size[j])
        if e > 0 and is_excluded(signs, noise, e + 1, N_COEFFICIENTS):
            return 0
    first, second = rest[1], rest[2]
    for d in range(3):
        for a in range(2):
            first[a, d], second[a, d] = corner[a, 1, d] - corner[a, 0, d], corner[a, 2, d] - corner[a, 0, d]
        vector[0, d] = p[0, d] - s[0] * corner[0, 0, d]
        vector[1, d] = p[1, d] - (s[0] * corner[1, 0, d] + 2 * s[1] * corner[0, 0, d]) / 3
        vector[2, d] = p[2, d] - (2 * s[1] * corner[1, 0, d] + s[2] * corner[0, 0, d]) / 3
        vector[3, d] = p[3, d] - s[2] * corner[1, 0, d]
    cross_linear(first[0], first[1], second[0], second[1], area)
    _add_dot_2_3(area, vector, 1.0, signs[3])
    dot_2_1(area, way[0], way[1], constant)
    length = np.sqrt(square)
    _add_2_3(s, constant, -away / (length if length > 0 else 1.0), signs[3])
    noise[3] = NOISE * span * span * (reach + widest * size[0])
    return 4


@inlined
def is_excluded(signs, noise, n_signs, n):
    """Return whether the `n` coefficients of the first of `signs` (5, 6), of edges, show that no time has one sign."""
    can_be_up, can_be_down = True, True
    for q in range(n_signs):
        low, high = signs[q, 0], signs[q, 0]
        for k in range(1, n):
            low, high = min(low, signs[q, k]), max(high, signs[q, k])
        can_be_up &= high >= -noise[q]
        can_be_down &= low <= noise[q]
    return not (can_be_up or can_be_down)
