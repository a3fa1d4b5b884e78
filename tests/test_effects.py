"""Plans of effects are right both ways, and what they leave out would not have changed the image.

Soundness: "auto" and "all" differ by at most 1e-12 in float64 and 1e-6 in float32, of 1 or the brightest pixel, over
random scenes and at the borders of every decision.
"""

from __future__ import annotations

import dataclasses
import json

import effect_scenes
import lit_scenes
import numpy as np
import pytest
import random_scenes
import scene_makers as make
import test_references
import torch
from effect_scenes import Body, Stage
from hypothesis import HealthCheck, given, settings
from test_random_scenes import accuracy_of

import torchblur as tb
from torchblur.effects import SWITCHED

SETTINGS = settings(
    max_examples=max(300, settings().max_examples), suppress_health_check=list(HealthCheck), database=None
)
ATOL = {torch.float64: 1e-12, torch.float32: 1e-6}


def check_same(scene: tb.Scene, **options) -> tuple[tb.Frame, tb.Frame]:
    """Compare what is rendered with the effects that are needed and with all; return both frames."""
    auto, everything = (tb.render(scene, effects=effects, **options) for effects in ("auto", "all"))
    textures = [mesh.material.texture for mesh in scene.meshes if mesh.material.texture is not None]
    is_sampled = bool(scene.lights) and any(t.shape[-1] == 4 and bool((t[..., 3] < 1).any()) for t in textures)
    slack = ATOL[torch.float32 if is_sampled else scene.dtype]  # what shines through a texture is sampled, from cuts on
    slack *= max(1.0, float(everything.rgba.abs().max()))
    torch.testing.assert_close(auto.rgba, everything.rgba, rtol=0, atol=slack)
    torch.testing.assert_close(auto.coverage, everything.coverage, rtol=0, atol=ATOL[scene.dtype])
    return auto, everything


@SETTINGS
@given(random_scenes.recipes())
def test_random_triangles(recipe):
    plain, shutter = random_scenes.build(recipe), random_scenes.build_shutter(recipe)
    scene = lit_scenes.to_torch(plain, torch.float64 if recipe.is_double else torch.float32)
    real = tb.Shutter(shutter.times, shutter.weights, shutter.line_delay, shutter.direction)
    check_same(scene, accuracy=accuracy_of(recipe), shutter=real, rays_per_pixel=recipe.n_rays)


@SETTINGS
@given(effect_scenes.stages())
def test_random_bodies(stage):
    check_same(effect_scenes.build(stage), rays_per_pixel=stage.n_rays)


@pytest.mark.parametrize("method", ["linear", "adaptive"])
@pytest.mark.parametrize("look", effect_scenes.LOOKS)
def test_approximations_keep_theirs(method, look):
    """They depend on where cells are cut, also by what is hidden."""
    bodies = [Body("wall", (0, 0, z), motion, look, 1.0, True) for z, motion in ((-2, "still"), (-1, "turn"))]
    bodies.append(Body("box", (0, 0, 1), "turn in pieces", look, 1.0, False))
    accuracy = tb.Accuracy.adaptive(0.01) if method == "adaptive" else tb.Accuracy.linear()
    check_same(effect_scenes.build(Stage(tuple(bodies), False, 0.1, "still", 1, True, 3)), accuracy=accuracy)


@pytest.mark.parametrize("name", ["quad", "plank"])
def test_scenes_of_the_references(name):
    if not (test_references.FOLDER / name).is_dir():
        pytest.skip(f"NOT TESTED: reference images are not at {test_references.FOLDER}")
    check_same(test_references.read_scene(test_references.FOLDER / name, torch.float32)[0])


