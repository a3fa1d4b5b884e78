"""Look at listed cells whose looks may vary, one ray at a time: what light falls on in them, and what they show.

Before: blend.py, quadrature.py.  After: visibility.py.
Symbols: S shutters, C channels; a span is a slice of a cell in which neither the shutter nor a light has a knot; a cell
in which nothing varies is one.
Source: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchblur.cpu.bends import find_bends, make_bends
from torchblur.cpu.blend import N_LOOKS, Colours, Listed, write_delays
from torchblur.cpu.curves import LIT, VARYING, Stock, follow, make_span
from torchblur.cpu.jit import borrowed, inlined, jit
from torchblur.cpu.lambert import Lit
from torchblur.cpu.layers import Looks
from torchblur.cpu.panels import make_panel
from torchblur.cpu.quadrature import DELAY, Room, add_still, add_varying, make_room
from torchblur.cpu.receive import Received, Shade, make_received, receive, with_room
from torchblur.cpu.settle import receive_still, settle
from torchblur.cpu.tiles import View
from torchblur.sort import SAME_TIME

FIRST_ROOM = 256


class Scene(NamedTuple):
    """What there is, and how rays see it."""

    stock: Stock
    looks: Looks
    lit: Lit
    colours: Colours
    knots: np.ndarray  # (K,) shutter times at which a light bends
    rays: View


@jit
def expose(
    listed: Listed, scene: Scene, shades: tuple[Shade, Shade], begin: tuple[int, int, bool], image: np.ndarray
) -> tuple[int, Received, Received]:
    """Look at listed cells: collect what light falls on, or add what they show to an image (H, W, S, C).

    Args:
        listed: cells.
        scene: of them.
        shades: when light is blocked on receivers over spans, and on those at instants.
        begin: numbers of the first receivers of both kinds, and whether to collect them and no more.
        image: to add to.

    Returns:
        The number of samples, and the receivers over spans and at instants.

    Source: ours.
    """
    listed, image = borrowed(listed), borrowed(image)
    stock, looks, colours, view = borrowed(scene.stock), borrowed(scene.looks), borrowed(scene.colours), scene.rays
    knots, lit, shade, still_shade = (
        borrowed(scene.knots),
        borrowed(scene.lit),
        borrowed(shades[0]),
        borrowed(shades[1]),
    )
    n_lamps = len(lit.kind)
    number, still_number, is_collecting = begin
    moving, resting = make_received(FIRST_ROOM, n_lamps), make_received(FIRST_ROOM, n_lamps)
    span, panel, bends = make_span(8, n_lamps), make_panel(8, n_lamps), make_bends(FIRST_ROOM)
    still = make_panel(8, n_lamps)  # of what rests: its higher powers stay 0
    room = make_room(colours, len(knots), image.shape[3] - N_LOOKS)
    interval, cell, layer = 0, 0, 0
    for p in range(listed.size[0]):
        pixel, n_intervals, n_cells = listed.pixel[p, 0], listed.pixel[p, 1], listed.pixel[p, 2]
        row, column = pixel // view.width, pixel % view.width
        x_ndc = 2 * (column + view.x_px) / view.width - 1
        y_ndc = 1 - 2 * (row + view.y_px) / view.height
        write_delays(colours, view, (column, row), room.shutter[DELAY])
        for k in range(cell, cell + n_cells):
            n_layers = listed.n_layers[k]
            if n_layers > len(span.face):
                span, panel = make_span(2 * n_layers, n_lamps), make_panel(2 * n_layers, n_lamps)
                still = make_panel(2 * n_layers, n_lamps)
            t_start, t_end = listed.t[k, 0], listed.t[k, 1]
            varies = False
            for m in range(n_layers):
                prism = listed.prism[interval + listed.layer[layer + m]]
                varies |= stock.flags[stock.face[prism]] & VARYING != 0
            if not varies:
                middle = 0.5 * (t_start + t_end)
                for m in range(n_layers):
                    prism = listed.prism[interval + listed.layer[layer + m]]
                    settle(stock, (looks, lit), borrowed(span), borrowed(still), (m, prism, x_ndc, y_ndc, middle))
                    if span.flags[m] & LIT:
                        span.receiver[m] = still_number
                        still_number += 1
                        if is_collecting:
                            resting = with_room(resting)
                            receive_still(borrowed(span), borrowed(still), (m, middle), lit, borrowed(resting))
                if not is_collecting:
                    when = t_start, t_end, borrowed(room)
                    what, out = borrowed((span, still)), image[row, column]
                    add_still(what, n_layers, (looks, lit, still_shade, colours), when, out)
                layer += n_layers
                continue
            n_spans = _cut(colours, knots, (t_start, t_end), borrowed(room))
            for part in range(n_spans):
                start, end = t_start, t_end
                if n_spans > 1:
                    a, b = room.ends[part], room.ends[part + 1]
                    if not b - a > SAME_TIME:
                        continue
                    start, end = (1 - a) * t_start + a * t_end, (1 - b) * t_start + b * t_end
                for m in range(n_layers):
                    prism = listed.prism[interval + listed.layer[layer + m]]
                    follow(stock, looks, lit, borrowed(span), (m, prism, x_ndc, y_ndc, start, end))
                    if not span.flags[m] & LIT:
                        continue
                    span.receiver[m] = number
                    number += 1
                    if is_collecting:
                        moving = with_room(moving)
                        receive(borrowed(span), m, lit, (start, end), borrowed(moving))
                if is_collecting:
                    continue
                n = find_bends(borrowed(span), n_layers, (looks, lit), shade, borrowed(bends))
                if n < 0:
                    bends = make_bends(-2 * n)
                    n = find_bends(borrowed(span), n_layers, (looks, lit), shade, borrowed(bends))
                what, when = borrowed((span, panel)), (start, end, borrowed(room))
                add_varying(
                    what, (n_layers, n, borrowed(bends)), (looks, lit, shade, colours), when, image[row, column]
                )
            layer += n_layers
        interval, cell = interval + n_intervals, cell + n_cells
    return room.count[0], moving, resting


@inlined
def _cut(colours: Colours, knots: np.ndarray, times: tuple[float, float], room: Room) -> int:
    """Write the shares of a cell at which its spans end, and return how many spans there are."""
    ends = room.ends
    t_start, t_end = times
    n = 1
    ends[0] = 0.0
    for s in range(len(colours.delay)):
        for k in range(colours.first[s], colours.first[s + 1]):
            n = _put(ends, n, (colours.time[k] + room.shutter[DELAY, s] - t_start) / (t_end - t_start))
    for k in range(len(knots)):
        n = _put(ends, n, (knots[k] - t_start) / (t_end - t_start))
    ends[n] = 1.0
    return n


@inlined
def _put(ends: np.ndarray, n: int, share: float) -> int:
    """Insert a share of the cell's time, if inside, and return how many there are."""
    if not (share > 0 and share < 1):
        return n
    place = n
    while ends[place - 1] > share:
        ends[place] = ends[place - 1]
        place -= 1
    ends[place] = share
    return n + 1
