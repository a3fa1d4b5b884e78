"""The random references: unbiased, as noisy as the theory says, and of the scene and shading of the exact image."""

import math

import agreement_scenes
import lit_scenes
import numpy as np
import pytest
import scene_makers as make
import torch

import torchblur as tb
from torchblur import time_samples
from torchblur.camera import CENTRE

MOMENT = 1e-9  # an exposure so short that nothing moves in it


def agreement(name):
    return make.to_torch(agreement_scenes.SCENES[name]())


def lit(name, casts_shadows=False):
    return lit_scenes.to_torch(lit_scenes.SCENES[name](), casts_shadows=casts_shadows)


def halton(scene, n, **options):
    return tb.accumulate(scene, n, sequence="halton", **options).rgba


def centred(scene, n, **options):
    return tb.stochastic(scene, n, places="centre", **options).rgba


REFERENCES = {"halton": halton, "stochastic": centred}


def sweep(width=4096):
    """One row of pixels, each of which one edge passes once: a bright half plane moves in from the left."""
    camera = tb.Camera.orthographic((0, 0, 5), (0, 0, 0), height_world=2 / width, width=width, height=1, near=1, far=9)
    corner = torch.tensor([[-9.0, -1, 0], [-1.0, -1, 0], [-1.0, 1, 0], [-9.0, 1, 0]], dtype=torch.float64)
    ends = torch.stack([corner, corner + torch.tensor([2.0, 0, 0], dtype=torch.float64)])
    return tb.Scene([tb.Mesh(ends, torch.tensor([[0, 1, 2], [0, 2, 3]]), tb.Material((1.0, 1.0, 1.0)))], camera)


@pytest.mark.parametrize("n", [8, 64])
def test_errors_of_one_event_are_those_of_the_theory(n):
    """Root of the mean square: 1 / (N sqrt 6) for one sample in each part, and for rotated Halton at a power of two."""
    scene = sweep()
    exact = tb.render(scene).rgba[..., 0]
    for name, reference in REFERENCES.items():
        error = (reference(scene, n)[..., 0] - exact).square().mean().sqrt()
        assert float(error) == pytest.approx(1 / (n * math.sqrt(6)), rel=0.08), name  # of 4096 pixels: 1 in 40 or so
    independent = torch.stack([centred(scene, 1, seed=k)[..., 0] for k in range(n)]).mean(0)
    error = (independent - exact).square().mean().sqrt()
    assert float(error) == pytest.approx(math.sqrt(1 / (6 * n)), rel=0.08)  # what no order of times would give


@pytest.mark.parametrize("name", REFERENCES)
@pytest.mark.parametrize("scene", ["transparent", "moving camera"])
def test_errors_fall_as_one_over_n(name, scene):
    scene = agreement(scene)
    exact, counts = tb.render(scene).rgba, (8, 32, 128, 256)
    errors = [float((REFERENCES[name](scene, n) - exact).square().mean().sqrt()) for n in counts]
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert slope == pytest.approx(-1, abs=0.1), errors


