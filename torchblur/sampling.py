"""Sampling over time, as the references that need no intervals.

Before: instant.py, time_samples.py.  After: the user.
Source: accumulation buffer, Haeberli & Akeley 1990; stochastic rasterisation, Akenine-Moller et al. 2007.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchblur import check
from torchblur.backends import choose_backend
from torchblur.camera import MAX_RAYS, pixel_rays
from torchblur.instant import instants_by
from torchblur.scene import Scene
from torchblur.shutter import Shutter
from torchblur.surfaces import build_surfaces
from torchblur.time_samples import HALTON_BITS, rotated_halton, stratified, sum_of_samples

MAX_TIMES = 1 << HALTON_BITS
MAX_OWNERS = 2_000_000  # pixels of instants handled together
MAX_TRIANGLES = 200_000  # faces of instants handled together
AT_ONCE_COMPILED = 4  # times as many of both where the search is compiled
SEQUENCES = ("midpoint", "halton")
PLACES = ("area", "centre")


@dataclass(frozen=True)
class Accumulated:
    """The mean of sharp images, or of samples."""

    rgba: Tensor  # (H, W, 4) linear, as in a Frame
    times: int  # how many, a pixel and ray


def accumulate(  # noqa: PLR0913  what random draws, and how they are looked at
    scene: Scene,
    times: int = 4096,
    *,
    shutter: Shutter | None = None,
    rays_per_pixel: int = 1,
    sequence: str = "midpoint",
    seed: int = 0,
    backend: str = "auto",
) -> Accumulated:
    """Return the mean of `times` looks at the scene while the shutter is open.

    Args:
        scene: what to render.
        times: number of instants N.
        shutter: weighs the parts; `Shutter.box()`, the whole exposure, if None.
        rays_per_pixel: as in `render`.
        sequence: "midpoint": sharp images at the midpoints of equal parts of the exposure; "halton": the first N of
            the sequence in base 2, moved round the exposure by a random amount for each pixel and ray.
        seed: of these amounts.
        backend: "torch", "cpu" (compiled), or "auto"; see `backends.choose_backend`. The results are the same.

    Returns:
        `rgba` (H, W, 4), on the scene's device and in its floating type.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Accuracy: each event (edge or crossing passing the ray) of contrast c is wrong by up to c / (2 N) with midpoints,
        c / (N sqrt(12)) in the mean square; the same times serve all pixels, so the error shows as bands. With
        "halton" it shows as noise, of c / (N sqrt(6)) if N is a power of two.
    Source: Haeberli & Akeley 1990, with midpoints; rotation: Cranley & Patterson 1976.
    """
    if not isinstance(scene, Scene):
        raise check.fail_type("scene", "a Scene", scene)
    check.positive_int("times", times, MAX_TIMES)
    shutter = _shutter(shutter)
    check.positive_int("rays_per_pixel", rays_per_pixel, MAX_RAYS)
    if sequence not in SEQUENCES:
        raise check.fail("sequence", f"one of {', '.join(SEQUENCES)}", sequence)
    generator, backend = _generator(seed), choose_backend(scene, backend)
    surfaces = build_surfaces(scene)
    if sequence == "halton":
        total, sum_them = 0, _samples_by(backend)
        for ray in pixel_rays(rays_per_pixel):
            draw = rotated_halton(times, ray, generator)
            total = total + sum_them(scene, surfaces, shutter, times, draw)
        return Accumulated(scene.over_background(total / rays_per_pixel).to(scene.dtype), times)
    camera = scene.camera
    n_lines = shutter.n_lines(camera.width, camera.height)
    start, end = shutter.span(n_lines)
    ends = start + (end - start) * torch.arange(times + 1, dtype=torch.float64, device=scene.device) / times
    pixel = torch.arange(camera.width * camera.height, device=scene.device)
    line = shutter.line_of(pixel % camera.width, pixel // camera.width, (camera.width, camera.height))
    line = line if shutter.line_delay else line[:1]  # one weight serves all
    n_faces = max(1, len(surfaces.opacity))
    at_once = AT_ONCE_COMPILED if backend == "cpu" else 1  # it keeps nothing by pixel or by pair
    batch = max(1, at_once * min(MAX_OWNERS // len(pixel), MAX_TRIANGLES // n_faces))
    total, (sum_them, _) = 0, instants_by(backend, surfaces)
    for part in torch.arange(times, device=scene.device).split(batch):
        early, late = ends[part].unsqueeze(1), ends[part + 1].unsqueeze(1)
        weight = shutter.weight(early, late, line) / rays_per_pixel
        for ray in pixel_rays(rays_per_pixel):
            total = total + sum_them(scene, surfaces, 0.5 * (early + late).flatten(), weight, ray)
    return Accumulated(scene.over_background(total).to(scene.dtype), times)


def stochastic(
    scene: Scene,
    samples: int = 64,
    *,
    shutter: Shutter | None = None,
    places: str = "area",
    seed: int = 0,
    backend: str = "auto",
) -> Accumulated:
    """Return the mean of `samples` random looks per pixel, each at a time and a place of its own.

    Args:
        scene: what to render.
        samples: N a pixel: one in each of N parts of the exposure of equal weight and, unless all are in the centre,
            one in each of N equal rectangles of the pixel, times and places paired at random. Best where N has two
            factors of like size.
        shutter: whose weight the times follow; `Shutter.box()`, the whole exposure, if None.
        places: of the rays: "area", over the pixel; "centre", as `render` with one ray.
        seed: of all that is random.
        backend: as in `accumulate`.

    Returns:
        `rgba` (H, W, 4), on the scene's device and in its floating type. Its mean over seeds is the image that
        `render` gives, with one ray at the centre or with infinitely many.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Accuracy: of an event of contrast c, at the centre, wrong by c / (N sqrt(6)) in the mean square. The error shows as
        noise.
    Cost: all faces once, and N times the pixels of the boxes around what they sweep over in 1 / N of the exposure.
    Gradient: to colour, opacity, textures and lights.
    Source: Akenine-Moller et al. 2007, McGuire et al. 2010 (time-continuous triangles); order by strata of time: ours.
    """
    if not isinstance(scene, Scene):
        raise check.fail_type("scene", "a Scene", scene)
    check.positive_int("samples", samples, MAX_TIMES)
    shutter = _shutter(shutter)
    if places not in PLACES:
        raise check.fail("places", f"one of {', '.join(PLACES)}", places)
    sum_them = _samples_by(choose_backend(scene, backend))
    draw = stratified(samples, places == "area", _generator(seed))
    total = sum_them(scene, build_surfaces(scene), shutter, samples, draw)
    return Accumulated(scene.over_background(total).to(scene.dtype), samples)


def _samples_by(backend: str) -> Callable[..., Tensor]:
    """Return what does the work of `sum_of_samples` in "torch" or "cpu"."""
    if backend == "torch":
        return sum_of_samples
    from torchblur.cpu.samples import sum_of_samples as compiled  # slow to import

    return compiled


def _shutter(shutter: Any) -> Shutter:
    """Return the shutter, or the whole exposure for None."""
    if shutter is None:
        return Shutter.box()
    if not isinstance(shutter, Shutter):
        raise check.fail_type("shutter", "a Shutter", shutter)
    return shutter


def _generator(seed: Any) -> torch.Generator:
    """Return a generator on the CPU, so that a seed means the same on every device."""
    if isinstance(seed, bool) or not isinstance(seed, int):
        raise check.fail_type("seed", "an integer", seed)
    if not 0 <= seed < 1 << 63:
        raise check.fail("seed", "a number in [0, 2**63)", seed)
    return torch.Generator().manual_seed(seed)
