"""Truths about any exposure: symmetries, sums and equalities that hold whatever the scene.

Tolerance of equalities that only reorder sums or split a time in two: 1e-10 in float64. A root found in another frame
of reference is off by 1e-16 over the edge's speed; speeds are above 1e-3 or so here, with some tens of events a pixel.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import scene_makers as make
import torch
from oracles import PlainMesh, PlainScene

import torchblur as tb

ATOL = 1e-10
SEEDS = range(3)


def soup(seed: int, **kw) -> PlainScene:
    """Return a random orthographic scene of loose triangles, two segments, mixed opacity."""
    return make.random_soup(np.random.default_rng(seed), 30, width=14, height=12, n_segments=1 + seed % 3, **kw)


def turning(seed: int, n_segments: int = 2, **kw) -> PlainScene:
    """Return a perspective scene: two turning boxes, one translucent, and a static floor."""
    generator = np.random.default_rng(seed)
    tilt = make.rotation_y(generator.uniform(0, 3)) @ make.rotation_z(generator.uniform(0, 3))
    boxes = [
        make.box_mesh(
            generator.uniform(-0.7, 0.7, 3),
            generator.uniform(0.6, 1.6, 3),
            lambda v: make.rotated(v @ tilt.T, 0.8, n_segments, make.rotation_y),
            color=generator.uniform(0, 1, (12, 3)),
            opacity=opacity,
        )
        for opacity in (1.0, 0.6)
    ]
    floor = PlainMesh(
        [[-3, -1.5, -3], [3, -1.5, -3], [3, -1.4, 3], [-3, -1.4, 3]], [[0, 1, 2], [0, 2, 3]], (0.3, 0.5, 0.2)
    )
    return PlainScene([*boxes, floor], make.perspective((0.5, 0.7, 5)), 16, 16, (0.1, 0.1, 0.3), **kw)


def replaced(scene: PlainScene, **changes) -> PlainScene:
    """Return the scene with some fields changed."""
    return dataclasses.replace(scene, **changes)


def map_meshes(scene: PlainScene, function) -> PlainScene:
    """Return the scene with every mesh's vertices mapped."""
    meshes = [PlainMesh(function(m.vertices), m.faces, m.color, m.opacity, m.double_sided) for m in scene.meshes]
    return replaced(scene, meshes=meshes)


def assert_same(a: torch.Tensor, b: torch.Tensor, atol: float = ATOL) -> None:
    """Check two images."""
    torch.testing.assert_close(a, b, rtol=0, atol=atol)


MAKERS = [soup, turning]


@pytest.mark.parametrize("maker", MAKERS)
def test_order_of_triangles_and_of_their_vertices_is_irrelevant(maker):
    scene, generator = maker(1), np.random.default_rng(0)
    first = make.render(scene)
    meshes = []
    for m in scene.meshes:
        order = generator.permutation(len(m.faces))
        faces = np.stack([np.roll(f, generator.integers(3)) for f in m.faces[order]])
        color = m.color if m.color.ndim == 1 else m.color[order]
        opacity = m.opacity if m.opacity.ndim == 0 else m.opacity[order]
        meshes.append(PlainMesh(m.vertices, faces, color, opacity))
    second = make.render(replaced(scene, meshes=meshes))
    assert_same(first.rgba, second.rgba)
    assert_same(first.coverage, second.coverage)
    assert_same(make.render(replaced(scene, meshes=scene.meshes[::-1])).coverage.flip(-1), first.coverage)


@pytest.mark.parametrize("maker", MAKERS)
@pytest.mark.parametrize("rays", [1, 4])
def test_zero_motion_is_the_sharp_frame(maker, rays, dtype):
    still = map_meshes(maker(2), lambda v: v if v.ndim == 2 else v[0])
    sharp = tb.render_instant(make.to_torch(still, dtype), t=0.3, rays_per_pixel=rays).rgba
    assert_same(make.render(still, dtype, rays_per_pixel=rays).rgba, sharp, 1e-12 if dtype == torch.float64 else 5e-7)
    repeated = map_meshes(still, lambda v: np.stack([v, v]))
    assert_same(
        make.render(repeated, dtype, rays_per_pixel=rays).rgba, sharp, 1e-12 if dtype == torch.float64 else 5e-7
    )


