"""Integrate the layers of a span, or of a cell in which nothing varies, over the exposure: nodes.py and resolve.py.

Before: bends.py, panels.py, shine.py.  After: expose.py.
Symbols: S shutters; spans are cut where looks bend, and the panels between get as many of Gauss's nodes as panels.py
asks for.
Source: Ronnow et al. 2021, alg. 1 (resolve); Gauss-Legendre quadrature; ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchblur.cpu.bends import Bends
from torchblur.cpu.blend import N_LOOKS, Colours, integral
from torchblur.cpu.curves import LIT, MIPPED, MULTIPLIES, TEXTURED, Span
from torchblur.cpu.jit import inlined, inner
from torchblur.cpu.lambert import Lit
from torchblur.cpu.layers import Looks
from torchblur.cpu.panels import Panel, count_nodes, expand, reach
from torchblur.cpu.receive import Shade
from torchblur.cpu.shine import level_at, look_at, place_at
from torchblur.nodes import COUNTS, FREE_HALVINGS, MANY, MAX_HALVINGS
from torchblur.sort import SAME_TIME

NODE, SHARE = np.zeros((2, COUNTS[-1] + 1, COUNTS[-1]))  # on [-1, 1], and weights that add up to 1
for _n in range(1, COUNTS[-1] + 1):
    NODE[_n, :_n], SHARE[_n, :_n] = np.polynomial.legendre.leggauss(_n)
SHARE *= 0.5
DELAY, AREA, WEIGHT, LEVEL, RISE, N_ROWS = 0, 1, 2, 3, 4, 5  # of what is kept of each shutter


class Room(NamedTuple):
    """What the rays of a thread work in."""

    shutter: np.ndarray  # (N_ROWS, S): delay of the line, area of the weights, weight of a
    #                      sample; and over a span the weight at its start and the rise to its end
    ends: np.ndarray  # (most spans + 1,) shares of the cell at which its spans end
    stack: np.ndarray  # (MAX_HALVINGS + 2, 3) panels yet to be done: start, end, halvings
    moment: np.ndarray  # (2, S, 4) integrals of 1, x, y, x y over a panel, for the finer and the coarser level
    corner: np.ndarray  # (2, 2) first column and row of the texels looked up, by level
    seen: np.ndarray  # (M,) int64 sample in which a mesh was seen last
    count: np.ndarray  # (3,) int64 samples, panels halved often in this span, and the last panel's ellipse


@inner
def make_room(colours: Colours, n_knots: int, n_meshes: int) -> Room:
    """Return room for rays under the shutters of `colours` and lights with so many knots."""
    n_shutters = len(colours.delay)
    room = Room(
        np.zeros((N_ROWS, n_shutters)),
        np.empty(len(colours.time) + n_knots + 2),
        np.empty((MAX_HALVINGS + 2, 3)),
        np.empty((2, n_shutters, 4)),
        np.empty((2, 2)),
        np.zeros(max(1, n_meshes), np.int64),
        np.zeros(3, np.int64),
    )
    for s in range(n_shutters):
        room.shutter[AREA, s] = integral(colours, s, colours.time[colours.first[s + 1] - 1])
    return room


@inlined
def add_still(
    what: tuple[Span, Panel],
    n_layers: int,
    scene: tuple[Looks, Lit, Shade, Colours],
    when: tuple[float, float, Room],
    out: np.ndarray,
) -> None:
    """Add what a cell between two shutter times shows in which nothing varies."""
    looks, lit, shade, colours = scene
    start, end, room = when
    shutter = room.shutter
    for s in range(len(colours.delay)):
        delay = shutter[DELAY, s]
        whole = integral(colours, s, end - delay) - integral(colours, s, start - delay)
        shutter[WEIGHT, s] = whole / shutter[AREA, s]
    reach(what[0], n_layers, (lit, shade), 0.5, what[1])
    _add_sample(what, n_layers, (looks, lit, colours.cutoff), (0.0, room), out)


@inlined
def _add_sample(
    what: tuple[Span, Panel], n_layers: int, scene: tuple[Looks, Lit, float], when: tuple[float, Room], out: np.ndarray
) -> None:
    """Add what is seen at a time of a panel, front to back, by the shutters' weights."""
    looks, lit, cutoff = scene
    time, room = when
    weight, seen = room.shutter[WEIGHT], room.seen
    room.count[0] += 1
    stamp = room.count[0]
    red, green, blue, due, arriving, left = 0.0, 0.0, 0.0, 0.0, 0.0, 1.0
    for m in range(n_layers):
        r, g, b, alpha, light = look_at(what[0], what[1], m, (looks, lit), time)
        part = left * alpha
        red, green, blue = red + part * r, green + part * g, blue + part * b
        due, arriving = due + part * light[0], arriving + part * light[1]
        mesh = looks.mesh_of[what[0].face[m]]
        if alpha > 0 and seen[mesh] != stamp:
            seen[mesh] = stamp
            for s in range(len(out)):
                out[s, N_LOOKS + mesh] += weight[s]
        left *= 1 - alpha
        if not left > cutoff:
            break
    for s in range(len(out)):
        share = weight[s]
        out[s, 0] += share * red
        out[s, 1] += share * green
        out[s, 2] += share * blue
        out[s, 3] += share * (1 - left)
        out[s, 4] += share * due
        out[s, 5] += share * arriving


