"""Colour spaces: linear light to and from the sRGB curve, and to a power curve (a door to kornia).

Before: nothing.  After: patterns.py, assets.py (sRGB in), writer.py and report.py (sRGB out),
export.py (power out), sensor.py (mosaics).
"""

from __future__ import annotations

import torch
from kornia.color import CFA, linear_rgb_to_rgb, raw_to_rgb, rgb_to_linear_rgb, rgb_to_raw
from torch import Tensor

# Colours of a mosaic's first row and of its second; kornia names them by OpenCV's custom, from pixel (1, 1).
MOSAICS = {"RGGB": CFA.BG, "GRBG": CFA.GB, "BGGR": CFA.RG, "GBRG": CFA.GR}


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


def mosaic(rgb: Tensor, pattern: str) -> Tensor:
    """Return (H, W), at each pixel of (H, W, 3) the colour that a filter of `pattern`, one of MOSAICS, lets through.

    H and W are even. Source: Bayer's filter, as in kornia.
    """
    return rgb_to_raw(image=rgb.permute(2, 0, 1), cfa=MOSAICS[pattern])[0]


def demosaic(raw: Tensor, pattern: str) -> Tensor:
    """Return (H, W, 3) colours of an (H, W) mosaic of `pattern`, one of MOSAICS; H and W are even.

    Source: bilinear interpolation, as in kornia.
    """
    return raw_to_rgb(image=raw[None, None], cfa=MOSAICS[pattern])[0].permute(1, 2, 0)