@pytest.mark.parametrize("maker", MAKERS)
@pytest.mark.parametrize("cut", [0.5, 0.3])
def test_parts_of_an_exposure_average_to_the_whole(maker, cut):
    scene = maker(1)
    whole, first, second = (make.render(scene, t_open=a, t_close=b) for a, b in ((0, 1), (0, cut), (cut, 1)))
    assert_same(cut * first.rgba + (1 - cut) * second.rgba, whole.rgba)
    assert_same(cut * first.coverage + (1 - cut) * second.coverage, whole.coverage)
    assert (first.rgba - second.rgba).abs().max() > 0.01


@pytest.mark.parametrize("maker", MAKERS)
def test_short_window_is_the_instant(maker):
    scene = maker(0)
    t, width = 0.37, 1e-7
    window = make.render(scene, t_open=t, t_close=t + width).rgba
    instant = tb.render_instant(make.to_torch(scene), t=t + width / 2).rgba
    assert_same(window, instant, 1e-6)  # no event falls into the window; its own share is rounded to 1e-16 / 1e-7


@pytest.mark.parametrize("maker", MAKERS)
def test_uniform_scene_stays_uniform(maker, dtype):
    scene = replaced(maker(1), background=(0.25, 0.5, 0.75))
    scene = replaced(scene, meshes=[PlainMesh(m.vertices, m.faces, (0.25, 0.5, 0.75), m.opacity) for m in scene.meshes])
    image = make.render(scene, dtype).rgba[..., :3]
    expected = torch.tensor([0.25, 0.5, 0.75], dtype=dtype).expand_as(image)
    assert_same(image, expected, 1e-12 if dtype == torch.float64 else 5e-7)


@pytest.mark.parametrize("maker", MAKERS)
def test_time_reversal_changes_nothing(maker):
    scene = maker(1)
    back = map_meshes(scene, lambda v: v if v.ndim == 2 else v[::-1])
    assert_same(make.render(back).rgba, make.render(scene).rgba)
    assert_same(
        make.render(back, t_open=0.6, t_close=0.9).rgba, make.render(scene, t_open=0.1, t_close=0.4).rgba, 4 * ATOL
    )


@pytest.mark.parametrize("maker", MAKERS)
@pytest.mark.parametrize(("axis", "image_axis"), [(0, 1), (1, 0)])
def test_mirrored_scene_gives_mirrored_image(maker, axis, image_axis):
    scene = maker(0)
    mirror = np.eye(4)
    mirror[axis, axis] = -1
    mirrored = replaced(scene, world_to_clip=mirror @ scene.world_to_clip)
    assert_same(make.render(mirrored).rgba.flip(image_axis), make.render(scene).rgba)


@pytest.mark.parametrize("maker", MAKERS)
def test_alpha_is_at_most_the_sum_of_coverage(maker, dtype):
    frame = make.render(maker(1), dtype)
    slack = 1e-12 if dtype == torch.float64 else 5e-7
    alpha, coverage = frame.rgba[..., 3], frame.coverage
    assert (alpha <= coverage.sum(-1) + slack).all()
    assert (alpha >= -slack).all()
    assert (alpha <= 1 + slack).all()
    assert (coverage >= -slack).all()
    assert (coverage <= 1 + slack).all()


def test_black_meshes_leave_the_background_times_one_minus_alpha():
    scene = replaced(soup(1), background=(1.0, 1.0, 1.0))
    scene = replaced(scene, meshes=[PlainMesh(m.vertices, m.faces, (0.0, 0.0, 0.0), m.opacity) for m in scene.meshes])
    rgba = make.render(scene).rgba
    assert_same(rgba[..., :3], (1 - rgba[..., 3:]).expand(-1, -1, 3))


def test_background_image_is_seen_through():
    scene = soup(1)
    generator = np.random.default_rng(3)
    image = generator.uniform(0, 1, (scene.height, scene.width, 3))
    black = make.render(replaced(scene, background=(0, 0, 0))).rgba
    expected = black.clone()
    expected[..., :3] += (1 - black[..., 3:]) * torch.as_tensor(image)
    assert_same(make.render(replaced(scene, background=image)).rgba, expected)


@pytest.mark.parametrize("maker", MAKERS)
def test_mesh_split_in_two_gives_the_same_image(maker):
    scene = maker(1)
    parts = []
    for m in scene.meshes:
        for k in (0, 1):
            color = m.color if m.color.ndim == 1 else m.color[k::2]
            opacity = m.opacity if m.opacity.ndim == 0 else m.opacity[k::2]
            parts.append(PlainMesh(m.vertices, m.faces[k::2], color, opacity))
    assert_same(make.render(replaced(scene, meshes=parts)).rgba, make.render(scene).rgba)


