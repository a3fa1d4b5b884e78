"""Hand the tiles of an image to threads: from prisms to composited pixels, or to cells for the plain path.

Before: blend.py.  After: exposure.py.
Symbols as in blend.py.
Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchblur import packed
from torchblur.camera import Ray
from torchblur.cells import Cells
from torchblur.cpu import blend, expose, receive
from torchblur.cpu.curves import find_stock
from torchblur.cpu.instant import looks_of, on_threads
from torchblur.cpu.jit import announce
from torchblur.cpu.lambert import find_lit
from torchblur.cpu.sweep import DEN, LOW, NUM, T_END, T_START
from torchblur.cpu.tiles import Geometry, View
from torchblur.intervals import Intervals
from torchblur.ledger import Ledger
from torchblur.prisms import Prisms
from torchblur.scene import Scene
from torchblur.shadows import find_shadows
from torchblur.shutter import DIRECTIONS, Shutter
from torchblur.surfaces import Surfaces
from torchblur.survey import Survey

JOBS_A_THREAD = 4  # portions of the tiles, so that threads end together
BYTES_PER_LOAD = 150  # of what is listed, a pair of prism and pixel


@dataclass(frozen=True)
class Sight:
    """What is in view, ready for the compiled code."""

    geometry: Geometry
    colours: blend.Colours
    prisms: Prisms


@dataclass(frozen=True)
class Listing:
    """What the rays of some pixels see, with intervals by pixel."""

    pixel: Tensor  # (pixels,) int64 of the image, row by row
    intervals: Intervals
    cells: Cells


def prepare(prisms: Prisms, survey: Survey, chosen: Tensor, shutters: tuple[Shutter, ...], cutoff: float) -> Sight:
    """Return what the compiled code needs.

    Args:
        prisms, survey: of the scene.
        chosen: (C,) int64 the prisms to look at.
        shutters: under which pixels are composited.
        cutoff: share of the light that is left where rays end.

    Source: ours.
    """
    announce(blend.see_tiles)
    surfaces = prisms.surfaces
    order = chosen[torch.sort(survey.nearness[1, chosen], descending=True, stable=True).indices]
    face = prisms.face_of[order]
    allowed = torch.where(surfaces.is_one_sided[face], prisms.parity[order], 0.0).to(torch.int8)
    tensors = (
        prisms.clip[..., order].permute(3, 0, 1, 2)[..., [0, 1, 3, 2]],
        torch.stack([prisms.t_open[order], prisms.t_close[order]], dim=1),
        prisms.corners_px[..., order].permute(2, 0, 1),
        prisms.bounds_px[:, order].T,
        survey.nearness[1, order],
        allowed,
        prisms.is_clipped[order],
        survey.is_still[order],
        survey.hides[order],
        surfaces.is_opaque[face],
        order,
        surfaces.tie_rank[face],
    )
    times = [(t, w) for s in shutters for t, w in zip(s.times, s.weights, strict=True)]
    first = np.cumsum([0, *(len(s.times) for s in shutters)])
    colours = blend.Colours(
        _array(torch.cat([surfaces.rgb, surfaces.opacity[:, None]], dim=1)[prisms.face_of]),
        _array(surfaces.mesh_of[prisms.face_of]),
        first,
        *np.array(times).T.copy(),
        np.array([s.line_delay for s in shutters]),
        np.array([DIRECTIONS.index(s.direction) for s in shutters]),
        cutoff,
    )
    return Sight(Geometry(*map(_array, tensors)), colours, prisms)


def composite(sight: Sight, scene: Scene, ray: Ray, may_cross: bool) -> tuple[Tensor, dict[str, int]]:
    """Return (shutters, H, W, N_LOOKS + M) float64 looks and coverage of constant colours, and the counts. Ours."""
    camera = scene.camera
    n_channels = blend.N_LOOKS + len(scene.meshes)
    image = np.zeros((camera.height, camera.width, len(sight.colours.delay), n_channels))
    view = _view(sight, scene, ray, may_cross)
    offsets, prisms, load = blend.bin_prisms(sight.geometry, view)

    def see(tiles: np.ndarray) -> np.ndarray:
        return blend.see_tiles(sight.geometry, view, (tiles, offsets, prisms), sight.colours, image, blend.COMPOSITE)[1]

    counts = on_threads(see, _shares(load, _n_jobs()))
    return torch.from_numpy(image).movedim(2, 0), _total(counts)


def integrate(sight: Sight, scene: Scene, ray: Ray, may_cross: bool, limits: tuple[int, Ledger]) -> Tensor:
    """Return what `composite` does, where textures, lights and shadows make something of it.

    Args:
        sight, scene, ray, may_cross: as in `composite`.
        limits: about which memory what is listed at a time may take, and what to note counts and times in.

    Source: ours.
    """
    memory_bytes, ledger = limits
    announce(expose.expose)
    surfaces, camera, device = sight.prisms.surfaces, scene.camera, scene.device
    image = np.zeros((camera.height, camera.width, len(sight.colours.delay), blend.N_LOOKS + len(scene.meshes)))
    times = sorted({t for light in surfaces.lights for t in light.knots})
    with ledger.stage("intervals", device):
        what = expose.Scene(
            find_stock(sight.prisms),
            looks_of(surfaces, scene, ray),
            find_lit(scene, surfaces),
            sight.colours,
            np.array(times, dtype=np.float64),
            _view(sight, scene, ray, may_cross),
        )
        tiles = _list_tiles(sight, what.rays, blend.LIST_CELLS, memory_bytes)
    while True:
        with ledger.stage("intervals", device):
            listings, counts = next(tiles, (None, {}))
        if listings is None:
            return torch.from_numpy(image).movedim(2, 0)
        ledger.add_many(counts)
        shades, firsts = _find_shades(listings, what, surfaces, (image, ledger, device))
        jobs = [(own, what, shades, (*first, False), image) for own, first in zip(listings, firsts, strict=True)]
        with ledger.stage("resolve", device):
            done = on_threads(lambda job: expose.expose(*job), jobs)
        ledger.add("nodes", sum(n for n, _, _ in done))


def _find_shades(
    listings: list[blend.Listed], what: expose.Scene, surfaces: Surfaces, to: tuple[np.ndarray, Ledger, torch.device]
) -> tuple[tuple[receive.Shade, receive.Shade], list[tuple[int, int]]]:
    """Return when light is blocked on what is listed, over spans and at instants, and the numbers of the first
    receivers of each listing; `to` is an image, which is not looked at, the ledger and its device.
    """
    image, ledger, device = to
    none = receive.no_shade()
    if surfaces.casters is None:
        return (none, none), [(0, 0)] * len(listings)
    with ledger.stage("nodes", device):
        found = on_threads(lambda listed: expose.expose(listed, what, (none, none), (0, 0, True), image), listings)
    shades, firsts = [], []
    with ledger.stage("shadows", device):
        for kind in (1, 2):
            parts = [f[kind] for f in found]
            counts = [int(p.count[0]) for p in parts]
            firsts.append(np.cumsum([0, *counts])[:-1].tolist())
            if not sum(counts):
                shades.append(none)
                continue
            shadows = find_shadows(surfaces, *receive.as_receivers(parts, kind == 2))
            ledger.add_shadows(shadows)
            shades.append(receive.as_shade(surfaces, sum(counts), shadows))
    return tuple(shades), list(zip(*firsts, strict=True))


def list_seen(
    sight: Sight, scene: Scene, ray: Ray, how: tuple[bool, bool], memory_bytes: int
) -> Iterator[tuple[Listing, dict[str, int]]]:
    """Yield what all rays see, some tiles at a time, and the counts of these.

    Args:
        sight: what is in view.
        scene: of it.
        ray: place of the rays in their pixels.
        how: whether surfaces may change places in depth, and whether to cut the intervals into cells; else none are
            listed.
        memory_bytes: about which what is listed at a time may take.

    Source: ours.
    """
    may_cross, cut = how
    mode = blend.LIST_CELLS if cut else blend.LIST_INTERVALS
    for listings, counts in _list_tiles(sight, _view(sight, scene, ray, may_cross), mode, memory_bytes):
        yield _join(listings, scene, ray), counts


def _list_tiles(
    sight: Sight, view: View, mode: int, memory_bytes: int
) -> Iterator[tuple[list[blend.Listed], dict[str, int]]]:
    """Yield listings of some tiles at a time, and their counts."""
    offsets, prisms, load = blend.bin_prisms(sight.geometry, view)
    no_image = np.zeros((0, 0, 0, 0))

    def see(tiles: np.ndarray) -> tuple[blend.Listed, np.ndarray]:
        return blend.see_tiles(sight.geometry, view, (tiles, offsets, prisms), sight.colours, no_image, mode)

    n_jobs = max(1, int(load.sum() * BYTES_PER_LOAD / memory_bytes) + 1)
    busy = np.flatnonzero(load)
    for tiles in np.array_split(busy, min(n_jobs, max(len(busy), 1))):
        found = on_threads(see, _shares(load, _n_jobs(), tiles))
        listings = [listed for listed, _ in found if listed.size[0]]
        if listings:
            yield listings, _total([counts for _, counts in found])


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _view(sight: Sight, scene: Scene, ray: Ray, may_cross: bool) -> View:
    camera, prisms = scene.camera, sight.prisms
    place = camera.width, camera.height, ray.x_px, ray.y_px
    start, end = prisms.window
    return View(*place, float(start), float(end), prisms.orders_by_w, may_cross)


def _n_jobs() -> int:
    threads = torch.get_num_threads()
    return threads if threads == 1 else JOBS_A_THREAD * threads


def _shares(load: np.ndarray, n: int, tiles: np.ndarray | None = None) -> list[np.ndarray]:
    """Return the tiles that have any `load` dealt into at most `n` shares, each with about as much to do, row by row as
    neighbours look at the same prisms.
    """
    tiles = np.flatnonzero(load) if tiles is None else tiles
    tiles = tiles[np.argsort(-load[tiles], kind="stable")]
    return [np.sort(tiles[k::n]) for k in range(min(n, len(tiles)))]


def _total(counts: list[np.ndarray]) -> dict[str, int]:
    """Return the sums of counts by name, but the largest of the deepest pixels."""
    rows = np.array([np.zeros(len(blend.COUNTS), dtype=np.int64), *counts])
    total = dict(zip(blend.COUNTS, rows.sum(0).tolist(), strict=True))
    return total | {"deepest_pixel": int(rows[:, blend.COUNTS.index("deepest_pixel")].max())}


def _join(listings: list[blend.Listed], scene: Scene, ray: Ray) -> Listing:
    """Return the listings end to end as tensors."""

    def cat(name: str, place: int) -> Tensor:
        return torch.from_numpy(np.concatenate([getattr(x, name)[: x.size[place]] for x in listings]))

    camera = scene.camera
    pixel, n_intervals, n_cells = cat("pixel", 0).unbind(1)
    data, t, n_layers, layer = cat("data", 1), cat("t", 2), cat("n_layers", 2), cat("layer", 3)
    offsets, cell_offsets = packed.offsets_from_counts(n_intervals), packed.offsets_from_counts(n_cells)
    layer_offsets = packed.offsets_from_counts(n_layers)
    first = offsets[packed.owners(cell_offsets)]  # interval of each cell's pixel
    x_px = (pixel % camera.width).to(torch.float64) + ray.x_px
    y_px = (pixel // camera.width).to(torch.float64) + ray.y_px
    intervals = Intervals(
        offsets=offsets,
        prism=cat("prism", 1),
        t_start=data[:, T_START].contiguous(),
        t_end=data[:, T_END].contiguous(),
        near_num=data[:, NUM:DEN].T.contiguous(),
        near_den=data[:, DEN:LOW].T.contiguous(),
        ray_ndc=torch.stack([2 * x_px / camera.width - 1, 1 - 2 * y_px / camera.height]),
        spacing_ndc=(2 * ray.spacing_px / camera.width, -2 * ray.spacing_px / camera.height),
    )
    cells = Cells(
        offsets=cell_offsets,
        t_start=t[:, 0].contiguous(),
        t_end=t[:, 1].contiguous(),
        layer_offsets=layer_offsets,
        layer_interval=layer + first[packed.owners(layer_offsets)],
        n_crossings=0,
    )
    return Listing(pixel, intervals, cells)
