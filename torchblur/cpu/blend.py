"""What the rays of tiles see: composited at once where colours are constant, else listed for the plain path.

Before: fill.py, sweep.py.  After: visibility.py.
Symbols: S shutters, C channels: N_LOOKS looks and one for each mesh; N intervals, K cells, L layers.
Source: Ronnow et al. 2021, alg. 1 (resolve).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchblur.cells import MIN_CELL
from torchblur.cpu.batch import make_batch
from torchblur.cpu.coverage import make_work
from torchblur.cpu.fill import fill_tile
from torchblur.cpu.jit import borrowed, inlined, inner, jit
from torchblur.cpu.sweep import N_NUMBERS, NO_ROOM, PRISM, Cells, Ray, make_cells, make_ray, make_solver, sweep
from torchblur.cpu.tiles import TILE_PX, Geometry, View, count_ray, gather_ray, make_tile

N_LOOKS = 6  # channels: premultiplied colour, opacity, direct light without and with shadows
COMPOSITE, LIST_CELLS, LIST_INTERVALS = 0, 1, 2
DOWN, UP, RIGHT = 0, 1, 2  # else left
FIRST_ROOM = 1024
COUNTS = ("intervals", "cells", "layers", "crossings", "deepest_pixel", "pairs", "hidden_pairs")


class Colours(NamedTuple):
    """What constant faces look like, and when it counts."""

    look: np.ndarray  # (prisms of the scene, 4) straight RGB, opacity
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


@inner
def integral(colours: Colours, s: int, t: float) -> float:
    """Return the weight of shutter `s` before a time of its first line; see `Shutter.weight`. Not yet divided."""
    total, first, time, weight = 0.0, colours.first, colours.time, colours.weight
    for k in range(first[s], first[s + 1] - 1):
        start, end = time[k], time[k + 1]
        if t <= start:
            break
        into, rise = min(t, end) - start, weight[k + 1] - weight[k]
        total += into * (weight[k] + (0.5 * into * rise / (end - start) if rise != 0 else 0.0))
    return total


@inlined
def write_delays(colours: Colours, view: View, place: tuple[int, int], out: np.ndarray) -> None:
    """Write by how much the line of a pixel, at column and row, delays each shutter to `out` (S,)."""
    column, row = place
    for s in range(len(out)):
        way = colours.direction[s]
        line = row if way == DOWN else view.height - 1 - row if way == UP else column
        if way > RIGHT:
            line = view.width - 1 - column
        out[s] = colours.delay[s] * line


@inner
def _composite(
    colours: Colours,
    ray: Ray,
    seen_in: tuple[Cells, int],
    room: tuple[np.ndarray, np.ndarray],
    out: tuple[np.ndarray, int, int],
) -> None:
    """Add what the cells of a ray show to a pixel of an image (H, W, S, C).

    Args:
        colours, ray: what is seen.
        seen_in: cells of the ray, and their number.
        room: (4, S) delays of the line, areas of the weights, and room; (M,) int64 room.
        out: the image, row and column.
    """
    image, row, column = out
    delays, seen = room
    t, first, layer, mark = seen_in[0].t, seen_in[0].first, seen_in[0].layer, ray.mark
    look, mesh_of, cutoff = colours.look, colours.mesh, colours.cutoff
    n_shutters = image.shape[2]
    for k in range(len(seen)):
        seen[k] = 0
    for s in range(n_shutters):
        delays[3, s] = 0.0  # of the weight, before the last cell's end
    for k in range(seen_in[1]):
        is_gap = k == 0 or t[k - 1, 1] != t[k, 0]
        for s in range(n_shutters):
            before = integral(colours, s, t[k, 0] - delays[0, s]) if is_gap else delays[3, s]
            delays[3, s] = integral(colours, s, t[k, 1] - delays[0, s])
            delays[2, s] = (delays[3, s] - before) / delays[1, s]
        red, green, blue, left = 0.0, 0.0, 0.0, 1.0
        for m in range(first[k], first[k + 1]):
            prism = mark[layer[m], PRISM]
            alpha = look[prism, 3]
            weight = left * alpha
            red += weight * look[prism, 0]
            green += weight * look[prism, 1]
            blue += weight * look[prism, 2]
            mesh = mesh_of[prism]
            if alpha > 0 and seen[mesh] != k + 1:
                seen[mesh] = k + 1
                for s in range(n_shutters):
                    image[row, column, s, N_LOOKS + mesh] += delays[2, s]
            left *= 1 - alpha
            if not left > cutoff:
                break
        for s in range(n_shutters):
            image[row, column, s, 0] += delays[2, s] * red
            image[row, column, s, 1] += delays[2, s] * green
            image[row, column, s, 2] += delays[2, s] * blue
            image[row, column, s, 3] += delays[2, s] * (1 - left)


@inner
def _make_listed(n: int) -> Listed:
    """Return room for so many pixels, intervals, cells and layers."""
    ints = np.int64
    return Listed(
        np.empty((n, 3), ints),
        np.empty((n, N_NUMBERS)),
        np.empty(n, ints),
        np.empty((n, 2)),
        np.empty(n, ints),
        np.empty(n, ints),
        np.zeros(4, ints),
    )


@inner
def _with_room(listed: Listed, n: int) -> Listed:
    """Return the listed with room for `n` of everything."""
    room = len(listed.layer)
    if n <= room:
        return listed
    bigger = _make_listed(max(2 * room, n))
    for k in range(4):
        bigger.size[k] = listed.size[k]
    for k in range(listed.size[0]):
        for c in range(3):
            bigger.pixel[k, c] = listed.pixel[k, c]
    for k in range(listed.size[1]):
        bigger.prism[k] = listed.prism[k]
        for c in range(N_NUMBERS):
            bigger.data[k, c] = listed.data[k, c]
    for k in range(listed.size[2]):
        bigger.t[k, 0], bigger.t[k, 1], bigger.n_layers[k] = listed.t[k, 0], listed.t[k, 1], listed.n_layers[k]
    for k in range(listed.size[3]):
        bigger.layer[k] = listed.layer[k]
    return bigger


@inner
def _list(listed: Listed, ray: Ray, n: int, seen_in: tuple[Cells, int], pixel: int) -> Listed:
    """Append the intervals and the cells of a ray."""
    cells, count = seen_in
    size = listed.size
    n_pixels, n_intervals, n_cells, n_layers = size[0], size[1], size[2], size[3]
    layers = cells.first[count]
    listed = _with_room(listed, max(max(n_pixels + 1, n_intervals + n), max(n_cells + count, n_layers + layers)))
    listed.pixel[n_pixels, 0], listed.pixel[n_pixels, 1], listed.pixel[n_pixels, 2] = pixel, n, count
    for k in range(n):
        listed.prism[n_intervals + k] = ray.mark[k, PRISM]
        for c in range(N_NUMBERS):
            listed.data[n_intervals + k, c] = ray.data[k, c]
    for k in range(count):
        listed.t[n_cells + k, 0], listed.t[n_cells + k, 1] = cells.t[k, 0], cells.t[k, 1]
        listed.n_layers[n_cells + k] = cells.first[k + 1] - cells.first[k]
    for k in range(layers):
        listed.layer[n_layers + k] = cells.layer[k]
    size = listed.size
    size[0], size[1], size[2], size[3] = n_pixels + 1, n_intervals + n, n_cells + count, n_layers + layers
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
    geometry, colours, image = borrowed(geometry), borrowed(colours), borrowed(image)
    which, offsets, prisms = borrowed(bins)
    n_across = (view.width + TILE_PX - 1) // TILE_PX
    tile, batch, work, solver = make_tile(), make_batch(), make_work(), make_solver()
    ray, cells = make_ray(64), make_cells(256, 1024)
    counts = np.zeros(len(COUNTS), np.int64)
    listed = _make_listed(FIRST_ROOM if mode != COMPOSITE else 1)
    n_shutters = len(colours.delay)
    delays, seen = np.zeros((4, n_shutters)), np.zeros(max(0, image.shape[3] - N_LOOKS), np.int64)
    for s in range(n_shutters):
        delays[1, s] = integral(colours, s, colours.time[colours.first[s + 1] - 1])
    window = (view.start, view.end)
    shortest = MIN_CELL * (view.end - view.start) if view.may_cross else np.inf
    for which_tile in which:
        x0, y0 = which_tile % n_across * TILE_PX, which_tile // n_across * TILE_PX
        width, height = min(TILE_PX, view.width - x0), min(TILE_PX, view.height - y0)
        tile.place[0], tile.place[1], tile.place[2], tile.place[3] = x0, y0, width, height
        tile = fill_tile(geometry, view, tile, (prisms, offsets[which_tile], offsets[which_tile + 1]), (batch, work))
        for pixel in range(width * height):
            n = count_ray(borrowed(tile), pixel)
            if n > len(ray.until):
                ray = make_ray(2 * n)
            n = gather_ray(geometry, borrowed(tile), pixel, window, borrowed(ray))
            if n == 0:
                continue
            column, row = x0 + pixel % width, y0 + pixel // width
            counts[0] += n
            counts[4] = max(counts[4], n)
            n_cells, n_crossings = 0, 0
            while mode != LIST_INTERVALS:
                n_cells, n_crossings = sweep(borrowed(ray), n, borrowed(cells), shortest, borrowed(solver))
                if n_cells != NO_ROOM:
                    break
                cells = make_cells(2 * len(cells.t), 2 * len(cells.layer))
            counts[1] += n_cells
            counts[2] += cells.first[n_cells]
            counts[3] += n_crossings
            if mode != COMPOSITE:
                listed = _list(listed, ray, n, (cells, n_cells), row * view.width + column)
                continue
            write_delays(colours, view, (column, row), delays[0])
            _composite(
                colours, borrowed(ray), (borrowed(cells), n_cells), borrowed((delays, seen)), (image, row, column)
            )
    counts[5], counts[6] = tile.counts[1], tile.counts[2]
    return listed, counts


@jit
def bin_prisms(geometry: Geometry, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the offsets of the tiles' prisms, these in ascending order, and each tile's load [pairs]. Source: ours."""
    n_across, n_down = (view.width + TILE_PX - 1) // TILE_PX, (view.height + TILE_PX - 1) // TILE_PX
    n, b = len(geometry.prism), geometry.bounds_px
    span = np.empty((n, 4), np.int64)
    offsets, load = np.zeros(n_across * n_down + 1, np.int64), np.zeros(n_across * n_down)
    for k in range(n):
        for side in range(4):
            size, most = (view.width, n_across - 1) if side % 2 == 0 else (view.height, n_down - 1)
            span[k, side] = min(int(min(max(b[k, side], 0.0), float(size))) // TILE_PX, most)
        for row in range(span[k, 1], span[k, 3] + 1):
            for column in range(span[k, 0], span[k, 2] + 1):
                which = row * n_across + column
                offsets[which + 1] += 1
                left, right = max(b[k, 0], column * TILE_PX), min(b[k, 2], (column + 1) * TILE_PX)
                top, bottom = max(b[k, 1], row * TILE_PX), min(b[k, 3], (row + 1) * TILE_PX)
                load[which] += (right - left + 1) * (bottom - top + 1)
    filled = np.zeros(n_across * n_down, np.int64)
    for which in range(len(filled)):
        filled[which] = offsets[which]
        offsets[which + 1] += offsets[which]
    prisms = np.empty(offsets[len(filled)], np.int64)
    for k in range(n):
        for row in range(span[k, 1], span[k, 3] + 1):
            for column in range(span[k, 0], span[k, 2] + 1):
                which = row * n_across + column
                prisms[filled[which]] = k
                filled[which] += 1
    return offsets, prisms, load
