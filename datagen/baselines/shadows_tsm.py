"""Time-dependent shadow maps: one depth map for each stratum of the exposure.

Before: shadow_samples.py, shadow_maps.py.  After: scripts.
Symbols: N strata; layer k is what the light sees at one random time in [k / N, (k + 1) / N].
Weak point: a receiver's sample and the layer of its stratum lie up to 1 / N apart in time, so that a surface that moves
towards the light at speed v shades itself where the bias is below v / N.
Source: Akenine-Moller, Munkberg & Hasselgren 2007; McGuire, Enderton, Shirley & Luebke 2010.
"""

from __future__ import annotations

import torch
from torch import Tensor

import torchblur as tb
from datagen.baselines.shadow_maps import LightViews, rasterise, view_from_light
from datagen.baselines.shadow_samples import (
    Hits,
    MovingFaces,
    ShadowedImage,
    average_samples,
    gather_faces,
    stratified_times,
)
from torchblur import check

BYTES_PER_DEPTH = 4  # Hong & Oh 2018, section 5


@torch.no_grad()
def render_tsm(
    scene: tb.Scene, *, n_layers: int, size_px: int, bias: float, generator: torch.Generator
) -> ShadowedImage:
    """Return the scene with `n_layers` samples a pixel and as many shadow maps.

    Args:
        scene: opaque meshes and one light that rests, whose shadows these are.
        n_layers: strata of the exposure.
        size_px: texels along each side of a map (of each of the six of a point light).
        bias: by how much a texel must be nearer to the light than a point to shade it [scene units].
        generator: gives the times.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Source: Akenine-Moller et al. 2007; McGuire et al. 2010.
    """
    faces = gather_faces(scene)
    check.positive_int("n_layers", n_layers)
    check.number("bias", bias, 0.0)
    views = view_from_light(scene, faces, size_px)
    jitter = torch.rand(n_layers, dtype=torch.float64, generator=generator)
    layers = torch.stack([_depth_map(views, faces, (k + float(jitter[k])) / n_layers) for k in range(n_layers)])

    def visible(hits: Hits) -> Tensor:
        texel, depth = views.find_texels(hits.world)
        nearest = layers[hits.sample, texel]
        return ((texel < 0) | (nearest >= depth - bias)).to(torch.float64)

    image, visibility = average_samples(scene, faces, stratified_times(scene, n_layers, generator), visible)
    counts = {"layers": n_layers, "texels": views.n_texels}
    return ShadowedImage(image, visibility, BYTES_PER_DEPTH * n_layers * views.n_texels, counts)


def _depth_map(views: LightViews, faces: MovingFaces, t: float) -> Tensor:
    """Return (texels,) the depth of what the light sees nearest at a time, inf where nothing."""
    corners = views.project(faces.world_at(t)[0])  # (V, F, 3, 4)
    view = torch.arange(len(corners), device=corners.device).repeat_interleave(corners.shape[1])
    found = rasterise(views, corners.flatten(0, 1), view)
    nearest = torch.full((views.n_texels,), torch.inf, dtype=torch.float64, device=corners.device)
    return nearest.scatter_reduce(0, found.texel, found.depth, "amin")
