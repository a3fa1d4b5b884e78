"""Random scenes of every kind of triangle, texture, light, camera, shutter and accuracy, against slow oracles and laws.

Run as many as wanted: `pytest tests/test_random_scenes.py --hypothesis-profile=slow`.

What is asked of each scene:
- nothing is raised, all is finite and in range;
- one pixel is the oracle's. Exact: within the stated 1e-6 of the brightest that any surface in it could be. Linear: the
  same rule written in numpy, within 1e-7 of it, for end times may be off by 1e-8 at tangencies. Adaptive, where nothing
  has texture or light: only the order of surfaces can be wrong, where the depths of two that cover the ray differ by
  less than twice the tolerance; while they do, a pixel is wrong by at most the largest colour in it. Opacity that does
  not vary along faces is exact in all three, as the times of covering are, whatever the order. Results of float32 are
  rounded to it;
- the order of meshes and faces does not matter (asked of half of the exact scenes), and exactly two parts of the
  exposure average to the whole (asked of the others).
"""

from __future__ import annotations

import dataclasses

import lit_scenes as lit
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from oracle_linear import Answer, PlainShutter, exact_pixel, has_ties, linear_pixel
from oracle_looks import LookMesh, LookScene
from random_scenes import MeshRecipe, Recipe, build, build_shutter, recipes, rng_of

import torchblur as tb
from torchblur.camera import pixel_rays

N_EXAMPLES = max(300, settings().max_examples)
FLOAT32 = 2.0**-23  # twice the rounding of a result
N_SAMPLES = 64  # times of a cell at which depths are compared


def accuracy_of(recipe: Recipe) -> tb.Accuracy:
    """Return the accuracy of a recipe."""
    tolerance = float(rng_of(recipe, 104).choice([0.1, 0.01, 1e-3]))
    return {
        "exact": tb.Accuracy.exact(),
        "linear": tb.Accuracy.linear(),
        "adaptive": tb.Accuracy.adaptive(tolerance),
    }[recipe.method]


def rendered(recipe: Recipe, plain: LookScene, shutter: PlainShutter) -> tb.Frame:
    """Return the frame of a plain scene."""
    scene = lit.to_torch(plain, torch.float64 if recipe.is_double else torch.float32)
    real = tb.Shutter(shutter.times, shutter.weights, shutter.line_delay, shutter.direction)
    return tb.render(scene, accuracy=accuracy_of(recipe), shutter=real, rays_per_pixel=recipe.n_rays)


def arrays(frame: tb.Frame) -> tuple[np.ndarray, np.ndarray]:
    """Return RGBA and coverage as float64."""
    return frame.rgba.double().numpy(), frame.coverage.double().numpy()


def shuffled(plain: LookScene, rng: np.random.Generator) -> tuple[LookScene, np.ndarray]:
    """Return the scene with meshes and faces in another order, and which mesh went where."""
    meshes = []
    for m in plain.meshes:
        order = rng.permutation(len(m.faces))
        per_face = {"faces": m.faces[order], "uv": m.uv[order]}
        if m.color.ndim == 2:
            per_face |= {"color": m.color[order], "opacity": m.opacity[order]}
        meshes.append(dataclasses.replace(m, **per_face))
    place = rng.permutation(len(meshes))
    return dataclasses.replace(plain, meshes=[meshes[k] for k in place]), place


def check_range(recipe: Recipe, plain: LookScene, rgba: np.ndarray, coverage: np.ndarray) -> None:
    """Check that nothing is impossible."""
    assert np.isfinite(rgba).all()
    assert np.isfinite(coverage).all()
    slack = 1e-9 if recipe.is_double else 1e-6
    assert rgba.min() >= 0
    assert rgba[..., 3].max() <= 1 + slack
    assert coverage.min() >= 0
    assert coverage.max() <= 1 + slack
    if all(m.shading == "unlit" for m in plain.meshes):
        most = [np.max(m.color) * (1 if m.texture is None else np.max(m.texture)) for m in plain.meshes]
        assert rgba[..., :3].max() <= max(*most, np.max(plain.background)) + slack


def check_order(recipe: Recipe, plain: LookScene, shutter: PlainShutter, found: tuple[np.ndarray, np.ndarray]) -> None:
    """Check that the order of input does not matter."""
    again, place = shuffled(plain, rng_of(recipe, 105))
    rgba, coverage = arrays(rendered(recipe, again, shutter))
    slack = 1e-9 if recipe.is_double else FLOAT32
    np.testing.assert_allclose(rgba, found[0], rtol=slack, atol=slack, err_msg="order of input")
    np.testing.assert_allclose(coverage, found[1][..., place], rtol=0, atol=slack, err_msg="order of input, coverage")


