"""Gather: what the filters that collect along a dominant motion share: tiles, taps, and how much a tap counts.

Before: views.py.  After: mcguire2012.py, guertin2014.py.
Symbols: q half of the motion over the exposure [px]; V the same with its length limited to [0.5, k]; k side of a
tile [px]; h, w tiles down and across; X the pixel that is blurred, Y the pixel that a tap falls on. Depths are positive
here, where the papers have negative z: a smaller one is nearer.
Source: McGuire et al. 2012, sec. 2; Guertin et al. 2014.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from datagen.baselines.views import STILL_PX
from torchblur import check

EPSILON_PX = 1e-5  # keeps directions of length 0 from dividing by 0
OFFSETS = tuple((s, t) for t in (-1, 0, 1) for s in (-1, 0, 1))  # of the 3 x 3 tiles, across and down


def limit_half_motion(motion_px: Tensor, longest_px: float) -> tuple[Tensor, Tensor]:
    """Return V (B, 2, H, W) and its length (B, H, W), 0.5 also where nothing moves (V itself is 0 there).

    Source: McGuire et al. 2012, sec. 2.2.
    """
    half = 0.5 * motion_px
    length = torch.linalg.vector_norm(half, dim=1)
    limited = length.clamp(STILL_PX, longest_px)
    return half * (limited / (length + EPSILON_PX)).unsqueeze(1), limited


def tile_max(vector: Tensor, tile_px: int) -> Tensor:
    """Return (B, 2, h, w) the longest of `vector` (B, 2, H, W) in each tile; of equal ones the first, row by row.

    Source: McGuire et al. 2012, sec. 2.3.
    """
    b, _, height, width = vector.shape
    rows, columns = -(-height // tile_px), -(-width // tile_px)
    padded = vector.new_zeros(b, 2, rows * tile_px, columns * tile_px)
    padded[..., :height, :width] = vector
    tiles = padded.reshape(b, 2, rows, tile_px, columns, tile_px).transpose(3, 4).flatten(4)
    best = _length(tiles.detach()).argmax(-1, keepdim=True)
    return tiles.gather(-1, best.unsqueeze(1).expand(-1, 2, -1, -1, -1)).squeeze(-1)


def neighbours(tiles: Tensor) -> tuple[Tensor, Tensor]:
    """Return (9, B, 2, h, w) the 3 x 3 tiles about each of `tiles`, in the order of OFFSETS, and whether (9, h, w)
    there are any: beyond the border all is 0.
    """
    rows, columns = tiles.shape[2:]
    row, column = torch.arange(rows, device=tiles.device), torch.arange(columns, device=tiles.device)
    found, is_there = [], []
    for s, t in OFFSETS:
        y, x = row + t, column + s
        inside = ((y >= 0) & (y < rows)).unsqueeze(1) & ((x >= 0) & (x < columns))
        near = tiles[:, :, y.clamp(0, rows - 1)][:, :, :, x.clamp(0, columns - 1)]
        found.append(torch.where(inside, near, 0.0))
        is_there.append(inside)
    return torch.stack(found), torch.stack(is_there)


def longest(candidates: Tensor, is_allowed: Tensor | None = None) -> Tensor:
    """Return (B, 2, h, w) the longest of `candidates` (9, B, 2, h, w) that are allowed (9, B, h, w)."""
    length = _length(candidates.detach(), dim=2)
    if is_allowed is not None:
        length = torch.where(is_allowed, length, -1.0)
    best = length.argmax(0)[None, :, None].expand(1, -1, 2, -1, -1)
    return candidates.gather(0, best).squeeze(0)


def fetch(image: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return (B, C, H, W) the pixels of `image` (B, C, h, w) at columns and rows (B, H, W) int64 or (H, W).

    Beyond the border the border's pixels go on.
    """
    b, c, h, w = image.shape
    index = (y.clamp(0, h - 1) * w + x.clamp(0, w - 1)).expand(b, *x.shape[-2:]).flatten(1)
    taken = image.flatten(2).gather(2, index.unsqueeze(1).expand(-1, c, -1))
    return taken.reshape(b, c, *x.shape[-2:])


def pixel_grid(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return (H, W) int64 columns and rows of the pixels of `image` (..., H, W)."""
    h, w = image.shape[-2:]
    row, column = torch.meshgrid(
        torch.arange(h, device=image.device), torch.arange(w, device=image.device), indexing="ij"
    )
    return column, row


def check_seed(seed: Any) -> None:
    """Raise unless `seed` is a whole number that a generator takes, or None."""
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int)):
        raise check.fail_type("seed", "an integer or None", seed)
    if seed is not None and not 0 <= seed < 2**63:
        raise check.fail("seed", "a number in [0, 2**63)", seed)


def pixel_noise(image: Tensor, count: int, seed: int) -> Tensor:
    """Return (count, H, W) numbers in [0, 1), the same for every image of a batch and on every device. Source: ours."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.rand(count, *image.shape[-2:], generator=generator, dtype=torch.float64)
    return noise.to(image.dtype).to(image.device)


def cone(distance_px: Tensor, radius_px: Tensor) -> Tensor:
    """Return how much a point that smears over `radius_px` covers what is `distance_px` away, falling linearly."""
    return (1 - distance_px / radius_px).clamp(0, 1)


def cylinder(distance_px: Tensor, radius_px: Tensor) -> Tensor:
    """Return the same with equal cover inside, falling smoothly from .95 to 1.05 of the radius."""
    share = ((distance_px - 0.95 * radius_px) / (0.1 * radius_px)).clamp(0, 1)
    return 1 - share * share * (3 - 2 * share)


def not_behind(here: Tensor, there: Tensor, extent: float | None) -> Tensor:
    """Return 1 where depth `there` is no larger than `here`, falling to 0 where it is larger by `extent`.

    Args:
        here, there: depths (B, H, W), inf where nothing is.
        extent: [scene units]; None for the smaller of the two depths.

    Source: McGuire et al. 2012 (softDepthCompare); Guertin et al. 2014 (zCompare).
    """
    both = torch.isfinite(here) & torch.isfinite(there)
    a, b = torch.where(both, here, 1.0), torch.where(both, there, 1.0)
    soft = (1 - (b - a) / (torch.minimum(a, b) if extent is None else extent)).clamp(0, 1)
    return torch.where(both, soft, torch.isinf(here).to(soft.dtype))


def _length(vector: Tensor, dim: int = 1) -> Tensor:
    """Return the lengths of 2-vectors."""
    return torch.linalg.vector_norm(vector, dim=dim)
