"""What a layer looks like at a time of a panel, one ray at a time: shading.py and lighting.py, compiled.

Before: panels.py.  After: expose.py.
Symbols as in panels.py.
Source: as lighting.py, lights.py and texture.py.
"""

from __future__ import annotations

import math

import numpy as np

from torchblur.cpu.curves import LIT, MIPPED, TEXTURED, Span
from torchblur.cpu.jit import inlined
from torchblur.cpu.lambert import DIRECTIONAL, SPOT, Lit
from torchblur.cpu.layers import FULL, Looks, lookup
from torchblur.cpu.panels import Panel

Seen = tuple[float, float, float, float, tuple[float, float]]


@inlined
def place_at(panel: Panel, m: int, s: float) -> tuple[float, float]:
    """Return the texture coordinates at `s`; of a face that is a line, those of the corners are taken as alike."""
    scale, uv = panel.scale, panel.uv
    inverse = scale[m, 0] + s * (scale[m, 1] + s * scale[m, 2])
    inverse = 1 / inverse if inverse != 0 else 0.0
    u = uv[m, 0, 0] + s * (uv[m, 0, 1] + s * uv[m, 0, 2])
    v = uv[m, 1, 0] + s * (uv[m, 1, 1] + s * uv[m, 1, 2])
    return u * inverse, v * inverse


@inlined
def level_at(panel: Panel, m: int, last: int, s: float) -> float:
    """Return the mip level at `s`, from 0 to `last`."""
    square, slope = 0.0, panel.slope
    for row in range(4):
        value = slope[m, 3, row] + s * slope[m, 4, row]
        value = slope[m, 0, row] + s * (slope[m, 1, row] + s * (slope[m, 2, row] + s * value))
        square += value * value
    scale = panel.scale[m, 0] + s * (panel.scale[m, 1] + s * panel.scale[m, 2])
    if scale == 0:
        return 0.0
    scale *= scale
    return min(0.5 * math.log2(max(0.5 * square / (scale * scale), 1.0)), float(last))


@inlined
def look_at(span: Span, panel: Panel, m: int, scene: tuple[Looks, Lit], s: float) -> Seen:
    """Return straight RGB, opacity, and the direct light due and arriving, of a layer at a time `s` of a panel."""
    looks, lit = scene
    face, flags = span.face[m], span.flags[m]
    red, green, blue, alpha = looks.rgb[face, 0], looks.rgb[face, 1], looks.rgb[face, 2], looks.opacity[face]
    direct = (0.0, 0.0)
    if flags & TEXTURED:
        u, v = place_at(panel, m, s)
        mesh, level = looks.mesh_of[face], 0.0
        if flags & MIPPED:
            level = level_at(panel, m, looks.n_levels[mesh] - 1, s)
        r, g, b, a = lookup(looks, mesh, u, v, level)
        red, green, blue, alpha = red * r, green * g, blue * b, alpha * (1.0 if a > 1 - FULL else a)
    if flags & LIT:
        (r, g, b), direct = shine(span, panel, m, lit, s)
        red, green, blue = red * r, green * g, blue * b
    return red, green, blue, alpha, direct


@inlined
def _at(rows: np.ndarray, s: float) -> tuple[float, float, float]:
    """Return the vector at `s` of which the powers are given (4, 3)."""
    x = rows[0, 0] + s * (rows[1, 0] + s * (rows[2, 0] + s * rows[3, 0]))
    y = rows[0, 1] + s * (rows[1, 1] + s * (rows[2, 1] + s * rows[3, 1]))
    return x, y, rows[0, 2] + s * (rows[1, 2] + s * (rows[2, 2] + s * rows[3, 2]))


@inlined
def _size(x: float, y: float, z: float) -> float:
    """Return the length of a vector, however small or large it is."""
    largest = max(abs(x), abs(y), abs(z))
    if largest == 0:
        return 0.0
    x, y, z = x / largest, y / largest, z / largest
    return largest * np.sqrt(x * x + y * y + z * z)


@inlined
def shine(
    span: Span, panel: Panel, m: int, lit: Lit, s: float
) -> tuple[tuple[float, float, float], tuple[float, float]]:
    """Return what to multiply the colour of a lit layer by at `s`, and the direct light
    that were there without shadows and that is, summed over RGB.
    """
    scale = panel.scale[m, 0] + s * (panel.scale[m, 1] + s * panel.scale[m, 2])
    red, green, blue, direct = lit.ambient[0], lit.ambient[1], lit.ambient[2], 0.0
    arriving = 0.0
    nx, ny, nz = _at(panel.normal[m], s)
    of_normal = _size(nx, ny, nz)
    if of_normal == 0 or scale == 0:
        return (red, green, blue), (direct, arriving)
    nx, ny, nz = nx / of_normal, ny / of_normal, nz / of_normal
    for lamp in range(len(lit.kind)):
        kind = lit.kind[lamp]
        x, y, z = _at(panel.vector[m, lamp], s)
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
            share *= _in_cone(panel, lit, lamp, s, (x, y, z, np.sign(scale)))
        whole = share * (lit.power[lamp, 0] + lit.power[lamp, 1] + lit.power[lamp, 2])
        share *= panel.visible[m, lamp]
        red += share * lit.power[lamp, 0]
        green += share * lit.power[lamp, 1]
        blue += share * lit.power[lamp, 2]
        direct, arriving = direct + whole, arriving + whole * panel.visible[m, lamp]
    return (red, green, blue), (direct, arriving)


@inlined
def _in_cone(panel: Panel, lit: Lit, lamp: int, s: float, toward: tuple[float, float, float, float]) -> float:
    """Return the share of a spot's light in the direction from it; `toward` is to it, but for the sign of S."""
    axis = panel.axis[lamp]
    x, y, z = axis[0, 0] + s * axis[1, 0], axis[0, 1] + s * axis[1, 1], axis[0, 2] + s * axis[1, 2]
    size = _size(x, y, z)
    if size == 0:
        size = 1.0
    cosine = -toward[3] * (x * toward[0] + y * toward[1] + z * toward[2]) / size
    inner, outer = lit.cosines[lamp, 0], lit.cosines[lamp, 1]
    if inner > outer:
        return min(max((cosine - outer) / (inner - outer), 0.0), 1.0) ** 2
    return 1.0 if cosine >= outer else 0.0
