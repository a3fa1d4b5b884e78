"""Scenes of the sizes at which the papers time analytic motion blur, made up anew, in float32 and plain colours.

Source: Ronnow et al. 2021, sec. 6, and 2022, sec. 5 (counts of triangles, sizes of images); shapes and motions ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import paper_scenes
import torch
from torch import Tensor

import torchblur as tb

CHARACTER = (38, 15)  # detail of 48,944 triangles
SMALL_CHARACTER = (26, 10)  # of 22,568


@dataclass(frozen=True)
class Case:
    """A scene, the size [px] at which it is timed, and how to make it at another one by width and height."""

    make: Callable[[int, int], tb.Scene]
    width: int
    height: int


def plank(width: int, height: int) -> tb.Scene:
    """Return a plank, 12 triangles, that turns and tilts."""
    return _plain(paper_scenes.plank(16).meshes, 1.0, (width, height))


def chip(width: int, height: int) -> tb.Scene:
    """Return a chip, 508 triangles, that tumbles."""
    return _plain(paper_scenes.chip(16).meshes, 1.0, (width, height))


def character(
    width: int, height: int, opacity: float = 1.0, detail: tuple[int, int] = CHARACTER, motion: float = 1.0
) -> tb.Scene:
    """Return a running figure; `motion` stretches its stride."""
    return _plain(paper_scenes.figure(16, paper_scenes.stride(motion), detail), opacity, (width, height))


def textured_character(width: int, height: int) -> tb.Scene:
    """Return the running figure with its textures."""
    return _plain(paper_scenes.figure(16, paper_scenes.stride(), CHARACTER), None, (width, height))


def million(width: int, height: int) -> tb.Scene:
    """Return a thousand capsules of 1,026 triangles each that fly apart, as one mesh."""
    random = torch.Generator().manual_seed(4)
    vertices, faces, _ = paper_scenes.capsule(0.08, (0.035, 0.035), 1.0, 27)
    n = 1000
    place, way = ((torch.rand(n, 1, 3, dtype=torch.float64, generator=random) - 0.5) * s for s in (3.6, 0.3))
    motion = torch.stack([(vertices + place + 0.5 * end * way).reshape(-1, 3) for end in (-1, 1)])
    every = faces + len(vertices) * torch.arange(n).reshape(n, 1, 1)
    return _plain([tb.Mesh(motion, every.reshape(-1, 3), name="capsules")], 1.0, (width, height))


def cloth(width: int, height: int) -> tb.Scene:
    """Return a cloth of 63,368 triangles that sinks over a ball and swings."""
    n = 178
    place = torch.linspace(-1.4, 1.4, n + 1, dtype=torch.float64)
    x, z = (p.flatten() for p in torch.meshgrid(place, place, indexing="ij"))
    radius = torch.hypot(x, z)

    def drape(sunk: float) -> Tensor:
        over = (0.6 - 0.35 * radius**2).clamp(min=0) * 1.2
        folds = 0.08 * radius * torch.sin(9 * torch.atan2(z, x) + 5 * sunk)
        swing = 0.25 * sunk * radius**2
        return torch.stack([x + 0.3 * swing, over + folds - 0.4 * sunk * radius, z + folds], dim=1)

    i, j = (k.flatten() for k in torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij"))
    a, b, c, d = i * (n + 1) + j, i * (n + 1) + j + 1, (i + 1) * (n + 1) + j + 1, (i + 1) * (n + 1) + j
    faces = torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)])
    tilt = paper_scenes.rotation((1, 0, 0), 35).T
    sheet = tb.Mesh(torch.stack([drape(0.0) @ tilt, drape(1.0) @ tilt]), faces, name="cloth")
    return _plain([sheet], 1.0, (width, height))


def pills(width: int, height: int, n: int = 74) -> tb.Scene:
    """Return tumbling pills of 608 triangles each, every second one of glass."""
    random = torch.Generator().manual_seed(3)
    vertices, faces, _ = paper_scenes.capsule(0.3, (0.13, 0.13), 1.0)
    meshes = []
    for k in range(n):
        place, way, axis = (torch.rand(3, dtype=torch.float64, generator=random) - 0.5 for _ in range(3))
        place = place * torch.tensor([3.2, 3.2, 2.0], dtype=torch.float64)
        turn = float(torch.rand((), generator=random)) * 360
        poses = [
            vertices @ paper_scenes.rotation(axis.tolist(), turn + 40 * end).T + place + 0.5 * end * way
            for end in range(2)
        ]
        look = tb.Material(torch.rand(3, generator=random).tolist(), 0.5 if k % 2 else 1.0)
        meshes.append(tb.Mesh(torch.stack(poses), faces, look, name="pill"))
    return _plain(meshes, None, (width, height))


def shards(width: int, height: int, n: int = 1500, size: float = 0.6) -> tb.Scene:
    """Return half-transparent triangles in random motion."""
    random = torch.Generator().manual_seed(2)

    def uniform(half: float, *shape: int) -> Tensor:
        return half * (2 * torch.rand(*shape, dtype=torch.float64, generator=random) - 1)

    place, shape, motion = uniform(1.5, n, 1, 3), uniform(0.5 * size, n, 3, 3), uniform(0.2, n, 1, 3)
    ends = torch.stack([(place + shape).reshape(-1, 3), (place + 1.1 * shape + motion).reshape(-1, 3)])
    look = tb.Material(torch.rand(n, 3, generator=random), 0.5)
    return _plain([tb.Mesh(ends, torch.arange(3 * n).reshape(n, 3), look, name="shards")], None, (width, height))


def _plain(meshes: list[tb.Mesh] | tuple[tb.Mesh, ...], opacity: float | None, size: tuple[int, int]) -> tb.Scene:
    """Return a scene of meshes in float32, with a colour of its own for each face where an `opacity` is given."""
    random = torch.Generator().manual_seed(0)
    plain = []
    for mesh in meshes:
        look = mesh.material
        if opacity is not None:
            tint = torch.rand(1, 3, generator=random) * 0.7 + 0.1
            look = tb.Material(tint + 0.2 * torch.rand(mesh.n_faces, 3, generator=random), opacity)
        uv = mesh.uv if look.texture is not None else None
        plain.append(tb.Mesh(mesh.vertices.float(), mesh.faces, look, name=mesh.name, uv=uv))
    return tb.Scene(plain, paper_scenes.still_camera(*size), paper_scenes.BACKDROP)


CASES: dict[str, Case] = {
    "plank": Case(plank, 1024, 1024),
    "chip": Case(chip, 512, 1024),
    "small character": Case(lambda w, h: character(w, h, 1.0, SMALL_CHARACTER), 256, 256),
    "character": Case(character, 1920, 1080),
    "textured character": Case(textured_character, 1920, 1080),
    "character, 4K": Case(character, 3840, 2160),
    "glass character": Case(lambda w, h: character(w, h, 0.5), 1920, 1080),
    "cloth": Case(cloth, 1024, 1024),
    "cloth, 2048": Case(cloth, 2048, 2048),
    "pills": Case(pills, 1920, 1080),
    "shards": Case(shards, 256, 256),
}
LARGE = {"million, 8K": Case(million, 7680, 4320)}  # minutes

CURVES: dict[str, tuple[tuple[float, ...], Callable[[float], tb.Scene]]] = {  # by what grows: values, scene at a value
    "triangles": (
        (1, 2, 4, 8, 16),
        lambda k: character(512, 512, 1.0, (round(10 * math.sqrt(k)), round(4 * math.sqrt(k)))),
    ),
    "pixels": ((128, 256, 512, 1024), lambda k: character(int(k), int(k), 1.0, SMALL_CHARACTER)),
    "motion": ((0.25, 0.5, 1, 2), lambda k: character(512, 512, 1.0, SMALL_CHARACTER, k)),
    "depth": ((375, 750, 1500, 3000, 6000), lambda k: shards(256, 256, int(k))),
}
