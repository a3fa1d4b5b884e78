"""Composite each cell front to back and add the cells up over the exposure.

Before: cells.py.  After: render.py.
Symbols: C cells, L layers, M meshes. Colour is linear, straight in a layer, premultiplied once composited.
Source: Ronnow et al. 2021, alg. 1 (resolve).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import packed
from torchblur.cells import Cells
from torchblur.shutter import Shutter
from torchblur.surfaces import Surfaces


@dataclass(frozen=True)
class Resolved:
    """The mean over the exposure for each pixel of a block."""

    premultiplied: Tensor  # (pixels, 3) float64 linear colour of the meshes alone
    alpha: Tensor  # (pixels,) float64 their mean opacity
    coverage: Tensor  # (pixels, M) float64 share of the exposure in which each mesh is visible


def resolve_cells(
    surfaces: Surfaces, face_of_interval: Tensor, cells: Cells, shutter: Shutter, cutoff: float
) -> Resolved:
    """Return colour, alpha and coverage of every pixel.

    Args:
        surfaces: appearance of the faces.
        face_of_interval: (N,) int64 of the intervals the cells were cut from.
        cells: with layers nearest first.
        shutter: weight of a cell.
        cutoff: transmittance at which a ray ends; see `packed.transmittance`.

    Accuracy: exact for flat colour and opacity; with a cut-off, see `Accuracy`.
    Gradient: to colour, opacity, and through the cells' times.
    Source: Ronnow et al. 2021, alg. 1.
    """
    face = face_of_interval[cells.layer_interval]
    alpha = surfaces.opacity[face]
    before, after = packed.transmittance(alpha, cells.layer_offsets, cutoff)
    weight = shutter.weight(cells.t_start, cells.t_end)
    layer_rgb = (before * alpha).unsqueeze(1) * surfaces.rgb[face]
    cell_rgba = torch.cat([packed.sum_by_owner(layer_rgb, cells.layer_offsets), (1 - after).unsqueeze(1)], dim=1)
    rgba = packed.sum_by_owner(weight.unsqueeze(1) * cell_rgba, cells.offsets)
    n_meshes = len(surfaces.first_face)
    visible = ((before.detach() > 0) & (alpha.detach() > 0)).nonzero().flatten()
    coverage = _coverage(cells, weight, (visible, surfaces.mesh_of[face[visible]]), n_meshes)
    return Resolved(rgba[:, :3], rgba[:, 3], coverage)


def _coverage(cells: Cells, weight: Tensor, visible: tuple[Tensor, Tensor], n_meshes: int) -> Tensor:
    """Return (pixels, M) the time in which at least one visible layer belongs to each mesh."""
    layer, mesh = visible
    n_pixels = len(cells.offsets) - 1
    cell_of_layer = packed.owners(cells.layer_offsets)[layer]
    key = torch.unique(cell_of_layer * n_meshes + mesh)
    cell = key // max(n_meshes, 1)
    target = packed.owners(cells.offsets)[cell] * n_meshes + key % max(n_meshes, 1)
    total = weight.new_zeros(n_pixels * n_meshes).index_add(0, target, weight[cell])
    return total.reshape(n_pixels, n_meshes)