@inlined
def _weigh_span(colours: Colours, when: tuple[float, float, Room]) -> bool:
    """Write the shutters' weights at a span's start, and their rise to its end; return whether all are constant."""
    start, end, room = when
    middle, is_even = 0.5 * (start + end), True
    for s in range(len(colours.delay)):
        delay = room.shutter[DELAY, s]
        room.shutter[LEVEL, s] = room.shutter[RISE, s] = 0.0
        for k in range(colours.first[s], colours.first[s + 1] - 1):
            t0, t1 = colours.time[k], colours.time[k + 1]
            if not (t0 <= middle - delay <= t1):
                continue
            w0, rise = colours.weight[k], colours.weight[k + 1] - colours.weight[k]
            slope = rise / (t1 - t0) / room.shutter[AREA, s]
            room.shutter[LEVEL, s] = w0 / room.shutter[AREA, s] + (start - delay - t0) * slope
            room.shutter[RISE, s] = (end - start) * slope
            is_even &= rise == 0
            break
    return is_even


@inlined
def add_varying(
    what: tuple[Span, Panel],
    seen: tuple[int, int, Bends],
    scene: tuple[Looks, Lit, Shade, Colours],
    when: tuple[float, float, Room],
    out: np.ndarray,
) -> None:
    """Add what a span shows whose looks vary; `seen` is how many layers, how many bends, and these."""
    n_layers, n_bends, bends = seen
    (span, panel), (looks, lit, shade, colours), (start, end, room) = what, scene, when
    tau, stack, shutter = bends.tau, room.stack, room.shutter
    is_even = _weigh_span(colours, when)
    is_simple = n_layers == 1 and span.flags[0] & (TEXTURED | LIT | MULTIPLIES) == TEXTURED
    is_simple &= looks.opacity[span.face[0]] == 1
    room.count[1] = 0
    for k in range(n_bends - 1):
        if not tau[k + 1] - tau[k] > SAME_TIME:
            continue
        stack[0, 0], stack[0, 1], stack[0, 2] = tau[k], tau[k + 1], 0.0
        top = 1
        while top > 0:
            top -= 1
            a, b, halvings = stack[top, 0], stack[top, 1], stack[top, 2]
            middle, half = 0.5 * (a + b), 0.5 * (b - a)
            expand(span, n_layers, lit, (middle, half), panel)
            reach(span, n_layers, (lit, shade), middle, panel)
            n, room.count[2] = count_nodes(span, n_layers, (looks, lit), panel, (is_even, room.count[2]))
            if n == 0:
                if halvings >= FREE_HALVINGS:
                    room.count[1] += 1
                if halvings < MAX_HALVINGS and room.count[1] <= MANY:
                    stack[top, 0], stack[top, 1], stack[top, 2] = middle, b, halvings + 1
                    stack[top + 1, 0], stack[top + 1, 1], stack[top + 1, 2] = a, middle, halvings + 1
                    top += 2
                    continue
                n = COUNTS[-1]
            part = (middle, half, 2 * half * (end - start))
            if is_simple:
                _add_panel(what, looks, (n, part), room, out)
                continue
            for j in range(n):
                for s in range(len(out)):
                    level = shutter[LEVEL, s] + (middle + half * NODE[n, j]) * shutter[RISE, s]
                    shutter[WEIGHT, s] = part[2] * SHARE[n, j] * level
                _add_sample(what, n_layers, (looks, lit, colours.cutoff), (NODE[n, j], room), out)


