"""Solve many pairs of a prism and a ray of one tile at once, where rounding cannot change what is found.

Before: polynomials.py.  After: fill.py.
An edge function of a moving triangle is a quadratic in time whose three coefficients are linear across the screen: a
prism is set up once for a tile (`set_up`), a pair then costs a few multiplications, and the loops over pairs hold no
branches and step through memory evenly, so that the compiler turns them into vector instructions. Where a sign is
within rounding, a root is nearly double or passed slowly, there is more than one piece, or numbers cancel, the pair is
marked HARD and left to coverage.py.
Symbols: edge functions e(u) = c + 2 h u + q u u at local time u in [0, 1]; X, Y the ray in NDC from the tile's middle;
M and D as in intervals.py. All triangles of a tile are set up about one origin, and an edge that two share gets
opposite numbers, so that no time is lost or counted twice between them.
Source: Ronnow et al. 2021, sec. 4.1 (edge equations in time); their form across the screen, and batches: ours.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchblur.cpu.jit import inlined, inner
from torchblur.cpu.polynomials import restrict_cubic
from torchblur.edges import EDGE_SIGN, FIRST, SECOND

ROOM = 256  # pairs of a batch
X, Y, W, Z = 0, 1, 2, 3
HARD, ONE_PIECE = 2.0, 1.0  # states of a pair; 0 where nothing is covered
UNSURE = 1e-12  # of the largest product: an edge function this small may have either sign
SLOW = 4e6  # times as much: an edge function that passes zero by half this slope does so at an unsure time (1e-10)
CANCELS = 1e-3  # of the greatest sum of sizes: a result this small has lost as many digits

# columns of `Batch.setup`: K, KX, KY of c, h, q of each edge; M0, MX, MY of each coefficient; D; where M0 holds; noise;
# size of the sums of D
M_AT, D_AT, AT_X, AT_Y, NOISE_AT, SIZE_AT, N_SETUP = 27, 39, 43, 44, 45, 46, 47

# Fields of the flat arrays, ROOM numbers each, one of a pair. They are unsigned, as else each access asks for a sign.
_U = np.uint64
C0, H0, Q0, C1, H1, Q1, C2, H2, Q2 = (_U(k * ROOM) for k in range(9))
NOISE, ALLOWED, START, END, STATE, PAIR_X, PAIR_Y = (_U(k * ROOM) for k in range(9, 16))
N_FIELDS = 16
M0, M1, M2, M3, D0, D1, D2, D3, FROM, TO, LOW, HIGH, WEAK, SIZE = (_U(k * ROOM) for k in range(14))


class Batch(NamedTuple):
    """Pairs to be solved."""

    setup: np.ndarray  # (ROOM + 1, N_SETUP) prisms
    field: np.ndarray  # (N_FIELDS * ROOM,) of the pairs
    near: np.ndarray  # (N_FIELDS * ROOM,) of those that cover something
    who: np.ndarray  # (ROOM, 3) int64: prism, its row of `setup`, pixel of the tile
    covered: np.ndarray  # (ROOM,) int64 which pairs cover something
    pixels: np.ndarray  # (ROOM,) int64 columns of the tile in a row


@inner
def make_batch() -> Batch:
    """Return room for a batch."""
    return Batch(
        np.empty((ROOM + 1, N_SETUP)),
        np.empty(N_FIELDS * ROOM),
        np.empty(N_FIELDS * ROOM),
        np.empty((ROOM, 3), np.int64),
        np.empty(ROOM, np.int64),
        np.empty(ROOM, np.int64),
    )


@inlined
def _cross(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return K, KX, KY, for which the edge from `a` to `b`, (x, y, w) each, is K + KX X + KY Y."""
    return a[0] * b[1] - a[1] * b[0], a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2]


@inlined
def _corner(clip: np.ndarray, k: int, end: int, c: int, origin: tuple[float, float]) -> tuple[float, float, float]:
    """Return x, y, w of a corner of a prism from an origin in NDC."""
    w = clip[k, end, c, W]
    return clip[k, end, c, X] - origin[0] * w, clip[k, end, c, Y] - origin[1] * w, w


