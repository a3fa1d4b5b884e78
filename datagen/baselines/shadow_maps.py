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
from datagen.baselines.shadow_samples import MovingFaces, boxes_px
from torchblur import check, packed
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
    n, xyw = views.size_px, corners[..., :3]
    box = boxes_px(xyw, n, n)
    side = torch.linalg.cross(xyw[:, [1, 2, 0]], xyw[:, [2, 0, 1]])  # edge functions, linear in the ray (x, y, 1)
    n_rows = torch.where(box[2] >= box[0], box[3] - box[1] + 1, 0).clamp(min=0)
    row, row_of = packed.expand(box[1], n_rows)
    y = 1 - 2 * (row.to(torch.float64) + 0.5) / n
    slope, level = side[row_of, :, 0], side[row_of, :, 1] * y.unsqueeze(1) + side[row_of, :, 2]
    parts = []
    for turn in (1, -1):
        zero = -level / slope
        low = torch.where(turn * slope > 0, zero, -torch.inf).amax(1)
        high = torch.where(turn * slope < 0, zero, torch.inf).amin(1)
        first = ((low + 1) * (n / 2) - 0.5 - 1e-6).ceil().clamp(-1, n).long().maximum(box[0, row_of])
        last = ((high + 1) * (n / 2) - 0.5 + 1e-6).floor().clamp(-1, n).long().minimum(box[2, row_of])
        column, own = packed.expand(first, (last - first + 1).clamp(min=0))
        triangle = row_of[own]
        x = 2 * (column.to(torch.float64) + 0.5) / n - 1
        e = slope[own] * x.unsqueeze(1) + level[own]
        along = torch.where(slope != 0, slope, side[row_of, :, 1])[own]
        sign = torch.where(e != 0, e, along)  # a centre on an edge belongs to the face on one side of it
        total = e.sum(1)
        kept = ((turn * sign > 0).all(1) & (total != 0)).nonzero().flatten()
        triangle, bary = triangle[kept], e[kept] / total[kept].unsqueeze(1)
        w, depth = ((bary * corners[..., k][triangle]).sum(1) for k in (2, 3))
        texel = view[triangle] * n * n + row[own[kept]] * n + column[kept]
        ahead = (w > 0).nonzero().flatten()
        parts.append((texel[ahead], triangle[ahead], bary[ahead], depth[ahead]))
    return Texels(*(torch.cat(p) for p in zip(*parts, strict=True)))


def _frame(axis: Tensor) -> Tensor:
    """Return rows x, y, forward (3, 3) of length 1; seen along `axis`, x is to the right of y."""
    forward = unit(axis)
    other = torch.eye(3, dtype=axis.dtype, device=axis.device)[forward.abs().argmin()]
    x = unit(torch.linalg.cross(forward, other))
    return torch.stack([x, torch.linalg.cross(x, forward), forward])
