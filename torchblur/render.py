"""Render the exact mean of a scene over its exposure, block of pixels by block of pixels.

Before: prisms.py, intervals.py, cells.py, nodes.py, resolve.py.  After: the user.
Source: Ronnow et al. 2021 (pipeline); blocks under a memory budget: ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchblur import check, packed
from torchblur.accuracy import Accuracy
from torchblur.camera import MAX_RAYS, Ray, pixel_rays
from torchblur.cells import count_layers, cut_cells
from torchblur.effects import EffectPlan, agree_plan, check_effects, follow_plan, plan_prisms
from torchblur.hidden import find_visible_intervals
from torchblur.intervals import Intervals
from torchblur.ledger import Ledger
from torchblur.nodes import add_shadows, estimate_bytes, estimate_path_bytes, find_varying, place_samples
from torchblur.pairs import Block, count_pairs
from torchblur.paths import cut_at_knots
from torchblur.prisms import Prisms, build_prisms
from torchblur.resolve import composite_samples, expose_samples, weigh_samples
from torchblur.scene import Scene
from torchblur.shutter import Shutter
from torchblur.subdivide import approximate
from torchblur.surfaces import Surfaces, build_surfaces
from torchblur.survey import Survey, survey_prisms

BYTES_PER_PAIR = 700  # peak of find_intervals; scripts/benchmark.py prints what a budget really takes
MIN_MEMORY_BYTES = 1 << 20
N_LOOKS = 6  # channels: premultiplied colour, opacity, direct light without and with shadows


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
    plan: EffectPlan  # which effects were simulated, and why


def render(
    scene: Scene,
    *,
    accuracy: Accuracy | None = None,
    effects: str | EffectPlan = "auto",
    shutter: Shutter | None = None,
    rays_per_pixel: int = 1,
    memory_bytes: int = 1 << 28,
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
    job = _checked_job(scene, shutters, accuracy, effects, rays_per_pixel, memory_bytes)
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
) -> tuple[Frame, ...]:
    """Return a frame for each part of the exposure, all from one set of intervals, which is found only once.

    Args:
        scene: what to render.
        windows: parts (start, end) of the exposure [shutter time]; they may overlap.
        shutter: whose weight applies inside each window, with unit integral; `Shutter.box()` if None.
        accuracy, effects, rays_per_pixel, memory_bytes: as in `render`.

    Returns:
        One frame a window, each what `render` returns for `shutter.window(start, end)`; they share counts and timings.

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
    job = _checked_job(scene, shutters, accuracy, effects, rays_per_pixel, memory_bytes)
    return tuple(job.frames())


def _checked_job(
    scene: Scene,
    shutters: tuple[Shutter, ...],
    accuracy: Accuracy | None,
    effects: str | EffectPlan,
    rays_per_pixel: int,
    memory_bytes: int,
) -> _Job:
    """Return the job of these arguments, or raise naming the wrong one."""
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
    return _Job(scene, shutters, accuracy, effects, rays_per_pixel, memory_bytes, Ledger())


@dataclass(frozen=True)
class _Work:
    """What there is to render, and what of it to simulate."""

    plan: EffectPlan
    prisms: Prisms
    survey: Survey
    chosen: Tensor  # (C,) int64 the prisms to look at