def shape(*corners, end=None, **options) -> tb.Mesh:
    """Return a mesh of one triangle, or of a sheet of two, that may move to `end`; options of Mesh or Material."""
    start = torch.tensor(corners, dtype=torch.float64)
    faces = [[0, 1, 2]] if len(corners) == 3 else [[0, 1, 2], [0, 2, 3]]
    knots = start if end is None else torch.stack([start, *(torch.tensor(e, dtype=torch.float64) for e in end)])
    own = {k: options.pop(k) for k in ("uv", "normals") if k in options}
    if "texture" in options:
        own["uv"] = torch.tensor([[[0.0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], dtype=torch.float64)
        own["uv"] = own["uv"][: len(faces)]
    return tb.Mesh(knots, faces, tb.Material(**options), **own)


def sheet(z=0.0, shift=None, x=(-0.5, 0.5), **options) -> tb.Mesh:
    """Return an upright sheet at depth z that may move."""
    corners = np.array([[x[0], -0.5, z], [x[1], -0.5, z], [x[1], 0.5, z], [x[0], 0.5, z]])
    return shape(*corners.tolist(), end=None if shift is None else [corners + shift], **options)


def approaching(*depths, x=0.0, tilt=0.0, **options) -> tb.Mesh:
    """Return a triangle, perhaps tilted, whose depth goes through `depths` at equal times."""
    corners = [np.array([[x - 0.4, -0.4, z], [x + 0.4, -0.4, z], [x, 0.4, z + tilt]]) for z in depths]
    return shape(*corners[0].tolist(), end=[c.tolist() for c in corners[1:]] or None, **options)


def turning(**options) -> tb.Mesh:
    """Return a triangle that turns its back."""
    start = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0, 0.5, 0]])
    return shape(*start.tolist(), end=[(start * [-1, 1, 1]).tolist()], **options)


TEXTURE = torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
CLEAR_TEXTURE, SOLID_TEXTURE = (torch.cat([TEXTURE, torch.full((4, 4, 1), a)], 2) for a in (0.999, 1.0))
ULP = np.finfo(np.float64).eps
STILL_LAMP = tb.PointLight((1.0, 1.0, -3.0), 10.0)
MOVING_LAMP = tb.PointLight([[1.0, 1.0, -3.0], [2.0, 1.0, -3.0]], 10.0)
GLIDING = np.stack([np.eye(4), np.eye(4)])
GLIDING[1, 0, 3] = 0.5

