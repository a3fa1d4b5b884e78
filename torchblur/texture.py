"""Look up textures: bilinear, repeated or clamped.

Before: surfaces.py.  After: nodes.py (where a lookup bends), shading.py.
Symbols: K lookups; (u, v) texture coordinates, v = 0 at the bottom edge; (x, y) texels, x right, y down, 0 at the
centre of the first texel, so that bilinear interpolation bends where x or y is whole.
Source: the OpenGL rules of texture lookup.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchblur.surfaces import Surfaces


def to_texels(surfaces: Surfaces, face: Tensor, uv: Tensor) -> Tensor:
    """Return (2, ..., K) places in texels of coordinates `uv` (2, ..., K) on the textures of `face` (K,). Ours."""
    width, height = surfaces.atlas.size[:, surfaces.mesh_of[face]].to(torch.float64)
    return torch.stack([uv[0] * width - 0.5, (1 - uv[1]) * height - 0.5])


def lookup(surfaces: Surfaces, face: Tensor, texel: Tensor) -> Tensor:
    """Return (K, 4) linear RGB and opacity at the places `texel` (2, K) of the textures of `face` (K,).

    Gradient: to the texels and, except where it bends, to the place.
    Source: bilinear interpolation.
    """
    atlas, mesh = surfaces.atlas, surfaces.mesh_of[face]
    whole = texel.detach().floor()
    share = texel - whole
    size, repeats = atlas.size[:, mesh], atlas.repeats[mesh]
    total = torch.zeros(len(face), 4, dtype=torch.float64, device=face.device)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        step = torch.tensor([[dx], [dy]], device=face.device)
        place = whole.long() + step
        place = torch.where(repeats, place % size, torch.minimum(place.clamp(min=0), size - 1))
        weight = torch.where(step == 1, share, 1 - share).prod(0)
        total = total + weight.unsqueeze(1) * atlas.texels[atlas.first[mesh] + place[1] * size[0] + place[0]]
    return total
