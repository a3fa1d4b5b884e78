"""Join what receives light with what may block it, compiled: each pair that meets is solved at once.

Before: jit.py, blocked.py.  After: shadow_pairs.py.
Symbols: as in shadow_pairs.py; a thing is a receiver or a caster in a view. What an opaque caster blocks all the time
nothing else changes: of each receiver the longest time is known for which opaque casters are known to block its light.
Source: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchblur.cpu.blocked import MOST_PIECES, find_blocked, work_room
from torchblur.cpu.jit import borrowed, inlined, jit
from torchblur.cpu.sides import shared_time
from torchblur.sort import SAME_TIME

Things = tuple[Tensor, Tensor, Tensor, Tensor]
STARTING_ROOM = 1 << 12  # pieces
APART = -1
FINER, FINEST = 2, 8  # levels: how much finer cells are than a caster's own, as receivers are small; and of all
ROUNDING = 1e-9  # of a part of a caster's time
MOST_OF = 0.5  # of the shared time: what is shorter is looked at alone


class Found(NamedTuple):
    """What is known of one light after some of its views."""

    keys: np.ndarray  # (room, 3) int64 receiver and caster of each piece of time, and the receiver's piece before it
    times: np.ndarray  # (room, 2) float64 shares of the receiver's slice at which it begins and ends
    count: int  # of the pieces
    last: np.ndarray  # (K,) int64 the last piece of each receiver, or -1
    known: np.ndarray  # (K, 2) float64 share of the slice in which opaque casters block
    was_seen: tuple[np.ndarray, np.ndarray]  # (K,) and (C,) bool: which receivers and casters were in a view before

    @classmethod
    def nothing(cls, n_receivers: int, n_casters: int) -> Found:
        """Return what is known before the first view. Source: ours."""
        seen = np.zeros(n_receivers, dtype=np.bool_), np.zeros(n_casters, dtype=np.bool_)
        last, known = np.full(n_receivers, -1), np.zeros((n_receivers, 2))
        return cls(np.empty((STARTING_ROOM, 3), dtype=np.int64), np.empty((STARTING_ROOM, 2)), 0, last, known, seen)

    def rows(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return receiver, caster, start and end (R,) of all pieces. Source: ours."""
        keys, times = torch.from_numpy(self.keys[: self.count]), torch.from_numpy(self.times[: self.count])
        return keys[:, 0], keys[:, 1], times[:, 0], times[:, 1]


def join(receiver: Things, caster: Things, sees_all: bool, arrays: tuple, found: Found) -> tuple[Found, int]:
    """Return what is known after a view, and how many pairs were looked at in it.

    Args:
        receiver: which (n,), box (5, n) of least x and y, greatest x and y in [0, 1], and depth, level (n,), and
            nothing more.
        caster: likewise, and (parts, 4, n) least and greatest x and y in equal parts of its time.
        sees_all: whether to look at all pairs rather than at those that touch a common cell.
        arrays: faces of the receivers (K,) and of the casters (C,), whether each caster (C,) hides all behind it, and
            what `sides.arrays_of` returns.
        found: before the view.

    Source: ours.
    """
    a, b = (
        (w.numpy(), box.T.contiguous().numpy(), level.numpy(), parts.permute(2, 0, 1).contiguous().numpy())
        for w, box, level, parts in (receiver, caster)
    )
    look = _join_all if sees_all else _join_levels
    keys, times, count, n = look(a, b, arrays, found, work_room())
    for was_seen, things in zip(found.was_seen, (a, b), strict=True):
        was_seen[things[0]] = True
    return found._replace(keys=keys, times=times, count=count), n


@jit
def _join_all(a, b, arrays, found, room):
    """Return the pieces, and how many pairs were looked at, of all pairs."""
    keys, times, count, n = found.keys, found.times, found.count, 0
    more = borrowed((arrays, (found.last, found.known, found.was_seen), room))
    a, b = borrowed(a), borrowed(b)
    for i in range(len(a[0])):
        for j in range(len(b[0])):
            if _is_dark(a[0][i], more):
                break
            if count + MOST_PIECES > len(keys):
                keys, times = _with_room(keys), _with_room(times)
            n_pieces = _look((a, b), (i, j), more, (borrowed(keys), borrowed(times), count))
            if n_pieces != APART:
                n += 1
                count += n_pieces
    return keys, times, count, n


