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
from torchblur.nodes import Samples, Varying
from torchblur.prisms import Prisms
from torchblur.shading import look, needing_points, points_on_prisms
from torchblur.shadows import with_shadows
from torchblur.shutter import Shutter


@dataclass(frozen=True)
class Composite:
    """What each sample shows, however long it is seen."""

    rgba: Tensor  # (S, 4) float64 premultiplied linear colour and opacity of the meshes
    light: Tensor  # (S, 2) float64 direct light that visible surfaces would get without shadows, and that they get
    seen_sample: Tensor  # (V,) int64 samples, once for each mesh that is visible in them
    seen_mesh: Tensor  # (V,) int64


@dataclass(frozen=True)
class Resolved:
    """The mean over the exposure for each pixel of a block."""

    rgba: Tensor  # (pixels, 4) float64 premultiplied linear colour and opacity of the meshes alone
    light: Tensor  # (pixels, 2) float64 direct light that visible surfaces would get without shadows, and that they get
    coverage: Tensor  # (pixels, M) float64 share of the exposure in which each mesh is visible


def composite_samples(
    prisms: Prisms,
    intervals: Intervals,
    cells: Cells,
    samples: Samples,
    accuracy: Accuracy,
    varying: Varying | None = None,
) -> Composite:
    """Return what every sample shows, front to back.

    Args:
        prisms: of the scene.
        intervals: from which the cells were cut.
        cells: with layers nearest first.
        samples: of the cells.
        varying: what varies in the cells, with the shadows on it; None if nothing does.
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
        known = None
        if varying is not None and varying.shadows is not None:
            receivers = varying.receivers_of(cells, layer[which], samples.span[sample[which]])
            known = varying.shadows, receivers, samples.tau[sample[which]]
        seen = look(surfaces, face, which, with_shadows(surfaces, points, known))
    else:
        seen = look_over(prisms, intervals, cells, (samples.cell[sample], interval))
    before, after = packed.transmittance(seen.alpha, offsets, accuracy.transmittance_cutoff)
    weight = (before * seen.alpha).unsqueeze(1)
    light = packed.sum_by_owner(weight * torch.cat([seen.rgb, seen.light], dim=1), offsets)
    n_meshes = max(1, len(surfaces.first_face))
    visible = ((before.detach() > 0) & (seen.alpha.detach() > 0)).nonzero().flatten()
    pairs = torch.unique(sample[visible] * n_meshes + surfaces.mesh_of[face[visible]])  # a mesh counts once
    rgba = torch.cat([light[:, :3], (1 - after).unsqueeze(1)], dim=1)
    return Composite(rgba, light[:, 3:], pairs // n_meshes, pairs % n_meshes)


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
    values = torch.cat([composite.rgba, composite.light], dim=1)
    means = packed.sum_by_owner(weight.unsqueeze(1) * values, offsets)
    n_pixels = len(offsets) - 1
    target = packed.owners(offsets)[composite.seen_sample] * n_meshes + composite.seen_mesh
    coverage = weight.new_zeros(n_pixels * n_meshes).index_add(0, target, weight[composite.seen_sample])
    return Resolved(means[:, :4], means[:, 4:], coverage.reshape(n_pixels, n_meshes))