def test_over_the_area_strata_help_too():
    """Times and places are paired at random: the error falls as 1 / sqrt(N), below that of independent samples."""
    scene = agreement("opaque")
    exact, counts = tb.render(scene, rays_per_pixel=256).rgba, (4, 16, 64)

    def error(rgba):
        return float((rgba - exact).square().mean().sqrt())

    errors = [error(tb.stochastic(scene, n).rgba) for n in counts]
    assert -1.0 < np.polyfit(np.log(counts), np.log(errors), 1)[0] < -0.45, errors
    independent = torch.stack([tb.stochastic(scene, 1, seed=k).rgba for k in range(counts[-1])]).mean(0)
    assert errors[-1] < 0.8 * error(independent)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"shutter": tb.Shutter.box(0.2, 0.6)},
        {"shutter": tb.Shutter.trapezoid(0.1, 0.3, 0.4, 0.9)},
        {"shutter": tb.Shutter.rolling(0.02, 0.4, "up")},
    ],
    ids=["box", "part", "trapezoid", "rolling"],
)
@pytest.mark.parametrize("name", REFERENCES)
def test_the_mean_over_seeds_is_the_exact_image(name, options):
    scene, n_seeds = agreement("transparent"), 150
    exact = tb.render(scene, **options).rgba
    runs = torch.stack([REFERENCES[name](scene, 3, seed=k, **options) for k in range(n_seeds)])
    off = (runs.mean(0) - exact).abs()
    spread = runs.std(0) / n_seeds**0.5
    assert bool((off <= 5 * spread + 3 / n_seeds).all())  # the last for what 600 samples may never have met
    unsure = spread > 1e-4
    assert int(unsure.sum()) > 100
    z = ((runs.mean(0) - exact) / spread)[unsure]
    assert abs(float(z.mean())) < 5 / int(unsure.sum()) ** 0.5 + 0.1  # pixels of one image share nothing but the scene
    assert 0.5 < float(z.std()) < 1.6  # about 1; an event that few seeds meet has a spread that few know


def test_the_area_is_that_of_the_pixel():
    """Seen through many rays a still edge covers part of a pixel, and a pixel of one sample is one of both."""
    camera = tb.Camera.orthographic((0, 0, 5), (0, 0, 0), height_world=2, width=2, height=2, near=1, far=9)
    corner = torch.tensor([[-9.0, -9, 0], [0.25, -9, 0], [0.25, 9, 0], [-9.0, 9, 0]], dtype=torch.float64)
    scene = tb.Scene([tb.Mesh(corner, torch.tensor([[0, 1, 2], [0, 2, 3]]))], camera)
    alpha = tb.stochastic(scene, 1024).rgba[..., 3]
    torch.testing.assert_close(alpha[:, 0], torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-12)
    torch.testing.assert_close(alpha[:, 1], torch.full((2,), 0.25, dtype=torch.float64), rtol=0, atol=0.01)
    assert float(centred(scene, 16)[0, 1, 3]) == 0
    one = torch.stack([tb.stochastic(scene, 1, seed=k).rgba[0, 1, 3] for k in range(40)])
    assert set(one.tolist()) == {0.0, 1.0}


@pytest.mark.parametrize("name", list(agreement_scenes.SCENES))
@pytest.mark.parametrize("t", [0.0, 0.37, 1 - 1e-9])
def test_at_one_moment_they_are_the_sharp_image(name, t):
    scene = agreement(name)
    shutter = tb.Shutter.box(t, t + MOMENT)
    sharp = tb.render_instant(scene, t).rgba
    for reference in REFERENCES.values():
        found = reference(scene, 2, shutter=shutter)
        differs = ((found - sharp).abs() > 1e-6).any(-1)
        assert int(differs.sum()) <= 1  # an edge may lie on a ray just then


@pytest.mark.parametrize("casts_shadows", [False, True])
@pytest.mark.parametrize("name", list(lit_scenes.SCENES))
def test_texture_and_light_are_those_of_the_sharp_image(name, casts_shadows):
    scene = lit(name, casts_shadows)
    for t in (0.2, 0.8):
        sharp = tb.render_instant(scene, t).rgba
        assert float(sharp[..., :3].std()) > 0
        found = centred(scene, 1, shutter=tb.Shutter.box(t, t + MOMENT))
        torch.testing.assert_close(found, sharp, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["spinning_box", "lit_texture"])
def test_shading_over_time_is_that_of_the_exact_image(name):
    scene = lit(name)
    exact = tb.render(scene).rgba
    errors = [float((centred(scene, n) - exact).square().mean().sqrt()) for n in (16, 256)]
    assert errors[1] < 0.2 * errors[0]
    assert errors[1] < 0.01


