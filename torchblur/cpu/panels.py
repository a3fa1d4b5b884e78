"""How many of Gauss's nodes a slice of a span needs, certified: what certificate.py says, compiled.

Before: curves.py.  After: expose.py.
Symbols: a panel is a slice of a span in which no look bends; rest as in certificate.py and curves.py. Where no light
and no mip level varies their growth is left out of the bound, and that of the shutter where it is constant.
Source: Trefethen 2013, theorem 19.3; ours.
"""

from __future__ import annotations

import math

import numpy as np

from torchblur.certificate import GROWTH, LEVELS, RHO, ROUNDING, SCALE_LIMIT, TOLERANCE, VECTOR_LIMIT
from torchblur.cpu.curves import LIT, MIPPED, MULTIPLIES, NEAR, TEXTURED, VARYING, Span
from torchblur.cpu.jit import inlined, jit
from torchblur.cpu.lambert import SPOT, Lit
from torchblur.cpu.layers import Looks
from torchblur.light_bends import LINEAR
from torchblur.nodes import COUNTS

RHOS = np.array(RHO)
REACH = np.array([[0.5 * (rho**k + rho**-k) for k in range(5)] for rho in RHO])  # of T_k on the ellipse
TWICE_LOG = 2 * np.log(RHOS)
BOUND = np.log(64 / 15 / 2 / (1 - RHOS**-2.0) / TOLERANCE)
MOST, ENOUGH = float(COUNTS[-1]), 3.0
N_NODES = np.array([next(c for c in COUNTS if c >= n) for n in range(1, COUNTS[-1] + 1)])  # at least n, from 1 on
BINOMIAL = np.array([[math.comb(n, k) if k <= n else 0.0 for k in range(5)] for n in range(5)])


@inlined
def _fits(sizes: tuple[float, float, float, float, float], limit: float, top: int) -> int:
    """Return the largest ellipse, `top` or smaller, on which a tail is within `limit` of its middle; -1 for none."""
    c0, c1, c2, c3, c4 = sizes
    least = ROUNDING * c0
    c1, c2 = c1 if c1 > least else 0.0, c2 if c2 > least else 0.0
    c3, c4 = c3 if c3 > least else 0.0, c4 if c4 > least else 0.0
    room = limit * c0
    while top >= 0:
        if c1 * REACH[top, 1] + c2 * REACH[top, 2] + c3 * REACH[top, 3] + c4 * REACH[top, 4] <= room:
            break
        top -= 1
    return top


@inlined
def quadratic(c0: float, c1: float, c2: float, middle: float, half: float) -> tuple[float, float, float]:
    """Return the Chebyshev coefficients of a quadratic on [middle - half, middle + half]."""
    first, second = c1 - c0, c2 - c1
    a, b = (1 - middle) * c0 + middle * c1, (1 - middle) * c1 + middle * c2
    bend = 0.5 * half * half * (second - first)
    return (1 - middle) * a + middle * b + bend, 2 * half * (b - a), bend


@inlined
def _vector_fits(rows: np.ndarray, n: int, panel: tuple[float, float], limit: float, top: int) -> int:
    """Return what `_fits` does of a vector of polynomials of `n` coefficients, rows (components, n)."""
    middle, half = panel
    s0, s1, s2, s3, s4 = 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(len(rows)):
        c0, c1, c2, c3 = rows[r, 0], rows[r, 1], rows[r, 2], rows[r, 3]
        c4 = rows[r, 4] if n == 5 else 0.0
        power = half
        v = 1 - middle
        if n == 5:  # Taylor's coefficients by differences, times powers of `half`
            d0, d1, d2, d3 = c1 - c0, c2 - c1, c3 - c2, c4 - c3
            e0, e1, e2 = d1 - d0, d2 - d1, d3 - d2
            f0, f1 = e1 - e0, e2 - e1
            a4 = half**4 * (f1 - f0)
            a3 = 4 * half**3 * (v * f0 + middle * f1)
            a2 = 6 * half**2 * (v * (v * e0 + middle * e1) + middle * (v * e1 + middle * e2))
            p0, p1, p2 = v * d0 + middle * d1, v * d1 + middle * d2, v * d2 + middle * d3
            a1 = 4 * power * (v * (v * p0 + middle * p1) + middle * (v * p1 + middle * p2))
            q0, q1, q2, q3 = v * c0 + middle * c1, v * c1 + middle * c2, v * c2 + middle * c3, v * c3 + middle * c4
            q0, q1, q2 = v * q0 + middle * q1, v * q1 + middle * q2, v * q2 + middle * q3
            q0, q1 = v * q0 + middle * q1, v * q1 + middle * q2
            a0 = v * q0 + middle * q1
        else:
            d0, d1, d2 = c1 - c0, c2 - c1, c3 - c2
            e0, e1 = d1 - d0, d2 - d1
            a4 = 0.0
            a3 = half**3 * (e1 - e0)
            a2 = 3 * half**2 * (v * e0 + middle * e1)
            a1 = 3 * power * (v * (v * d0 + middle * d1) + middle * (v * d1 + middle * d2))
            q0, q1, q2 = v * c0 + middle * c1, v * c1 + middle * c2, v * c2 + middle * c3
            q0, q1 = v * q0 + middle * q1, v * q1 + middle * q2
            a0 = v * q0 + middle * q1
        t0, t1, t2, t3, t4 = a0 + a2 / 2 + a4 * 3 / 8, a1 + a3 * 3 / 4, a2 / 2 + a4 / 2, a3 / 4, a4 / 8
        s0, s1, s2, s3, s4 = s0 + t0 * t0, s1 + t1 * t1, s2 + t2 * t2, s3 + t3 * t3, s4 + t4 * t4
    return _fits((np.sqrt(s0), np.sqrt(s1), np.sqrt(s2), np.sqrt(s3), np.sqrt(s4)), limit, top)


