"""When a moving triangle covers a ray, one pair at a time: what intervals.py and edges.py do for many at once.

Before: polynomials.py.  After: fill.py.
Symbols as in edges.py; `work.corner` holds x, y, w, z of the reduced corners: (2 ends, 3 corners, 4).
Source: as intervals.py; the same operations in the same order, so that all times are the same bits.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchblur.bernstein import MAX_HALVINGS
from torchblur.cpu.jit import inner
from torchblur.cpu.polynomials import MAX_DEGREE, roots_of, sort_few
from torchblur.edges import CLIP_NOISE, FIRST, SECOND

MAX_CUTS = 14  # 0, 1, two roots of each edge and three of each clip plane
HALF_GAUSS = 0.5 / math.sqrt(3)


class Work(NamedTuple):
    """Room for one pair of prism and ray."""

    corner: np.ndarray  # (2, 3, 4)
    edge: np.ndarray  # (3 coefficients, 3 edges)
    root: np.ndarray  # (2, 3): earlier and later of each edge
    sign: np.ndarray  # (3 slices, 3 edges) int64
    cut: np.ndarray  # (MAX_CUTS,)
    piece: np.ndarray  # (MAX_CUTS, 2) local times at which the covered pieces start and end
    room: np.ndarray  # of polynomials.roots_of
    found: np.ndarray  # (MAX_DEGREE,)
    ends: np.ndarray  # (2, 3, 4) corners at the ends of a piece


@inner
def make_work() -> Work:
    """Return room for one pair."""
    return Work(
        np.empty((2, 3, 4)),
        np.empty((3, 3)),
        np.empty((2, 3)),
        np.empty((3, 3), np.int64),
        np.empty(MAX_CUTS),
        np.empty((MAX_CUTS, 2)),
        np.empty((MAX_HALVINGS + 4, MAX_DEGREE + 3)),
        np.empty(MAX_DEGREE),
        np.empty((2, 3, 4)),
    )


@inner
def _edges(c: np.ndarray, out: np.ndarray) -> None:
    """Write the Bernstein coefficients of the edges of corners `c` (2, 3, 4) to `out` (3, 3)."""
    for edge in range(3):
        i, j = FIRST[edge], SECOND[edge]
        turn = -1.0 if edge == 1 else 1.0
        ax, ay, bx, by = c[0, i, 0], c[0, i, 1], c[0, j, 0], c[0, j, 1]
        px, py, qx, qy = c[1, i, 0], c[1, i, 1], c[1, j, 0], c[1, j, 1]
        out[0, edge] = turn * (ax * by - ay * bx)
        out[1, edge] = 0.5 * (turn * ((ax * qy - ay * qx) + (px * by - py * bx)))
        out[2, edge] = turn * (px * qy - py * qx)


@inner
def _edge_roots(corner: np.ndarray, edge: int, root: np.ndarray) -> None:
    """Write the local times at which an edge may change sign to `root[:, edge]`; 1 where there is none."""
    i, j = FIRST[edge], SECOND[edge]
    ax, ay, bx, by = corner[0, i, 0], corner[0, i, 1], corner[0, j, 0], corner[0, j, 1]
    dax, day = corner[1, i, 0] - ax, corner[1, i, 1] - ay
    dbx, dby = corner[1, j, 0] - bx, corner[1, j, 1] - by
    c0 = ax * by - ay * bx
    h = 0.5 * ((ax * dby - ay * dbx) + (dax * by - day * bx))
    c2 = dax * dby - day * dbx
    size = max(max(abs(c0), abs(h)), abs(c2))
    root[0, edge], root[1, edge] = 1.0, 1.0
    if not size > 0:
        return
    c0, h, c2 = c0 / size, h / size, c2 / size
    disc = h * h - c2 * c0
    if not disc > 0:
        return
    q = -(h + math.copysign(math.sqrt(disc), h))
    first, second = q / c2, c0 / q
    if not (0.0 < first < 1.0):
        first = 1.0
    if not (0.0 < second < 1.0):
        second = 1.0
    root[0, edge], root[1, edge] = min(first, second), max(first, second)


@inner
def _untied(e: float, slope_x: float, slope_y: float) -> float:
    """Return `e`, or where it is 0 the first of its slopes along the ray's x and y that is not."""
    return e if e != 0 else slope_x if slope_x != 0 else slope_y


