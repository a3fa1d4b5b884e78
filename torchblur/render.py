"""Render the exact mean of a scene over its exposure, block of pixels by block of pixels.

Before: prisms.py, intervals.py, cells.py, resolve.py.  After: the user.
Source: Ronnow et al. 2021 (pipeline); blocks under a memory budget: ours.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchblur import check
from torchblur.accuracy import Accuracy
from torchblur.camera import pixel_rays
from torchblur.cells import count_layers, cut_cells
from torchblur.intervals import Block, Intervals, count_pairs, find_intervals
from torchblur.prisms import Prisms, build_prisms
from torchblur.resolve import Resolved, resolve_cells
from torchblur.scene import Scene
from torchblur.shutter import Shutter
from torchblur.surfaces import build_surfaces

BYTES_PER_PAIR = 700  # peak of find_intervals, measured by scripts/benchmark_memory.py
BYTES_PER_LAYER = 260  # peak of cut_cells and resolve_cells
MIN_MEMORY_BYTES = 1 << 20
MAX_RAYS = 4096
COUNTS = ("prisms", "blocks", "pairs", "intervals", "cells", "layers", "crossings", "deepest_pixel")
STAGES = ("prisms", "intervals", "cells", "resolve")


@dataclass(frozen=True)
class Frame:
    """An image integrated over the exposure."""

    rgba: Tensor  # (H, W, 4) linear: RGB is what the pixel sees, background included; A the meshes' mean opacity
    coverage: Tensor  # (H, W, M) share of the shutter's window in which each mesh is visible at the pixel
    counts: dict[str, int]  # how many of COUNTS
    timings: dict[str, float]  # seconds in each of STAGES


@dataclass
class _Ledger:
    """What was done so far."""

    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COUNTS, 0))
    timings: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))

    def add(self, name: str, n: int) -> None:
        self.counts[name] += int(n)

    def deepest(self, name: str, n: int) -> None:
        self.counts[name] = max(self.counts[name], int(n))

    @contextmanager
    def stage(self, name: str, device: torch.device) -> Iterator[None]:
        start = time.perf_counter()
        yield
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        self.timings[name] += time.perf_counter() - start


def render(
    scene: Scene,
    *,
    accuracy: Accuracy | None = None,
    shutter: Shutter | None = None,
    rays_per_pixel: int = 1,
    memory_bytes: int = 1 << 28,
) -> Frame:
    """Return the mean of `scene` over the shutter's window, exact in time, without samples or noise.

    Args:
        scene: what to render; the frame has its device, and the floating type of its vertices.
        accuracy: `Accuracy.exact()` if None.
        shutter: `Shutter.box()`, the whole exposure, if None.
        rays_per_pixel: 1 looks through the pixel's centre only; more rays, each exact in time, are spread inside the
            pixel and averaged (box filter).
        memory_bytes: working memory to stay under, by dividing the image into blocks [bytes]. The image itself comes
            on top, with gradients autograd keeps every block, and a single ray that needs more gets it.

    Returns:
        A frame with `rgba` (H, W, 4), `coverage` (H, W, M), counts and timings.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Accuracy: geometry is solved in float64 whatever the type of the input; only the result is rounded to it.
    Gradient: to vertices, camera, colours, opacities, background. None comes from silhouettes that do not move
        during the exposure (see README).
    Source: Ronnow et al. 2021 and 2022; exactness, order and memory blocks: ours.

    Example:
        >>> camera = Camera(torch.eye(4, dtype=torch.float64), 1, 1)
        >>> float(render(Scene([], camera, background=(0.25, 0, 0))).rgba[0, 0, 0])
        0.25
    """
    if not isinstance(scene, Scene):
        raise check.fail_type("scene", "a Scene", scene)
    accuracy = Accuracy.exact() if accuracy is None else accuracy
    shutter = Shutter.box() if shutter is None else shutter
    if not isinstance(accuracy, Accuracy):
        raise check.fail_type("accuracy", "an Accuracy", accuracy)
    if not isinstance(shutter, Shutter):
        raise check.fail_type("shutter", "a Shutter", shutter)
    check.positive_int("rays_per_pixel", rays_per_pixel, MAX_RAYS)
    if check.positive_int("memory_bytes", memory_bytes) < MIN_MEMORY_BYTES:
        raise check.fail("memory_bytes", f"at least {MIN_MEMORY_BYTES}", memory_bytes)
    ledger = _Ledger()
    with torch.set_grad_enabled(scene.requires_grad):
        with ledger.stage("prisms", scene.device):
            surfaces = build_surfaces(scene)
            prisms = build_prisms(scene, surfaces, shutter)
        ledger.add("prisms", prisms.count)
        job = _Job(scene, prisms, accuracy, shutter, memory_bytes, ledger)
        total = sum(job.image(ray) for ray in pixel_rays(rays_per_pixel)) / rays_per_pixel
        alpha, coverage = total[..., 3:4], total[..., 4:]
        rgb = total[..., :3] + (1 - alpha) * scene.background.to(total)
        rgba = torch.cat([rgb, alpha], dim=-1).to(scene.dtype)
        for leaf in scene.tensors():  # what nothing depends on has gradient 0, not none
            rgba = rgba + (0 * leaf).sum().to(rgba) if leaf.requires_grad else rgba
    return Frame(rgba, coverage.to(scene.dtype), ledger.counts, ledger.timings)


@dataclass(frozen=True)
class _Job:
    """One frame to render."""

    scene: Scene
    prisms: Prisms
    accuracy: Accuracy
    shutter: Shutter
    memory_bytes: int
    ledger: _Ledger

    def image(self, ray_px: tuple[float, float]) -> Tensor:
        """Return (H, W, 4 + M) float64: premultiplied colour, alpha and coverage for one ray per pixel."""
        camera = self.scene.camera
        whole = Block(0, 0, camera.width, camera.height, ray_px, camera.width, camera.height)
        every = torch.arange(self.prisms.count, device=self.scene.device)
        n_channels = 4 + len(self.scene.meshes)
        places, values = [], []
        for block, candidates in self._blocks(whole, every):
            with self.ledger.stage("intervals", self.scene.device):
                intervals, n_pairs = find_intervals(self.prisms, block, candidates)
            self.ledger.add("blocks", 1)
            self.ledger.add("pairs", n_pairs)
            self.ledger.add("intervals", intervals.count)
            if intervals.count == 0:
                continue
            self.ledger.deepest("deepest_pixel", intervals.offsets.diff().max())
            for pixels in self._chunks(intervals):
                done = self._resolve(intervals.of_pixels(pixels))
                places.append((block.y0 + pixels // block.width) * camera.width + block.x0 + pixels % block.width)
                values.append(torch.cat([done.premultiplied, done.alpha.unsqueeze(1), done.coverage], dim=1))
        image = torch.zeros(camera.height * camera.width, n_channels, dtype=torch.float64, device=self.scene.device)
        if places:
            image = image.index_put((torch.cat(places),), torch.cat(values))
        return image.reshape(camera.height, camera.width, n_channels)

    def _resolve(self, intervals: Intervals) -> Resolved:
        with self.ledger.stage("cells", self.scene.device):
            cells = cut_cells(self.prisms, intervals)
        self.ledger.add("cells", len(cells.t_start))
        self.ledger.add("layers", len(cells.layer_interval))
        self.ledger.add("crossings", cells.n_crossings)
        with self.ledger.stage("resolve", self.scene.device):
            face = self.prisms.face_of[intervals.prism]
            cutoff = self.accuracy.transmittance_cutoff
            return resolve_cells(self.prisms.surfaces, face, cells, self.shutter, cutoff)

    def _blocks(self, block: Block, candidates: Tensor) -> Iterator[tuple[Block, Tensor]]:
        """Yield blocks whose pairs fit the memory, each with the prisms that may touch it; empty ones left out."""
        counts = count_pairs(self.prisms, block, candidates)
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
            yield from self._blocks(part, candidates)

    def _chunks(self, intervals: Intervals) -> Iterator[Tensor]:
        """Yield runs of covered pixels whose layers fit the memory."""
        with self.ledger.stage("cells", self.scene.device):
            layers = count_layers(intervals)
            pixels = (layers > 0).nonzero().flatten()
            per_chunk = max(1, self.memory_bytes // BYTES_PER_LAYER)
            chunk = torch.cumsum(layers[pixels], 0) // per_chunk
            sizes = torch.unique_consecutive(chunk, return_counts=True)[1].tolist()
        yield from torch.split(pixels, sizes)
