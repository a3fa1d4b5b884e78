"""How many of Gauss's nodes a slice of a span needs, certified: what certificate.py says, compiled.

Before: receive.py.  After: shine.py, expose.py.
Symbols: a panel is a slice of a span in which no look bends; s in [-1, 1] is time in it; there curves are kept by their
powers of s. Rest as in certificate.py and curves.py. Where no light and no mip level varies their growth is left out of
the bound, and that of the shutter where it is constant.
Source: Trefethen 2013, theorem 19.3; ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchblur.certificate import GROWTH, LEVELS, ROUNDING, SCALE_LIMIT, TOLERANCE, VECTOR_LIMIT
from torchblur.cpu.curves import LIT, MIPPED, MULTIPLIES, NEAR, TEXTURED, VARYING, Span
from torchblur.cpu.jit import inlined, inner
from torchblur.cpu.lambert import SPOT, Lit
from torchblur.cpu.layers import Looks
from torchblur.cpu.receive import Shade, visible_at
from torchblur.light_bends import LINEAR
from torchblur.nodes import COUNTS

LEAST, RATIO = 1.6, 1.25
RHO = LEAST * RATIO ** np.arange(81)
REACH = np.array([[0.5 * (rho**k + rho**-k) for k in range(5)] for rho in RHO])  # of T_k on the ellipse
# what looks may grow by on an ellipse for n nodes to err by no more than the tolerance
ROOM = np.array([[rho ** (2 * n) / (64 / 15 / 2 / (1 - rho**-2) / TOLERANCE) for n in range(17)] for rho in RHO])
CLIMB = 4  # how much larger an ellipse may be than the one of the panel before
ENOUGH, SMALL, STEP = 3, 3000.0, 5  # nodes, and growth, from which smaller ellipses do not pay; the step to the next
ROUND_UP = np.array([next(c for c in COUNTS if c >= n) for n in range(1, COUNTS[-1] + 1)])  # of n - 1


class Panel(NamedTuple):
    """The curves of the layers of a span by their powers of s over a panel."""

    scale: np.ndarray  # (L, 3)
    uv: np.ndarray  # (L, 2, 3)
    slope: np.ndarray  # (L, 5, 4) power, row
    normal: np.ndarray  # (L, 4, 3) power, axis
    vector: np.ndarray  # (L, lamps, 4, 3)
    axis: np.ndarray  # (lamps, 2, 3)
    visible: np.ndarray  # (L, lamps) share of each lamp that reaches the layer


@inner
def make_panel(n_layers: int, n_lamps: int) -> Panel:
    """Return room for so many layers under so many lamps."""
    n = n_layers
    return Panel(
        np.zeros((n, 3)),
        np.zeros((n, 2, 3)),
        np.zeros((n, 5, 4)),
        np.zeros((n, 4, 3)),
        np.zeros((n, n_lamps, 4, 3)),
        np.zeros((n_lamps, 2, 3)),
        np.ones((n, n_lamps)),
    )


@inlined
def expand(span: Span, n_layers: int, lit: Lit, part: tuple[float, float], panel: Panel) -> None:
    """Write the curves of a part of the span, given by its middle and half length."""
    middle, half = part
    for m in range(n_layers):
        flags = span.flags[m]
        if not flags & (TEXTURED | LIT):
            continue
        _quadratic(span.scale[m], middle, half, panel.scale[m])
        if flags & TEXTURED:
            _quadratic(span.uv[m, 0], middle, half, panel.uv[m, 0])
            _quadratic(span.uv[m, 1], middle, half, panel.uv[m, 1])
        if flags & MIPPED:
            _quartics(span.slope[m], middle, half, panel.slope[m])
        if flags & LIT:
            _cubics(span.normal[m], middle, half, panel.normal[m])
            for lamp in range(len(lit.kind)):
                _cubics(span.vector[m, lamp], middle, half, panel.vector[m, lamp])
                if lit.kind[lamp] == SPOT:
                    for d in range(3):
                        change = span.axis[lamp, d, 1] - span.axis[lamp, d, 0]
                        panel.axis[lamp, 0, d] = span.axis[lamp, d, 0] + middle * change
                        panel.axis[lamp, 1, d] = half * change


@inlined
def reach(span: Span, n_layers: int, scene: tuple[Lit, Shade], tau: float, panel: Panel) -> None:
    """Write the light that reaches the layers of a span at a share of its time."""
    lit, shade = scene
    for m in range(n_layers):
        if span.flags[m] & LIT:
            for lamp in range(len(lit.kind)):
                panel.visible[m, lamp] = visible_at(shade, lamp, span.receiver[m], tau)


@inlined
def _quadratic(c: np.ndarray, middle: float, half: float, out: np.ndarray) -> None:
    a, b, v = c[1] - c[0], c[2] - c[1], 1 - middle
    out[0] = v * (v * c[0] + middle * c[1]) + middle * (v * c[1] + middle * c[2])
    out[1] = 2 * half * (v * a + middle * b)
    out[2] = half * half * (b - a)


@inlined
def _cubics(c: np.ndarray, middle: float, half: float, out: np.ndarray) -> None:
    """Write the powers of three cubics (3, 4) to `out` (4, 3)."""
    u, v = middle, 1 - middle
    b0, b1, b2, b3 = v * v * v, 3 * v * v * u, 3 * v * u * u, u * u * u
    for r in range(3):
        c0, c1, c2, c3 = c[r, 0], c[r, 1], c[r, 2], c[r, 3]
        d0, d1, d2 = c1 - c0, c2 - c1, c3 - c2
        e0, e1 = d1 - d0, d2 - d1
        out[0, r] = b0 * c0 + b1 * c1 + b2 * c2 + b3 * c3
        out[1, r] = 3 * half * (v * v * d0 + 2 * v * u * d1 + u * u * d2)
        out[2, r] = 3 * half * half * (v * e0 + u * e1)
        out[3, r] = half * half * half * (e1 - e0)


@inlined
def _quartics(c: np.ndarray, middle: float, half: float, out: np.ndarray) -> None:
    """Write the powers of four quartics (5, 4) to `out` (5, 4)."""
    u, v = middle, 1 - middle
    vv, uv, uu = v * v, u * v, u * u
    h2 = half * half
    for r in range(4):
        c0, c1, c2, c3, c4 = c[0, r], c[1, r], c[2, r], c[3, r], c[4, r]
        d0, d1, d2, d3 = c1 - c0, c2 - c1, c3 - c2, c4 - c3
        e0, e1, e2 = d1 - d0, d2 - d1, d3 - d2
        f0, f1 = e1 - e0, e2 - e1
        out[0, r] = vv * vv * c0 + 4 * vv * uv * c1 + 6 * uv * uv * c2 + 4 * uv * uu * c3 + uu * uu * c4
        out[1, r] = 4 * half * (vv * v * d0 + 3 * vv * u * d1 + 3 * v * uu * d2 + uu * u * d3)
        out[2, r] = 6 * h2 * (vv * e0 + 2 * uv * e1 + uu * e2)
        out[3, r] = 4 * h2 * half * (v * f0 + u * f1)
        out[4, r] = h2 * h2 * (f1 - f0)


@inlined
def _fits(sizes: tuple[float, float, float, float, float], limit: float, top: int) -> int:
    """Return the largest ellipse, `top` or smaller, on which a tail of Chebyshev coefficients of these sizes is within
    `limit` of its middle; -1 for none.
    """
    c0, c1, c2, c3, c4 = sizes
    least, room = ROUNDING * c0, limit * c0
    c1, c2 = c1 if c1 > least else 0.0, c2 if c2 > least else 0.0
    c3, c4 = c3 if c3 > least else 0.0, c4 if c4 > least else 0.0
    while top >= 0:
        if c1 * REACH[top, 1] + c2 * REACH[top, 2] + c3 * REACH[top, 3] + c4 * REACH[top, 4] <= room:
            break
        top -= 1
    return top


@inlined
def _vectors_fit(rows: np.ndarray, n: int, limit: float, top: int) -> int:
    """Return what `_fits` does of vectors by their powers, (4 or 5 powers, n)."""
    s0, s1, s2, s3, s4 = 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(n):
        a0, a1, a2, a3 = rows[0, r], rows[1, r], rows[2, r], rows[3, r]
        a4 = rows[4, r] if len(rows) == 5 else 0.0
        t0, t1, t2, t3, t4 = a0 + a2 / 2 + a4 * 0.375, a1 + a3 * 0.75, 0.5 * (a2 + a4), 0.25 * a3, 0.125 * a4
        s0, s1, s2, s3, s4 = s0 + t0 * t0, s1 + t1 * t1, s2 + t2 * t2, s3 + t3 * t3, s4 + t4 * t4
    return _fits((np.sqrt(s0), np.sqrt(s1), np.sqrt(s2), np.sqrt(s3), np.sqrt(s4)), limit, top)


@inlined
def _light_fits(panel: Panel, m: int, lit: Lit, top: int) -> int:
    """Return the largest ellipse on which the light on a layer is analytic."""
    top = _vectors_fit(panel.normal[m], 3, VECTOR_LIMIT, top)
    for lamp in range(len(lit.kind)):
        limit = VECTOR_LIMIT
        if lit.kind[lamp] == SPOT:
            limit = _cone_limit(panel, m, lit, lamp)
            if limit == np.inf:
                continue
            size, change = 0.0, 0.0
            for d in range(3):
                size += panel.axis[lamp, 0, d] ** 2
                change += panel.axis[lamp, 1, d] ** 2
            top = _fits((np.sqrt(size), np.sqrt(change), 0.0, 0.0, 0.0), limit, top)
        top = _vectors_fit(panel.vector[m, lamp], 3, limit, top)
    return top


@inlined
def _cone_limit(panel: Panel, m: int, lit: Lit, lamp: int) -> float:
    """Return by what share vectors to a spot may vary; see light_bends.py."""
    along, of_vector, of_axis = 0.0, 0.0, 0.0
    for d in range(3):
        v, a = panel.vector[m, lamp, 0, d], panel.axis[lamp, 0, d]
        along, of_vector, of_axis = along + v * a, of_vector + v * v, of_axis + a * a
    size = np.sqrt(of_vector * of_axis)
    cosine = abs(along) / size if size > 0 else abs(along)
    inner, outer = lit.cosines[lamp, 0], lit.cosines[lamp, 1]
    if cosine < outer:
        return np.inf
    return min(VECTOR_LIMIT, LINEAR * (inner - outer)) if cosine < inner else VECTOR_LIMIT


@inlined
def count_nodes(
    span: Span, n_layers: int, scene: tuple[Looks, Lit], panel: Panel, how: tuple[bool, int]
) -> tuple[int, int]:
    """Return how many nodes bring a panel below the tolerance, of COUNTS, or 0 where none are certain to; and the
    ellipse that was found.

    Args:
        span, n_layers: what is seen.
        scene: what there is.
        panel: its curves.
        how: whether the shutter is constant, and the ellipse of another panel, from near which to look.
    """
    looks, lit = scene
    is_even, top = how
    top, grows = min(top + CLIMB, len(RHO) - 1), False
    for m in range(n_layers):
        flags = span.flags[m]
        if not flags & VARYING:
            continue
        if flags & (TEXTURED | NEAR):
            s0, s1, s2 = panel.scale[m, 0], panel.scale[m, 1], panel.scale[m, 2]
            top = _fits((abs(s0 + s2 / 2), abs(s1), abs(s2 / 2), 0.0, 0.0), SCALE_LIMIT, top)
        if flags & MIPPED:
            top = _vectors_fit(panel.slope[m], 4, VECTOR_LIMIT, top)
            grows = True
        if flags & LIT:
            top = _light_fits(panel, m, lit, top)
            grows = True
        if top < 0:
            return 0, 0
    best, rho = len(ROUND_UP) + 1, top
    while rho >= 0:
        growth = _growth(span, n_layers, looks, panel, rho) * (GROWTH if grows else 1.0)
        growth *= 1.0 if is_even else 1 + RHO[rho] / 2
        n = 1
        while n < best and growth > ROOM[rho, n]:
            n += 1
        best = n
        if best <= ENOUGH or growth < SMALL:
            break
        rho -= STEP
    return ROUND_UP[best - 1] if best <= len(ROUND_UP) else 0, top


@inlined
def _growth(span: Span, n_layers: int, looks: Looks, panel: Panel, rho: int) -> float:
    """Return what lookups grow by on an ellipse: colours one at a time, times opacities."""
    most, total = 1.0, 1.0
    for m in range(n_layers):
        flags = span.flags[m]
        if not (flags & VARYING and flags & TEXTURED):
            continue
        mesh, level = looks.mesh_of[span.face[m]], span.level[m, 0]
        s0, s1, s2 = panel.scale[m, 0] + panel.scale[m, 2] / 2, panel.scale[m, 1], panel.scale[m, 2] / 2
        inverse = 1 / s0 if s0 != 0 else 1.0
        product = 1.0
        for axis in range(2):
            p2 = panel.uv[m, axis, 2] / 2
            p0, p1 = panel.uv[m, axis, 0] + p2, panel.uv[m, axis, 1]
            ratio = p0 * inverse
            a1, a2, least = abs(p1 - ratio * s1), abs(p2 - ratio * s2), ROUNDING * abs(p0)
            a1, a2 = a1 if a1 > least else 0.0, a2 if a2 > least else 0.0
            away = (a1 * REACH[rho, 1] + a2 * REACH[rho, 2]) * abs(inverse)
            product *= 1 + 2 * away * looks.size[level, axis, mesh]
        most = max(most, product)
        if flags & MULTIPLIES:
            total *= product * LEVELS
    return total * most
