import math

import pytest
import torch

import torchblur as tb
from datagen.clips import Actor, Clip, expose, freeze
from datagen.knots import MAX_SEGMENTS, TOLERANCE_PX
from datagen.motions import CameraPath, Path, PlayedVertices, RigidBody, RigidMotion, Sway, turns
from datagen.shapes import ball, box, enclosed_volume, gear, knot, polyhedron, star, torus, vase

W, H = 96, 64
STILL_CAMERA = CameraPath(Path((0.0, 0.0, 6.0)), Path((0.0, 0.0, 0.0)), fov_y_deg=45.0, near=0.3, far=50.0)
OPEN_S, CLOSE_S = 0.1, 0.1 + 1 / 48


def actor(motion, shape=None):
    shape = shape or box(2, (0.8, 0.8, 0.8))
    return Actor("body", shape.faces, torch.tensor([0.5, 0.5, 0.5]), RigidBody(shape.vertices, motion))


def clip_of(motion, camera=STILL_CAMERA, shape=None):
    return Clip((actor(motion, shape),), camera, torch.zeros(3))


def to_px(world, matrices):
    """Screen positions (N, V, 2) of (N, V, 3), written out apart from datagen's and torchblur's own."""
    clip = torch.einsum("nij,nvj->nvi", matrices, torch.cat([world, torch.ones_like(world[..., :1])], -1))
    ndc = clip[..., :2] / clip[..., 3:]
    return torch.stack([(ndc[..., 0] + 1) * W / 2, (1 - ndc[..., 1]) * H / 2], -1), clip[..., 3]


def real_error_px(clip, exposure, n=1501):
    """The largest distance on the screen between the exact motion and the scene's, at many instants."""
    worst = 0.0
    t = torch.linspace(0, 1, n, dtype=torch.float64)
    seconds = exposure.open_s + t * (exposure.close_s - exposure.open_s)
    exact_matrix = clip.camera.matrices(seconds, W, H)
    camera = exposure.scene.camera
    for one, mesh in zip(clip.actors, exposure.scene.meshes, strict=True):
        segments = max(mesh.n_segments, camera.n_segments, 1)
        ends = torch.arange(segments + 1, dtype=torch.float64) / segments
        at_ends = torch.cat([mesh.vertices_at(ends), torch.ones(segments + 1, len(mesh.vertices_at(ends)[0]), 1)], -1)
        clip_ends = torch.einsum("nij,nvj->nvi", camera.world_to_clip_at(ends), at_ends)
        first = (t * segments).floor().clamp(max=segments - 1).long()
        share = (t * segments - first)[:, None, None]
        chord = clip_ends[first] * (1 - share) + clip_ends[first + 1] * share
        chord_px = torch.stack(
            [(chord[..., 0] / chord[..., 3] + 1) * W / 2, (1 - chord[..., 1] / chord[..., 3]) * H / 2], -1
        )
        exact_px, w = to_px(one.motion.at(seconds), exact_matrix)
        on_screen = (w > 0) & ((exact_px / torch.tensor([W, H]) - 0.5).abs() <= 0.5).all(-1)
        worst = max(worst, float((chord_px - exact_px).norm(dim=-1)[on_screen].max()))
    return worst


def test_a_still_body_has_no_knots():
    exposure = expose(clip_of(RigidMotion(Path((0.0, 0.0, 0.0)))), W, H, OPEN_S, CLOSE_S)
    assert exposure.mesh_knots[0].segments == 0
    assert exposure.scene.meshes[0].vertices.ndim == 2
    assert exposure.scene.camera.n_segments == 0


def test_a_slow_or_straight_body_has_one_segment():
    for motion in (RigidMotion(Path((0.0, 0.0, 0.0), (30.0, 5.0, 0.0))), RigidMotion(Path((0.0,) * 3), spin_rad_s=1.0)):
        exposure = expose(clip_of(motion), W, H, OPEN_S, CLOSE_S)
        assert exposure.mesh_knots[0].segments == 1
        assert real_error_px(clip_of(motion), exposure) < TOLERANCE_PX


@pytest.mark.parametrize("spin", [20.0, 75.0, 300.0])
def test_fast_rotation_gets_as_many_segments_as_it_needs_and_no_more(spin):
    clip = clip_of(RigidMotion(Path((0.4, 0.2, 0.0)), (0.2, 0.3, 1.0), spin))
    exposure = expose(clip, W, H, OPEN_S, CLOSE_S)
    segments = exposure.mesh_knots[0].segments
    assert segments > 1
    assert segments & (segments - 1) == 0
    assert real_error_px(clip, exposure) < TOLERANCE_PX
    # half as many would not do: rebuild the scene with every second knot
    mesh = exposure.scene.meshes[0]
    coarse = tb.Scene([tb.Mesh(mesh.vertices[::2], mesh.faces)], exposure.scene.camera)
    worse = type(exposure)(coarse, OPEN_S, CLOSE_S, exposure.camera_knots, exposure.mesh_knots)
    assert real_error_px(clip, worse) > TOLERANCE_PX


