"""Gradients by central differences (torch.autograd.gradcheck, float64) and by hand, away from tangencies.

gradcheck moves an input by 1e-6; rounding of 1e-16 / 1e-6 = 1e-10 in the difference quotient and the curvature over
1e-6 leave the stated relative 1e-6 room.
"""

from __future__ import annotations

import numpy as np
import pytest
import scene_makers as make
import torch
from agreement_scenes import SCENES
from oracles import PlainMesh, PlainScene

import torchblur as tb

CHECK = {"eps": 1e-6, "atol": 1e-6, "rtol": 1e-6}


def check(function, *inputs: torch.Tensor) -> None:
    """Run gradcheck, and make sure that something depends on the inputs at all."""
    inputs = tuple(i.detach().clone().requires_grad_() for i in inputs)
    assert torch.autograd.gradcheck(function, inputs, **CHECK)
    image = function(*inputs)
    weights = torch.arange(1, image.numel() + 1, dtype=image.dtype).sqrt().reshape(image.shape)
    (image * weights).sum().backward()  # uneven, so that opposite changes do not cancel
    assert all(i.grad is not None and i.grad.abs().max() > 1e-3 for i in inputs), "nothing depends on an input"


def rendered(plain: PlainScene, vertices=None, matrix=None, color=None, opacity=None, background=None) -> torch.Tensor:
    """Render a plain scene of one mesh with some of its tensors replaced."""
    scene = make.to_torch(plain)
    mesh, camera = scene.meshes[0], scene.camera
    material = tb.Material(
        mesh.material.color if color is None else color, mesh.material.opacity if opacity is None else opacity
    )
    mesh = tb.Mesh(mesh.vertices if vertices is None else vertices, mesh.faces, material)
    camera = tb.Camera(camera.world_to_clip if matrix is None else matrix, camera.width, camera.height)
    return tb.render(tb.Scene([mesh], camera, scene.background if background is None else background)).rgba


def one_mesh(
    meshes: list[PlainMesh], matrix=make.IDENTITY, width=1, height=1, background=(0.3, 0.2, 0.9)
) -> PlainScene:
    """Return a scene whose meshes are joined into one with per-face colours and opacities."""
    vertices = np.concatenate([m.knots() if len(m.knots()) > 1 else m.knots().repeat(2, 0) for m in meshes], 1)
    starts = np.cumsum([0] + [m.knots().shape[1] for m in meshes[:-1]])
    faces = np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)])
    color = np.concatenate([np.broadcast_to(m.color, (len(m.faces), 3)) for m in meshes])
    opacity = np.concatenate([np.broadcast_to(m.opacity, len(m.faces)) for m in meshes])
    return PlainScene([PlainMesh(vertices, faces, color, opacity)], matrix, width, height, background)


def cases() -> dict[str, PlainScene]:
    """Return the scenes of case 28 and some harder ones, every mesh non-degenerate and no pixel at a tangency."""
    generator = np.random.default_rng(2)
    sliding = make.quad(-0.53, 0.11, -9, 8, 0.1, shift=(0.7, 0.05), color=(1, 0.5, 0.2))
    nine = make.triangle([(-12, 18), (-27, -18), (110, 70)], [(10, -5), (-9, 6), (-110, -90)], color=(1, 0.5, 0.2))
    planes = [make.quad(-9, 9, -9, 8, 0.9, -0.1, color=(1, 0, 0)), make.quad(-8, 9, -9, 7, 0, 0.8, color=(0, 1, 0))]
    clear = [PlainMesh(p.vertices, p.faces, p.color, o) for p, o in zip(planes, (0.3, 0.9), strict=True)]
    behind = make.triangle(
        [(-1, -1, 2), (1.1, -1, 2.2), (0.1, 1.3, 1.9)], [(-1, -1.1, -2), (1, -0.9, -1.8), (0, 1, -2.1)], color=(1, 1, 0)
    )
    tilted = [
        make.triangle(
            np.column_stack([[-99, 99, 1], [-98, -99, 99], generator.uniform(2, 6, 3)]),
            np.column_stack([[-99, 99, 3], [-97, -99, 99], generator.uniform(2, 6, 3)]),
            color=color,
            opacity=opacity,
        )
        for color, opacity in (((1, 0, 0), 0.8), ((0, 1, 0), 0.6), ((0, 0, 1), 1.0))
    ]
    soup = make.random_triangles(generator, 3, size=0.9, extent=0.3, opacity=generator.uniform(0.3, 0.9, 3))
    return {
        "sliding box": one_mesh([sliding]),
        "four intervals": one_mesh([nine]),
        "crossing, opaque": one_mesh(planes),
        "crossing, clear": one_mesh(clear),
        "near plane": one_mesh([behind], make.w_is_z(), 3, 2),
        "crossing, perspective": one_mesh(tilted, make.w_is_z(), 1, 1),
        "soup": one_mesh([soup], make.IDENTITY, 3, 2),
    }


