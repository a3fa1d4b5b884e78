"""Directional blur: the plainest filters, a kernel per image or a line of taps per pixel (a door to kornia).

Before: views.py.  After: filters.py.
What they cannot do: they know no depth. Each pixel is averaged along its own motion, so moving objects keep their sharp
outline and pull the background into themselves; one kernel an image is right only where all moves alike. Beyond the
border the border's pixels go on.
Source: kornia's motion kernel; the average along a motion field is as old as the velocity buffer.
"""

from __future__ import annotations

from typing import Any

import torch
from kornia.filters import motion_blur
from kornia.geometry.transform import remap
from torch import Tensor

from datagen.baselines.views import STILL_PX, View, checked_images
from torchblur import check

MAX_LENGTH_PX = 4095
MAX_TAPS = 1 << 12


def directional_image(color: Any, motion_px: Any) -> Tensor:
    """Return images (B, C, H, W), each blurred along one line.

    Args:
        color: (B, C, H, W) float32 or float64, linear.
        motion_px: (B, 2) displacement over the exposure [px, x right, y down] of each image as a whole.

    Raises:
        TypeError, ValueError: a wrong argument, named; a motion of more than MAX_LENGTH_PX.

    Accuracy: the line is as long as the odd number of pixels nearest to the motion, and is spread over the pixels
        beside it.
    Gradient: to colour.
    Source: kornia's `motion_blur`, of equal weight along the line.
    """
    image = checked_images(color)
    motion = check.floats("motion_px", motion_px, (len(image), 2)).detach()
    check.same_device(color=image, motion_px=motion)
    length = torch.linalg.vector_norm(motion, dim=1)
    if (length > MAX_LENGTH_PX).any():
        raise check.fail("motion_px", f"motions of at most {MAX_LENGTH_PX} px", f"{float(length.max()):g}")
    size = (2 * torch.floor(length / 2) + 1).long()
    angle_deg = torch.rad2deg(torch.atan2(-motion[:, 1], motion[:, 0])).to(image.dtype)
    blurred = image
    for k in torch.unique(size).tolist():
        if k > 1:
            which = (size == k).nonzero().flatten()
            part = motion_blur(
                input=image[which],
                kernel_size=k,
                angle=angle_deg[which],
                direction=torch.zeros_like(angle_deg[which]),
                border_type="replicate",
                mode="bilinear",
            )
            blurred = blurred.index_put((which,), part)
    return blurred


def directional(color: Any, motion_px: Any, *, samples: int = 32) -> Tensor:
    """Return images (B, C, H, W), each pixel the mean along its own motion, half of it to either side.

    Args:
        color: (B, C, H, W) float32 or float64, linear.
        motion_px: (B, 2, H, W) displacement over the exposure [px, x right, y down].
        samples: taps at the middles of equal parts of the motion, bilinear between pixels.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Gradient: to colour and motion.
    Source: ours. Motions of 1 px and less blur nothing.
    """
    image = checked_images(color)
    motion = View(image, motion_px, torch.ones_like(image[:, :1])).motion_px
    check.positive_int("samples", samples, MAX_TAPS)
    h, w = image.shape[-2:]
    row = torch.arange(h, dtype=image.dtype, device=image.device).unsqueeze(1)
    column = torch.arange(w, dtype=image.dtype, device=image.device)
    total = torch.zeros_like(image)
    for k in range(samples):
        t = (k + 0.5) / samples - 0.5
        total = total + remap(
            image=image,
            map_x=column + t * motion[:, 0],
            map_y=row + t * motion[:, 1],
            mode="bilinear",
            padding_mode="border",
            align_corners=True,
        )
    is_still = torch.linalg.vector_norm(motion.detach(), dim=1, keepdim=True) <= 2 * STILL_PX
    return torch.where(is_still, image, total / samples)
