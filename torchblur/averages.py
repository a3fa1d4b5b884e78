"""The mean look of a layer over a cell, as the papers approximate it: texture by two anisotropic lookups along the line
between the ends of the layer's interval, light with the normal of the interval's start.

Before: shading.py, shadows.py.  After: resolve.py.  Only for `Accuracy.linear` and `Accuracy.adaptive`.
Symbols: L layers (an interval in a cell), J of them with texture or light.
Source: Ronnow et al. 2021, sec. 4.4 and 5.1; the rule for the taps is that of EXT_texture_filter_anisotropic.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchblur.cells import Cells
from torchblur.intervals import Intervals
from torchblur.lighting import reflected
from torchblur.prisms import Prisms
from torchblur.shading import Look, Points, needing_points, points_on_prisms, position_and_normal, uv_slopes
from torchblur.shadows import visible_at
from torchblur.surfaces import Surfaces
from torchblur.texture import footprint, lookup

MAX_TAPS = 16  # of an anisotropic lookup
INSET = 1e-6  # of an interval: places at its ends are looked up so far inside, where a face seen edge-on has one


def look_over(prisms: Prisms, intervals: Intervals, cells: Cells, layers: tuple[Tensor, Tensor]) -> Look:
    """Return the mean look of layers over their cells, with the shadows of the cells' middles.

    Args:
        prisms: of the scene.
        intervals: as the accuracy approximates them.
        cells: cut from these.
        layers: cell and interval (L,) of each.

    Accuracy: none stated; see `Accuracy.linear`.
    Gradient: to colour, opacity, texture, uv, normals, lights.
    Source: Ronnow et al. 2021, sec. 4.4.
    """
    cell, interval = layers
    surfaces = prisms.surfaces
    face = prisms.face_of[intervals.prism[interval]]
    rgb, alpha = surfaces.rgb[face], surfaces.opacity[face]
    which = needing_points(surfaces, face)
    direct = torch.zeros(len(face), 2, dtype=torch.float64, device=face.device)
    if len(which) == 0:
        return Look(rgb, alpha, direct)
    cell, interval = cell[which], interval[which]
    t_start, t_end = intervals.t_start[interval], intervals.t_end[interval]
    start, end = (
        points_on_prisms(prisms, intervals, interval, (1 - at) * t_start + at * t_end) for at in (INSET, 1 - INSET)
    )
    share = torch.stack([(t[cell] - t_start) / (t_end - t_start) for t in (cells.t_start, cells.t_end)])
    textured = surfaces.is_textured[start.face].nonzero().flatten()
    if len(textured):
        of = which[textured]
        rgba = _two_lookups(surfaces, (start, end), share, textured)
        rgb = rgb.index_put((of,), rgb[of] * rgba[:, :3])
        alpha = alpha.index_put((of,), alpha[of] * rgba[:, 3])
    lit = surfaces.is_lit[start.face].nonzero().flatten()
    if len(lit):
        (first, normal), (last, _) = (position_and_normal(surfaces, p, lit) for p in (start, end))
        middle = share.mean(0)[lit]
        t = 0.5 * (cells.t_start + cells.t_end)[cell[lit]]
        point = (1 - middle) * first + middle * last
        visible = visible_at(surfaces, point, t, start.face[lit])
        light, own = reflected(surfaces, point, normal, t, visible)
        rgb = rgb.index_put((which[lit],), rgb[which[lit]] * light)
        direct = direct.index_put((which[lit],), own)
    return Look(rgb, alpha, direct)


def _two_lookups(surfaces: Surfaces, ends: tuple[Points, Points], share: Tensor, textured: Tensor) -> Tensor:
    """Return (n, 4) the mean of both halves of the way from `share` to `share` (2, J) between the `ends`."""
    face = ends[0].face[textured]
    uv_start, uv_end = ((p.weight[:, textured] * p.uv[..., textured]).sum(1) for p in ends)
    first, last = ((1 - s) * uv_start + s * uv_end for s in share[:, textured])
    middle = 0.5 * (first + last)
    size = surfaces.atlas.size[0][:, surfaces.mesh_of[face]]
    minor = torch.ones(len(face), dtype=torch.float64, device=face.device)
    if ends[0].slope.shape[-1]:
        has_levels = surfaces.atlas.n_levels[surfaces.mesh_of[face]] > 1
        wide = footprint(size, uv_slopes(ends[0], textured)).detach().clamp(min=1.0)
        minor = torch.where(has_levels, wide, minor)
    halves = [_anisotropic(surfaces, face, way, minor) for way in ((first, middle), (middle, last))]
    rgba = 0.5 * (halves[0] + halves[1])
    opacity = rgba[:, 3:]
    is_visible = opacity > 0
    rgb = torch.where(is_visible, rgba[:, :3] / torch.where(is_visible, opacity, 1.0), 0.0)
    return torch.cat([rgb, opacity], dim=1)


def _anisotropic(surfaces: Surfaces, face: Tensor, way: tuple[Tensor, Tensor], minor: Tensor) -> Tensor:
    """Return (n, 4) premultiplied, the mean of taps evenly spaced on the `way` between two places uv (2, n).

    Args:
        surfaces: appearance of the faces.
        face: (n,).
        way: first and last place.
        minor: (n,) width of the way: of the ray's footprint, at least one texel.
    """
    mesh = surfaces.mesh_of[face]
    first, step = way[0], way[1] - way[0]
    length = (step.detach() * surfaces.atlas.size[0][:, mesh]).norm(dim=0)
    major = torch.maximum(length, minor)
    n_taps = (major / minor).ceil().clamp(max=MAX_TAPS)
    level = torch.log2((major / n_taps).clamp(min=1.0))
    level = torch.minimum(level, (surfaces.atlas.n_levels[mesh] - 1).to(level.dtype))
    total = torch.zeros(len(face), 4, dtype=torch.float64, device=face.device)
    for k in range(int(n_taps.max())):
        active = (n_taps > k).nonzero().flatten()
        place = first[:, active] + step[:, active] * ((k + 0.5) / n_taps[active])
        rgba = lookup(surfaces, face[active], place, level[active])
        total = total.index_add(0, active, torch.cat([rgba[:, :3] * rgba[:, 3:], rgba[:, 3:]], dim=1))
    return total / n_taps.unsqueeze(1)