@inlined
def _light_fits(span: Span, m: int, lit: Lit, panel: tuple[float, float], top: int) -> int:
    """Return the largest ellipse on which the light on a layer is analytic."""
    top = _vector_fits(span.normal[m], 4, panel, VECTOR_LIMIT, top)
    for lamp in range(len(lit.kind)):
        limit = VECTOR_LIMIT
        if lit.kind[lamp] == SPOT:
            limit = _cone_limit(span, m, lit, lamp, panel[0])
            if limit == np.inf:
                continue
            top = _axis_fits(span.axis[lamp], panel, limit, top)
        top = _vector_fits(span.vector[m, lamp], 4, panel, limit, top)
    return top


@inlined
def _axis_fits(axis: np.ndarray, panel: tuple[float, float], limit: float, top: int) -> int:
    middle, half = panel
    size, change = 0.0, 0.0
    for d in range(3):
        size += (axis[d, 0] + middle * (axis[d, 1] - axis[d, 0])) ** 2
        change += (half * (axis[d, 1] - axis[d, 0])) ** 2
    return _fits((np.sqrt(size), np.sqrt(change), 0.0, 0.0, 0.0), limit, top)


@inlined
def cubic(c: np.ndarray, tau: float) -> float:
    """Return the value at `tau` of four coefficients."""
    v = 1 - tau
    a, b, d = v * c[0] + tau * c[1], v * c[1] + tau * c[2], v * c[2] + tau * c[3]
    return v * (v * a + tau * b) + tau * (v * b + tau * d)


@inlined
def _cone_limit(span: Span, m: int, lit: Lit, lamp: int, tau: float) -> float:
    """Return by what share vectors to a spot may vary about `tau`; see light_bends.py."""
    along, of_vector, of_axis = 0.0, 0.0, 0.0
    for d in range(3):
        v = cubic(span.vector[m, lamp, d], tau)
        a = span.axis[lamp, d, 0] + tau * (span.axis[lamp, d, 1] - span.axis[lamp, d, 0])
        along, of_vector, of_axis = along + v * a, of_vector + v * v, of_axis + a * a
    size = np.sqrt(of_vector * of_axis)
    cosine = abs(along) / size if size > 0 else abs(along)
    inner, outer = lit.cosines[lamp, 0], lit.cosines[lamp, 1]
    if cosine < outer:
        return np.inf
    return min(VECTOR_LIMIT, LINEAR * (inner - outer)) if cosine < inner else VECTOR_LIMIT


@inlined
def count_nodes(
    span: Span, n_layers: int, scene: tuple[Looks, Lit], panel: tuple[float, float], is_even: bool
) -> int:
    """Return how many nodes bring a panel below the tolerance, of COUNTS; 0 where none are certain to.

    Args:
        span, n_layers: what is seen.
        scene: what there is.
        panel: its middle and half its length, in the span's time.
        is_even: whether the shutter is constant.
    """
    looks, lit = scene
    middle, half = panel
    top, grows = len(RHO) - 1, False
    for m in range(n_layers):
        flags = span.flags[m]
        if not flags & VARYING:
            continue
        if flags & (TEXTURED | NEAR):
            s0, s1, s2 = quadratic(span.scale[m, 0], span.scale[m, 1], span.scale[m, 2], middle, half)
            top = _fits((abs(s0), abs(s1), abs(s2), 0.0, 0.0), SCALE_LIMIT, top)
        if flags & MIPPED:
            top = _vector_fits(span.slope[m], 5, panel, VECTOR_LIMIT, top)
            grows = True
        if flags & LIT:
            top = _light_fits(span, m, lit, panel, top)
            grows = True
        if top < 0:
            return 0
    best, rho = np.inf, top
    while rho >= 0:
        growth = 0.0 if is_even else math.log1p(RHOS[rho] / 2)
        growth += _growth(span, n_layers, looks, panel, rho) + (math.log(GROWTH) if grows else 0.0)
        best = min(best, (growth + BOUND[rho]) / TWICE_LOG[rho])
        if best <= ENOUGH:  # smaller ellipses seldom ask for less
            break
        rho -= 3
    return N_NODES[max(int(np.ceil(best)), 1) - 1] if best <= MOST else 0


@inlined
def _growth(span: Span, n_layers: int, looks: Looks, panel: tuple[float, float], rho: int) -> float:
    """Return the logarithm of what lookups grow by on an ellipse: colours one at a time, times opacities."""
    middle, half = panel
    most, total = 1.0, 0.0
    for m in range(n_layers):
        flags = span.flags[m]
        if not (flags & VARYING and flags & TEXTURED):
            continue
        mesh, level = looks.mesh_of[span.face[m]], span.level[m, 0]
        s0, s1, s2 = quadratic(span.scale[m, 0], span.scale[m, 1], span.scale[m, 2], middle, half)
        product = 1.0
        for axis in range(2):
            size = float(looks.size[level, axis, mesh])
            p0, p1, p2 = quadratic(span.uv[m, axis, 0], span.uv[m, axis, 1], span.uv[m, axis, 2], middle, half)
            ratio = p0 / s0 if s0 != 0 else p0
            a1, a2, least = abs(p1 - ratio * s1), abs(p2 - ratio * s2), ROUNDING * abs(p0)
            a1, a2 = a1 if a1 > least else 0.0, a2 if a2 > least else 0.0
            away = size * (a1 * REACH[rho, 1] + a2 * REACH[rho, 2])
            product *= 1 + 2 * away / (abs(s0) if s0 != 0 else 1.0)
        most = max(most, product)
        if flags & MULTIPLIES:
            total += math.log(product * LEVELS)
    return total + math.log(most)
