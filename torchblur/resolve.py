"""Composite each sample front to back and add the samples up over the exposure.

Before: nodes.py.  After: render.py.
Symbols: S samples, L layers in them, M meshes, V pairs of a sample and a mesh visible in it. Colour is linear, straight
in a layer, premultiplied once composited.
Source: Ronnow et al. 2021, alg. 1 (resolve).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import packed
from torchblur.accuracy import Accuracy
from torchblur.averages import look_over
from torchblur.cells import Cells
from torchblur.intervals import Intervals
from torchblur.nodes import Samples
from torchblur.prisms import Prisms
from torchblur.shading import look, needing_points, points_on_prisms
from torchblur.shutter import Shutter


@dataclass(frozen=True)
class Composite:
    """What each sample shows, however long it is seen."""

    rgba: Tensor  # (S, 4) float64 premultiplied linear colour and opacity of the meshes
    seen_sample: Tensor  # (V,) int64 samples, once for each mesh that is visible in them
    seen_mesh: Tensor  # (V,) int64


@dataclass(frozen=True)
class Resolved:
    """The mean over the exposure for each pixel of a block."""

    premultiplied: Tensor  # (pixels, 3) float64 linear colour of the meshes alone
    alpha: Tensor  # (pixels,) float64 their mean opacity
    coverage: Tensor  # (pixels, M) float64 share of the exposure in which each mesh is visible


def composite_samples(
    prisms: Prisms, intervals: Intervals, cells: Cells, samples: Samples, accuracy: Accuracy
) -> Composite:
    """Return what every sample shows, front to back.

    Args:
        prisms: of the scene.
        intervals: from which the cells were cut.
        cells: with layers nearest first.
        samples: of the cells.
        accuracy: whether layers are looked at at the samples' times, or on average over the cells; where rays end.

    Accuracy: exactly, opacities are multiplied at each time, never their means; else see `Accuracy`.
    Gradient: to colour, opacity, texture, normals, lights, and through the samples' times.
    Source: Ronnow et al. 2021, alg. 1.
    """
    counts = cells.layer_offsets.diff()[samples.cell]
    layer, sample = packed.expand(cells.layer_offsets[samples.cell], counts)
    offsets = packed.offsets_from_counts(counts)
    surfaces, interval = prisms.surfaces, cells.layer_interval[layer]
    face = prisms.face_of[intervals.prism[interval]]
    if accuracy.method == "exact":
        which = needing_points(surfaces, face)
        points = points_on_prisms(prisms, intervals, interval[which], samples.t[sample[which]])
        rgb, alpha = look(surfaces, face, which, points)
    else:
        rgb, alpha = look_over(prisms, intervals, cells, (samples.cell[sample], interval))
    before, after = packed.transmittance(alpha, offsets, accuracy.transmittance_cutoff)
    light = packed.sum_by_owner((before * alpha).unsqueeze(1) * rgb, offsets)
    n_meshes = max(1, len(surfaces.first_face))
    visible = ((before.detach() > 0) & (alpha.detach() > 0)).nonzero().flatten()
    seen = torch.unique(sample[visible] * n_meshes + surfaces.mesh_of[face[visible]])  # a mesh counts once
    return Composite(torch.cat([light, (1 - after).unsqueeze(1)], dim=1), seen // n_meshes, seen % n_meshes)


def weigh_samples(shutter: Shutter, cells: Cells, samples: Samples, line: Tensor) -> Tensor:
    """Return the weight (S,) of each sample under a shutter.

    Args:
        shutter: whose bends lie between the samples' panels.
        cells: of the samples.
        samples: one for a flat cell, Gauss's nodes for the others.
        line: (S,) line of the image that each sample belongs to.

    Gradient: to the cells' times.
    Source: ours.
    """
    start, end = cells.t_start[samples.cell], cells.t_end[samples.cell]
    whole = shutter.weight(start, end, line)
    if samples.is_flat.all():
        return whole
    return torch.where(samples.is_flat, whole, samples.length * shutter.density(samples.t, line))


def expose_samples(offsets: Tensor, composite: Composite, weight: Tensor, n_meshes: int) -> Resolved:
    """Return the mean of the samples of each pixel.

    Args:
        offsets: (pixels + 1,) of the samples.
        composite: of the samples.
        weight: (S,) of each sample.
        n_meshes: M.

    Gradient: through composite and weight.
    Source: the rendering integral of Ronnow et al. 2021, sec. 3.
    """
    rgba = packed.sum_by_owner(weight.unsqueeze(1) * composite.rgba, offsets)
    n_pixels = len(offsets) - 1
    target = packed.owners(offsets)[composite.seen_sample] * n_meshes + composite.seen_mesh
    coverage = weight.new_zeros(n_pixels * n_meshes).index_add(0, target, weight[composite.seen_sample])
    return Resolved(rgba[:, :3], rgba[:, 3], coverage.reshape(n_pixels, n_meshes))
