"""Composite each cell front to back and add the cells up over the exposure.

Before: cells.py.  After: render.py.
Symbols: C cells, L layers, M meshes, S pairs of a cell and a mesh visible in it. Colour is linear, straight in a
layer, premultiplied once composited.
Source: Ronnow et al. 2021, alg. 1 (resolve).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import packed
from torchblur.cells import Cells
from torchblur.surfaces import Surfaces


@dataclass(frozen=True)
class Composite:
    """What each cell shows, however long it is seen."""

    rgba: Tensor  # (C, 4) float64 premultiplied linear colour and opacity of the meshes
    seen_cell: Tensor  # (S,) int64 cells, once for each mesh that is visible in them
    seen_mesh: Tensor  # (S,) int64


@dataclass(frozen=True)
class Resolved:
    """The mean over the exposure for each pixel of a block."""

    premultiplied: Tensor  # (pixels, 3) float64 linear colour of the meshes alone
    alpha: Tensor  # (pixels,) float64 their mean opacity
    coverage: Tensor  # (pixels, M) float64 share of the exposure in which each mesh is visible


def composite_cells(surfaces: Surfaces, face_of_interval: Tensor, cells: Cells, cutoff: float) -> Composite:
    """Return what every cell shows, front to back.

    Args:
        surfaces: appearance of the faces.
        face_of_interval: (N,) int64 of the intervals the cells were cut from.
        cells: with layers nearest first.
        cutoff: transmittance at which a ray ends; see `packed.transmittance`.

    Accuracy: exact for flat colour and opacity; with a cut-off, see `Accuracy`.
    Gradient: to colour and opacity.
    Source: Ronnow et al. 2021, alg. 1.
    """
    face = face_of_interval[cells.layer_interval]
    alpha = surfaces.opacity[face]
    before, after = packed.transmittance(alpha, cells.layer_offsets, cutoff)
    layer_rgb = (before * alpha).unsqueeze(1) * surfaces.rgb[face]
    rgba = torch.cat([packed.sum_by_owner(layer_rgb, cells.layer_offsets), (1 - after).unsqueeze(1)], dim=1)
    n_meshes = max(1, len(surfaces.first_face))
    visible = ((before.detach() > 0) & (alpha.detach() > 0)).nonzero().flatten()
    cell = packed.owners(cells.layer_offsets)[visible]
    seen = torch.unique(cell * n_meshes + surfaces.mesh_of[face[visible]])  # a mesh counts once a cell
    return Composite(rgba, seen // n_meshes, seen % n_meshes)


def expose_cells(cells: Cells, composite: Composite, weight: Tensor, n_meshes: int) -> Resolved:
    """Return the mean of the cells of each pixel under a shutter.

    Args:
        cells: in time order.
        composite: of the same cells.
        weight: (C,) of each cell, from the shutter.
        n_meshes: M.

    Gradient: through the composite, and to the cells' times through the weight.
    Source: the rendering integral of Ronnow et al. 2021, sec. 3.
    """
    rgba = packed.sum_by_owner(weight.unsqueeze(1) * composite.rgba, cells.offsets)
    n_pixels = len(cells.offsets) - 1
    target = packed.owners(cells.offsets)[composite.seen_cell] * n_meshes + composite.seen_mesh
    coverage = weight.new_zeros(n_pixels * n_meshes).index_add(0, target, weight[composite.seen_cell])
    return Resolved(rgba[:, :3], rgba[:, 3], coverage.reshape(n_pixels, n_meshes))