def test_small_copies_of_textures_are_used_alike():
    texture = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    corner = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, -3], [-1, 1, -3]], dtype=torch.float64)
    uv = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    camera = tb.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y_deg=60, width=12, height=10, near=0.1, far=20)
    look = tb.Material(texture=texture, mipmap=True)
    ends = torch.stack([corner, corner + torch.tensor([0.4, 0.1, -0.5], dtype=torch.float64)])
    scene = tb.Scene([tb.Mesh(ends, faces, look, uv=uv[faces])], camera)
    sharp = tb.render_instant(scene, 0.6).rgba
    found = centred(scene, 1, shutter=tb.Shutter.box(0.6, 0.6 + MOMENT))
    torch.testing.assert_close(found, sharp, rtol=0, atol=1e-6)


def test_a_closed_surface_has_no_cracks():
    """A wall of many triangles that fills the view while it turns and bends: every sample meets exactly one of them."""
    generator = torch.Generator().manual_seed(2)
    n = 12
    vertices, faces = make.grid(n, 6.0)
    start = torch.as_tensor(vertices, dtype=torch.float64)
    bend = 0.15 * torch.rand(start.shape, generator=generator, dtype=torch.float64)
    turned = start @ torch.as_tensor(make.rotation_z(0.4), dtype=torch.float64).T + bend
    camera = tb.Camera.look_at((0, 0, 2), (0, 0, 0), fov_y_deg=50, width=31, height=23, near=0.1, far=10)
    mesh = tb.Mesh(torch.stack([start, turned]), torch.as_tensor(faces), tb.Material((1.0, 1.0, 1.0), 0.5))
    for places in ("area", "centre"):
        rgba = tb.stochastic(tb.Scene([mesh], camera), 16, places=places).rgba
        torch.testing.assert_close(rgba[..., 3], torch.full((23, 31), 0.5, dtype=torch.float64), rtol=0, atol=1e-12)


