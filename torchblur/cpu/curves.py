"""What the layers of a slice of time do, one ray at a time: paths.py, texture_bends.py and light_bends.py, compiled.

Before: jit.py, lambert.py, layers.py.  After: bends.py, panels.py.
Symbols: a span is a slice of a cell in which neither the shutter nor a light has a knot; L layers in it; tau in [0, 1]
is time in the span. All polynomials by their Bernstein coefficients over it: S = e_0 + e_1 + e_2; a place on a texture
is (U, V) / S; the rows of a footprint's matrix are Q / S^2; N is a normal, V = S (light - point).
Source: Ronnow et al. 2022, eq. 1 and 2; polynomial form ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchblur.cpu.jit import inlined, inner
from torchblur.cpu.lambert import DIRECTIONAL, SPOT, Lit, along
from torchblur.cpu.layers import Looks
from torchblur.prisms import Prisms

TEXTURED, MIPPED, LIT, NEAR, VARYING, MULTIPLIES, RESTS = 1, 2, 4, 8, 16, 32, 64  # flags of a layer
CORNER, EDGE, ACROSS, SQUARE, CONE = 0, 2, 5, 8, 10  # rows of the room


class Stock(NamedTuple):
    """The prisms of a scene, and what of their faces decides how looks vary."""

    clip: np.ndarray  # (P, 2, 3, 3) end, corner, x y w
    t: np.ndarray  # (P, 2) slice of time
    face: np.ndarray  # (P,) int64
    corner: np.ndarray  # (P, 3) int64 which corner of the face is stored at each place
    parity: np.ndarray  # (P,)
    world: np.ndarray  # (P, 2, 3, 3), or none
    normal: np.ndarray  # (P, 2, 3, 3), or none
    flags: np.ndarray  # (F,) int64 of TEXTURED, LIT, VARYING, MULTIPLIES, RESTS
    is_smooth: np.ndarray  # (F,) bool: has normals


class Span(NamedTuple):
    """The layers of a span."""

    flags: np.ndarray  # (L,) int64
    face: np.ndarray  # (L,) int64
    scale: np.ndarray  # (L, 3) S
    uv: np.ndarray  # (L, 2, 3) U and V
    corners: np.ndarray  # (L, 2, 2) least and greatest u and v of the corners
    slope: np.ndarray  # (L, 5, 4) rows of the footprint's matrix, last, in texels of level 0
    level: np.ndarray  # (L, 2) int64 least and greatest level of lookups
    receiver: np.ndarray  # (L,) int64 number of the layer among those that light falls on
    place: np.ndarray  # (L, 3, 4) P
    normal: np.ndarray  # (L, 3, 4)
    side: np.ndarray  # (L, 2) what makes N V the cosine: of lamps that are near, and of directions
    vector: np.ndarray  # (L, lamps, 3, 4)
    axis: np.ndarray  # (lamps, 3, 2) of spots
    quartic: np.ndarray  # (5, 1) to work in
    room: np.ndarray  # (11, 12) to work in, see CORNER and following


def find_stock(prisms: Prisms) -> Stock:
    """Return what the compiled code needs of the prisms. Source: ours."""
    surfaces = prisms.surfaces
    marks = (TEXTURED, surfaces.is_textured), (LIT, surfaces.is_lit), (VARYING, surfaces.is_varying)
    more = (MULTIPLIES, surfaces.has_varying_opacity), (RESTS, surfaces.rests)
    flags = sum(flag * is_so.long() for flag, is_so in (*marks, *more))
    world, normal = (moving.permute(3, 0, 1, 2) for moving in (prisms.world, prisms.normal))
    tensors = (
        prisms.clip.permute(3, 0, 1, 2)[..., [0, 1, 3]],
        prisms.t_open.new_empty(prisms.count, 2),
        prisms.face_of,
        prisms.corner_of.T,
        prisms.parity,
        world,
        normal,
        flags,
        surfaces.has_normals,
    )
    stock = Stock(*(tensor.detach().contiguous().numpy() for tensor in tensors))
    stock.t[:, 0], stock.t[:, 1] = prisms.t_open.numpy(), prisms.t_close.numpy()
    return stock


@inner
def make_span(n_layers: int, n_lamps: int) -> Span:
    """Return room for so many layers under so many lamps."""
    n, ints = n_layers, np.int64
    return Span(
        np.zeros(n, ints),
        np.zeros(n, ints),
        np.empty((n, 3)),
        np.empty((n, 2, 3)),
        np.empty((n, 2, 2)),
        np.empty((n, 5, 4)),
        np.zeros((n, 2), ints),
        np.zeros(n, ints),
        np.empty((n, 3, 4)),
        np.zeros((n, 3, 4)),
        np.empty((n, 2)),
        np.zeros((n, n_lamps, 3, 4)),
        np.zeros((n_lamps, 3, 2)),
        np.empty((5, 1)),
        np.empty((11, 12)),
    )


@inlined
def follow(stock: Stock, looks: Looks, lit: Lit, span: Span, what: tuple[int, int, float, float, float, float]) -> None:
    """Write the curves of a layer to its place in a span.

    Args:
        stock, looks, lit: what there is.
        span: to write to.
        what: place of the layer, prism, the ray's x and y in NDC, shutter times of the span's start and end.
    """
    m, prism, x_ndc, y_ndc, t_start, t_end = what
    face = stock.face[prism]
    flags = stock.flags[face]
    if flags & RESTS:  # only the shadows on it change, which are known
        flags &= ~VARYING
    span.face[m], span.flags[m] = face, flags
    if not flags & (TEXTURED | LIT):
        return
    corner, e = span.room[CORNER:EDGE], span.room[EDGE:ACROSS]
    clip, t_open = stock.clip, stock.t[prism, 0]
    length = stock.t[prism, 1] - t_open
    at = ((t_start - t_open) / length, (t_end - t_open) / length)
    for end in range(2):
        u = at[end]
        for i in range(3):
            w0, w1 = clip[prism, 0, i, 2], clip[prism, 1, i, 2]
            x = (1 - u) * (clip[prism, 0, i, 0] - x_ndc * w0) + u * (clip[prism, 1, i, 0] - x_ndc * w1)
            y = (1 - u) * (clip[prism, 0, i, 1] - y_ndc * w0) + u * (clip[prism, 1, i, 1] - y_ndc * w1)
            corner[end, i], corner[end, 3 + i], corner[end, 6 + i] = x, y, (1 - u) * w0 + u * w1
    _edges(corner, 0, 3, e)
    for k in range(3):
        span.scale[m, k] = e[0, k] + e[1, k] + e[2, k]
    if flags & TEXTURED:
        _follow_texture(stock, looks, span, m, prism)
    if flags & LIT:
        _follow_light(stock, lit, span, (m, prism, at), (t_start, t_end))


@inlined
def _edges(corner: np.ndarray, x: int, y: int, out: np.ndarray) -> None:
    """Write the coefficients of the cross products of the corners' numbers from `x` and from `y` on to `out` (3, 3)."""
    _edge(corner, (x + 1, y + 1, x + 2, y + 2), 1.0, out[0])
    _edge(corner, (x, y, x + 2, y + 2), -1.0, out[1])
    _edge(corner, (x, y, x + 1, y + 1), 1.0, out[2])


