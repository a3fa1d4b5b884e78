"""The light that a point of a surface sends to the viewer, as a share of its colour.

Before: lights.py, surfaces.py.  After: shading.py.
Symbols: K points; a corner is given in any order, `turn` tells whether that order is the face's own.
Source: Lambert's law, radiance = albedo / pi * irradiance * cosine.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchblur.lights import unit
from torchblur.surfaces import Surfaces


def flat_normal(corner: Tensor, turn: Tensor) -> Tensor:
    """Return (3, K) normals, of the length of twice the area, of faces with `corner` (3 corners, 3, K) in world space.

    They point to where the corners turn counter-clockwise, for `turn` (K,) -1 to the other side.
    """
    return turn * torch.linalg.cross(corner[1] - corner[0], corner[2] - corner[0], dim=0)


def reflected(
    surfaces: Surfaces, point: Tensor, normal: Tensor, t: Tensor, visible: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return (K, 3): ambient + sum of irradiance / pi * cosine * visible over the lights; and (K, 2): the direct light
    that were there without shadows, and that is there, both summed over RGB.

    Args:
        surfaces: whose lights shine.
        point: (3, K) float64 world positions.
        normal: (3, K) on the viewer's side, of any length.
        t: (K,) shutter times.
        visible: (lights, K) share of each light that reaches the points; all of it if None.

    Gradient: to points, normals, lights and `visible`.
    Source: Lambert's law.
    """
    normal = unit(normal)
    total = surfaces.ambient.expand(point.shape[1], 3)
    due = arriving = torch.zeros_like(t)
    for k, light in enumerate(surfaces.lights):
        to_light, irradiance = light.arriving(point, t)
        cosine = (normal * to_light).sum(0).clamp(min=0)
        direct = irradiance * (cosine / math.pi).unsqueeze(1)
        due = due + direct.sum(1)
        direct = direct if visible is None else direct * visible[k].unsqueeze(1)
        arriving = arriving + direct.sum(1)
        total = total + direct
    return total, torch.stack([due, arriving], dim=1)
