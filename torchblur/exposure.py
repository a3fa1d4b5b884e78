"""Look at all rays of one place in the pixels, block of pixels by block of pixels, plainly or by the compiled code.

Before: prisms.py, intervals.py, cells.py, nodes.py, resolve.py, cpu/visibility.py.  After: render.py.
Source: Ronnow et al. 2021 (pipeline); blocks under a memory budget: ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchblur import packed
from torchblur.accuracy import Accuracy
from torchblur.camera import Ray
from torchblur.cells import Cells, count_layers, cut_cells
from torchblur.cpu import visibility
from torchblur.effects import EffectPlan
from torchblur.hidden import find_visible_intervals
from torchblur.intervals import Intervals
from torchblur.ledger import Ledger
from torchblur.nodes import Varying, add_shadows, estimate_bytes, estimate_path_bytes, find_varying, place_samples
from torchblur.pairs import Block, count_pairs
from torchblur.paths import cut_at_knots
from torchblur.prisms import Prisms
from torchblur.resolve import composite_samples, expose_samples, weigh_samples
from torchblur.scene import Scene
from torchblur.shutter import Shutter
from torchblur.subdivide import approximate
from torchblur.surfaces import Surfaces
from torchblur.survey import Survey

BYTES_PER_PAIR = 700  # peak of find_intervals
N_LOOKS = 6  # channels: premultiplied colour, opacity, direct light without and with shadows


@dataclass(frozen=True)
class Work:
    """What there is to render, and what of it to simulate."""

    plan: EffectPlan
    prisms: Prisms
    survey: Survey
    chosen: Tensor  # (C,) int64 the prisms to look at


@dataclass(frozen=True)
class Exposure:
    """What there is to render, under which shutters, and how."""

    scene: Scene
    shutters: tuple[Shutter, ...]
    accuracy: Accuracy
    memory_bytes: int
    ledger: Ledger
    work: Work
    backend: str  # "torch" or "cpu"

    def image(self, ray: Ray) -> Tensor:
        """Return (shutters, H, W, N_LOOKS + M) float64: looks and coverage for one ray per pixel. Source: see above."""
        camera, device = self.scene.camera, self.scene.device
        if self.backend == "cpu" and self._way().method == "exact":
            if self._is_plain():
                return self._composite(ray)
            if not self._has_open_casters():
                return self._integrate(ray)
        places, values = [], []
        for (column, row), intervals, cells in self._seen(ray):
            places.append(row * camera.width + column)
            values.append(self._resolve(intervals, cells, (column, row)))
        n_pixels, n_channels = camera.height * camera.width, N_LOOKS + len(self.scene.meshes)
        image = torch.zeros(n_pixels, len(self.shutters), n_channels, dtype=torch.float64, device=device)
        if places:
            image = image.index_put((torch.cat(places),), torch.cat(values))
        return image.reshape(camera.height, camera.width, -1, n_channels).movedim(2, 0)

    def _is_plain(self) -> bool:
        """Return whether colours are constant, so that cells need no further look."""
        surfaces = self.work.prisms.surfaces
        return not ((surfaces.is_textured | surfaces.is_lit).any() or self._is_forced("curvature"))

    def _has_open_casters(self) -> bool:
        """Return whether textures decide how much light casters let through."""
        surfaces = self.work.prisms.surfaces
        casters = surfaces.casters
        return casters is not None and bool(surfaces.has_varying_opacity[casters.face].any())

    def _is_forced(self, name: str) -> bool:
        return self.work.plan[name].forced

    def _way(self) -> Accuracy:
        """Return the accuracy to follow: where all is straight, adaptive is linear."""
        is_straight = "curvature" not in self.work.plan.simulated
        return Accuracy.linear() if self.accuracy.method == "adaptive" and is_straight else self.accuracy

    def _sight(self) -> visibility.Sight:
        work, cutoff = self.work, self.accuracy.transmittance_cutoff
        return visibility.prepare(work.prisms, work.survey, work.chosen, self.shutters, cutoff)

    def _composite(self, ray: Ray) -> Tensor:
        """Return what `image` does, where colours are constant."""
        with self.ledger.stage("intervals", self.scene.device):
            may_cross = "crossings" in self.work.plan.simulated
            image, counts = visibility.composite(self._sight(), self.scene, ray, may_cross)
        self.ledger.add_many(counts)
        return image

    def _integrate(self, ray: Ray) -> Tensor:
        """Return what `image` does, where looks may vary."""
        may_cross = "crossings" in self.work.plan.simulated
        with self.ledger.stage("intervals", self.scene.device):
            sight = self._sight()
        return visibility.integrate(sight, self.scene, ray, may_cross, (self.memory_bytes, self.ledger))

    def _seen(self, ray: Ray) -> Iterator[tuple[tuple[Tensor, Tensor], Intervals, Cells | None]]:
        """Yield column and row of some pixels, the intervals of these, and their cells where they are cut already."""
        camera, work, accuracy = self.scene.camera, self.work, self._way()
        if self.backend == "cpu":
            is_exact, may_cross = accuracy.method == "exact", "crossings" in work.plan.simulated
            listings = visibility.list_seen(self._sight(), self.scene, ray, (may_cross, is_exact), self.memory_bytes)
            while True:
                with self.ledger.stage("intervals", self.scene.device):
                    found = next(listings, None)
                if found is None:
                    return
                listing, counts = found
                self.ledger.add("blocks", 1)
                self.ledger.add_many(counts)
                place = listing.pixel % camera.width, listing.pixel // camera.width
                if is_exact:
                    yield place, listing.intervals, listing.cells
                    continue
                intervals = approximate(work.prisms, listing.intervals, accuracy)
                for pixels in self._chunks(work.prisms.surfaces, intervals):
                    yield (place[0][pixels], place[1][pixels]), intervals.of_pixels(pixels), None
        whole = Block(0, 0, camera.width, camera.height, ray, camera.width, camera.height)
        for block, candidates in self._blocks(work.prisms, whole, work.chosen):
            with self.ledger.stage("intervals", self.scene.device):
                intervals, counts = find_visible_intervals(work.prisms, work.survey, block, candidates)
                intervals = approximate(work.prisms, intervals, accuracy)
            self.ledger.add("blocks", 1)
            self.ledger.add_many(counts | {"intervals": intervals.count})
            if intervals.count == 0:
                continue
            self.ledger.deepest("deepest_pixel", intervals.offsets.diff().max())
            for pixels in self._chunks(work.prisms.surfaces, intervals):
                place = block.x0 + pixels % block.width, block.y0 + pixels // block.width
                yield place, intervals.of_pixels(pixels), None

    def _resolve(self, intervals: Intervals, cells: Cells | None, pixel: tuple[Tensor, Tensor]) -> Tensor:
        """Return (pixels, shutters, N_LOOKS + M) of the pixels at column and row `pixel`, in portions that fit."""
        prisms = self.work.prisms
        is_exact = self.accuracy.method == "exact"
        with self.ledger.stage("cells", self.scene.device):
            if cells is None:
                cells = cut_cells(prisms, intervals, "crossings" in self.work.plan.simulated)
                cells = cells if is_exact else cut_at_knots(cells, self._knots(self._lines(pixel)))
        varying = self._varying(intervals, cells, pixel)
        portions = self._portions(cells, varying)
        if len(portions) <= 1:
            return self._resolve_shadowed(intervals, cells, pixel, varying)
        parts = []
        for chosen in portions:
            *own, of = *cells.of_pixels(intervals, chosen), tuple(place[chosen] for place in pixel)
            parts.append(self._resolve_shadowed(*own, of, self._varying(*own, of)))
        return torch.cat(parts)

    def _varying(self, intervals: Intervals, cells: Cells, pixel: tuple[Tensor, Tensor]) -> Varying | None:
        """Return what varies in cells, where that matters."""
        if self.accuracy.method != "exact":
            return None
        with self.ledger.stage("nodes", self.scene.device):
            return find_varying(self.work.prisms, intervals, cells, self._knots(self._lines(pixel)))

    def _portions(self, cells: Cells, varying: Varying | None) -> Sequence[Tensor]:
        """Return runs of the cells' pixels whose samples fit the memory."""
        with self.ledger.stage("nodes", self.scene.device):
            return _portions(estimate_bytes(self.work.prisms, cells, varying), self.memory_bytes)

    def _resolve_shadowed(
        self, intervals: Intervals, cells: Cells, pixel: tuple[Tensor, Tensor], varying: Varying | None
    ) -> Tensor:
        """Return what `_resolve` does, with the shadows on `varying` found once for all portions that these ask for."""
        prisms = self.work.prisms
        if varying is None or prisms.surfaces.casters is None:
            return self._resolve_cells(intervals, cells, pixel, varying)
        with self.ledger.stage("shadows", self.scene.device):
            varying = add_shadows(prisms, varying)
        self.ledger.add_shadows(varying.shadows)
        portions = self._portions(cells, varying)
        if len(portions) <= 1:
            return self._resolve_cells(intervals, cells, pixel, varying)
        receiver_pixel = packed.owners(cells.offsets)[varying.cell[varying.span_of_receivers]]
        parts = []
        for chosen in portions:
            *own, of = *cells.of_pixels(intervals, chosen), tuple(place[chosen] for place in pixel)
            some = self._varying(*own, of)
            if some is not None and varying.shadows is not None:
                on = ((receiver_pixel >= chosen[0]) & (receiver_pixel <= chosen[-1])).nonzero().flatten()
                some = replace(some, shadows=varying.shadows.choose(on))
            parts.append(self._resolve_cells(*own, of, some))
        return torch.cat(parts)

    def _resolve_cells(
        self, intervals: Intervals, cells: Cells, pixel: tuple[Tensor, Tensor], varying: Varying | None
    ) -> Tensor:
        """Return what `_resolve` does, of all cells at once."""
        prisms, device = self.work.prisms, self.scene.device
        if self.backend == "torch" or self.accuracy.method != "exact":
            self.ledger.add("cells", len(cells.t_start))
            self.ledger.add("layers", len(cells.layer_interval))
            self.ledger.add("crossings", cells.n_crossings)
        with self.ledger.stage("nodes", device):
            samples = place_samples(prisms, cells, varying)
        self.ledger.add("nodes", len(samples.cell))
        with self.ledger.stage("resolve", device):
            pixel_of = packed.owners(cells.offsets)[samples.cell]
            offsets = packed.offsets_from_owners(pixel_of, len(pixel[0]))
            composite = composite_samples(prisms, intervals, cells, samples, self.accuracy, varying)
            parts = []
            for shutter, line in zip(self.shutters, self._lines(pixel), strict=True):
                weight = weigh_samples(shutter, cells, samples, line[pixel_of])
                done = expose_samples(offsets, composite, weight, len(self.scene.meshes))
                parts.append(torch.cat([done.rgba, done.light, done.coverage], dim=1))
            return torch.stack(parts, dim=1)

    def _lines(self, pixel: tuple[Tensor, Tensor]) -> list[Tensor]:
        """Return shutter by shutter the lines (pixels,) at column and row `pixel`."""
        camera = self.scene.camera
        return [s.line_of(*pixel, (camera.width, camera.height)) for s in self.shutters]

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