def test_body_and_camera_together_stay_within_the_tolerance():
    shake = (Sway((0.3, 0.1, 0.0), 40.0, 0.3), Sway((0.0, 0.3, 0.1), 55.0, 1.0))
    cameras = [
        CameraPath(Path((0.0, 0.5, 6.0), sways=shake), Path((0.0,) * 3, sways=shake[:1]), 45.0, 0.3, 50.0),
        CameraPath(Path((0.0, 0.5, 6.0)), Path((0.0,) * 3), 45.0, 0.3, 50.0, orbit_rad_s=12.0),
        CameraPath(Path((0.0, 0.5, 6.0)), Path((0.0,) * 3), 45.0, 0.3, 50.0, roll_rad=0.4, roll_rate_rad_s=30.0),
    ]
    motions = [RigidMotion(Path((0.5, 0.0, 0.0)), (0.0, 1.0, 1.0), 40.0), RigidMotion(Path((-0.5, 0.0, 0.0)))]
    for camera in cameras:
        clip = Clip(tuple(actor(m) for m in motions), camera, torch.zeros(3))
        exposure = expose(clip, W, H, OPEN_S, CLOSE_S)
        assert exposure.camera_knots.segments >= 1
        assert exposure.mesh_knots[1].segments == 0  # still in the world: only the camera has knots
        assert real_error_px(clip, exposure) < TOLERANCE_PX
        assert not any(k.limit_reached for k in (exposure.camera_knots, *exposure.mesh_knots))


def test_the_limit_is_reported_with_the_error_left():
    clip = clip_of(RigidMotion(Path((0.0,) * 3), (0.0, 0.0, 1.0), 20_000.0))
    exposure = expose(clip, W, H, OPEN_S, CLOSE_S)
    assert exposure.mesh_knots[0].segments == MAX_SEGMENTS
    assert exposure.mesh_knots[0].limit_reached
    assert exposure.mesh_knots[0].error_px > TOLERANCE_PX


@pytest.mark.parametrize("n_turns", [1, 2])
def test_full_turns_within_the_exposure_are_not_taken_for_rest(n_turns):
    clip = clip_of(RigidMotion(Path((0.0,) * 3), (0.0, 0.0, 1.0), n_turns * 2 * math.pi / (CLOSE_S - OPEN_S)))
    exposure = expose(clip, W, H, OPEN_S, CLOSE_S)
    assert exposure.mesh_knots[0].segments >= 8
    assert real_error_px(clip, exposure) < TOLERANCE_PX


def test_walls_behind_the_camera_ask_for_no_knots():
    camera = CameraPath(
        Path((0.0, 0.0, 6.0)), Path((0.0,) * 3, sways=(Sway((0.4, 0.0, 0.0), 8.0, 0.0),)), 45.0, 0.3, 50.0
    )
    front = expose(clip_of(RigidMotion(Path((0.0, 0.0, -3.0))), camera), W, H, OPEN_S, CLOSE_S)
    around = expose(clip_of(RigidMotion(Path((0.0,) * 3)), camera, box(10, (5.0, 5.0, 9.0))), W, H, OPEN_S, CLOSE_S)
    assert around.camera_knots.segments <= 4 * max(front.camera_knots.segments, 1)


def test_rigid_motion_keeps_all_lengths_and_follows_the_screw():
    motion = RigidMotion(Path((1.0, 0.0, 0.0), (0.0, 2.0, 0.0)), (0.0, 1.0, 0.0), math.pi, rest=(0.3, -0.2, 0.9))
    vertices = box(1, (1.0, 0.5, 0.25)).vertices
    placed = motion.place(vertices, torch.tensor([0.0, 0.37, 1.0]))
    for frame in placed:
        torch.testing.assert_close(torch.cdist(frame, frame), torch.cdist(vertices, vertices), atol=1e-7, rtol=1e-7)
    # half a turn about y in one second, and two up: x and z change sign about the axis through (1, ., 0)
    start, end = placed[0] - torch.tensor([1.0, 0.0, 0.0]), placed[2] - torch.tensor([1.0, 2.0, 0.0])
    torch.testing.assert_close(end, start * torch.tensor([-1.0, 1.0, -1.0]), atol=1e-12, rtol=0)