@pytest.mark.parametrize(("right", "down"), [(3, 0), (0, 2), (-2, 4)])
def test_scene_shifted_by_whole_pixels(right, down):
    scene = soup(0)
    matrix = np.eye(4)
    matrix[0, 3], matrix[1, 3] = 2 * right / scene.width, -2 * down / scene.height
    a = make.render(scene).rgba
    b = make.render(replaced(scene, world_to_clip=matrix @ scene.world_to_clip)).rgba
    h, w = scene.height, scene.width
    here = a[max(0, -down) : h - max(0, down), max(0, -right) : w - max(0, right)]
    there = b[max(0, down) : h - max(0, -down), max(0, right) : w - max(0, -right)]
    assert_same(there, here)
    assert (here[..., 3] > 0).any()


@pytest.mark.parametrize("split", [2, 3, 8])
@pytest.mark.parametrize("maker", MAKERS)
def test_knots_on_the_line_change_nothing(maker, split):
    """World-linear motion under a static camera, perspective too, is clip-linear: cutting it is no approximation."""
    scene = map_meshes(maker(0), lambda v: v if v.ndim == 2 else v[[0, -1]])
    s = np.linspace(0, 1, split + 1)[:, None, None]
    cut = map_meshes(scene, lambda v: v if v.ndim == 2 else v[0] * (1 - s) + v[1] * s)
    assert_same(make.render(cut).rgba, make.render(scene).rgba, 1e-9)  # each cut rounds the vertices once more
    assert_same(make.render(cut).coverage, make.render(scene).coverage, 1e-9)


def test_meshes_with_different_numbers_of_knots():
    scene = turning(1, n_segments=2)
    fine = np.arange(7) / 6
    meshes = list(scene.meshes)
    knots = meshes[0].vertices
    k = np.minimum((fine * 2).astype(int), 1)
    s = (fine * 2 - k)[:, None, None]
    meshes[0] = PlainMesh(knots[k] * (1 - s) + knots[k + 1] * s, meshes[0].faces, meshes[0].color, meshes[0].opacity)
    assert_same(make.render(replaced(scene, meshes=meshes)).rgba, make.render(scene).rgba, 1e-9)


def test_camera_knots_and_mesh_knots_are_united():
    """A camera moving in 3 segments, a mesh in 2: clip space is linear between 0, 1/3, 1/2, 2/3, 1."""
    scene = turning(0, n_segments=2)
    eyes = [(0.5, 0.7, 5), (0.6, 0.6, 5.1), (0.8, 0.5, 4.9), (0.7, 0.8, 4.8)]
    moving = replaced(scene, world_to_clip=np.stack([make.perspective(e) for e in eyes]))

    def at(knots, t):
        n = len(knots) - 1
        k = min(int(t * n + 1e-9), n - 1)
        return knots[k] * (1 - (t * n - k)) + knots[k + 1] * (t * n - k)

    united = np.array([0, 1 / 3, 1 / 2, 2 / 3, 1])
    frame = make.render(moving)
    # the same clip path as four exposures, one for each piece, mesh and camera both given by two knots
    total = torch.zeros_like(frame.rgba)
    for a, b in itertools.pairwise(united):
        part = replaced(
            map_meshes(scene, lambda v, a=a, b=b: v if v.ndim == 2 else np.stack([at(v, a), at(v, b)])),
            world_to_clip=np.stack([at(moving.world_to_clip, a), at(moving.world_to_clip, b)]),
        )
        total += (b - a) * make.render(part).rgba
    assert_same(frame.rgba, total, 1e-9)


def test_moving_camera_is_the_world_moving_the_other_way():
    scene = map_meshes(soup(0), lambda v: v[0] if v.ndim == 3 else v)
    shift = np.array([0.3, -0.2, 0.0])
    matrix = np.stack([np.eye(4), np.eye(4)])
    matrix[1, :3, 3] = shift
    camera_moves = make.render(replaced(scene, world_to_clip=matrix)).rgba
    world_moves = make.render(map_meshes(scene, lambda v: np.stack([v, v + shift]))).rgba
    assert_same(camera_moves, world_moves)


