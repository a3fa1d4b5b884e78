"""Choose the times at which the cells of a ray are looked at: one for a flat cell, Gauss's nodes where texture moves.

Before: cells.py, shading.py.  After: resolve.py.
Symbols: C cells, S samples (a time in a cell and how much of it that time stands for), p panels (slices of a cell in
which no lookup bends), K pairs of a panel or cell and one of its textured layers; tau in [0, 1] is time in the cell;
texel place = P / Q with quadratics P and Q = S (sum of edge functions).
Source: Ronnow et al. 2022, eq. 1 (the quadratics); panels between texel lines and Gauss-Legendre nodes: ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchblur import bernstein, edges, packed
from torchblur.cells import Cells
from torchblur.intervals import Intervals
from torchblur.prisms import Prisms
from torchblur.shading import corner_uv
from torchblur.sort import argsort_by
from torchblur.texture import to_texels

FEW, MANY = 2, 4  # nodes of a panel: exact to degree 3 and 7 in time
NEARLY_LINEAR = 1.02  # ratio of Q over a panel below which 2 nodes are right to about 1e-10 of the contrast
MAX_RATIO = 1.25  # above it a panel is halved: 4 nodes then are right to about 1e-9 of the contrast
MAX_HALVINGS = 16  # towards an end at which Q vanishes (a face seen edge-on); the place itself stays finite there
SAME_TIME = 1e-12  # of the cell


@dataclass(frozen=True)
class Samples:
    """Times at which cells are looked at, cell by cell."""

    cell: Tensor  # (S,) int64
    t: Tensor  # (S,) float64 shutter time
    share: Tensor  # (S,) float64 of the cell's length that the sample stands for
    is_flat: Tensor  # (S,) bool: stands for its whole cell, in which nothing changes


def place_samples(prisms: Prisms, intervals: Intervals, cells: Cells, knots: tuple[Tensor, Tensor]) -> Samples:
    """Return the samples of all cells.

    Args:
        prisms: of the scene.
        intervals: from which the cells were cut.
        cells: with their visible layers.
        knots: shutter times at which a shutter bends (J,), and by how much a line delays each for every pixel
            (J, pixels); cells with moving texture are cut there too.

    Accuracy: lookups bend only between panels, so the error is that of Gauss's rule on a smooth function: about 1e-9
        of the contrast of the texture within a texel.
    Source: ours.
    """
    middle = 0.5 * (cells.t_start + cells.t_end)
    every = torch.arange(len(middle), device=middle.device)
    with torch.no_grad():
        layer_face = prisms.face_of[intervals.prism[cells.layer_interval]]
        layer = prisms.surfaces.is_textured[layer_face].nonzero().flatten()
        if len(layer) == 0:
            return Samples(every, middle, torch.ones_like(middle), torch.ones_like(every, dtype=torch.bool))
        cell = packed.owners(cells.layer_offsets)[layer]
        varying = torch.unique(cell)
        textured = _Textured.of(prisms, intervals, cells, (cell, cells.layer_interval[layer]))
        panels = _panels(textured, varying, _bends(textured, cells, knots))
        panels, ratio = _halve(textured, panels, len(middle))
        opacity = prisms.surfaces.has_varying_opacity[layer_face[layer]]
        n_opacity = torch.zeros_like(every).index_add(0, cell, opacity.long())
        parts = []
        is_easy = (ratio <= NEARLY_LINEAR) & (n_opacity[panels[0]] == 0)
        for chosen, n in ((is_easy, FEW), (~is_easy, MANY)):
            owner, start, end = (p[chosen] for p in panels)
            place, weight = (torch.as_tensor(a, device=middle.device) for a in np.polynomial.legendre.leggauss(n))
            tau = start + (end - start) * (0.5 * (place.unsqueeze(1) + 1))
            share = (end - start) * 0.5 * weight.unsqueeze(1)
            parts.append((owner.repeat(n), tau.flatten(), share.flatten()))
        is_varying = torch.zeros_like(every, dtype=torch.bool)
        is_varying[varying] = True
        rest = (~is_varying).nonzero().flatten()
        one = torch.ones_like(middle[rest])
        parts.append((rest, 0.5 * one, one))
        owner, tau, share = (torch.cat(p) for p in zip(*parts, strict=True))
        order = argsort_by(owner, tau)
        owner, tau, share = owner[order], tau[order], share[order]
    t = (1 - tau) * cells.t_start[owner] + tau * cells.t_end[owner]
    return Samples(owner, t, share, ~is_varying[owner])


def count_nodes(prisms: Prisms, intervals: Intervals, cells: Cells) -> int:
    """Return about how many lookups the layers of the cells will take: an estimate, for memory. Source: ours."""
    with torch.no_grad():
        face = prisms.face_of[intervals.prism[cells.layer_interval]]
        layer = prisms.surfaces.is_textured[face].nonzero().flatten()
        if len(layer) == 0:
            return len(cells.layer_interval)
        cell = packed.owners(cells.layer_offsets)[layer]
        textured = _Textured.of(prisms, intervals, cells, (cell, cells.layer_interval[layer]))
        lines = sum((high - low + 1).clamp(min=0) for low, high in (_lines(textured, axis) for axis in (0, 1)))
        panels = torch.zeros_like(cells.t_start).index_add(0, cell, lines + 2)
        return int((panels * cells.layer_offsets.diff()).sum()) * MANY


@dataclass(frozen=True)
class _Textured:
    """The textured layers of cells, and their places on the texture over the cell as P / Q."""

    cell: Tensor  # (K,) int64, sorted
    place: Tensor  # (2, 3, K) Bernstein coefficients of P in x and y
    scale: Tensor  # (3, K) Bernstein coefficients of Q
    low: Tensor  # (2, K) least texel line that can matter
    high: Tensor  # (2, K)

    @classmethod
    def of(cls, prisms: Prisms, intervals: Intervals, cells: Cells, layers: tuple[Tensor, Tensor]) -> _Textured:
        """Return the polynomials of layers (cell, interval) over their cells."""
        cell, interval = layers
        prism = intervals.prism[interval]
        pixel = packed.owners(intervals.offsets)[interval]
        span = (prisms.t_close - prisms.t_open)[prism]
        u_start, u_end = ((t[cell] - prisms.t_open[prism]) / span for t in (cells.t_start, cells.t_end))
        corners = edges.reduce_corners(prisms.clip, prism, intervals.ray_ndc[:, pixel]).between(u_start, u_end)
        e = edges.edge_coefficients(corners)
        face = prisms.face_of[prism]
        texel = to_texels(prisms.surfaces, face, corner_uv(prisms, prism))  # (2, 3, K)
        mesh = prisms.surfaces.mesh_of[face]
        last = (prisms.surfaces.atlas.size[:, mesh] - 1).to(torch.float64)
        repeats = prisms.surfaces.atlas.repeats[mesh]
        low, high = texel.amin(1), texel.amax(1)  # the place is a mean of the corners'
        low = torch.where(repeats, low, torch.maximum(low, torch.zeros_like(low)))
        high = torch.where(repeats, high, torch.minimum(high, last))
        return cls(cell, (e.unsqueeze(0) * texel.unsqueeze(1)).sum(2), e.sum(1), low, high)


def _bends(textured: _Textured, cells: Cells, knots: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Return the cells (B,) and times tau (B,) at which a lookup crosses a texel line, or a shutter bends."""
    owner_parts, tau_parts = [], []
    for axis in (0, 1):
        low, high = _lines(textured, axis)
        line, of = packed.expand(low.long(), (high - low + 1).clamp(min=0).long())
        c = textured.place[axis][:, of] - line * textured.scale[:, of]
        for tau in _quadratic_roots(c):
            inside = ((tau > 0) & (tau < 1)).nonzero().flatten()
            owner_parts.append(textured.cell[of[inside]])
            tau_parts.append(tau[inside])
    times, delays = knots
    cell = torch.unique(textured.cell)
    pixel = packed.owners(cells.offsets)[cell]
    for time, delay in zip(times, delays, strict=True):
        tau = (time + delay[pixel] - cells.t_start[cell]) / (cells.t_end - cells.t_start)[cell]
        inside = ((tau > 0) & (tau < 1)).nonzero().flatten()
        owner_parts.append(cell[inside])
        tau_parts.append(tau[inside])
    return torch.cat(owner_parts), torch.cat(tau_parts)


