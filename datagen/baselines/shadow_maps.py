"""What a light sees: projections of it, and rasterisation into the texels of a shadow map.

Before: shadow_samples.py.  After: shadows_hong2018.py, shadows_tsm.py.
Symbols: V views (1 of spots and directional lights, 6 of points), each of size x size texels; T triangles; J points.
"Light space" is (x, y, w, depth), x / w and y / w in [-1, 1] inside a view: w = depth, the distance along the view's
axis, for lights with a place, and w = 1 for directional ones.
Source: Williams 1978 (shadow maps).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

import torchblur as tb
from datagen.baselines.shadow_samples import MovingFaces, boxes_px, centres_ndc, pixels_in
from torchblur import check
from torchblur.lights import unit

MAX_SPOT_DEG = 80.0  # a wider cone does not fit one view
MARGIN = 1.001  # of a view over what it must hold
MAX_SIZE_PX = 8192


@dataclass(frozen=True, eq=False)
class LightViews:
    """Views of one light that rests."""

    matrix: Tensor  # (V, 4, 4) float64 world to light space
    size_px: int

    @property
    def n_texels(self) -> int:
        """Number of texels of all views."""
        return len(self.matrix) * self.size_px**2

    def project(self, world: Tensor) -> Tensor:
        """Return (V, ..., 4) light space of world positions (..., 3)."""
        return torch.einsum("vij,...j->v...i", self.matrix[..., :3], world) + self.matrix[..., 3].reshape(
            -1, *[1] * (world.ndim - 1), 4
        )

    def find_texels(self, world: Tensor) -> tuple[Tensor, Tensor]:
        """Return the texel (J,) that points (J, 3) fall into, -1 outside all views, and their depth (J,)."""
        place = self.project(world)
        w = place[..., 2]
        ndc = place[..., :2] / torch.where(w > 0, w, 1.0).unsqueeze(-1)
        is_inside = (w > 0) & (ndc.abs() <= 1).all(-1)
        view = is_inside.to(torch.uint8).argmax(0)
        own = torch.arange(len(world), device=world.device)
        n = self.size_px
        column = ((ndc[view, own, 0] + 1) * (n / 2)).long().clamp(0, n - 1)
        row = ((1 - ndc[view, own, 1]) * (n / 2)).long().clamp(0, n - 1)
        texel = view * n * n + row * n + column
        return torch.where(is_inside.any(0), texel, -1), place[view, own, 3]


@dataclass(frozen=True, eq=False)
class Texels:
    """Where triangles cover the centres of texels."""

    texel: Tensor  # (J,) int64
    triangle: Tensor  # (J,) int64
    bary: Tensor  # (J, 3)
    depth: Tensor  # (J,)


@torch.no_grad()
def view_from_light(scene: tb.Scene, faces: MovingFaces, size_px: int) -> LightViews:
    """Return the views of the scene's light: a spot's cone, a box around all faces, or the six sides of a cube.

    Raises:
        TypeError, ValueError: `size_px`; a spot wider than 80 degrees from its axis.

    Source: Williams 1978.
    """
    check.positive_int("size_px", size_px, MAX_SIZE_PX)
    light = scene.lights[0]
    if isinstance(light, tb.DirectionalLight):
        frame = _frame(light.direction.to(faces.world).reshape(-1, 3)[0])
        place = faces.world.reshape(-1, 3) @ frame.T
        low, high = place.amin(0), place.amax(0)
        half = ((high - low)[:2] / 2).clamp(min=1e-9 * float((high - low).max())) * MARGIN
        rows = torch.zeros(4, 4, dtype=torch.float64, device=frame.device)
        rows[:2, :3] = frame[:2] / half.unsqueeze(1)
        rows[:2, 3] = -(low + high)[:2] / 2 / half
        rows[2, 3] = 1.0
        rows[3, :3], rows[3, 3] = frame[2], -low[2]
        return LightViews(rows.unsqueeze(0), size_px)
    position = light.position.to(faces.world).reshape(-1, 3)[0]
    if isinstance(light, tb.SpotLight):
        if light.outer_angle_deg > MAX_SPOT_DEG:
            raise check.fail("outer_angle_deg", f"at most {MAX_SPOT_DEG:g}", light.outer_angle_deg)
        axes, slope = (
            [light.target.to(position).reshape(-1, 3)[0] - position],
            math.tan(math.radians(light.outer_angle_deg)),
        )
    else:
        sides = torch.eye(3).to(position)
        axes, slope = [*sides, *-sides], 1.0
    matrices = []
    for axis in axes:
        frame = _frame(axis)
        rows = torch.stack([frame[0] / (slope * MARGIN), frame[1] / (slope * MARGIN), frame[2], frame[2]])
        matrices.append(torch.cat([rows, -(rows @ position).unsqueeze(1)], dim=1))
    return LightViews(torch.stack(matrices), size_px)


def rasterise(views: LightViews, corners: Tensor, view: Tensor) -> Texels:
    """Return the texels whose centres triangles in light space (T, 3, 4) cover, each in its view (T,).

    Both sides count. A centre on an edge that two triangles share counts once, as on graphics hardware.

    Source: Olano & Greer 1997 (homogeneous rasterisation); depth is linear in space, so perspective is right.
    """
    n = views.size_px
    xyw = corners[..., :3]
    pixel, triangle = pixels_in(boxes_px(xyw, n, n), n)
    x0, y0 = centres_ndc(pixel, n, n)
    side = torch.linalg.cross(xyw[:, [1, 2, 0]], xyw[:, [2, 0, 1]])[triangle]  # (pairs, 3, 3): linear in the ray
    e = side[..., 0] * x0.unsqueeze(1) + side[..., 1] * y0.unsqueeze(1) + side[..., 2]
    along = torch.where(side[..., 0] != 0, side[..., 0], side[..., 1])
    sign = torch.where(e != 0, e, along)
    kept = ((sign > 0).all(1) | (sign < 0).all(1)).nonzero().flatten()
    pixel, triangle, e = pixel[kept], triangle[kept], e[kept]
    total = e.sum(1)
    bary = e / torch.where(total != 0, total, 1.0).unsqueeze(1)
    w, depth = ((bary * corners[..., k][triangle]).sum(1) for k in (2, 3))
    kept = ((total != 0) & (w > 0)).nonzero().flatten()
    texel = view[triangle] * n * n + pixel
    return Texels(texel[kept], triangle[kept], bary[kept], depth[kept])


def _frame(axis: Tensor) -> Tensor:
    """Return rows x, y, forward (3, 3) of length 1; seen along `axis`, x is to the right of y."""
    forward = unit(axis)
    other = torch.eye(3, dtype=axis.dtype, device=axis.device)[forward.abs().argmin()]
    x = unit(torch.linalg.cross(forward, other))
    return torch.stack([x, torch.linalg.cross(x, forward), forward])
