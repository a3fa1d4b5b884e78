"""Deliberate bugs in what plans leave out; the named check must turn red, and be green without them."""

from __future__ import annotations

import dataclasses
import importlib
from types import SimpleNamespace

import pytest
import test_effects
import torch
from effect_scenes import Body, Stage, build

from torchblur import edges, effects, hidden, scene, survey

render = importlib.import_module("torchblur.render")


def same(*bodies: Body, **changes):
    """Return the check that "auto" and "all" agree on a scene of bodies."""
    stage = dataclasses.replace(Stage(bodies, False, 0.1, "still", 1, True, 5), **changes)
    return lambda: test_effects.check_same(build(stage))


def right(name: str):
    """Return the check that a plan is right both ways."""
    return lambda: test_effects.test_plan_is_right_both_ways(name)


def body(shape: str, z: int, motion: str, look: str = "faces", opacity: float = 1.0, double_sided: bool = True) -> Body:
    """Return a body in the middle of the view."""
    return Body(shape, (0, 0, z), motion, look, opacity, double_sided)


STILL = same(body("wall", -2, "still"), body("slant", 0, "still"), body("box", 0, "shift"))
COVERED = same(body("wall", -2, "shift", "texture"), body("box", 0, "shift"))
GLASS = same(body("wall", -2, "shift"), body("box", 0, "shift", opacity=0.999))


def changed(function, change):
    """Return `function` with its result put through `change`."""
    return lambda *args: change(function(*args))


def with_field(function, **changes):
    """Return `function` with fields of its dataclass result put through functions."""
    return changed(function, lambda r: dataclasses.replace(r, **{k: f(getattr(r, k)) for k, f in changes.items()}))


def plant_farthest_of_what_rests(patch):
    patch.setattr(hidden, "CLEARLY", -1e-3)


def plant_all_rests(patch):
    patch.setattr(render, "survey_prisms", with_field(render.survey_prisms, is_still=torch.ones_like))


def plant_all_hides(patch):
    patch.setattr(render, "survey_prisms", with_field(render.survey_prisms, hides=torch.ones_like))


def plant_front_and_back_changed(patch):
    patch.setattr(render, "survey_prisms", with_field(render.survey_prisms, facing=torch.neg))


def plant_gaps_in_covers_ignored(patch):
    def wrong(prisms, found, intervals):
        low, _ = hidden.bernstein.ratio_range(intervals.near_num, intervals.near_den)
        pixel = hidden.packed.owners(intervals.offsets)
        nothing = low.new_zeros(len(intervals.offsets) - 1)
        return nothing.scatter_reduce(0, pixel, low.clamp(min=0), "amax")

    patch.setattr(hidden, "_lasting_cover", wrong)


def plant_greatest_nearness_of_covers(patch):
    original = hidden.bernstein.ratio_range
    patch.setattr(hidden, "bernstein", SimpleNamespace(ratio_range=lambda *args: original(*args)[::-1]))


def plant_tie_rule_dropped_for_what_rests(patch):
    original = edges.still_sign

    def wrong(corners):
        with pytest.MonkeyPatch.context() as inner:
            inner.setattr(edges, "_break_ties", lambda e, *_: e)
            return original(corners)

    patch.setattr(edges, "still_sign", wrong)


def plant_order_never_changes(patch):
    patch.setattr(render, "survey_prisms", with_field(render.survey_prisms, may_cross=lambda _: False))


def plant_looks_never_change(patch):
    patch.setattr(render, "build_surfaces", with_field(render.build_surfaces, is_varying=torch.zeros_like))


def plant_lights_rest(patch):
    def wrong(scene):
        resting = [dataclasses.replace(light, position=light.position.reshape(-1, 3)[0]) for light in scene.lights]
        found = original(dataclasses.replace(scene, lights=resting))
        return dataclasses.replace(original(scene), is_varying=found.is_varying)

    original = render.build_surfaces
    patch.setattr(render, "build_surfaces", wrong)