@inlined
def _edge(corner: np.ndarray, which: tuple[int, int, int, int], turn: float, out: np.ndarray) -> None:
    """Write the coefficients of `turn` times the cross product of two vectors, always from lower place to higher."""
    i, j, k, m = which
    ax, ay, bx, by = corner[0, i], corner[0, j], corner[0, k], corner[0, m]
    cx, cy, dx, dy = corner[1, i], corner[1, j], corner[1, k], corner[1, m]
    out[0] = turn * (ax * by - ay * bx)
    out[1] = 0.5 * turn * ((ax * dy - ay * dx) + (cx * by - cy * bx))
    out[2] = turn * (cx * dy - cy * dx)


@inlined
def _follow_texture(stock: Stock, looks: Looks, span: Span, m: int, prism: int) -> None:
    """Write the place on the texture, and if smaller copies may be looked up the footprint."""
    e, face, uv = span.room[EDGE:ACROSS], stock.face[prism], looks.uv
    for axis in range(2):
        low, high = np.inf, -np.inf
        for k in range(3):
            span.uv[m, axis, k] = 0.0
        for i in range(3):
            value = uv[face, stock.corner[prism, i], axis]
            low, high = min(low, value), max(high, value)
            for k in range(3):
                span.uv[m, axis, k] += e[i, k] * value
        span.corners[m, axis, 0], span.corners[m, axis, 1] = low, high
    span.level[m, 0] = span.level[m, 1] = 0
    mesh = looks.mesh_of[face]
    last = looks.n_levels[mesh] - 1
    if last < 1:
        return
    corner, slope, across = span.room[CORNER:EDGE], span.slope, span.room[ACROSS:SQUARE]
    for screen in range(2):
        _edges(corner, 3 if screen == 0 else 6, 6 if screen == 0 else 0, across)
        for axis in range(2):
            wide = looks.size[0, axis, mesh] * looks.step[screen]
            row = 2 * screen + axis
            for k in range(5):
                slope[m, k, row] = 0.0
            for i in range(3):
                value = uv[face, stock.corner[prism, i], axis] * wide
                _add_product(span.scale[m], across[i], value, slope[m, :, row])
                _add_product(span.uv[m, axis], across[i], -wide, slope[m, :, row])
    low, high = _square_range(span, m)
    span.level[m, 0] = min(int(np.floor(0.5 * np.log2(max(low, 1.0)))), last)
    high = 0.5 * np.log2(max(high, 1.0))
    span.level[m, 1] = last if not high < last else int(np.ceil(high))
    if span.level[m, 1] > 0:
        span.flags[m] |= MIPPED