def test_invisible_objects_change_nothing():
    scene = soup(1)
    ghost = make.random_triangles(np.random.default_rng(9), 20, opacity=0.0)
    frame, with_ghost = make.render(scene), make.render(replaced(scene, meshes=[ghost, *scene.meshes]))
    assert_same(with_ghost.rgba, frame.rgba)
    assert (with_ghost.coverage[..., 0] == 0).all()
    assert_same(with_ghost.coverage[..., 1:], frame.coverage)


def test_scale_of_clip_space_is_irrelevant():
    scene = turning(1)
    a, b = (make.render(replaced(scene, world_to_clip=k * scene.world_to_clip)).rgba for k in (1.0, 1024.0))
    assert_same(a, b)


@pytest.mark.parametrize("maker", MAKERS)
def test_memory_budget_does_not_change_the_image(maker):
    scene = maker(1)
    large, small = make.render(scene), make.render(scene, memory_bytes=1 << 20)
    assert_same(small.rgba, large.rgba, 0)
    assert_same(small.coverage, large.coverage, 0)


def test_result_is_the_same_every_time():
    assert_same(make.render(turning(1)).rgba, make.render(turning(1)).rgba, 0)


def centroid(image: torch.Tensor) -> tuple[float, float, float]:
    """Return total alpha and its centre (x, y) [px]."""
    alpha = image[..., 3].double()
    y, x = torch.meshgrid(torch.arange(alpha.shape[0]) + 0.5, torch.arange(alpha.shape[1]) + 0.5, indexing="ij")
    return float(alpha.sum()), float((alpha * x).sum() / alpha.sum()), float((alpha * y).sum() / alpha.sum())


def test_rays_per_pixel_converges_to_area_without_shift():
    n, size = 8, 0.6123  # no edge on a pixel border
    scene = PlainScene([make.quad(-size, size, -size, size, 0)], make.IDENTITY, n, n)
    ticks = np.arange(n) / n * 2 - 1
    share = (np.minimum(ticks + 2 / n, size) - np.maximum(ticks, -size)).clip(0) * n / 2
    errors = {}
    for rays in (1, 8, 64):
        image = make.render(scene, rays_per_pixel=rays).rgba
        _, x, y = centroid(image)
        # the point set's own centre is the pixel's: what is left is a ray's worth of asymmetry, 1 / rays of a pixel
        assert (x, y) == pytest.approx((n / 2, n / 2), abs=0.5 / rays)
        errors[rays] = float(np.abs(image[..., 3].numpy() - share[:, None] * share[None]).max())
    # discrepancy of the Hammersley set of 64 points: at most about ln(64) / 64
    assert errors[64] < 0.065
    assert errors[64] < errors[8] < errors[1]


def test_rays_are_spread_about_the_pixel_centre():
    scene = soup(0)
    one, many = (make.render(scene, rays_per_pixel=rays).rgba for rays in (1, 16))
    assert (one - many).abs().max() > 1e-3
    assert float((one - many).mean((0, 1)).abs().max()) < 0.05  # the mean over the image is kept: no gain
    sheet = make.quad(-4, 4, -4, 4, 0, opacity=0.5)
    alpha = make.render(replaced(scene, meshes=[sheet]), rays_per_pixel=7).rgba[..., 3]
    assert_same(alpha, torch.full_like(alpha, 0.5), 1e-14)


@pytest.mark.parametrize("shift", [(0.5, 0.0), (0.0, -0.375), (0.5, 0.25)])
def test_blur_has_no_shift_against_the_centre_frame(shift):
    n = 32
    mesh = make.quad(-0.25, 0.25, -0.25, 0.25, 0, shift=shift)
    mesh.vertices = mesh.vertices - np.array([shift[0] / 2, shift[1] / 2, 0])
    scene = PlainScene([mesh], make.IDENTITY, n, n)
    _, x, y = centroid(make.render(scene).rgba)
    _, sharp_x, sharp_y = centroid(tb.render_instant(make.to_torch(scene), t=0.5).rgba)
    assert (x, y) == pytest.approx((n / 2, n / 2), abs=1e-9)
    assert (sharp_x, sharp_y) == pytest.approx((n / 2, n / 2), abs=1e-9)


def test_frame_reports_counts_and_timings():
    frame = make.render(soup(0))
    assert {"prisms", "pairs", "intervals", "cells", "layers", "crossings", "deepest_pixel"} <= frame.counts.keys()
    assert all(isinstance(v, int) and v >= 0 for v in frame.counts.values())
    assert all(v >= 0 for v in frame.timings.values())
    empty = make.render(PlainScene([], make.IDENTITY, 2, 2))
    assert empty.counts["intervals"] == 0