@inner
def _edge_signs(work: Work, edge: int) -> None:
    """Write the signs of an edge that may change it before, between and after its roots."""
    corner = work.corner
    i, j = FIRST[edge], SECOND[edge]
    turn = -1.0 if edge == 1 else 1.0
    a0, a1, a2 = corner[0, i, 0], corner[0, i, 1], corner[0, i, 2]
    b0, b1, b2 = corner[0, j, 0], corner[0, j, 1], corner[0, j, 2]
    c0, c1, c2 = corner[1, i, 0], corner[1, i, 1], corner[1, i, 2]
    d0, d1, d2 = corner[1, j, 0], corner[1, j, 1], corner[1, j, 2]
    bend = turn * ((c0 - a0) * (d1 - b1) - (c1 - a1) * (d0 - b0)) / 12
    start = 0.0
    for k in range(3):
        end = 1.0 if k == 2 else work.root[k, edge]
        u = 0.5 * (start + end)
        v = 1 - u
        ax, ay = v * a0 + u * c0, v * a1 + u * c1
        bx, by = v * b0 + u * d0, v * b1 + u * d1
        mean = turn * (ax * by - ay * bx) + bend * ((end - start) * (end - start))
        if mean == 0:
            aw, bw = v * a2 + u * c2, v * b2 + u * d2
            mean = _untied(mean, turn * (ay * bw - aw * by), turn * (aw * bx - ax * bw))
        work.sign[k, edge] = 1 if mean > 0 else -1 if mean < 0 else 0
        start = end


@inner
def _still_sign(work: Work) -> int:
    """Return the common sign of the edges of corners at rest, 0 if there is none."""
    e, corner = work.edge, work.corner
    common = 0
    for edge in range(3):
        value = e[0, edge]
        if value == 0:
            i, j = FIRST[edge], SECOND[edge]
            ax, ay, aw = corner[0, i, 0], corner[0, i, 1], corner[0, i, 2]
            bx, by, bw = corner[0, j, 0], corner[0, j, 1], corner[0, j, 2]
            turn = -1.0 if edge == 1 else 1.0
            value = _untied(value, turn * (ay * bw - aw * by), turn * (aw * bx - ax * bw))
        sign = 1 if value > 0 else -1 if value < 0 else 0
        if sign == 0 or sign * common < 0:
            return 0
        common = sign
    return common


@inner
def _inside_sign(work: Work, u: float) -> int:
    """Return the common sign of the edges at a local time, 0 outside."""
    common = 0
    for edge in range(3):
        sign = work.sign[(u > work.root[0, edge]) + (u > work.root[1, edge]), edge]
        if sign == 0 or sign * common < 0:
            return 0
        common = sign
    return common


@inner
def _plane_at(corner: np.ndarray, c: int, end: int, is_near: bool) -> float:
    """Return the value of a clip plane at a corner."""
    z, w = corner[end, c, 3], corner[end, c, 2]
    return z + w if is_near else w - z


@inner
def _plane_roots(work: Work, is_near: bool, n_cuts: int) -> int:
    """Append the local times at which the hit may cross a clip plane to the cuts, and return their number."""
    e, cubic = work.edge, work.room
    cubic[0, 0] = cubic[0, 1] = cubic[0, 2] = cubic[0, 3] = 0.0
    for c in range(3):
        a, b = _plane_at(work.corner, c, 0, is_near), _plane_at(work.corner, c, 1, is_near)
        cubic[0, 0] += e[0, c] * a
        cubic[0, 1] += 1 / 3 * (e[0, c] * b) + 2 / 3 * (e[1, c] * a)
        cubic[0, 2] += 2 / 3 * (e[1, c] * b) + 1 / 3 * (e[2, c] * a)
        cubic[0, 3] += e[2, c] * b
    noise = 0.0
    for k in range(4):
        noise = max(noise, abs(cubic[0, k]) * CLIP_NOISE)
    count = roots_of(cubic, 4, noise, work.found)
    for k in range(min(count, 3)):
        work.cut[n_cuts] = work.found[k]
        n_cuts += 1
    return n_cuts


@inner
def _plane_mean(work: Work, is_near: bool, start: float, end: float) -> float:
    """Return the mean of a clip plane's value at the hit over a piece of local time."""
    corner, mean = work.corner, 0.0
    middle, length = 0.5 * (start + end), end - start
    for side in (-1.0, 1.0):
        u = middle + side * HALF_GAUSS * length
        v = 1 - u
        for c in range(3):
            i, j = FIRST[c], SECOND[c]
            ax, ay = v * corner[0, i, 0] + u * corner[1, i, 0], v * corner[0, i, 1] + u * corner[1, i, 1]
            bx, by = v * corner[0, j, 0] + u * corner[1, j, 0], v * corner[0, j, 1] + u * corner[1, j, 1]
            plane = v * _plane_at(corner, c, 0, is_near) + u * _plane_at(corner, c, 1, is_near)
            mean += (-0.5 if c == 1 else 0.5) * (ax * by - ay * bx) * plane
    return mean


