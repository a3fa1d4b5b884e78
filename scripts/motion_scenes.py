"""Scenes of motions that are curved, fast or lit: a helicopter, tumbling teapots, a jump, and a shadow on a floor.

All are deterministic, in float64, sized by the height of the image. Shapes, looks and motions are ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import paper_scenes
import torch
from torch import Tensor

import torchblur as tb

Solid = tuple[Tensor, Tensor, Tensor]  # vertices (V, 3), faces (F, 3), uv (F, 3, 2)
PIECES = 12  # linear pieces of a turn
SKY = (0.5, 0.62, 0.8)
F64 = torch.float64


def helicopter(size: int = 256) -> tb.Scene:
    """Return a helicopter that drifts, its four blades and its tail rotor turning, in twelve linear pieces."""
    drift = torch.linspace(-0.06, 0.06, PIECES + 1, dtype=F64).unsqueeze(1) * torch.tensor([1.0, 0.3, 0.0], dtype=F64)
    cabin = _tube(
        [(-0.75, 0, 0), (-0.6, 0, 0), (-0.3, 0, 0), (0.15, 0, 0), (0.5, 0.04, 0)], (0, 0.3, 0.42, 0.34, 0), 20
    )
    boom = _tube([(0.2, 0.08, 0), (1.35, 0.22, 0)], (0.14, 0.05), 8)
    mast = _tube([(-0.15, 0.35, 0), (-0.15, 0.58, 0)], (0.04, 0.04), 6)
    skids = [_tube([(-0.7, -0.52, z), (0.4, -0.52, z)], (0.03, 0.03), 6) for z in (-0.3, 0.3)]
    fin = _sheet([(1.25, 0.2, 0), (1.42, 0.2, 0), (1.5, 0.55, 0), (1.38, 0.55, 0)])
    body = [(cabin, (0.75, 0.12, 0.1)), (boom, (0.9, 0.9, 0.9)), (mast, (0.2, 0.2, 0.2)), (fin, (0.75, 0.12, 0.1))]
    meshes = [_rigid(solid, colour, [torch.eye(3, dtype=F64)] * (PIECES + 1), drift) for solid, colour in body]
    meshes += [_rigid(s, (0.15, 0.15, 0.18), [torch.eye(3, dtype=F64)] * (PIECES + 1), drift) for s in skids]
    for count, reach, width, axis, degrees, hub in (
        (4, 1.5, 0.07, (0, 1, 0), 77.0, (-0.15, 0.6, 0.0)),
        (3, 0.3, 0.035, (0, 0, 1), 200.0, (1.4, 0.3, 0.06)),
    ):
        turns = [paper_scenes.rotation(axis, degrees * k / PIECES) for k in range(PIECES + 1)]
        place = drift + torch.tensor(hub, dtype=F64)
        for blade in range(count):
            upright = paper_scenes.rotation(axis, 360 * blade / count + 20)
            corner = [(0.08, -width), (reach, -width), (reach, width), (0.08, width)]
            flat = [(x, 0, y) if axis[1] else (x, y, 0) for x, y in corner]
            colour = (0.85, 0.2, 0.1) if blade == 0 else (0.12, 0.12, 0.14)
            meshes.append(_rigid(_sheet(flat), colour, [t @ upright for t in turns], place))
    camera = tb.Camera.look_at(
        (-1.6, 1.5, 4.2), (0.15, 0.1, 0), fov_y_deg=38, width=size, height=size, near=0.5, far=20
    )
    return tb.Scene(meshes, camera, SKY)


def teapots(size: int = 256) -> tb.Scene:
    """Return three glazed teapots under a sun, each tumbling about its own axis, in twelve linear pieces."""
    meshes = []
    flights = (
        ((-0.95, 0.75, 0.0), (0.1, -0.25, 0.0), (1, 0.4, 0.2), 75, (0.2, 0.45, 0.75)),
        ((0.95, 0.55, -0.4), (-0.2, 0.1, 0.0), (0.2, 0.3, 1), -95, (0.8, 0.55, 0.15)),
        ((0.0, -0.85, 0.3), (0.15, 0.3, 0.0), (0.1, 1, 0.3), 120, (0.65, 0.2, 0.25)),
    )
    for place, way, axis, degrees, colour in flights:
        turns = [paper_scenes.rotation(axis, degrees * (k / PIECES - 0.5)) for k in range(PIECES + 1)]
        share = torch.linspace(-0.5, 0.5, PIECES + 1, dtype=F64).unsqueeze(1)
        path = torch.tensor(place, dtype=F64) + share * torch.tensor(way, dtype=F64)
        meshes += [_rigid(part, colour, turns, path, shading="lambert") for part in _teapot(0.62)]
    sun = tb.DirectionalLight((-0.4, -1.0, -0.8), 2.6, casts_shadows=False)
    camera = paper_scenes.still_camera(size, size)
    return tb.Scene(meshes, camera, paper_scenes.BACKDROP, lights=[sun], ambient=(0.18, 0.18, 0.2))


def jump(size: int = 256) -> tb.Scene:
    """Return a figure that leaps along a parabola, limbs swinging, in eight linear pieces."""
    shares = [k / 8 for k in range(9)]
    poses = [paper_scenes.pose(s, (-0.35 + 0.6 * s, -0.25 + 1.2 * s * (1 - s) + 0.15 * s)) for s in shares]
    return tb.Scene(paper_scenes.figure(size, poses), paper_scenes.still_camera(size, size), paper_scenes.BACKDROP)


def shadowed_floor(size: int = 256) -> tb.Scene:
    """Return a cross that spins and a kite that slides above a floor at rest, lit by a lamp whose shadows they cast."""
    floor = _sheet([(-4, 0, 3.5), (4, 0, 3.5), (4, 0, -4), (-4, 0, -4)])
    arms = [_sheet([(-1.1, 0, 0.16), (1.1, 0, 0.16), (1.1, 0, -0.16), (-1.1, 0, -0.16)])]
    arms += [_sheet([(0.16, 0, 0.8), (0.16, 0, 0.16), (-0.16, 0, 0.16), (-0.16, 0, 0.8)])]
    arms += [_sheet([(0.16, 0, -0.16), (0.16, 0, -0.8), (-0.16, 0, -0.8), (-0.16, 0, -0.16)])]
    turns = [paper_scenes.rotation((0, 1, 0), 15 + 70 * k / PIECES) for k in range(PIECES + 1)]
    above = torch.tensor([[-0.7, 1.1, 0.2]], dtype=F64).expand(PIECES + 1, 3)
    matte = tb.Material((0.75, 0.74, 0.7), shading="lambert")
    meshes = [tb.Mesh(floor[0], floor[1], matte, name="floor")]
    meshes += [_rigid(arm, (0.8, 0.3, 0.15), turns, above, shading="lambert") for arm in arms]
    kite = _sheet([(-0.45, 0, 0), (0, 0.1, 0.35), (0.6, 0, 0), (0, 0.1, -0.35)])
    slide = torch.tensor([[0.5, 0.7, 1.2], [1.7, 0.9, 0.3]], dtype=F64)
    meshes.append(_rigid(kite, (0.2, 0.45, 0.7), [torch.eye(3, dtype=F64)] * 2, slide, shading="lambert"))
    camera = tb.Camera.look_at((0, 3.9, 5.6), (0, 0.3, 0), fov_y_deg=42, width=size, height=size, near=0.5, far=30)
    lamp = tb.PointLight((1.0, 5.0, 1.5), 60.0)
    return tb.Scene(meshes, camera, (0.05, 0.06, 0.08), lights=[lamp], ambient=(0.07, 0.07, 0.08))


SCENES: dict[str, Callable[[int], tb.Scene]] = {
    "helicopter": helicopter,
    "teapots": teapots,
    "jump": jump,
    "shadowed floor": shadowed_floor,
}


def _rigid(
    solid: Solid, colour: Sequence[float], turns: Sequence[Tensor], places: Tensor, shading: str = "unlit"
) -> tb.Mesh:
    """Return a solid turned and put at each of the places (K+1, 3), its faces striped in two shades of a colour."""
    vertices, faces, _ = solid
    motion = torch.stack([vertices @ turn.T for turn in turns]) + places.unsqueeze(1)
    shade = torch.where((torch.arange(len(faces)) // 2) % 2 == 0, 1.0, 0.72).to(F64).unsqueeze(1)
    look = tb.Material(shade * torch.tensor(colour, dtype=F64), shading=shading)
    return tb.Mesh(motion, faces, look)


def _sheet(corners: Sequence[tuple[float, float, float]]) -> Solid:
    """Return a flat quadrilateral, counter-clockwise from the side that is to be seen."""
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    return torch.tensor(corners, dtype=F64), faces, torch.zeros(2, 3, 2, dtype=F64)


def _tube(path: Sequence[tuple[float, float, float]], radii: Sequence[float], n_around: int) -> Solid:
    """Return a tube about a path in a plane of constant z, with a radius at each point; radius 0 closes it."""
    points = torch.tensor(path, dtype=F64)
    ahead = torch.cat([points[1:2] - points[:1], points[2:] - points[:-2], points[-1:] - points[-2:-1]])
    ahead = ahead / ahead.norm(dim=1, keepdim=True)
    side = torch.stack([-ahead[:, 1], ahead[:, 0], torch.zeros(len(path), dtype=F64)], dim=1)
    angle = torch.arange(n_around, dtype=F64) * (2 * math.pi / n_around)
    across = torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    ring = angle.cos().reshape(1, -1, 1) * side.unsqueeze(1) + angle.sin().reshape(1, -1, 1) * across
    vertices = points.unsqueeze(1) + torch.tensor(radii, dtype=F64).reshape(-1, 1, 1) * ring
    j, i = (g.flatten() for g in torch.meshgrid(torch.arange(len(path) - 1), torch.arange(n_around), indexing="ij"))
    a, b = j * n_around + i, j * n_around + (i + 1) % n_around
    quads = torch.stack([torch.stack([a, b, b + n_around], 1), torch.stack([a, b + n_around, a + n_around], 1)], 1)
    faces = quads.reshape(-1, 3)
    corner = vertices.reshape(-1, 3)[faces]
    area = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).norm(dim=1)
    faces = faces[area > 1e-12]
    return vertices.reshape(-1, 3), faces, torch.zeros(len(faces), 3, 2, dtype=F64)


def _teapot(scale: float) -> list[Solid]:
    """Return a pot with its lid, a spout and a handle."""
    profile = (
        (0.0, -0.52),
        (0.55, -0.5),
        (0.82, -0.25),
        (0.85, 0.05),
        (0.6, 0.4),
        (0.5, 0.45),
        (0.3, 0.52),
        (0.08, 0.55),
    )
    knob = ((0.12, 0.64), (0.0, 0.72))
    upright = [(0.0, y, 0.0) for _, y in (*profile, *knob)]
    body = _tube(upright, [r for r, _ in (*profile, *knob)], 18)
    spout = _tube([(0.7, -0.15, 0), (1.0, -0.02, 0), (1.15, 0.25, 0), (1.35, 0.42, 0)], (0.2, 0.15, 0.1, 0.08), 8)
    bend = [(-0.75 - 0.5 * math.sin(a), 0.05 + 0.32 * math.cos(a), 0.0) for a in torch.linspace(0, math.pi, 8).tolist()]
    handle = _tube(bend, [0.06] * 8, 6)
    return [(scale * vertices, faces, uv) for vertices, faces, uv in (body, spout, handle)]
