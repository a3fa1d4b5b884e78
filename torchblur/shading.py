"""What a surface looks like at a time along a ray: colour and opacity, with texture and light.

Before: texture.py, lighting.py, intervals.py.  After: resolve.py, instant.py.
Symbols: K points on surfaces, J of them with texture or light; weight_i = e_i / S the barycentric of a face's corner i.
Source: Ronnow et al. 2022, eq. 1 and 2 (perspective-correct attributes without division by w).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import edges
from torchblur.intervals import Intervals
from torchblur.lighting import flat_normal, reflected
from torchblur.prisms import Prisms
from torchblur.stopwatch import spent_on
from torchblur.surfaces import Surfaces
from torchblur.texture import lookup, mip_level

OPAQUE = 1e-14  # rounding of an interpolated opacity of 1


@dataclass(frozen=True)
class Look:
    """What K points look like."""

    rgb: Tensor  # (K, 3) straight colour
    alpha: Tensor  # (K,) opacity
    light: Tensor  # (K, 2) direct light that were there without shadows, and that is there; 0 on what is not lit


@dataclass(frozen=True)
class Points:
    """Points on faces that have texture or light; corners in any order, the same in all fields."""

    face: Tensor  # (J,) int64
    weight: Tensor  # (3, J) float64 barycentrics of the corners
    slope: Tensor  # (2, 3, J) their change from one ray to the next along x and y; (2, 3, 0) without mips
    uv: Tensor  # (2, 3, J) of the corners
    world: Tensor  # (3 corners, 3, J) positions; (3, 3, 0) where nothing is lit
    normal: Tensor  # (3 corners, 3, J) normals, of any length; or as `world`
    turn: Tensor  # (J,) +1 where the corners are in the face's order, else -1
    side: Tensor  # (J,) +1 where the face turns counter-clockwise on screen, else -1
    t: Tensor  # (J,) shutter time
    visible: Tensor | None = None  # (lights, J) share of each light that reaches the points; all of it if None


def needing_points(surfaces: Surfaces, face: Tensor) -> Tensor:
    """Return the indices (J,) of the faces `face` (K,) whose look depends on where and when they are seen. Ours."""
    return (surfaces.is_textured | surfaces.is_lit)[face].nonzero().flatten()


def look(surfaces: Surfaces, face: Tensor, which: Tensor, points: Points) -> Look:
    """Return the look of points on `face` (K,).

    Args:
        surfaces: appearance of the faces.
        face: (K,) int64.
        which: (J,) of `needing_points`.
        points: these.

    Gradient: to colour, opacity, texture, lights, and through the points.
    Source: ours.
    """
    rgb, alpha = surfaces.rgb[face], surfaces.opacity[face]
    direct = torch.zeros(len(face), 2, dtype=torch.float64, device=face.device)
    if len(which) == 0:
        return Look(rgb, alpha, direct)
    textured = surfaces.is_textured[points.face].nonzero().flatten()
    if len(textured):
        of, own = which[textured], points.face[textured]
        corner_uv = points.uv[..., textured]
        level = torch.zeros(len(of), dtype=torch.float64, device=of.device)
        with spent_on("texture"):
            if points.slope.shape[-1]:
                level = mip_level(surfaces, own, uv_slopes(points, textured))
            rgba = lookup(surfaces, own, (points.weight[:, textured] * corner_uv).sum(1), level)
        rgb = rgb.index_put((of,), rgb[of] * rgba[:, :3])
        opacity = rgba[:, 3]  # 1 must stay 1 for what is behind to be hidden, but weights add up to 1 - 1e-16
        opacity = opacity + ((1 - opacity) * (opacity > 1 - OPAQUE)).detach()
        alpha = alpha.index_put((of,), alpha[of] * opacity)
    lit = surfaces.is_lit[points.face].nonzero().flatten()
    if len(lit):
        visible = None if points.visible is None else points.visible[:, lit]
        with spent_on("lighting"):
            light, own = reflected(surfaces, *position_and_normal(surfaces, points, lit), points.t[lit], visible)
        rgb = rgb.index_put((which[lit],), rgb[which[lit]] * light)
        direct = direct.index_put((which[lit],), own)
    return Look(rgb, alpha, direct)


def points_on_prisms(prisms: Prisms, intervals: Intervals, interval: Tensor, t: Tensor) -> Points:
    """Return where the rays of `interval` (J,) meet its moving faces at shutter times `t` (J,).

    Gradient: to vertices, normals, camera and uv, and through `t`.
    Source: Ronnow et al. 2022, eq. 1 and 2.
    """
    prism = intervals.prism[interval]
    ray = intervals.ray_ndc[:, intervals.pixel_of(interval)]
    u = (t - prisms.t_open[prism]) / (prisms.t_close - prisms.t_open)[prism]
    x, y, w = edges.reduce_corners(prisms.clip, prism, ray).at(u)
    e = edges.edges_of(x, y)
    scale = e.sum(0)
    is_seen = scale != 0  # what has become a line may cover the ray for a rounding error
    slope = e.new_zeros(2, 3, 0)
    if prisms.surfaces.has_mipmaps:
        slope = _slopes((x, y, w), intervals.spacing_ndc)
    is_lit = prisms.world.shape[-1] > 0
    moving = (c.index_select(-1, prism) if is_lit else c for c in (prisms.world, prisms.normal))
    world, normal = ((1 - u) * c[0] + u * c[1] if is_lit else c[0] for c in moving)
    parity = prisms.parity[prism]
    return Points(
        face=prisms.face_of[prism],
        weight=torch.where(is_seen, e / torch.where(is_seen, scale, 1.0), 1 / 3),
        slope=slope,
        uv=prisms.corner_uv(prism),
        world=world,
        normal=normal,
        turn=parity,
        side=parity * scale.detach().sign(),
        t=t,
    )


def weight_slopes(e: Tensor, slopes: tuple[Tensor, Tensor], spacing: tuple[float, float]) -> Tensor:
    """Return (2, 3, J) the change of the barycentrics e / S from one ray to the next.

    Args:
        e: (3, J) edge functions.
        slopes: of e along the ray's x and y in NDC, (3, J) each.
        spacing: from one ray to the next along x and y, in NDC.

    Source: quotient rule.
    """
    scale = e.sum(0)
    square = torch.where(scale != 0, scale.square(), 1.0)  # a line has none, see `points_on_prisms`
    return torch.stack([(scale * d - e * d.sum(0)) * (step / square) for d, step in zip(slopes, spacing, strict=True)])


def uv_slopes(points: Points, chosen: Tensor) -> Tensor:
    """Return (2 uv, 2 axes, n) the change of uv from one ray to the next at the points `chosen` (n,). Ours."""
    return (points.slope[..., chosen].unsqueeze(0) * points.uv[..., chosen].unsqueeze(1)).sum(2)


def _slopes(corners: tuple[Tensor, Tensor, Tensor], spacing: tuple[float, float]) -> Tensor:
    """Return `weight_slopes` at reduced corners x, y, w (3, J)."""
    x, y, w = corners
    return weight_slopes(edges.edges_of(x, y), (edges.edges_of(y, w), edges.edges_of(w, x)), spacing)


def position_and_normal(surfaces: Surfaces, points: Points, lit: Tensor) -> tuple[Tensor, Tensor]:
    """Return world positions and normals on the viewer's side, of any length, (3, I) each, of the points `lit` (I,).

    Source: Ronnow et al. 2022, eq. 2.
    """
    weight, world = points.weight[:, lit].unsqueeze(1), points.world[..., lit]
    normal = flat_normal(world, points.turn[lit])
    smooth = (weight * points.normal[..., lit]).sum(0)
    normal = torch.where(surfaces.has_normals[points.face[lit]], smooth, normal)
    return (weight * world).sum(0), normal * (points.side[lit] * surfaces.handedness)
