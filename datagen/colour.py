"""Colour spaces: linear light to and from the sRGB curve, and to a power curve (the only door to kornia).

Before: nothing.  After: patterns.py, assets.py (sRGB in), writer.py and report.py (sRGB out),
export.py (power out).
"""

from __future__ import annotations

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor


def srgb_from_linear(rgb: Tensor) -> Tensor:
    """Return (H, W, 3) sRGB values of linear (H, W, 3) colours, in [0, 1]: light outside is clipped, as a display does.

    Source: IEC 61966-2-1, as in kornia.
    """
    planes = rgb.permute(2, 0, 1).clamp(0, 1)
    return linear_rgb_to_rgb(image=planes).permute(1, 2, 0)


def linear_from_srgb(rgb: Tensor) -> Tensor:
    """Return (N, 3) linear colours of (N, 3) sRGB values in [0, 1]. Source: IEC 61966-2-1, as in kornia."""
    return rgb_to_linear_rgb(image=rgb.T.reshape(3, -1, 1)).reshape(3, -1).T.contiguous()


def bytes_from_linear(rgb: Tensor) -> Tensor:
    """Return (H, W, 3) uint8 sRGB of linear (H, W, 3) colours, rounded to nearest. Source: ours."""
    return (srgb_from_linear(rgb.to(torch.float64)) * 255).round().to(torch.uint8)


def gamma_bytes_from_linear(rgb: Tensor) -> Tensor:
    """Return (H, W, 3) uint8 of linear (H, W, 3) colours clipped to [0, 1], to the power 1/2.2, rounded to nearest.

    Source: the camera response of GoPro's `blur_gamma`, Nah et al. 2017.
    """
    coded = rgb.to(torch.float64).clamp(0, 1) ** (1 / 2.2)
    return (coded * 255).round().to(torch.uint8)
