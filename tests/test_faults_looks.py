"""Deliberate bugs in textures, lights and accuracies; see test_faults.py."""

from __future__ import annotations

import dataclasses
import importlib
import itertools
import math

import lit_scenes as lit
import numpy as np
import pytest
import scene_makers as make
import test_lighting
import test_mipmap
import test_misprints
import test_random_scenes
import test_subdivide
import test_texture
import torch
from lit_scenes import UPRIGHT
from oracle_looks import LookMesh, LookScene, bilinear, pyramid
from test_faults import changed, replaced

import torchblur as tb
from torchblur import (
    atlas,
    averages,
    light_bends,
    lights,
    nodes,
    pairs,
    shading,
    subdivide,
    texture_bends,
)

render = importlib.import_module("torchblur.render")  # the module, which the function of the same name hides


def lambert(normal_scale=lambda n: n.norm(dim=0), clamp=lambda c: c.clamp(min=0), ambient=1.0):
    """Return Lambert's law, or a wrong one."""

    def reflected(surfaces, point, normal, t, _visible):
        total = ambient * surfaces.ambient.expand(point.shape[1], 3)
        for light in surfaces.lights:
            to_light, irradiance = light.arriving(point, t)
            cosine = clamp((normal / normal_scale(normal) * to_light).sum(0))
            total = total + irradiance * (cosine / math.pi).unsqueeze(1)
        return total, torch.zeros_like(total[:, :2])

    return reflected


def plant_mip_level_off_by_one(patch):
    patch.setattr(shading, "mip_level", changed(shading.mip_level, lambda level: (level - 1).clamp(min=0)))


