"""Look up textures: bilinear between texels, linear between mip levels, repeated or clamped.

Before: surfaces.py.  After: shading.py, texture_bends.py.
Symbols: K lookups; (u, v) texture coordinates, v = 0 at the bottom edge; (x, y) texels of one level, x right, y down, 0
at the centre of the first texel, so that bilinear interpolation bends where x or y is whole.
Source: the OpenGL rules of texture lookup; mip maps, Williams 1983.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchblur.surfaces import Surfaces


def to_texels(uv: Tensor, size: Tensor) -> Tensor:
    """Return (2, ..., K) places in texels of coordinates `uv` (2, ..., K) on images of `size` (2, K). Ours."""
    return torch.stack([uv[0] * size[0] - 0.5, (1 - uv[1]) * size[1] - 0.5])


def footprint(size: Tensor, slope: Tensor) -> Tensor:
    """Return the root mean square (K,) of the axes of the rays' footprints [texels].

    Unlike the longer axis alone, it is smooth and does not change when the image is turned.

    Args:
        size: (2, K) of the textures.
        slope: (2 uv, 2 screen axes, K) change of uv from one ray to the next.

    Source: ours.
    """
    square = 0.5 * (size.unsqueeze(1) * slope).square().sum((0, 1))
    is_there = square > 0
    return torch.where(is_there, torch.where(is_there, square, 1.0).sqrt(), 0.0)


def mip_level(surfaces: Surfaces, face: Tensor, slope: Tensor) -> Tensor:
    """Return the levels (K,) of lookups: log2 of the footprint, from 0 to the last.

    Args:
        surfaces: appearance of the faces.
        face: (K,) int64.
        slope: as in `footprint`.

    Source: Williams 1983.
    """
    atlas, mesh = surfaces.atlas, surfaces.mesh_of[face]
    level = torch.log2(footprint(atlas.size[0][:, mesh], slope).clamp(min=1.0))
    return torch.minimum(level, (atlas.n_levels[mesh] - 1).to(level.dtype))


def lookup(surfaces: Surfaces, face: Tensor, uv: Tensor, level: Tensor) -> Tensor:
    """Return (K, 4) linear RGB and opacity of the textures of `face` (K,) at `uv` (2, K) and `level` (K,).

    Gradient: to the texels and, except where it bends, to place and level.
    Source: trilinear interpolation.
    """
    fine = level.detach().floor()
    looked = _bilinear(surfaces, face, uv, fine.long())
    blended = (level > fine).nonzero().flatten()
    if len(blended) == 0:
        return looked
    coarse = _bilinear(surfaces, face[blended], uv[:, blended], fine[blended].long() + 1)
    share = (level - fine)[blended].unsqueeze(1)
    return looked.index_put((blended,), (1 - share) * looked[blended] + share * coarse)


def _bilinear(surfaces: Surfaces, face: Tensor, uv: Tensor, level: Tensor) -> Tensor:
    """Return (K, 4) at whole levels (K,)."""
    atlas, mesh = surfaces.atlas, surfaces.mesh_of[face]
    size, first, repeats = atlas.size[level, :, mesh].T, atlas.first[level, mesh], atlas.repeats[mesh]
    texel = to_texels(uv, size)
    whole = texel.detach().floor()
    share = texel - whole
    total = torch.zeros(len(face), 4, dtype=torch.float64, device=face.device)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        step = torch.tensor([[dx], [dy]], device=face.device)
        place = whole.long() + step
        place = torch.where(repeats, place % size, torch.minimum(place.clamp(min=0), size - 1))
        weight = torch.where(step == 1, share, 1 - share).prod(0)
        total = total + weight.unsqueeze(1) * atlas.texels[first + place[1] * size[0] + place[0]]
    return total
