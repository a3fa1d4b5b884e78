"""Choose the times at which the cells of a ray are looked at: one for a flat cell, Gauss's nodes where looks vary.

Before: texture_bends.py, light_bends.py, resting.py.  After: resolve.py.
Symbols: C cells, S samples (a time in a cell and how much of it that time stands for), spans (see paths.py), p panels
(slices of a span in which no look bends). Panels get as many nodes as certificate.py asks for; those for which the most
do not suffice are halved, towards a time at which a divider vanishes at most MAX_HALVINGS times.
Source: Gauss-Legendre quadrature; ours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from torchblur import packed
from torchblur.blocking import Receivers
from torchblur.cells import Cells
from torchblur.certificate import SCALE_LIMIT, VECTOR_LIMIT, Divider, nodes_needed
from torchblur.intervals import Intervals
from torchblur.light_bends import LightPaths
from torchblur.paths import Paths, cut_spans, follow
from torchblur.prisms import Prisms
from torchblur.resting import Resting
from torchblur.shadows import Shadows, find_shadows
from torchblur.sort import SAME_TIME, argsort_by, between
from torchblur.surfaces import Surfaces
from torchblur.texture_bends import TexturePaths

COUNTS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16)  # nodes of a panel
FEW, FEW_LIT = 3, 8  # nodes that panels of textured and of lit layers take on average, or fewer
BYTES_PER_LOOK = 900  # of place_samples and composite_samples, a layer of a sample, with textures and lights
BYTES_PER_LAYER = 400  # the same, with neither
BYTES_TO_CUT = 260  # of cut_cells, a layer
BYTES_PER_PATH, BYTES_PER_LIGHT = 2500, 1200  # of find_varying, a layer with texture or light, and each light on it
MAX_HALVINGS = 16  # towards a time at which a q vanishes (a face seen edge-on); what is looked at stays finite there
MANY, FREE_HALVINGS = 64, 8  # panels of a span that may fail after so many halvings; more are rounding, and accepted


@dataclass(frozen=True)
class Samples:
    """Times at which cells are looked at, cell by cell."""

    cell: Tensor  # (S,) int64
    t: Tensor  # (S,) float64 shutter time
    length: Tensor  # (S,) float64 shutter time that the sample stands for
    is_flat: Tensor  # (S,) bool: stands for its whole cell, in which nothing changes
    span: Tensor  # (S,) int64 the span in which it lies; 0 where flat
    tau: Tensor  # (S,) float64 share of the span


@dataclass(frozen=True)
class Varying:
    """What varies within cells: the paths of their layers whose look depends on time, over spans; and those at rest."""

    cell: Tensor  # (n,) int64 cell of each span
    start: Tensor  # (n,) share of the cell
    end: Tensor  # (n,)
    paths: Paths
    textured: TexturePaths
    which_textured: Tensor  # which of the paths
    lit: LightPaths
    which_lit: Tensor
    is_followed: Tensor  # (L,) bool of all layers in the cells, whether they have a path
    rests: Tensor  # (L,) bool, whether they have none but shadows may change them
    resting: Resting
    shadows: Shadows | None = None  # of the lit paths, and after them of what rests, once they have been found

    @property
    def span_of_receivers(self) -> Tensor:
        """The span of each receiver: of the lit paths, and after them of what rests."""
        return torch.cat([self.lit.paths.span, self.resting.span])

    def receivers(self) -> Receivers:
        """Return the lit paths, and after them what rests, as what light falls on. Source: ours."""
        parts = self.lit.receivers(), self.resting.receivers
        fields = ((getattr(p, name) for p in parts) for name in ("place", "scale", "t", "face", "rests"))
        return Receivers(*(torch.cat(list(f), dim=-1) for f in fields))

    def due(self, prisms: Prisms) -> tuple[Tensor, ...]:
        """Return light by light (receivers,) bool: False where the surface faces away at all times. Source: ours."""
        pairs = zip(self.lit.due(prisms), self.resting.due, strict=True)
        return tuple(torch.cat(pair) for pair in pairs)

    def receivers_of(self, cells: Cells, layer: Tensor, span: Tensor) -> Tensor:
        """Return which of the receivers layers (n,) are over the spans (n,) in whose cells they are; -1 for none.

        Args:
            cells: in which the layers are.
            layer: of all.
            span: of these.

        Source: ours.
        """
        lit = torch.full((len(self.paths.span) + 1,), -1, dtype=torch.int64, device=span.device)
        lit[self.which_lit] = torch.arange(len(self.which_lit), device=span.device)
        found = torch.full_like(span, -1)
        kinds = (self.is_followed, self.paths.span), (self.rests, self.resting.span)
        for k, (is_one, span_of) in enumerate(kinds):
            before = packed.offsets_from_counts(is_one.long())
            own = is_one[layer].nonzero().flatten()
            of = span[own]
            rank = before[layer[own]] - before[cells.layer_offsets[self.cell[of]]]
            place = packed.offsets_from_owners(span_of, len(self.cell))[of] + rank
            found[own] = lit[place] if k == 0 else len(self.which_lit) + place
        return found


def middle_samples(cells: Cells) -> Samples:
    """Return one sample for each cell, in its middle: exact where nothing changes within cells. Source: ours."""
    every = torch.arange(len(cells.t_start), device=cells.t_start.device)
    middle = 0.5 * (cells.t_start + cells.t_end)
    one = torch.ones_like(middle)
    is_flat = torch.ones_like(every, dtype=torch.bool)
    return Samples(every, middle, cells.t_end - cells.t_start, is_flat, torch.zeros_like(every), 0.5 * one)


@torch.no_grad()
def find_varying(prisms: Prisms, intervals: Intervals, cells: Cells, knots: tuple[Tensor, Tensor]) -> Varying | None:
    """Return what varies within the cells, None if nothing does.

    Args:
        prisms: of the scene.
        intervals: from which the cells were cut.
        cells: with their visible layers.
        knots: see `paths.cut_spans`.

    Source: ours.
    """
    surfaces = prisms.surfaces
    face = prisms.face_of[intervals.prism[cells.layer_interval]]
    is_varying, rests = surfaces.is_varying[face], surfaces.rests[face]
    if not is_varying.any():
        return None
    spans, is_followed = cut_spans(prisms, cells, is_varying, knots), is_varying & ~rests
    paths = follow(prisms, intervals, cells, spans, is_followed)
    which_textured = surfaces.is_textured[paths.face].nonzero().flatten()
    is_lit = surfaces.is_lit[paths.face] if surfaces.lights else torch.zeros_like(paths.span, dtype=torch.bool)
    which_lit = is_lit.nonzero().flatten()
    return Varying(
        cell=spans.cell,
        start=spans.start,
        end=spans.end,
        paths=paths,
        textured=TexturePaths.of(prisms, paths.choose(which_textured)),
        which_textured=which_textured,
        lit=LightPaths.of(prisms, paths.choose(which_lit)),
        which_lit=which_lit,
        is_followed=is_followed,
        rests=rests,
        resting=Resting.of(prisms, intervals, cells, spans, rests),
    )


@torch.no_grad()
def add_shadows(prisms: Prisms, varying: Varying) -> Varying:
    """Return what varies with the shadows on it, where there are any. Source: ours."""
    if prisms.surfaces.casters is None or len(varying.span_of_receivers) == 0:
        return varying
    return replace(varying, shadows=find_shadows(prisms.surfaces, varying.receivers(), varying.due(prisms)))


@torch.no_grad()
def estimate_bytes(prisms: Prisms, cells: Cells, varying: Varying | None) -> Tensor:
    """Return about how much memory the samples of each pixel (pixels,) take at their peak [bytes]. Source: ours."""
    n_layers = cells.layer_offsets.diff().to(torch.float64)
    surfaces = prisms.surfaces
    if varying is None:
        is_plain = not (surfaces.is_textured | surfaces.is_lit).any()
        of_cell = n_layers * (BYTES_PER_LAYER if is_plain else BYTES_PER_LOOK)
    else:
        lines = varying.textured.count_lines(prisms)
        panels = torch.ones_like(varying.start).index_add(0, varying.textured.paths.span, lines)
        nodes = torch.full_like(panels, FEW)
        nodes[varying.lit.paths.span] = FEW_LIT
        if varying.shadows is not None:
            which, _ = varying.shadows.ends(surfaces)
            panels = panels + torch.bincount(varying.span_of_receivers[which], minlength=len(panels))
        of_cell = n_layers * BYTES_PER_LAYER
        of_cell = of_cell.index_add(0, varying.cell, panels * nodes * n_layers[varying.cell] * BYTES_PER_LOOK)
    return packed.sum_by_owner(of_cell, cells.offsets)


def estimate_path_bytes(surfaces: Surfaces, layers: Tensor, n_intervals: Tensor, n_knots: int) -> Tensor:
    """Return about how much memory `cut_cells` and `find_varying` take at their peak, by pixel (pixels,) [bytes].

    Args:
        surfaces: what the faces look like: those with texture or light have paths, one for each slice of a cell.
        layers: (pixels,) of all cells.
        n_intervals: (pixels,) which make at most twice as many cells.
        n_knots: of shutters and lights inside the exposure: each cuts one cell of a pixel more.

    Source: ours.
    """
    paths = 0
    if surfaces.is_textured.any():
        paths += BYTES_PER_PATH
    if surfaces.is_lit.any():
        paths += BYTES_PER_PATH + BYTES_PER_LIGHT * len(surfaces.lights)
    depth = layers / (2 * n_intervals - 1).clamp(min=1)
    return layers * float(BYTES_TO_CUT + paths) + depth * float(n_knots * paths)


@torch.no_grad()
def place_samples(prisms: Prisms, cells: Cells, varying: Varying | None) -> Samples:
    """Return the samples of all cells.

    Args:
        prisms: of the scene.
        cells: with their visible layers.
        varying: of `find_varying`.

    Accuracy: certificate.TOLERANCE, certified.
    Gradient: of times and lengths to the cells' ends. A knot, which cuts a cell at a fixed time, does not move with
        them, nor does the edge of a shadow; bends may, since there looks only bend.
    Source: Gauss-Legendre quadrature; ours.
    """
    if varying is None:
        return middle_samples(cells)
    device = cells.t_start.device
    panels = _cut_panels(prisms, varying)
    owner, start, end, n_nodes = _count_nodes(prisms, varying, panels)
    parts = [], [], []
    for n in COUNTS:
        chosen = (n_nodes == n).nonzero().flatten()
        place, weight = (torch.as_tensor(a, device=device).unsqueeze(1) for a in _gauss(n))
        zero = torch.zeros_like(start[chosen])
        for values, more in zip(parts, (chosen, 0.5 * (place + 1) + zero, 0.5 * weight + zero), strict=True):
            values.append(more.expand(n, len(chosen)).flatten())
    panel, within, share = (torch.cat(values) for values in parts)
    is_flat = torch.ones(len(cells.t_start), dtype=torch.bool, device=device)
    is_flat[varying.cell] = False
    rest = is_flat.nonzero().flatten()
    half = torch.full((len(rest),), 0.5, dtype=torch.float64, device=device)
    span = torch.cat([owner[panel], torch.zeros_like(rest)])
    owner_cell = torch.cat([varying.cell[owner[panel]], rest])
    tau = torch.cat([start[panel] + within * (end - start)[panel], half])
    within, share = torch.cat([within, half]), torch.cat([share, 2 * half])
    with torch.enable_grad():
        ends = _panel_ends(cells, varying, (owner, start, end))
        first, last = (torch.cat([e[panel], c[rest]]) for e, c in zip(ends, (cells.t_start, cells.t_end), strict=True))
        t, length = (1 - within) * first + within * last, share * (last - first)
        order = argsort_by(owner_cell, t.detach())
        found = (owner_cell, t, length, is_flat[owner_cell], span, tau)
        return Samples(*(part[order] for part in found))


def _panel_ends(cells: Cells, varying: Varying, panels: tuple[Tensor, Tensor, Tensor]) -> list[Tensor]:
    """Return the shutter times (p,) at which panels (span, start, end) start and end; inside a span on which shadows
    fall they do not move with the cell, as what they part is not the same.
    """
    span, *shares = panels
    first, last = (end[span] for end in _span_ends(cells, varying))
    ends = []
    for share in shares:
        t = (1 - share) * first + share * last
        ends.append(t if varying.shadows is None else torch.where((share > 0) & (share < 1), t.detach(), t))
    return ends


def _span_ends(cells: Cells, varying: Varying) -> tuple[Tensor, Tensor]:
    """Return the shutter times (n,) at which spans start and end, moving where these are the cell's own ends."""
    t_start, t_end = cells.t_start[varying.cell], cells.t_end[varying.cell]
    start, end = ((1 - s) * t_start.detach() + s * t_end.detach() for s in (varying.start, varying.end))
    is_first, is_last = varying.start <= SAME_TIME, varying.end >= 1 - SAME_TIME  # as spans so short are left out
    return torch.where(is_first, t_start, start), torch.where(is_last, t_end, end)


