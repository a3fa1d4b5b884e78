"""The scenes by which analytic motion blur is judged in the literature, made up anew: same kinds of motion, own shapes.

A plank that turns about a pivot, a tumbling chip, a running figure, overlapping glass, and two sheets that swap places.
Vertices move linearly between few knots, so that depth and texture coordinates bend along the rays. All scenes are
unlit, deterministic, in float64, and sized by the height of the image; textures grow with it, about a texel a pixel.
Source: the scenes of Ronnow et al. 2021, sec. 5, and 2022, sec. 4; shapes, textures and motions ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

import torchblur as tb

BACKDROP = (0.62, 0.68, 0.74)
FOV_Y_DEG = 45
SKIN, HAIR, SHIRT, TROUSERS, SHOE = (
    (0.85, 0.5, 0.33),
    (0.12, 0.05, 0.02),
    (0.8, 0.1, 0.08),
    (0.05, 0.09, 0.3),
    (0.9, 0.9, 0.9),
)

Shape = tuple[Tensor, Tensor, Tensor]  # vertices (V, 3), faces (F, 3), uv (F, 3, 2)


def plank(size: int = 256) -> tb.Scene:
    """Return a wooden plank, 12 triangles, that turns and tilts about its middle in one linear piece."""
    vertices, faces, uv = _box((1.7, 0.55, 0.08))
    start = vertices @ (rotation((1, 0, 0), -35) @ rotation((0, 0, 1), 45)).T
    end = vertices @ (rotation((1, 0, 0), -35) @ rotation((0, 0, 1), -45)).T
    motion = torch.stack([start, end + torch.tensor([0.12, 0.06, 0.0], dtype=torch.float64)])
    look = textured(_wood(max(8, size // 6), max(16, size // 2)))
    return tb.Scene([tb.Mesh(motion, faces, look, name="plank", uv=uv)], still_camera(size, size), BACKDROP)


def chip(size: int = 256) -> tb.Scene:
    """Return a falling poker chip, 508 triangles, that tumbles while it turns, in one linear piece."""
    vertices, faces, uv = _chip(128, 0.85, 0.12)
    poses = []
    for k in range(2):
        turn = rotation((1, 0.25, 0.1), 50 + 60 * k) @ rotation((0, 1, 0), 60 * k)
        poses.append(vertices @ turn.T + torch.tensor([0.0, 0.25 - 0.5 * k, 0.0], dtype=torch.float64))
    mesh = tb.Mesh(torch.stack(poses), faces, textured(_chip_look(max(8, size // 2))), name="chip", uv=uv)
    return tb.Scene([mesh], still_camera(max(1, size // 2), size), BACKDROP)


def character(size: int = 256) -> tb.Scene:
    """Return a running figure of 14 parts and 8,512 triangles, each limb on its own way in one linear piece."""
    return tb.Scene(figure(size, stride()), still_camera(size, size), BACKDROP)


def transparent(size: int = 256) -> tb.Scene:
    """Return 200 overlapping half-transparent triangles in motion, every fifth with a texture."""
    random = torch.Generator().manual_seed(5)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, dtype=torch.float64, generator=random)

    meshes = []
    for n, texture in ((160, None), (40, rings(max(8, size // 12), 3))):
        place, shape = uniform(-1.5, 1.5, n, 1, 3), uniform(-0.42, 0.42, n, 3, 3)
        motion, bend = uniform(-0.3, 0.3, n, 1, 3), uniform(-0.3, 0.3, n, 3, 3)
        start, end = (place + shape).reshape(-1, 3), (place + shape + motion + bend).reshape(-1, 3)
        uv = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]], dtype=torch.float64).expand(n, 3, 2)
        look = tb.Material(uniform(0.1, 1.0, n, 3), 0.5, texture=texture)
        faces = torch.arange(3 * n).reshape(n, 3)
        meshes.append(tb.Mesh(torch.stack([start, end]), faces, look, name="glass", uv=uv))
    return tb.Scene(meshes, still_camera(size, size), BACKDROP)


def swapping_quads(size: int = 256) -> tb.Scene:
    """Return a sheet that recedes from view depth 1 to 9 through one that rests at depth 3.

    The first is in front for a quarter of the exposure; were z / w linear in time, it would be for three quarters.
    """
    corner = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    uv = (0.5 * (corner + 1))[faces]

    def sheet(centre: tuple[float, float], half: float, depth: float) -> Tensor:
        """Return corners by centre and half side in half heights of the image, at a view depth."""
        scale = math.tan(math.radians(FOV_Y_DEG) / 2) * depth
        xy = (corner * half + torch.tensor(centre, dtype=torch.float64)) * scale
        return torch.cat([xy, torch.full((4, 1), 5 - depth, dtype=torch.float64)], dim=1)

    going = torch.stack([sheet((-0.30, 0.18), 0.55, 1.0), sheet((-0.22, 0.24), 0.50, 9.0)])
    resting = sheet((0.25, -0.2), 0.6, 3.0)
    warm = textured(stripes(max(8, size // 2), 8), (1.0, 0.5, 0.2))
    cold = textured(rings(max(8, size // 2), 7), (0.2, 0.55, 1.0))
    meshes = [tb.Mesh(going, faces, warm, name="going", uv=uv), tb.Mesh(resting, faces, cold, name="resting", uv=uv)]
    return tb.Scene(meshes, still_camera(size, size), (0.03, 0.03, 0.04))


SCENES: dict[str, Callable[[int], tb.Scene]] = {
    "plank": plank,
    "chip": chip,
    "character": character,
    "transparent": transparent,
    "swapping quads": swapping_quads,
}


def still_camera(width: int, height: int) -> tb.Camera:
    """Return a still camera 5 units in front of the origin, where it sees 4.1 units from top to bottom."""
    return tb.Camera.look_at((0, 0, 5), (0, 0, 0), fov_y_deg=FOV_Y_DEG, width=width, height=height, near=0.5, far=20)


def textured(texture: np.ndarray, color: Sequence[float] = (1.0, 1.0, 1.0)) -> tb.Material:
    """Return an opaque material of one texture, not repeated."""
    return tb.Material(color, texture=texture, wrap="clamp")


def rotation(axis: Sequence[float], degrees: float) -> Tensor:
    """Return the (3, 3) rotation about `axis`, counter-clockwise seen against it."""
    x, y, z = (math.radians(degrees) * np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)).tolist()
    return torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64))


# --- shapes ---


def _box(half: tuple[float, float, float]) -> Shape:
    """Return a box of 12 triangles with half sides `half`; u runs along x and v along y where they can."""
    signs = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    faces, uv = [], []
    for axis in range(3):
        for side in (-1, 1):
            ring = []
            for b, c in ((-1, -1), (1, -1), (1, 1), (-1, 1))[::side]:
                corner = [side, side, side]
                corner[(axis + 1) % 3], corner[(axis + 2) % 3] = b, c
                ring.append(tuple(corner))
            places = [_box_uv(axis, corner, half) for corner in ring]
            for chosen in ((0, 1, 2), (0, 2, 3)):
                faces.append([signs.index(ring[k]) for k in chosen])
                uv.append([places[k] for k in chosen])
    vertices = torch.tensor(signs, dtype=torch.float64) * torch.tensor(half, dtype=torch.float64)
    return vertices, torch.tensor(faces), torch.tensor(uv, dtype=torch.float64)


def _box_uv(axis: int, corner: tuple[int, ...], half: tuple[float, float, float]) -> tuple[float, float]:
    """Return the texture coordinates of a corner, given by signs, on the side that faces along `axis`."""
    x, y, z = (0.5 * (sign + 1) for sign in corner)
    return (z * half[2] / half[0] if axis == 0 else x), (z * half[2] / half[1] if axis == 1 else y)


def _chip(n: int, radius: float, half_height: float) -> Shape:
    """Return a flat cylinder about y of 4 n - 4 triangles, n a power of 2.

    The round sides are polygons of which every second corner is cut off until none is left. They show the left half
    of the texture, the rim shows the right half.
    """
    angle = torch.arange(n, dtype=torch.float64) * (2 * math.pi / n)
    x, z = angle.cos(), -angle.sin()
    vertices = torch.cat(
        [torch.stack([radius * x, torch.full_like(x, y), radius * z], 1) for y in (half_height, -half_height)]
    )
    strides = [1 << k for k in range(n.bit_length() - 2)]
    top = torch.cat([torch.arange(0, n, 2 * s).unsqueeze(1) + torch.tensor([0, s, 2 * s]) for s in strides]) % n
    disc = torch.stack([0.25 + 0.245 * x, 0.5 - 0.49 * z], dim=1)
    i = torch.arange(n)
    j, left, right = (i + 1) % n, 0.51 + 0.48 * i / n, 0.51 + 0.48 * (i + 1) / n
    low, high = torch.full((n,), 0.02), torch.full((n,), 0.98)
    rim = torch.cat([torch.stack([i, i + n, j + n], dim=1), torch.stack([i, j + n, j], dim=1)])
    rim_u = torch.cat([torch.stack([left, left, right], dim=1), torch.stack([left, right, right], dim=1)])
    rim_v = torch.cat([torch.stack([high, low, low], dim=1), torch.stack([high, low, high], dim=1)])
    uv = torch.cat([disc[top], disc[top.flip(1)], torch.stack([rim_u, rim_v], dim=2).double()])
    return vertices, torch.cat([top, top.flip(1) + n, rim]), uv


def capsule(length: float, radii: tuple[float, float], flat: float, n_around: int = 16, n_along: int = 6) -> Shape:
    """Return a closed limb along y from 0 to `length`, round at both ends, `flat` times as wide along z as along x."""
    quarter = torch.linspace(0, math.pi / 2, n_along + 1, dtype=torch.float64)
    body = torch.linspace(0, 1, n_along + 3, dtype=torch.float64)[1:-1]
    radius = torch.cat([radii[0] * quarter.sin(), (1 - body) * radii[0] + body * radii[1], radii[1] * quarter.cos()])
    height = torch.cat([-radii[0] * quarter.cos(), body * length, length + radii[1] * quarter.sin()])
    radius[0], radius[-1] = 0, 0
    angle = torch.arange(n_around, dtype=torch.float64) * (2 * math.pi / n_around)
    ring = torch.stack([angle.sin(), torch.zeros_like(angle), flat * angle.cos()], dim=1)
    vertices = radius[:, None, None] * ring + height[:, None, None] * torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    j, i = torch.meshgrid(torch.arange(len(radius) - 1), torch.arange(n_around), indexing="ij")
    j, i = j.flatten(), i.flatten()
    corner = [(j, i), (j, i + 1), (j + 1, i + 1), (j + 1, i)]
    share = (height - height[0]) / (height[-1] - height[0])
    place = [torch.stack([b / n_around, share[a]], dim=1) for a, b in corner]
    number = [a * n_around + b % n_around for a, b in corner]
    faces = torch.cat([torch.stack([number[k] for k in chosen], dim=1) for chosen in ((0, 1, 2), (0, 2, 3))])
    uv = torch.cat([torch.stack([place[k] for k in chosen], dim=1) for chosen in ((0, 1, 2), (0, 2, 3))])
    has_area = torch.cat([j > 0, j < len(radius) - 2])
    return vertices.reshape(-1, 3), faces[has_area], uv[has_area]


# --- the figure ---

FIGURE_SCALE = 1.2
# name, where it hangs, how far to the side, degrees forward of straight down when the shutter opens and closes, length,
# radii, how flat, look: two colours and how many checks around and along
LIMBS = (
    ("trunk", "hip", 0.0, (165, 170), 0.62, (0.17, 0.2), 1.35, (SHIRT, (0.95, 0.9, 0.8), 0, 7)),
    ("pelvis", "hip", 0.0, (170, 175), 0.06, (0.17, 0.17), 1.4, (TROUSERS, (0.2, 0.3, 0.7), 6, 2)),
    ("neck", "trunk", 0.0, (165, 172), 0.3, (0.07, 0.07), 1.0, (SKIN, SKIN, 0, 0)),
    ("head", "neck", 0.0, (168, 178), 0.14, (0.15, 0.16), 0.9, (SKIN, HAIR, 0, 1)),
    ("right thigh", "hip", 0.13, (62, 25), 0.5, (0.14, 0.1), 1.0, (TROUSERS, (0.2, 0.3, 0.7), 6, 5)),
    ("right shin", "right thigh", 0.13, (-8, -22), 0.5, (0.1, 0.06), 1.0, (TROUSERS, (0.2, 0.3, 0.7), 6, 5)),
    ("right foot", "right shin", 0.13, (80, 66), 0.2, (0.07, 0.06), 0.9, (SHOE, SHIRT, 0, 3)),
    ("left thigh", "hip", -0.13, (-28, 8), 0.5, (0.14, 0.1), 1.0, (TROUSERS, (0.2, 0.3, 0.7), 6, 5)),
    ("left shin", "left thigh", -0.13, (-100, -78), 0.5, (0.1, 0.06), 1.0, (TROUSERS, (0.2, 0.3, 0.7), 6, 5)),
    ("left foot", "left shin", -0.13, (-22, 4), 0.2, (0.07, 0.06), 0.9, (SHOE, SHIRT, 0, 3)),
    ("right arm", "trunk", 0.34, (-58, -18), 0.36, (0.1, 0.08), 1.0, (SHIRT, (0.95, 0.9, 0.8), 0, 5)),
    ("right forearm", "right arm", 0.34, (20, 70), 0.36, (0.07, 0.05), 1.0, (SKIN, (0.6, 0.3, 0.2), 2, 8)),
    ("left arm", "trunk", -0.34, (48, 8), 0.36, (0.1, 0.08), 1.0, (SHIRT, (0.95, 0.9, 0.8), 0, 5)),
    ("left forearm", "left arm", -0.34, (135, 95), 0.36, (0.07, 0.05), 1.0, (SKIN, (0.6, 0.3, 0.2), 2, 8)),
)


Pose = dict[str, tuple[Tensor, Tensor]]  # each limb's base (3,) and rotation (3, 3)


def pose(share: float, hip: tuple[float, float]) -> Pose:
    """Return where the limbs are in a share of the stride, limbs hanging on limbs, from the hip's place on."""
    facing = rotation((0, 1, 0), -35)
    joints = {"hip": torch.tensor([*hip, 0.0], dtype=torch.float64)}
    poses = {}
    for name, parent, sideways, (first, last), length, *_ in LIMBS:
        base = joints[parent] * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
        base = base + torch.tensor([0.0, 0.0, sideways], dtype=torch.float64)
        turn = rotation((0, 0, 1), (1 - share) * first + share * last - 180)
        joints[name] = base + turn @ torch.tensor([0.0, length, 0.0], dtype=torch.float64)
        poses[name] = FIGURE_SCALE * facing @ base, FIGURE_SCALE * facing @ turn
    return poses