# name: (meshes, what they need, lights, camera)
TRUTH = {
    "a sheet at rest": ([sheet()], ""),
    "knots that are equal": ([sheet(shift=[0.0, 0, 0])], ""),
    "sheets at rest one behind the other": ([sheet(0.0), sheet(0.5), sheet(-0.5)], ""),
    "sheets at rest that pass through each other": ([approaching(0.0, tilt=0.5), sheet(0.1)], ""),
    "the same beside one that moves": (
        [approaching(0.0, tilt=0.5), sheet(0.1, x=(-0.4, 0.4)), sheet(0.0, [0.1, 0, 0], (-0.9, -0.7))],
        "motion",
    ),
    "a sheet that moves": ([sheet(shift=[0.4, 0, 0])], "motion"),
    "one that barely moves": ([sheet(shift=[ULP, 0, 0])], "motion"),
    "one that moves before one at rest": ([sheet(shift=[0.4, 0, 0]), sheet(0.5)], "motion"),
    "opacity 0.999": ([sheet(opacity=0.999)], "transparency"),
    "the next number below 1": ([sheet(opacity=1 - ULP / 2)], "transparency"),
    "opacity 0": ([sheet(opacity=0.0), sheet(0.5)], ""),
    "a texture at rest": ([sheet(texture=TEXTURE)], "texture"),
    "a texture that moves": ([sheet(texture=TEXTURE, shift=[0.4, 0, 0])], "texture motion curvature"),
    "a texture at rest and a plain sheet that moves": (
        [sheet(texture=TEXTURE), sheet(-0.5, [0.4, 0, 0])],
        "texture motion",
    ),
    "a texture with opacity 0.999": ([sheet(texture=CLEAR_TEXTURE)], "texture transparency"),
    "a texture with opacity 1": ([sheet(texture=SOLID_TEXTURE)], "texture"),
    "a texture out of view": ([sheet(texture=TEXTURE, x=(2.0, 3.0)), sheet()], ""),
    "lit at rest": ([sheet(shading="lambert")], "lighting", [STILL_LAMP]),
    "lit by a light that moves": ([sheet(shading="lambert")], "lighting curvature", [MOVING_LAMP]),
    "lit in motion": ([sheet(shading="lambert", shift=[0.1, 0, 0])], "lighting motion curvature", [STILL_LAMP]),
    "lit sheets in the light of each other": (
        [sheet(shading="lambert"), sheet(-0.5, shading="lambert")],
        "lighting shadows",
        [STILL_LAMP],
    ),
    "lit before a sheet that moves and casts": (
        [sheet(-0.5, [0.4, 0, 0], (-0.9, -0.4)), sheet(shading="lambert")],
        "lighting motion curvature shadows",
        [STILL_LAMP],
    ),
    "lit in motion from everywhere alike": ([sheet(shading="lambert", shift=[0.1, 0, 0])], "lighting motion"),
    "a light on nothing that is lit": ([sheet()], "", [MOVING_LAMP]),
    "through the near plane": ([approaching(-0.5, -1.5)], "motion clipping"),
    "on the near plane": ([approaching(-1.0, -0.5)], "motion"),
    "through the far plane": ([approaching(0.5, 1.5)], "motion clipping"),
    "one side shown, in motion": ([sheet(double_sided=False, shift=[0.4, 0, 0])], "motion"),
    "its back alone, in motion": ([approaching(0.5, 0.2, double_sided=False), turning(double_sided=True)], "motion"),
    "it turns its back": ([turning(double_sided=False)], "motion facing"),
    "it turns its back, which looks the same": ([turning(double_sided=True)], "motion"),
    "depths that pass": ([approaching(0.0, 0.5), approaching(0.5, 0.0)], "motion crossings"),
    "depths that touch": ([approaching(0.0, 0.5), approaching(1.0, 0.5)], "motion"),
    "depths that pass in different places": ([approaching(0.0, 0.5, x=-0.5), approaching(0.5, 0.0, x=0.5)], "motion"),
    "depths that overlap, but not at one time": (
        [approaching(0.0, 0.2, 0.6), approaching(0.3, 0.7, 0.9)],
        "motion",
    ),
    "a camera that moves": ([sheet()], "motion", [], GLIDING),
    "a texture under a camera that moves": ([sheet(texture=TEXTURE)], "texture motion curvature", [], GLIDING),
    "motion out of view": ([sheet(x=(2.0, 3.0), shift=[0.4, 0, 0]), sheet()], ""),
    "nothing": ([], ""),
}
FACING_AWAY = ("its back alone, in motion",)


def truth_scene(name: str) -> tuple[tb.Scene, set[str]]:
    """Return a scene whose needs are known."""
    meshes, needs, lights, matrix = (*TRUTH[name], [], make.IDENTITY)[:4] if len(TRUTH[name]) == 2 else (
        *TRUTH[name], make.IDENTITY)[:4]  # fmt: skip
    if name in FACING_AWAY:  # counter-clockwise triangles show their fronts
        meshes = [tb.Mesh(meshes[0].vertices, meshes[0].faces.flip(1), meshes[0].material), *meshes[1:]]
    camera = tb.Camera(torch.tensor(matrix), 12, 10)
    return tb.Scene(meshes, camera, (0.1, 0.2, 0.3), lights=lights), set(needs.split())


@pytest.mark.parametrize("name", list(TRUTH))
def test_plan_is_right_both_ways(name):
    scene, needs = truth_scene(name)
    plan = tb.plan_effects(scene)
    assert plan.needed == needs, str(plan)
    auto, everything = check_same(scene)
    assert auto.plan == plan
    assert auto.plan.simulated == needs
    assert everything.plan.simulated == needs | set(SWITCHED)