@inlined
def _product(e: tuple[float, float, float], q: tuple[float, float]) -> tuple[float, float, float, float]:
    """Return the Bernstein coefficients of a quadratic times a linear function."""
    e0, e1, e2 = e
    a, b = q
    return e0 * a, 1 / 3 * (e0 * b) + 2 / 3 * (e1 * a), 2 / 3 * (e1 * b) + 1 / 3 * (e2 * a), e2 * b


@inner
def set_up(
    clip: np.ndarray, k: int, tile: tuple[float, float, float, float], orders_by_w: bool, out: tuple[np.ndarray, int]
) -> None:
    """Write what a tile needs of a prism to a row of `Batch.setup`.

    Args:
        clip: (P, 2, 3, 4) x y w z of the prisms, all in front of the camera.
        k: which prism.
        tile: middle and half sides in NDC.
        orders_by_w: see intervals.py.
        out: array and row.
    """
    setup, row = out
    middle, reach_x, reach_y = (tile[0], tile[1]), tile[2], tile[3]
    most = 0.0
    for edge in range(3):
        i, j, turn = FIRST[edge], SECOND[edge], EDGE_SIGN[edge]
        a, b = _corner(clip, k, 0, i, middle), _corner(clip, k, 0, j, middle)
        c, d = _corner(clip, k, 1, i, middle), _corner(clip, k, 1, j, middle)
        da, db = (c[0] - a[0], c[1] - a[1], c[2] - a[2]), (d[0] - b[0], d[1] - b[1], d[2] - b[2])
        at_start, first, second, bend = _cross(a, b), _cross(a, db), _cross(da, b), _cross(da, db)
        size = 0.0
        for n in range(3):
            setup[row, 9 * edge + n] = turn * at_start[n]
            setup[row, 9 * edge + 3 + n] = 0.5 * (turn * (first[n] + second[n]))
            setup[row, 9 * edge + 6 + n] = turn * bend[n]
            reach = 1.0 if n == 0 else reach_x if n == 1 else reach_y
            size += reach * (abs(at_start[n]) + abs(first[n]) + abs(second[n]) + abs(bend[n]))
        # the products themselves, as they may cancel in K
        size += abs(a[0] * b[1]) + abs(a[1] * b[0]) + abs(c[0] * d[1]) + abs(c[1] * d[0])
        most = max(most, size)
    setup[row, NOISE_AT] = UNSURE * most
    # nearness: about a place of the prism's own, where fewer digits cancel
    w = clip[k, 0, 0, W] + clip[k, 1, 0, W]
    own = ((clip[k, 0, 0, X] + clip[k, 1, 0, X]) / w, (clip[k, 0, 0, Y] + clip[k, 1, 0, Y]) / w)
    setup[row, AT_X], setup[row, AT_Y] = own[0] - middle[0], own[1] - middle[1]
    for n in range(M_AT, D_AT + 4):
        setup[row, n] = 0.0
    sizes = (0.0, 0.0, 0.0, 0.0)
    for edge in range(3):
        i, j, turn = FIRST[edge], SECOND[edge], EDGE_SIGN[edge]
        a, b = _corner(clip, k, 0, i, own), _corner(clip, k, 0, j, own)
        c, d = _corner(clip, k, 1, i, own), _corner(clip, k, 1, j, own)
        at_start, first, second, at_end = _cross(a, b), _cross(a, d), _cross(c, b), _cross(c, d)
        depth = clip[k, 0, edge, W], clip[k, 1, edge, W]
        order = (1.0, 1.0)
        if not orders_by_w:
            order = 2 * depth[0] - clip[k, 0, edge, Z], 2 * depth[1] - clip[k, 1, edge, Z]
        for n in range(3):
            e = turn * at_start[n], 0.5 * (turn * (first[n] + second[n])), turn * at_end[n]
            m = _product(e, order)
            for coefficient in range(4):
                setup[row, M_AT + 3 * coefficient + n] += m[coefficient]
            if n == 0:
                p = _product(e, depth)
                s = _product((abs(e[0]), abs(e[1]), abs(e[2])), depth)
                sizes = sizes[0] + s[0], sizes[1] + s[1], sizes[2] + s[2], sizes[3] + s[3]
                for coefficient in range(4):
                    setup[row, D_AT + coefficient] += p[coefficient]
    setup[row, SIZE_AT] = max(max(sizes[0], sizes[1]), max(sizes[2], sizes[3]))