def check_parts(recipe: Recipe, plain: LookScene, pixel: tuple[int, int], brightest: float) -> None:
    """Check that two parts of the exposure average to the whole."""
    cut = float(rng_of(recipe, 106).uniform(0.1, 0.9))
    windows = [PlainShutter(w, (1.0, 1.0)) for w in ((0.0, cut), (cut, 1.0), (0.0, 1.0))]
    first, second, whole = (arrays(rendered(recipe, plain, w))[0][pixel] for w in windows)
    tolerance = (1e-7 if recipe.is_double else 1e-6) * max(1.0, brightest)
    np.testing.assert_allclose(cut * first + (1 - cut) * second, whole, rtol=0, atol=tolerance, err_msg="parts")


def mean_answer(recipe: Recipe, plain: LookScene, shutter: PlainShutter, pixel: tuple[int, int]) -> Answer:
    """Return the oracle's mean over the pixel's rays."""
    oracle = linear_pixel if recipe.method == "linear" else exact_pixel
    answers = [oracle(plain, shutter, *pixel, ray[:2]) for ray in pixel_rays(recipe.n_rays)]
    return Answer(
        np.mean([a.rgba for a in answers], 0),
        np.mean([a.coverage for a in answers], 0),
        max(a.brightest for a in answers),
        all(a.is_clear for a in answers),
        [cell for a in answers for cell in a.cells],
    )


def uncertain_share(answer: Answer, shutter: PlainShutter, delay: float, tolerance: float) -> float:
    """Return at most which share of the exposure has two surfaces within `tolerance` in z / w, sampled with slack."""
    total = 0.0
    for a, b, active in answer.cells:
        t = a + (b - a) * (np.arange(N_SAMPLES) + 0.5) / N_SAMPLES
        depths = np.array([np.divide(*p.depth_parts(t)) for p in active]).reshape(-1, N_SAMPLES)
        gaps = np.diff(np.sort(depths, axis=0), axis=0)
        close = (gaps < 1.01 * tolerance).any(0)
        share = min(1.0, close.mean() + (4 / N_SAMPLES if close.any() and not close.all() else 0))
        total += share * (b - a) * float(shutter.density(t - delay).max())
    return total


def check_pixel(recipe: Recipe, plain: LookScene, shutter: PlainShutter, found: tuple[np.ndarray, np.ndarray]) -> None:
    """Compare one pixel with the oracle, if the oracle can decide what is in front there."""
    covered = np.argwhere(found[1].max(-1) > 0)
    row, col = covered[rng_of(recipe, 107).integers(len(covered))].tolist() if len(covered) else (0, 0)
    if any(has_ties(plain, row, col, ray[:2]) for ray in pixel_rays(recipe.n_rays)):
        return
    answer = mean_answer(recipe, plain, shutter, (row, col))
    error = np.abs(found[0][row, col] - answer.rgba)
    rounding = 0.0 if recipe.is_double else FLOAT32 * max(1.0, float(answer.rgba.max()))
    opacity_varies = any(m.texture is not None and m.texture.shape[2] == 4 for m in plain.meshes)
    share = {"exact": 1e-6, "linear": 1e-7, "adaptive": 1e-7}[recipe.method]
    if not opacity_varies or recipe.method == "exact" or (recipe.method == "linear" and answer.is_clear):
        assert error[3] <= share + rounding, (error, answer)
    if not answer.is_clear:
        return
    if recipe.method != "adaptive":
        assert error[:3].max() <= share * answer.brightest + rounding, (error, answer)
        if not opacity_varies:  # an opacity that is 1 up to rounding hides up to rounding
            gap = np.abs(found[1][row, col] - answer.coverage)
            assert gap.max() <= share + FLOAT32 * (not recipe.is_double), (gap, answer)
    elif all(m.texture is None and m.shading == "unlit" for m in plain.meshes):
        tolerance = 2 * accuracy_of(recipe).tolerance
        bound = uncertain_share(answer, shutter, shutter.delay(plain, row, col), tolerance) / recipe.n_rays
        assert error[:3].max() <= (bound + 1e-7) * answer.brightest + rounding, (error, bound, answer)
    if recipe.method == "exact" and recipe.seed % 2:
        check_parts(recipe, plain, (row, col), answer.brightest)


def check(recipe: Recipe) -> None:
    """Check all that is said above."""
    plain, shutter = build(recipe), build_shutter(recipe)
    found = arrays(rendered(recipe, plain, shutter))
    check_range(recipe, plain, *found)
    if recipe.method != "exact" or recipe.seed % 2 == 0:
        check_order(recipe, plain, shutter, found)
    check_pixel(recipe, plain, shutter, found)


@settings(max_examples=N_EXAMPLES, suppress_health_check=list(HealthCheck), database=None)
@given(recipes())
def test_random_scenes(recipe):
    check(recipe)


