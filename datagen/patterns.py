"""Patterns: palettes and the colour of every face of a shape.

Before: shapes.py, colour.py.  After: scenes.py.
Symbols: F faces; colours are linear RGB. Light is painted into the faces, as the surfaces themselves are unlit.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from datagen.colour import linear_from_srgb
from datagen.shapes import Shape

# sRGB, five colours each: one for the backdrop and four that stand out from it.
PALETTES = (
    ("1d2b3a", "f2b134", "ed553b", "20a39e", "f6f0e0"),
    ("f3ede2", "264653", "e76f51", "e9c46a", "2a9d8f"),
    ("12263a", "06bcc1", "f4d1ae", "f25f5c", "c5d8d1"),
    ("e8e4da", "3d5a80", "ee6c4d", "98c1d9", "293241"),
    ("2b2135", "ff7b54", "ffb26b", "ffd56f", "939b62"),
    ("d9e5e3", "1b4965", "5fa8d3", "ff6f61", "f9c74f"),
    ("22223b", "9a8c98", "f2e9e4", "c9445b", "4a9fa5"),
    ("f5e9da", "6d2e46", "a26769", "2f6690", "d5a021"),
    ("0f2e2b", "7ddf64", "e4ff1a", "e8aa14", "ff5714"),
    ("e6e1ef", "5e3fbe", "f06292", "26a6a4", "ffca3a"),
    ("31393c", "2176ff", "33a1fd", "fdca40", "f79824"),
    ("efe6dd", "bb4430", "7ebdc2", "f3dfa2", "231f20"),
    ("2e294e", "f46036", "1b998b", "e71d36", "c5d86d"),
    ("cfd8dc", "37474f", "ff8a65", "4db6ac", "fff176"),
    ("3b1f2b", "db504a", "e3b505", "56a3a6", "f2ebdd"),
    ("dfe7d3", "344e41", "588157", "bc6c25", "dda15e"),
)
PATTERNS = ("checker", "stripes", "bands", "gradient", "noise", "patches", "spots", "plain")
LIGHT = (0.42, 0.78, 0.47)  # where the painted light comes from, in the shape's space
SHADE = 0.30  # share of light on a face turned away from it


@functools.cache
def palette_colours(number: int) -> Tensor:
    """Return the (5, 3) float64 linear colours of a palette: the backdrop's first. Source: ours."""
    codes = PALETTES[number % len(PALETTES)]
    srgb = [[int(code[k : k + 2], 16) / 255 for k in (0, 2, 4)] for code in codes]
    return linear_from_srgb(torch.tensor(srgb, dtype=torch.float64))


def paint(shape: Shape, colours: Tensor, pattern: str, rng: np.random.Generator) -> Tensor:
    """Return the (F, 3) float64 linear colour of every face, without light.

    Args:
        shape: what to paint.
        colours: (C, 3) linear, C >= 2; the pattern takes the first ones.
        pattern: one of PATTERNS.
        rng: where the pattern's scale and chance come from.

    Raises:
        ValueError: an unknown pattern.

    Source: ours.
    """
    u, v = shape.cell_uv.unbind(-1)
    i, j = cell_numbers(shape, rng)
    first, second = colours[0], colours[1]
    if pattern == "checker":
        share = (i + j) % 2
    elif pattern == "stripes":
        share = i % 2
    elif pattern == "bands":
        share = (j + i * int(rng.integers(0, 2))) % 4 // 2
    elif pattern == "gradient":
        share = v if rng.random() < 0.5 else (1 - torch.cos(u * 2 * torch.pi)) / 2
    elif pattern == "noise":
        share = smooth_noise(cell_centres(shape) * float(rng.uniform(1.5, 4.0)), rng)
        share = ((share - 0.25) * 2).clamp(0, 1)
    elif pattern == "patches":
        choice = torch.from_numpy(rng.integers(0, len(colours), 64 * 64))
        return colours[choice[(i % 64) * 64 + j % 64]]
    elif pattern == "spots":
        share = (i % 2) * (j % 2)
    elif pattern == "plain":
        share = torch.zeros_like(u)
    else:
        raise ValueError(f"pattern: expected one of {', '.join(PATTERNS)}, got {pattern!r}")
    share = share.to(torch.float64).unsqueeze(-1)
    return first * (1 - share) + second * share


def cell_numbers(shape: Shape, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Return (F,) int64 column and row of each face in a grid of pattern cells, whole cells of the shape each.

    Args:
        shape: its cells lie on a regular grid, or anywhere, as on a polyhedron.
        rng: how many of the shape's cells make one of the pattern's.

    Source: ours.
    """
    numbers = []
    for place in shape.cell_uv.unbind(-1):
        n = round(0.5 / max(float(place.min()), 0.01))  # the first cell's middle is half a cell from the edge
        steps = [s for s in (1, 2, 3) if n % (2 * s) == 0 and n // s >= 4] or [1]  # even, so that a seam fits
        numbers.append(torch.floor(place * n).long() // int(rng.choice(steps)))
    return numbers[0], numbers[1]


def cell_centres(shape: Shape) -> Tensor:
    """Return (F, 3) centres of the faces' cells: of the quad where two faces share one. Source: ours."""
    centres = shape.centres()
    uv = shape.cell_uv
    if len(uv) % 2 or not torch.equal(uv[::2], uv[1::2]):
        return centres
    return ((centres[::2] + centres[1::2]) / 2).repeat_interleave(2, 0)


def light(shape: Shape, colours: Tensor, two_sided: bool = False) -> Tensor:
    """Return face colours (F, 3) with a fixed light painted in: soft Lambert, darker where turned away.

    Args:
        shape: gives the normals.
        colours: (F, 3) or (3,) linear.
        two_sided: both sides of a sheet catch the light.

    Source: ours.
    """
    toward = torch.tensor(LIGHT, dtype=torch.float64)
    cosine = shape.normals() @ (toward / toward.norm())
    cosine = cosine.abs() if two_sided else cosine
    amount = SHADE + (1 - SHADE) * ((cosine + 0.35) / 1.35).clamp(min=0)
    return colours * amount.unsqueeze(-1)


def lit_color(shape: Shape, colours: Tensor, is_lit: bool, two_sided: bool = False) -> Tensor:
    """Return face colours as float32: as they are for lamps to light them, or with a fixed light painted in.

    Args:
        shape, colours, two_sided: as for `light`.
        is_lit: whether lamps light the shape.

    Source: ours.
    """
    return (colours if is_lit else light(shape, colours, two_sided)).to(torch.float32)


def smooth_noise(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Return (N,) values in [0, 1] of a random smooth function at points (N, 3): a few waves, summed.

    Source: ours.
    """
    total = torch.zeros(len(points), dtype=torch.float64)
    n_waves = 7
    for _ in range(n_waves):
        direction = torch.from_numpy(rng.normal(size=3))
        total += torch.sin(points @ direction * 1.6 + rng.uniform(0, 2 * np.pi))
    return (total / n_waves**0.5 / 1.6).clamp(-1, 1) / 2 + 0.5
