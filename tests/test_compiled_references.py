"""The compiled sharp images and references are those of torch: same coverage, same order, same looks.

Both work in float64 by the same operations in the same order, so geometry agrees to the last bit; sums and textures may
differ by rounding: 1e-12 of values of order 1, and for float32 results their own rounding, 2^-23.
"""

from __future__ import annotations

import threading

import agreement_scenes
import lit_scenes
import numpy as np
import pytest
import scene_makers as make
import torch
from hypothesis import HealthCheck, given, settings
from oracle_looks import LookScene
from oracles import PlainMesh, PlainScene
from random_scenes import Recipe, build, build_shutter, recipes

import torchblur as tb
from torchblur.backends import choose_backend
from torchblur.cpu import shadow_rays

N_EXAMPLES = max(60, settings().max_examples)
ROUNDING = {torch.float64: 1e-12, torch.float32: 2.0**-22}
FIELDS = ("depth_view", "motion_px", "motion_to_open_px", "motion_to_close_px", "bary")


def compare(scene: tb.Scene, shutter: tb.Shutter | None = None, rays: int = 1) -> None:
    """Check that all references of a scene agree."""
    slack = ROUNDING[scene.dtype]

    def both(make_image, what):
        compiled, plain = (make_image(backend).double() for backend in ("cpu", "torch"))
        scale = max(1.0, float(plain.abs().max()))
        torch.testing.assert_close(compiled, plain, rtol=0, atol=slack * scale, msg=lambda m: f"{what}: {m}")

    both(lambda b: tb.accumulate(scene, 5, shutter=shutter, rays_per_pixel=rays, backend=b).rgba, "midpoint")
    both(lambda b: tb.accumulate(scene, 4, shutter=shutter, sequence="halton", backend=b).rgba, "halton")
    for places in ("area", "centre"):
        both(lambda b, p=places: tb.stochastic(scene, 6, shutter=shutter, places=p, backend=b).rgba, places)
    compiled, plain = (tb.render_instant(scene, 0.3, rays_per_pixel=rays, backend=b) for b in ("cpu", "torch"))
    both(lambda b: (compiled if b == "cpu" else plain).rgba, "instant")
    for name in ("mesh_id", "face_id"):
        assert torch.equal(getattr(compiled, name), getattr(plain, name)), name
    for name in FIELDS:
        a, b = getattr(compiled, name), getattr(plain, name)
        torch.testing.assert_close(a, b, rtol=slack, atol=slack, equal_nan=True, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.parametrize("dtype", ROUNDING, ids=str)
@pytest.mark.parametrize("name", agreement_scenes.SCENES)
def test_scenes_that_differ_in_everything(name, dtype):
    compare(make.to_torch(agreement_scenes.SCENES[name](), dtype), rays=2)


@pytest.mark.parametrize("way", ["plain", "shadows", "hybrid"])
@pytest.mark.parametrize("name", lit_scenes.SCENES)
def test_lit_scenes_with_shadows_of_few_casters_and_of_many(name, way, monkeypatch):
    if way == "hybrid":
        monkeypatch.setattr(shadow_rays, "MOST", 0)
    compare(lit_scenes.to_torch(lit_scenes.SCENES[name](), casts_shadows=way != "plain"))


@pytest.mark.parametrize("direction", ["down", "up", "right", "left"])
def test_rolling_shutters(direction):
    shutter = tb.Shutter.rolling(0.5 / agreement_scenes.SIZE, 0.4, direction)
    compare(make.to_torch(agreement_scenes.SCENES["four segments"]()), shutter)


def check(recipe: Recipe) -> None:
    plain, shutter = build(recipe), build_shutter(recipe)
    dtype = torch.float64 if recipe.is_double else torch.float32
    scene = lit_scenes.to_torch(plain, dtype, casts_shadows=recipe.seed % 2 == 0)
    real = tb.Shutter(shutter.times, shutter.weights, shutter.line_delay, shutter.direction)
    compare(scene, real, recipe.n_rays)


@settings(max_examples=N_EXAMPLES, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(recipes())
def test_random_scenes_with_every_degenerate_triangle(recipe):
    check(recipe)


def resting(*triangles, **material) -> tb.Scene:
    """Return triangles at rest, each a mesh of its own colour, on 8 x 8 pixels of the plane z = 0."""
    colours = np.random.default_rng(3).uniform(0, 1, (len(triangles), 3))
    meshes = [PlainMesh(t, [[0, 1, 2]], c, **material) for t, c in zip(triangles, colours, strict=True)]
    return make.to_torch(PlainScene(meshes, make.IDENTITY, 8, 8))


def test_edges_and_corners_in_the_centres_of_pixels_are_covered_once():
    """Eight triangles around a vertex in a pixel's centre, edges along rows, columns and diagonals of centres."""
    around = 0.5 * np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]) + 0.125
    fan = [[(0.125, 0.125, 0), (*around[k], 0), (*around[(k + 1) % 8], 0)] for k in range(8)]
    scene = resting(*fan, opacity=0.5)
    compare(scene)
    alpha = tb.accumulate(scene, 1, backend="cpu").rgba[..., 3]
    assert set(alpha.flatten().tolist()) == {0.0, 0.5}  # never by two, never by none in between
    assert int((alpha == 0.5).sum()) == 16


