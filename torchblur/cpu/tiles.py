"""What covers the rays of a tile of pixels, and how far they are closed in time.

Before: sweep.py.  After: fill.py, blend.py.
Symbols: P prisms, in order of their greatest nearness; a tile is a square of pixels; its time is cut into SLICES. A
slice of a ray is closed at a nearness n once opaque intervals that abut cover all of it and are nowhere less near than
n: what is less near throughout is not seen in it (Boulos et al. 2010 cull by depth and time likewise).
Source: Ronnow et al. 2021, sec. 4; tiles and closing slices: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchblur.cpu.jit import inner
from torchblur.cpu.polynomials import sort_by
from torchblur.cpu.sweep import HIGH, IS_OPAQUE, N_NUMBERS, PRISM, RANK, T_END, T_START, Ray
from torchblur.hidden import CLEARLY

SLICES = 8
TILE_PX = 16


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


@inner
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


@inner
def close(
    cover: np.ndarray, run: np.ndarray, pixel: int, interval: tuple[float, float, float], window: tuple[float, float]
) -> bool:
    """Note that an opaque interval (start, end, least nearness) covers a ray; return whether this closes a slice."""
    start, end, nearness = interval
    length = (window[1] - window[0]) / SLICES
    first, last = _slices((start, end), window)
    is_closer = False
    for s in range(first, last + 1):
        if nearness <= cover[pixel, s]:
            continue
        opens = window[0] + s * length
        closes = window[0] + (s + 1) * length if s < SLICES - 1 else window[1]
        a, b = max(start, opens), min(end, closes)
        if a <= run[pixel, s, 1] and b >= run[pixel, s, 0]:
            a, b = min(a, run[pixel, s, 0]), max(b, run[pixel, s, 1])
            run[pixel, s, 0], run[pixel, s, 1], run[pixel, s, 2] = a, b, min(nearness, run[pixel, s, 2])
        elif b - a > run[pixel, s, 1] - run[pixel, s, 0]:
            run[pixel, s, 0], run[pixel, s, 1], run[pixel, s, 2] = a, b, nearness
        if run[pixel, s, 0] <= opens and run[pixel, s, 1] >= closes:
            cover[pixel, s] = max(cover[pixel, s], run[pixel, s, 2])
            run[pixel, s, 0], run[pixel, s, 1] = np.inf, -np.inf
            is_closer = True
    return is_closer


@inner
def _slices(times: tuple[float, float], window: tuple[float, float]) -> tuple[int, int]:
    """Return the first and the last slice that a time reaches."""
    scale = SLICES / (window[1] - window[0])
    first, last = int((times[0] - window[0]) * scale), int((times[1] - window[0]) * scale)
    return min(max(first, 0), SLICES - 1), min(max(last, 0), SLICES - 1)


@inner
def cover_of(cover: np.ndarray, pixel: int, times: tuple[float, float], window: tuple[float, float]) -> float:
    """Return the nearness at which a ray is closed all through some time."""
    first, last = _slices(times, window)
    least = cover[pixel, first]
    for s in range(first + 1, last + 1):
        least = min(least, cover[pixel, s])
    return least


@inner
def with_room(tile: Tile, n: int) -> Tile:
    """Return the tile with room for `n` intervals more."""
    have = tile.counts[0]
    if have + n <= len(tile.prism):
        return tile
    most = max(2 * len(tile.prism), have + n)
    data, prism, following = np.empty((most, N_NUMBERS)), np.empty(most, np.int64), np.empty(most, np.int64)
    for i in range(have):  # slices take seconds to compile
        prism[i], following[i] = tile.prism[i], tile.next[i]
        for c in range(N_NUMBERS):
            data[i, c] = tile.data[i, c]
    return Tile(tile.place, data, prism, following, tile.last, tile.cover, tile.least, tile.run, tile.counts)


@inner
def clear(tile: Tile) -> None:
    """Forget what covers the tile."""
    last, least, cover, run = tile.last, tile.least, tile.cover, tile.run
    tile.counts[0] = 0
    for pixel in range(tile.place[2] * tile.place[3]):
        last[pixel], least[pixel] = -1, 0.0
        for k in range(SLICES):
            cover[pixel, k], run[pixel, k, 0], run[pixel, k, 1] = 0.0, np.inf, -np.inf


@inner
def least_of(cover: np.ndarray, pixel: int) -> float:
    """Return the nearness at which a ray is closed all the time."""
    least = cover[pixel, 0]
    for s in range(1, SLICES):
        least = min(least, cover[pixel, s])
    return least


@inner
def count_ray(tile: Tile, pixel: int) -> int:
    """Return how many intervals of a ray were found."""
    following = tile.next
    n, i = 0, tile.last[pixel]
    while i >= 0:
        n += 1
        i = following[i]
    return n


@inner
def gather_ray(geometry: Geometry, tile: Tile, pixel: int, window: tuple[float, float], ray: Ray) -> int:
    """Write the intervals of a ray that are not hidden to `ray` in order of their starts, and return their number."""
    following, found, cover, active = tile.next, tile.data, tile.cover, ray.active
    n, i = 0, tile.last[pixel]
    while i >= 0:
        if found[i, HIGH] >= (1 - CLEARLY) * cover_of(cover, pixel, (found[i, T_START], found[i, T_END]), window):
            active[n] = i
            n += 1
        i = following[i]
    sort_by(found, T_START, active, n)
    data, mark, prism = ray.data, ray.mark, tile.prism
    scene_prism, rank, is_opaque = geometry.prism, geometry.rank, geometry.is_opaque
    for m in range(n):
        i = active[m]
        k = prism[i]
        for c in range(N_NUMBERS):
            data[m, c] = found[i, c]
        mark[m, PRISM], mark[m, RANK], mark[m, IS_OPAQUE] = scene_prism[k], rank[k], is_opaque[k]
    return n
