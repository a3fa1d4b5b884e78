"""What a surface looks like at a time along a ray: colour and opacity, textures included.

Before: texture.py, intervals.py.  After: resolve.py, instant.py.
Symbols: K points on surfaces.
Source: Ronnow et al. 2022, eq. 1 (perspective-correct attributes without division by w).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchblur import edges
from torchblur.prisms import Prisms
from torchblur.surfaces import Surfaces
from torchblur.texture import lookup, to_texels


def textured_among(surfaces: Surfaces, face: Tensor) -> Tensor:
    """Return the indices of the faces `face` (K,) that have a texture. Ours."""
    return surfaces.is_textured[face].nonzero().flatten()


def look(surfaces: Surfaces, face: Tensor, textured: Tensor, texel: Tensor) -> tuple[Tensor, Tensor]:
    """Return straight colour (K, 3) and opacity (K,) of points on `face` (K,).

    Args:
        surfaces: appearance of the faces.
        face: (K,) int64.
        textured: (J,) of `textured_among`.
        texel: (2, J) places of these on their textures.

    Gradient: to colour, opacity, texture, and through `texel`.
    Source: ours.
    """
    rgb, alpha = surfaces.rgb[face], surfaces.opacity[face]
    if len(textured) == 0:
        return rgb, alpha
    rgba = torch.cat([rgb, alpha.unsqueeze(1)], dim=1)
    rgba = rgba.index_put((textured,), rgba[textured] * lookup(surfaces, face[textured], texel))
    return rgba[:, :3], rgba[:, 3]


def texels_on_prisms(prisms: Prisms, prism: Tensor, ray_ndc: Tensor, t: Tensor) -> Tensor:
    """Return (2, K) places on the textures, where rays meet moving prisms at shutter times `t`.

    Args:
        prisms: of the scene.
        prism, ray_ndc, t: (K,), (2, K), (K,).

    Gradient: to vertices, camera and uv, and through `t`.
    Source: Ronnow et al. 2022, eq. 1.
    """
    u = (t - prisms.t_open[prism]) / (prisms.t_close - prisms.t_open)[prism]
    x, y, _ = edges.reduce_corners(prisms.clip, prism, ray_ndc).at(u)
    e = edges.edges_of(x, y)
    uv = corner_uv(prisms, prism)
    return to_texels(prisms.surfaces, prisms.face_of[prism], (e * uv).sum(1) / e.sum(0))


def corner_uv(prisms: Prisms, prism: Tensor) -> Tensor:
    """Return (2, 3, K) texture coordinates of the corners of prisms `prism` (K,) in their stored order. Ours."""
    face, order = prisms.face_of[prism], prisms.corner_of[:, prism]
    return torch.stack([prisms.surfaces.uv[face, corner] for corner in order]).permute(2, 0, 1)
