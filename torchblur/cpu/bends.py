"""When the looks of a span bend, one ray at a time: what texture_bends.py and light_bends.py say, compiled.

Before: receive.py, polynomials.py.  After: expose.py.
Symbols as in curves.py.
Source: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchblur.bernstein import MAX_HALVINGS
from torchblur.cpu.curves import CONE, LIT, MIPPED, SQUARE, TEXTURED, VARYING, Span, dot_of, square_of, squares
from torchblur.cpu.jit import inlined, inner
from torchblur.cpu.lambert import SPOT, Lit
from torchblur.cpu.layers import Looks
from torchblur.cpu.polynomials import MAX_DEGREE, roots_of, sort_few
from torchblur.cpu.receive import Shade
from torchblur.light_bends import FLAT
from torchblur.light_bends import NOISE as LIGHT_NOISE
from torchblur.texture_bends import NOISE as TEXTURE_NOISE

CHOOSE_2, CHOOSE_6 = np.array([1.0, 2, 1]), np.array([1.0, 6, 15, 20, 15, 6, 1])
CHOOSE_8 = np.array([1.0, 8, 28, 56, 70, 56, 28, 8, 1])

FEW = 32  # that are sorted by insertion


class Bends(NamedTuple):
    """Times at which a look may bend."""

    tau: np.ndarray  # (room,)
    room: np.ndarray  # of roots_of
    found: np.ndarray  # (MAX_DEGREE,)


@inner
def make_bends(n: int) -> Bends:
    """Return room for so many times."""
    return Bends(np.empty(n), np.empty((MAX_HALVINGS + 4, MAX_DEGREE + 3)), np.empty(MAX_DEGREE))


@inlined
def find_bends(span: Span, n_layers: int, scene: tuple[Looks, Lit], shade: Shade, bends: Bends) -> int:
    """Write the times inside a span at which its varying looks may bend or shadows begin or end, and its ends, in
    ascending order.

    Returns:
        How many there are, or minus how many there would be where there is no room for them.
    """
    looks, lit = scene
    tau = bends.tau
    tau[0], tau[1] = 0.0, 1.0
    count = 2
    for m in range(n_layers):
        flags = span.flags[m]
        if flags & LIT and shade.n_receivers > 0:
            for lamp in range(len(lit.kind)):
                for r in range(shade.first[lamp, span.receiver[m]], shade.first[lamp, span.receiver[m] + 1]):
                    count = _add(tau, count, shade.start[r])
                    count = _add(tau, count, shade.end[r])
        if not flags & VARYING:
            continue
        if flags & TEXTURED:
            count = _cross_lines(span, m, looks, tau, count)
            if flags & MIPPED:
                count = _cross_levels(span, m, bends, count)
        if flags & LIT:
            count = _cross_light(span, m, lit, bends, count)
    if count > len(tau):
        return -count
    if count > 2:
        if count > FEW:
            tau[:count].sort()
        else:
            sort_few(tau, count)
    return count


@inlined
def _add(tau: np.ndarray, count: int, value: float) -> int:
    """Add a time if it lies inside; where there is no room, only count it."""
    if not (value > 0.0 and value < 1.0):
        return count
    if count < len(tau):
        tau[count] = value
    return count + 1


@inlined
def _cross_lines(span: Span, m: int, looks: Looks, tau: np.ndarray, count: int) -> int:
    """Add the times at which a place on a texture crosses a line of texels."""
    mesh = looks.mesh_of[span.face[m]]
    s0, s1, s2 = span.scale[m, 0], span.scale[m, 1], span.scale[m, 2]
    is_proper = (s0 > 0 and s1 > 0 and s2 > 0) or (s0 < 0 and s1 < 0 and s2 < 0)
    for level in range(span.level[m, 0], span.level[m, 1] + 1):
        for axis in range(2):
            size = float(looks.size[level, axis, mesh])
            p0, p1, p2 = span.uv[m, axis, 0], span.uv[m, axis, 1], span.uv[m, axis, 2]
            low, high = span.corners[m, axis, 0], span.corners[m, axis, 1]
            if axis == 1:  # v runs up, rows down
                p0, p1, p2, low, high = s0 - p0, s1 - p1, s2 - p2, 1 - high, 1 - low
            p0, p1, p2 = p0 * size - 0.5 * s0, p1 * size - 0.5 * s1, p2 * size - 0.5 * s2
            low, high = low * size - 0.5, high * size - 0.5
            if not looks.repeats[mesh]:
                low, high = max(low, 0.0), min(high, size - 1)
            if is_proper:
                r0, r1, r2 = p0 / s0, p1 / s1, p2 / s2
                low, high = max(low, min(r0, r1, r2)), min(high, max(r0, r1, r2))
            first = np.ceil(low)
            for k in range(int(high - first) + 1 if first <= high else 0):  # of huge ones the next may be the same
                line = first + k
                c0, c1, c2 = p0 - line * s0, p1 - line * s1, p2 - line * s2
                h, bend = c1 - c0, c0 - 2 * c1 + c2
                square = h * h - bend * c0
                if square >= 0:
                    q = -(h + np.copysign(np.sqrt(square), h))
                    count = _add(tau, count, q / bend)
                    count = _add(tau, count, c0 / q)
    return count


@inner
def _add_roots(bends: Bends, n: int, noise: float, count: int) -> int:
    """Add the roots of the polynomial of `n` coefficients in the first row of the room."""
    for k in range(roots_of(bends.room, n, noise, bends.found)):
        count = _add(bends.tau, count, bends.found[k])
    return count


@inlined
def _cross_levels(span: Span, m: int, bends: Bends, count: int) -> int:
    """Add the times at which the level of lookups is a whole number."""
    squares(span, m)
    for level in range(span.level[m, 0], span.level[m, 1] + 1):
        largest = 0.0
        for k in range(9):
            bends.room[0, k] = span.room[SQUARE, k] - 4.0**level * span.room[SQUARE + 1, k]
            largest = max(largest, abs(bends.room[0, k]))
        count = _add_roots(bends, 9, TEXTURE_NOISE * largest, count)
    return count


@inlined
def _largest(vector: np.ndarray) -> float:
    """Return the size of the largest coefficient of (3, 4)."""
    out = 0.0
    for d in range(3):
        for k in range(4):
            out = max(out, abs(vector[d, k]))
    return out


@inlined
def _cross_light(span: Span, m: int, lit: Lit, bends: Bends, count: int) -> int:
    """Add the times at which the surface turns to or from a lamp, or passes the borders of a spot's cone."""
    normal = span.normal[m]
    of_normal = _largest(normal)
    for lamp in range(len(lit.kind)):
        vector = span.vector[m, lamp]
        of_vector = _largest(vector)
        dot_of(normal, vector, bends.room[0])
        count = _add_roots(bends, 7, LIGHT_NOISE * of_normal * of_vector, count)
        if lit.kind[lamp] != SPOT:
            continue
        inner, outer = lit.cosines[lamp, 0], lit.cosines[lamp, 1]
        count = _cross_cone(span, m, lamp, inner, (bends, count))
        if outer != inner:
            count = _cross_cone(span, m, lamp, outer, (bends, count))
    return count