def plant_mip_levels_of_every_second_texel(patch):
    def halve(image, axis):
        rows = image.movedim(axis, 0)
        return (rows if len(rows) == 1 else rows[: len(rows) // 2 * 2 : 2]).movedim(0, axis)

    patch.setattr(atlas, "_halve", halve)


def plant_footprint_of_the_whole_pixel(patch):
    def spacing(self):
        return 2 / self.image_width, -2 / self.image_height

    patch.setattr(pairs.Block, "spacing_ndc", property(spacing))


def plant_normal_not_renormalised(patch):
    patch.setattr(shading, "reflected", lambert(normal_scale=lambda n: torch.ones_like(n[0])))


def plant_normals_do_not_move(patch):
    patch.setattr(render, "build_prisms", replaced(render.build_prisms, normal=lambda n: n[:1].expand_as(n)))


def plant_normal_of_the_back_not_negated(patch):
    original = shading.points_on_prisms
    resolve = importlib.import_module("torchblur.resolve")
    patch.setattr(resolve, "points_on_prisms", replaced(original, side=torch.ones_like))


def plant_inverse_square_dropped(patch):
    def wrong(vector, intensity):
        return vector / vector.norm(dim=0), intensity.to(torch.float64).expand(vector.shape[1], 3)

    patch.setattr(lights, "_from_a_point", wrong)


def plant_cosine_not_clamped(patch):
    patch.setattr(shading, "reflected", lambert(clamp=lambda c: c))


def plant_spot_falloff_not_squared(patch):
    original = lights.SpotLight.arriving

    def wrong(self, point, t):
        to_light, irradiance = original(self, point, t)
        _, full = lights._from_a_point(lights.along(self.position, t) - point, self.intensity)
        return to_light, (irradiance * full).sqrt()

    patch.setattr(lights.SpotLight, "arriving", wrong)


def plant_light_rests(patch):
    original = lights.along
    patch.setattr(lights, "along", lambda knots, t: original(knots, torch.zeros_like(t)))


def plant_ambient_divided_by_pi(patch):
    patch.setattr(shading, "reflected", lambert(ambient=1 / math.pi))


def plant_flat_normal_of_the_open_end(patch):
    patch.setattr(render, "build_prisms", replaced(render.build_prisms, world=lambda w: w[:1].expand_as(w)))


def plant_texture_bends_ignored(patch):
    patch.setattr(texture_bends.TexturePaths, "lines", lambda *_: [])


def plant_level_bends_ignored(patch):
    original = texture_bends.TexturePaths.bends

    def wrong(self, prisms):
        none = self.mipped[:0]
        return original(dataclasses.replace(self, mipped=none, slope=self.slope[..., none]), prisms)

    patch.setattr(texture_bends.TexturePaths, "bends", wrong)


def plant_light_bends_ignored(patch):
    patch.setattr(light_bends.LightPaths, "bends", lambda self, _: (self.paths.span[:0], self.paths.t[0, :0]))


def plant_too_few_nodes(patch):
    patch.setattr(nodes, "COUNTS", (1,))
    patch.setattr(nodes, "nodes_needed", lambda dividers, lookup, panels, _: torch.ones_like(panels[1]))


def plant_chord_of_view_depth(patch):
    """1 / w over chords of w, which for w that moves evenly is right: the swap comes when it does exactly."""
    original = subdivide.approximate

    def wrong(prisms, found, accuracy):
        if accuracy.method == "exact":
            return found
        w = found.near_den[[0, -1]] / found.near_num[[0, -1]]
        chord = torch.stack([w[0], (2 * w[0] + w[1]) / 3, (w[0] + 2 * w[1]) / 3, w[1]])
        return dataclasses.replace(original(prisms, found, accuracy), near_num=torch.ones_like(chord), near_den=chord)

    patch.setattr(test_subdivide, "approximate", wrong)


def plant_chord_of_one_over_w(patch):
    original = subdivide.nearness_coefficients

    def wrong(prisms, *rest):
        return original(dataclasses.replace(prisms, orders_by_w=True), *rest)

    patch.setattr(subdivide, "nearness_coefficients", wrong)


def plant_chord_ends_swapped(patch):
    original = subdivide._Curves.ends
    patch.setattr(subdivide._Curves, "ends", lambda self: original(self).flip(0))


def plant_texture_not_followed_by_adaptive(patch):
    def depth_alone(self):
        return subdivide.chord_error_bound(self.num, self.den)

    patch.setattr(subdivide._Curves, "error_bound", depth_alone)


def plant_one_halving_only(patch):
    patch.setattr(subdivide, "MAX_HALVINGS", 1)


def plant_normal_of_the_end(patch):
    points_on_prisms, position_and_normal = averages.points_on_prisms, averages.position_and_normal
    latest = []

    def remembering(*args):
        latest.append(points_on_prisms(*args))
        return latest[-1]

    def wrong(surfaces, points, lit):
        place, _ = position_and_normal(surfaces, points, lit)
        return place, position_and_normal(surfaces, latest[-1], lit)[1]

    patch.setattr(averages, "points_on_prisms", remembering)
    patch.setattr(averages, "position_and_normal", wrong)


def plant_one_tap(patch):
    patch.setattr(averages, "MAX_TAPS", 1)


def plant_whole_way_looked_up_twice(patch):
    original = averages._anisotropic
    first = []

    def wrong(surfaces, face, way, minor):
        first.append(way[0])
        start = first[-2] if len(first) % 2 == 0 else way[0]  # the second half starts where the first one does
        return original(surfaces, face, (start, way[1]), minor)

    patch.setattr(averages, "_anisotropic", wrong)


def plant_premultiplied_means_not_divided(patch):
    original = averages._anisotropic

    def wrong(*args):
        rgba = original(*args)
        return torch.cat([rgba[:, :3] * rgba[:, 3:], rgba[:, 3:]], dim=1)

    patch.setattr(averages, "_anisotropic", wrong)


def facing_plate():
    test_mipmap.test_level_of_a_plate_that_faces_the_viewer(5.3)


def linear(name: str):
    """Return the check that a scene is the linear rule's."""
    return lambda: test_random_scenes.test_linear_is_the_rule(name)


def test_level_alone_changes():
    """A plate moves away along the ray, w = 1 + 7.3 t: its place on the texture rests, a footprint is 3.2 w texels."""
    texture = test_mipmap.texture_of(64, 64)
    corners = np.array([[-60.0, -50, 1], [70, -50, 1], [0.3, 80, 1]])
    uv = (corners[:, :2] + 20) / 40
    mesh = LookMesh(np.stack([corners, corners + np.array([0, 0, 7.3])]), [[0, 1, 2]], uv=uv[None], texture=texture)
    mesh.shading, mesh.color = "unlit", np.ones(3)
    got = tb.render(lit.to_torch(LookScene([mesh], make.w_is_z(), 1, 1))).rgba[0, 0, :3].numpy()
    seen = [bilinear(image, np.full((1, 2), 0.5), "repeat")[0][0, :3] for image in pyramid(texture)]

    def integral(k, w):  # of the lookup between levels k and k + 1, where the level is log2(3.2 w)
        log_part = w * np.log2(3.2 * w) - w / np.log(2)
        return seen[k] * w + (seen[k + 1] - seen[k]) * (log_part - k * w)

    ends = [1.0, *(2.0**k / 3.2 for k in (2, 3, 4)), 8.3]
    parts = [integral(k + 1, b) - integral(k + 1, a) for k, (a, b) in enumerate(itertools.pairwise(ends))]
    np.testing.assert_allclose(got, sum(parts) / 7.3, rtol=0, atol=1e-9)


FAULTS = {
    plant_mip_level_off_by_one: facing_plate,
    plant_mip_levels_of_every_second_texel: lambda: test_mipmap.test_levels_of_even_sizes_are_block_means(1),
    plant_footprint_of_the_whole_pixel: lambda: test_mipmap.test_more_rays_take_finer_levels(4),
    plant_normal_not_renormalised: lambda: test_lighting.test_vertex_normals_are_interpolated_and_then_renormalised(
        True
    ),
    plant_normals_do_not_move: test_lighting.test_moving_normals_are_linear_between_knots_and_renormalised,
    plant_normal_of_the_back_not_negated: (
        lambda: test_lighting.test_vertex_normals_are_negated_on_the_back_and_never_turned_to_the_viewer(UPRIGHT)
    ),
    plant_inverse_square_dropped: lambda: test_lighting.test_point_light((0, 0, 2), 2.5),
    plant_cosine_not_clamped: test_lighting.test_ambient_and_several_lights_add_up,
    plant_spot_falloff_not_squared: (
        lambda: test_lighting.test_spot_light_fades_as_the_square_between_its_cones(30, (20, 40), None)
    ),
    plant_light_rests: test_lighting.test_light_moves_over_a_still_plate,
    plant_ambient_divided_by_pi: test_lighting.test_ambient_and_several_lights_add_up,
    plant_flat_normal_of_the_open_end: lambda: test_lighting.test_plate_turns_under_a_sun(UPRIGHT),
    plant_texture_bends_ignored: test_texture.test_a_sliding_texture_is_the_mean_over_its_path,
    plant_level_bends_ignored: lambda: test_level_alone_changes(),
    plant_light_bends_ignored: test_lighting.test_hard_spot_border_passes_in_mid_exposure,
    plant_too_few_nodes: test_lighting.test_light_moves_over_a_still_plate,
    plant_chord_of_view_depth: (
        lambda: test_subdivide.test_the_papers_planes_change_places_when_each_accuracy_says(3.0)
    ),
    plant_chord_of_one_over_w: (
        lambda: test_subdivide.test_linear_is_exact_at_the_ends_and_touches_nothing_else(np.random.default_rng(1))
    ),
    plant_chord_ends_swapped: (
        lambda: test_subdivide.test_the_papers_planes_change_places_when_each_accuracy_says(3.0)
    ),
    plant_texture_not_followed_by_adaptive: (
        test_misprints.test_misprint_8_a_texture_that_spins_at_constant_depth_is_cut
    ),
    plant_one_halving_only: (lambda: test_misprints.test_misprint_6_halving_goes_on_until_the_whole_chord_fits(1e-4)),
    plant_normal_of_the_end: linear("smooth_ball"),
    plant_one_tap: lambda: test_random_scenes.test_linear_looks_up_textures(False, 3),
    plant_whole_way_looked_up_twice: linear("lit_texture"),
    plant_premultiplied_means_not_divided: linear("lit_texture"),
}


@pytest.mark.parametrize("plant", list(FAULTS), ids=lambda p: p.__name__.removeprefix("plant_"))
def test_planted_fault_is_caught(plant, monkeypatch):
    check = FAULTS[plant]
    check()  # green as it is
    plant(monkeypatch)
    with pytest.raises(AssertionError):
        check()
