"""Sampling over time, as the reference that needs no intervals.

Before: instant.py.  After: the user.
Source: accumulation buffer, Haeberli & Akeley 1990.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import check
from torchblur.camera import pixel_rays
from torchblur.instant import MAX_RAYS, mean_of_instants
from torchblur.scene import Scene
from torchblur.shutter import Shutter
from torchblur.surfaces import build_surfaces

MAX_TIMES = 1 << 24
MAX_OWNERS = 2_000_000  # pixels of instants handled together
MAX_TRIANGLES = 200_000  # faces of instants handled together


@dataclass(frozen=True)
class Accumulated:
    """The mean of sharp images."""

    rgba: Tensor  # (H, W, 4) linear, as in a Frame
    times: int  # how many


def accumulate(
    scene: Scene, times: int = 4096, *, shutter: Shutter | None = None, rays_per_pixel: int = 1
) -> Accumulated:
    """Return the mean of `times` sharp images at the midpoints of equal parts of the shutter's window.

    Args:
        scene: what to render.
        times: number of instants N.
        shutter: whole exposure if None.
        rays_per_pixel: as in `render`.

    Returns:
        `rgba` (H, W, 4), on the scene's device and in its floating type.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Accuracy: each event (edge or crossing passing the ray) of contrast c is wrong by up to c / (2 N); the same times
        serve all pixels, so the error shows as bands.
    Source: Haeberli & Akeley 1990, with midpoints.
    """
    if not isinstance(scene, Scene):
        raise check.fail_type("scene", "a Scene", scene)
    check.positive_int("times", times, MAX_TIMES)
    shutter = Shutter.box() if shutter is None else shutter
    if not isinstance(shutter, Shutter):
        raise check.fail_type("shutter", "a Shutter", shutter)
    check.positive_int("rays_per_pixel", rays_per_pixel, MAX_RAYS)
    surfaces = build_surfaces(scene)
    middle = (torch.arange(times, dtype=torch.float64, device=scene.device) + 0.5) / times
    t = shutter.t_open + (shutter.t_close - shutter.t_open) * middle
    n_pixels, n_faces = scene.camera.width * scene.camera.height, max(1, len(surfaces.opacity))
    batch = max(1, min(MAX_OWNERS // n_pixels, MAX_TRIANGLES // n_faces))
    total = sum(
        mean_of_instants(scene, surfaces, part, ray) * len(part)
        for ray in pixel_rays(rays_per_pixel)
        for part in torch.split(t, batch)
    )
    return Accumulated((total / (times * rays_per_pixel)).to(scene.dtype), times)