def stride(length: float = 1.0) -> list[Pose]:
    """Return the two ends of a stride, `length` times as long."""
    return [pose(end, (-0.1 + 0.25 * end, -0.15 + 0.06 * end)) for end in (0.0, length)]


def figure(size: int, poses: Sequence[Pose], detail: tuple[int, int] = (16, 6)) -> list[tb.Mesh]:
    """Return the figure's limbs, moving linearly between poses at equally spaced times; `detail` counts the triangles
    around a limb and along its round ends: 14 x 2 around (3 along + 1) in all.
    """
    meshes = []
    for k, (name, *_, length, radii, flat, (colour, other, across, along)) in enumerate(LIMBS):
        vertices, faces, uv = capsule(length, radii, flat, *detail)
        motion = torch.stack([vertices @ turn.T + base for base, turn in (p[name] for p in poses)])
        look = textured(_cloth(max(8, size // 6), (colour, other), (across, along), seed=k))
        meshes.append(tb.Mesh(motion, faces, look, name=name, uv=uv))
    return meshes


# --- textures: (h, w, 3) linear, row 0 on top ---


def _texels(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return u and v (h, w) of the centres of a texture's texels."""
    u, v = (np.arange(width) + 0.5) / width, 1 - (np.arange(height) + 0.5) / height
    return np.meshgrid(u, v)


def _mix(first: Sequence[float], second: Sequence[float], share: np.ndarray) -> np.ndarray:
    """Return (h, w, 3): `first` where `share` is 0, `second` where it is 1."""
    return np.asarray(first) * (1 - share[..., None]) + np.asarray(second) * share[..., None]


def _wood(height: int, width: int) -> np.ndarray:
    """Return wood whose grain runs along u in fine lines, bent by two knots."""
    u, v = _texels(height, width)
    ring = v + 0.03 * np.sin(7 * u + 1) + 0.015 * np.sin(17 * u + 4 * v)
    for x, y in ((0.22, 0.65), (0.73, 0.3)):
        ring = ring + 0.12 * (v - y) * np.exp(-(((u - x) / 0.06) ** 2) - ((v - y) / 0.3) ** 2)
    lines = (0.5 + 0.5 * np.cos(2 * np.pi * 9 * ring)) ** 4
    fibre = np.random.default_rng(1).uniform(-1, 1, (height, 1)) * (0.5 + 0.5 * np.sin(9 * u))
    return _mix((0.72, 0.42, 0.18), (0.1, 0.035, 0.01), np.clip(0.9 * lines + 0.06 * fibre, 0, 1))


def _chip_look(n: int) -> np.ndarray:
    """Return a chip's look: on the left its round side with a striped middle, on the right its rim."""
    u, v = _texels(n, 2 * n)
    x, y = (u - 0.25) / 0.245, (v - 0.5) / 0.49
    radius, turn = np.hypot(x, y), np.arctan2(y, x) / (2 * np.pi)
    spots = _mix((0.75, 0.03, 0.05), (1.0, 0.95, 0.85), (np.floor(16 * turn) % 2))
    stripe = np.floor(12 * (x + 1)).astype(int) % 4
    colours = np.array([(0.05, 0.25, 0.6), (1.0, 0.8, 0.1), (0.95, 0.95, 0.95), (0.05, 0.45, 0.2)])
    disc = np.where((radius < 0.68)[..., None], colours[stripe], spots)
    rim = _mix((0.75, 0.03, 0.05), (1.0, 0.95, 0.85), np.floor((u - 0.51) / 0.48 * 16) % 2)
    return np.where((u < 0.5)[..., None], disc, rim)


def _cloth(n: int, colours: Sequence[Sequence[float]], checks: tuple[int, int], seed: int) -> np.ndarray:
    """Return cloth of two colours in so many checks around and along, 0 for none, with a fine weave."""
    u, v = _texels(n, n)
    around, along = (np.floor(2 * count * place) % 2 for count, place in zip(checks, (u, v), strict=True))
    weave = np.random.default_rng(seed).uniform(0.75, 1, (n, n, 1))
    return _mix(*colours, np.abs(around - along)) * weave


def rings(n: int, count: int) -> np.ndarray:
    """Return `count` bright rings on dark ground."""
    u, v = _texels(n, n)
    return _mix((0.15,) * 3, (1.0,) * 3, (np.hypot(u - 0.5, v - 0.5) * 2 * count) % 1 < 0.5)


def stripes(n: int, count: int) -> np.ndarray:
    """Return `count` bright diagonal stripes on dark ground."""
    u, v = _texels(n, n)
    return _mix((0.15,) * 3, (1.0,) * 3, ((u + v) * count) % 1 < 0.5)
