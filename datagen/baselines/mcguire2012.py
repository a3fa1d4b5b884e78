"""McGuire et al. 2012: gather along the dominant motion of the tiles around, with soft depth.

Before: gather.py.  After: filters.py.
What it cannot do: one direction a tile, so that crossing motions smear each other or stay too sharp; motion is a
straight line of at most `tile_px` to either side; the background behind a moving object is guessed from beside it; what
is hidden, transparent or beyond the border is not known: glass moves with the first surface seen through the pixel, and
the border's pixels go on outside. In a field of one motion the weights of the taps are no box but fall from 4 in the
middle to about 2 at the ends.
Symbols: as in gather.py; v_n the dominant motion; S taps; j jitter.
Source: McGuire, Hennessy, Bukowski, Osman 2012, the function `reconstruct`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from datagen.baselines import gather
from datagen.baselines.views import STILL_PX, View
from torchblur import check

MAX_SAMPLES = 1 << 12
MAX_TILE_PX = 1 << 12


def mcguire2012(
    view: View, *, samples: int = 15, tile_px: int = 20, soft_depth: float = 0.1, seed: int | None = 0
) -> Tensor:
    """Return the blurred images (B, C, H, W).

    Args:
        view: sharp images, motion and depth.
        samples: taps S, odd.
        tile_px: side of a tile and the longest blur to either side.
        soft_depth: difference of depth [scene units] over which near and far shade into each other, above 0.
        seed: of the jitter of the taps, one number a pixel; None for no jitter.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Gradient: to colour, depth, and the lengths of motions; none to which pixels the taps fall on.
    Source: McGuire et al. 2012. Motions of 1 px and less, over the exposure, blur nothing.
    """
    if not isinstance(view, View):
        raise check.fail_type("view", "a View", view)
    if check.positive_int("samples", samples, MAX_SAMPLES) % 2 == 0:
        raise check.fail("samples", "an odd number", samples)
    check.positive_int("tile_px", tile_px, MAX_TILE_PX)
    if check.number("soft_depth", soft_depth, 0.0) == 0:
        raise check.fail("soft_depth", "a number above 0", soft_depth)
    gather.check_seed(seed)
    color, depth = view.color, view.depth_view[:, 0]
    half, speed = gather.limit_half_motion(view.motion_px, tile_px)
    around, _ = gather.neighbours(gather.tile_max(half, tile_px))
    column, row = gather.pixel_grid(color)
    dominant = gather.fetch(gather.longest(around), column // tile_px, row // tile_px)
    jitter = 0.0 if seed is None else gather.pixel_noise(color, 1, seed)[0] - 0.5
    known = torch.cat([color, speed.unsqueeze(1), depth.unsqueeze(1)], dim=1)
    weight = 1 / speed
    total = weight.unsqueeze(1) * color
    for i in range(samples):
        if i == (samples - 1) // 2:
            continue  # the centre is there already
        t = -1 + 2 * (i + jitter + 1) / (samples + 1)
        x, y = (
            torch.floor(c + t * v.detach() + 0.5).long() for c, v in zip((column, row), dominant.unbind(1), strict=True)
        )
        there = gather.fetch(known, x, y)
        distance = torch.hypot((x - column).to(color.dtype), (y - row).to(color.dtype))
        tap = _weight((speed, depth), (there[:, -2], there[:, -1]), distance, soft_depth)
        weight = weight + tap
        total = total + tap.unsqueeze(1) * there[:, :-2]
    is_still = torch.linalg.vector_norm(dominant, dim=1) <= STILL_PX + gather.EPSILON_PX
    return torch.where(is_still.unsqueeze(1), color, total / weight.unsqueeze(1))


def _weight(here: tuple[Tensor, Tensor], there: tuple[Tensor, Tensor], distance: Tensor, soft_depth: float) -> Tensor:
    """Return how much a tap counts, from speed and depth (B, H, W) of X and of Y."""
    (speed_x, depth_x), (speed_y, depth_y) = here, there
    in_front = gather.not_behind(depth_x, depth_y, soft_depth)
    behind = gather.not_behind(depth_y, depth_x, soft_depth)
    both = 2 * gather.cylinder(distance, speed_y) * gather.cylinder(distance, speed_x)
    return in_front * gather.cone(distance, speed_y) + behind * gather.cone(distance, speed_x) + both
