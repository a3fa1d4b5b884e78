"""What the layers of a cell show in which nothing varies, one ray at a time: one place, one normal, one way to a lamp.

Before: panels.py, receive.py.  After: expose.py.
Symbols as in curves.py, at one instant: S the sum of the edge functions e_i, P = S place.
Source: as curves.py, of which this is the constant term.
"""

from __future__ import annotations

import numpy as np

from torchblur.cpu.curves import ACROSS, CORNER, EDGE, LIT, MIPPED, TEXTURED, Span, Stock
from torchblur.cpu.jit import inlined
from torchblur.cpu.lambert import DIRECTIONAL, SPOT, Lit, along
from torchblur.cpu.layers import Looks
from torchblur.cpu.panels import Panel
from torchblur.cpu.receive import Received


@inlined
def settle(
    stock: Stock,
    scene: tuple[Looks, Lit],
    span: Span,
    panel: Panel,
    what: tuple[int, int, float, float, float],
) -> None:
    """Write how a layer looks to a panel of which only the first powers are used, and its kind to the span.

    Args:
        stock, scene: what there is.
        span, panel: to write to.
        what: place of the layer, prism, the ray's x and y in NDC, shutter time.
    """
    m, prism, x_ndc, y_ndc, t = what
    looks, lit = scene
    face = stock.face[prism]
    flags = stock.flags[face]
    span.face[m], span.flags[m] = face, flags
    if not flags & (TEXTURED | LIT):
        return
    corner, e = span.room[CORNER], span.room[EDGE]
    clip, t_open = stock.clip, stock.t[prism, 0]
    u = (t - t_open) / (stock.t[prism, 1] - t_open)
    for i in range(3):
        w0, w1 = clip[prism, 0, i, 2], clip[prism, 1, i, 2]
        corner[i] = (1 - u) * (clip[prism, 0, i, 0] - x_ndc * w0) + u * (clip[prism, 1, i, 0] - x_ndc * w1)
        corner[3 + i] = (1 - u) * (clip[prism, 0, i, 1] - y_ndc * w0) + u * (clip[prism, 1, i, 1] - y_ndc * w1)
        corner[6 + i] = (1 - u) * w0 + u * w1
    _edges(corner, 0, 3, e)
    panel.scale[m, 0] = e[0] + e[1] + e[2]
    if flags & TEXTURED:
        _settle_texture(stock, looks, span, panel, (m, prism))
    if flags & LIT:
        _settle_light(stock, lit, span, panel, (m, prism, u, t))


@inlined
def _edges(corner: np.ndarray, x: int, y: int, out: np.ndarray) -> None:
    """Write the cross products of the corners' numbers from `x` and from `y` on to `out`."""
    out[0] = corner[x + 1] * corner[y + 2] - corner[y + 1] * corner[x + 2]
    out[1] = corner[y] * corner[x + 2] - corner[x] * corner[y + 2]
    out[2] = corner[x] * corner[y + 1] - corner[y] * corner[x + 1]


@inlined
def _settle_texture(stock: Stock, looks: Looks, span: Span, panel: Panel, which: tuple[int, int]) -> None:
    """Write the place on the texture, and if it has smaller copies the footprint."""
    m, prism = which
    corner, e, across = span.room[CORNER], span.room[EDGE], span.room[ACROSS]
    face, uv = span.face[m], looks.uv
    c0, c1, c2 = stock.corner[prism, 0], stock.corner[prism, 1], stock.corner[prism, 2]
    for axis in range(2):
        panel.uv[m, axis, 0] = e[0] * uv[face, c0, axis] + e[1] * uv[face, c1, axis] + e[2] * uv[face, c2, axis]
    mesh = looks.mesh_of[face]
    if looks.n_levels[mesh] < 2:
        return
    span.flags[m] |= MIPPED
    scale = panel.scale[m, 0]
    for screen in range(2):
        _edges(corner, 3 if screen == 0 else 6, 6 if screen == 0 else 0, across)
        for axis in range(2):
            at, wide = panel.uv[m, axis, 0], looks.size[0, axis, mesh] * looks.step[screen]
            slope = across[0] * (scale * uv[face, c0, axis] - at) + across[1] * (scale * uv[face, c1, axis] - at)
            panel.slope[m, 0, 2 * screen + axis] = wide * (slope + across[2] * (scale * uv[face, c2, axis] - at))