def test_a_still_scene_is_its_sharp_image():
    vertices, faces = make.grid(4, 1.6)
    camera = tb.Camera.look_at((0, 0, 2), (0, 0, 0), fov_y_deg=60, width=16, height=16, near=0.1, far=10)
    colors = torch.rand(len(faces), 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    scene = tb.Scene([tb.Mesh(torch.as_tensor(vertices), torch.as_tensor(faces), tb.Material(colors, 0.7))], camera)
    sharp = tb.render_instant(scene).rgba  # edges of the grid lie on rays
    for reference in REFERENCES.values():
        torch.testing.assert_close(reference(scene, 4), sharp, rtol=0, atol=1e-12)


def test_portions_do_not_show(monkeypatch):
    scene = agreement("transparent")
    whole = tb.stochastic(scene, 6).rgba
    monkeypatch.setattr("torchblur.time_samples.MAX_PAIRS", 30)
    torch.testing.assert_close(tb.stochastic(scene, 6).rgba, whole, rtol=0, atol=0)
    monkeypatch.setattr("torchblur.time_samples.MAX_SAMPLES", 6 * scene.camera.width * 3)  # other random numbers
    exact = tb.render(scene).rgba
    by_rows = float((centred(scene, 64) - exact).square().mean().sqrt())
    monkeypatch.undo()
    assert by_rows < 1.5 * float((centred(scene, 64) - exact).square().mean().sqrt())


def test_times_and_places_lie_in_all_their_strata():
    samples = time_samples.stratified(12, True, torch.Generator().manual_seed(0))(7)
    strata = torch.arange(12).unsqueeze(1).expand(12, 7)
    assert torch.equal((samples.share * 12).floor().long(), strata)
    cell = (samples.y_px * 3).floor() * 4 + (samples.x_px * 4).floor()
    assert torch.equal(cell.long().sort(0).values, strata)
    assert len(torch.unique(cell, dim=1).T) == 7  # every pixel in an order of its own
    turned = time_samples.rotated_halton(8, CENTRE, torch.Generator().manual_seed(0))(5).share
    torch.testing.assert_close(turned.diff(dim=0), torch.full((7, 5), 1 / 8, dtype=torch.float64))
    assert len(torch.unique(turned[0])) == 5
    odd = time_samples.rotated_halton(3, CENTRE, torch.Generator().manual_seed(0))(1).share.flatten()
    gaps = sorted([*odd.diff().tolist(), 1 - float(odd[-1] - odd[0])])
    assert gaps == pytest.approx([0.25, 0.25, 0.5])  # 0, 1/2, 1/4


def test_the_seed_decides(device):
    scene = make.to_torch(agreement_scenes.SCENES["opaque"](), device=device)
    for reference in REFERENCES.values():
        first, again, other = (reference(scene, 4, seed=s) for s in (1, 1, 2))
        assert torch.equal(first, again)
        assert float((first - other).abs().max()) > 0.01
        assert first.device.type == device.type


def test_an_empty_scene_shows_its_background():
    camera = tb.Camera.look_at((0, 0, 2), (0, 0, 0), fov_y_deg=60, width=4, height=3, near=0.1, far=10)
    for reference in REFERENCES.values():
        rgba = reference(tb.Scene([], camera, (0.1, 0.2, 0.3)), 4)
        torch.testing.assert_close(rgba[0, 0], torch.tensor([0.1, 0.2, 0.3, 0.0], dtype=rgba.dtype))


def test_gradients_to_colour():
    scene = agreement("transparent")
    mesh = scene.meshes[0]
    color = torch.full((mesh.n_faces, 3), 0.5, dtype=torch.float64, requires_grad=True)
    look = tb.Material(color, mesh.material.opacity, double_sided=True)
    seen = tb.Scene([tb.Mesh(mesh.vertices, mesh.faces, look)], scene.camera)
    tb.stochastic(seen, 4).rgba.sum().backward()
    assert float(color.grad.abs().max()) > 0


@pytest.mark.parametrize(
    ("name", "call", "error"),
    [
        ("scene", lambda s: tb.stochastic("scene"), TypeError),
        ("samples", lambda s: tb.stochastic(s, 0), ValueError),
        ("samples", lambda s: tb.stochastic(s, 2.0), TypeError),
        ("shutter", lambda s: tb.stochastic(s, shutter=(0, 1)), TypeError),
        ("shutter", lambda s: tb.stochastic(s, 2, shutter=tb.Shutter.rolling(0.4, 0.9)), ValueError),
        ("places", lambda s: tb.stochastic(s, places="corner"), ValueError),
        ("seed", lambda s: tb.stochastic(s, seed=0.5), TypeError),
        ("seed", lambda s: tb.accumulate(s, 2, sequence="halton", seed=-1), ValueError),
        ("sequence", lambda s: tb.accumulate(s, 2, sequence="sobol"), ValueError),
    ],
)
def test_wrong_arguments_are_refused_by_name(name, call, error):
    with pytest.raises(error, match=f"^{name}: expected .*, got "):
        call(agreement("opaque"))


@pytest.mark.parametrize("backend", ["torch", "cpu"])
@pytest.mark.parametrize(
    "shutter", [tb.Shutter.trapezoid(0.1, 0.2, 0.7, 0.9), tb.Shutter((0.0, 0.3, 0.6, 1.0), (1.0, 0.0, 0.0, 2.0))]
)
def test_what_rests_is_its_sharp_image_under_any_shutter(shutter, backend):
    wall = torch.tensor([[-9.0, -9, 0], [9, -9, 0], [0, 18, 0]])
    camera = tb.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y_deg=40, width=4, height=4, near=0.1, far=9)
    scene = tb.Scene([tb.Mesh(wall, [[0, 1, 2]], tb.Material((0.0, 0.5, 1.0)))], camera, background=(1.0, 1.0, 1.0))
    wanted = torch.tensor([0.0, 0.5, 1.0, 1.0]).expand(4, 4, 4)
    for n in (1, 3, 8):
        for name, reference in REFERENCES.items():
            seen = reference(scene, n, shutter=shutter, backend=backend)
            assert torch.allclose(seen, wanted, rtol=0, atol=1e-6), (name, n)