def _lines(textured: _Textured, axis: int) -> tuple[Tensor, Tensor]:
    """Return the first and the last texel line (K,) that the place may cross: P / Q lies in the hull of its ratios."""
    place, scale = textured.place[axis], textured.scale
    ratio = place / torch.where(scale != 0, scale, 1.0)
    is_proper = (scale > 0).all(0) | (scale < 0).all(0)
    low = torch.where(is_proper, torch.maximum(ratio.amin(0), textured.low[axis]), textured.low[axis])
    high = torch.where(is_proper, torch.minimum(ratio.amax(0), textured.high[axis]), textured.high[axis])
    return low.ceil(), high.floor()


def _quadratic_roots(c: Tensor) -> tuple[Tensor, Tensor]:
    """Return both roots (n,) of quadratics with Bernstein coefficients (3, n); NaN or infinite where there is none."""
    h, c2 = c[1] - c[0], c[0] - 2 * c[1] + c[2]
    q = -(h + torch.copysign(torch.sqrt(h * h - c2 * c[0]), h))
    return q / c2, c[0] / q


def _panels(textured: _Textured, varying: Tensor, bends: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return cell, start and end (p,) of the slices between the bends of the cells `varying`."""
    zero = torch.zeros(len(varying), dtype=torch.float64, device=varying.device)
    owner = torch.cat([varying, varying, bends[0]])
    tau = torch.cat([zero, zero + 1, bends[1]])
    order = argsort_by(owner, tau)
    owner, tau = owner[order], tau[order]
    real = ((owner[1:] == owner[:-1]) & (tau[1:] - tau[:-1] > SAME_TIME)).nonzero().flatten()
    start, end = tau[real], tau[real + 1]
    return owner[real], start, end


def _halve(
    textured: _Textured, panels: tuple[Tensor, Tensor, Tensor], n_cells: int
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Return panels over which Q changes by little, and by how much, as a ratio (p,)."""
    offsets = packed.offsets_from_owners(textured.cell, n_cells)
    done, ratios = [], []
    for k in range(MAX_HALVINGS + 1):
        owner, start, end = panels
        layer, of = packed.expand(offsets[owner], offsets.diff()[owner])
        q = bernstein.restrict(textured.scale[:, layer], start[of], end[of])
        is_proper = (q > 0).all(0) | (q < 0).all(0)
        steep = torch.where(is_proper, q.abs().amax(0) / torch.where(is_proper, q.abs().amin(0), 1.0), torch.inf)
        ratio = torch.ones_like(start).scatter_reduce(0, of, steep, "amax")
        ready = (ratio <= MAX_RATIO) if k < MAX_HALVINGS else torch.ones_like(ratio, dtype=torch.bool)
        done.append(tuple(p[ready] for p in panels))
        ratios.append(ratio[ready])
        owner, start, end = (p[~ready] for p in panels)
        if len(owner) == 0:
            break
        middle = 0.5 * (start + end)
        panels = torch.cat([owner, owner]), torch.cat([start, middle]), torch.cat([middle, end])
    return tuple(torch.cat(p) for p in zip(*done, strict=True)), torch.cat(ratios)