@inner
def add_row(
    room: tuple[np.ndarray, np.ndarray, np.ndarray],
    n: int,
    who: tuple[int, float, float, int],
    x: tuple[float, float],
) -> None:
    """Append pairs of a prism with rays of one row to a batch that holds `n`.

    Args:
        room: `setup`, `field` and `pixels` of the batch, of which the last holds the columns.
        n: pairs in it.
        who: prism's row of `setup`, sign of the edges that is seen, Y, and how many pairs.
        x: X of the tile's first column, and from one to the next.
    """
    setup, field, pixels = room
    row, allowed, y, count = who
    noise = setup[row, NOISE_AT]
    at, step = x
    base = _U(n)
    for m in range(_U(count)):
        place = base + m
        field[place + PAIR_X], field[place + PAIR_Y] = at + step * pixels[m], y
        field[place + NOISE], field[place + ALLOWED] = noise, allowed
    for k in range(9):
        constant, slope = setup[row, 3 * k] + y * setup[row, 3 * k + 2], setup[row, 3 * k + 1]
        first = base + _U(k * ROOM)
        for m in range(_U(count)):
            field[first + m] = constant + slope * field[base + m + PAIR_X]


@inlined
def _edge(c: float, h: float, q: float, noise: float) -> tuple[float, float, bool, bool, bool]:
    """Return the earlier and the later root in (0, 1), 1 where there is none; whether the edge is surely positive,
    surely negative, or unsure.
    """
    middle = c + h
    end = middle + (h + q)
    low, high = min(c, min(middle, end)), max(c, max(middle, end))
    disc = h * h - q * c
    is_positive, is_negative = low > noise, high < -noise
    is_small = (abs(c) <= noise) | (abs(end) <= noise) | (abs(disc) <= (SLOW * noise) * (SLOW * noise))
    s = -(h + math.copysign(math.sqrt(max(disc, 0.0)), h))
    first, second = s / q, c / s
    first = first if (first > 0.0) & (first < 1.0) & (disc > 0.0) else 1.0
    second = second if (second > 0.0) & (second < 1.0) & (disc > 0.0) else 1.0
    is_unsure = (not (is_positive | is_negative)) & is_small
    return min(first, second), max(first, second), is_positive, is_negative, is_unsure


@inlined
def _without(start: float, end: float, gap: tuple[float, float]) -> tuple[float, float]:
    """Return a piece of time without a gap that reaches across one of its ends."""
    first, last = gap
    return last if (first <= start) & (start < last) else start, first if (first < end) & (end <= last) else end


@inlined
def _inside(
    starts: tuple[bool, bool, bool], a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]
) -> tuple[float, float, bool]:
    """Return when all three edges have one sign, and whether there may be more pieces than this one.

    Args:
        starts: whether each edge has it at first.
        a, b, c: roots of each.
    """
    # an edge that starts with it has it but in the gap between its roots; else only there
    start = max(0.0 if starts[0] else a[0], max(0.0 if starts[1] else b[0], 0.0 if starts[2] else c[0]))
    end = min(1.0 if starts[0] else a[1], min(1.0 if starts[1] else b[1], 1.0 if starts[2] else c[1]))
    p = (a[0] if starts[0] else 2.0, a[1] if starts[0] else 2.0)
    q = (b[0] if starts[1] else 2.0, b[1] if starts[1] else 2.0)
    r = (c[0] if starts[2] else 2.0, c[1] if starts[2] else 2.0)
    for _ in range(3):  # gaps may follow on each other
        start, end = _without(start, end, p)
        start, end = _without(start, end, q)
        start, end = _without(start, end, r)
    is_split = (
        ((start < p[0]) & (p[0] < p[1]) & (p[1] < end))
        | ((start < q[0]) & (q[0] < q[1]) & (q[1] < end))
        | ((start < r[0]) & (r[0] < r[1]) & (r[1] < end))
    )
    return start, end, is_split


