"""One instant: colour, depth, motion, ids and barycentrics of what is visible at the pixel's centre.

Tolerance: 1e-10 in float64 (values of order 10 to 100 px, one division by w each). float32 results are rounded to 6e-8
of their size from vertices that were rounded so too, and motion is a difference of positions up to 100 px: 1e-4 px.
"""

from __future__ import annotations

import numpy as np
import oracles
import pytest
import scene_makers as make
import torch
from agreement_scenes import SCENES
from oracles import PlainMesh, PlainScene

import torchblur as tb

RED, GREEN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)


def instant(scene: PlainScene, t: float, dtype=torch.float64, **options) -> tb.Instant:
    """Render a plain scene at an instant."""
    return tb.render_instant(make.to_torch(scene, dtype), t=t, **options)


@pytest.mark.parametrize("name", list(SCENES))
@pytest.mark.parametrize("t", [0.0, 0.31, 1.0])
def test_everything_is_the_oracles(name, t):
    scene = SCENES[name]()
    now = instant(scene, t)
    seen = 0
    perspective = name in {"near plane", "rotating, K = 1", "rotating, K = 8", "moving camera", "one-sided"}
    for row in range(scene.height):
        for col in range(scene.width):
            hits = oracles.find_hits(scene, row, col, t)
            color = oracles.sample_pixel(scene, row, col, np.array([t]))[0]
            np.testing.assert_allclose(now.rgba[row, col].numpy(), color, rtol=0, atol=1e-12)
            if not hits:
                assert int(now.mesh_id[row, col]) == -1
                assert float(now.depth_view[row, col]) == np.inf
                continue
            seen += 1
            hit = hits[0]
            assert (int(now.mesh_id[row, col]), int(now.face_id[row, col])) == (hit.mesh, hit.face)
            np.testing.assert_allclose(now.bary[row, col].numpy(), hit.bary[1:], rtol=0, atol=1e-10)
            if perspective:
                np.testing.assert_allclose(float(now.depth_view[row, col]), hit.w, rtol=1e-10)
            here = np.array([col + 0.5, row + 0.5])
            to_open, to_close = (oracles.place_px(scene, hit, s) - here for s in (0.0, 1.0))
            np.testing.assert_allclose(now.motion_to_open_px[row, col].numpy(), to_open, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(now.motion_to_close_px[row, col].numpy(), to_close, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(now.motion_px[row, col].numpy(), to_close - to_open, rtol=1e-9, atol=1e-9)
    assert seen > 3


@pytest.mark.parametrize("t", [0.0, 0.25, 1.0])
def test_square_moving_right_and_up_has_positive_x_and_negative_y(t, dtype):
    width, height = 40, 20
    square = make.quad(-0.5, 0.3, -0.6, 0.4, 0, shift=(0.25, 0.3), color=RED)
    now = instant(PlainScene([square], make.IDENTITY, width, height), t, dtype)
    expected = torch.tensor([0.25 * width / 2, -0.3 * height / 2], dtype=dtype)
    on = now.mesh_id == 0
    assert 0.1 < float(on.double().mean()) < 0.4
    atol = 1e-10 if dtype == torch.float64 else 1e-4
    for motion, share in ((now.motion_px, 1.0), (now.motion_to_open_px, -t), (now.motion_to_close_px, 1 - t)):
        torch.testing.assert_close(motion[on], (share * expected).expand_as(motion[on]), rtol=0, atol=atol)
        assert (motion[~on] == 0).all()


def test_motion_is_that_of_the_object_not_of_the_image():
    """A disc that spins about the pixel's centre: the point at the centre does not move, others turn."""
    vertices, faces = make.grid(6, 1.3)
    mesh = PlainMesh(make.rotated(vertices, np.pi / 2, 64), faces)
    scene = PlainScene([mesh], make.IDENTITY, 9, 9)
    now = instant(scene, 0.0)
    x = (torch.arange(9) + 0.5 - 4.5).expand(9, 9).double()
    y = -x.T  # y up
    # a quarter turn counter-clockwise takes (x, y) to (-y, x); on screen y is down
    expected = torch.stack([-y - x, -(x - y)], -1)
    torch.testing.assert_close(now.motion_px, expected, rtol=0, atol=1e-10)


def test_open_and_close_are_consistent_with_motion_along_a_curve():
    now = instant(SCENES["moving camera"](), 0.6)
    torch.testing.assert_close(now.motion_px, now.motion_to_close_px - now.motion_to_open_px, rtol=0, atol=1e-9)
    at_open = instant(SCENES["moving camera"](), 0.0)
    assert at_open.motion_to_open_px.abs().max() < 1e-9
    torch.testing.assert_close(at_open.motion_px, at_open.motion_to_close_px, rtol=0, atol=1e-9)


def test_camera_motion_alone_moves_static_points():
    floor = PlainMesh([[-3, -1, -3], [3, -1, -3], [3, -0.9, 3], [-3, -0.9, 3]], [[0, 1, 2], [0, 2, 3]])
    matrix = np.stack([make.perspective((0, 0.5, 5), (0, 0, 0)), make.perspective((0.5, 0.5, 5), (0.5, 0, 0))])
    now = instant(PlainScene([floor], matrix, 16, 16), 0.5)
    on = now.mesh_id == 0
    assert on.any()
    assert (now.motion_px[..., 0][on] < -0.1).all()  # the camera goes right, the world left
    assert now.motion_px[..., 1][on].abs().max() < 1e-9


def test_motion_to_the_next_frame():
    square = make.quad(-0.5, 0.3, -0.6, 0.4, 0, shift=(0.25, 0.0))
    later = make.quad(-0.25, 0.55, -0.6, 0.4, 0, shift=(0.5, 0.5))
    scene, following = (make.to_torch(PlainScene([m], make.IDENTITY, 20, 20)) for m in (square, later))
    now = tb.render_instant(scene, t=0.5)
    on = now.mesh_id == 0
    expected = torch.tensor([(0.25 - 0.125 + 0.25) * 10, -0.25 * 10], dtype=torch.float64)
    motion = tb.motion_to(now, following, 0.5)
    torch.testing.assert_close(motion[on], expected.expand_as(motion[on]), rtol=0, atol=1e-10)
    assert (motion[~on] == 0).all()
    for t, known in ((0.5, 0 * now.motion_px), (1.0, now.motion_to_close_px), (0.0, now.motion_to_open_px)):
        torch.testing.assert_close(tb.motion_to(now, scene, t), known, rtol=0, atol=1e-9)


@pytest.mark.parametrize("depth", [0.25, 3.0, 40.0])
def test_depth_is_view_depth_not_distance(depth, dtype):
    camera = tb.Camera.look_at((1, 2, 3), (1, 2, -1), fov_y_deg=70, width=9, height=7, near=0.1, far=100)
    corners = torch.tensor([[-999, -999, 3 - depth], [999, -999, 3 - depth], [0, 999, 3 - depth]], dtype=dtype)
    now = tb.render_instant(tb.Scene([tb.Mesh(corners, [[0, 1, 2]])], camera), t=0.5)
    tol = 1e-12 if dtype == torch.float64 else 3e-6  # 3 - depth was rounded to 2e-7
    torch.testing.assert_close(now.depth_view, torch.full((7, 9), depth, dtype=dtype), rtol=tol, atol=tol)


def test_depth_of_a_tilted_plane_at_every_centre():
    matrix = make.w_is_z()
    # w = 4 + x_world + y_world / 2, with x = x0 w: w = 4 / (1 - x0 - y0 / 2)
    corners = np.array([[-2.0, -2.0], [3.0, -1.5], [0.0, 3.0]])
    mesh = make.triangle(np.column_stack([corners, 4 + corners @ [1, 0.5]]))
    scene = PlainScene([mesh], matrix, 8, 8)
    now = instant(scene, 0.5)
    for row, col in zip(*np.nonzero(now.mesh_id.numpy() == 0), strict=True):
        x0, y0 = scene.pixel_ndc(row, col)
        assert float(now.depth_view[row, col]) == pytest.approx(4 / (1 - x0 - y0 / 2), rel=1e-12)
    assert (now.mesh_id == 0).sum() > 8


@pytest.mark.parametrize("near", [0.5, -2.0])
def test_depth_of_an_orthographic_camera(near, dtype):
    camera = tb.Camera.orthographic((0, 0, 5), (0, 0, 0), height_world=4, width=5, height=4, near=near, far=9)
    corners = torch.tensor([[-99, -99, 1.25], [99, -99, 1.25], [0, 99, 1.25]], dtype=dtype)
    now = tb.render_instant(tb.Scene([tb.Mesh(corners, [[0, 1, 2]])], camera), t=0.5)
    torch.testing.assert_close(now.depth_view, torch.full((4, 5), 3.75, dtype=dtype), rtol=1e-6, atol=0)


def test_orthographic_pixels_are_square_and_placed():
    camera = tb.Camera.orthographic((0, 0, 5), (0, 0, 0), height_world=4, width=8, height=4, near=1, far=9)
    square = make.quad(-2, 0, 0, 1, 0)  # world units are pixels here: columns 2 and 3, row 1
    now = tb.render_instant(tb.Scene([tb.Mesh(torch.tensor(square.vertices), square.faces)], camera), t=0.5)
    expected = torch.full((4, 8), -1)
    expected[1, 2:4] = 0
    assert torch.equal(now.mesh_id, expected)


def test_ids_and_nearest_surface(dtype):
    left = make.quad(-1, 0, -2, 3, 0.5, color=RED)
    everywhere = make.quad(-2, 3, -2, 3, 0.7, color=GREEN)
    ghost = make.quad(-2, 3, -2, 3, 0.1, color=GREEN, opacity=0.0)
    glass = make.quad(-2, 3, 0, 3, 0.3, color=GREEN, opacity=0.25)
    now = instant(PlainScene([everywhere, ghost, left, glass], make.IDENTITY, 4, 4), 0.5, dtype)
    assert torch.equal(now.mesh_id[:2], torch.full((2, 4), 3))  # what cannot be seen is not there, glass is
    assert torch.equal(now.mesh_id[2:], torch.tensor([[2, 2, 0, 0]] * 2))
    assert set(now.face_id.flatten().tolist()) <= {0, 1}
    np.testing.assert_allclose(now.rgba[0, 0].numpy(), (0.75, 0.25, 0, 1), atol=1e-7)


def test_one_sided_faces_are_seen_from_the_front_only():
    front = make.triangle([(-9, -9), (9, -9), (0, 9)], double_sided=False)
    back = PlainMesh(front.vertices, front.faces[:, ::-1], double_sided=False)
    assert int(instant(PlainScene([front]), 0.5).mesh_id[0, 0]) == 0
    assert int(instant(PlainScene([back]), 0.5).mesh_id[0, 0]) == -1


def test_point_that_goes_behind_the_camera_has_no_motion():
    corners = [(-1, -1), (1, -1), (0, 1)]
    mesh = make.triangle([(*p, 2.0) for p in corners], [(*p, -2.0) for p in corners])
    now = instant(PlainScene([mesh], make.w_is_z(0.1, 100)), 0.25)
    assert float(now.depth_view[0, 0]) == pytest.approx(1.0)
    assert torch.isfinite(now.motion_to_open_px).all()
    assert torch.isnan(now.motion_to_close_px).all()
    assert torch.isnan(now.motion_px).all()
    assert int(instant(PlainScene([mesh], make.w_is_z(0.1, 100)), 0.47).mesh_id[0, 0]) == 0
    assert int(instant(PlainScene([mesh], make.w_is_z(0.1, 100)), 0.48).mesh_id[0, 0]) == -1


def test_near_plane_cuts_a_static_triangle():
    matrix = make.w_is_z(1.0, 100)
    corners = np.array([[-3.0, -3.0, 0.5], [3.0, -3.0, 0.5], [0.0, 9.0, 6.5]])  # w = 0.5 + (y + 3) / 2
    now = instant(PlainScene([make.triangle(corners)], matrix, 1, 64), 0.5)
    rows = torch.nonzero(now.mesh_id[:, 0] == 0).flatten()
    scene = PlainScene([], matrix, 1, 64)
    expected = []
    for row in range(64):
        y0 = scene.pixel_ndc(row, 0)[1]
        w = 2 / (1 - y0 / 2)  # y = y0 w: w = 2 + y0 w / 2
        expected += [row] if w >= 1 and -3 <= y0 * w <= 9 else []
    assert rows.tolist() == expected
    assert len(expected) > 5


def test_more_rays_blend_colour_but_leave_the_rest_at_the_centre():
    scene = SCENES["opaque"]()
    one, many = instant(scene, 0.4), instant(scene, 0.4, rays_per_pixel=8)
    assert (one.rgba - many.rgba).abs().max() > 0.01
    for name in ("depth_view", "motion_px", "mesh_id", "face_id", "bary"):
        assert torch.equal(getattr(one, name), getattr(many, name)), name


def test_image_is_the_same_at_segment_ends_from_both_sides():
    scene = SCENES["four segments"]()
    a, b = instant(scene, 0.5 - 1e-12), instant(scene, 0.5)
    torch.testing.assert_close(a.motion_px, b.motion_px, rtol=0, atol=1e-8)
    assert torch.equal(a.face_id, b.face_id)


@pytest.mark.parametrize("noise", [0.0, 1e-17, -1e-12, 1e-7])
@pytest.mark.parametrize("row", [0, 2])
def test_a_matrix_that_is_orthographic_up_to_rounding_orders_by_depth(noise, row):
    """A last row of (0, 0, 1e-17, 1) must not make 1 / w, which says nothing about depth here, the order."""
    square = torch.tensor([[-2.0, -2, 0], [2, -2, 0], [0, 3, 0]], dtype=torch.float64)
    shift = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    near = tb.Mesh(torch.stack([square + shift, square + 1.1 * shift]), [[0, 1, 2]], tb.Material((1.0, 0, 0)))
    far = tb.Mesh(square, [[0, 1, 2]], tb.Material((0.0, 1, 0)))
    straight = tb.Camera.orthographic((0, 0, 5), (0, 0, 0), height_world=2, width=2, height=2, near=0.1, far=10)
    matrix = straight.world_to_clip.clone()
    matrix[3, row] = noise
    scene = tb.Scene([far, near], tb.Camera(matrix, 2, 2, depth_at_near=0.1))
    assert tb.render(scene).rgba[0, 0].tolist() == [1, 0, 0, 1]
    now = tb.render_instant(scene, 0.0)
    assert now.rgba[0, 0].tolist() == [1, 0, 0, 1]
    assert float(now.depth_view[0, 0]) == pytest.approx(4.0, abs=1e-5)


def test_an_instant_in_portions_is_the_instant(monkeypatch):
    """Deep overdraw is worked off in rectangles of pixels: the image must not show it."""
    generator = torch.Generator().manual_seed(3)
    vertices = (torch.rand(2, 90, 3, dtype=torch.float64, generator=generator) - 0.5) * 3
    mesh = tb.Mesh(vertices, torch.arange(90).reshape(30, 3), tb.Material(torch.rand(30, 3, generator=generator), 0.5))
    camera = tb.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y_deg=60, width=23, height=17, near=0.1, far=10)
    scene = tb.Scene([mesh], camera)
    whole, mean = tb.render_instant(scene, 0.4), tb.accumulate(scene, 5)
    monkeypatch.setattr("torchblur.fragments.MAX_PAIRS", 40)
    parts = tb.render_instant(scene, 0.4)
    for name in ("rgba", "depth_view", "motion_px", "mesh_id", "face_id", "bary"):
        torch.testing.assert_close(getattr(parts, name), getattr(whole, name), rtol=0, atol=0)
    torch.testing.assert_close(tb.accumulate(scene, 5).rgba, mean.rgba, rtol=0, atol=1e-15)
