"""Find the intervals of all rays of a tile, prism by prism, the nearest first, without solving what is hidden.

Before: batch.py, coverage.py, tiles.py.  After: blend.py.
Symbols as in tiles.py. Pairs of prism and ray are solved in batches, see batch.py; clipped prisms and pairs that a
batch leaves are solved one by one, see coverage.py.
Source: Ronnow et al. 2021, sec. 4; tiles: ours.
"""

from __future__ import annotations

import itertools

import numpy as np

from torchblur.cpu import batch as batches
from torchblur.cpu.batch import Batch, W, X, Y, Z
from torchblur.cpu.coverage import Work, find_pieces, nearness_of
from torchblur.cpu.jit import borrowed, inner
from torchblur.cpu.sweep import DEN, HIGH, LOW, N_NUMBERS, NUM, T_END, T_START
from torchblur.cpu.tiles import TILE_PX, Geometry, Tile, View, clear, close, cover_of, least_of, with_room
from torchblur.hidden import CLEARLY
from torchblur.intervals import SHORTEST
from torchblur.pairs import ROUNDING
from torchblur.prisms import BOUND_SLACK_PX
from torchblur.sort import TIE

MOST_PIECES = 16  # more than the intervals of one pair
EVERY = 16  # prisms after which the tile's cover is looked at anew
WIDE = 5  # columns from which on the hull of a prism is worth its cost
PAIRS = np.array(list(itertools.combinations(range(6), 2)))
_U = np.uint64  # see batch.py


@inner
def _columns(c: np.ndarray, which: int, level: float, ends: tuple[int, int], x_px: float) -> tuple[int, int]:
    """Return the first and last column between `ends` inside the hull of the corners of a prism; see pairs.py."""
    low, high = ends
    left, right, most = np.inf, -np.inf, 0.0
    for k in range(6):
        most = max(most, max(abs(c[which, 0, k]), abs(c[which, 1, k])))
    for k in range(len(PAIRS)):
        i, j = PAIRS[k, 0], PAIRS[k, 1]
        y_i, y_j = c[which, 1, i], c[which, 1, j]
        if (y_i <= level) != (y_j <= level):
            place = c[which, 0, i] + (level - y_i) / (y_j - y_i) * (c[which, 0, j] - c[which, 0, i])
            left, right = min(left, place), max(right, place)
    slack = BOUND_SLACK_PX + ROUNDING * most
    if not left <= right or not slack < 1:
        return low, high
    first, last = np.ceil(left - slack - x_px), np.floor(right + slack - x_px)
    return int(min(max(first, low), high + 1)), int(max(min(last, high), low - 1))


@inner
def _solve_hard(geometry: Geometry, view: View, tile: Tile, who: tuple[int, int, float, float], work: Work) -> None:
    """Find the intervals in which a prism covers a ray, `who`: prism, pixel of the tile, x and y in NDC."""
    k, pixel, x_ndc, y_ndc = who
    corner, clip = work.corner, geometry.clip
    for end in range(2):
        for c in range(3):
            w = clip[k, end, c, W]
            corner[end, c, 0] = clip[k, end, c, X] - x_ndc * w
            corner[end, c, 1] = clip[k, end, c, Y] - y_ndc * w
            corner[end, c, 2], corner[end, c, 3] = w, clip[k, end, c, Z]
    n_pieces = find_pieces(work, geometry.is_clipped[k], geometry.is_still[k], geometry.allowed[k])
    first, data = tile.counts[0], tile.data
    for m in range(n_pieces):
        start, end, n = work.piece[m, 0], work.piece[m, 1], first + m
        nearness_of(work, start, end, view.orders_by_w, (data, n, NUM))
        is_front, is_back, low, high = True, True, np.inf, -np.inf
        for c in range(4):
            den = data[n, DEN + c]
            is_front, is_back = is_front and den > 0, is_back and den < 0
            ratio = data[n, NUM + c] / den
            low, high = min(low, ratio), max(high, ratio)
        if not (is_front or is_back):
            low, high = -np.inf, np.inf
        data[n, T_START], data[n, T_END] = start, end
        data[n, LOW], data[n, HIGH] = low, high
        tile.prism[n], tile.next[n] = k, pixel
    _keep(geometry, view, tile, n_pieces)