@jit
def _join_levels(a, b, arrays, found, room):
    """Return the pieces, and how many pairs were looked at, of those that touch a common cell."""
    keys, times, count, n = found.keys, found.times, found.count, 0
    more = borrowed((arrays, (found.last, found.known, found.was_seen), room))
    a, b = borrowed(a), borrowed(b)
    finest_a, finest_b = a[2].max(), b[2].max()
    begin = np.empty(4 ** min(finest_a, finest_b + FINER, FINEST) + 2, dtype=np.int64)
    for level_a in range(finest_a + 1):
        of_a = np.flatnonzero(a[2] == level_a)
        if len(of_a) == 0:
            continue
        for level_b in range(finest_b + 1):
            of_b = np.flatnonzero(b[2] == level_b)
            if len(of_b) == 0:
                continue
            side = 2 ** min(level_a, level_b + FINER, FINEST)
            cells_a, cells_b = _cells(a[1], of_a, side), _cells(b[1], of_b, side)
            held = _fill(begin, cells_b, side)
            for i in range(len(of_a)):
                if _is_dark(a[0][of_a[i]], more):
                    continue
                for corner in range(4):
                    x, y = cells_a[i, 0] + corner % 2, cells_a[i, 1] + corner // 2
                    if x > cells_a[i, 2] or y > cells_a[i, 3]:
                        continue
                    for place in range(begin[y * side + x], begin[y * side + x + 1]):
                        if _is_dark(a[0][of_a[i]], more):
                            break
                        j = held[place]
                        if max(cells_a[i, 0], cells_b[j, 0]) != x or max(cells_a[i, 1], cells_b[j, 1]) != y:
                            continue  # seen in another cell
                        if count + MOST_PIECES > len(keys):
                            keys, times = _with_room(keys), _with_room(times)
                        places = of_a[i], of_b[j]
                        n_pieces = _look((a, b), places, more, (borrowed(keys), borrowed(times), count))
                        if n_pieces != APART:
                            n += 1
                            count += n_pieces
    return keys, times, count, n


@jit
def _with_room(rows):
    """Return twice as many rows, of which the first are these."""
    more = np.empty((2 * len(rows), rows.shape[1]), dtype=rows.dtype)
    more[: len(rows)] = rows
    return more


@inlined
def _is_dark(r, more):
    """Return whether opaque casters are known to block the light of a receiver all the time."""
    known = more[1][1]
    return known[r, 0] <= 0 and known[r, 1] >= 1


@inlined
def _look(things, places, more, out):
    """Write the pieces of two things to `out` after the first `count` of its rows, and return how many these are, or
    APART where the things do not meet or nothing of them is unknown.
    """
    (a, b), (arrays, state, _) = things, more
    if not _meet(a, b, places, arrays):
        return APART
    pair = a[0][places[0]], b[0][places[1]]
    parts = _parts_met(a, b, places, arrays[1])
    if parts[1] < parts[0]:
        return 0
    start, end = state[1][pair[0], 0], state[1][pair[0], 1]
    shared = _narrowed(shared_time(pair, arrays[1]), parts, arrays[1][1][1][pair[1]], b[3].shape[1], (start, end))
    return _solve(pair, shared, more, out) if shared[0] <= shared[1] else APART


@jit
def _solve(pair, shared, more, out):
    """Write the pieces of a pair (receiver, caster) in a time that both share, as `_look` does, unless it is listed."""
    r, c = pair
    ((_, _, hides), of_pair), (last, known, (receiver_was_seen, caster_was_seen)), room = more
    keys, times, count = out
    if receiver_was_seen[r] and caster_was_seen[c]:  # on another side of the cube
        row = last[r]
        while row >= 0:
            if keys[row, 1] == c:
                return 0
            row = keys[row, 2]
    pieces, n = room[0], find_blocked(pair, shared, of_pair, room)
    for k in range(n):
        start, end, row = pieces[k, 0], pieces[k, 1], count + k
        keys[row, 0], keys[row, 1], keys[row, 2] = r, c, last[r]
        times[row, 0], times[row, 1] = start, end
        last[r] = row
        if not hides[c]:
            continue
        if start <= known[r, 1] + SAME_TIME and end >= known[r, 0] - SAME_TIME and known[r, 1] > known[r, 0]:
            known[r, 0], known[r, 1] = min(known[r, 0], start), max(known[r, 1], end)
        elif end - start > known[r, 1] - known[r, 0]:
            known[r, 0], known[r, 1] = start, end
    return n