@pytest.mark.parametrize("opacity", [1.0, 0.5])
def test_coplanar_faces_have_one_order_whatever_the_order_of_input(opacity):
    corners = [(-0.9, -0.8, 0), (0.9, -0.7, 0), (0.0, 0.9, 0)]
    copies = [corners, corners[1:] + corners[:1], corners[::-1], corners]
    scene = resting(*copies, opacity=opacity)
    compare(scene)
    again = tb.Scene(scene.meshes[::-1], scene.camera)
    first, second = (tb.accumulate(s, 3, backend="cpu").rgba for s in (scene, again))
    torch.testing.assert_close(first, second, rtol=0, atol=1e-12)
    assert float(first[..., 3].max()) == pytest.approx(1 - (1 - opacity) ** 4)


def test_opaque_faces_hide_within_half_transparent_coplanar_ones():
    corners = [(-0.9, -0.8, 0), (0.9, -0.7, 0), (0.0, 0.9, 0)]
    for seed in range(6):
        colours = np.random.default_rng(seed).uniform(0, 1, (3, 3))
        meshes = [PlainMesh(corners, [[0, 1, 2]], c, o) for c, o in zip(colours, (1.0, 0.5, 0.25), strict=True)]
        compare(make.to_torch(PlainScene(meshes, make.IDENTITY, 8, 8)))


def test_a_thousand_layers_a_pixel():
    generator, n = np.random.default_rng(1), 1000
    corner = np.array([(-1.5, -1.5), (1.5, -1.5), (1.5, 1.5), (-1.5, 1.5)])
    depth = np.repeat(generator.permutation(np.linspace(-0.9, 0.9, n)), 4)
    place = np.column_stack([np.tile(corner, (n, 1)), depth])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * k for k in range(n)])
    colours = np.repeat(generator.uniform(0, 1, (n, 3)), 2, 0)
    mesh = PlainMesh(np.stack([place, place + 0.01]), faces, colours, 0.02)
    compare(make.to_torch(PlainScene([mesh], make.IDENTITY, 3, 3)))


def test_nothing_to_see():
    camera = tb.Camera(torch.eye(4), 4, 3)
    compare(tb.Scene([], camera, (0.1, 0.2, 0.3)))
    compare(tb.Scene([tb.Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64))], camera))
    clear = make.to_torch(PlainScene([make.quad(-1, 1, -1, 1, 0, opacity=0.0)], make.IDENTITY, 4, 3))
    compare(clear)
    assert (tb.render_instant(clear, backend="cpu").mesh_id == -1).all()


def test_threads_change_nothing():
    scene = make.to_torch(agreement_scenes.SCENES["transparent"]())
    one = tb.accumulate(scene, 9, backend="cpu").rgba
    before = torch.get_num_threads()
    found = []
    try:
        torch.set_num_threads(3)
        work = [
            threading.Thread(target=lambda: found.append(tb.accumulate(scene, 9, backend="cpu").rgba)) for _ in range(2)
        ]
        for thread in work:
            thread.start()
        for thread in work:
            thread.join()
    finally:
        torch.set_num_threads(before)
    assert len(found) == 2
    assert all(torch.equal(image, one) for image in found)


class Images(torch.utils.data.Dataset):
    """Sharp images of a scene, made by whoever asks."""

    def __len__(self):
        return 3

    def __getitem__(self, k):
        return tb.render_instant(make.to_torch(agreement_scenes.SCENES["opaque"]()), 0.4, backend="cpu").rgba


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_workers_of_a_loader_after_use_in_the_parent(start):
    own = Images()[0]
    loader = torch.utils.data.DataLoader(Images(), batch_size=None, num_workers=1, multiprocessing_context=start)
    images = list(loader)
    assert len(images) == 3
    assert all(torch.equal(image, own) for image in images)


def test_which_backend_is_chosen():
    scene = {d: make.to_torch(agreement_scenes.SCENES["opaque"](), d) for d in ROUNDING}
    assert choose_backend(scene[torch.float32], "auto") == "cpu"
    assert choose_backend(scene[torch.float64], "auto") == "torch"
    assert choose_backend(scene[torch.float64], "cpu") == "cpu"
    with pytest.raises(ValueError, match=r"backend: expected one of auto, torch, cpu, got .*gpu"):
        tb.accumulate(scene[torch.float32], 2, backend="gpu")
    with pytest.raises(TypeError, match="backend: expected one of"):
        tb.render_instant(scene[torch.float32], backend=1)


def test_gradients_are_those_of_torch():
    color = torch.tensor([0.2, 0.4, 0.6], requires_grad=True)
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    scene = tb.Scene([tb.Mesh(corners, [[0, 1, 2]], tb.Material(color))], tb.Camera(torch.eye(4), 4, 4))
    for make_image in (tb.accumulate, tb.stochastic):
        image = make_image(scene, 2).rgba
        assert torch.autograd.grad(image.sum(), color)[0].abs().min() > 0
        with pytest.raises(ValueError, match="backend: expected torch or auto for a scene that asks for gradients"):
            make_image(scene, 2, backend="cpu")
        with torch.no_grad():  # then there is nothing to differentiate, whatever the tensors ask for
            assert choose_backend(scene, "auto") == "cpu"
            torch.testing.assert_close(make_image(scene, 2).rgba, image.detach(), rtol=0, atol=1e-6)


def test_recipes_reach_what_the_compiled_code_tells_apart():
    """Of the scenes above some have textures with opacities, moving cameras, lights and one-sided faces."""
    found = set()

    @settings(max_examples=N_EXAMPLES, database=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(recipes())
    def collect(recipe):
        plain: LookScene = build(recipe)
        for mesh in plain.meshes:
            found.add("texture" if mesh.texture is not None and mesh.texture.shape[2] == 4 else "none")
            found.add(mesh.shading)
            found.add(mesh.double_sided)
        found.add(recipe.camera_segments > 0)

    collect()
    assert {"texture", "lambert", "unlit", True, False} <= found