@inner
def solve(field: np.ndarray, n: int) -> None:
    """Set START, END and STATE of `n` pairs: inside, all three edges have one sign."""
    for k in range(_U(n)):
        noise, allowed = field[k + NOISE], field[k + ALLOWED]
        c, d, e = field[k + C0], field[k + C1], field[k + C2]
        a0, a1, a_front, a_back, a_unsure = _edge(c, field[k + H0], field[k + Q0], noise)
        b0, b1, b_front, b_back, b_unsure = _edge(d, field[k + H1], field[k + Q1], noise)
        g0, g1, g_front, g_back, g_unsure = _edge(e, field[k + H2], field[k + Q2], noise)
        front_start, front_end, front_split = _inside((c > 0, d > 0, e > 0), (a0, a1), (b0, b1), (g0, g1))
        back_start, back_end, back_split = _inside((not c > 0, not d > 0, not e > 0), (a0, a1), (b0, b1), (g0, g1))
        may_front = (allowed >= 0) & (not (a_back | b_back | g_back))
        may_back = (allowed <= 0) & (not (a_front | b_front | g_front))
        is_front, is_back = may_front & (front_start < front_end), may_back & (back_start < back_end)
        is_hard = (
            ((may_front | may_back) & (a_unsure | b_unsure | g_unsure))
            | (is_front & is_back)
            | (is_front & front_split)
            | (is_back & back_split)
        )
        field[k + START] = front_start if is_front else back_start
        field[k + END] = front_end if is_front else back_end
        field[k + STATE] = HARD if is_hard else ONE_PIECE if is_front | is_back else 0.0


@inner
def gather_covered(batch: Batch, n: int) -> int:
    """List the pairs of a batch of `n` that cover one piece of time, set up their nearness, and return their number."""
    field, near, setup, who, covered = batch.field, batch.near, batch.setup, batch.who, batch.covered
    count = _U(0)
    for k in range(_U(n)):
        if field[k + STATE] != ONE_PIECE:
            continue
        row = who[k, 1]
        x, y = field[k + PAIR_X] - setup[row, AT_X], field[k + PAIR_Y] - setup[row, AT_Y]
        for c in range(4):
            m = M_AT + 3 * c
            near[count + _U(c * ROOM)] = setup[row, m] + (x * setup[row, m + 1] + y * setup[row, m + 2])
            near[count + _U((4 + c) * ROOM)] = setup[row, D_AT + c]
        near[count + SIZE] = setup[row, SIZE_AT]
        near[count + FROM], near[count + TO] = field[k + START], field[k + END]
        covered[count] = k
        count += _U(1)
    return np.int64(count)


@inlined
def _bounds(c0: float, c1: float, c2: float, c3: float) -> tuple[float, float, float]:
    """Return the least and the greatest of four numbers, and the greatest size."""
    low, high = min(min(c0, c1), min(c2, c3)), max(max(c0, c1), max(c2, c3))
    return low, high, max(abs(low), abs(high))


@inner
def restrict(near: np.ndarray, n: int) -> None:
    """Restrict the M and D of `n` pairs to FROM and TO, bound the nearness, and mark those that cancel as WEAK."""
    for k in range(_U(n)):
        part = near[k + FROM], near[k + TO]
        m0, m1, m2, m3 = near[k + M0], near[k + M1], near[k + M2], near[k + M3]
        d0, d1, d2, d3 = near[k + D0], near[k + D1], near[k + D2], near[k + D3]
        _, _, m_size = _bounds(m0, m1, m2, m3)
        m0, m1, m2, m3 = restrict_cubic(m0, m1, m2, m3, part)
        d0, d1, d2, d3 = restrict_cubic(d0, d1, d2, d3, part)
        _, _, m_most = _bounds(m0, m1, m2, m3)
        d_low, d_high, _ = _bounds(d0, d1, d2, d3)
        d_least = min(abs(d_low), abs(d_high))
        low, high, _ = _bounds(m0 / d0, m1 / d1, m2 / d2, m3 / d3)
        is_one_sided = (d_low > 0) | (d_high < 0)
        is_weak = (m_most < CANCELS * m_size) | (d_least < CANCELS * near[k + SIZE]) | (not is_one_sided)
        near[k + M0], near[k + M1], near[k + M2], near[k + M3] = m0, m1, m2, m3
        near[k + D0], near[k + D1], near[k + D2], near[k + D3] = d0, d1, d2, d3
        near[k + LOW], near[k + HIGH], near[k + WEAK] = low, high, 1.0 if is_weak else 0.0
