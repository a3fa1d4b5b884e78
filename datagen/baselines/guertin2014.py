"""Guertin, McGuire, Nowrouzezahrai 2014: gather along two directions, the dominant one and the pixel's own.

Before: gather.py.  After: filters.py.
What it cannot do: motion is a straight line of at most `tile_px` to either side; a turning disc is cut into wedges,
a tile each (the pinwheel); the background behind a moving object is guessed from beside it; what is hidden, transparent
or beyond the border is not known.
Symbols: as in gather.py; N taps; p the pixel; v_max the dominant motion, w_n its direction; w_c the pixel's own
direction, or across v_max where the pixel is slow; u how much the tiles around disagree with v_max.
Source: Guertin et al. 2014, with these readings where the text is silent or cannot be meant: steps and products take
unit directions; products enter by their size, so that no weight is negative; slow pixels, not fast ones, get the
direction across; the depth test is that of 2012 with the smaller depth for its extent, and taps are rounded to the
nearest pixel, as there, lest the image move by half of one; u, which spreads the taps, measures the tiles around
against v_max, and where u is 1/2 every second tap goes along w_c; the border between tiles is blurred by displacing
the look-up by up to a quarter of a tile.
"""

from __future__ import annotations

import torch
from torch import Tensor

from datagen.baselines import gather
from datagen.baselines.mcguire2012 import MAX_SAMPLES, MAX_TILE_PX
from datagen.baselines.views import STILL_PX, View
from torchblur import check

CENTRE_SHARE = 40.0  # kappa: the larger, the less the pixel itself counts
JITTER_SHARE = 0.95  # eta
JITTER_TAPS = 27.0  # phi: with eta, the reach of the jitter in taps
SLOW_PX = 1.5  # gamma: from half a pixel over this length w_c turns into the pixel's own direction
TILE_JITTER = 0.5  # of a tile: the width of the displacement of the look-up


def guertin2014(view: View, *, samples: int = 35, tile_px: int = 40, seed: int | None = 0) -> Tensor:
    """Return the blurred images (B, C, H, W).

    Args:
        view: sharp images, motion and depth.
        samples: taps N.
        tile_px: side of a tile and the longest blur to either side.
        seed: of the jitter of taps and tiles, three numbers a pixel; None for no jitter.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Gradient: to colour, depth, and the motions' part in the weights; none to which pixels the taps fall on.
    Source: Guertin et al. 2014, as read above. Motions of 1 px and less, over the exposure, blur nothing.
    """
    if not isinstance(view, View):
        raise check.fail_type("view", "a View", view)
    check.positive_int("samples", samples, MAX_SAMPLES)
    check.positive_int("tile_px", tile_px, MAX_TILE_PX)
    gather.check_seed(seed)
    color, depth = view.color, view.depth_view[:, 0]
    half, speed = gather.limit_half_motion(view.motion_px, tile_px)
    noise = None if seed is None else gather.pixel_noise(color, 3, seed)
    dominant, spread = _dominant(half, tile_px, noise)
    v_max = torch.linalg.vector_norm(dominant, dim=1)
    main, own = _directions(half, speed, dominant)
    column, row = gather.pixel_grid(color)
    known = torch.cat([color, speed.unsqueeze(1), depth.unsqueeze(1), _unit(half)], dim=1)
    weight = samples / (CENTRE_SHARE * speed)
    total = weight.unsqueeze(1) * color
    jitter = 0.0 if noise is None else (2 * noise[0] - 1) * (JITTER_SHARE * JITTER_TAPS / samples)
    for i in range(samples):
        t = -1 + 2 * (i + jitter + 1) / (samples + 1)
        goes_own = torch.floor((i + 1) * spread) > torch.floor(i * spread)
        direction = torch.where(goes_own.unsqueeze(1), own, main)
        step = (t * v_max).unsqueeze(1) * direction
        x, y = (torch.floor(c + d.detach() + 0.5).long() for c, d in zip((column, row), step.unbind(1), strict=True))
        there = gather.fetch(known, x, y)
        travelled = abs(t) * v_max
        speed_y, depth_y = there[:, -4], there[:, -3]
        along_x, along_y = _dot(own, direction).abs(), _dot(there[:, -2:], direction).abs()
        tap = gather.not_behind(depth, depth_y, None) * gather.cone(travelled, speed_y) * along_y
        tap = tap + gather.not_behind(depth_y, depth, None) * gather.cone(travelled, speed) * along_x
        both = gather.cylinder(travelled, torch.minimum(speed, speed_y))
        tap = tap + 2 * both * torch.maximum(along_x, along_y)
        weight = weight + tap
        total = total + tap.unsqueeze(1) * there[:, :-4]
    return torch.where((v_max <= STILL_PX + gather.EPSILON_PX).unsqueeze(1), color, total / weight.unsqueeze(1))


def _dominant(half: Tensor, tile_px: int, noise: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return v_max (B, 2, H, W) and u (B, H, W) of each pixel.

    A neighbouring tile counts only if its motion may reach this one: along an axis with a component along it, on a
    diagonal in the pair of quadrants of that diagonal.
    """
    around, is_there = gather.neighbours(gather.tile_max(half, tile_px))
    reaches = []
    for (s, t), (x, y) in zip(gather.OFFSETS, (c.unbind(1) for c in around.detach()), strict=True):
        reaches.append((torch.sign(s * x) + torch.sign(t * y)).abs() == abs(s) + abs(t))
    v_max = gather.longest(around, torch.stack(reaches))
    agreement = (_unit(around.flatten(0, 1)).reshape(around.shape) * _unit(v_max)).sum(2).abs().sum(0)
    spread = 1 - agreement / is_there.sum(0)
    column, row = gather.pixel_grid(half)
    shift_x, shift_y = (0.0, 0.0) if noise is None else TILE_JITTER * (noise[1:] - 0.5)
    tile = (torch.floor((c + 0.5) / tile_px + d).long() for c, d in ((column, shift_x), (row, shift_y)))
    found = gather.fetch(torch.cat([v_max, spread.unsqueeze(1)], dim=1), *tile)
    return found[:, :2], found[:, 2]


def _directions(half: Tensor, speed: Tensor, dominant: Tensor) -> tuple[Tensor, Tensor]:
    """Return w_n and w_c (B, 2, H, W), both of length 1; w_n is 0 where nothing around moves."""
    main = _unit(dominant)
    across = torch.stack([-main[:, 1], main[:, 0]], dim=1)
    across = torch.where((_dot(across, half) < 0).unsqueeze(1), -across, across)
    share = ((speed - STILL_PX) / SLOW_PX).clamp(0, 1).unsqueeze(1)
    mixed = across * (1 - share) + _unit(half) * share
    return main, mixed / torch.linalg.vector_norm(mixed, dim=1, keepdim=True).clamp(min=gather.EPSILON_PX)


def _unit(vector: Tensor) -> Tensor:
    """Return 2-vectors (B, 2, ...) over their length; what is shorter than half a pixel stays shorter than 1."""
    return vector / torch.linalg.vector_norm(vector, dim=1, keepdim=True).clamp(min=STILL_PX)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Return the products (B, H, W) of 2-vectors (B, 2, H, W)."""
    return (a * b).sum(1)