@inlined
def _add_panel(
    what: tuple[Span, Panel],
    looks: Looks,
    nodes: tuple[int, tuple[float, float, float]],
    room: Room,
    out: np.ndarray,
) -> None:
    """Add what a panel shows of an opaque layer that is textured and no more: its texels are the same throughout, and
    weigh by the moments of the place between them. `nodes` is their number, and middle, half and length of the panel.
    """
    span, panel = what
    n, (middle, half, length) = nodes
    face, fine, moment, shutter = span.face[0], span.level[0, 0], room.moment, room.shutter
    mesh = looks.mesh_of[face]
    last, n_levels = looks.n_levels[mesh] - 1, 1
    if span.flags[0] & MIPPED:
        fine = int(level_at(panel, 0, last, 0.0))
        n_levels = 2 if fine < last else 1
    u, v = place_at(panel, 0, 0.0)
    for k in range(n_levels):
        width, height = looks.size[fine + k, 0, mesh], looks.size[fine + k, 1, mesh]
        room.corner[k, 0], room.corner[k, 1] = np.floor(u * width - 0.5), np.floor((1 - v) * height - 0.5)
        for s in range(len(out)):
            for c in range(4):
                moment[k, s, c] = 0.0
    for j in range(n):
        node = NODE[n, j]
        u, v = place_at(panel, 0, node)
        coarse = level_at(panel, 0, last, node) - fine if n_levels == 2 else 0.0
        for k in range(n_levels):
            x = u * looks.size[fine + k, 0, mesh] - 0.5 - room.corner[k, 0]
            y = (1 - v) * looks.size[fine + k, 1, mesh] - 0.5 - room.corner[k, 1]
            share = length * SHARE[n, j] * (coarse if k else 1 - coarse)
            for s in range(len(out)):
                weight = share * (shutter[LEVEL, s] + (middle + half * node) * shutter[RISE, s])
                moment[k, s, 0] += weight
                moment[k, s, 1] += weight * x
                moment[k, s, 2] += weight * y
                moment[k, s, 3] += weight * x * y
    room.count[0] += n
    for k in range(n_levels):
        _add_texels(looks, (face, mesh, fine + k), (room.corner[k, 0], room.corner[k, 1]), moment[k], out)


@inlined
def _add_texels(
    looks: Looks, which: tuple[int, int, int], corner: tuple[float, float], moment: np.ndarray, out: np.ndarray
) -> None:
    """Add the four texels about a `corner` of the texture of a face, mesh and level, by moments (S, 4)."""
    face, mesh, level = which
    width, height = looks.size[level, 0, mesh], looks.size[level, 1, mesh]
    column, row = int(corner[0]), int(corner[1])
    if looks.repeats[mesh]:
        column0, row0, column1, row1 = column % width, row % height, (column + 1) % width, (row + 1) % height
    else:
        column0, row0 = min(max(column, 0), width - 1), min(max(row, 0), height - 1)
        column1, row1 = min(max(column + 1, 0), width - 1), min(max(row + 1, 0), height - 1)
    first, texels = looks.first[level, mesh], looks.texels
    i, j = first + row0 * width + column0, first + row0 * width + column1
    k, m = first + row1 * width + column0, first + row1 * width + column1
    for s in range(len(out)):
        xy = moment[s, 3]
        right, below = moment[s, 1] - xy, moment[s, 2] - xy
        rest = moment[s, 0] - moment[s, 1] - below
        for c in range(3):
            total = rest * texels[i, c] + right * texels[j, c] + below * texels[k, c] + xy * texels[m, c]
            out[s, c] += looks.rgb[face, c] * total
        out[s, 3] += moment[s, 0]
        out[s, N_LOOKS + mesh] += moment[s, 0]
