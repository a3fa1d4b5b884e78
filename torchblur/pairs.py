"""Pairs of a prism and a ray of a block of pixels that the prism may cover: those inside its swept outline.

Before: prisms.py.  After: intervals.py.
Symbols: P prisms, n pairs; the outline on screen is the convex hull of the six projected corners (in front of the near
plane: where that cuts a prism, its bounding rectangle serves).
Source: Ronnow et al. 2021, sec. 4 (rasterising the prism's bounds); spans of the hull: ours.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import packed
from torchblur.camera import Ray
from torchblur.prisms import BOUND_SLACK_PX, Prisms

ROUNDING = 1e-12  # of the largest coordinate: slack of a span for prisms that reach far off the screen


@dataclass(frozen=True)
class Block:
    """A rectangle of pixels and the place of the ray inside each."""

    x0: int  # first column [px]
    y0: int  # first row [px]
    width: int
    height: int
    ray: Ray  # place of the ray inside its pixel
    image_width: int
    image_height: int

    @property
    def n_pixels(self) -> int:
        """Number of pixels."""
        return self.width * self.height

    def ray_ndc(self, pixel: Tensor) -> Tensor:
        """Return (2, n) float64 NDC of the rays of the block's pixels `pixel` (n,), row by row."""
        x_px = (self.x0 + pixel % self.width).to(torch.float64) + self.ray.x_px
        y_px = (self.y0 + pixel // self.width).to(torch.float64) + self.ray.y_px
        return torch.stack([2 * x_px / self.image_width - 1, 1 - 2 * y_px / self.image_height])

    @property
    def spacing_ndc(self) -> tuple[float, float]:
        """Distance in NDC from one ray to the next, along x and y (downwards, hence negative)."""
        return 2 * self.ray.spacing_px / self.image_width, -2 * self.ray.spacing_px / self.image_height

    def columns_rows(self, bounds_px: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the first column, first row, and numbers of columns and rows (P,) of the block whose rays `bounds_px`
        (4, P) hold.
        """
        low_x = torch.ceil(bounds_px[0].clamp(min=-1) - self.ray.x_px).clamp(min=self.x0)
        low_y = torch.ceil(bounds_px[1].clamp(min=-1) - self.ray.y_px).clamp(min=self.y0)
        high_x = torch.floor(bounds_px[2].clamp(max=self.image_width) - self.ray.x_px)
        high_y = torch.floor(bounds_px[3].clamp(max=self.image_height) - self.ray.y_px)
        n_x = (high_x.clamp(max=self.x0 + self.width - 1) - low_x + 1).clamp(min=0)
        n_y = (high_y.clamp(max=self.y0 + self.height - 1) - low_y + 1).clamp(min=0)
        return low_x.long(), low_y.long(), n_x.long(), n_y.long()


def count_pairs(prisms: Prisms, block: Block, candidates: Tensor) -> Tensor:
    """Return (C,) the number of pixels of `block` inside the bounds of each of the `candidates` (C,)."""
    _, _, n_x, n_y = block.columns_rows(prisms.bounds_px[:, candidates])
    return n_x * n_y


def find_pairs(prisms: Prisms, block: Block, candidates: Tensor) -> tuple[Tensor, Tensor]:
    """Return the prism (n,) and the pixel of the block (n,) of each pair, prism by prism, row by row.

    Args:
        prisms: of the scene.
        block: pixels and ray.
        candidates: (C,) int64 prisms whose bounds may touch the block.

    Accuracy: conservative: no ray that a prism covers is left out.
    Source: ours.
    """
    low_x, low_y, n_x, n_y = block.columns_rows(prisms.bounds_px[:, candidates])
    row, of = packed.expand(low_y, n_y * (n_x > 0))
    first, last = _hull_columns(prisms.corners_px[..., candidates[of]], row, block)
    first = torch.maximum(first, low_x[of])
    last = torch.minimum(last, (low_x + n_x - 1)[of])
    column, of_row = packed.expand(first, (last - first + 1).clamp(min=0))
    pixel = (row[of_row] - block.y0) * block.width + (column - block.x0)
    return candidates[of[of_row]], pixel


def _hull_columns(corners_px: Tensor, row: Tensor, block: Block) -> tuple[Tensor, Tensor]:
    """Return the first and last column (R,) int64 of the rays of each `row` (R,) inside the hull of (2, 6, R) corners.

    Where the ray's row misses the hull by rounding, or there is no hull, all columns.
    """
    x, y = corners_px
    level = row.to(torch.float64) + block.ray.y_px
    low = torch.full_like(level, torch.inf)
    high = torch.full_like(level, -torch.inf)
    for i, j in itertools.combinations(range(6), 2):
        crosses = (y[i] <= level) != (y[j] <= level)
        share = (level - y[i]) / torch.where(crosses, y[j] - y[i], 1.0)
        place = x[i] + share * (x[j] - x[i])
        low = torch.where(crosses, torch.minimum(low, place), low)
        high = torch.where(crosses, torch.maximum(high, place), high)
    slack = BOUND_SLACK_PX + ROUNDING * torch.maximum(x.abs().amax(0), y.abs().amax(0))
    first = torch.ceil(low - slack - block.ray.x_px)
    last = torch.floor(high + slack - block.ray.x_px)
    none = ~(low <= high) | ~(slack < 1)  # NaN corners too
    first = torch.where(none, float(block.x0), first.clamp(block.x0, block.x0 + block.width))
    last = torch.where(none, float(block.x0 + block.width - 1), last.clamp(block.x0 - 1, block.x0 + block.width - 1))
    return first.long(), last.long()