@pytest.mark.parametrize("name", list(lit.SCENES))
def test_linear_is_the_rule(name):
    """On the scenes of the lights' own tests, every pixel."""
    plain = lit.SCENES[name]()
    got = tb.render(lit.to_torch(plain), accuracy=tb.Accuracy.linear()).rgba.numpy()
    for row, col in np.ndindex(plain.height, plain.width):
        answer = linear_pixel(plain, PlainShutter(), row, col)
        error = np.abs(got[row, col] - answer.rgba)
        assert error.max() <= 1e-7 * max(1.0, answer.brightest), (row, col, error)


def mesh_of(*kinds: str, n_segments=1, **changes) -> MeshRecipe:
    """Return the recipe of a mesh with a texture without levels, unlit, half transparent."""
    plain = MeshRecipe(kinds, n_segments, (7, 9, 3), "repeat", False, "unlit", False, True, "half")
    return dataclasses.replace(plain, **changes)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("mipmap", [True, False])
def test_linear_looks_up_textures(mipmap, seed):
    """Slices that are several texels long, which take several taps."""
    mesh = mesh_of(*["plain"] * 6, texture=(7, 9, 4), mipmap=mipmap)
    check(Recipe(seed, "perspective", 1, (mesh,), (), (3, 2), 1, "box", "linear", True))


@pytest.mark.parametrize("seed", range(8))
def test_linear_does_not_depend_on_the_levels_of_other_meshes(seed):
    """A texture without levels was looked up with the taps of one that has them, where another mesh has."""
    meshes = mesh_of(*["plain"] * 4), mesh_of("plain", mipmap=True)
    check(Recipe(seed, "orthographic", 0, meshes, (), (2, 2), 1, "box", "linear", True))


@pytest.mark.parametrize("method", ["exact", "linear", "adaptive"])
@pytest.mark.parametrize("shading", ["unlit", "lambert"])
def test_lines_are_nothing(method, shading):
    """Some of 1500 lines cover the ray for a rounding error, at times at which all edge functions are 0."""
    start = np.random.default_rng(1).uniform(-1, 1, (2, 1500, 3)).round(1)
    step = np.random.default_rng(2).uniform(-1, 1, (2, 1500, 3)).round(1)
    knots = np.stack([start, start + step, start + 2 * step], 2).reshape(2, -1, 3)
    n = len(knots[0]) // 3
    mesh = LookMesh(knots, np.arange(3 * n).reshape(n, 3), uv=np.zeros((n, 3, 2)), texture=np.ones((2, 3, 3)))
    mesh.shading = shading
    scene = lit.to_torch(LookScene([mesh], lit.UPRIGHT, 1, 1, (0.2, 0.4, 0.6), lights=[lit.point((0.3, 0.2, 1.4))]))
    accuracy = tb.Accuracy.adaptive(0.01) if method == "adaptive" else tb.Accuracy(method=method)
    got = tb.render(scene, accuracy=accuracy).rgba[0, 0].numpy()
    np.testing.assert_allclose(got, [0.2, 0.4, 0.6, 0.0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("other", ["uv", "normals", "shading", "wrap", "mipmap"])
def test_order_of_coplanar_faces_that_look_different(other):
    """Two faces in one place, of one mesh and of two, which differ in one thing alone."""
    rng = np.random.default_rng(3)
    corners = np.array([[-3.0, -3, 0], [3, -3, 0], [0, 4, 0]])
    plain = {"texture": rng.uniform(0, 1, (4, 5, 3)), "uv": 1 + 3 * rng.uniform(0, 1, (1, 3, 2))}
    plain |= {"shading": "lambert", "normals": np.array([[0.0, 0, 1]] * 3)}
    change = {"uv": plain["uv"] / 2, "normals": np.array([[0.5, 0, 1]] * 3), "shading": "unlit"}
    change |= {"wrap": "clamp", "mipmap": False}
    one, two = (LookMesh(corners, [[0, 1, 2]], **look) for look in (plain, plain | {other: change[other]}))
    orders = [[one, two], [two, one]]
    if other in ("uv", "normals"):
        orders += [
            [
                dataclasses.replace(
                    a,
                    vertices=np.concatenate([corners, corners]),
                    faces=[[0, 1, 2], [3, 4, 5]],
                    uv=np.concatenate([a.uv, b.uv]),
                    normals=np.concatenate([a.normals, b.normals]),
                )
            ]
            for a, b in orders
        ]
    scenes = [LookScene(meshes, lit.UPRIGHT, 1, 1, lights=[lit.sun((-0.5, 0, -1), 3.0)]) for meshes in orders]
    images = [tb.render(lit.to_torch(scene)).rgba for scene in scenes]
    for k in range(0, len(images), 2):
        torch.testing.assert_close(images[k], images[k + 1], rtol=0, atol=1e-12)