@inlined
def _add_product(a: np.ndarray, b: np.ndarray, factor: float, out: np.ndarray) -> None:
    """Add a multiple of the product of two quadratics to `out` (5,)."""
    out[0] += factor * (a[0] * b[0])
    out[1] += factor * (0.5 * (a[0] * b[1] + a[1] * b[0]))
    out[2] += factor * ((a[0] * b[2] + 4 * (a[1] * b[1]) + a[2] * b[0]) / 6)
    out[3] += factor * (0.5 * (a[1] * b[2] + a[2] * b[1]))
    out[4] += factor * (a[2] * b[2])


@inlined
def square_of(rows: np.ndarray, n: int, share: float, out: np.ndarray) -> None:
    """Write `share` of the sum of the squares of `n` quartics (5, n) to `out` (9,)."""
    for k in range(9):
        out[k] = 0.0
    for r in range(n):
        a, b, c, d, e = rows[0, r], 4 * rows[1, r], 6 * rows[2, r], 4 * rows[3, r], rows[4, r]
        out[0] += share * (a * a)
        out[1] += share * (2 * a * b) / 8
        out[2] += share * (2 * a * c + b * b) / 28
        out[3] += share * 2 * (a * d + b * c) / 56
        out[4] += share * (2 * (a * e + b * d) + c * c) / 70
        out[5] += share * 2 * (b * e + c * d) / 56
        out[6] += share * (2 * c * e + d * d) / 28
        out[7] += share * (2 * d * e) / 8
        out[8] += share * (e * e)


