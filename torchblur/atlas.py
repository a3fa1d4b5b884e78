"""Atlas: the textures of all meshes end to end, each with its smaller copies.

Before: scene.py.  After: surfaces.py, texture.py.
Symbols: M meshes, X texels; level 0 is the texture itself, level k + 1 has half the size of level k, rounded down.
Source: mip maps, Williams 1983; exact area means for odd sizes: ours.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur.scene import Mesh
from torchblur.stopwatch import spent_on


@dataclass(frozen=True)
class Atlas:
    """The textures of all meshes end to end; a mesh without one has a single white texel."""

    texels: Tensor  # (X, 4) float64 linear RGB and opacity, level by level, row by row from the top
    first: Tensor  # (levels, M) int64 first texel of each level of each mesh; the last level fills the rest
    size: Tensor  # (levels, 2, M) int64 width, height
    n_levels: Tensor  # (M,) int64
    repeats: Tensor  # (M,) bool


@spent_on("texture")
def build_atlas(meshes: tuple[Mesh, ...], device: torch.device) -> Atlas:
    """Return the textures of all meshes, opacity 1 added where a texture has none. Source: Williams 1983."""
    white = torch.ones(1, 1, 4, dtype=torch.float64, device=device)
    levels_of: dict[tuple[int, bool], int] = {}  # by texture and mip maps: meshes may share them
    pyramids: list[list[Tensor]] = []
    which = []
    for mesh in meshes:
        texture, mipmap = mesh.material.texture, mesh.material.mipmap
        key = (id(texture), mipmap)
        if key not in levels_of:
            image = white if texture is None else texture.to(device, torch.float64)
            opacity = torch.ones(*image.shape[:2], 4 - image.shape[2], dtype=torch.float64, device=device)
            image = torch.cat([image, opacity], dim=2)
            levels_of[key] = len(pyramids)
            pyramids.append(pyramid(image) if mipmap else [image])
        which.append(levels_of[key])
    most = max((len(p) for p in pyramids), default=1)
    firsts = iter(itertools.accumulate((i.shape[0] * i.shape[1] for p in pyramids for i in p), initial=0))
    first, size = [], []
    for levels in pyramids:
        places = [next(firsts) for _ in levels]
        sizes = [(i.shape[1], i.shape[0]) for i in levels]
        first.append(places + places[-1:] * (most - len(levels)))
        size.append(sizes + sizes[-1:] * (most - len(levels)))
    images = [i.reshape(-1, 4) for p in pyramids for i in p]
    one = torch.tensor(which, dtype=torch.int64, device=device)
    counts = torch.tensor([len(p) for p in pyramids], dtype=torch.int64, device=device)
    return Atlas(
        texels=torch.cat(images) if images else white.reshape(1, 4),
        first=torch.tensor(first, dtype=torch.int64, device=device).reshape(-1, most).T[:, one],
        size=torch.tensor(size, dtype=torch.int64, device=device).reshape(-1, most, 2).permute(1, 2, 0)[..., one],
        n_levels=counts[one],
        repeats=torch.tensor([m.material.wrap == "repeat" for m in meshes], dtype=torch.bool, device=device),
    )


def pyramid(image: Tensor) -> list[Tensor]:
    """Return the levels of an image (h, w, 4) of straight RGB and opacity, down to one texel.

    Each texel is the mean of the area under it; colours count by their opacity, so that what is invisible lends no
    colour. Source: Williams 1983.
    """
    levels = [image]
    while max(image.shape[:2]) > 1:
        opacity = image[..., 3:]
        means = torch.cat([image, image[..., :3] * opacity], dim=2)
        for axis in (0, 1):
            means = _halve(means, axis)
        plain, opacity, weighted = means[..., :3], means[..., 3:4], means[..., 4:]
        is_visible = opacity > 0
        rgb = torch.where(is_visible, weighted / torch.where(is_visible, opacity, 1.0), plain)
        image = torch.cat([rgb, opacity], dim=2)
        levels.append(image)
    return levels


def _halve(image: Tensor, axis: int) -> Tensor:
    """Return area means along an axis of n texels in n // 2: of 2 + 1 / (n // 2) texels each where n is odd."""
    n = image.shape[axis]
    if n == 1:
        return image
    half = n // 2
    rows = image.movedim(axis, 0)
    first, second = rows[: 2 * half : 2], rows[1 : 2 * half : 2]
    if n % 2 == 0:
        return ((first + second) / 2).movedim(0, axis)
    share = (torch.arange(1, half + 1, dtype=image.dtype, device=image.device) / half).reshape(-1, 1, 1)
    mean = ((1 + 1 / half - share) * first + second + share * rows[2::2]) / (2 + 1 / half)
    return mean.movedim(0, axis)