def test_turns_are_right_handed():
    quarter = turns((0.0, 0.0, 2.0), torch.tensor([math.pi / 2]))[0]
    expected = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(quarter @ torch.tensor([1.0, 0, 0], dtype=torch.float64), expected)
    with pytest.raises(ValueError, match="axis: expected"):
        turns((0.0, 0.0, 0.0), torch.tensor([1.0]))


def test_a_sequence_is_played_back_and_forth_through_its_frames():
    positions = torch.tensor([0.0, 1.0, 4.0], dtype=torch.float64)[:, None, None].expand(3, 1, 3)
    played = PlayedVertices(positions, rate_hz=2.0)
    at = played.at(torch.tensor([0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 2.25, -0.25]))[:, 0, 0]
    assert at.tolist() == [0.0, 0.5, 1.0, 4.0, 1.0, 0.0, 0.5, 0.5]
    assert played.kinks_s(0.1, 1.2) == [0.5, 1.0]
    assert played.kinks_s(0.5, 1.0) == []


def test_a_kink_of_a_sequence_inside_the_exposure_is_followed():
    shape = box(2, (0.8, 0.8, 0.8))
    shift = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)[:, None, None]
    positions = shape.vertices + shift * torch.tensor([0.4, 0.0, 0.0], dtype=torch.float64)
    played = PlayedVertices(positions, rate_hz=24.0, start_s=0.0)
    clip = Clip((Actor("played", shape.faces, torch.ones(3), played),), STILL_CAMERA, torch.zeros(3))
    exposure = expose(clip, W, H, 1 / 24 - 1 / 96, 1 / 24 + 1 / 96)  # out and back about frame 1
    assert exposure.mesh_knots[0].segments == 2  # a knot falls on the kink
    assert real_error_px(clip, exposure) < TOLERANCE_PX
    uneven = expose(clip, W, H, 1 / 24 - 1 / 96, 1 / 24 + 1 / 71)
    assert uneven.mesh_knots[0].segments > 2
    assert real_error_px(clip, uneven) < TOLERANCE_PX
    for close_s in (1 / 71, 1 / 83, 1 / 91, 1 / 67):  # the error is largest at the kink itself, and is stated as that
        found = expose(clip, W, H, 1 / 24 - 1 / 96, 1 / 24 + close_s)
        assert found.mesh_knots[0].error_px == pytest.approx(real_error_px(clip, found, 6001), rel=0.01)


def test_a_frozen_clip_is_the_exact_pose():
    motion = RigidMotion(Path((0.0, 0.0, 0.0), (3.0, 0.0, 0.0)), (0.0, 0.0, 1.0), 50.0)
    clip = clip_of(motion)
    scene = freeze(clip, W, H, 0.125)
    assert scene.meshes[0].n_segments == 0
    exact = motion.place(clip.actors[0].motion.vertices, torch.tensor([0.125]))[0]
    torch.testing.assert_close(scene.meshes[0].vertices, exact.to(torch.float32), atol=0, rtol=0)


def test_an_empty_window_is_refused():
    with pytest.raises(ValueError, match="close_s: expected"):
        expose(clip_of(RigidMotion(Path((0.0,) * 3))), W, H, 1.0, 1.0)


@pytest.mark.parametrize(
    "shape",
    [box(5), ball(6), vase([0.4, 0.8, 0.2]), torus(), knot(), star(), gear(), polyhedron("icosahedron", 2, True),
     polyhedron("tetrahedron", 1), polyhedron("octahedron")],
)  # fmt: skip
def test_closed_shapes_are_closed_and_look_outward(shape):
    assert shape.is_closed
    assert enclosed_volume(shape) > 0.1
    points = [tuple(p) for p in shape.vertices.tolist()]
    edges: dict[tuple, int] = {}
    for face in shape.faces.tolist():
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            if points[a] != points[b]:
                edges[points[a], points[b]] = edges.get((points[a], points[b]), 0) + 1
    assert all(edges.get((b, a)) == n for (a, b), n in edges.items())


def test_a_sequence_that_is_played_through_often_is_cut_at_64_of_its_frames_at_most():
    positions = torch.rand(9, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for rate_hz, close_s in ((24.0, 1e9), (1e6, 1.0), (64.0, 1.0)):
        times = PlayedVertices(positions, rate_hz, 0.25).kinks_s(0.0, close_s)
        assert 32 <= len(times) <= 64
        assert times == sorted(times)
        assert 0 < times[0] < times[-1] < close_s
        assert max(abs((t + 0.25) * rate_hz - round((t + 0.25) * rate_hz)) for t in times) < 1e-3