@inlined
def _meet(a, b, places, arrays):
    """Return whether the rectangles, depths and times of two things overlap and they are different faces."""
    i, j = places
    p, q = a[1], b[1]
    if p[i, 0] > q[j, 2] or q[j, 0] > p[i, 2] or p[i, 1] > q[j, 3] or q[j, 1] > p[i, 3] or q[j, 4] > p[i, 4]:
        return False
    r, c = a[0][i], b[0][j]
    (face_r, face_c, _), (thing, blocker, _) = arrays
    if face_r[r] == face_c[c]:
        return False
    first, last = thing[2][r, 0], thing[2][r, 1]
    start, end = blocker[1][c, 0], blocker[1][c, 1]
    if thing[0].shape[1] == 1:
        return first >= start and (first < end or end == 1)
    return max(first, start) < min(last, end)


@inlined
def _parts_met(a, b, places, arrays):
    """Return the first and the last part of a caster's time, if any, that a receiver shares and in which its rectangle
    overlaps the receiver's.
    """
    i, j = places
    box, parts = a[1], b[3]
    times, slices = arrays[0][2], arrays[1][1]
    r, c, n = a[0][i], b[0][j], parts.shape[1]
    rate = n / (slices[c, 1] - slices[c, 0])
    first = max(int((times[r, 0] - slices[c, 0]) * rate - ROUNDING), 0)
    last = min(int((times[r, 1] - slices[c, 0]) * rate + ROUNDING), n - 1)
    low, high = n, -1
    for k in range(first, last + 1):
        if (
            box[i, 0] <= parts[j, k, 2]
            and parts[j, k, 0] <= box[i, 2]
            and box[i, 1] <= parts[j, k, 3]
            and parts[j, k, 1] <= box[i, 3]
        ):
            low, high = min(low, k), k
    return low, high


@inlined
def _narrowed(shared, parts, times, n, known):
    """Return of a time that receiver and caster share what lies in the first to last of the `n` parts of the caster's
    `times`, without parts at the ends that are `known` to be dark; if nothing is left, what begins after it ends.
    """
    t_start, t_end, u_start, u_end = shared
    low, high = parts
    if t_start == t_end:
        return shared
    step, stretch = (times[1] - times[0]) / n, (u_end - u_start) / (t_end - t_start)
    while (
        low <= high
        and known[0] <= _share(low, times, step, shared)
        and _share(low + 1, times, step, shared) <= known[1]
    ):
        low += 1
    while (
        low <= high
        and known[0] <= _share(high, times, step, shared)
        and _share(high + 1, times, step, shared) <= known[1]
    ):
        high -= 1
    first, last = times[0] + low * step, times[0] + (high + 1) * step
    if high < low:
        return 1.0, 0.0, 0.0, 0.0
    if last - first > MOST_OF * (t_end - t_start):
        return shared
    if first > t_start:
        t_start, u_start = first, u_start + (first - t_start) * stretch
    if last < t_end:
        t_end, u_end = last, u_end + (last - t_end) * stretch
    return t_start, t_end, u_start, u_end


@inlined
def _share(k, times, step, shared):
    """Return when part `k` of a caster's `times` begins, as a share of the receiver's, in their `shared` time."""
    t_start, t_end, u_start, u_end = shared
    t = times[0] + k * step
    if t <= t_start:
        return u_start
    return u_end if t >= t_end else u_start + (t - t_start) * (u_end - u_start) / (t_end - t_start)


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
    for k in range(len(cells)):
        for y in range(cells[k, 1], cells[k, 3] + 1):
            for x in range(cells[k, 0], cells[k, 2] + 1):
                held[begin[y * side + x + 1]] = k
                begin[y * side + x + 1] += 1
    return held