@inlined
def _settle_light(stock: Stock, lit: Lit, span: Span, panel: Panel, layer: tuple[int, int, float, float]) -> None:
    """Write the place, the normal, and the vectors to the lamps; `layer` is its place, prism, share of the prism's time
    and shutter time.
    """
    m, prism, u, t = layer
    e, place, normal, scale = span.room[EDGE], span.place, panel.normal, panel.scale[m, 0]
    sign = np.sign(scale)
    is_smooth = stock.is_smooth[span.face[m]]
    side = lit.handedness * (stock.parity[prism] if is_smooth else 1.0)
    span.side[m, 0] = side * (sign if is_smooth else 1.0)
    span.side[m, 1] = side * (1.0 if is_smooth else sign)
    world = stock.world
    for d in range(3):
        a = (1 - u) * world[prism, 0, 0, d] + u * world[prism, 1, 0, d]
        b = (1 - u) * world[prism, 0, 1, d] + u * world[prism, 1, 1, d]
        c = (1 - u) * world[prism, 0, 2, d] + u * world[prism, 1, 2, d]
        place[m, d, 0] = e[0] * a + e[1] * b + e[2] * c
        span.room[ACROSS, d], span.room[ACROSS, 3 + d] = b - a, c - a
        if is_smooth:
            total = 0.0
            for i in range(3):
                total += e[i] * ((1 - u) * stock.normal[prism, 0, i, d] + u * stock.normal[prism, 1, i, d])
            normal[m, 0, d] = total
    if not is_smooth:
        along_b, along_c = span.room[ACROSS, :3], span.room[ACROSS, 3:6]
        for d in range(3):
            i, j = (d + 1) % 3, (d + 2) % 3
            normal[m, 0, d] = along_b[i] * along_c[j] - along_b[j] * along_c[i]
    for lamp in range(len(lit.kind)):
        x, y, z = along(lit.path, lit.track[lamp, 0], 1, lit.track[lamp, 1], t)
        vector = panel.vector[m, lamp, 0]
        if lit.kind[lamp] == DIRECTIONAL:
            vector[0], vector[1], vector[2] = -x, -y, -z
            continue
        vector[0] = scale * x - place[m, 0, 0]
        vector[1] = scale * y - place[m, 1, 0]
        vector[2] = scale * z - place[m, 2, 0]
        if lit.kind[lamp] == SPOT:
            gx, gy, gz = along(lit.path, lit.track[lamp, 2], 1, lit.track[lamp, 3], t)
            axis = panel.axis[lamp, 0]
            axis[0], axis[1], axis[2] = gx - x, gy - y, gz - z


@inlined
def receive_still(span: Span, panel: Panel, layer: tuple[int, float], lit: Lit, received: Received) -> None:
    """Append a settled layer, given by its place and the shutter time, as what light falls on."""
    m, t = layer
    n, scale = received.count[0], panel.scale[m, 0]
    received.count[0] = n + 1
    received.face[n], received.rests[n] = span.face[m], True
    received.t[n, 0] = received.t[n, 1] = t
    for d in range(3):
        received.scale[n, d] = 1.0
        for k in range(4):
            received.place[n, k, d] = span.place[m, d, 0] / scale
    normal = panel.normal[m, 0]
    for lamp in range(len(lit.kind)):
        vector = panel.vector[m, lamp, 0]
        side = span.side[m, 1 if lit.kind[lamp] == DIRECTIONAL else 0]
        received.due[n, lamp] = side * (normal[0] * vector[0] + normal[1] * vector[1] + normal[2] * vector[2]) > 0
