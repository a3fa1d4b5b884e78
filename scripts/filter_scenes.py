"""Scenes on which image-space motion blur fails in the ways that its authors show, made up anew.

A spinning rotor, gears that turn before each other, and pills that fall through a glass bottle before a passing wall.
All are unlit, deterministic, in float64, seen from the front, and sized by the height of the image.
Source: the failures in McGuire et al. 2012 (fig. 7), Guertin & Nowrouzezahrai 2015 (fig. 4) and Ronnow et al. 2021
(transparency); shapes, colours and motions ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

import torchblur as tb

BACKDROP = (0.62, 0.68, 0.74)
VIEW_HEIGHT = 4.0  # [scene units] at depth 5, where z = 0
PIECES = 24  # linear pieces of a turn
SECTORS = 8  # pairs of light and dark sectors of the rotor
ROTOR_RADIUS = 1.5

Flat = tuple[Tensor, Tensor, Tensor]  # vertices (V, 2), faces (F, 3), colours (F, 3)


def rotor(size: int = 256, turn_deg: float = 2 * 360 / SECTORS) -> tb.Scene:
    """Return a disc of light and dark sectors that turns, by two pairs of them if not told otherwise: in truth all
    circles then become even.
    """
    light, dark = torch.tensor([0.95, 0.75, 0.2]), torch.tensor([0.1, 0.15, 0.35])
    colours = [light if k % 2 else dark for k in range(2 * SECTORS)]
    rings = [(0.12, ROTOR_RADIUS)]
    disc = _join([_ring(rings[0], colours, 12), _ring((0.0, 0.12), [torch.tensor([0.7, 0.1, 0.1])], 24)])
    return tb.Scene([_turning(disc, (0, 0, 0), turn_deg, "rotor")], _camera(size), BACKDROP)


def gears(size: int = 256) -> tb.Scene:
    """Return a small spoked gear that turns before the rim of a large one, whose motion dominates all around."""
    return tb.Scene([_large_gear(), _small_gear()], _camera(size), BACKDROP)


def small_gear(size: int = 256) -> tb.Scene:
    """Return the small gear of `gears` alone."""
    return tb.Scene([_small_gear()], _camera(size), BACKDROP)


def pills(size: int = 256) -> tb.Scene:
    """Return half-transparent pills that fall through a resting bottle of glass, before a wall that moves sideways."""
    random = torch.Generator().manual_seed(7)
    wall = _checks(24, 9.0)
    side = torch.tensor([0.55, 0.0, 0.0], dtype=torch.float64)
    meshes = [_moving(wall, (-0.275, 0, -2.5), side, 1.0, "wall")]
    for k in range(7):
        colour = 0.15 + 0.8 * torch.rand(3, generator=random)
        x, y = -0.36 + 0.24 * (k % 4) + 0.1 * (k // 4), 0.75 - 0.55 * (k // 2) + 0.12 * (k % 2)
        fall = torch.tensor([0.0, -0.5, 0.0], dtype=torch.float64)
        meshes.append(_moving(_pill(0.17, 0.16, colour), (x, y + 0.25, -0.2 - 0.01 * k), fall, 0.6, "pill"))
    bottle = _pill(0.95, 0.55, torch.tensor([0.75, 0.9, 0.8]))
    meshes.append(_moving(bottle, (0, 0, 0.3), torch.zeros(3, dtype=torch.float64), 0.25, "bottle"))
    return tb.Scene(meshes, _camera(size), BACKDROP)


SCENES: dict[str, Callable[[int], tb.Scene]] = {"rotor": rotor, "gears": gears, "pills": pills}


def _camera(size: int) -> tb.Camera:
    """Return a still camera that sees VIEW_HEIGHT units at depth 5."""
    fov = 2 * math.degrees(math.atan(VIEW_HEIGHT / 10))
    return tb.Camera.look_at((0, 0, 5), (0, 0, 0), fov_y_deg=fov, width=size, height=size, near=0.5, far=20)


def _large_gear() -> tb.Mesh:
    """Return the gear that fills most of the view, behind."""
    return _turning(_gear(1.95, 26, ((0.35, 0.38, 0.42), (0.85, 0.8, 0.7))), (-0.75, -0.75, -0.3), 24, "large gear")


def _small_gear() -> tb.Mesh:
    """Return the spoked gear in front."""
    return _turning(_gear(0.75, 10, ((0.75, 0.2, 0.1), (0.95, 0.85, 0.3))), (0.75, 0.75, 0.2), -50, "small gear")


def _turning(shape: Flat, place: tuple[float, float, float], degrees: float, name: str) -> tb.Mesh:
    """Return a flat shape that turns about its origin by `degrees`, as far before as after the middle."""
    vertices, faces, colours = shape
    poses = []
    for k in range(PIECES + 1):
        angle = math.radians(degrees * (k / PIECES - 0.5))
        c, s = math.cos(angle), math.sin(angle)
        turned = vertices @ torch.tensor([[c, s], [-s, c]], dtype=torch.float64)
        poses.append(torch.cat([turned, torch.zeros_like(turned[:, :1])], dim=1))
    motion = torch.stack(poses) + torch.tensor(place, dtype=torch.float64)
    return tb.Mesh(motion, faces, tb.Material(colours.double(), double_sided=True), name=name)


def _moving(shape: Flat, place: tuple[float, float, float], way: Tensor, opacity: float, name: str) -> tb.Mesh:
    """Return a flat shape that moves along `way` from `place`; at rest if that is 0."""
    vertices, faces, colours = shape
    start = torch.cat([vertices, torch.zeros_like(vertices[:, :1])], dim=1) + torch.tensor(place, dtype=torch.float64)
    motion = torch.stack([start, start + way]) if bool(way.any()) else start
    return tb.Mesh(motion, faces, tb.Material(colours.double(), opacity, double_sided=True), name=name)


def _join(parts: list[Flat]) -> Flat:
    """Return shapes as one."""
    first, faces = 0, []
    for vertices, face, _ in parts:
        faces.append(face + first)
        first += len(vertices)
    return torch.cat([p[0] for p in parts]), torch.cat(faces), torch.cat([p[2] for p in parts])


def _ring(radii: tuple[float, float], colours: list[Tensor], steps: int) -> Flat:
    """Return a ring of sectors of equal angle, one of each colour, each in so many steps."""
    n = len(colours) * steps
    angle = torch.arange(n, dtype=torch.float64) * (2 * math.pi / n)
    unit = torch.stack([angle.cos(), angle.sin()], dim=1)
    i = torch.arange(n)
    j = (i + 1) % n
    faces = torch.cat([torch.stack([i, i + n, j + n], 1), torch.stack([i, j + n, j], 1)])
    per_quad = torch.stack(colours).repeat_interleave(steps, dim=0)
    return torch.cat([radii[0] * unit, radii[1] * unit]), faces, torch.cat([per_quad, per_quad])


def _gear(radius: float, teeth: int, colours: tuple[tuple[float, ...], tuple[float, ...]]) -> Flat:
    """Return a rim with teeth of alternating colours, a hub, and six spokes striped along their length."""
    plain, bright = (torch.tensor(c) for c in colours)
    rim = _ring((0.75 * radius, 0.92 * radius), [plain, bright] * teeth, 4)
    hub = _ring((0.0, 0.18 * radius), [plain, bright] * 4, 4)
    parts = [rim, hub]
    for k in range(6):
        angle = k * math.pi / 3
        along = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
        across = torch.tensor([-along[1], along[0]], dtype=torch.float64)
        ends = torch.linspace(0.15, 0.8, 2, dtype=torch.float64) * radius
        corners = [e * along + s * 0.075 * radius * across for e in ends for s in (-1, 1)]
        parts.append((torch.stack(corners), torch.tensor([[0, 2, 3], [0, 3, 1]]), torch.stack([bright, bright])))
    for k in range(teeth):
        angle = torch.tensor([(k + s) * 2 * math.pi / teeth for s in (-0.22, 0.22, 0.13, -0.13)], dtype=torch.float64)
        reach = torch.tensor([0.9, 0.9, 1.05, 1.05], dtype=torch.float64).unsqueeze(1) * radius
        corners = reach * torch.stack([angle.cos(), angle.sin()], dim=1)
        shade = torch.stack([plain, plain]) * 0.8
        parts.append((corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), shade))
    return _join(parts)


def _pill(half_length: float, radius: float, colour: Tensor) -> Flat:
    """Return an upright stadium."""
    angle = torch.arange(33, dtype=torch.float64) * (math.pi / 32)
    top = torch.stack([radius * angle.cos(), half_length + radius * angle.sin()], dim=1)
    outline = torch.cat([top, -top])
    i = torch.arange(1, len(outline) - 1)
    faces = torch.stack([torch.zeros_like(i), i, i + 1], dim=1)
    return outline, faces, colour.expand(len(faces), 3)


def _checks(n: int, side: float) -> Flat:
    """Return a square wall of n by n checks."""
    line = torch.linspace(-side / 2, side / 2, n + 1, dtype=torch.float64)
    y, x = torch.meshgrid(line, line, indexing="ij")
    row, column = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
    low = (row * (n + 1) + column).flatten()
    faces = torch.cat([torch.stack([low, low + 1, low + n + 2], 1), torch.stack([low, low + n + 2, low + n + 1], 1)])
    light, dark = torch.tensor([0.85, 0.85, 0.8]), torch.tensor([0.12, 0.3, 0.4])
    colours = torch.where(((row + column) % 2 == 0).flatten().unsqueeze(1), light, dark)
    return torch.stack([x.flatten(), y.flatten()], dim=1), faces, torch.cat([colours, colours])
