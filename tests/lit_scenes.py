"""Small lit and textured scenes as plain arrays, and the one place where they become torchblur scenes."""

from __future__ import annotations

import dataclasses

import numpy as np
import scene_makers as make
import torch
from oracle_looks import LookMesh, LookScene, PlainLight

import torchblur as tb

UPRIGHT = np.diag([1.0, 1.0, -1.0, 1.0])  # orthographic: NDC x, y = world x, y; the viewer is at z = +1
MIRRORED = np.eye(4)  # the same x and y seen from z = -1, so left and right are swapped
BACKGROUND = (0.2, 0.3, 0.4)


def to_torch(plain: LookScene, dtype=torch.float64, casts_shadows: bool = False) -> tb.Scene:
    """Return the torchblur scene of a plain one."""

    def tensor(array):
        return None if array is None else torch.tensor(np.array(array, dtype=np.float64), dtype=dtype)

    meshes = []
    for m in plain.meshes:
        material = tb.Material(
            tensor(m.color),
            tensor(m.opacity),
            double_sided=m.double_sided,
            texture=tensor(m.texture),
            wrap=m.wrap,
            mipmap=m.mipmap,
            shading=m.shading,
        )
        faces = torch.tensor(m.faces.copy())
        meshes.append(tb.Mesh(tensor(m.vertices), faces, material, uv=tensor(m.uv), normals=tensor(m.normals)))
    camera = tb.Camera(torch.tensor(plain.world_to_clip.copy()), plain.width, plain.height)
    lights = [to_light(light, tensor, casts_shadows) for light in plain.lights]
    return tb.Scene(meshes, camera, tensor(plain.background), lights=lights, ambient=tensor(plain.ambient))


def to_light(light: PlainLight, tensor, casts_shadows: bool) -> tb.PointLight | tb.SpotLight | tb.DirectionalLight:
    """Return the torchblur light of a plain one."""
    if light.kind == "directional":
        return tb.DirectionalLight(tensor(light.direction), tensor(light.power), casts_shadows=casts_shadows)
    if light.kind == "point":
        return tb.PointLight(tensor(light.position), tensor(light.power), casts_shadows=casts_shadows)
    rest = {"inner_angle_deg": light.inner_deg, "outer_angle_deg": light.outer_deg, "casts_shadows": casts_shadows}
    return tb.SpotLight(tensor(light.position), tensor(light.target), tensor(light.power), **rest)


def point(position, power=1.0) -> PlainLight:
    return PlainLight("point", power, position=position)


def sun(direction, power=1.0) -> PlainLight:
    return PlainLight("directional", power, direction=direction)


def spot(position, target, power=1.0, angles=(20.0, 40.0)) -> PlainLight:
    return PlainLight("spot", power, position=position, target=target, inner_deg=angles[0], outer_deg=angles[1])


def plate(corners=None, **material) -> LookMesh:
    """Return a square of two faces, by default in z = 0, whose diagonal misses the centre; corners (4, 3) or knots."""
    if corners is None:
        corners = np.array([[-3.1, -3, 0], [3, -3.3, 0], [3.2, 3, 0], [-3, 3.6, 0]])
    return LookMesh(corners, [[0, 1, 2], [0, 2, 3]], **material)


def one_pixel(mesh, lights=(), ambient=(0.0, 0.0, 0.0), matrix=UPRIGHT, background=(0.0, 0.0, 0.0)) -> LookScene:
    """Return a scene of one or more meshes whose one pixel's centre is NDC (0, 0)."""
    meshes = mesh if isinstance(mesh, list) else [mesh]
    return LookScene(meshes, matrix, 1, 1, background, lights=list(lights), ambient=ambient)


def square_uv(corners: np.ndarray) -> np.ndarray:
    """Return uv (2, 3, 2) of a plate's faces from those of its corners (4, 2)."""
    return np.asarray(corners, dtype=np.float64)[[[0, 1, 2], [0, 2, 3]]]


def backwards(scene: LookScene) -> LookScene:
    """Return the scene with time running backwards."""

    def turned(value, static_ndim):
        value = None if value is None else np.asarray(value, dtype=np.float64)
        return value[::-1] if value is not None and value.ndim > static_ndim else value

    meshes = [
        dataclasses.replace(m, vertices=turned(m.vertices, 2), normals=turned(m.normals, 2)) for m in scene.meshes
    ]
    places = ("position", "target", "direction")
    lights = [dataclasses.replace(k, **{p: turned(getattr(k, p), 1) for p in places}) for k in scene.lights]
    return dataclasses.replace(scene, meshes=meshes, lights=lights, world_to_clip=turned(scene.world_to_clip, 2))