CASES = cases()


@pytest.mark.parametrize("name", list(CASES))
def test_28_vertices(name):
    scene = CASES[name]
    check(lambda v: rendered(scene, vertices=v), torch.tensor(scene.meshes[0].vertices))


@pytest.mark.parametrize("name", ["near plane", "crossing, perspective"])
def test_camera_matrix(name):
    scene = CASES[name]
    check(lambda m: rendered(scene, matrix=m), torch.tensor(scene.world_to_clip))


@pytest.mark.parametrize("name", ["sliding box", "four intervals", "soup"])
def test_orthographic_camera_matrix(name):
    """Only the rows of x and y: a step in the row of w would turn the camera into a perspective one."""
    scene = CASES[name]
    rest = torch.tensor(scene.world_to_clip[2:])
    check(lambda m: rendered(scene, matrix=torch.cat([m, rest])), torch.tensor(scene.world_to_clip[:2]))


def test_moving_camera_matrix():
    scene = CASES["soup"]
    still = PlainMesh(
        scene.meshes[0].vertices[0], scene.meshes[0].faces, scene.meshes[0].color, scene.meshes[0].opacity
    )
    matrix = np.stack([np.eye(4), np.eye(4), np.eye(4)])
    matrix[1, 0, 3], matrix[2, :2, 3], matrix[1, 1, 0] = 0.3, (0.4, -0.2), 0.2
    plain = PlainScene([still], matrix, 3, 2, (0.3, 0.2, 0.9))
    rest = torch.tensor(matrix[:, 2:])
    check(lambda m: rendered(plain, matrix=torch.cat([m, rest], 1)), torch.tensor(matrix[:, :2]))
    check(lambda v: rendered(plain, vertices=v), torch.tensor(still.vertices))


@pytest.mark.parametrize("name", ["crossing, clear", "soup", "near plane"])
def test_colours_opacities_background(name):
    scene = CASES[name]
    mesh = scene.meshes[0]
    opacity = np.clip(
        np.broadcast_to(mesh.opacity, len(mesh.faces)), 0.3, 0.9
    )  # inside (0, 1): differences are two-sided
    color = torch.tensor(np.broadcast_to(mesh.color, (len(mesh.faces), 3)).copy() + 0.1)
    check(
        lambda c, o, b: rendered(scene, color=c, opacity=o, background=b),
        color, torch.tensor(opacity), torch.tensor(scene.background),
    )  # fmt: skip
    image = torch.rand(scene.height, scene.width, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    check(lambda b: rendered(scene, background=b), image + 0.1)


def test_28_sliding_box_by_hand():
    """Coverage of [0, W] + v t over x is W / v: moving the left edge out adds 1 / v, both knots together."""
    box = make.quad(-0.6, -0.1, -9, 8, 0, shift=(2.0, 0.0))
    scene = make.to_torch(PlainScene([box]))
    vertices = scene.meshes[0].vertices.clone().requires_grad_()
    tb.render(tb.Scene([tb.Mesh(vertices, box.faces)], scene.camera)).rgba[0, 0, 3].backward()
    by_vertex = vertices.grad.sum(0)[:, 0]
    assert float(by_vertex[[0, 3]].sum()) == pytest.approx(-1 / 2, abs=1e-12)
    assert float(by_vertex[[1, 2]].sum()) == pytest.approx(1 / 2, abs=1e-12)
    torch.testing.assert_close(vertices.grad[..., 2], torch.zeros(2, 4, dtype=torch.float64), rtol=0, atol=1e-12)


def test_28_crossing_by_hand():
    """Depths z0 + (z1 - z0) t and h cross at t = (h - z0) / (z1 - z0): with z0 = 0, z1 = 1, h = 1/2, dt/dh = 1."""
    depth = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    red = make.quad(-9, 9, -9, 8, 0, 1, color=(1, 0, 0))
    flat = torch.tensor(make.quad(-9, 9, -9, 8, 0).vertices)
    green = tb.Mesh(flat + torch.stack([depth * 0, depth * 0, depth]), red.faces, tb.Material((0, 1, 0)))
    scene = make.to_torch(PlainScene([red]))
    rgba = tb.render(tb.Scene([*scene.meshes, green], scene.camera)).rgba[0, 0]
    np.testing.assert_allclose(rgba.detach().numpy(), (0.5, 0.5, 0, 1), atol=1e-12)
    (slope,) = torch.autograd.grad(rgba[0], depth)
    assert float(slope) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("alpha", [0.0, 0.3, 0.9, 1.0])
def test_opacity_gradient_is_colour_minus_what_is_behind(alpha):
    """dC/da = c - C_behind for every a, exactly 1 included: a hidden surface still matters to the derivative."""
    opacity = torch.tensor(alpha, dtype=torch.float64, requires_grad=True)
    front, behind = make.quad(-9, 9, -9, 8, 0), make.quad(-9, 9, -9, 8, 0.5)
    meshes = [
        tb.Mesh(torch.tensor(front.vertices), front.faces, tb.Material((0.9, 0.1, 0.4), opacity)),
        tb.Mesh(torch.tensor(behind.vertices), behind.faces, tb.Material((0.2, 0.8, 0.3), 0.75)),
    ]
    scene = tb.Scene(meshes, make.to_torch(PlainScene([])).camera, torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64))
    rgba = tb.render(scene).rgba[0, 0]
    c, under = np.array([0.9, 0.1, 0.4]), 0.75 * np.array([0.2, 0.8, 0.3]) + 0.25 * np.array([1.0, 0.0, 1.0])
    expected = [*(c - under), 1 - 0.75]
    got = [float(torch.autograd.grad(rgba[k], opacity, retain_graph=True)[0]) for k in range(4)]
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)
    instant = tb.render_instant(scene, t=0.5).rgba[0, 0]
    got = [float(torch.autograd.grad(instant[k], opacity, retain_graph=True)[0]) for k in range(4)]
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)


