"""When a caster blocks a light for a receiver, compiled: the exact times of a pair.

Before: still_sides.py, polynomials.py, shadow_rays.py.  After: join.py.
Symbols: as in blocking.py, whose rules these are: of signs, of what is rounding, and of edges that are hit.
Source: as blocking.py.
"""

from __future__ import annotations

import numpy as np

from torchblur.bernstein import MAX_HALVINGS
from torchblur.cpu.jit import inlined, jit
from torchblur.cpu.polynomials import MAX_DEGREE, roots_of
from torchblur.cpu.shadow_rays import blocks_place, blocks_way
from torchblur.cpu.sides import along, polynomials, scratch_room
from torchblur.cpu.sieve import may_be_alike
from torchblur.cpu.still_sides import still_polynomials
from torchblur.sort import SAME_TIME

MOST_TIMES = 5 * MAX_DEGREE + 2  # at which one of the signs may change, and both ends
MOST_PIECES = MOST_TIMES // 2 + 1


def work_room():
    """Return what `find_blocked` works in; the first of it, (MOST_PIECES, 2), are its results."""
    solver = np.empty((MAX_HALVINGS + 4, MAX_DEGREE + 3)), np.empty(MAX_DEGREE), np.empty(MOST_TIMES)
    return np.empty((MOST_PIECES, 2)), scratch_room(), solver


@inlined
def find_blocked(pair, shared, arrays, room):
    """Write when a caster blocks the light, as shares (start, end) of the receiver's slice, to the first of `room`, and
    return how many pieces these are. An instant is blocked from 0 to 1.

    Args:
        pair: receiver and caster.
        shared: when the part of the time that they share begins and ends which is looked at, and both as shares of the
            receiver's slice.
        arrays: of `sides.arrays_of`.
        room: of `work_room`.
    """
    r, c = pair
    pieces, scratch, solver = room
    (place, _, _, rests), caster, (_, _, light_rests) = arrays
    _, _, low, high = shared
    signs, noise = scratch[3]
    if place.shape[1] > 1 and not (light_rests and rests[r]):
        degree, n_signs = 5, polynomials(pair, shared, arrays, scratch)
    elif place.shape[1] > 1 and not caster[3][c]:
        degree, n_signs = 3, still_polynomials(pair, shared, arrays, scratch)
    else:
        pieces[0, 0], pieces[0, 1] = low, high
        return 1 if _is_blocked_at(pair, shared[0], arrays, scratch) else 0
    if n_signs == 0 or not may_be_alike(signs, noise, n_signs, degree + 1):
        return 0
    n = _pieces(signs[0], (noise, n_signs, degree, scratch[4][0]), solver, pieces)
    for k in range(n):
        pieces[k, 0] = low + pieces[k, 0] * (high - low)
        pieces[k, 1] = high if pieces[k, 1] == 1 else low + pieces[k, 1] * (high - low)
    return n


@jit
def _is_blocked_at(pair, t, arrays, scratch):
    """Return whether a caster blocks the light for a receiver that rests, at a shutter time."""
    r, c = pair
    (place, scale, _, _), (world, slices, gap, _), (shines, is_directional, _) = arrays
    lamp = scratch[2][0]
    along(shines, t, lamp)
    s, u = scale[r, 0], (t - slices[c, 0]) / (slices[c, 1] - slices[c, 0])
    point = place[r, 0, 0] / s, place[r, 0, 1] / s, place[r, 0, 2] / s
    corners = _corner(world[c], 0, u), _corner(world[c], 1, u), _corner(world[c], 2, u)
    size = 0.0
    for d in range(3):
        size = max(size, abs(corners[0][d]), abs(corners[1][d]), abs(corners[2][d]), abs(point[d]))
    shines_from = lamp[0], lamp[1], lamp[2]
    if is_directional:
        return blocks_way(shines_from, point, corners, gap * size)
    return blocks_place(shines_from, point, corners, gap * size)


@inlined
def _corner(world, i, u):
    """Return x, y, z of a corner at part time `u`."""
    v = 1 - u
    return (
        v * world[0, i, 0] + u * world[1, i, 0],
        v * world[0, i, 1] + u * world[1, i, 1],
        v * world[0, i, 2] + u * world[1, i, 2],
    )


@jit
def _pieces(signs, more, solver, pieces):
    """Write when all signs (5, 6) are alike to `pieces`, in order, those that touch made one; return how many."""
    noise, n_signs, degree, _ = more
    room, found, times = solver
    times[0], n = 0.0, 1
    for q in range(n_signs):
        for k in range(degree + 1):
            room[0, k] = signs[q, k]
        for k in range(roots_of(room, degree + 1, noise[q], found)):
            place = n
            while place > 1 and times[place - 1] > found[k]:
                times[place] = times[place - 1]
                place -= 1
            times[place] = found[k]
            n += 1
    times[n] = 1.0
    count = 0
    for k in range(n):
        start, end = times[k], times[k + 1]
        if not end - start > SAME_TIME or not _are_alike(signs, more, 0.5 * (start + end)):
            continue
        if count > 0 and start - pieces[count - 1, 1] <= SAME_TIME:
            pieces[count - 1, 1] = end
        else:
            pieces[count, 0], pieces[count, 1] = start, end
            count += 1
    return count


@inlined
def _are_alike(signs, more, u):
    """Return whether all signs (5, 6) are alike at a share of the time."""
    noise, n_signs, degree, normals = more
    side, v = 0.0, 1 - u
    for q in range(n_signs):
        a, b, c, d = signs[q, 0], signs[q, 1], signs[q, 2], signs[q, 3]
        if degree == 5:
            e, f = signs[q, 4], signs[q, 5]
            a, b, c, d, e = v * a + u * b, v * b + u * c, v * c + u * d, v * d + u * e, v * e + u * f
            a, b, c, d = v * a + u * b, v * b + u * c, v * c + u * d, v * d + u * e
        a, b, c = v * a + u * b, v * b + u * c, v * c + u * d
        a, b = v * a + u * b, v * b + u * c
        value = v * a + u * b
        own = 0.0
        if abs(value) > noise[q]:
            own = np.sign(value)
        elif q < 3:
            for axis in range(3):
                a, b, c = normals[q, 0, axis], normals[q, 1, axis], normals[q, 2, axis]
                slope = v * (v * a + u * b) + u * (v * b + u * c)
                if slope != 0:
                    own = np.sign(slope)
                    break
        if own == 0 or (q > 0 and own != side):
            return False
        side = own
    return True
