"""Lit scenes against the slow oracle and against accumulation, the laws they obey, and their gradients.

Tolerances: an instant is right to rounding (1e-9); a mean over the exposure to the stated 1e-6 of the brightest that
any surface on that pixel's ray could be (light at right angles, texture as it is); brightness that two such means
differ by is at most twice that.
"""

from __future__ import annotations

import dataclasses

import lit_scenes as lit
import numpy as np
import pytest
import torch
from lit_scenes import SCENES, UPRIGHT
from oracle_looks import image_at, mean_over_exposure, radiance

import torchblur as tb
from torchblur.camera import pixel_rays

FLOAT64 = torch.float64
NAMES = list(SCENES)


def pixels_of(scene) -> list[tuple[int, int]]:
    """Return all pixels, row by row."""
    return [(row, col) for row in range(scene.height) for col in range(scene.width)]


@pytest.mark.parametrize("name", NAMES)
def test_the_oracles_agree_with_each_other(name):
    """An event moves the mean of N midpoint samples by at most contrast / (2 N); few pixels have more than 8."""
    scene, generator, n = SCENES[name](), np.random.default_rng(7), 128
    for _ in range(2):
        row, col = int(generator.integers(scene.height)), int(generator.integers(scene.width))
        sampled = np.mean([radiance(scene, row, col, (k + 0.5) / n) for k in range(n)], 0)
        answer = mean_over_exposure(scene, row, col)
        assert np.abs(answer.rgba - sampled).max() <= 8 * max(1, answer.brightest) / (2 * n)


@pytest.mark.parametrize("name", NAMES)
def test_render_is_the_oracle(name):
    scene = SCENES[name]()
    got = tb.render(lit.to_torch(scene)).rgba.numpy()
    for row, col in pixels_of(scene):
        answer = mean_over_exposure(scene, row, col)
        error = np.abs(got[row, col] - answer.rgba)
        assert error[:3].max() <= 1e-6 * answer.brightest, (row, col, error)
        assert error[3] <= 1e-6, (row, col, error)


@pytest.mark.parametrize("name", NAMES)
def test_instants_are_the_oracle(name):
    plain = SCENES[name]()
    scene = lit.to_torch(plain)
    for t in (0.0, 0.37, 0.81):
        got = tb.render_instant(scene, t).rgba.numpy()
        expected = image_at(plain, t)
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)
    times = (np.arange(5) + 0.5) / 5
    expected = np.mean([image_at(plain, t) for t in times], 0)
    np.testing.assert_allclose(tb.accumulate(scene, 5).rgba.numpy(), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (FLOAT64, 1e-7)])
def test_parts_of_the_exposure_average_to_the_whole(name, dtype, tolerance):
    scene = lit.to_torch(SCENES[name](), dtype)
    whole = tb.render(scene).rgba
    assert whole.dtype == dtype
    first, second = (tb.render(scene, shutter=tb.Shutter.box(*w)).rgba for w in ((0, 0.37), (0.37, 1)))
    largest = max(1.0, float(whole.max()))
    torch.testing.assert_close(0.37 * first + 0.63 * second, whole, rtol=0, atol=tolerance * largest)


@pytest.mark.parametrize("name", NAMES)
def test_time_may_run_backwards(name):
    plain = SCENES[name]()
    forwards, backwards = (tb.render(lit.to_torch(s)).rgba for s in (plain, lit.backwards(plain)))
    torch.testing.assert_close(backwards, forwards, rtol=0, atol=2e-6 * max(1.0, float(forwards.max())))


@pytest.mark.parametrize("name", NAMES)
def test_accumulation_closes_in(name):
    scene = lit.to_torch(SCENES[name]())
    exact = tb.render(scene).rgba[..., :3]
    error = (tb.accumulate(scene, 4096).rgba[..., :3] - exact).square().mean()
    assert float(10 * torch.log10(exact.max() ** 2 / error)) >= 60


def test_more_rays_are_the_mean_of_their_oracles():
    plain = SCENES["flight"]()
    plain.rays_per_pixel = 3
    got = tb.render(lit.to_torch(plain), rays_per_pixel=3).rgba.numpy()
    for row, col in pixels_of(plain)[10::4]:
        answers = [mean_over_exposure(plain, row, col, place=place) for place in pixel_rays(3)]
        expected = np.mean([a.rgba for a in answers], 0)
        np.testing.assert_allclose(got[row, col], expected, rtol=0, atol=1e-6 * max(a.brightest for a in answers))


@pytest.mark.parametrize("name", ["spinning_box", "lit_texture", "smooth_ball", "flight"])
def test_order_of_corners_and_memory_change_nothing(name):
    """Also not the other way round, if vertex normals, which belong to the counter-clockwise side, are turned too."""
    plain = SCENES[name]()
    whole = tb.render(lit.to_torch(plain)).rgba
    parts = tb.render(lit.to_torch(plain), memory_bytes=1 << 20).rgba
    torch.testing.assert_close(parts, whole, rtol=0, atol=1e-12)
    for order, side in (([1, 2, 0], 1), ([2, 1, 0], -1)):
        meshes = [
            dataclasses.replace(
                m,
                faces=m.faces[:, order],
                uv=None if m.uv is None else m.uv[:, order],
                normals=None if m.normals is None else side * m.normals,
            )
            for m in plain.meshes
        ]
        turned = tb.render(lit.to_torch(dataclasses.replace(plain, meshes=meshes))).rgba
        torch.testing.assert_close(turned, whole, rtol=0, atol=1e-9)


