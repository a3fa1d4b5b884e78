"""What the rays of tiles see: composited at once where colours are constant, else listed for the plain path.

Before: tiles.py.  After: visibility.py.
Symbols: S shutters, C channels: N_LOOKS looks and one for each mesh; N intervals, K cells, L layers.
Source: Ronnow et al. 2021, alg. 1 (resolve).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchblur.cells import MIN_CELL
from torchblur.cpu.coverage import make_work
from torchblur.cpu.jit import jit
from torchblur.cpu.sweep import N_NUMBERS, Cells, Ray, make_cells, make_ray, make_solver, sweep
from torchblur.cpu.tiles import TILE_PX, Geometry, View, fill_tile, gather_ray, make_tile

N_LOOKS = 6  # channels: premultiplied colour, opacity, direct light without and with shadows
COMPOSITE, LIST_CELLS, LIST_INTERVALS = 0, 1, 2
DOWN, UP, RIGHT = 0, 1, 2  # else left
FIRST_ROOM = 1024
COUNTS = ("intervals", "cells", "layers", "crossings", "deepest_pixel", "pairs", "hidden_pairs")


class Colours(NamedTuple):
    """What constant faces look like, and when it counts."""

    rgb: np.ndarray  # (prisms of the scene, 3)
    opacity: np.ndarray  # (prisms of the scene,)
    mesh: np.ndarray  # (prisms of the scene,) int64
    first: np.ndarray  # (S + 1,) int64 first knot of each shutter
    time: np.ndarray  # knots of all shutters
    weight: np.ndarray  # at these
    delay: np.ndarray  # (S,) of a line
    direction: np.ndarray  # (S,) int64
    cutoff: float


class Listed(NamedTuple):
    """What the rays see, pixel by pixel in the order in which they were visited."""

    pixel: np.ndarray  # (room, 3) int64: pixel of the image, intervals, cells
    data: np.ndarray  # (room, N_NUMBERS) intervals
    prism: np.ndarray  # (room,) int64 of the intervals
    t: np.ndarray  # (room, 2) cells
    n_layers: np.ndarray  # (room,) int64 of the cells
    layer: np.ndarray  # (room,) int64 interval of the same pixel
    size: np.ndarray  # (4,) int64 pixels, intervals, cells, layers


@jit
def _integral(colours: Colours, s: int, t: float) -> float:
    """Return the weight of shutter `s` before a time of its first line; see `Shutter.weight`. Not yet divided."""
    total = 0.0
    for k in range(colours.first[s], colours.first[s + 1] - 1):
        start, end = colours.time[k], colours.time[k + 1]
        if t <= start:
            break
        into, rise = min(t, end) - start, colours.weight[k + 1] - colours.weight[k]
        total += into * (colours.weight[k] + 0.5 * into * rise / (end - start))
    return total


@jit
def _composite(colours: Colours, ray: Ray, cells: Cells, delays: np.ndarray, out: np.ndarray) -> None:
    """Add what the cells of a ray show to `out` (S, C); `delays` (3, S) of its line, area of the weights, room."""
    n_shutters, n_meshes = out.shape[0], out.shape[1] - N_LOOKS
    seen = np.zeros(n_meshes, np.int64)
    for k in range(cells.count[0]):
        for s in range(n_shutters):
            start, end = cells.t[k, 0] - delays[0, s], cells.t[k, 1] - delays[0, s]
            delays[2, s] = (_integral(colours, s, end) - _integral(colours, s, start)) / delays[1, s]
        red, green, blue, left = 0.0, 0.0, 0.0, 1.0
        for m in range(cells.first[k], cells.first[k + 1]):
            prism = ray.prism[cells.layer[m]]
            alpha = colours.opacity[prism]
            weight = left * alpha
            red += weight * colours.rgb[prism, 0]
            green += weight * colours.rgb[prism, 1]
            blue += weight * colours.rgb[prism, 2]
            mesh = colours.mesh[prism]
            if alpha > 0 and seen[mesh] != k + 1:
                seen[mesh] = k + 1
                for s in range(n_shutters):
                    out[s, N_LOOKS + mesh] += delays[2, s]
            left *= 1 - alpha
            if not left > colours.cutoff:
                break
        for s in range(n_shutters):
            out[s, 0] += delays[2, s] * red
            out[s, 1] += delays[2, s] * green
            out[s, 2] += delays[2, s] * blue
            out[s, 3] += delays[2, s] * (1 - left)


@jit
def _roomier(a: np.ndarray, n: int) -> np.ndarray:
    """Return an array with room for at least `n` rows and the rows of `a`."""
    if n <= len(a):
        return a
    bigger = np.empty((max(2 * len(a), n), *a.shape[1:]), a.dtype)
    bigger[: len(a)] = a
    return bigger


@jit
def _list(listed: Listed, ray: Ray, n: int, cells: Cells, pixel: int) -> Listed:
    """Append the intervals and the cells of a ray."""
    n_pixels, n_intervals, n_cells, n_layers = listed.size
    count = cells.count[0]
    layers = cells.first[count]
    listed = Listed(
        _roomier(listed.pixel, n_pixels + 1),
        _roomier(listed.data, n_intervals + n),
        _roomier(listed.prism, n_intervals + n),
        _roomier(listed.t, n_cells + count),
        _roomier(listed.n_layers, n_cells + count),
        _roomier(listed.layer, n_layers + layers),
        listed.size,
    )
    listed.pixel[n_pixels, 0], listed.pixel[n_pixels, 1], listed.pixel[n_pixels, 2] = pixel, n, count
    listed.data[n_intervals : n_intervals + n] = ray.data[:n]
    listed.prism[n_intervals : n_intervals + n] = ray.prism[:n]
    listed.t[n_cells : n_cells + count] = cells.t[:count]
    for k in range(count):
        listed.n_layers[n_cells + k] = cells.first[k + 1] - cells.first[k]
    listed.layer[n_layers : n_layers + layers] = cells.layer[:layers]
    listed.size[:] = n_pixels + 1, n_intervals + n, n_cells + count, n_layers + layers
    return listed


@jit
def see_tiles(
    geometry: Geometry,
    view: View,
    bins: tuple[np.ndarray, np.ndarray, np.ndarray],
    colours: Colours,
    image: np.ndarray,
    mode: int,
) -> tuple[Listed, np.ndarray]:
    """Look along all rays of some tiles.

    Args:
        geometry, view: prisms and image.
        bins: tiles to look at, offsets of all tiles' prisms, and these prisms.
        colours: of constant faces.
        image: (H, W, S, C) to which to add, for COMPOSITE.
        mode: COMPOSITE, LIST_CELLS or LIST_INTERVALS.

    Returns:
        What was listed, and COUNTS.

    Source: ours.
    """
    which, offsets, prisms = bins
    n_across = (view.width + TILE_PX - 1) // TILE_PX
    tile, work, solver = make_tile(), make_work(), make_solver()
    ray, cells = make_ray(64), make_cells(256, 1024)
    counts = np.zeros(len(COUNTS), np.int64)
    room = FIRST_ROOM if mode != COMPOSITE else 1
    listed = Listed(
        np.empty((room, 3), np.int64),
        np.empty((room, N_NUMBERS)),
        np.empty(room, np.int64),
        np.empty((room, 2)),
        np.empty(room, np.int64),
        np.empty(room, np.int64),
        np.zeros(4, np.int64),
    )
    n_shutters = len(colours.delay)
    delays = np.zeros((3, n_shutters))
    for s in range(n_shutters):
        delays[1, s] = _integral(colours, s, colours.time[colours.first[s + 1] - 1])
    window = (view.start, view.end)
    shortest = MIN_CELL * (view.end - view.start) if view.may_cross else np.inf
    for which_tile in which:
        x0, y0 = which_tile % n_across * TILE_PX, which_tile // n_across * TILE_PX
        width, height = min(TILE_PX, view.width - x0), min(TILE_PX, view.height - y0)
        tile.place[:] = x0, y0, width, height
        tile = fill_tile(geometry, view, tile, prisms[offsets[which_tile] : offsets[which_tile + 1]], work)
        for pixel in range(width * height):
            ray, n = gather_ray(geometry, tile, pixel, window, ray)
            if n == 0:
                continue
            column, row = x0 + pixel % width, y0 + pixel // width
            counts[0] += n
            counts[4] = max(counts[4], n)
            cells.count[:] = 0
            if mode != LIST_INTERVALS:
                cells = sweep(ray, n, cells, shortest, solver)
            counts[1] += cells.count[0]
            counts[2] += cells.first[cells.count[0]]
            counts[3] += cells.count[1]
            if mode != COMPOSITE:
                listed = _list(listed, ray, n, cells, row * view.width + column)
                continue
            for s in range(n_shutters):
                way = colours.direction[s]
                line = row if way == DOWN else view.height - 1 - row if way == UP else column
                if way > RIGHT:
                    line = view.width - 1 - column
                delays[0, s] = colours.delay[s] * line
            _composite(colours, ray, cells, delays, image[row, column])
    counts[5], counts[6] = tile.counts[1], tile.counts[2]
    return listed, counts


@jit
def bin_prisms(geometry: Geometry, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the offsets of the tiles' prisms, these in ascending order, and each tile's load [pairs]. Source: ours."""
    n_across, n_down = (view.width + TILE_PX - 1) // TILE_PX, (view.height + TILE_PX - 1) // TILE_PX
    n = len(geometry.prism)
    span = np.empty((n, 4), np.int64)
    offsets = np.zeros(n_across * n_down + 1, np.int64)
    load = np.zeros(n_across * n_down)
    for k in range(n):
        b = geometry.bounds_px[k]
        span[k, 0] = int(min(max(b[0], 0.0), float(view.width))) // TILE_PX
        span[k, 1] = int(min(max(b[1], 0.0), float(view.height))) // TILE_PX
        span[k, 2] = min(int(min(max(b[2], 0.0), float(view.width))) // TILE_PX, n_across - 1)
        span[k, 3] = min(int(min(max(b[3], 0.0), float(view.height))) // TILE_PX, n_down - 1)
        for row in range(span[k, 1], span[k, 3] + 1):
            for column in range(span[k, 0], span[k, 2] + 1):
                which = row * n_across + column
                offsets[which + 1] += 1
                left, right = max(b[0], column * TILE_PX), min(b[2], (column + 1) * TILE_PX)
                load[which] += (right - left + 1) * (min(b[3], (row + 1) * TILE_PX) - max(b[1], row * TILE_PX) + 1)
    offsets = np.cumsum(offsets)
    filled = offsets.copy()
    prisms = np.empty(offsets[-1], np.int64)
    for k in range(n):
        for row in range(span[k, 1], span[k, 3] + 1):
            for column in range(span[k, 0], span[k, 2] + 1):
                which = row * n_across + column
                prisms[filled[which]] = k
                filled[which] += 1
    return offsets, prisms, load