@pytest.mark.parametrize("forced", SWITCHED)
@pytest.mark.parametrize("name", list(TRUTH))
def test_each_effect_can_be_forced(name, forced):
    scene, needs = truth_scene(name)
    plan = tb.plan_effects(scene).forcing(forced)
    frame = tb.render(scene, effects=plan)
    assert frame.plan.simulated == needs | {forced}
    torch.testing.assert_close(frame.rgba, tb.render(scene).rgba, rtol=0, atol=1e-12)


def test_what_each_effect_does():
    """What is left out is not done, and what is forced is: seen in the counts."""
    wall, box = (
        Body("wall", (0, 0, -3), "still", "texture", 1.0, True),
        Body("box", (0, 0, 0), "turn", "flat", 1.0, True),
    )
    scene = effect_scenes.build(Stage((wall, box), False, 0.1, None, 1, True, 0))
    auto, everything = check_same(scene)
    assert auto.counts["still_pairs"] > 0
    assert everything.counts["still_pairs"] == 0
    assert auto.counts["pairs"] + auto.counts["hidden_pairs"] < everything.counts["pairs"]
    assert auto.counts["intervals"] < everything.counts["intervals"]
    assert auto.counts["nodes"] == auto.counts["cells"]
    by_motion = tb.render(scene, effects=tb.plan_effects(scene).forcing("motion")).counts
    assert by_motion["still_pairs"] == 0
    one_sided = dataclasses.replace(box, double_sided=False)
    scene = effect_scenes.build(Stage((one_sided,), False, 0.1, None, 1, True, 0))
    pairs = [tb.render(scene, effects=e).counts["pairs"] for e in ("auto", tb.plan_effects(scene).forcing("facing"))]
    assert pairs[0] < pairs[1]


def test_what_is_hidden_is_not_solved():
    """A box in front of others, at rest and in motion: most rays see nothing of them."""
    front = Body("wall", (0, 0, 2), "forward", "flat", 1.0, True)
    behind = tuple(Body("box", (x, 0, -2), "turn in pieces", "faces", 0.5, True) for x in (-1, 0, 1))
    auto, everything = check_same(effect_scenes.build(Stage((*behind, front), False, 0.1, None, 1, True, 1)))
    assert auto.counts["hidden_pairs"] > 0.3 * everything.counts["pairs"]


@pytest.mark.parametrize("look", ["faces", "lit"])
def test_gradients_are_the_same(look):
    bodies = (
        Body("wall", (0, 0, -3), "still", "texture", 1.0, True),
        Body("box", (0, 0, 0), "shift", look, 1.0, True),
    )
    grads = []
    for effects in ("auto", "all"):
        scene = effect_scenes.build(Stage(bodies, False, 0.1, "still", 1, True, 0))
        leaves = [m.vertices.requires_grad_() for m in scene.meshes] + [
            scene.meshes[0].material.texture.requires_grad_()
        ]
        rgba = tb.render(scene, effects=effects).rgba
        weight = torch.rand(rgba.shape, generator=torch.Generator().manual_seed(0), dtype=rgba.dtype)
        grads.append(torch.autograd.grad((rgba * weight).sum(), leaves))
    for a, b in zip(*grads, strict=True):
        assert float(a.abs().max()) > 0
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9 if look == "faces" else 1e-5)  # by nodes: certified


def test_knots_that_ask_for_gradients_move():
    scene, _ = truth_scene("knots that are equal")
    scene.meshes[0].vertices.requires_grad_()
    assert not scene.is_still(scene.meshes[0])


def test_windows_share_a_plan():
    scene, needs = truth_scene("one that moves before one at rest")
    windows = [(0.0, 0.3), (0.3, 1.0)]
    auto, everything = (tb.render_windows(scene, windows, effects=e) for e in ("auto", "all"))
    for a, b in zip(auto, everything, strict=True):
        assert a.plan.needed == needs
        torch.testing.assert_close(a.rgba, b.rgba, rtol=0, atol=1e-12)


