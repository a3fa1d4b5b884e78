"""Deliberate bugs, each planted inside torchblur for one test: the named check must turn red, and be green without it.

A fault replaces one internal function by a wrong one. If a name moves, the fault fails to plant and says so.
"""

from __future__ import annotations

import dataclasses
import importlib

import pytest
import test_agreement
import test_closed_form
import test_gradients
import test_instant
import test_seams
import torch

from torchblur import cells, edges, exposure, instant, intervals, packed, prisms, surfaces
from torchblur.shutter import Shutter

FLOAT64 = torch.float64
render = importlib.import_module("torchblur.render")  # the module, which the function of the same name hides


def oracle(name: str):
    """Return the check that every pixel of a scene is the oracle's."""
    return lambda: test_agreement.test_every_pixel_is_the_oracles(name)


def changed(function, change):
    """Return `function` with its result put through `change`."""
    return lambda *args, **kwargs: change(function(*args, **kwargs))


def replaced(function, **changes):
    """Return `function` with fields of its dataclass result put through functions."""

    def change(result):
        return dataclasses.replace(result, **{k: f(getattr(result, k)) for k, f in changes.items()})

    return changed(function, change)


def plant_order_reversed(patch):
    patch.setattr(cells, "_nearness", changed(cells._nearness, torch.neg))


def plant_crossings_ignored(patch):
    none = torch.zeros(0, dtype=torch.int64)
    nothing = cells.Crossings(none, none.to(FLOAT64), none.reshape(1, 0).expand(2, 0))
    patch.setattr(cells, "_find_crossings", lambda *_: nothing)


def plant_one_crossing_a_round_lost(patch):
    def drop(found):
        kept = slice(1, None) if len(found.pixel) > 1 else slice(None)
        return cells.Crossings(found.pixel[kept], found.t[kept], found.pair[:, kept])

    original = cells._find_crossings
    rounds = []

    def once(*args):
        rounds.append(0)
        found = original(*args)
        return drop(found) if len(rounds) == 1 else cells.Crossings(found.pixel[:0], found.t[:0], found.pair[:, :0])

    patch.setattr(cells, "_find_crossings", once)


def plant_half_pixel_shift(patch):
    original = intervals.Block.ray_ndc
    shift = torch.tensor([[0.05], [0.0]], dtype=FLOAT64)
    patch.setattr(intervals.Block, "ray_ndc", lambda self, pixel: original(self, pixel) + shift)


def plant_image_upside_down(patch):
    original = intervals.Block.ray_ndc
    flip = torch.tensor([[1.0], [-1.0]], dtype=FLOAT64)
    patch.setattr(intervals.Block, "ray_ndc", lambda self, pixel: original(self, pixel) * flip)


def plant_alpha_squared(patch):
    original = packed.transmittance
    patch.setattr(packed, "transmittance", lambda alpha, *rest: original(alpha * alpha, *rest))


def plant_transmittance_ignored(patch):
    original = packed.transmittance

    def wrong(alpha, offsets, cutoff=0.0):
        before, after = original(alpha, offsets, cutoff)
        return torch.ones_like(before), after

    patch.setattr(packed, "transmittance", wrong)


def plant_weights_not_by_time(patch):
    patch.setattr(Shutter, "weight", lambda self, a, b, line: torch.full_like(a, 0.125))


def plant_window_not_normalised(patch):
    patch.setattr(Shutter, "weight", lambda self, a, b, line: b - a)


def plant_tie_rule_dropped(patch):
    patch.setattr(edges, "_break_ties", lambda e, *_: e)


def plant_near_plane_dropped(patch):
    patch.setattr(render, "build_prisms", replaced(render.build_prisms, is_clipped=torch.zeros_like))


def plant_near_crossings_left_out_of_bounds(patch):
    original = prisms._extent_px

    def wrong(points, valid, width, height):
        low, high = original(points, valid, width, height)
        if len(points) == 15:  # the pairwise crossings of the near plane
            return torch.full_like(low, torch.inf), torch.full_like(high, -torch.inf)
        return low, high

    patch.setattr(prisms, "_extent_px", wrong)


def plant_facing_ignored(patch):
    patch.setattr(render, "build_surfaces", replaced(render.build_surfaces, is_one_sided=torch.zeros_like))


def plant_facing_by_stored_order(patch):
    patch.setattr(render, "build_prisms", replaced(render.build_prisms, parity=torch.ones_like))


def plant_background_not_weighted(patch):
    def wrong(result):
        return dataclasses.replace(result, rgba=torch.cat([result.rgba[:, :3], torch.ones_like(result.rgba[:, 3:])], 1))

    patch.setattr(exposure, "expose_samples", changed(exposure.expose_samples, wrong))


def plant_segment_times_wrong(patch):
    original = prisms.window_times

    def wrong(*args):
        times = original(*args)
        return [times[0], *(t**2 for t in times[1:-1]), times[-1]]

    patch.setattr(prisms, "window_times", wrong)


def plant_camera_knots_ignored(patch):
    original = prisms.window_times
    patch.setattr(prisms, "window_times", lambda *args: original(*args)[:: len(original(*args)) - 1])


