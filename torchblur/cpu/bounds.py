"""What prisms can do at most, compiled: bounds and crossings as survey.py has them, prism by prism.

Before: jit.py.  After: survey.py.
Symbols: as in survey.py; a place is a tile of the screen in a slice of time.
Source: as survey.py.
"""

from __future__ import annotations

import numpy as np

from torchblur.cpu.jit import inlined, jit


@jit
def bound(clip, flags, orders_by_w, noise):
    """Return whether each prism rests on screen (P,) bool, its facing (P,) int8 and its nearness (2, P).

    Args:
        clip: (2, 3, 4, P) corners.
        flags: parity (P,), and whether each prism is clipped (P,).
        orders_by_w: depth order by 1 / w, else by z / w.
        noise: share of the product of the corners' sizes that may be rounding.
    """
    parity, is_clipped = flags
    n = clip.shape[3]
    rests, facing, nearness = np.empty(n, dtype=np.bool_), np.zeros(n, dtype=np.int8), np.empty((2, n))
    for k in range(n):
        is_still, is_proper, low, high = True, not is_clipped[k], np.inf, -np.inf
        for c in range(3):
            for d in range(4):
                is_still &= clip[0, c, d, k] == clip[1, c, d, k]
            for e in range(2):
                z, w = clip[e, c, 2, k], clip[e, c, 3, k]
                is_proper &= w > 0
                near = 1 / w if orders_by_w else 2 - z / w
                low, high = min(low, near), max(high, near)
        rests[k] = is_still
        nearness[0, k], nearness[1, k] = (low, high) if is_proper else (-np.inf, np.inf)
        if not is_clipped[k]:
            facing[k] = _facing(clip, k, parity[k], noise)
    return rests, facing, nearness


@inlined
def _facing(clip, k, parity, noise):
    """Return +1 or -1 where all Bernstein coefficients of D have that sign, or 0."""
    rows0 = rows1 = rows2 = rows3 = 0.0
    for i in range(2):
        for j in range(2):
            bx, by, bw = clip[i, 1, 0, k], clip[i, 1, 1, k], clip[i, 1, 3, k]
            cx, cy, cw = clip[j, 2, 0, k], clip[j, 2, 1, k], clip[j, 2, 3, k]
            x, y, w = by * cw - bw * cy, bw * cx - bx * cw, bx * cy - by * cx
            for end in range(2):
                value = clip[end, 0, 0, k] * x + clip[end, 0, 1, k] * y + clip[end, 0, 3, k] * w
                order = i + j + end
                if order == 0:
                    rows0 += value
                elif order == 1:
                    rows1 += value / 3
                elif order == 2:
                    rows2 += value / 3
                else:
                    rows3 += value
    size = noise
    for c in range(3):
        longest = 0.0
        for e in range(2):
            x, y, w = clip[e, c, 0, k], clip[e, c, 1, k], clip[e, c, 3, k]
            longest = max(longest, x * x + y * y + w * w)
        size *= np.sqrt(longest)
    least = min(min(rows0, rows1), min(rows2, rows3)) * parity
    most = max(max(rows0, rows1), max(rows2, rows3)) * parity
    if min(least, most) > size:
        return 1
    return -1 if max(least, most) < -size else 0


@jit
def may_cross(seen, slices, size, rules):
    """Return whether the nearness of two prisms overlaps in a place in which one of them moves.

    Args:
        seen: bounds (4, P) [px], nearness (2, P), whether each moves (P,), whether each is left out (P,).
        slices: first and last slice of time (P,) int64 of each, exclusive, and how many there are.
        size: of the image [px].
        rules: tiles along a side, one after the other; most places of a prism and slice on average; overlap that is
            rounding.
    """
    bounds, nearness, moves, is_out = seen
    first, last, n_slices = slices
    grids, most_places, touching = rules
    n, total, n_prisms = 1, 0, len(moves)
    tiles = np.empty((n_prisms, 4), dtype=np.int64)
    for grid in grids:
        n, total, n_spans = grid, 0, 0
        for k in range(n_prisms):
            if is_out[k]:
                continue
            for d in range(4):
                share = min(max(bounds[d, k], 0.0), size[d % 2]) / size[d % 2]
                tiles[k, d] = min(int(share * grid), grid - 1)
            spans = last[k] - first[k]
            total += (tiles[k, 2] - tiles[k, 0] + 1) * (tiles[k, 3] - tiles[k, 1] + 1) * spans
            n_spans += spans
        if total <= most_places * n_spans:
            break
    is_lively = np.zeros(n_slices * n * n, dtype=np.bool_)
    counts = np.zeros(len(is_lively) + 1, dtype=np.int64)
    for k in range(n_prisms):
        if is_out[k]:
            continue
        for s in range(first[k], last[k]):
            for y in range(tiles[k, 1], tiles[k, 3] + 1):
                for x in range(tiles[k, 0], tiles[k, 2] + 1):
                    place = (s * n + y) * n + x
                    is_lively[place] |= moves[k]
                    counts[place + 1] += 1
    # most scenes that may cross show it by any one prism of each place
    one = np.full(len(is_lively), -1)
    for k in range(n_prisms):
        if is_out[k]:
            continue
        for s in range(first[k], last[k]):
            for y in range(tiles[k, 1], tiles[k, 3] + 1):
                for x in range(tiles[k, 0], tiles[k, 2] + 1):
                    place = (s * n + y) * n + x
                    if not is_lively[place]:
                        continue
                    if one[place] < 0:
                        one[place] = k
                    elif _overlap(nearness, one[place], k, touching):
                        return True
    begin = np.cumsum(counts)
    held, filled = np.empty(total, dtype=np.int64), begin[:-1].copy()
    for k in range(n_prisms):
        if is_out[k]:
            continue
        for s in range(first[k], last[k]):
            for y in range(tiles[k, 1], tiles[k, 3] + 1):
                for x in range(tiles[k, 0], tiles[k, 2] + 1):
                    place = (s * n + y) * n + x
                    held[filled[place]] = k
                    filled[place] += 1
    for place in range(len(is_lively)):
        own = held[begin[place] : begin[place + 1]]
        if len(own) < 2 or not is_lively[place]:
            continue
        # sorted by their least, two overlap somewhere just if two neighbours do
        order = own[np.argsort(nearness[0][own], kind="mergesort")]
        for k in range(1, len(order)):
            if nearness[0, order[k]] * (1 + touching) < nearness[1, order[k - 1]]:
                return True
    return False


@inlined
def _overlap(nearness, a, b, touching):
    """Return whether the nearness of two prisms overlaps by more than rounding."""
    if nearness[0, a] <= nearness[0, b]:
        return nearness[0, b] * (1 + touching) < nearness[1, a]
    return nearness[0, a] * (1 + touching) < nearness[1, b]
