"""Render the exact mean of a scene over its exposure.

Before: prisms.py, effects.py, exposure.py.  After: the user.
Source: Ronnow et al. 2021 (pipeline).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import check
from torchblur.accuracy import Accuracy
from torchblur.backends import choose_backend
from torchblur.camera import MAX_RAYS, pixel_rays
from torchblur.effects import EffectPlan, agree_plan, check_effects, follow_plan, plan_prisms
from torchblur.exposure import N_LOOKS, Exposure, Work
from torchblur.ledger import TIMED_EFFECTS, Ledger
from torchblur.prisms import build_prisms
from torchblur.scene import Scene
from torchblur.shutter import Shutter
from torchblur.stopwatch import watching
from torchblur.surfaces import build_surfaces
from torchblur.survey import survey_prisms

MIN_MEMORY_BYTES = 1 << 20


@dataclass(frozen=True)
class Frame:
    """An image integrated over the exposure."""

    rgba: Tensor  # (H, W, 4) linear: RGB is what the pixel sees, background included; A the meshes' mean opacity
    coverage: Tensor  # (H, W, M) share of the shutter's window in which each mesh is visible at the pixel
    shadow: (
        Tensor | None
    )  # (H, W) share of the direct light due to what the pixel sees that no shadow takes away; 1 where
    # none is due; None where no light of the scene casts shadows
    counts: dict[str, int]  # how many of ledger.COUNTS
    timings: dict[str, float]  # seconds in each of ledger.STAGES
    effect_timings: dict[str, float]  # seconds of them in code that serves one of ledger.TIMED_EFFECTS alone; the
    # others share theirs, and the compiled path tells only what prepares textures and finds shadows from the rest
    plan: EffectPlan  # which effects were simulated, and why


def render(  # noqa: PLR0913  all keywords but the first
    scene: Scene,
    *,
    accuracy: Accuracy | None = None,
    effects: str | EffectPlan = "auto",
    shutter: Shutter | None = None,
    rays_per_pixel: int = 1,
    memory_bytes: int = 1 << 28,
    backend: str = "auto",
) -> Frame:
    """Return the mean of `scene` over its exposure, weighted by the shutter, exact in time, without samples or noise.

    Args:
        scene: what to render; the frame has its device, and the floating type of its vertices.
        accuracy: `Accuracy.exact()` if None.
        effects: "auto" leaves out what the scene does not call for, which does not change the image; "all" leaves out
            nothing; a plan, of `plan_effects`, simulates what it says, and must hold all that the scene needs.
        shutter: `Shutter.box()`, the whole exposure, if None.
        rays_per_pixel: 1 looks through the pixel's centre only; more rays, each exact in time, are spread inside the
            pixel and averaged (box filter).
        memory_bytes: working memory to stay under, by dividing the image into blocks [bytes]. The image, the prisms
            (0.4 kB a face and piece of motion, twice that where there is light) and the textures (43 bytes a texel
            with mip levels) come on top, with gradients autograd keeps every block, and a single ray
            that needs more gets it.
        backend: "torch": any device, gradients; "cpu": compiled, for scenes on the CPU without gradients; "auto": the
            compiled one where it can be and results are float32. They agree within 2e-5 but where surfaces lie in
            one plane to about 1e-11 of their depth (of an orthographic camera: of its far - near): which of these is
            in front may differ.

    Returns:
        A frame with `rgba` (H, W, 4), `coverage` (H, W, M), `shadow` (H, W) or None, counts, timings and the plan.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Accuracy: geometry is solved in float64 whatever the type of the input; only the result is rounded to it.
    Gradient: to vertices, normals, camera, uv, colours, opacities, textures, lights, background. None comes from
        silhouettes that do not move during the exposure (see README), nor from the edges of shadows. To vertices and
        camera only with `Accuracy.exact()`.
    Source: Ronnow et al. 2021 and 2022; exactness, order and memory blocks: ours.

    Example:
        >>> camera = Camera(torch.eye(4, dtype=torch.float64), 1, 1)
        >>> float(render(Scene([], camera, background=(0.25, 0, 0))).rgba[0, 0, 0])
        0.25
    """
    shutters = (Shutter.box() if shutter is None else shutter,)
    job = _checked_job(scene, shutters, (accuracy, effects), (rays_per_pixel, memory_bytes), backend)
    return job.frames()[0]


def render_windows(  # noqa: PLR0913  as render, and the windows
    scene: Scene,
    windows: Sequence[tuple[float, float]],
    *,
    accuracy: Accuracy | None = None,
    effects: str | EffectPlan = "auto",
    shutter: Shutter | None = None,
    rays_per_pixel: int = 1,
    memory_bytes: int = 1 << 28,
    backend: str = "auto",
) -> tuple[Frame, ...]:
    """Return a frame for each part of the exposure, all from one set of intervals, which is found only once.

    Args:
        scene: what to render.
        windows: parts (start, end) of the exposure [shutter time]; they may overlap.
        shutter: whose weight applies inside each window, with unit integral; `Shutter.box()` if None.
        accuracy, effects, rays_per_pixel, memory_bytes, backend: as in `render`.

    Returns:
        One frame a window, each what `render` returns for `shutter.window(start, end)`; they share counts and timings.
        `Accuracy.linear()` and `.adaptive()` follow surfaces by chords over the time from the first window's start to
        the last one's end, not over each window, and so give other images than `render` there.

    Raises:
        TypeError, ValueError: a wrong argument, named; a window in which the shutter sees nothing.

    Source: ours.
    """
    whole = Shutter.box() if shutter is None else shutter
    if not isinstance(whole, Shutter):
        raise check.fail_type("shutter", "a Shutter", shutter)
    if not isinstance(windows, (list, tuple)) or not all(isinstance(w, (list, tuple)) and len(w) == 2 for w in windows):
        raise check.fail_type("windows", "a sequence of pairs (start, end)", windows)
    if not windows:
        raise check.fail("windows", "at least one pair (start, end)", windows)
    shutters = tuple(whole.window(start, end) for start, end in windows)
    job = _checked_job(scene, shutters, (accuracy, effects), (rays_per_pixel, memory_bytes), backend)
    return tuple(job.frames())


def _checked_job(
    scene: Scene,
    shutters: tuple[Shutter, ...],
    how: tuple[Accuracy | None, str | EffectPlan],
    costs: tuple[int, int],
    backend: str,
) -> _Job:
    """Return the job of these arguments, or raise naming the wrong one."""
    (accuracy, effects), (rays_per_pixel, memory_bytes) = how, costs
    if not isinstance(scene, Scene):
        raise check.fail_type("scene", "a Scene", scene)
    accuracy = Accuracy.exact() if accuracy is None else accuracy
    if not isinstance(accuracy, Accuracy):
        raise check.fail_type("accuracy", "an Accuracy", accuracy)
    moving = [scene.camera.world_to_clip, *(mesh.vertices for mesh in scene.meshes)]
    if accuracy.method != "exact" and torch.is_grad_enabled() and any(m.requires_grad for m in moving):
        raise check.fail("accuracy", "Accuracy.exact(), as vertices or camera ask for gradients", accuracy.method)
    check_effects(effects)
    for shutter in shutters:
        if not isinstance(shutter, Shutter):
            raise check.fail_type("shutter", "a Shutter", shutter)
        shutter.span(shutter.n_lines(scene.camera.width, scene.camera.height))
    check.positive_int("rays_per_pixel", rays_per_pixel, MAX_RAYS)
    if check.positive_int("memory_bytes", memory_bytes) < MIN_MEMORY_BYTES:
        raise check.fail("memory_bytes", f"at least {MIN_MEMORY_BYTES}", memory_bytes)
    backend = choose_backend(scene, backend)
    return _Job(scene, shutters, accuracy, effects, rays_per_pixel, memory_bytes, backend, Ledger())


@dataclass(frozen=True)
class _Job:
    """One scene to render under one or several shutters."""

    scene: Scene
    shutters: tuple[Shutter, ...]
    accuracy: Accuracy
    effects: str | EffectPlan
    rays_per_pixel: int
    memory_bytes: int
    backend: str
    ledger: Ledger

    def frames(self) -> list[Frame]:
        """Return a frame for each shutter."""
        with watching() as watch:
            images, plan = self._images()
        casts = any(light.casts_shadows for light in self.scene.lights)
        spent = {name: watch.seconds.get(name, 0.0) for name in TIMED_EFFECTS}
        with torch.set_grad_enabled(self.scene.requires_grad):
            return [self._frame(image, (plan, spent), casts) for image in images]

    def _images(self) -> tuple[Tensor, EffectPlan]:
        """Return (shutters, H, W, N_LOOKS + M) looks and coverage, and the plan that was followed."""
        scene, ledger = self.scene, self.ledger
        spans = [s.span(s.n_lines(scene.camera.width, scene.camera.height)) for s in self.shutters]
        window = min(start for start, _ in spans), max(end for _, end in spans)
        with torch.set_grad_enabled(scene.requires_grad):
            with ledger.stage("prisms", scene.device):
                surfaces = build_surfaces(scene)
                prisms = build_prisms(scene, surfaces, window)
            ledger.add("prisms", prisms.count)
            with ledger.stage("plan", scene.device):
                survey = survey_prisms(prisms, (scene.camera.width, scene.camera.height))
                own = plan_prisms(scene, (prisms, survey), self.accuracy, self.rays_per_pixel)
                plan = agree_plan(self.effects, own)
                prisms, survey, chosen = follow_plan(plan, prisms, survey, self.accuracy)
            work = Work(plan, prisms, survey, chosen)
            exposure = Exposure(scene, self.shutters, self.accuracy, self.memory_bytes, ledger, work, self.backend)
            images = map(exposure.image, pixel_rays(self.rays_per_pixel))
            total = functools.reduce(torch.add, images)  # a single one is not copied
            return (total / self.rays_per_pixel if self.rays_per_pixel > 1 else total), plan

    def _frame(self, image: Tensor, done: tuple[EffectPlan, dict[str, float]], has_shadows: bool) -> Frame:
        """Return the frame of (H, W, N_LOOKS + M) looks and coverage."""
        scene = self.scene
        rgba, coverage = scene.over_background(image[..., :4]).to(scene.dtype), image[..., N_LOOKS:]
        shadow = None
        if has_shadows:
            due, arriving = image[..., 4:N_LOOKS].unbind(-1)
            is_due = due > 0
            shadow = torch.where(is_due, arriving / torch.where(is_due, due, 1.0), 1.0).to(scene.dtype)
        for leaf in scene.tensors():  # what nothing depends on has gradient 0, not none
            rgba = rgba + (0 * leaf).sum().to(rgba) if leaf.requires_grad else rgba
        plan, spent = done
        return Frame(rgba, coverage.to(scene.dtype), shadow, self.ledger.counts, self.ledger.timings, spent, plan)
