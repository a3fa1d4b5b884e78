"""The compiled exposure is that of torch: same looks and coverage of every pixel, in every way to render.

Both work in float64 by the same operations, so that times agree to the last bit; crossings in depth are searched over
other slices of time, and sums are taken in another order. 2e-5 is the stated bound for float32 results; float64 ones
are asked for 1e-9, a hundred times what was seen. Where looks vary in time both count their own nodes, each of them
certain to err by less than certificate.TOLERANCE.
"""

from __future__ import annotations

import threading
import time

import agreement_scenes
import lit_scenes
import numpy as np
import pytest
import scene_makers as make
import torch
from hypothesis import HealthCheck, given, settings
from oracles import PlainMesh, PlainScene
from random_scenes import Recipe, build, build_shutter, recipes
from test_random_scenes import accuracy_of

import torchblur as tb
from torchblur.certificate import TOLERANCE

N_EXAMPLES = max(300, settings().max_examples)
SLACK = {torch.float64: 1e-9, torch.float32: 2e-5}
WAYS = {
    "plain": {},
    "all effects": {"effects": "all"},
    "rolling, three rays": {"rays_per_pixel": 3, "shutter": tb.Shutter.rolling(0.05, 0.4, "left")},
    "trapezoid": {"shutter": tb.Shutter.trapezoid(0.1, 0.2, 0.7, 0.9)},
    "cut off": {"accuracy": tb.Accuracy.exact(0.2)},
    "linear": {"accuracy": tb.Accuracy.linear()},
    "adaptive": {"accuracy": tb.Accuracy.adaptive(0.01)},
    "little memory": {"memory_bytes": 1 << 20},
}


def looks_vary(scene: tb.Scene) -> bool:
    """Return whether anything has a texture or light."""
    return any(m.material.texture is not None or m.material.shading == "lambert" for m in scene.meshes)


def compare(scene: tb.Scene, **options) -> tb.Frame:
    """Check that both frames of a scene agree, and return the compiled one."""
    compiled, plain = (tb.render(scene, backend=backend, **options) for backend in ("cpu", "torch"))
    scale = max(1.0, float(plain.rgba.abs().max()))
    for name in ("rgba", "coverage", "shadow"):
        ours, theirs = getattr(compiled, name), getattr(plain, name)
        assert (ours is None) == (theirs is None), name
        if ours is not None:
            slack = max(SLACK[scene.dtype], TOLERANCE if looks_vary(scene) else 0.0) * scale
            torch.testing.assert_close(ours, theirs, rtol=0, atol=slack, msg=lambda m, n=name: f"{n}: {m}")
    return compiled


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", agreement_scenes.SCENES)
def test_scenes_that_differ_in_everything(name, way):
    compare(make.to_torch(agreement_scenes.SCENES[name]()), **WAYS[way])


@pytest.mark.parametrize("name", agreement_scenes.SCENES)
def test_float32(name):
    compare(make.to_torch(agreement_scenes.SCENES[name](), torch.float32))


@pytest.mark.parametrize("casts_shadows", [False, True], ids=["plain", "shadows"])
@pytest.mark.parametrize("name", lit_scenes.SCENES)
def test_textures_lights_and_shadows(name, casts_shadows):
    compare(lit_scenes.to_torch(lit_scenes.SCENES[name](), casts_shadows=casts_shadows))


@pytest.mark.parametrize("casts_shadows", [False, True], ids=["plain", "shadows"])
@pytest.mark.parametrize("name", lit_scenes.SCENES)
def test_textures_and_lights_are_compiled(name, casts_shadows):
    """Torch cuts no cells, but where a texture decides how much light a caster lets through."""
    scene = lit_scenes.to_torch(lit_scenes.SCENES[name](), torch.float32, casts_shadows=casts_shadows)
    textures = [m.material.texture for m in scene.meshes if m.material.texture is not None]
    lets_through = any((t[..., 3:] < 1).any() for t in textures)
    frame = tb.render(scene)
    assert frame.counts["nodes"] > 0
    assert frame.timings["resolve"] > 0
    assert (frame.timings["cells"] > 0) == (casts_shadows and lets_through)


