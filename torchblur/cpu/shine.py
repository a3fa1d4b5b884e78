"""What a layer of a span looks like at a time, one ray at a time: shading.py and lighting.py, compiled.

Before: curves.py.  After: expose.py.
Symbols as in curves.py.
Source: as lighting.py, lights.py and texture.py.
"""

from __future__ import annotations

import math

import numpy as np

from torchblur.cpu.curves import LIT, MIPPED, TEXTURED, Span
from torchblur.cpu.jit import inlined, jit
from torchblur.cpu.lambert import DIRECTIONAL, SPOT, Lit
from torchblur.cpu.layers import FULL, Looks, lookup
from torchblur.cpu.panels import cubic

Seen = tuple[float, float, float, float, float]


@inlined
def parabola(c0: float, c1: float, c2: float, tau: float) -> float:
    """Return the value at `tau` of three coefficients."""
    v = 1 - tau
    return v * (v * c0 + tau * c1) + tau * (v * c1 + tau * c2)


@inlined
def place_at(span: Span, m: int, tau: float) -> tuple[float, float]:
    """Return the texture coordinates at `tau`; of a face that is a line, those of its middle."""
    scale = parabola(span.scale[m, 0], span.scale[m, 1], span.scale[m, 2], tau)
    if scale == 0:
        return 0.5 * (span.corners[m, 0, 0] + span.corners[m, 0, 1]), 0.5 * (
            span.corners[m, 1, 0] + span.corners[m, 1, 1]
        )
    u = parabola(span.uv[m, 0, 0], span.uv[m, 0, 1], span.uv[m, 0, 2], tau)
    v = parabola(span.uv[m, 1, 0], span.uv[m, 1, 1], span.uv[m, 1, 2], tau)
    return u / scale, v / scale


@inlined
def level_at(span: Span, m: int, last: int, tau: float) -> float:
    """Return the mip level at `tau`, from 0 to `last`."""
    scale = parabola(span.scale[m, 0], span.scale[m, 1], span.scale[m, 2], tau)
    if scale == 0:
        return 0.0
    v, square = 1 - tau, 0.0
    w0, w1, w2, w3, w4 = v**4, 4 * v**3 * tau, 6 * v * v * tau * tau, 4 * v * tau**3, tau**4
    for row in range(4):
        s = span.slope[m, row]
        value = w0 * s[0] + w1 * s[1] + w2 * s[2] + w3 * s[3] + w4 * s[4]
        square += value * value
    return min(0.5 * math.log2(max(0.5 * square / scale**4, 1.0)), float(last))


@inlined
def look_at(span: Span, m: int, scene: tuple[Looks, Lit], tau: float) -> Seen:
    """Return straight RGB, opacity, and the direct light, of a layer at `tau`."""
    looks, lit = scene
    face, flags = span.face[m], span.flags[m]
    red, green, blue, alpha = looks.rgb[face, 0], looks.rgb[face, 1], looks.rgb[face, 2], looks.opacity[face]
    direct = 0.0
    if flags & TEXTURED:
        u, v = place_at(span, m, tau)
        mesh, level = looks.mesh_of[face], 0.0
        if flags & MIPPED:
            level = level_at(span, m, looks.n_levels[mesh] - 1, tau)
        r, g, b, a = lookup(looks, mesh, u, v, level)
        red, green, blue, alpha = red * r, green * g, blue * b, alpha * (1.0 if a > 1 - FULL else a)
    if flags & LIT:
        (r, g, b), direct = shine(span, m, lit, tau)
        red, green, blue = red * r, green * g, blue * b
    return red, green, blue, alpha, direct


@inlined
def _at(rows: np.ndarray, tau: float) -> tuple[float, float, float]:
    return cubic(rows[0], tau), cubic(rows[1], tau), cubic(rows[2], tau)


@inlined
def _size(x: float, y: float, z: float) -> float:
    """Return the length of a vector, however small or large it is."""
    largest = max(abs(x), abs(y), abs(z))
    if largest == 0:
        return 0.0
    x, y, z = x / largest, y / largest, z / largest
    return largest * np.sqrt(x * x + y * y + z * z)


@inlined
def shine(span: Span, m: int, lit: Lit, tau: float) -> tuple[tuple[float, float, float], float]:
    """Return what to multiply the colour of a lit layer by at `tau`, and the direct light in it, summed over RGB."""
    scale = parabola(span.scale[m, 0], span.scale[m, 1], span.scale[m, 2], tau)
    red, green, blue, direct = lit.ambient[0], lit.ambient[1], lit.ambient[2], 0.0
    nx, ny, nz = _at(span.normal[m], tau)
    of_normal = _size(nx, ny, nz)
    if of_normal == 0 or scale == 0:
        return (red, green, blue), direct
    nx, ny, nz = nx / of_normal, ny / of_normal, nz / of_normal
    for lamp in range(len(lit.kind)):
        kind = lit.kind[lamp]
        x, y, z = _at(span.vector[m, lamp], tau)
        length = _size(x, y, z)
        if length == 0:
            continue
        x, y, z = x / length, y / length, z / length
        cosine = (nx * x + ny * y + nz * z) * span.side[m, 1 if kind == DIRECTIONAL else 0]
        if not cosine > 0:
            continue
        share = cosine / math.pi
        if kind != DIRECTIONAL:
            share *= (scale / length) ** 2
        if kind == SPOT:
            share *= _in_cone(span, lit, lamp, tau, (x, y, z, np.sign(scale)))
        red += share * lit.power[lamp, 0]
        green += share * lit.power[lamp, 1]
        blue += share * lit.power[lamp, 2]
        direct += share * (lit.power[lamp, 0] + lit.power[lamp, 1] + lit.power[lamp, 2])
    return (red, green, blue), direct


@inlined
def _in_cone(span: Span, lit: Lit, lamp: int, tau: float, toward: tuple[float, float, float, float]) -> float:
    """Return the share of a spot's light in the direction from it; `toward` is to it, but for the sign of S."""
    axis = span.axis[lamp]
    x = axis[0, 0] + tau * (axis[0, 1] - axis[0, 0])
    y = axis[1, 0] + tau * (axis[1, 1] - axis[1, 0])
    z = axis[2, 0] + tau * (axis[2, 1] - axis[2, 0])
    size = _size(x, y, z)
    if size == 0:
        size = 1.0
    cosine = -toward[3] * (x * toward[0] + y * toward[1] + z * toward[2]) / size
    inner, outer = lit.cosines[lamp, 0], lit.cosines[lamp, 1]
    if inner > outer:
        return min(max((cosine - outer) / (inner - outer), 0.0), 1.0) ** 2
    return 1.0 if cosine >= outer else 0.0