def _asks_for_slopes(prisms: Prisms) -> bool:
    """Return whether what looks follow in time asks for gradients."""
    lights = [tensor for light in prisms.surfaces.lights for tensor in light.tensors().values()]
    return any(x.requires_grad for x in (prisms.clip, prisms.world, prisms.normal, prisms.surfaces.uv, *lights))


@cache
def _gauss(n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.polynomial.legendre.leggauss(n)


def _cut_panels(prisms: Prisms, varying: Varying) -> tuple[Tensor, Tensor, Tensor]:
    """Return span, start and end (p,) of the slices between the bends."""
    every = torch.arange(len(varying.cell), device=varying.cell.device)
    owners, taus = [every, every], [torch.zeros_like(varying.start), torch.ones_like(varying.start)]
    for curves in (varying.textured, varying.lit):
        which, tau = curves.bends(prisms)
        inside = ((tau > 0) & (tau < 1)).nonzero().flatten()
        owners.append(curves.paths.span[which[inside]])
        taus.append(tau[inside])
    if varying.shadows is not None:
        which, tau = varying.shadows.ends(prisms.surfaces)
        owners.append(varying.span_of_receivers[which])
        taus.append(tau)
    return between(torch.cat(owners), torch.cat(taus))


def _dividers(prisms: Prisms, varying: Varying) -> list[Divider]:
    """Return what the looks divide by."""
    textured, lit = varying.textured, varying.lit
    scaled = torch.zeros_like(varying.paths.span, dtype=torch.bool)
    scaled[varying.which_textured] = True
    if any(lit.is_near):
        scaled[varying.which_lit] = True
    scaled = scaled.nonzero().flatten()
    found = [Divider(varying.paths.span[scaled], varying.paths.scale[:, scaled].unsqueeze(1), SCALE_LIMIT)]
    found.append(Divider(textured.paths.span[textured.mipped], textured.slope, VECTOR_LIMIT))
    found += lit.dividers(prisms)
    return [f for f in found if len(f.span)]


def _count_nodes(
    prisms: Prisms, varying: Varying, panels: tuple[Tensor, Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return panels, halved where necessary, and their numbers of nodes (p,)."""
    n_spans, slopes = len(varying.cell), _asks_for_slopes(prisms)
    dividers, lookup = _dividers(prisms, varying), varying.textured.finest_lookup(prisms)
    counts = torch.tensor([*COUNTS, COUNTS[-1]], device=varying.start.device)
    done = []
    for k in range(MAX_HALVINGS + 1):
        span, start, end = panels
        needed = nodes_needed(dividers, lookup, panels, n_spans, slopes)
        place = torch.searchsorted(counts[:-1].to(needed.dtype), needed)
        is_ready = place < len(COUNTS)
        if k >= FREE_HALVINGS:
            failing = torch.bincount(span[~is_ready], minlength=n_spans)
            is_ready |= failing[span] > MANY
        if k == MAX_HALVINGS:
            is_ready = torch.ones_like(is_ready)
        done.append((span[is_ready], start[is_ready], end[is_ready], counts[place[is_ready]]))
        span, start, end = (p[~is_ready] for p in panels)
        if len(span) == 0:
            break
        middle = 0.5 * (start + end)
        panels = torch.cat([span, span]), torch.cat([start, middle]), torch.cat([middle, end])
    return tuple(torch.cat(parts) for parts in zip(*done, strict=True))