@inlined
def _cross_cone(span: Span, m: int, lamp: int, cosine: float, to: tuple[Bends, int]) -> int:
    """Add the times at which the point crosses a cone: roots of (V A)^2 - cosine^2 V^2 A^2, or of V A for a plane."""
    bends, count = to
    vector, axis = span.vector[m, lamp], span.axis[lamp]
    room, square, half = bends.room[0], span.room[SQUARE], span.quartic[:, 0]
    largest = 0.0
    for k in range(5):
        half[k] = 0.0
    for k in range(3):
        square[k] = 0.0
    for d in range(3):
        a, b = axis[d, 0], axis[d, 1]
        largest = max(largest, abs(a), abs(b))
        square[0] += a * a
        square[1] += a * b
        square[2] += b * b
        for k in range(4):
            half[k] += (4 - k) / 4 * vector[d, k] * a
            half[k + 1] += (k + 1) / 4 * vector[d, k] * b
    noise = LIGHT_NOISE * (_largest(vector) * largest) ** 2
    if not cosine > FLAT:
        for k in range(5):
            room[k] = half[k]
        return _add_roots(bends, 5, np.sqrt(noise), count)
    rest = span.room[CONE]
    dot_of(vector, vector, rest)
    square_of(span.quartic, 1, 1.0, room)
    for k in range(7):
        for j in range(3):
            share = CHOOSE_6[k] * CHOOSE_2[j] / CHOOSE_8[k + j]
            room[k + j] -= cosine * cosine * share * rest[k] * square[j]
    return _add_roots(bends, 9, noise, count)
