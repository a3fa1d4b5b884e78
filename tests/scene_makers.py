"""Small scenes as plain arrays, and the one place where they become torchblur scenes."""

from __future__ import annotations

import numpy as np
import torch
from oracles import PlainMesh, PlainScene

import torchblur as tb

IDENTITY = np.eye(4)  # orthographic: NDC x, y = world x, y; nearer = smaller z; near and far at z = -1 and 1


def w_is_z(near: float = 0.1, far: float = 100.0) -> np.ndarray:
    """Return a perspective matrix whose clip x, y are world x, y and whose w is world z."""
    al, be = (far + near) / (far - near), -2 * far * near / (far - near)
    return np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, al, be], [0, 0, 1, 0]], dtype=np.float64)


def perspective(
    eye=(0.0, 0.0, 5.0), target=(0.0, 0.0, 0.0), fov_deg=45.0, aspect=1.0, near=0.1, far=100.0
) -> np.ndarray:
    """Return an OpenGL look-at perspective matrix, y up."""
    eye, target = np.asarray(eye, float), np.asarray(target, float)
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    view = np.eye(4)
    view[:3, :3] = [right, up, back]
    view[:3, 3] = -view[:3, :3] @ eye
    f = 1 / np.tan(np.radians(fov_deg) / 2)
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1] = f / aspect, f
    projection[2, 2], projection[2, 3] = (far + near) / (near - far), 2 * far * near / (near - far)
    projection[3, 2] = -1
    return projection @ view


def to_torch(scene: PlainScene, dtype=torch.float64, device="cpu") -> tb.Scene:
    """Return the torchblur scene of a plain one."""

    def tensor(array):
        return torch.tensor(array.copy(), dtype=dtype, device=device)

    meshes = [
        tb.Mesh(
            tensor(m.vertices),
            torch.tensor(m.faces.copy(), device=device),
            tb.Material(color=tensor(m.color), opacity=tensor(m.opacity), double_sided=m.double_sided),
        )
        for m in scene.meshes
    ]
    matrix = torch.as_tensor(scene.world_to_clip, dtype=torch.float64, device=device)
    camera = tb.Camera(matrix, scene.width, scene.height)
    return tb.Scene(meshes=meshes, camera=camera, background=tensor(scene.background))


def render(scene: PlainScene, dtype=torch.float64, device="cpu", t_open=0.0, t_close=1.0, **options) -> tb.Frame:
    """Render a plain scene over a window of the exposure."""
    return tb.render(to_torch(scene, dtype, device), shutter=tb.Shutter.box(t_open, t_close), **options)


def triangle(start, end=None, z=0.0, **material) -> PlainMesh:
    """Return one triangle from (3, 2) or (3, 3) vertices at open and close."""

    def with_z(v):
        v = np.asarray(v, dtype=np.float64)
        return v if v.shape[-1] == 3 else np.concatenate([v, np.full((len(v), 1), z)], -1)

    vertices = with_z(start) if end is None else np.stack([with_z(start), with_z(end)])
    return PlainMesh(vertices, [[0, 1, 2]], **material)


def quad(x0, x1, y0, y1, z0, z1=None, shift=(0.0, 0.0), **material) -> PlainMesh:
    """Return an axis-parallel rectangle of two triangles that moves by `shift` and from depth z0 to z1."""
    start = np.array([[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]], dtype=np.float64)
    z1 = z0 if z1 is None else z1
    end = start + np.array([shift[0], shift[1], z1 - z0])
    vertices = start if z1 == z0 and tuple(shift) == (0.0, 0.0) else np.stack([start, end])
    return PlainMesh(vertices, [[0, 1, 2], [0, 2, 3]], **material)


def slab(t_start: float, t_end: float, z0: float, z1: float, **material) -> PlainMesh:
    """Return a rectangle that covers NDC (0, 0) during exactly [t_start, t_end], at depth z0 + (z1 - z0) t."""
    return quad(-t_end, -t_start, -8, 8, z0, z1, shift=(1.0, 0.0), **material)


def grid(n: int, size: float, z: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n+1)^2 and alternating-diagonal faces of a square [-size, size]^2."""
    ticks = np.linspace(-size, size, n + 1)
    x, y = np.meshgrid(ticks, ticks)
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], -1)
    faces = []
    for j in range(n):
        for i in range(n):
            a, b, c, d = j * (n + 1) + i, j * (n + 1) + i + 1, (j + 1) * (n + 1) + i + 1, (j + 1) * (n + 1) + i
            faces += [[a, b, c], [a, c, d]] if (i + j) % 2 else [[a, b, d], [b, c, d]]
    return vertices, np.array(faces)


def rotation_z(angle: float) -> np.ndarray:
    """Return the rotation about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def rotation_y(angle: float) -> np.ndarray:
    """Return the rotation about y."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def rotated(vertices: np.ndarray, angle: float, n_segments: int, turn=rotation_z) -> np.ndarray:
    """Return (K+1, V, 3) knots of a rotation about the origin."""
    return np.stack([vertices @ turn(angle * k / n_segments).T for k in range(n_segments + 1)])


def box_mesh(center, size, knots=None, **material) -> PlainMesh:
    """Return a closed box, outward faces counter-clockwise; `knots` maps its (8, 3) vertices to (K+1, 8, 3)."""
    corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], dtype=np.float64)
    vertices = corners * np.asarray(size) / 2
    loops = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    faces = [f for a, b, c, d in loops for f in ([a, b, c], [a, c, d])]
    moved = vertices if knots is None else knots(vertices)
    return PlainMesh(moved + np.asarray(center), faces, **material)


def random_triangles(rng, n, *, extent=1.0, size=0.4, motion=0.4, z=(-0.9, 0.9), n_segments=1, **material) -> PlainMesh:
    """Return n loose triangles with independent random motion of every vertex, inside the orthographic depth range."""
    centre = rng.uniform(-extent, extent, (1, n, 1, 3))
    vertices = centre + rng.uniform(-size, size, (1, n, 3, 3))
    moves = rng.uniform(-motion, motion, (n_segments, n, 1, 3)) + 0.5 * rng.uniform(
        -motion, motion, (n_segments, n, 3, 3)
    )
    knots = np.concatenate([vertices, vertices + np.cumsum(moves, 0)])
    depth_shape = (n_segments + 1, n, 3)
    knots[..., 2] = rng.uniform(*z, depth_shape)
    material.setdefault("color", rng.uniform(0, 1, (n, 3)))
    return PlainMesh(knots.reshape(n_segments + 1, -1, 3), np.arange(3 * n).reshape(n, 3), **material)


def random_soup(rng, n, *, width=24, height=20, n_segments=1, opacity=None, **kw) -> PlainScene:
    """Return an orthographic scene of loose moving triangles of mixed opacity over a coloured background."""
    if opacity is None:
        opacity = rng.choice([1.0, 0.3, 0.7], n)
    mesh = random_triangles(rng, n, n_segments=n_segments, opacity=opacity, **kw)
    return PlainScene([mesh], IDENTITY, width, height, background=(0.2, 0.4, 0.6))