def test_28_static_edges_have_no_gradient():
    scene = make.to_torch(PlainScene([make.quad(-0.51, 0.3, -0.7, 0.4, 0)], make.IDENTITY, 6, 6))
    vertices = scene.meshes[0].vertices.clone().requires_grad_()
    tb.render(tb.Scene([tb.Mesh(vertices, scene.meshes[0].faces)], scene.camera)).rgba.sum().backward()
    assert (vertices.grad == 0).all()


def test_28_tangent_edge_gives_finite_gradients():
    at = [np.array([(0, 3.0), (-1 + s / 2, -s), (1 + s / 2, s)]) for s in (-0.5, 0.5)]  # e0 = (t - 1/2)^2
    scene = make.to_torch(PlainScene([make.triangle(*at)]))
    vertices = scene.meshes[0].vertices.clone().requires_grad_()
    tb.render(tb.Scene([tb.Mesh(vertices, scene.meshes[0].faces)], scene.camera)).rgba.sum().backward()
    assert torch.isfinite(vertices.grad).all()


@pytest.mark.parametrize("name", list(SCENES))
def test_float32_gradients_are_finite_and_those_of_float64(name):
    plain = SCENES[name]()
    grads = []
    for dtype in (torch.float32, torch.float64):
        # the same numbers in both: float32 vertices widened
        scene = make.to_torch(plain, torch.float32)
        vertices = [m.vertices.to(dtype).requires_grad_() for m in scene.meshes]
        meshes = [
            tb.Mesh(v, m.faces, tb.Material(m.material.color, m.material.opacity, double_sided=m.material.double_sided))
            for v, m in zip(vertices, scene.meshes, strict=True)
        ]
        image = tb.render(tb.Scene(meshes, scene.camera, scene.background)).rgba
        assert image.dtype == dtype
        image.square().sum().backward()
        assert all(v.grad is not None and torch.isfinite(v.grad).all() for v in vertices)
        grads.append(torch.cat([v.grad.double().flatten() for v in vertices]))
    assert grads[1].abs().max() > 1e-3
    # one rounding of the result, one of the gradient: 1e-5 of the largest
    assert float((grads[0] - grads[1]).abs().max()) <= 1e-5 * float(grads[1].abs().max())


def test_image_can_be_differentiated_even_if_nothing_depends_on_the_vertices():
    """A frame in which nothing is seen must not stop a training loop."""
    for place in (0.0, 5.0):
        vertices = torch.tensor([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]], dtype=torch.float64) + place
        vertices.requires_grad_()
        scene = tb.Scene([tb.Mesh(vertices, [[0, 1, 2]])], make.to_torch(PlainScene([])).camera)
        tb.render(scene).rgba.sum().backward()
        assert (vertices.grad == 0).all()


def test_no_graph_without_request():
    assert not make.render(CASES["soup"]).rgba.requires_grad
    scene = make.to_torch(CASES["soup"])
    vertices = scene.meshes[0].vertices.clone().requires_grad_()
    with torch.no_grad():
        assert not tb.render(tb.Scene([tb.Mesh(vertices, scene.meshes[0].faces)], scene.camera)).rgba.requires_grad


def test_small_blocks_have_the_same_gradient():
    plain = SCENES["transparent"]()
    grads = []
    for options in ({}, {"memory_bytes": 1 << 20}):
        scene = make.to_torch(plain)
        vertices = scene.meshes[0].vertices.clone().requires_grad_()
        mesh = tb.Mesh(vertices, scene.meshes[0].faces, scene.meshes[0].material)
        tb.render(tb.Scene([mesh], scene.camera, scene.background), **options).rgba.square().sum().backward()
        grads.append(vertices.grad)
    torch.testing.assert_close(grads[0], grads[1], rtol=1e-9, atol=1e-9)
