"""Cut a ray's time into cells, one ray at a time: what cells.py does for many at once.

Before: polynomials.py.  After: tiles.py.
Symbols: n intervals of a ray in order of their starts; rows of `data` hold t_start, t_end, the Bernstein coefficients
of M and D (see intervals.py), and the least and greatest nearness. A pair is certain until a time: up to then its
order is known not to change.
Source: Ronnow et al. 2021, alg. 1 (the event sweep); order at midpoints and certificates as in cells.py; keeping
certificates from cell to cell: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchblur.bernstein import MAX_HALVINGS
from torchblur.cells import CROSSING_NOISE
from torchblur.cpu.jit import inlined, jit
from torchblur.cpu.polynomials import MAX_DEGREE, cubic_at, restrict_cubic, roots_of, sort_by
from torchblur.sort import TIE

T_START, T_END, NUM, DEN, LOW, HIGH, N_NUMBERS = 0, 1, 2, 6, 10, 11, 12


class Ray(NamedTuple):
    """The intervals of one ray, and room to sweep over them."""

    data: np.ndarray  # (room, N_NUMBERS)
    prism: np.ndarray  # (room,) int64
    rank: np.ndarray  # (room,) int64 tie rank of the face
    is_opaque: np.ndarray  # (room,) bool
    by_end: np.ndarray  # (room,) int64
    active: np.ndarray  # (room,) int64 those that cover the ray now, nearest first
    upper: np.ndarray  # (room,) int64 which one the order in depth below was last compared with, -1 for none
    until: np.ndarray  # (room,) time until which this order is certain


class Cells(NamedTuple):
    """The cells of one ray."""

    t: np.ndarray  # (room, 2)
    first: np.ndarray  # (room + 1,) int64 first layer of each
    layer: np.ndarray  # (room,) int64 interval of the ray
    count: np.ndarray  # (2,) int64 numbers of cells and of crossings


class Solver(NamedTuple):
    """Room to look for crossings."""

    room: np.ndarray  # of polynomials.roots_of
    found: np.ndarray  # (MAX_DEGREE,)


@jit
def make_ray(n: int) -> Ray:
    """Return room for `n` intervals."""
    ints = np.int64
    return Ray(
        np.empty((n, N_NUMBERS)),
        np.empty(n, ints),
        np.empty(n, ints),
        np.empty(n, np.bool_),
        np.empty(n, ints),
        np.empty(n, ints),
        np.empty(n, ints),
        np.empty(n),
    )


@jit
def make_cells(n_cells: int, n_layers: int) -> Cells:
    """Return room for so many cells and layers."""
    return Cells(
        np.empty((n_cells, 2)), np.zeros(n_cells + 1, np.int64), np.empty(n_layers, np.int64), np.zeros(2, np.int64)
    )


@jit
def make_solver() -> Solver:
    """Return room to look for crossings."""
    return Solver(np.empty((MAX_HALVINGS + 4, MAX_DEGREE + 3)), np.empty(MAX_DEGREE))


@inlined
def _local(ray: Ray, i: int, t: float) -> float:
    """Return where in interval `i` the time `t` lies, in [0, 1]."""
    start, end = ray.data[i, T_START], ray.data[i, T_END]
    return min(max((t - start) / (end - start), 0.0), 1.0)


@inlined
def _nearness(ray: Ray, i: int, t: float) -> float:
    u = _local(ray, i, t)
    den = cubic_at(ray.data, i, DEN, u)
    return cubic_at(ray.data, i, NUM, u) / den if den != 0 else np.inf


@jit
def _is_in_front(ray: Ray, i: int, j: int, start: float, end: float) -> bool:
    """Return whether interval `i` is in front of `j` in the middle of a cell; see `cells._depth_order`."""
    data = ray.data
    if data[i, LOW] > data[j, HIGH]:
        return True
    if data[j, LOW] > data[i, HIGH]:
        return False
    for share in (0.5, 0.75):
        t = share * start + (1 - share) * end
        a, b = _nearness(ray, i, t), _nearness(ray, j, t)
        if a == b == np.inf:
            break
        if not abs(a - b) <= TIE * min(abs(a), abs(b)):
            return a > b
    return ray.rank[i] < ray.rank[j]


@jit
def _order(ray: Ray, n: int, start: float, end: float) -> int:
    """Put the active intervals in order of depth, down to the first opaque one, and return its place, or the last."""
    active, opaque = ray.active, -1
    for k in range(n):
        own = active[k]
        place = k
        if opaque >= 0:
            front = active[opaque]
            if ray.upper[own] == front and ray.until[own] >= end:
                continue
            if _is_in_front(ray, front, own, start, end):
                continue
            for m in range(k, opaque + 1, -1):
                active[m] = active[m - 1]
            active[opaque + 1] = own
            place = opaque + 1
        while place > 0:
            above = active[place - 1]
            if ray.upper[own] == above and ray.until[own] >= end:
                break
            if not _is_in_front(ray, own, above, start, end):
                break
            active[place], active[place - 1] = above, own
            place -= 1
        if opaque >= 0 and place <= opaque:
            opaque += 1
        if ray.is_opaque[own] and (opaque < 0 or place < opaque):
            opaque = place
    return opaque if opaque >= 0 else n - 1


@jit
def _first_crossing(ray: Ray, pair: tuple[int, int], start: float, least: float, solver: Solver) -> float:
    """Return the first time after `start`, by more than `least`, at which two intervals change places; or the first of
    their ends.
    """
    data, f = ray.data, solver.room
    i, j = pair
    end = min(data[i, T_END], data[j, T_END])
    part_i, part_j = (_local(ray, i, start), _local(ray, i, end)), (_local(ray, j, start), _local(ray, j, end))
    a0, a1, a2, a3 = restrict_cubic(data, i, NUM, part_i)
    b0, b1, b2, b3 = restrict_cubic(data, i, DEN, part_i)
    p0, p1, p2, p3 = restrict_cubic(data, j, NUM, part_j)
    q0, q1, q2, q3 = restrict_cubic(data, j, DEN, part_j)  # F = a q - p b
    f[0, 0] = a0 * q0 - p0 * b0
    f[0, 1] = 0.5 * ((a0 * q1 + a1 * q0) - (p0 * b1 + p1 * b0))
    f[0, 2] = 0.2 * ((a0 * q2 + a2 * q0) - (p0 * b2 + p2 * b0)) + 0.6 * (a1 * q1 - p1 * b1)
    f[0, 3] = 0.05 * ((a0 * q3 + a3 * q0) - (p0 * b3 + p3 * b0)) + 0.45 * ((a1 * q2 + a2 * q1) - (p1 * b2 + p2 * b1))
    f[0, 4] = 0.2 * ((a1 * q3 + a3 * q1) - (p1 * b3 + p3 * b1)) + 0.6 * (a2 * q2 - p2 * b2)
    f[0, 5] = 0.5 * ((a2 * q3 + a3 * q2) - (p2 * b3 + p3 * b2))
    f[0, 6] = a3 * q3 - p3 * b3
    size_i = _largest(a0, a1, a2, a3) * _largest(q0, q1, q2, q3)
    size_j = _largest(p0, p1, p2, p3) * _largest(b0, b1, b2, b3)
    first = end
    for k in range(roots_of(f, MAX_DEGREE + 1, CROSSING_NOISE * (size_i + size_j), solver.found)):
        t = start + solver.found[k] * (end - start)
        if t - start > least:
            first = min(first, t)
    return first


@inlined
def _largest(a: float, b: float, c: float, d: float) -> float:
    return max(max(abs(a), abs(b)), max(abs(c), abs(d)))


@jit
def _certify(ray: Ray, n: int, opaque: int, cell: tuple[float, float, float], solver: Solver) -> float:
    """Return the time within a cell (start, end, shortest) until which the order of the active intervals holds."""
    start, end, least = cell
    if not end - start > least:
        return end
    until = end  # the order is that of the middle of all of the cell
    data, active = ray.data, ray.active
    for k in range(1, n):
        above, own = active[k - 1 if k <= opaque else opaque], active[k]
        if data[above, LOW] > data[own, HIGH] or (ray.upper[own] == above and ray.until[own] >= end):
            continue
        t = _first_crossing(ray, (above, own), start, least, solver)
        if until - t > least:
            end = min(end, t)
            ray.upper[own] = -1
        else:
            ray.upper[own], ray.until[own] = above, t
    return until if until - end <= least else end


@jit
def _emit(cells: Cells, ray: Ray, opaque: int, start: float, end: float) -> Cells:
    """Append a cell, or make the last one longer where it shows the same."""
    n, active = cells.count[0], ray.active
    first = cells.first[n]
    if n > 0 and cells.t[n - 1, 1] == start and first - cells.first[n - 1] == opaque + 1:
        is_same, before = True, cells.first[n - 1]
        for k in range(opaque + 1):
            if cells.layer[before + k] != active[k]:
                is_same = False
                break
        if is_same:
            cells.t[n - 1, 1] = end
            return cells
    if n + 1 > len(cells.t) or first + opaque + 1 > len(cells.layer):
        bigger = make_cells(max(2 * len(cells.t), n + 1), max(2 * len(cells.layer), first + opaque + 1))
        for k in range(n):
            bigger.t[k, 0], bigger.t[k, 1], bigger.first[k + 1] = cells.t[k, 0], cells.t[k, 1], cells.first[k + 1]
        for k in range(first):
            bigger.layer[k] = cells.layer[k]
        bigger.count[0], bigger.count[1] = cells.count[0], cells.count[1]
        cells = bigger
    cells.t[n, 0], cells.t[n, 1] = start, end
    for k in range(opaque + 1):
        cells.layer[first + k] = active[k]
    cells.first[n + 1] = first + opaque + 1
    cells.count[0] = n + 1
    return cells


@jit
def sweep(ray: Ray, n: int, cells: Cells, shortest: float, solver: Solver) -> Cells:
    """Return the cells of a ray, written to `cells` or, where these have no room, to larger ones.

    Args:
        ray: its intervals in order of their starts.
        n: their number.
        cells: room.
        shortest: time; shorter cells are not searched for crossings.
        solver: room.

    Source: Ronnow et al. 2021, alg. 1.
    """
    cells.count[0] = cells.count[1] = 0
    data, by_end, active = ray.data, ray.by_end, ray.active
    for k in range(n):
        by_end[k] = k
        ray.upper[k] = -1
    sort_by(data, T_END, by_end, n)
    now, next_start, next_end, n_active = data[0, T_START], 0, 0, 0
    while True:
        while next_end < n and data[by_end[next_end], T_END] <= now:
            gone, place = by_end[next_end], 0
            while active[place] != gone:
                place += 1
            for k in range(place, n_active - 1):
                active[k] = active[k + 1]
            n_active -= 1
            next_end += 1
        while next_start < n and data[next_start, T_START] <= now:
            active[n_active] = next_start
            n_active += 1
            next_start += 1
        if next_end == n:
            return cells
        event = data[by_end[next_end], T_END]
        if next_start < n:
            event = min(event, data[next_start, T_START])
        while n_active > 0 and now < event:
            end = event
            while True:
                opaque = _order(ray, n_active, now, end)
                certain = _certify(ray, n_active, opaque, (now, end, shortest), solver)
                if not certain < end:
                    break
                end = certain
                cells.count[1] += 1
            cells = _emit(cells, ray, opaque, now, end)
            now = end
        now = event
