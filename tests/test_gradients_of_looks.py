"""Gradients through light and texture in motion, against central differences: what rests in value may move in slope."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import effect_scenes
import numpy as np
import pytest
import torch
from effect_scenes import Body, Stage

import torchblur as tb

STEP = 1e-5  # of a scene of size 1: curvature leaves 1e-10, rounding 1e-11
RTOL = 1e-5  # of the largest entry
FLOAT64 = torch.float64
POSITION, SIDE = (1.0, 2.0, 4.0), (-2.0, 0.5, 1.5)
LIGHTS = {
    "point": [tb.PointLight(POSITION, (30.0, 20.0, 10.0), casts_shadows=False)],
    "moving point": [tb.PointLight([POSITION, (1.5, 1.0, 3.0), (2.0, 2.5, 4.5)], 30.0, casts_shadows=False)],
    "directional": [tb.DirectionalLight((-0.3, -0.4, -1.0), (3.0, 2.0, 1.0), casts_shadows=False)],
    "spot": [
        tb.SpotLight(POSITION, (0.1, 0.0, 0.5), 60.0, inner_angle_deg=2.0, outer_angle_deg=25.0, casts_shadows=False)
    ],
    "two": [
        tb.PointLight(POSITION, 30.0, casts_shadows=False),
        tb.PointLight(SIDE, (5.0, 9.0, 1.0), casts_shadows=False),
    ],
}
WALL = Body("wall", (0, 0, -3), "still", "flat", 1.0, True)
SHUTTERS = {
    "whole": tb.Shutter.box(),
    "rolling": tb.Shutter.rolling(0.05, 0.6),
    "steep": tb.Shutter.trapezoid(0.2, 0.2, 0.5, 0.9),
}


def scene_of(motion: str, look: str, lights: str, shape: str = "box") -> tb.Scene:
    """Return a body in motion before a wall at rest, in float64, in which no ray rests on an edge."""
    body = Body(shape, (0, 0, 0), motion, look, 1.0, True)
    scene = effect_scenes.build(Stage((WALL, body), False, 0.1, None, 1, True, 0))
    camera = tb.Camera.look_at(effect_scenes.EYE, (0.03, -0.02, 0), fov_y_deg=40, width=9, height=7, near=0.1, far=20)
    return dataclasses.replace(scene, camera=camera, lights=LIGHTS[lights])


def with_vertices(scene: tb.Scene, vertices: torch.Tensor) -> tb.Scene:
    """Return the scene with other vertices of its second mesh."""
    return dataclasses.replace(scene, meshes=[scene.meshes[0], dataclasses.replace(scene.meshes[1], vertices=vertices)])


def check_slopes(seen: Callable[[torch.Tensor], torch.Tensor], at: torch.Tensor, n_entries: int = 12) -> None:
    """Compare the slopes of an uneven sum of images with central differences, at some entries of `at`."""
    generator = np.random.default_rng(4)
    weights = {}

    def total(value: torch.Tensor) -> torch.Tensor:
        image = seen(value)
        weight = weights.setdefault(image.shape, torch.as_tensor(generator.uniform(0.5, 1, image.shape)))
        return (image * weight).sum()

    leaf = at.detach().clone().requires_grad_()
    (slopes,) = torch.autograd.grad(total(leaf), leaf)
    slack = RTOL * float(slopes.abs().max())
    assert slack > 0
    for entry in generator.permutation(at.numel())[:n_entries]:
        step = torch.zeros(at.numel(), dtype=at.dtype)
        step[entry] = STEP
        step = step.reshape(at.shape)
        with torch.no_grad():
            quotient = float(total(at + step) - total(at - step)) / (2 * STEP)
        assert float(slopes.flatten()[entry]) == pytest.approx(quotient, rel=0, abs=slack), f"entry {int(entry)}"


@pytest.mark.parametrize("effects", ["auto", "all"])
def test_a_flat_face_that_slides_in_its_plane(effects):
    """Its light stands still, so that one look is the whole integral; but a corner that moves turns it in time."""
    scene = scene_of("shift", "lit", "point")
    vertices = scene.meshes[1].vertices.clone().requires_grad_()
    seen = tb.render(with_vertices(scene, vertices), effects=effects).rgba[2, 3]
    slope = [float(torch.autograd.grad(seen[k], vertices, retain_graph=True)[0][0, 6, 2]) for k in range(3)]
    quotients = []
    for step in (1e-3, 1e-4, 1e-5):
        ends = []
        for sign in (1, -1):
            moved = scene.meshes[1].vertices.clone()
            moved[0, 6, 2] += sign * step
            ends.append(tb.render(with_vertices(scene, moved), effects=effects).rgba[2, 3])
        quotients.append((ends[0] - ends[1])[:3].div(2 * step).tolist())
    assert quotients[1] == pytest.approx(quotients[2], rel=1e-7)  # the reference has settled
    assert min(quotients[2]) > 0.005
    assert slope == pytest.approx(quotients[2], rel=1e-6)


@pytest.mark.parametrize("lights", list(LIGHTS))
@pytest.mark.parametrize("motion", ["shift", "forward", "turn"])
def test_vertices_of_lit_faces(motion, lights):
    scene = scene_of(motion, "lit", lights)
    check_slopes(lambda v: tb.render(with_vertices(scene, v)).rgba, scene.meshes[1].vertices)


@pytest.mark.parametrize("lights", ["point", "directional", "spot"])
def test_vertices_and_normals_of_smooth_faces(lights):
    scene = scene_of("shift", "lit", lights, "slant")
    body = scene.meshes[1]
    normals = torch.tensor([-0.4, 0.0, 1.0]) + 0.2 * torch.sin(torch.arange(2.0 * 9 * 3)).reshape(2, 9, 3)

    def seen(vertices, normals):
        mesh = tb.Mesh(vertices, body.faces, body.material, normals=normals)
        return tb.render(dataclasses.replace(scene, meshes=[mesh])).rgba

    check_slopes(lambda v: seen(v, normals.to(FLOAT64)), body.vertices)
    check_slopes(lambda n: seen(body.vertices, n), normals.to(FLOAT64))


@pytest.mark.parametrize("look", ["texture", "alpha texture", "lit texture"])
@pytest.mark.parametrize("motion", ["shift", "forward", "turn"])
def test_vertices_and_uv_of_textured_faces(motion, look):
    scene = scene_of(motion, look, "point")
    check_slopes(lambda v: tb.render(with_vertices(scene, v)).rgba, scene.meshes[1].vertices)
    body = scene.meshes[1]

    def seen(uv):
        return tb.render(dataclasses.replace(scene, meshes=[dataclasses.replace(body, uv=uv)])).rgba

    check_slopes(seen, body.uv)


def test_uv_that_are_one_place():
    """The texture stands still in time, but not once a corner's uv differs from the others."""
    scene = scene_of("shift", "texture", "point")
    body = scene.meshes[1]
    material = dataclasses.replace(body.material, mipmap=False)
    one = torch.tensor([0.43, 0.37], dtype=FLOAT64).expand_as(body.uv).clone()

    def seen(uv):
        return tb.render(dataclasses.replace(scene, meshes=[tb.Mesh(body.vertices, body.faces, material, uv=uv)])).rgba

    check_slopes(seen, one, 24)