@inner
def _keep(geometry: Geometry, view: View, tile: Tile, n: int) -> None:
    """Take over `n` intervals that follow those of the tile, with local times and `next` their pixel: in shutter time,
    linked, and without those that are hidden.
    """
    data, prism, following, last_of = tile.data, tile.prism, tile.next, tile.last
    cover, run, least = tile.cover, tile.run, tile.least
    t, hides = geometry.t, geometry.hides
    window, shortest, place = (view.start, view.end), SHORTEST * (view.end - view.start), tile.counts[0]
    first = place
    for m in range(first, first + n):
        k, pixel, low, high = prism[m], following[m], data[m, LOW], data[m, HIGH]
        # ranges that are apart are so by more than surfaces that count as coplanar
        low, high = low - TIE * abs(low), high + TIE * abs(high)
        start, end = data[m, T_START], data[m, T_END]
        opens, closes = t[k, 0], t[k, 1]
        t_start, t_end = (1 - start) * opens + start * closes, (1 - end) * opens + end * closes
        if not t_end - t_start > shortest:
            continue
        if high < (1 - CLEARLY) * cover_of(cover, pixel, (t_start, t_end), window):
            continue
        if place != m:
            prism[place] = k
            for c in range(N_NUMBERS):
                data[place, c] = data[m, c]
        data[place, T_START], data[place, T_END], data[place, LOW], data[place, HIGH] = t_start, t_end, low, high
        following[place] = last_of[pixel]
        last_of[pixel] = place
        place += 1
        if hides[k] and low > 0 and close(cover, run, pixel, (t_start, t_end, low), window):
            least[pixel] = least_of(cover, pixel)
    tile.counts[0] = place