@pytest.mark.parametrize("name", ["crossing", "four segments", "moving camera"])
def test_windows(name):
    scene, windows = make.to_torch(agreement_scenes.SCENES[name]()), [(0.0, 0.3), (0.2, 0.9), (0.5, 0.50001)]
    pairs = (tb.render_windows(scene, windows, backend=b) for b in ("cpu", "torch"))
    for compiled, plain in zip(*pairs, strict=True):
        torch.testing.assert_close(compiled.rgba, plain.rgba, rtol=0, atol=1e-9)
        torch.testing.assert_close(compiled.coverage, plain.coverage, rtol=0, atol=1e-9)


def check(recipe: Recipe) -> None:
    """Check a random scene."""
    plain, shutter = build(recipe), build_shutter(recipe)
    scene = lit_scenes.to_torch(plain, torch.float64 if recipe.is_double else torch.float32)
    real = tb.Shutter(shutter.times, shutter.weights, shutter.line_delay, shutter.direction)
    compare(scene, shutter=real, accuracy=accuracy_of(recipe), rays_per_pixel=recipe.n_rays)


@settings(max_examples=N_EXAMPLES, suppress_health_check=list(HealthCheck))
@given(recipes())
def test_random_scenes(recipe):
    check(recipe)


def test_deep_pixels():
    """A thousand faces that cover three pixels a side: the scratch grows."""
    generator, n = np.random.default_rng(1), 1000
    corner = np.array([(-1.5, -1.5), (1.5, -1.5), (0.0, 1.5)])
    depth = np.repeat(generator.permutation(np.linspace(-0.9, 0.9, n)), 3)
    place = np.column_stack([np.tile(corner, (n, 1)), depth])
    place[:, :2] += generator.uniform(-1, 1, (3 * n, 2))
    later = place + np.column_stack([generator.uniform(-1, 1, (3 * n, 2)), generator.uniform(-2e-3, 2e-3, 3 * n)])
    faces = np.arange(3 * n).reshape(n, 3)
    mesh = PlainMesh(np.stack([place, later]), faces, generator.uniform(0, 1, (n, 3)), 0.02)
    frame = compare(make.to_torch(PlainScene([mesh], make.IDENTITY, 3, 3)))
    assert frame.counts["deepest_pixel"] > 300
    assert frame.counts["crossings"] > 100


def test_nothing_to_see():
    camera = tb.Camera(torch.eye(4), 4, 3)
    compare(tb.Scene([], camera, (0.1, 0.2, 0.3)))
    compare(tb.Scene([tb.Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64))], camera))


def test_more_than_one_tile_and_odd_sizes():
    plain = agreement_scenes.SCENES["rotating, K = 8"]()
    scene = make.to_torch(PlainScene(plain.meshes, plain.world_to_clip, 75, 41, plain.background))
    compare(scene)
    compare(scene, rays_per_pixel=2, memory_bytes=1 << 20)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, 0.2)], ids=["still", "moving"])
def test_what_is_hidden_is_not_solved(shift):
    """A sheet of two opaque faces, moving or not, closes the view on 200 faces behind it."""
    generator = np.random.default_rng(4)
    behind = make.random_triangles(generator, 200)
    behind.vertices[..., 2] = generator.uniform(0.2, 0.8, behind.vertices.shape[:-1])
    sheet = make.quad(-3, 3, -3, 3, -0.5, shift=shift, color=(1, 0, 0))
    camera = np.diag([1.0, 1.0, 1.0, 1.0])
    frame = compare(make.to_torch(PlainScene([behind, sheet], camera, 40, 40)))
    assert frame.counts["intervals"] < 1.5 * 40 * 40
    assert frame.counts["pairs"] < 2.5 * 40 * 40