@pytest.mark.parametrize("part", ["position", "target"])
def test_lights_that_shine_on_what_slides(part):
    scene = scene_of("shift", "lit", "spot")

    def seen(value):
        return tb.render(
            dataclasses.replace(scene, lights=[dataclasses.replace(scene.lights[0], **{part: value})])
        ).rgba

    check_slopes(seen, getattr(scene.lights[0], part).to(FLOAT64))


@pytest.mark.parametrize("look", ["flat", "texture", "lit"])
@pytest.mark.parametrize("shutter", list(SHUTTERS))
def test_what_a_shutter_cuts_off_has_no_slope(shutter, look):
    """Where the weight jumps inside a slice of time, the jump stays while the slice's ends move."""
    scene = scene_of("turn", look, "moving point")
    check_slopes(lambda v: tb.render(with_vertices(scene, v), shutter=SHUTTERS[shutter]).rgba, scene.meshes[1].vertices)


@pytest.mark.parametrize("look", ["flat", "texture", "lit"])
def test_windows(look):
    scene = scene_of("turn", look, "point")

    def seen(vertices):
        frames = tb.render_windows(with_vertices(scene, vertices), [(0.0, 0.35), (0.35, 0.8), (0.2, 0.3)])
        return torch.stack([frame.rgba for frame in frames])

    check_slopes(seen, scene.meshes[1].vertices)


@pytest.mark.parametrize("late", [-1e-16, 0.0, 1e-16])
def test_an_end_that_meets_a_knot_still_moves(late):
    """A sheet leaves the ray as the weight peaks at 2: moving its edge by dx takes 2 dx, however rounded."""
    x = [-0.5 - late, 9.0, 9.0, -0.5 - late]
    start = torch.tensor([[x[k], y, 0.0] for k, y in enumerate((-9.0, -9.0, 8.0, 8.0))], dtype=FLOAT64)
    vertices = torch.stack([start, start + torch.tensor([1.0, 0.0, 0.0])]).requires_grad_()
    mesh = tb.Mesh(vertices, [[0, 1, 2], [0, 2, 3]], tb.Material((1.0, 1.0, 1.0), shading="lambert"))
    camera = tb.Camera(torch.eye(4, dtype=FLOAT64), 1, 1)
    scene = tb.Scene([mesh], camera, lights=[tb.DirectionalLight((0.0, 0.0, 1.0), np.pi)])
    tb.render(scene, shutter=tb.Shutter.trapezoid(0.0, 0.5, 0.5, 1.0)).rgba[0, 0, 0].backward()
    assert float(vertices.grad[:, [0, 3], 0].sum()) == pytest.approx(-2.0, rel=1e-9)