@dataclass(frozen=True)
class _Job:
    """One scene to render under one or several shutters."""

    scene: Scene
    shutters: tuple[Shutter, ...]
    accuracy: Accuracy
    effects: str | EffectPlan
    rays_per_pixel: int
    memory_bytes: int
    ledger: Ledger

    def frames(self) -> list[Frame]:
        """Return a frame for each shutter."""
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
            work = _Work(plan, prisms, survey, chosen)
            total = sum(self._image(work, ray) for ray in pixel_rays(self.rays_per_pixel)) / self.rays_per_pixel
            casts = any(light.casts_shadows for light in scene.lights)
            return [self._frame(image, plan, casts) for image in total]

    def _frame(self, image: Tensor, plan: EffectPlan, has_shadows: bool) -> Frame:
        """Return the frame of (H, W, N_LOOKS + M) looks and coverage."""
        scene = self.scene
        rgba, coverage = scene.over_background(image[..., :4]).to(scene.dtype), image[..., N_LOOKS:]
        due, arriving = image[..., 4:N_LOOKS].unbind(-1)
        is_due = due > 0
        shadow = torch.where(is_due, arriving / torch.where(is_due, due, 1.0), 1.0).to(scene.dtype)
        for leaf in scene.tensors():  # what nothing depends on has gradient 0, not none
            rgba = rgba + (0 * leaf).sum().to(rgba) if leaf.requires_grad else rgba
        shadow = shadow if has_shadows else None
        return Frame(rgba, coverage.to(scene.dtype), shadow, self.ledger.counts, self.ledger.timings, plan)

    def _image(self, work: _Work, ray: Ray) -> Tensor:
        """Return (shutters, H, W, N_LOOKS + M) float64: looks and coverage for one ray per pixel."""
        camera, device = self.scene.camera, self.scene.device
        whole = Block(0, 0, camera.width, camera.height, ray, camera.width, camera.height)
        prisms, accuracy = work.prisms, self.accuracy
        if accuracy.method == "adaptive" and "curvature" not in work.plan.simulated:
            accuracy = Accuracy.linear()
        places, values = [], []
        for block, candidates in self._blocks(prisms, whole, work.chosen):
            with self.ledger.stage("intervals", device):
                intervals, counts = find_visible_intervals(prisms, work.survey, block, candidates)
                intervals = approximate(prisms, intervals, accuracy)
            self.ledger.add("blocks", 1)
            for name, n in counts.items():
                self.ledger.add(name, n)
            self.ledger.add("intervals", intervals.count)
            if intervals.count == 0:
                continue
            self.ledger.deepest("deepest_pixel", intervals.offsets.diff().max())
            for pixels in self._chunks(prisms.surfaces, intervals):
                column, row = block.x0 + pixels % block.width, block.y0 + pixels // block.width
                places.append(row * camera.width + column)
                values.append(self._resolve(work, intervals.of_pixels(pixels), (column, row)))
        n_pixels, n_channels = camera.height * camera.width, N_LOOKS + len(self.scene.meshes)
        image = torch.zeros(n_pixels, len(self.shutters), n_channels, dtype=torch.float64, device=device)
        if places:
            image = image.index_put((torch.cat(places),), torch.cat(values))
        return image.reshape(camera.height, camera.width, -1, n_channels).movedim(2, 0)

    def _resolve(self, work: _Work, intervals: Intervals, pixel: tuple[Tensor, Tensor], whole: bool = True) -> Tensor:
        """Return (pixels, shutters, N_LOOKS + M) of the pixels at column and row `pixel`, in portions that fit."""
        camera, device = self.scene.camera, self.scene.device
        prisms, (column, row) = work.prisms, pixel
        is_exact = self.accuracy.method == "exact"
        lines = [s.line_of(column, row, (camera.width, camera.height)) for s in self.shutters]
        with self.ledger.stage("cells", device):
            cells = cut_cells(prisms, intervals, "crossings" in work.plan.simulated)
            cells = cells if is_exact else cut_at_knots(cells, self._knots(lines))
        with self.ledger.stage("nodes", device):
            varying = find_varying(prisms, intervals, cells, self._knots(lines)) if is_exact else None
            n_bytes = estimate_bytes(prisms, cells, varying)
        if whole and len(portions := _portions(n_bytes, self.memory_bytes)) > 1:
            return self._in_portions(work, intervals, pixel, portions)
        if varying is not None and prisms.surfaces.casters is not None:
            with self.ledger.stage("shadows", device):
                varying = add_shadows(prisms, varying)
                n_bytes = estimate_bytes(prisms, cells, varying)
            if len(portions := _portions(n_bytes, self.memory_bytes)) > 1:
                return self._in_portions(work, intervals, pixel, portions)
            self.ledger.add_shadows(varying.shadows)
        self.ledger.add("cells", len(cells.t_start))
        self.ledger.add("layers", len(cells.layer_interval))
        self.ledger.add("crossings", cells.n_crossings)
        with self.ledger.stage("nodes", device):
            samples = place_samples(prisms, cells, varying)
        self.ledger.add("nodes", len(samples.cell))
        with self.ledger.stage("resolve", device):
            pixel_of = packed.owners(cells.offsets)[samples.cell]
            offsets = packed.offsets_from_owners(pixel_of, len(column))
            composite = composite_samples(prisms, intervals, cells, samples, self.accuracy, varying)
            parts = []
            for shutter, line in zip(self.shutters, lines, strict=True):
                weight = weigh_samples(shutter, cells, samples, line[pixel_of])
                done = expose_samples(offsets, composite, weight, len(self.scene.meshes))
                parts.append(torch.cat([done.rgba, done.light, done.coverage], dim=1))
            return torch.stack(parts, dim=1)

    def _in_portions(
        self, work: _Work, intervals: Intervals, pixel: tuple[Tensor, Tensor], portions: Sequence[Tensor]
    ) -> Tensor:
        """Return what `_resolve` does, portion by portion of the pixels."""
        parts = []
        for chosen in portions:
            own = tuple(place[chosen] for place in pixel)
            parts.append(self._resolve(work, intervals.of_pixels(chosen), own, False))
        return torch.cat(parts)

    def _knots(self, lines: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the times (J,) at which the shutters bend, and by how much lines delay them (J, pixels)."""
        times = [t for s in self.shutters for t in s.times]
        delays = [s.line_delay * lines[k].to(torch.float64) for k, s in enumerate(self.shutters) for _ in s.times]
        return torch.tensor(times, dtype=torch.float64, device=self.scene.device), torch.stack(delays)

    def _blocks(self, prisms: Prisms, block: Block, candidates: Tensor) -> Iterator[tuple[Block, Tensor]]:
        """Yield blocks whose pairs fit the memory, each with the prisms that may touch it; empty ones left out."""
        counts = count_pairs(prisms, block, candidates)
        candidates = candidates[counts > 0]
        total = int(counts.sum())
        if total == 0:
            return
        if total * BYTES_PER_PAIR <= self.memory_bytes or block.n_pixels == 1:
            yield block, candidates
            return
        if block.width >= block.height:
            half = block.width // 2
            parts = replace(block, width=half), replace(block, x0=block.x0 + half, width=block.width - half)
        else:
            half = block.height // 2
            parts = replace(block, height=half), replace(block, y0=block.y0 + half, height=block.height - half)
        for part in parts:
            yield from self._blocks(prisms, part, candidates)

    def _chunks(self, surfaces: Surfaces, intervals: Intervals) -> Iterator[Tensor]:
        """Yield runs of covered pixels whose layers fit the memory."""
        with self.ledger.stage("cells", self.scene.device):
            layers = count_layers(intervals)
            pixels = (layers > 0).nonzero().flatten()
            inner = {t for s in self.shutters for t in s.times} | {t for k in surfaces.lights for t in k.knots}
            n_intervals = intervals.offsets.diff()[pixels]
            n_bytes = estimate_path_bytes(surfaces, layers[pixels], n_intervals, len(inner - {0.0, 1.0}))
        yield from (pixels[chosen] for chosen in _portions(n_bytes, self.memory_bytes))


def _portions(n_bytes: Tensor, memory_bytes: int) -> Sequence[Tensor]:
    """Return runs of indices whose `n_bytes` (n,) add up to about `memory_bytes` or are single."""
    if len(n_bytes) == 0:
        return ()
    portion = torch.cumsum(n_bytes, 0) // memory_bytes
    sizes = torch.unique_consecutive(portion, return_counts=True)[1].tolist()
    return torch.arange(len(n_bytes), device=n_bytes.device).split(sizes)
