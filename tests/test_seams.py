"""Swept closed meshes show no seam: where a mesh fills the view all the time, coverage is 1 and alpha is its opacity.

Tolerances are the stated ones: 1e-12 in float64 and 1e-6 in float32, for every pixel.
"""

from __future__ import annotations

import numpy as np
import pytest
import scene_makers as make
import torch
from oracles import PlainMesh, PlainScene

ATOL = {torch.float64: 1e-12, torch.float32: 1e-6}


def sphere(n_splits: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return an octahedron split n times, vertices on the unit sphere."""
    vertices = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    points = [np.array(v, dtype=np.float64) for v in vertices]
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    for _ in range(n_splits):
        middle_of, split = {}, []
        for face in faces:
            ends = [(face[i], face[(i + 1) % 3]) for i in range(3)]
            for a, b in ends:
                if frozenset((a, b)) not in middle_of:
                    middle_of[frozenset((a, b))] = len(points)
                    middle = points[a] + points[b]
                    points.append(middle / np.linalg.norm(middle))
            m = [middle_of[frozenset(e)] for e in ends]
            split += [(face[0], m[0], m[2]), (face[1], m[1], m[0]), (face[2], m[2], m[1]), tuple(m)]
        faces = split
    return np.array(points), np.array(faces)


def shell_knots(kind: str, generator: np.random.Generator) -> np.ndarray:
    """Return knots of a closed shell of radius about 3 around the camera; never nearer than 1."""
    points, _ = sphere()
    points = 3 * points
    spin = make.rotation_y(0.3) @ make.rotation_z(0.2)
    if kind == "static":
        return points @ spin.T
    if kind == "translation":
        return np.stack([points, points + generator.uniform(-0.8, 0.8, 3)])
    if kind == "rotation":
        return make.rotated(points @ spin.T, 1.0, 4, make.rotation_y)
    if kind == "fast rotation of one segment":
        return make.rotated(points @ spin.T, 1.5, 1, make.rotation_y)
    # every vertex on its own, less than a third of an edge (1.5 at radius 3) away
    return points + generator.uniform(-0.25, 0.25, (4, *points.shape))


KINDS = ["static", "translation", "rotation", "fast rotation of one segment", "every vertex on its own"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("opacity", [0.5, 1.0])
def test_camera_inside_a_closed_shell(kind, opacity, dtype):
    """From inside, every ray meets the shell exactly once, with triangles beside and behind the camera too."""
    generator = np.random.default_rng(1)
    mesh = PlainMesh(shell_knots(kind, generator), generator.permutation(sphere()[1]), opacity=opacity)
    matrix = make.perspective((0.1, 0.05, 0.2), (0.3, 0.1, -1), fov_deg=100, near=0.05, far=50)
    frame = make.render(PlainScene([mesh], matrix, 18, 14), dtype)
    alpha, coverage = frame.rgba[..., 3], frame.coverage
    torch.testing.assert_close(coverage, torch.ones_like(coverage), rtol=0, atol=ATOL[dtype])
    torch.testing.assert_close(alpha, torch.full_like(alpha, opacity), rtol=0, atol=ATOL[dtype])


@pytest.mark.parametrize("kind", KINDS)
def test_camera_outside_meets_front_and_back_once(kind, dtype):
    """From outside, every ray near the middle enters and leaves: two layers, one of them of front faces."""
    generator = np.random.default_rng(3)
    mesh = PlainMesh(shell_knots(kind, generator), sphere()[1], opacity=0.5)
    matrix = make.perspective((0, 0, 9), fov_deg=10, near=0.1, far=50)
    for double_sided, expected in ((True, 0.75), (False, 0.5)):
        mesh.double_sided = double_sided
        alpha = make.render(PlainScene([mesh], matrix, 20, 20), dtype).rgba[..., 3]
        torch.testing.assert_close(alpha, torch.full_like(alpha, expected), rtol=0, atol=ATOL[dtype])


@pytest.mark.parametrize("rays", [1, 4])
def test_moving_camera_inside_a_static_shell(rays, dtype):
    generator = np.random.default_rng(4)
    mesh = PlainMesh(shell_knots("static", generator), sphere()[1], opacity=0.5)
    targets = [(0.3, 0.1, -1), (0.8, 0.2, -1), (1.2, -0.2, -0.6)]
    matrix = np.stack([make.perspective((0.1 * k, 0, 0.2), p, fov_deg=80, near=0.05) for k, p in enumerate(targets)])
    frame = make.render(PlainScene([mesh], matrix, 20, 16), dtype, rays_per_pixel=rays)
    alpha = frame.rgba[..., 3]
    torch.testing.assert_close(alpha, torch.full_like(alpha, 0.5), rtol=0, atol=ATOL[dtype])


def test_float32_vertices_shared_by_position_only():
    """Faces that repeat a vertex instead of sharing its index are just as tight: equal numbers, equal edges."""
    vertices, faces = make.grid(8, 2.0)
    generator = np.random.default_rng(5)
    knots = (vertices + generator.uniform(-0.12, 0.12, (3, *vertices.shape))).astype(np.float32)
    loose = knots[:, faces.reshape(-1)]
    scene = PlainScene([PlainMesh(loose, np.arange(faces.size).reshape(-1, 3), opacity=0.5)], make.IDENTITY, 15, 15)
    for dtype in (torch.float32, torch.float64):
        alpha = make.render(scene, dtype).rgba[..., 3]
        torch.testing.assert_close(alpha, torch.full_like(alpha, 0.5), rtol=0, atol=ATOL[dtype])


def coincident_knots(kind: str, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return knots, faces and matrix of a sheet that fills the view, with all numbers on a dyadic grid.

    Pixel centres of an 8 by 8 image are dyadic too: vertices and edges pass exactly through them, or lie on them.
    """
    vertices, faces = make.grid(12, 3.0)
    if kind == "every vertex on a grid":
        return vertices + generator.integers(-2, 3, (3, *vertices.shape)) / 16, faces, make.IDENTITY
    if kind == "edges slide along the rays":
        shear = np.eye(3)
        shear[0, 1] = generator.integers(-2, 3) / 4
        shift = np.array([*generator.integers(-2, 3, 2), 0]) / 4
        return np.stack([vertices, vertices @ shear.T + shift]), faces, make.IDENTITY
    start = vertices * np.array([6, 6, 1]) + np.array(
        [0, 0, 2]
    )  # comes and goes along the axis: vertices move on rays through the centre
    return np.stack([start, start + np.array([0, 0, generator.integers(1, 9) / 4])]), faces, make.w_is_z(0.25, 64)


@pytest.mark.parametrize("kind", ["every vertex on a grid", "edges slide along the rays", "towards the camera"])
@pytest.mark.parametrize("seed", range(4))
def test_coincidences_on_a_dyadic_grid(kind, seed, dtype):
    generator = np.random.default_rng(seed)
    knots, faces, matrix = coincident_knots(kind, generator)
    mesh = PlainMesh(knots, generator.permutation(faces), opacity=0.5)
    alpha = make.render(PlainScene([mesh], matrix, 8, 8), dtype).rgba[..., 3]
    torch.testing.assert_close(alpha, torch.full_like(alpha, 0.5), rtol=0, atol=ATOL[dtype])