def ball(n_around=6, radius=1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and outward faces of a coarse ball about the origin."""
    rings = [[0, radius, 0]]
    for height in (0.5, -0.4):
        angle = 2 * np.pi * (np.arange(n_around) + height) / n_around
        r = radius * np.sqrt(1 - height**2)
        rings += np.stack([r * np.sin(angle), np.full(n_around, radius * height), r * np.cos(angle)], 1).tolist()
    rings.append([0, -radius, 0])
    faces, last = [], 2 * n_around + 1
    for k in range(n_around):
        a, b = 1 + k, 1 + (k + 1) % n_around
        c, d = a + n_around, b + n_around
        faces += [[0, a, b], [a, c, d], [a, d, b], [c, last, d]]
    return np.array(rings), np.array(faces)


def _scene(meshes, lights, matrix=None, ambient=(0.05, 0.1, 0.15), size=(6, 5)) -> LookScene:
    matrix = make.perspective((0.3, 0.5, 4), fov_deg=34.0, aspect=1.2) if matrix is None else matrix
    return LookScene(meshes, matrix, *size, BACKGROUND, lights=lights, ambient=ambient)


def sliding_plate() -> LookScene:
    """A tilted plate that slides and sinks under a point light and a still sun."""
    corners = np.array([[-1.1, -1, 0.5], [1, -1.3, -0.2], [1.2, 1, 0.1], [-1, 1.1, 0.8]])
    moving = np.stack([corners, corners + np.array([0.7, 0.3, -0.5])])
    lights = [point((0.4, 0.3, 1.2), (2.0, 1.0, 3.0)), sun((0.3, -0.2, -1), (0.5, 0.7, 0.2))]
    return _scene([plate(moving, color=(0.9, 0.5, 0.3))], lights, UPRIGHT)


def spinning_box() -> LookScene:
    """A box that turns in three pieces of motion: flat sides pass the terminator of a sun."""
    colors = np.random.default_rng(5).uniform(0, 1, (12, 3))
    box = make.box_mesh((0.1, 0, 0), (1.7, 1.1, 1.3), lambda v: make.rotated(v, 1.2, 3, make.rotation_y), color=colors)
    mesh = LookMesh(box.vertices, box.faces, color=box.color)
    return _scene([mesh], [sun((-0.9, -0.4, -0.3), 4.0), point((1.2, 1.0, 1.6), (1.0, 2.0, 1.5))])


def smooth_ball() -> LookScene:
    """A ball with moving normals of uneven lengths, under a light that moves along knots of its own."""
    vertices, faces = ball()
    stretch = np.random.default_rng(1).uniform(0.5, 2, (len(vertices), 1))
    turned = make.rotated(vertices, 0.9, 2, make.rotation_y)
    mesh = LookMesh(
        turned + np.array([[[-0.2, 0, 0]], [[0.1, 0.1, 0]], [[0.3, 0, 0]]]), faces, normals=turned * stretch
    )
    way = np.array([[1.5, 0.5, 2], [0.2, 1.4, 1.5], [-1.3, 0.3, 1.2], [-2, -1, 1.5]])
    return _scene([mesh], [point(way, (12.0, 10.0, 8.0))])


def sweeping_spots() -> LookScene:
    """Two spots sweep over a plate, one with a soft border and one with a hard one."""
    floor = plate(np.array([[-3.1, -1, 3], [3, -1.2, 3], [3.2, 0.5, -3], [-3, 0.7, -3]]), color=(0.8, 0.9, 0.7))
    way = np.array([[-1.0, 0, 0], [0.2, -0.3, 0.4], [1, 0, 1], [0, 0, 0]])
    soft = spot((0.3, 2.0, 0.5), way, (25.0, 20.0, 15.0), (8, 25))
    hard = spot(np.array([[-0.5, 1.5, 1], [0.6, 1.7, 0]]), (0.1, -0.2, 0.3), (8.0, 9.0, 14.0), (17, 17))
    return _scene([floor], [soft, hard])


def lit_texture() -> LookScene:
    """A translucent texture turns over an unlit plate, looked up without mip levels, in the light of all kinds."""
    corners = np.array([[-0.9, -1, 0], [1, -0.8, 0.1], [0.9, 1.1, 0], [-1, 0.9, 0.3]])
    moving = np.stack([corners, corners @ make.rotation_z(0.8).T @ make.rotation_y(0.4).T + [0.2, 0, 0.3]])
    texture = np.random.default_rng(3).uniform(0, 1, (4, 3, 4))
    uv = square_uv([[0, 0], [1.3, 0], [1.2, 1], [0.1, 1.1]])
    front = plate(moving, color=(1.0, 0.8, 0.6), opacity=0.9, uv=uv, texture=texture, mipmap=False)
    back = plate(corners * 0.7 - [0, 0, 0.6], color=(0.1, 0.6, 0.2), shading="unlit")
    lights = [point((0.3, 0.5, 2), 9.0), sun((0, -0.5, -1)), spot((1, 0, 2), (0, 0, 0), 4.0)]
    return _scene([front, back], lights)


def flight() -> LookScene:
    """A camera flies over a floor with mip levels in the light of one point; the floor has normals of its own."""
    floor = plate(np.array([[-3.1, -1, 2], [3, -1, 2], [3.2, -0.8, -7], [-3, -1, -7]]), wrap="clamp")
    texture = np.random.default_rng(4).uniform(0, 1, (24, 16, 3))
    normals = np.array([[0.2, 1, 0], [-0.3, 1, 0.1], [0, 1, 0.2], [0, 1, -0.3]])
    floor = dataclasses.replace(
        floor, uv=square_uv([[0, 0], [1, 0], [1, 1], [0, 1]]), texture=texture, normals=normals, color=(1.0, 0.9, 1.1)
    )
    matrix = np.stack([make.perspective((x, 0.4, 3 - x), (x / 2, 0, 0), aspect=1.2) for x in (0.0, 0.3, 0.9)])
    return _scene([floor], [point((0.5, 0.6, 0.2), 9.0)], matrix)


def crossing_planes() -> LookScene:
    """Translucent planes tilt through each other and past the light, which falls on the side that is seen."""
    generator, meshes = np.random.default_rng(8), []
    for opacity in (1.0, 0.5, 0.7):
        corners = make.quad(-1.33, 1.21, -1.12, 1.44, 0, 1).vertices
        corners[..., 2] = generator.uniform(-0.9, 0.9, (2, 4))
        meshes.append(plate(corners, color=generator.uniform(0, 1, 3), opacity=opacity))
    return _scene(meshes, [point((0.2, 0.3, 0.1), 0.5), sun((1, 0.3, -0.4))], UPRIGHT)


def mirrored_soup() -> LookScene:
    """Loose triangles turn over before a mirrored camera; one-sided and two-sided, flat and smooth, soft light."""
    generator, meshes = np.random.default_rng(12), []
    for double_sided, smooth in ((False, True), (True, False), (True, True)):
        soup = make.random_triangles(generator, 8, size=0.8, n_segments=2, opacity=generator.choice([1.0, 0.6], 8))
        normals = generator.normal(size=soup.vertices.shape) * 0.4 - [0, 0, 1] if smooth else None
        material = {"color": soup.color, "opacity": soup.opacity, "double_sided": double_sided}
        meshes.append(LookMesh(soup.vertices, soup.faces, normals=normals, **material))
    lights = [point((0.5, 0.2, -2.5), (4.0, 5.0, 6.0)), spot((-0.5, 0, -2), (0.2, 0, 0), 6.0, (5, 35))]
    return _scene(meshes, lights, MIRRORED)


def leaving_plate() -> LookScene:
    """A tilted plate with a fine texture flies away and turns, unlit and lit halves, through several mip levels."""
    near = np.array([[-1.2, -1, 1], [1.1, -1.2, 0.5], [1.3, 1, 0], [-1, 1.1, 0.4]])
    moving = np.stack([near, near * 1.5 + [0.3, 0.1, -6]])
    uv = square_uv([[0, 0], [1, 0], [1, 1], [0, 1]])
    texture = np.random.default_rng(6).uniform(0, 1, (21, 33, 4))
    back = plate(near * 2 - [0, 0, 7], shading="unlit", uv=uv, texture=texture[:, :, :3], color=(0.9, 1.0, 0.8))
    return _scene([plate(moving, uv=uv, texture=texture), back], [sun((0.1, -0.3, -1), 5.0)])


SCENES = {
    make_scene.__name__: make_scene
    for make_scene in (
        sliding_plate,
        spinning_box,
        smooth_ball,
        sweeping_spots,
        lit_texture,
        flight,
        crossing_planes,
        mirrored_soup,
        leaving_plate,
    )
}