def test_window_without_motion():
    """A mesh that moves in the second half only rests in the first."""
    knots = torch.tensor(make.grid(1, 0.5)[0]).expand(3, -1, -1).clone()
    knots[2, :, 0] += 0.5
    scene = tb.Scene([tb.Mesh(knots, make.grid(1, 0.5)[1])], tb.Camera(torch.eye(4, dtype=torch.float64), 8, 8))
    assert "motion" in tb.plan_effects(scene).needed
    assert "motion" not in tb.plan_effects(scene, shutter=tb.Shutter.box(0, 0.5)).needed


@pytest.mark.parametrize(("accuracy", "needs"), [(tb.Accuracy.linear(), set()), (tb.Accuracy.adaptive(0.1), set())])
def test_depth_that_is_straight_is_not_cut(accuracy, needs):
    scene, _ = truth_scene("a sheet that moves")
    assert tb.plan_effects(scene, accuracy)["curvature"].needed == bool(needs)
    slanted = shape((-0.5, -0.5, 0.0), (0.5, -0.5, 0.3), (0.0, 0.5, 0.0), end=[[(0, 0, 0), (1, 0, 0.3), (0.5, 1, 0)]])
    curved = tb.Scene([slanted], scene.camera)
    assert tb.plan_effects(curved, accuracy)["curvature"].needed
    for each in (scene, curved):
        check_same(each, accuracy=accuracy)


def test_plan_is_told():
    scene, _ = truth_scene("a texture with opacity 0.999")
    plan = tb.plan_effects(scene, rays_per_pixel=4)
    text = str(plan)
    for effect in plan.effects:
        line = next(line for line in text.splitlines() if line.startswith(effect.name))
        assert ("yes" if effect.needed else "no") in line.split()
        assert effect.why.split()[0] in line
    assert max(map(len, text.splitlines())) <= 120
    assert "rays" in plan.needed
    assert plan.moves == (False,)
    assert plan.opacity == ("textured",)
    again = json.loads(json.dumps(plan.to_dict()))
    assert again["effects"]["transparency"]["needed"] is True
    assert again["effects"]["motion"]["needed"] is False
    assert "forced" in str(plan.forcing("motion"))
    with pytest.raises(KeyError):
        plan["fog"]


def test_timings_and_counts_name_what_was_done():
    scene, _ = truth_scene("a texture that moves")
    frame = tb.render(scene)
    assert list(frame.timings) == ["prisms", "plan", "intervals", "cells", "nodes", "shadows", "resolve"]
    assert all(seconds > 0 for stage, seconds in frame.timings.items() if stage != "shadows")


def test_effects_are_timed_where_they_have_code_of_their_own():
    frames = {name: tb.render(truth_scene(name)[0]) for name in ("a texture that moves", "a sheet that moves")}
    textured, plain = (frame.effect_timings for frame in frames.values())
    assert list(textured) == ["texture", "lighting", "shadows", "crossings", "curvature"]
    assert textured["texture"] > 0
    assert textured["shadows"] < 1e-3
    assert plain["curvature"] < 1e-3
    assert all(sum(f.effect_timings.values()) < sum(f.timings.values()) for f in frames.values())


def test_bad_plans_are_refused():
    scene, _ = truth_scene("depths that pass")
    plain = tb.plan_effects(truth_scene("a sheet at rest")[0])
    with pytest.raises(ValueError, match=r"effects: expected a plan with crossings, motion, which the scene needs"):
        tb.render(scene, effects=plain)
    with pytest.raises(TypeError, match=r'effects: expected "auto", "all" or an EffectPlan'):
        tb.render(scene, effects="some")
    with pytest.raises(ValueError, match=r"names: expected some of motion, .* got str 'fog'|names: .*fog"):
        plain.forcing("fog")
    for wrong in ({"scene": 1}, {"accuracy": 1}, {"shutter": 1}, {"rays_per_pixel": 0}):
        with pytest.raises((TypeError, ValueError), match=next(iter(wrong))):
            tb.plan_effects(**({"scene": scene} | wrong))