@inner
def find_pieces(work: Work, is_clipped: bool, is_still: bool, allowed: int) -> int:
    """Return how many pieces of its time a prism covers a ray, and write them to `work.piece`.

    Args:
        work: whose corners are set.
        is_clipped: reaches beyond a clip plane.
        is_still: rests on screen.
        allowed: sign of the edges that is seen, 0 for both.

    Source: intervals._covered_pieces.
    """
    e, corner = work.edge, work.corner
    _edges(corner, e)
    can_be_positive, can_be_negative = allowed >= 0, allowed <= 0
    is_steady = not is_clipped
    for k in range(3):
        negative = e[0, k] < 0 and e[1, k] < 0 and e[2, k] < 0
        positive = e[0, k] > 0 and e[1, k] > 0 and e[2, k] > 0
        can_be_positive = can_be_positive and not negative
        can_be_negative = can_be_negative and not positive
        is_steady = is_steady and (negative or positive)
    if not (can_be_positive or can_be_negative):
        return 0
    piece = work.piece
    if is_still:
        sign = _still_sign(work)
        if sign == 0 or sign * allowed < 0:
            return 0
        is_steady = True
    if is_steady:  # of one sign, or one of the two could not be
        piece[0, 0], piece[0, 1] = 0.0, 1.0
        return 1
    cut, n_cuts = work.cut, 2
    cut[0], cut[1] = 0.0, 1.0
    for k in range(3):
        if e[0, k] > 0 and e[1, k] > 0 and e[2, k] > 0:
            work.root[0, k] = work.root[1, k] = 1.0
            work.sign[0, k] = work.sign[1, k] = work.sign[2, k] = 1
            continue
        if e[0, k] < 0 and e[1, k] < 0 and e[2, k] < 0:
            work.root[0, k] = work.root[1, k] = 1.0
            work.sign[0, k] = work.sign[1, k] = work.sign[2, k] = -1
            continue
        _edge_roots(corner, k, work.root)
        _edge_signs(work, k)
        for r in range(2):
            if work.root[r, k] < 1.0:
                cut[n_cuts] = work.root[r, k]
                n_cuts += 1
    if is_clipped:
        n_cuts = _plane_roots(work, False, _plane_roots(work, True, n_cuts))
    sort_few(cut, n_cuts)
    count, before = 0, 0
    for k in range(n_cuts - 1):
        start, end = cut[k], cut[k + 1]
        if not start < end:  # no length: breaks what it stands between as any other that is not covered
            before = 0
            continue
        side = _inside_sign(work, 0.5 * (start + end))
        if side != 0 and is_clipped:
            is_seen = (
                _plane_mean(work, True, start, end) * side >= 0 and _plane_mean(work, False, start, end) * side >= 0
            )
            side = side if is_seen else 0
        if side * allowed < 0:
            side = 0
        if side != 0:
            if side == before:
                piece[count - 1, 1] = end
            else:
                piece[count, 0], piece[count, 1] = start, end
                count += 1
        before = side
    return count


@inner
def nearness_of(work: Work, start: float, end: float, orders_by_w: bool, out: tuple[np.ndarray, int, int]) -> None:
    """Write the eight Bernstein coefficients of M and D over a piece of local time to `out`: an array, row and column.

    Source: intervals.nearness_coefficients.
    """
    corner, e, ends = work.corner, work.edge, work.ends
    near, row, first = out
    for c in range(3):
        for k in range(4):
            ends[0, c, k] = (1 - start) * corner[0, c, k] + start * corner[1, c, k]
            ends[1, c, k] = (1 - end) * corner[0, c, k] + end * corner[1, c, k]
    _edges(ends, e)
    m0, m1, m2, m3, d0, d1, d2, d3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(3):
        u, v = ends[0, c, 2], ends[1, c, 2]
        d0 += e[0, c] * u
        d1 += 1 / 3 * (e[0, c] * v) + 2 / 3 * (e[1, c] * u)
        d2 += 2 / 3 * (e[1, c] * v) + 1 / 3 * (e[2, c] * u)
        d3 += e[2, c] * v
        if not orders_by_w:
            u, v = 2 * u - ends[0, c, 3], 2 * v - ends[1, c, 3]
            m0 += e[0, c] * u
            m1 += 1 / 3 * (e[0, c] * v) + 2 / 3 * (e[1, c] * u)
            m2 += 2 / 3 * (e[1, c] * v) + 1 / 3 * (e[2, c] * u)
            m3 += e[2, c] * v
    if orders_by_w:
        m0, s1, m3 = (e[0, 0] + e[0, 1]) + e[0, 2], (e[1, 0] + e[1, 1]) + e[1, 2], (e[2, 0] + e[2, 1]) + e[2, 2]
        m1, m2 = (m0 + 2 * s1) / 3, (2 * s1 + m3) / 3
    near[row, first], near[row, first + 1], near[row, first + 2], near[row, first + 3] = m0, m1, m2, m3
    near[row, first + 4], near[row, first + 5], near[row, first + 6], near[row, first + 7] = d0, d1, d2, d3