@inlined
def dot_of(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """Write the dot product of vectors of cubics (3, 4) to `out` (7,)."""
    for k in range(7):
        out[k] = 0.0
    for d in range(3):
        a0, a1, a2, a3 = a[d, 0], 3 * a[d, 1], 3 * a[d, 2], a[d, 3]
        b0, b1, b2, b3 = b[d, 0], 3 * b[d, 1], 3 * b[d, 2], b[d, 3]
        out[0] += a0 * b0
        out[1] += (a0 * b1 + a1 * b0) / 6
        out[2] += (a0 * b2 + a1 * b1 + a2 * b0) / 15
        out[3] += (a0 * b3 + a1 * b2 + a2 * b1 + a3 * b0) / 20
        out[4] += (a1 * b3 + a2 * b2 + a3 * b1) / 15
        out[5] += (a2 * b3 + a3 * b2) / 6
        out[6] += a3 * b3


@inlined
def squares(span: Span, m: int) -> None:
    """Write S^4 times the square of a footprint, and S^4, to the rows SQUARE and SQUARE + 1 of the room."""
    square, fourth, quartic = span.room[SQUARE], span.room[SQUARE + 1], span.quartic
    for k in range(5):
        quartic[k, 0] = 0.0
    _add_product(span.scale[m], span.scale[m], 1.0, quartic[:, 0])
    square_of(quartic, 1, 1.0, fourth)
    square_of(span.slope[m], 4, 0.5, square)


@inlined
def _square_range(span: Span, m: int) -> tuple[float, float]:
    """Return bounds of the square of a footprint [texels of level 0]; infinite where S may vanish."""
    squares(span, m)
    low, high = np.inf, -np.inf
    for k in range(9):
        fourth = span.room[SQUARE + 1, k]
        if not fourth > 0:
            return -np.inf, np.inf
        ratio = span.room[SQUARE, k] / fourth
        low, high = min(low, ratio), max(high, ratio)
    return low, high


@inlined
def _follow_light(
    stock: Stock, lit: Lit, span: Span, layer: tuple[int, int, tuple[float, float]], times: tuple[float, float]
) -> None:
    """Write the normal and the vectors to the lamps; `layer` is its place, prism, and times in the prism."""
    m, prism, at = layer
    e, place, ends = span.room[EDGE:ACROSS], span.place[m], span.room[CORNER:EDGE]
    normal, scale = span.normal, span.scale
    sign = np.sign(scale[m, 0] + scale[m, 1] + scale[m, 2])
    parity, is_smooth = stock.parity[prism], stock.is_smooth[stock.face[prism]]
    side = lit.handedness * (parity if is_smooth else 1.0)
    span.side[m, 0] = side * (sign if is_smooth else 1.0)
    span.side[m, 1] = side * (1.0 if is_smooth else sign)
    if is_smooth:
        _ends(stock.normal, prism, at, ends)
        _attribute(e, ends, normal[m])
    _ends(stock.world, prism, at, ends)
    _attribute(e, ends, place)
    if not is_smooth:
        _flat_normal(ends, normal[m])
    for lamp in range(len(lit.kind)):
        first, count = lit.track[lamp, 0], lit.track[lamp, 1]
        x0, y0, z0 = along(lit.path, first, 1, count, times[0])
        x1, y1, z1 = along(lit.path, first, 1, count, times[1])
        vector = span.vector[m, lamp]
        if lit.kind[lamp] == DIRECTIONAL:
            for d, (a, b) in enumerate(((x0, x1), (y0, y1), (z0, z1))):  # of degree 1, raised to 3
                vector[d, 0], vector[d, 1], vector[d, 2], vector[d, 3] = -a, -(2 * a + b) / 3, -(a + 2 * b) / 3, -b
            continue
        span.flags[m] |= NEAR
        s0, s1, s2 = scale[m, 0], scale[m, 1], scale[m, 2]
        for d, (a, b) in enumerate(((x0, x1), (y0, y1), (z0, z1))):
            vector[d, 0] = s0 * a - place[d, 0]
            vector[d, 1] = (2 * s1 * a + s0 * b) / 3 - place[d, 1]
            vector[d, 2] = (s2 * a + 2 * s1 * b) / 3 - place[d, 2]
            vector[d, 3] = s2 * b - place[d, 3]
        if lit.kind[lamp] == SPOT:
            first, count = lit.track[lamp, 2], lit.track[lamp, 3]
            u0, v0, w0 = along(lit.path, first, 1, count, times[0])
            u1, v1, w1 = along(lit.path, first, 1, count, times[1])
            axis = span.axis[lamp]
            for d, (a, b) in enumerate(((u0 - x0, u1 - x1), (v0 - y0, v1 - y1), (w0 - z0, w1 - z1))):
                axis[d, 0], axis[d, 1] = a, b


@inlined
def _ends(moving: np.ndarray, prism: int, at: tuple[float, float], out: np.ndarray) -> None:
    """Write the vectors of the three corners at both ends of the span to `out` (2, 9 or more)."""
    for end in range(2):
        u = at[end]
        for i in range(3):
            for d in range(3):
                out[end, 3 * i + d] = (1 - u) * moving[prism, 0, i, d] + u * moving[prism, 1, i, d]


@inlined
def _attribute(e: np.ndarray, ends: np.ndarray, out: np.ndarray) -> None:
    """Write the coefficients of the sum of e_i and the corners' vectors to `out` (3, 4)."""
    for d in range(3):
        c0, c1, c2, c3 = 0.0, 0.0, 0.0, 0.0
        for i in range(3):
            a, b = ends[0, 3 * i + d], ends[1, 3 * i + d]
            c0 += e[i, 0] * a
            c1 += (2 * e[i, 1] * a + e[i, 0] * b) / 3
            c2 += (e[i, 2] * a + 2 * e[i, 1] * b) / 3
            c3 += e[i, 2] * b
        out[d, 0], out[d, 1], out[d, 2], out[d, 3] = c0, c1, c2, c3


@inlined
def _flat_normal(ends: np.ndarray, out: np.ndarray) -> None:
    """Write the coefficients of the normal of corners that move linearly, raised to degree 3, to `out` (3, 4)."""
    for d in range(3):
        i, j = (d + 1) % 3, (d + 2) % 3
        ax, ay = ends[0, 3 + i] - ends[0, i], ends[0, 3 + j] - ends[0, j]
        bx, by = ends[0, 6 + i] - ends[0, i], ends[0, 6 + j] - ends[0, j]
        cx, cy = ends[1, 3 + i] - ends[1, i], ends[1, 3 + j] - ends[1, j]
        ex, ey = ends[1, 6 + i] - ends[1, i], ends[1, 6 + j] - ends[1, j]
        first, last = ax * by - ay * bx, cx * ey - cy * ex
        both = (ax * ey - ay * ex) + (cx * by - cy * bx)
        out[d, 0], out[d, 1], out[d, 2], out[d, 3] = first, (first + both) / 3, (both + last) / 3, last