@inner
def _flush(geometry: Geometry, view: View, tile: Tile, batch: Batch, n: int, work: Work) -> Tile:
    """Find the intervals of the `n` pairs of a batch."""
    field, near, who, covered = batch.field, batch.near, batch.who, batch.covered
    batches.solve(field, n)
    n_covered = batches.gather_covered(batch, n)
    batches.restrict(near, n_covered)
    tile = with_room(tile, n_covered)
    own = borrowed(tile)
    data, prism, following, first, count = own.data, own.prism, own.next, own.counts[0], 0
    for m in range(_U(n_covered)):
        pair = covered[m]
        if near[m + batches.WEAK] != 0:
            field[_U(pair) + batches.STATE] = batches.HARD
            continue
        place = first + count
        for c in range(8):
            data[place, NUM + c] = near[m + _U(c * batches.ROOM)]
        data[place, T_START], data[place, T_END] = near[m + batches.FROM], near[m + batches.TO]
        data[place, LOW], data[place, HIGH] = near[m + batches.LOW], near[m + batches.HIGH]
        prism[place], following[place] = who[pair, 0], who[pair, 2]
        count += 1
    _keep(geometry, view, own, count)
    n_hard = 0  # listed first: a loop over all that may call would count references for each
    for m in range(_U(n)):
        if field[m + batches.STATE] == batches.HARD:
            covered[n_hard] = m
            n_hard += 1
    for m in range(n_hard):
        k, _, pixel = who[covered[m]]
        ray = _ray_of(view, tile.place[0] + pixel % tile.place[2], tile.place[1] + pixel // tile.place[2])
        tile = with_room(tile, MOST_PIECES)
        _solve_hard(geometry, view, borrowed(tile), (k, pixel, ray[0], ray[1]), work)
    return tile


@inner
def _ray_of(view: View, column: int, row: int) -> tuple[float, float]:
    """Return x and y of a pixel's ray in NDC."""
    return 2 * (column + view.x_px) / view.width - 1, 1 - 2 * (row + view.y_px) / view.height


@inner
def fill_tile(
    geometry: Geometry, view: View, tile: Tile, which: tuple[np.ndarray, int, int], room: tuple[Batch, Work]
) -> Tile:
    """Find the intervals of all rays of a tile.

    Args:
        geometry: of the prisms.
        view: the image.
        tile: whose place is set.
        which: prisms, and the first and last (exclusive) of those that may touch the tile; these ascend.
        room: for pairs that are solved together, and for single ones.

    Source: ours.
    """
    batch, work = borrowed(room)
    x0, y0, width, height = tile.place[0], tile.place[1], tile.place[2], tile.place[3]
    prisms, first, last = which
    clear(borrowed(tile))
    x_first, y_first = _ray_of(view, x0, y0)
    x_last, y_last = _ray_of(view, x0 + width - 1, y0 + height - 1)
    x_middle, y_middle = 0.5 * (x_first + x_last), 0.5 * (y_first + y_last)
    middle = (x_middle, y_middle, 0.5 * (x_last - x_first), 0.5 * (y_first - y_last))
    columns = (x_first - x_middle, 2 / view.width)
    window, bounds, who, pixels = (view.start, view.end), geometry.bounds_px, batch.who, batch.pixels
    own = borrowed(tile)
    cover, closed = own.cover, own.least  # not of those that grow
    highs, t, hulls = geometry.high, geometry.t, geometry.corners_px
    is_clipped, allowed_of = geometry.is_clipped, geometry.allowed
    setup, clip, field = batch.setup, geometry.clip, batch.field
    least, n, row_of, n_pairs, n_hidden = 0.0, 0, 0, 0, 0
    for m in range(first, last):
        k = prisms[m]
        high = highs[k]
        if (m - first) % EVERY == 0:
            least = np.inf
            for pixel in range(width * height):
                least = min(least, closed[pixel])
        if high < (1 - CLEARLY) * least:
            break
        first_row = int(max(np.ceil(max(bounds[k, 1], -1.0) - view.y_px), y0))
        last_row = int(min(np.floor(min(bounds[k, 3], float(view.height)) - view.y_px), y0 + height - 1))
        low = int(max(np.ceil(max(bounds[k, 0], -1.0) - view.x_px), x0))
        most = int(min(np.floor(min(bounds[k, 2], float(view.width)) - view.x_px), x0 + width - 1))
        if low > most or first_row > last_row:
            continue
        times = (t[k, 0], t[k, 1])
        is_whole = times[0] <= view.start and times[1] >= view.end
        is_set_up, is_hard, allowed = False, is_clipped[k], float(allowed_of[k])
        for row in range(first_row, last_row + 1):
            left, right = low, most
            if most - low >= WIDE:
                left, right = _columns(hulls, k, row + view.y_px, (low, most), view.x_px)
            count = 0
            for column in range(left - x0, right + 1 - x0):
                pixel = (row - y0) * width + column
                hidden_at = closed[pixel] if is_whole else cover_of(cover, pixel, times, window)
                if high < (1 - CLEARLY) * hidden_at:
                    n_hidden += 1
                    continue
                pixels[count] = column
                count += 1
            if count == 0:
                continue
            n_pairs += count
            if not (is_set_up or is_hard):
                is_set_up = True
                batches.set_up(clip, k, middle, view.orders_by_w, (setup, row_of))
            if is_hard:
                tile = with_room(tile, MOST_PIECES * count)
                for m_pixel in range(count):
                    x_ndc, y_ndc = _ray_of(view, x0 + pixels[m_pixel], row)
                    pixel = (row - y0) * width + pixels[m_pixel]
                    _solve_hard(geometry, view, borrowed(tile), (k, pixel, x_ndc, y_ndc), work)
                continue
            y = _ray_of(view, x0, row)[1] - y_middle
            batches.add_row((setup, field, pixels), n, (row_of, allowed, y, count), columns)
            for m_pixel in range(count):
                who[n, 0], who[n, 1], who[n, 2] = k, row_of, (row - y0) * width + pixels[m_pixel]
                n += 1
            if n > batches.ROOM - TILE_PX:
                tile = _flush(geometry, view, tile, batch, n, work)
                for c in range(batches.N_SETUP):
                    setup[0, c] = setup[row_of, c]
                n, row_of = 0, 0
        if is_set_up:
            row_of = row_of + 1 if n > 0 else 0
    tile.counts[1] += n_pairs
    tile.counts[2] += n_hidden
    return _flush(geometry, view, tile, batch, n, work)
