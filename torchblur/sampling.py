"""Sampling over time, as the reference that needs no intervals.

Before: instant.py.  After: the user.
Source: accumulation buffer, Haeberli & Akeley 1990.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import check
from torchblur.camera import MAX_RAYS, pixel_rays
from torchblur.instant import sum_of_instants
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
    """Return the mean of `times` sharp images at the midpoints of equal parts of the time the shutter is open.

    Args:
        scene: what to render.
        times: number of instants N.
        shutter: weighs the parts; `Shutter.box()`, the whole exposure, if None.
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
    camera = scene.camera
    n_lines = shutter.n_lines(camera.width, camera.height)
    start, end = shutter.span(n_lines)
    surfaces = build_surfaces(scene)
    ends = start + (end - start) * torch.arange(times + 1, dtype=torch.float64, device=scene.device) / times
    pixel = torch.arange(camera.width * camera.height, device=scene.device)
    line = shutter.line_of(pixel % camera.width, pixel // camera.width, (camera.width, camera.height))
    line = line if shutter.line_delay else line[:1]  # one weight serves all
    n_faces = max(1, len(surfaces.opacity))
    batch = max(1, min(MAX_OWNERS // len(pixel), MAX_TRIANGLES // n_faces))
    total = 0
    for part in torch.arange(times, device=scene.device).split(batch):
        early, late = ends[part].unsqueeze(1), ends[part + 1].unsqueeze(1)
        weight = shutter.weight(early, late, line) / rays_per_pixel
        for ray in pixel_rays(rays_per_pixel):
            total = total + sum_of_instants(scene, surfaces, 0.5 * (early + late).flatten(), weight, ray)
    return Accumulated(scene.over_background(total).to(scene.dtype), times)
