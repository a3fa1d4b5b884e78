"""Choose the times at which the cells of a ray are looked at: one for a flat cell, Gauss's nodes where looks vary.

Before: texture_bends.py, light_bends.py.  After: resolve.py.
Symbols: C cells, S samples (a time in a cell and how much of it that time stands for), spans (see paths.py), p
panels (slices of a span in which no look bends), n nodes of a panel, d the degree of a look in texels; q vectors of
polynomials that looks divide by: S, footprints, normals, vectors to lights.

Certificate: on a panel, look at q through its Chebyshev coefficients c_0, c_1, ... On the ellipse about the panel
whose semi-axes add up to rho, q leaves c_0 by at most sum_k>0 |c_k| (rho^k + rho^-k) / 2. Where that is a set share of
|c_0| for all q, the looks are analytic inside the ellipse and grow by at most (1 + rho / 2)^d, and Gauss's rule errs by
at most BOUND (1 + rho / 2)^d rho^(-2 n) (Trefethen, theorem 19.3). Panels get the fewest nodes for which that is below
TOLERANCE; those for which the most do not suffice are halved.
Source: Trefethen 2013, Approximation Theory and Approximation Practice (Gauss's rule on analytic functions); ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from torchblur import bernstein, packed
from torchblur.cells import Cells
from torchblur.intervals import Intervals
from torchblur.light_bends import LightPaths
from torchblur.paths import Paths, between, cut_spans, follow
from torchblur.prisms import Prisms
from torchblur.shading import needing_points
from torchblur.sort import argsort_by
from torchblur.texture_bends import TexturePaths

COUNTS = (1, 2, 3, 4, 6, 8, 12, 16)  # nodes of a panel
TOLERANCE = 1e-6  # of what is looked at: the contrast of a texture between neighbours, the light on a facing surface
BOUND = 40.0  # 64 / 15 / 2 times the most by which a look can exceed its size while all q stay within their shares
ROUNDING = 1e-13  # of the mean of a q: smaller coefficients are rounding
SCALE_LIMIT = 0.5  # share of its mean by which S may vary
MAX_DEGREE = 15  # of a look: six layers with textured opacity in a cell; beyond, the certificate is a rule of thumb
FEW, FEW_LIT = 3, 8  # nodes that panels of textured and of lit layers take on average, or fewer
BYTES_PER_LOOK = 900  # of place_samples and composite_samples, a layer of a sample, with textures and lights
BYTES_PER_LAYER = 400  # the same, with neither
MAX_HALVINGS = 16  # towards a time at which a q vanishes (a face seen edge-on); what is looked at stays finite there
MANY, FREE_HALVINGS = 8, 4  # panels of a span that may fail after so many halvings; more are noise, and accepted


@dataclass(frozen=True)
class Samples:
    """Times at which cells are looked at, cell by cell."""

    cell: Tensor  # (S,) int64
    t: Tensor  # (S,) float64 shutter time
    share: Tensor  # (S,) float64 of the cell's length that the sample stands for
    is_flat: Tensor  # (S,) bool: stands for its whole cell, in which nothing changes


@dataclass(frozen=True)
class Varying:
    """What varies within cells: the paths of their layers with texture or light, over spans."""

    cell: Tensor  # (n,) int64 cell of each span
    start: Tensor  # (n,) share of the cell
    end: Tensor  # (n,)
    degree: Tensor  # (n,) int64 of the looks of the span's cell
    paths: Paths
    textured: TexturePaths
    which_textured: Tensor  # which of the paths
    lit: LightPaths
    which_lit: Tensor


def middle_samples(cells: Cells) -> Samples:
    """Return one sample for each cell, in its middle: exact where nothing changes within cells. Source: ours."""
    every = torch.arange(len(cells.t_start), device=cells.t_start.device)
    middle = 0.5 * (cells.t_start + cells.t_end)
    return Samples(every, middle, torch.ones_like(middle), torch.ones_like(every, dtype=torch.bool))


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
    if len(needing_points(surfaces, face)) == 0:
        return None
    spans = cut_spans(prisms, intervals, cells, knots)
    paths = follow(prisms, intervals, cells, spans)
    which_textured = surfaces.is_textured[paths.face].nonzero().flatten()
    is_lit = surfaces.is_lit[paths.face] if surfaces.lights else torch.zeros_like(paths.span, dtype=torch.bool)
    which_lit = is_lit.nonzero().flatten()
    textured = TexturePaths.of(prisms, paths.choose(which_textured))
    span = textured.paths.span
    own = torch.zeros_like(spans.cell).scatter_reduce(0, span, torch.full_like(span, 2), "amax")
    own.scatter_reduce_(0, span[textured.mipped], torch.full_like(textured.mipped, 3), "amax")
    varies = surfaces.has_varying_opacity[textured.paths.face].long()
    return Varying(
        cell=spans.cell,
        start=spans.start,
        end=spans.end,
        degree=(own.index_add(0, span, 2 * varies) + 1).clamp(max=MAX_DEGREE),  # 1 for the shutter
        paths=paths,
        textured=textured,
        which_textured=which_textured,
        lit=LightPaths.of(prisms, paths.choose(which_lit)),
        which_lit=which_lit,
    )


@torch.no_grad()
def estimate_bytes(prisms: Prisms, cells: Cells, varying: Varying | None) -> int:
    """Return about how much memory the samples of the cells will take at their peak [bytes]. Source: ours."""
    n_layers = cells.layer_offsets.diff()
    total = int(n_layers.sum())
    surfaces = prisms.surfaces
    if varying is None:
        return total * (BYTES_PER_LOOK if (surfaces.is_textured | surfaces.is_lit).any() else BYTES_PER_LAYER)
    lines = varying.textured.count_lines(prisms)
    panels = torch.ones_like(varying.start).index_add(0, varying.textured.paths.span, lines)
    nodes = torch.full_like(panels, FEW)
    nodes[varying.lit.paths.span] = FEW_LIT
    return total * BYTES_PER_LAYER + int((panels * nodes * n_layers[varying.cell]).sum()) * BYTES_PER_LOOK


@torch.no_grad()
def place_samples(prisms: Prisms, cells: Cells, varying: Varying | None) -> Samples:
    """Return the samples of all cells.

    Args:
        prisms: of the scene.
        cells: with their visible layers.
        varying: of `find_varying`.

    Accuracy: TOLERANCE, certified; see the top of the file.
    Source: Trefethen 2013; ours.
    """
    if varying is None:
        return middle_samples(cells)
    device = cells.t_start.device
    panels = _cut_panels(prisms, varying)
    owner, start, end, n_nodes = _count_nodes(_dividers(prisms, varying), varying, panels)
    owners, taus, shares = [], [], []
    for n in COUNTS:
        chosen = (n_nodes == n).nonzero().flatten()
        place, weight = (torch.as_tensor(a, device=device) for a in _gauss(n))
        length = (end - start)[chosen]
        owners.append(owner[chosen].repeat(n))
        taus.append((start[chosen] + length * (0.5 * (place.unsqueeze(1) + 1))).flatten())
        shares.append((length * (0.5 * weight.unsqueeze(1))).flatten())
    span, tau, share = torch.cat(owners), torch.cat(taus), torch.cat(shares)
    length = varying.end - varying.start
    is_varying = torch.zeros(len(cells.t_start), dtype=torch.bool, device=device)
    is_varying[varying.cell] = True
    rest = (~is_varying).nonzero().flatten()
    one = torch.ones(len(rest), dtype=torch.float64, device=device)
    owner = torch.cat([varying.cell[span], rest])
    tau = torch.cat([varying.start[span] + tau * length[span], 0.5 * one])
    share = torch.cat([share * length[span], one])
    order = argsort_by(owner, tau)
    owner, tau, share = owner[order], tau[order], share[order]
    with torch.enable_grad():
        t = (1 - tau) * cells.t_start[owner] + tau * cells.t_end[owner]
    return Samples(owner, t, share, ~is_varying[owner])


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
    return between(torch.cat(owners), torch.cat(taus))


def _dividers(prisms: Prisms, varying: Varying) -> list[tuple[Tensor, Tensor, float]]:
    """Return the q: the spans (m,) they belong to, sorted, coefficients (d + 1, c, m), and how far they may vary."""
    textured, lit = varying.textured, varying.lit
    scaled = torch.zeros_like(varying.paths.span, dtype=torch.bool)
    scaled[varying.which_textured] = True
    if any(lit.is_near):
        scaled[varying.which_lit] = True
    scaled = scaled.nonzero().flatten()
    found = [(varying.paths.span[scaled], varying.paths.scale[:, scaled].unsqueeze(1), SCALE_LIMIT)]
    found.append((textured.paths.span[textured.mipped], textured.slope, SCALE_LIMIT / 2))
    found += [(lit.paths.span[which], q, limit) for which, q, limit in lit.smooth_vectors(prisms)]
    return [f for f in found if len(f[0])]


def _count_nodes(
    dividers: list[tuple[Tensor, Tensor, float]], varying: Varying, panels: tuple[Tensor, Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return panels, halved where necessary, and their numbers of nodes (p,)."""
    n_spans = len(varying.cell)
    offsets = [packed.offsets_from_owners(owner, n_spans) for owner, _, _ in dividers]
    table = torch.tensor(_least_rho(), dtype=torch.float64, device=varying.start.device)  # (counts, degrees)
    counts = torch.tensor([*COUNTS, COUNTS[-1]], device=table.device)
    done = []
    for k in range(MAX_HALVINGS + 1):
        span, start, end = panels
        rho = table[:, varying.degree[span]]  # (counts, p)
        passes = torch.isfinite(rho)
        for (_, q, limit), own in zip(dividers, offsets, strict=True):
            index, of = packed.expand(own[span], own.diff()[span])
            sizes = _chebyshev_sizes(bernstein.restrict(q[..., index], start[of], end[of]))
            for i in range(len(COUNTS)):
                fails = _tail(sizes, rho[i, of]) > limit * sizes[0]
                passes[i, of[fails]] = False
        place = (~passes).long().cumprod(0).sum(0)  # of the first count that passes
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


