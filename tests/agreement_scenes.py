"""Fourteen small scenes that differ in everything the renderer distinguishes; used by agreement and fault tests."""

from __future__ import annotations

import numpy as np
import scene_makers as make
from oracles import PlainMesh, PlainScene

SIZE = 10  # pixels a side
BACKGROUND = (0.2, 0.4, 0.6)
TILT = make.rotation_y(0.6) @ make.rotation_z(0.4)


def _soup(seed: int, n: int, **kw) -> PlainScene:
    return make.random_soup(np.random.default_rng(seed), n, width=SIZE, height=SIZE, **kw)


def _perspective(meshes, matrix=None) -> PlainScene:
    matrix = make.perspective((0.3, 0.5, 5)) if matrix is None else matrix
    return PlainScene(meshes, matrix, SIZE, SIZE, BACKGROUND)


def _turning_box(n_segments: int, angle: float = 1.2, **material) -> PlainMesh:
    colors = np.random.default_rng(5).uniform(0, 1, (12, 3))
    return make.box_mesh(
        (0.1, 0, 0),
        (1.7, 1.1, 2.3),
        lambda v: make.rotated(v @ TILT.T, angle, n_segments, make.rotation_y),
        color=colors,
        **material,
    )


def crossing() -> PlainScene:
    """Planes that tilt through each other, several crossings a pixel."""
    generator = np.random.default_rng(8)
    meshes = []
    for opacity in (1.0, 0.5, 0.7, 0.4):
        plane = make.quad(-1.33, 1.21, -1.12, 1.44, 0, 1, color=generator.uniform(0, 1, 3), opacity=opacity)
        plane.vertices[..., 2] = generator.uniform(-0.9, 0.9, (2, 4))
        meshes.append(plane)
    return PlainScene(meshes, make.IDENTITY, SIZE, SIZE, BACKGROUND)


def near_plane() -> PlainScene:
    """Triangles whose vertices pass the camera plane in both directions."""
    generator = np.random.default_rng(3)
    n = 8
    z = np.stack([generator.uniform(-0.5, 4, 3 * n), generator.uniform(-2, 3, 3 * n)])
    vertices = np.concatenate([generator.uniform(-2, 2, (2, 3 * n, 2)), z[..., None]], -1)
    colors = generator.uniform(0, 1, (n, 3))
    mesh = PlainMesh(vertices, np.arange(3 * n).reshape(n, 3), colors, generator.choice([1.0, 0.5], n))
    return PlainScene([mesh], make.w_is_z(), SIZE, SIZE, BACKGROUND)


def slivers() -> PlainScene:
    """Long thin triangles, much thinner than a pixel."""
    generator = np.random.default_rng(4)
    n = 36
    a, b = generator.uniform(-1.5, 1.5, (2, n, 3))
    vertices = np.stack([a, b, b + generator.uniform(-0.05, 0.05, (n, 3))], 1)
    vertices[..., 2] = generator.uniform(-0.8, 0.8, (n, 1)) + generator.uniform(-0.05, 0.05, (n, 3))
    knots = np.stack([vertices, vertices + generator.uniform(-0.6, 0.6, (n, 1, 3)) * np.array([1, 1, 0])])
    mesh = PlainMesh(knots.reshape(2, -1, 3), np.arange(3 * n).reshape(n, 3), generator.uniform(0, 1, (n, 3)), 0.8)
    return PlainScene([mesh], make.IDENTITY, SIZE, SIZE, BACKGROUND)


def many_layers() -> PlainScene:
    """Eleven translucent sheets sliding at different speeds."""
    generator = np.random.default_rng(6)
    meshes = []
    for z in np.linspace(-0.9, 0.9, 11):
        x, y = generator.uniform(-1.5, 0, 2)
        shift = generator.uniform(-0.8, 0.8, 2)
        meshes.append(
            make.quad(x, x + 1.7, y, y + 1.6, z, z + 0.04, shift=shift, color=generator.uniform(0, 1, 3), opacity=0.3)
        )
    return PlainScene(meshes, make.IDENTITY, SIZE, SIZE, BACKGROUND)


def moving_camera() -> PlainScene:
    """A camera on a curved path of three segments, a mesh of two segments, and a static floor."""
    eyes = [(-0.6, 0.5, 4.5), (-0.1, 0.7, 4.2), (0.3, 0.6, 4.4), (0.9, 0.3, 4.6)]
    matrix = np.stack([make.perspective(e, fov_deg=50) for e in eyes])
    floor = PlainMesh([[-3, -1, -3], [3, -1, -3], [3, -0.9, 3], [-3, -0.9, 3]], [[0, 1, 2], [0, 2, 3]], (0.3, 0.5, 0.2))
    return _perspective([_turning_box(2, opacity=0.7), floor], matrix)


def static_and_moving() -> PlainScene:
    """Static triangles with moving ones among them."""
    generator = np.random.default_rng(12)
    moving = make.random_triangles(generator, 12, opacity=generator.choice([1.0, 0.5], 12))
    static = make.random_triangles(generator, 12, opacity=0.6)
    static.vertices = static.vertices[0]
    return PlainScene([static, moving], make.IDENTITY, SIZE, SIZE, BACKGROUND)


def fast() -> PlainScene:
    """Small triangles that cross the whole image and more."""
    generator = np.random.default_rng(13)
    mesh = make.random_triangles(generator, 30, size=0.25, motion=3.0, extent=1.5, opacity=0.9)
    return PlainScene([mesh], make.IDENTITY, SIZE, SIZE, BACKGROUND)


def orthographic_view() -> PlainScene:
    """A turning box seen by an orthographic camera that is not the identity."""
    matrix = np.diag([0.55, 0.55, -0.2, 1.0])  # looks down -z, near and far at z = 5 and -5
    return _perspective(
        [_turning_box(3, opacity=0.6), make.quad(-0.7, 1.6, -0.2, 1.3, 1.5, -1.5, color=(1, 0, 0))], matrix
    )


def one_sided() -> PlainScene:
    """A closed box of front faces only, and a one-sided sheet that turns away."""
    sheet = PlainMesh(
        [[-1.5, -1, 1.6], [0.2, -1.1, 1.6], [-0.4, 1.2, 1.6]], [[0, 1, 2]], (1, 1, 0), 0.8, double_sided=False
    )
    sheet.vertices = make.rotated(sheet.vertices, 2.5, 4, make.rotation_y)
    return _perspective([_turning_box(4, double_sided=False, opacity=0.5), sheet])


SCENES = {
    "opaque": lambda: _soup(1, 30, opacity=1.0),
    "transparent": lambda: _soup(2, 24, opacity=np.random.default_rng(2).uniform(0.1, 0.9, 24)),
    "crossing": crossing,
    "near plane": near_plane,
    "rotating, K = 1": lambda: _perspective([_turning_box(1, opacity=0.6)]),
    "rotating, K = 8": lambda: _perspective([_turning_box(8, opacity=0.6)]),
    "orthographic": orthographic_view,
    "static and moving": static_and_moving,
    "slivers": slivers,
    "moving camera": moving_camera,
    "one-sided": one_sided,
    "many layers": many_layers,
    "fast": fast,
    "four segments": lambda: _soup(3, 20, n_segments=4),
}