def test_threads_change_nothing():
    plain = agreement_scenes.SCENES["transparent"]()
    scene = make.to_torch(PlainScene(plain.meshes, plain.world_to_clip, 70, 70, plain.background))
    one = tb.render(scene, backend="cpu").rgba
    before, found = torch.get_num_threads(), []
    try:
        torch.set_num_threads(3)
        work = [threading.Thread(target=lambda: found.append(tb.render(scene, backend="cpu").rgba)) for _ in range(2)]
        for thread in work:
            thread.start()
        for thread in work:
            thread.join()
    finally:
        torch.set_num_threads(before)
    assert len(found) == 2
    assert all(torch.equal(image, one) for image in found)


def test_gradients_need_torch():
    color = torch.tensor([0.2, 0.4, 0.6], requires_grad=True)
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    scene = tb.Scene([tb.Mesh(corners, [[0, 1, 2]], tb.Material(color))], tb.Camera(torch.eye(4), 4, 4))
    assert torch.autograd.grad(tb.render(scene, backend="auto").rgba.sum(), color)[0].abs().min() > 0
    with pytest.raises(ValueError, match="backend: expected torch or auto for a scene that asks for gradients"):
        tb.render(scene, backend="cpu")
    with pytest.raises(ValueError, match=r"backend: expected one of auto, torch, cpu, got .*gpu"):
        tb.render_windows(scene, [(0, 1)], backend="gpu")


class Frames(torch.utils.data.Dataset):
    """Two frames, each rendered where it is asked for."""

    def __len__(self) -> int:
        return 2

    def __getitem__(self, k: int) -> torch.Tensor:
        plain = agreement_scenes.SCENES["transparent"]()
        scene = make.to_torch(PlainScene(plain.meshes, plain.world_to_clip, 40, 40, plain.background))
        return tb.render(scene, backend="cpu", shutter=tb.Shutter.box(0, 0.5 + 0.5 * k)).rgba


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_workers_of_a_data_loader(start):
    """Before, with two threads, and after in the parent."""
    frames, before = Frames(), torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        expected = [frames[k] for k in range(2)]
        loader = torch.utils.data.DataLoader(
            frames, batch_size=None, num_workers=1, multiprocessing_context=start, timeout=300
        )
        found = list(loader)
        again = [frames[k] for k in range(2)]
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(found + again, expected + expected, strict=True))


def test_very_many_layers_that_begin_at_once_take_no_square_of_time():
    n, opacity, random = 60_000, 1e-4, torch.Generator().manual_seed(0)
    depth = torch.linspace(-1, -9, n, dtype=torch.float64)[torch.randperm(n, generator=random)]
    corner = torch.tensor([[-20.0, -20], [20, -20], [0, 30]], dtype=torch.float64).repeat(n, 1)
    start = torch.cat([corner, depth.repeat_interleave(3).unsqueeze(1)], 1)
    color = torch.rand(n, 3, dtype=torch.float64, generator=random)
    moving = torch.stack([start, start + torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64)])
    mesh = tb.Mesh(moving, torch.arange(3 * n).reshape(n, 3), tb.Material(color, opacity))
    camera = tb.Camera.look_at((0, 0, 0), (0, 0, -1), fov_y_deg=30, width=1, height=1, near=0.1, far=20)
    began = time.process_time()
    seen = tb.render(tb.Scene([mesh], camera), backend="cpu").rgba[0, 0]
    assert time.process_time() - began < 60  # 170 s where each was put in its place on its own; less than 1 s now
    before = (1 - opacity) ** torch.arange(n, dtype=torch.float64)
    wanted = (opacity * before.unsqueeze(1) * color[torch.argsort(-depth)]).sum(0)
    assert torch.allclose(seen[:3], wanted, rtol=0, atol=1e-9)
    assert float(seen[3]) == pytest.approx(1 - (1 - opacity) ** n, abs=1e-9)