SQUARE = torch.tensor([[-1.1, -1, 0.1], [1, -1.2, 0], [1.2, 1, -0.1], [-1, 1.3, 0.2]], dtype=FLOAT64)
CAMERA = tb.Camera(torch.tensor(UPRIGHT), 2, 1)
FACES = [[0, 1, 2], [0, 2, 3]]
TRIANGLE = torch.tensor([[-2.1, -1, 0.1], [2, -1.2, 0], [0.2, 1.6, -0.1]], dtype=FLOAT64)
UV = torch.tensor([[[0.0, 0], [1, 0], [0.6, 1]]], dtype=FLOAT64)


def tensors(**values) -> dict[str, torch.Tensor]:
    """Return float64 leaves that ask for gradients."""
    return {k: torch.as_tensor(v, dtype=FLOAT64).clone().requires_grad_() for k, v in values.items()}


def lit_by_all(given: dict[str, torch.Tensor], smooth: bool) -> torch.Tensor:
    """Return the image of a moving translucent textured triangle under one light of each kind."""
    texture = given["texture"]
    material = tb.Material((0.9, 0.7, 0.5), 0.8, texture=texture, wrap="clamp", mipmap=False, shading="lambert")
    mesh = tb.Mesh(given["vertices"], [[0, 1, 2]], material, uv=UV, normals=given["normals"] if smooth else None)
    lights = [
        tb.PointLight(given["position"], given["intensity"]),
        tb.SpotLight(given["place"], given["target"], given["power"], inner_angle_deg=5.0, outer_angle_deg=60.0),
        tb.DirectionalLight(given["direction"], given["irradiance"]),
    ]
    return tb.render(tb.Scene([mesh], CAMERA, (0.1, 0.2, 0.3), lights=lights, ambient=given["ambient"])).rgba


@pytest.mark.parametrize("smooth", [False, True])
def test_gradients_reach_everything_that_light_depends_on(smooth):
    end = TRIANGLE * 1.1 + torch.tensor([0.35, 0.23, 0.1], dtype=FLOAT64)
    given = tensors(
        vertices=torch.stack([TRIANGLE, end]),
        texture=torch.rand(1, 2, 4, dtype=FLOAT64, generator=torch.Generator().manual_seed(2)) * 0.8 + 0.1,
        normals=[[[0.3, 0, 1], [-0.2, 0.1, 2], [0, -0.4, 1]], [[0.0, 0.1, 1]] * 3],
        position=[[0.3, -0.4, 1.2], [0.8, 0.4, 1.0], [0.2, 0.5, 1.5]],
        intensity=2.0,
        place=[-0.5, 0.4, 1.5],
        target=[[0.0, 0.1, 0], [0.3, -0.2, 0.1]],
        power=4.0,
        direction=[0.2, -0.3, -1.5],
        irradiance=[1.0, 2.0, 0.5],
        ambient=[0.1, 0.2, 0.3],
    )
    names = list(given) if smooth else ["vertices", "position", "direction"]  # the rest does not know

    def image(*values):
        return lit_by_all({**given, **dict(zip(names, values, strict=True))}, smooth)

    assert torch.autograd.gradcheck(image, tuple(given[name] for name in names), eps=1e-6, atol=1e-5, rtol=1e-3)
    out = image(*(given[name] for name in names))
    weight = torch.arange(1, out.numel() + 1, dtype=FLOAT64).sqrt().reshape(out.shape)
    (out * weight).sum().backward()
    for name in names:
        assert given[name].grad.abs().max() > 1e-3, f"nothing depends on {name}"


def test_gradients_of_a_light_that_asks_alone():
    """A scene of constants must still pass gradients to its lights, also where the terminator passes."""
    vertices = torch.stack([SQUARE, SQUARE @ torch.tensor([[0.6, 0, -0.8], [0, 1, 0], [0.8, 0, 0.6]]).to(FLOAT64)])
    material = tb.Material(shading="lambert")
    camera = tb.Camera(torch.diag(torch.tensor([1.0, 1, -0.5, 1], dtype=FLOAT64)), 2, 1)

    def image(direction, position):
        lights = [tb.DirectionalLight(direction, 2.0), tb.PointLight(position, (1.0, 2, 3))]
        return tb.render(tb.Scene([tb.Mesh(vertices, FACES, material)], camera, lights=lights)).rgba

    given = tensors(direction=[-1.0, 0, -0.3], position=[0.7, 0.2, 0.3])
    assert torch.autograd.gradcheck(image, tuple(given.values()), eps=1e-6, atol=1e-5, rtol=1e-3)
