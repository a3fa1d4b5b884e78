"""Wraps: people's pictures around the actors, and behind them.

Before: photos.py, patterns.py, clips.py.  After: scenes.py.
Symbols: V vertices, F faces. All of it is drawn from the stream `pictures`, so nothing else is moved by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from datagen.clips import Actor
from datagen.patterns import lit_color
from datagen.photos import load_background, load_texture
from datagen.shapes import Shape

WRAPPED_SHARE = 0.5  # of the moving bodies; what stands behind them always is


def wrap_actor(actor: Actor, path: str, repeat: float) -> Actor:
    """Return the actor with a picture about it instead of its colours, in the same light.

    The picture lies on each face as seen along that axis of the body to which the face is turned most; the texels are
    square. Faces that bend with time keep the places of the first frame.

    Args:
        actor: whom to wrap.
        path: of the picture.
        repeat: how long one picture is [scene units].

    Raises:
        PictureError: the file cannot be read any more.

    Source: box mapping, as in any modelling program.
    """
    texture = load_texture(path)
    vertices = actor.motion.resting()
    shape = Shape(vertices, actor.faces, torch.zeros(len(actor.faces), 2, dtype=torch.float64), False)
    aspect = texture.shape[1] / texture.shape[0]
    uv = box_uv(shape) / repeat * torch.tensor([1.0, aspect], dtype=torch.float64)
    white = torch.ones(len(actor.faces), 3, dtype=torch.float64)
    color = lit_color(shape, white, actor.is_lit, two_sided=actor.double_sided)
    return replace(actor, color=color, texture=texture, uv=uv.to(torch.float32))


def box_uv(shape: Shape) -> Tensor:
    """Return (F, 3, 2) float64 places of the faces' corners [scene units], seen along the axis they are turned to.

    Source: box mapping.
    """
    corners = shape.vertices[shape.faces]  # (F, 3, 3)
    axis = shape.normals().abs().argmax(1)
    seen = torch.tensor([[2, 1], [0, 2], [0, 1]])[axis]  # upright on walls: v is the body's y
    return corners.gather(2, seen.unsqueeze(1).expand(-1, 3, -1))


def wrap_actors(
    actors: Sequence[Actor], n_backdrop: int, rng: np.random.Generator, folder: str, names: Sequence[str]
) -> tuple[list[Actor], dict[str, str]]:
    """Return the actors, some of them wrapped, and which file each of those wears.

    Args:
        actors: the backdrop's first.
        n_backdrop: how many of them are the backdrop's.
        rng: stream `pictures`.
        folder: of the pictures.
        names: of the usable ones.

    Source: ours.
    """
    wrapped, worn = [], {}
    for k, actor in enumerate(actors):
        name = names[int(rng.integers(0, len(names)))]
        repeat = float(rng.uniform(2.5, 5.0) if k < n_backdrop else rng.uniform(0.7, 1.6))
        is_chosen = k < n_backdrop or rng.random() < WRAPPED_SHARE
        if is_chosen and float(actor.color.max()) <= 1:  # what shines stays as it is
            wrapped.append(wrap_actor(actor, str(Path(folder) / name), repeat))
            worn[actor.name] = name
        else:
            wrapped.append(actor)
    return wrapped, worn


def choose_background(
    rng: np.random.Generator, folder: str, names: Sequence[str], size: tuple[int, int]
) -> tuple[Tensor, str]:
    """Return an (H, W, 3) float32 linear background, and the name of its file.

    Args:
        rng: stream `pictures`.
        folder: of the pictures.
        names: of the usable ones.
        size: width and height of the image [px].

    Source: ours.
    """
    name = names[int(rng.integers(0, len(names)))]
    place = (float(rng.random()), float(rng.random()))
    return load_background(str(Path(folder) / name), size, place, bool(rng.random() < 0.5)), name
