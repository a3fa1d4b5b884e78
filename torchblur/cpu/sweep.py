"""Cut a ray's time into cells, one ray at a time: what cells.py does for many at once.

Before: polynomials.py.  After: tiles.py.
Symbols: n intervals of a ray in order of their starts; rows of `data` hold t_start, t_end, the Bernstein coefficients
of M and D (see intervals.py), and the least and greatest nearness. A pair is certain until a time: up to then its
order is known not to change.
Arrays are looked up once, not inside loops: each look at one in a tuple counts a reference, which costs more than the
arithmetic.
Source: Ronnow et al. 2021, alg. 1 (the event sweep); order at midpoints and certificates as in cells.py; keeping
certificates from cell to cell: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchblur.bernstein import MAX_HALVINGS
from torchblur.cells import CROSSING_NOISE
from torchblur.cpu.jit import inlined, inner
from torchblur.cpu.polynomials import MAX_DEGREE, cubic_at, restrict_cubic, roots_of, sort_by
from torchblur.sort import TIE

T_START, T_END, NUM, DEN, LOW, HIGH, N_NUMBERS = 0, 1, 2, 6, 10, 11, 12
PRISM, RANK, IS_OPAQUE, UPPER, N_MARKS = 0, 1, 2, 3, 4
N_CROSSING = 7  # coefficients of a difference of two nearnesses
NO_ROOM = -1
MANY = 64  # intervals that start at once


class Ray(NamedTuple):
    """The intervals of one ray, and room to sweep over them."""

    data: np.ndarray  # (room, N_NUMBERS)
    mark: np.ndarray  # (room, N_MARKS) int64: prism, tie rank of the face, whether it is opaque, and UPPER: with which
    #                   one its order in depth was last certified, -1 for none
    until: np.ndarray  # (room,) time until which this order is certain
    pace: np.ndarray  # (room,) 1 / length
    by_end: np.ndarray  # (room,) int64
    active: np.ndarray  # (room,) int64 those that cover the ray now, nearest first


class Cells(NamedTuple):
    """The cells of one ray."""

    t: np.ndarray  # (room, 2)
    first: np.ndarray  # (room + 1,) int64 first layer of each
    layer: np.ndarray  # (room,) int64 interval of the ray


class Solver(NamedTuple):
    """Room to look for crossings."""

    room: np.ndarray  # of polynomials.roots_of
    found: np.ndarray  # (MAX_DEGREE,)


@inner
def make_ray(n: int) -> Ray:
    """Return room for `n` intervals."""
    ints = np.int64
    return Ray(
        np.empty((n, N_NUMBERS)),
        np.empty((n, N_MARKS), ints),
        np.empty(n),
        np.empty(n),
        np.empty(n, ints),
        np.empty(n, ints),
    )


@inner
def make_cells(n_cells: int, n_layers: int) -> Cells:
    """Return room for so many cells and layers."""
    return Cells(np.empty((n_cells, 2)), np.zeros(n_cells + 1, np.int64), np.empty(n_layers, np.int64))


@inner
def make_solver() -> Solver:
    """Return room to look for crossings."""
    return Solver(np.empty((MAX_HALVINGS + 4, MAX_DEGREE + 3)), np.empty(MAX_DEGREE))


@inlined
def _local(data: np.ndarray, pace: np.ndarray, i: int, t: float) -> float:
    """Return where in interval `i` the time `t` lies, in [0, 1]."""
    return min(max((t - data[i, T_START]) * pace[i], 0.0), 1.0)


@inlined
def _nearness(data: np.ndarray, pace: np.ndarray, i: int, t: float) -> tuple[float, float]:
    """Return M and D of interval `i` at a time, of which D is not negative."""
    u = _local(data, pace, i, t)
    num = cubic_at(data[i, NUM], data[i, NUM + 1], data[i, NUM + 2], data[i, NUM + 3], u)
    den = cubic_at(data[i, DEN], data[i, DEN + 1], data[i, DEN + 2], data[i, DEN + 3], u)
    return (num, den) if den >= 0 else (-num, -den)


@inner
def _is_in_front(ray: Ray, i: int, j: int, cell: tuple[float, float]) -> bool:
    """Return whether interval `i` is in front of `j` in the middle of a cell, by a close look."""
    data, mark, pace = ray.data, ray.mark, ray.pace
    start, end = cell
    for share in (0.5, 0.75):
        t = share * start + (1 - share) * end
        num_i, den_i = _nearness(data, pace, i, t)
        num_j, den_j = _nearness(data, pace, j, t)
        if den_i == 0 or den_j == 0:  # edge-on: nearest
            if den_i == den_j:
                break
            return den_i == 0
        a, b = num_i * den_j, num_j * den_i
        if not abs(a - b) <= TIE * min(abs(a), abs(b)):
            return a > b
    return mark[i, RANK] < mark[j, RANK]


@inlined
def _precedes(ray: Ray, i: int, j: int, cell: tuple[float, float]) -> bool:
    """Return whether interval `i` is in front of `j` in the middle of a cell; see `cells._depth_order`."""
    if ray.data[i, LOW] > ray.data[j, HIGH]:
        return True
    if ray.data[j, LOW] > ray.data[i, HIGH]:
        return False
    return _is_in_front(ray, i, j, cell)


@inlined
def _drop_ended(data: np.ndarray, active: np.ndarray, n: int, now: float) -> int:
    """Take out of the active intervals those that end by `now`, and return how many are left."""
    left = 0
    for k in range(n):
        own = active[k]
        if data[own, T_END] > now:
            active[left] = own
            left += 1
    return left


@inner
def _sort_roughly(data: np.ndarray, active: np.ndarray, n: int) -> None:
    """Put active intervals in order of their least nearness, so that `_order` has little to move where many start."""
    sort_by(data, LOW, active, n)
    for k in range(n // 2):
        active[k], active[n - 1 - k] = active[n - 1 - k], active[k]


@inlined
def _order(ray: Ray, n: int, start: float, end: float) -> int:
    """Put the active intervals in order of depth, down to the first opaque one, and return its place, or the last."""
    mark, until, active = ray.mark, ray.until, ray.active
    opaque = -1
    for k in range(n):
        own = active[k]
        place = k
        if opaque >= 0:
            front = active[opaque]
            if mark[own, UPPER] == front and until[own] >= end:
                continue
            if _precedes(ray, front, own, (start, end)):
                continue
            for m in range(k, opaque + 1, -1):
                active[m] = active[m - 1]
            active[opaque + 1] = own
            place = opaque + 1
        while place > 0:
            above = active[place - 1]
            if mark[own, UPPER] == above and until[own] >= end:
                break
            if not _precedes(ray, own, above, (start, end)):
                break
            active[place], active[place - 1] = above, own
            place -= 1
        if opaque >= 0 and place <= opaque:
            opaque += 1
        if mark[own, IS_OPAQUE] != 0 and (opaque < 0 or place < opaque):
            opaque = place
    return opaque if opaque >= 0 else n - 1


@inlined
def _first_crossing(ray: Ray, pair: tuple[int, int], start: float, least: float, solver: Solver) -> float:
    """Return the first time after `start`, by more than `least`, at which two intervals change places; or the first of
    their ends.
    """
    data, pace = ray.data, ray.pace
    i, j = pair
    end = min(data[i, T_END], data[j, T_END])
    a0, a1, a2, a3 = data[i, NUM], data[i, NUM + 1], data[i, NUM + 2], data[i, NUM + 3]
    b0, b1, b2, b3 = data[i, DEN], data[i, DEN + 1], data[i, DEN + 2], data[i, DEN + 3]
    p0, p1, p2, p3 = data[j, NUM], data[j, NUM + 1], data[j, NUM + 2], data[j, NUM + 3]
    q0, q1, q2, q3 = data[j, DEN], data[j, DEN + 1], data[j, DEN + 2], data[j, DEN + 3]
    if start > data[i, T_START] or end < data[i, T_END]:
        u, v = _local(data, pace, i, start), _local(data, pace, i, end)
        a0, a1, a2, a3 = restrict_cubic(a0, a1, a2, a3, (u, v))
        b0, b1, b2, b3 = restrict_cubic(b0, b1, b2, b3, (u, v))
    if start > data[j, T_START] or end < data[j, T_END]:
        u, v = _local(data, pace, j, start), _local(data, pace, j, end)
        p0, p1, p2, p3 = restrict_cubic(p0, p1, p2, p3, (u, v))
        q0, q1, q2, q3 = restrict_cubic(q0, q1, q2, q3, (u, v))
    f0 = a0 * q0 - p0 * b0  # F = a q - p b
    f1 = 0.5 * ((a0 * q1 + a1 * q0) - (p0 * b1 + p1 * b0))
    f2 = 0.2 * ((a0 * q2 + a2 * q0) - (p0 * b2 + p2 * b0)) + 0.6 * (a1 * q1 - p1 * b1)
    f3 = 0.05 * ((a0 * q3 + a3 * q0) - (p0 * b3 + p3 * b0)) + 0.45 * ((a1 * q2 + a2 * q1) - (p1 * b2 + p2 * b1))
    f4 = 0.2 * ((a1 * q3 + a3 * q1) - (p1 * b3 + p3 * b1)) + 0.6 * (a2 * q2 - p2 * b2)
    f5 = 0.5 * ((a2 * q3 + a3 * q2) - (p2 * b3 + p3 * b2))
    f6 = a3 * q3 - p3 * b3
    most = max(max(max(f0, f1), max(f2, f3)), max(max(f4, f5), f6))
    if most <= 0 or min(min(min(f0, f1), min(f2, f3)), min(min(f4, f5), f6)) >= 0:
        return end
    f = solver.room
    f[0, 0], f[0, 1], f[0, 2], f[0, 3], f[0, 4], f[0, 5], f[0, 6] = f0, f1, f2, f3, f4, f5, f6
    size_i = _largest(a0, a1, a2, a3) * _largest(q0, q1, q2, q3)
    size_j = _largest(p0, p1, p2, p3) * _largest(b0, b1, b2, b3)
    first = end
    for k in range(roots_of(f, N_CROSSING, CROSSING_NOISE * (size_i + size_j), solver.found)):
        t = start + solver.found[k] * (end - start)
        if t - start > least:
            first = min(first, t)
    return first


@inlined
def _largest(a: float, b: float, c: float, d: float) -> float:
    return max(max(abs(a), abs(b)), max(abs(c), abs(d)))


@inlined
def _certify(ray: Ray, n: int, opaque: int, cell: tuple[float, float, float], solver: Solver) -> float:
    """Return the time within a cell (start, end, shortest) until which the order of the active intervals holds."""
    start, end, least = cell
    if not end - start > least:
        return end
    until = end  # the order is that of the middle of all of the cell
    data, mark, certain, active = ray.data, ray.mark, ray.until, ray.active
    for k in range(1, n):
        above, own = active[k - 1 if k <= opaque else opaque], active[k]
        if mark[own, UPPER] == above and certain[own] >= end:
            continue
        if data[above, LOW] > data[own, HIGH]:
            mark[own, UPPER], certain[own] = above, min(data[above, T_END], data[own, T_END])
            continue
        t = _first_crossing(ray, (above, own), start, least, solver)
        if until - t > least:
            end = min(end, t)
            mark[own, UPPER] = -1
        else:
            mark[own, UPPER], certain[own] = above, t
    return until if until - end <= least else end


@inner
def sweep(ray: Ray, n: int, cells: Cells, shortest: float, solver: Solver) -> tuple[int, int]:
    """Write the cells of a ray to `cells`, and return their number and that of crossings; NO_ROOM where they are more.

    Args:
        ray: its intervals in order of their starts.
        n: their number.
        cells: room.
        shortest: time; shorter cells are not searched for crossings.
        solver: room.

    Source: Ronnow et al. 2021, alg. 1.
    """
    data, mark, pace, by_end, active = ray.data, ray.mark, ray.pace, ray.by_end, ray.active
    t, first, layer = cells.t, cells.first, cells.layer
    n_cells, n_layers, n_crossings, last = 0, 0, 0, 0
    for k in range(n):
        by_end[k] = k
        mark[k, UPPER], pace[k] = -1, 1 / (data[k, T_END] - data[k, T_START])
    sort_by(data, T_END, by_end, n)
    now, next_start, next_end, n_active = data[0, T_START], 0, 0, 0
    while True:
        if next_end < n and data[by_end[next_end], T_END] <= now:
            n_active = _drop_ended(data, active, n_active, now)
            while next_end < n and data[by_end[next_end], T_END] <= now:
                next_end += 1
        n_before = n_active
        while next_start < n and data[next_start, T_START] <= now:
            active[n_active] = next_start
            n_active += 1
            next_start += 1
        if n_active - n_before >= MANY:
            _sort_roughly(data, active, n_active)
        if next_end == n:
            return n_cells, n_crossings
        event = data[by_end[next_end], T_END]
        if next_start < n:
            event = min(event, data[next_start, T_START])
        while n_active > 0 and now < event:
            end, opaque = event, 0
            while n_active > 1:
                opaque = _order(ray, n_active, now, end)
                certain = _certify(ray, n_active, opaque, (now, end, shortest), solver)
                if not certain < end:
                    break
                end = certain
                n_crossings += 1
            # a cell that shows the same as the last one makes it longer
            is_same = n_cells > 0 and t[n_cells - 1, 1] == now and n_layers - last == opaque + 1
            if is_same:
                for k in range(opaque + 1):
                    if layer[last + k] != active[k]:
                        is_same = False
                        break
            if is_same:
                t[n_cells - 1, 1] = end
            else:
                if n_cells == len(t) or n_layers + opaque + 1 > len(layer):
                    return NO_ROOM, 0
                t[n_cells, 0], t[n_cells, 1] = now, end
                last = n_layers
                for k in range(opaque + 1):
                    layer[n_layers + k] = active[k]
                n_cells += 1
                n_layers += opaque + 1
                first[n_cells] = n_layers
            now = end
        now = event