def plant_middle_coefficient_wrong(patch):
    def wrong(e):
        e = e.clone()
        e[1] = (e[0] + e[2]) / 2  # quadratics taken for linear
        return e

    patch.setattr(edges, "edge_coefficients", changed(edges.edge_coefficients, wrong))


def plant_second_root_lost(patch):
    def wrong(roots):
        roots = roots.clone()
        roots[3:] = 1
        return roots

    patch.setattr(edges, "edge_roots", changed(edges.edge_roots, wrong))


def plant_coverage_counted_twice(patch):
    def wrong(result):
        return dataclasses.replace(result, coverage=2 * result.coverage)

    patch.setattr(exposure, "expose_samples", changed(exposure.expose_samples, wrong))


def plant_ties_by_input_order(patch):
    patch.setattr(
        render, "build_surfaces", replaced(render.build_surfaces, tie_rank=lambda rank: torch.arange(len(rank)))
    )


def plant_gradient_of_events_lost(patch):
    patch.setattr(intervals, "attach_gradient", lambda t, *_: t)


def plant_gradient_of_crossings_lost(patch):
    patch.setattr(cells, "attach_gradient", lambda t, *_: t)


def plant_motion_upside_down(patch):
    original = instant.clip_to_px
    flip = torch.tensor([0.0, 1.0], dtype=FLOAT64)
    patch.setattr(instant, "clip_to_px", lambda clip, w, h: original(clip, w, h) * (1 - 2 * flip) + flip * float(h))


def plant_accumulation_at_frame_starts(patch):
    original = instant.sum_of_instants
    patch.setattr(
        instant,
        "sum_of_instants",
        lambda scene, faces, t, *rest: original(scene, faces, (t - t[0]).clamp(0, 1), *rest),
    )


def plant_opacity_of_the_next_face(patch):
    patch.setattr(surfaces.Mesh, "face_opacity", changed(surfaces.Mesh.face_opacity, lambda a: a.roll(1)))


def coplanar():
    """Run the check of coplanar faces."""
    test_closed_form.test_16_coplanar_triangles_do_not_depend_on_input_order("flat", False, 1.0)


FAULTS = {
    plant_order_reversed: oracle("opaque"),
    plant_crossings_ignored: oracle("crossing"),
    plant_one_crossing_a_round_lost: oracle("crossing"),
    plant_half_pixel_shift: oracle("opaque"),
    plant_image_upside_down: oracle("opaque"),
    plant_alpha_squared: oracle("transparent"),
    plant_transmittance_ignored: oracle("transparent"),
    plant_weights_not_by_time: oracle("opaque"),
    plant_window_not_normalised: lambda: test_closed_form.test_15_swap_time_in_perspective(False, FLOAT64),
    plant_tie_rule_dropped: lambda: test_closed_form.test_05_quads_with_every_pixel_centre_on_edges_and_vertices(
        1.0, "static", FLOAT64
    ),
    plant_near_plane_dropped: lambda: test_closed_form.test_08_passes_behind_the_camera(FLOAT64),
    plant_near_crossings_left_out_of_bounds: lambda: test_closed_form.test_18_prisms_through_the_camera_plane(0),
    plant_facing_ignored: lambda: test_closed_form.test_06_winding_flip(FLOAT64),
    plant_facing_by_stored_order: oracle("one-sided"),
    plant_background_not_weighted: oracle("transparent"),
    plant_segment_times_wrong: oracle("four segments"),
    plant_camera_knots_ignored: oracle("moving camera"),
    plant_middle_coefficient_wrong: oracle("fast"),
    plant_second_root_lost: lambda: test_closed_form.test_09_four_intervals(FLOAT64),
    plant_coverage_counted_twice: oracle("many layers"),
    plant_ties_by_input_order: coplanar,
    plant_gradient_of_events_lost: test_gradients.test_28_sliding_box_by_hand,
    plant_gradient_of_crossings_lost: test_gradients.test_28_crossing_by_hand,
    plant_motion_upside_down: lambda: test_instant.test_square_moving_right_and_up_has_positive_x_and_negative_y(
        0.25, FLOAT64
    ),
    plant_accumulation_at_frame_starts: test_agreement.test_accumulation_is_the_mean_of_midpoint_instants,
    plant_opacity_of_the_next_face: oracle("transparent"),
}


@pytest.mark.parametrize("plant", list(FAULTS), ids=lambda p: p.__name__.removeprefix("plant_"))
def test_planted_fault_is_caught(plant, monkeypatch):
    check = FAULTS[plant]
    check()  # green as it is
    plant(monkeypatch)
    with pytest.raises((AssertionError, RuntimeError)):  # RuntimeError: autograd finds no graph at all
        check()


def test_seams_are_caught_when_one_face_is_missing(monkeypatch):
    test_seams.test_camera_inside_a_closed_shell("rotation", 0.5, FLOAT64)
    vertices, faces = test_seams.sphere()
    monkeypatch.setattr(test_seams, "sphere", lambda: (vertices, faces[faces[:, 0].argsort()][: len(faces) * 7 // 8]))
    with pytest.raises(AssertionError):
        test_seams.test_camera_inside_a_closed_shell("rotation", 0.5, FLOAT64)
