"""Find what each ray of a tile of pixels sees in time, tile by tile, without solving what is hidden.

Before: coverage.py, sweep.py.  After: blend.py.
Symbols: P prisms, in order of their greatest nearness; a tile is a square of pixels; its time is cut into SLICES. A
slice of a ray is closed at a nearness n once opaque intervals that abut cover all of it and are nowhere less near than
n: what is less near throughout is not seen in it (Boulos et al. 2010 cull by depth and time likewise).
Source: Ronnow et al. 2021, sec. 4; tiles and closing slices: ours.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from torchblur.cpu.coverage import Work, find_pieces, nearness_of
from torchblur.cpu.jit import jit
from torchblur.cpu.sweep import DEN, HIGH, LOW, N_NUMBERS, NUM, T_END, T_START, Ray, make_ray, sort_by
from torchblur.hidden import CLEARLY
from torchblur.intervals import SHORTEST
from torchblur.pairs import ROUNDING
from torchblur.prisms import BOUND_SLACK_PX

SLICES = 8
TILE_PX = 32
EVERY = 16  # prisms after which the tile's cover is looked at anew
PAIRS = np.array(list(itertools.combinations(range(6), 2)))
X, Y, W, Z = 0, 1, 2, 3


class Geometry(NamedTuple):
    """The prisms to look at, the nearest first."""

    clip: np.ndarray  # (P, 2, 3, 4) x y w z
    t: np.ndarray  # (P, 2) slice of time
    corners_px: np.ndarray  # (P, 2, 6), NaN where there is no hull
    bounds_px: np.ndarray  # (P, 4)
    high: np.ndarray  # (P,) greatest nearness, inf where there is none
    allowed: np.ndarray  # (P,) int8 sign of the edges that is seen, 0 for both
    is_clipped: np.ndarray  # (P,) bool
    is_still: np.ndarray  # (P,) bool
    hides: np.ndarray  # (P,) bool
    is_opaque: np.ndarray  # (P,) bool: nothing of the ray is seen behind it
    prism: np.ndarray  # (P,) int64 which of the scene's
    rank: np.ndarray  # (P,) int64 tie rank of the face


class View(NamedTuple):
    """The rays of an image."""

    width: int
    height: int
    x_px: float  # place of the ray inside each pixel
    y_px: float
    start: float  # of the window of time
    end: float
    orders_by_w: bool
    may_cross: bool


class Tile(NamedTuple):
    """The rays of a tile, what covers them, and how they are closed."""

    place: np.ndarray  # (4,) int64: first column, first row, columns, rows
    data: np.ndarray  # (room, N_NUMBERS) all intervals found, see sweep.py
    prism: np.ndarray  # (room,) int64 place of their prism
    next: np.ndarray  # (room,) int64 interval of the same ray found before, -1 for none
    last: np.ndarray  # (pixels,) int64 interval found last, -1 for none
    cover: np.ndarray  # (pixels, SLICES) nearness at which a slice is closed, 0 while it is open
    least: np.ndarray  # (pixels,) of cover
    run: np.ndarray  # (pixels, SLICES, 3) start, end, least nearness of the opaque run that may close the slice
    counts: np.ndarray  # (3,) int64 intervals now; pairs solved and left out in all


@jit
def make_tile() -> Tile:
    """Return room for a tile."""
    n, room = TILE_PX * TILE_PX, 8 * TILE_PX * TILE_PX
    return Tile(
        np.empty(4, np.int64),
        np.empty((room, N_NUMBERS)),
        np.empty(room, np.int64),
        np.empty(room, np.int64),
        np.empty(n, np.int64),
        np.empty((n, SLICES)),
        np.empty(n),
        np.empty((n, SLICES, 3)),
        np.zeros(3, np.int64),
    )


@jit
def _columns(corners: np.ndarray, level: float, low: int, high: int, x_px: float) -> tuple[int, int]:
    """Return the first and last column, between `low` and `high`, inside the hull of corners; see pairs.py."""
    x, y = corners[0], corners[1]
    left, right, most = np.inf, -np.inf, 0.0
    for k in range(6):
        most = max(most, max(abs(x[k]), abs(y[k])))
    for k in range(len(PAIRS)):
        i, j = PAIRS[k, 0], PAIRS[k, 1]
        if (y[i] <= level) != (y[j] <= level):
            place = x[i] + (level - y[i]) / (y[j] - y[i]) * (x[j] - x[i])
            left, right = min(left, place), max(right, place)
    slack = BOUND_SLACK_PX + ROUNDING * most
    if not left <= right or not slack < 1:
        return low, high
    first, last = np.ceil(left - slack - x_px), np.floor(right + slack - x_px)
    return int(min(max(first, low), high + 1)), int(max(min(last, high), low - 1))


@jit
def _close(tile: Tile, pixel: int, interval: tuple[float, float, float], window: tuple[float, float]) -> None:
    """Note that an opaque interval (start, end, least nearness) covers a ray."""
    start, end, nearness = interval
    length = (window[1] - window[0]) / SLICES
    first = min(max(int((start - window[0]) / length), 0), SLICES - 1)
    last = min(max(int((end - window[0]) / length), 0), SLICES - 1)
    is_closer = False
    for s in range(first, last + 1):
        if nearness <= tile.cover[pixel, s]:
            continue
        opens = window[0] + s * length
        closes = window[0] + (s + 1) * length if s < SLICES - 1 else window[1]
        a, b = max(start, opens), min(end, closes)
        run = tile.run[pixel, s]
        if a <= run[1] and b >= run[0]:
            run[0], run[1], run[2] = min(a, run[0]), max(b, run[1]), min(nearness, run[2])
        elif b - a > run[1] - run[0]:
            run[0], run[1], run[2] = a, b, nearness
        if run[0] <= opens and run[1] >= closes:
            tile.cover[pixel, s] = max(tile.cover[pixel, s], run[2])
            run[0], run[1] = np.inf, -np.inf
            is_closer = True
    if is_closer:
        least = tile.cover[pixel, 0]
        for s in range(1, SLICES):
            least = min(least, tile.cover[pixel, s])
        tile.least[pixel] = least


@jit
def _cover_of(tile: Tile, pixel: int, times: tuple[float, float], window: tuple[float, float]) -> float:
    """Return the nearness at which a ray is closed all through some time."""
    length = (window[1] - window[0]) / SLICES
    first = min(max(int((times[0] - window[0]) / length), 0), SLICES - 1)
    last = min(max(int((times[1] - window[0]) / length), 0), SLICES - 1)
    least = tile.cover[pixel, first]
    for s in range(first + 1, last + 1):
        least = min(least, tile.cover[pixel, s])
    return least


@jit
def _grown(tile: Tile) -> Tile:
    """Return the tile with twice the room for intervals."""
    n = len(tile.prism)
    data, prism, following = np.empty((2 * n, N_NUMBERS)), np.empty(2 * n, np.int64), np.empty(2 * n, np.int64)
    data[:n], prism[:n], following[:n] = tile.data, tile.prism, tile.next
    return Tile(tile.place, data, prism, following, tile.last, tile.cover, tile.least, tile.run, tile.counts)


@jit
def _solve(geometry: Geometry, view: View, tile: Tile, who: tuple[int, int, float, float], work: Work) -> Tile:
    """Find the intervals in which a prism covers a ray, `who`: prism, pixel of the tile, x and y in NDC."""
    k, pixel, x_ndc, y_ndc = who
    corner, clip = work.corner, geometry.clip[k]
    for end in range(2):
        for c in range(3):
            w = clip[end, c, W]
            corner[end, c, 0] = clip[end, c, X] - x_ndc * w
            corner[end, c, 1] = clip[end, c, Y] - y_ndc * w
            corner[end, c, 2], corner[end, c, 3] = w, clip[end, c, Z]
    n_pieces = find_pieces(work, geometry.is_clipped[k], geometry.is_still[k], geometry.allowed[k])
    window, opens, closes = (view.start, view.end), geometry.t[k, 0], geometry.t[k, 1]
    for m in range(n_pieces):
        start, end = work.piece[m, 0], work.piece[m, 1]
        t_start, t_end = (1 - start) * opens + start * closes, (1 - end) * opens + end * closes
        if not t_end - t_start > SHORTEST * (view.end - view.start):
            continue
        n = tile.counts[0]
        if n == len(tile.prism):
            tile = _grown(tile)
        data = tile.data[n]
        nearness_of(work, start, end, view.orders_by_w, data[NUM:LOW])
        low, high = -np.inf, np.inf
        den = data[DEN:LOW]
        if (den[0] > 0 and den[1] > 0 and den[2] > 0 and den[3] > 0) or (
            den[0] < 0 and den[1] < 0 and den[2] < 0 and den[3] < 0
        ):
            low, high = np.inf, -np.inf
            for c in range(4):
                ratio = data[NUM + c] / den[c]
                low, high = min(low, ratio), max(high, ratio)
        if high < (1 - CLEARLY) * _cover_of(tile, pixel, (t_start, t_end), window):
            continue
        data[T_START], data[T_END], data[LOW], data[HIGH] = t_start, t_end, low, high
        tile.prism[n], tile.next[n] = k, tile.last[pixel]
        tile.last[pixel] = n
        tile.counts[0] = n + 1
        if geometry.hides[k] and low > 0:
            _close(tile, pixel, (t_start, t_end, low), window)
    return tile


@jit
def fill_tile(geometry: Geometry, view: View, tile: Tile, prisms: np.ndarray, work: Work) -> Tile:
    """Find the intervals of all rays of a tile.

    Args:
        geometry: of the prisms.
        view: the image.
        tile: whose place is set.
        prisms: (n,) which may touch the tile, in ascending order.
        work: room.

    Source: ours.
    """
    x0, y0, width, height = tile.place[0], tile.place[1], tile.place[2], tile.place[3]
    n_pixels = width * height
    tile.counts[0] = 0
    tile.last[:n_pixels] = -1
    tile.cover[:n_pixels] = 0.0
    tile.least[:n_pixels] = 0.0
    tile.run[:n_pixels, :, 0] = np.inf
    tile.run[:n_pixels, :, 1] = -np.inf
    for m in range(len(prisms)):
        k = prisms[m]
        high, bounds = geometry.high[k], geometry.bounds_px[k]
        if m % EVERY == 0 and high < (1 - CLEARLY) * tile.least[:n_pixels].min():
            break
        first_row = int(max(np.ceil(max(bounds[1], -1.0) - view.y_px), y0))
        last_row = int(min(np.floor(min(bounds[3], float(view.height)) - view.y_px), y0 + height - 1))
        low = int(max(np.ceil(max(bounds[0], -1.0) - view.x_px), x0))
        most = int(min(np.floor(min(bounds[2], float(view.width)) - view.x_px), x0 + width - 1))
        if low > most:
            continue
        times, window = (geometry.t[k, 0], geometry.t[k, 1]), (view.start, view.end)
        is_whole = times[0] <= view.start and times[1] >= view.end
        for row in range(first_row, last_row + 1):
            first, last = _columns(geometry.corners_px[k], row + view.y_px, low, most, view.x_px)
            y_ndc = 1 - 2 * (row + view.y_px) / view.height
            for column in range(first, last + 1):
                pixel = (row - y0) * width + column - x0
                cover = tile.least[pixel] if is_whole else _cover_of(tile, pixel, times, window)
                if high < (1 - CLEARLY) * cover:
                    tile.counts[2] += 1
                    continue
                tile.counts[1] += 1
                x_ndc = 2 * (column + view.x_px) / view.width - 1
                tile = _solve(geometry, view, tile, (k, pixel, x_ndc, y_ndc), work)
    return tile


@jit
def gather_ray(geometry: Geometry, tile: Tile, pixel: int, window: tuple[float, float], ray: Ray) -> tuple[Ray, int]:
    """Return the intervals of a ray that are not hidden in order of their starts, and their number."""
    n, i = 0, tile.last[pixel]
    while i >= 0:
        n += 1
        i = tile.next[i]
    if n > len(ray.prism):
        ray = make_ray(2 * n)
    n, i = 0, tile.last[pixel]
    while i >= 0:
        own = tile.data[i]
        if own[HIGH] >= (1 - CLEARLY) * _cover_of(tile, pixel, (own[T_START], own[T_END]), window):
            ray.active[n] = i
            n += 1
        i = tile.next[i]
    sort_by(tile.data[:, T_START], n, ray.active)
    for m in range(n):
        i = ray.active[m]
        k = tile.prism[i]
        for c in range(N_NUMBERS):
            ray.data[m, c] = tile.data[i, c]
        ray.prism[m], ray.rank[m] = geometry.prism[k], geometry.rank[k]
        ray.is_opaque[m] = geometry.is_opaque[k]
    return ray, n
