"""Join what receives light with what may block it, compiled: each pair that meets goes straight through the sieve.

Before: jit.py, sieve.py.  After: shadow_pairs.py.
Symbols: as in shadow_pairs.py, whose order of pairs this keeps; a thing is a receiver or a caster in a view.
Source: ours.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchblur.cpu.jit import borrowed, inlined, jit
from torchblur.cpu.sieve import may_block, scratch_room

Things = tuple[Tensor, Tensor, Tensor]
STARTING_ROOM = 1 << 12  # pairs
APART, CANDIDATE, BLOCKS = 0, 1, 2


def join(receiver: Things, caster: Things, sees_all: bool, arrays: tuple) -> tuple[tuple[Tensor, Tensor], int]:
    """Return receiver and caster (n,) of the pairs of a view that may block its light, and how many were candidates.

    Args:
        receiver: which (n,), box (5, n) of least x and y, greatest x and y in [0, 1], and depth, and level (n,).
        caster: likewise.
        sees_all: whether to look at all pairs rather than at those that touch a common cell.
        arrays: faces of the receivers (K,) and of the casters (C,), and what `sieve.arrays_of` returns.

    Source: ours.
    """
    a, b = ((w.numpy(), box.T.contiguous().numpy(), level.numpy()) for w, box, level in (receiver, caster))
    room = scratch_room()
    found, n = _join_all(a, b, arrays, room) if sees_all else _join_levels(a, b, arrays, room)
    r, c = torch.from_numpy(found).unbind(1)
    return (r, c), n


@jit
def _join_all(a, b, arrays, room):
    """Return the pairs (n, 2) that may block among all, and how many were candidates."""
    out, count, n = np.empty((STARTING_ROOM, 2), dtype=np.int64), 0, 0
    a, b, arrays, room = borrowed(a), borrowed(b), borrowed(arrays), borrowed(room)
    for i in range(len(a[0])):
        for j in range(len(b[0])):
            verdict = _look(a, b, (i, j), arrays, room)
            n += verdict > 0
            if verdict == BLOCKS:
                out = _with_room(out, count)
                out[count, 0], out[count, 1] = a[0][i], b[0][j]
                count += 1
    return out[:count].copy(), n


@jit
def _join_levels(a, b, arrays, room):
    """Return the pairs (n, 2) that may block among those that touch a common cell, and how many were candidates."""
    out, count, n = np.empty((STARTING_ROOM, 2), dtype=np.int64), 0, 0
    a, b, arrays, room = borrowed(a), borrowed(b), borrowed(arrays), borrowed(room)
    finest_a, finest_b = a[2].max(), b[2].max()
    begin = np.empty(4 ** min(finest_a, finest_b) + 2, dtype=np.int64)
    for level_a in range(finest_a + 1):
        of_a = np.flatnonzero(a[2] == level_a)
        if len(of_a) == 0:
            continue
        for level_b in range(finest_b + 1):
            of_b = np.flatnonzero(b[2] == level_b)
            if len(of_b) == 0:
                continue
            side = 2 ** min(level_a, level_b)
            cells_a, cells_b = _cells(a[1], of_a, side), _cells(b[1], of_b, side)
            held = _fill(begin, cells_b, side)
            for corner in range(4):
                for i in range(len(of_a)):
                    x, y = cells_a[i, 0] + corner % 2, cells_a[i, 1] + corner // 2
                    if x > cells_a[i, 2] or y > cells_a[i, 3]:
                        continue
                    for place in range(begin[y * side + x], begin[y * side + x + 1]):
                        j = held[place]
                        if max(cells_a[i, 0], cells_b[j, 0]) != x or max(cells_a[i, 1], cells_b[j, 1]) != y:
                            continue  # seen in another cell
                        places = of_a[i], of_b[j]
                        verdict = _look(a, b, places, arrays, room)
                        n += verdict > 0
                        if verdict == BLOCKS:
                            out = _with_room(out, count)
                            out[count, 0], out[count, 1] = a[0][places[0]], b[0][places[1]]
                            count += 1
    return out[:count].copy(), n


@jit
def _with_room(out, count):
    """Return the rows, of which `count` are taken, with room for one more."""
    if count < len(out):
        return out
    more = np.empty((2 * len(out), 2), dtype=np.int64)
    more[: len(out)] = out
    return more


@inlined
def _look(a, b, places, arrays, room):
    """Return APART, CANDIDATE or BLOCKS, the last where a candidate may do so, of two things."""
    if not _meet(a, b, places, arrays):
        return APART
    return BLOCKS if may_block((a[0][places[0]], b[0][places[1]]), arrays[1], room) else CANDIDATE


@inlined
def _meet(a, b, places, arrays):
    """Return whether the rectangles, depths and times of two things overlap and they are different faces."""
    i, j = places
    p, q = a[1], b[1]
    if p[i, 0] > q[j, 2] or q[j, 0] > p[i, 2] or p[i, 1] > q[j, 3] or q[j, 1] > p[i, 3] or q[j, 4] > p[i, 4]:
        return False
    r, c = a[0][i], b[0][j]
    (face_r, face_c), (thing, blocker, _) = arrays
    if face_r[r] == face_c[c]:
        return False
    first, last = thing[2][r, 0], thing[2][r, 1]
    start, end = blocker[1][c, 0], blocker[1][c, 1]
    if thing[0].shape[1] == 1:
        return first >= start and (first < end or end == 1)
    return max(first, start) < min(last, end)


@jit
def _cells(box, of, side):
    """Return the first and last cell x, y, x, y (n, 4) of things `of` (n,), of `side` by `side` cells."""
    out = np.empty((len(of), 4), dtype=np.int64)
    for k in range(len(of)):
        for d in range(4):
            out[k, d] = min(max(int(np.floor(box[of[k], d] * side)), 0), side - 1)
    return out


@jit
def _fill(begin, cells, side):
    """Return what each cell holds, cell by cell, and write where each begins to `begin`."""
    begin[: side * side + 2] = 0
    for k in range(len(cells)):
        for y in range(cells[k, 1], cells[k, 3] + 1):
            for x in range(cells[k, 0], cells[k, 2] + 1):
                begin[y * side + x + 2] += 1
    for cell in range(2, side * side + 2):
        begin[cell] += begin[cell - 1]
    held = np.empty(begin[side * side + 1], dtype=np.int64)
    for corner in range(4):
        for k in range(len(cells)):
            x, y = cells[k, 0] + corner % 2, cells[k, 1] + corner // 2
            if x <= cells[k, 2] and y <= cells[k, 3]:
                held[begin[y * side + x + 1]] = k
                begin[y * side + x + 1] += 1
    return held