def plant_only_ends_compared(patch):
    patch.setattr(scene.Scene, "is_still", lambda self, mesh: mesh.n_segments == 0 or bool(
        (mesh.vertices[0] == mesh.vertices[-1]).all()))  # fmt: skip


def plant_slices_of_time_ignored(patch):
    original = survey._may_cross

    def wrong(prisms, *rest):
        whole = dataclasses.replace(
            prisms, t_open=torch.zeros_like(prisms.t_open), t_close=torch.ones_like(prisms.t_close)
        )
        return original(whole, *rest)

    patch.setattr(survey, "_may_cross", wrong)


def plant_places_on_screen_ignored(patch):
    patch.setattr(survey, "GRIDS", (1,))


def plant_opacity_of_textures_ignored(patch):
    def wrong(scene):
        found = original(scene)
        return dataclasses.replace(found, is_opaque=found.opacity == 1)

    original = effects.build_surfaces
    patch.setattr(effects, "build_surfaces", wrong)


def plant_cuts_do_not_matter(patch):
    exact = effects.Accuracy.exact()
    original = render.follow_plan
    patch.setattr(render, "follow_plan", lambda plan, prisms, found, _: original(plan, prisms, found, exact))


def there_and_back():
    """Compare a sheet that moves away and comes back."""
    start = test_effects.sheet().vertices
    mesh = test_effects.tb.Mesh(torch.stack([start, start + 0.3, start]), [[0, 1, 2], [0, 2, 3]])
    plan = test_effects.tb.plan_effects(test_effects.tb.Scene([mesh], test_effects.truth_scene("nothing")[0].camera))
    assert plan.moves == (True,)


def on_centres():
    """Compare a still sheet whose edges and diagonal pass through rays."""
    camera = test_effects.tb.Camera(torch.eye(4, dtype=torch.float64), 8, 8)
    test_effects.check_same(test_effects.tb.Scene([test_effects.sheet(x=(-0.375, 0.625))], camera))
    mesh = test_effects.shape((-0.375, -0.375, 0), (0.625, -0.375, 0), (0.625, 0.625, 0), (-0.375, 0.625, 0))
    test_effects.check_same(test_effects.tb.Scene([mesh], camera))


def approximated():
    """Compare textures cut by what is hidden, of which the papers' approximations see something."""
    bodies = (
        Body("open box", (-1, 1, -1), "turn in pieces", "flat", 0.5, True),
        Body("slant", (2, 2, 1), "shift", "texture", 1.0, False),
    )
    stage = Stage(bodies, False, 3.6, "still", 1, False, 2)
    test_effects.check_same(build(stage), accuracy=test_effects.tb.Accuracy.linear())


FAULTS = {
    "farthest_of_what_rests": STILL,
    "all_rests": COVERED,
    "all_hides": GLASS,
    "front_and_back_changed": same(body("box", 0, "turn", double_sided=False)),
    "gaps_in_covers_ignored": COVERED,
    "greatest_nearness_of_covers": same(body("wall", 0, "forward"), body("slant", 0, "still")),
    "tie_rule_dropped_for_what_rests": on_centres,
    "order_never_changes": right("depths that pass"),
    "looks_never_change": same(body("wall", 0, "shift", "texture")),
    "lights_rest": same(body("wall", 0, "still", "lit"), light="moving"),
    "only_ends_compared": there_and_back,
    "slices_of_time_ignored": right("depths that overlap, but not at one time"),
    "places_on_screen_ignored": right("depths that pass in different places"),
    "opacity_of_textures_ignored": right("a texture with opacity 0.999"),
    "cuts_do_not_matter": approximated,
}


@pytest.mark.parametrize("name", list(FAULTS))
def test_planted_fault_is_caught(name):
    FAULTS[name]()
    with pytest.MonkeyPatch.context() as patch:
        globals()[f"plant_{name}"](patch)
        with pytest.raises(AssertionError):
            FAULTS[name]()


def test_every_fault_has_a_check():
    assert {n.removeprefix("plant_") for n in globals() if n.startswith("plant_")} == set(FAULTS)
