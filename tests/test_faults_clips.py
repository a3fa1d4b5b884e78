"""Deliberate bugs between a lit clip and its picture; brute force must tell them from health."""

import dataclasses

import pytest
import torch
from test_datagen_lit_clips import check_clip, plan

import torchblur as tb
from datagen import clips, samples
from datagen.lamps import Lamp

CLIPS = (1, 3)  # all that a fault can touch moves here, lamps and camera too
HALF_S = plan().spec.exposure_s / 2
MIRROR = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)


def put(patch, change, late_s=0.0):
    """Put the lights of all lamps through a function, or let them be late."""
    original = Lamp.light
    patch.setattr(Lamp, "light", lambda lamp, times_s: change(original(lamp, times_s - late_s)))


def named(point, directional):
    """Return a function that changes a field of lights, by its name in a lamp and in a sun."""

    def change(light, function):
        name = directional if isinstance(light, tb.DirectionalLight) else point
        return dataclasses.replace(light, **{name: function(getattr(light, name))})

    return change


def exposed(patch, change):
    """Put the clip, opening and closing of every exposure through a function."""
    original = samples.expose

    def wrong(clip, width, height, open_s, close_s):
        clip, open_s, close_s = change(clip, open_s, close_s)
        return original(clip, width, height, open_s, close_s)

    patch.setattr(samples, "expose", wrong)


class Late:
    """A motion or a camera path half a shutter late."""

    def __init__(self, path):
        self.path = path

    def __getattr__(self, name):
        return getattr(self.path, name)

    def at(self, times_s):
        return self.path.at(times_s - HALF_S)

    def matrices(self, times_s, width, height):
        return self.path.matrices(times_s - HALF_S, width, height)


def plant_lamps_mirrored(patch):
    put(patch, lambda light: named("position", "direction")(light, lambda value: value * MIRROR))


def plant_lamps_a_hundredth_brighter(patch):
    put(patch, lambda light: named("intensity", "irradiance")(light, lambda value: value * 1.01))


def plant_shadows_dropped(patch):
    put(patch, lambda light: dataclasses.replace(light, casts_shadows=False))


def plant_lamps_late(patch):
    put(patch, lambda light: light, HALF_S)


def plant_lamps_at_rest_while_the_shutter_is_open(patch):
    original = Lamp.light
    patch.setattr(Lamp, "light", lambda lamp, times_s: original(lamp, times_s[:1] if len(times_s) > 1 else times_s))


def plant_bodies_late(patch):
    def late(clip, *times):
        actors = tuple(dataclasses.replace(actor, motion=Late(actor.motion)) for actor in clip.actors)
        return dataclasses.replace(clip, actors=actors), *times

    exposed(patch, late)


def plant_one_body_late(patch):
    def late(clip, *times):
        *others, last = clip.actors
        return dataclasses.replace(clip, actors=(*others, dataclasses.replace(last, motion=Late(last.motion)))), *times

    exposed(patch, late)


def plant_camera_late(patch):
    exposed(patch, lambda clip, *times: (dataclasses.replace(clip, camera=Late(clip.camera)), *times))


def plant_shutter_half_as_long(patch):
    exposed(patch, lambda clip, a, b: (clip, (3 * a + b) / 4, (a + 3 * b) / 4))


def plant_one_chord_for_each_body(patch):
    original = clips.choose_mesh_segments

    def wrong(*arguments):
        knots = original(*arguments)
        return dataclasses.replace(knots, segments=min(knots.segments, 1))

    patch.setattr(clips, "choose_mesh_segments", wrong)


def plant_sharp_when_the_shutter_opens(patch):
    original = tb.render_instant
    patch.setattr(tb, "render_instant", lambda scene, t=0.0, **options: original(scene, t=0.0, **options))


def plant_ambient_light_dropped(patch):
    original = tb.Scene
    patch.setattr(tb, "Scene", lambda **fields: original(**fields | {"ambient": (0.0, 0.0, 0.0)}))


FAULTS = [name for name in globals() if name.startswith("plant_")]


@pytest.mark.parametrize("name", FAULTS)
def test_planted_fault_is_caught(name):
    for number in CLIPS:
        check_clip(number)
    caught = []
    with pytest.MonkeyPatch.context() as patch:
        globals()[name](patch)
        for number in CLIPS:
            try:
                check_clip(number)
            except AssertionError as error:
                caught.append(str(error))
    assert caught