def _chebyshev_sizes(q: Tensor) -> Tensor:
    """Return (d + 1, m) the lengths of the Chebyshev coefficients of vectors (d + 1, c, m) in Bernstein form."""
    to_chebyshev = torch.as_tensor(_chebyshev_matrix(len(q) - 1), device=q.device)
    return torch.einsum("kj,jcm->kcm", to_chebyshev, q).norm(dim=1)


@cache
def _chebyshev_matrix(degree: int) -> np.ndarray:
    """Return the (d + 1, d + 1) matrix from Bernstein to Chebyshev coefficients on the same range."""
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    u = 0.5 * (nodes + 1)
    binomial = np.cumprod([1.0, *((degree - k) / (k + 1) for k in range(degree))])
    values = np.stack([binomial[k] * u**k * (1 - u) ** (degree - k) for k in range(degree + 1)], axis=1)
    chebyshev = np.stack([np.cos(k * np.arccos(nodes)) for k in range(degree + 1)], axis=1)
    return np.linalg.solve(chebyshev, values)


def _tail(sizes: Tensor, rho: Tensor) -> Tensor:
    """Return (m,) the most by which a q can leave its mean on the ellipse of `rho` (m,)."""
    total = torch.zeros_like(rho)
    for k in range(1, len(sizes)):
        grown = 0.5 * sizes[k] * (rho**k + rho**-k)
        total = total + torch.where(sizes[k] > ROUNDING * sizes[0], grown, 0.0)
    return total


@cache
def _least_rho() -> list[list[float]]:
    """Return the least rho for each of COUNTS and degrees 0 to MAX_DEGREE; infinite where no rho suffices."""
    rows = []
    for n in COUNTS:
        row = []
        for degree in range(MAX_DEGREE + 1):
            grid = np.geomspace(1.01, 1e9, 4001)
            fits = BOUND * (1 + grid / 2) ** degree * grid ** (-2.0 * n) / (1 - grid**-2) <= TOLERANCE
            row.append(float(grid[fits.argmax()]) if fits.any() else np.inf)
        rows.append(row)
    return rows
