import json
import math

import pytest
import torch

import torchblur as tb
from datagen.clips import Actor, Clip
from datagen.motions import CameraPath, Path, RigidBody, RigidMotion, Sway
from datagen.samples import frame_times, make_sample, render_sample
from datagen.scenes import Plan, build_clip, plan_from_json
from datagen.shapes import sheet
from datagen.spec import parse_spec
from datagen.writer import encode_exr, sample_parts

SIZE = 24
VIEW = 4.0  # scene units from top to bottom at the origin
CAMERA = CameraPath(
    Path((0.0, 0.0, 5.0)), Path((0.0, 0.0, 0.0)), fov_y_deg=2 * math.degrees(math.atan(VIEW / 10)), near=0.3, far=50.0
)
PX = SIZE / VIEW  # pixels of a scene unit at the origin


def plan(**fields):
    base = {"width": SIZE, "height": SIZE, "rays_per_pixel": 1, "frames_per_clip": 4}
    return Plan(parse_spec(base | fields), (), "")


def square_clip(velocity=(0.0, 0.0, 0.0), camera=CAMERA, sways=()):
    shape = sheet(2)
    body = RigidBody(shape.vertices, RigidMotion(Path((0.0, 0.0, 0.0), velocity, sways)))
    color = torch.tensor([[0.9, 0.2, 0.1], [0.1, 0.6, 0.9]]).repeat(4, 1)
    return Clip((Actor("square", shape.faces, color, body),), camera, torch.tensor([0.1, 0.2, 0.3]))


def middle(plane):
    return plane[SIZE // 2, SIZE // 2]


def test_a_square_moving_right_and_down_has_positive_motion():
    velocity = (12.0, -6.0, 0.0)  # world y is up, screen y is down
    sample = render_sample(square_clip(velocity), plan(exposure=0.5), 0, 0)
    per_s = torch.tensor([12.0 * PX, 6.0 * PX])
    torch.testing.assert_close(middle(sample.motion_px).float(), per_s / 48, atol=1e-3, rtol=0)
    torch.testing.assert_close(middle(sample.motion_next_px).float(), per_s / 24, atol=1e-3, rtol=0)
    torch.testing.assert_close(middle(sample.motion_previous_px).float(), -per_s / 24, atol=1e-3, rtol=0)
    data = sample_parts(sample)["data"]
    assert data["forward.u"][SIZE // 2, SIZE // 2] == pytest.approx(12 * PX / 48, abs=1e-3)
    assert data["forward.v"][SIZE // 2, SIZE // 2] == pytest.approx(6 * PX / 48, abs=1e-3)
    assert data["previous.u"][SIZE // 2, SIZE // 2] < 0 < data["next.v"][SIZE // 2, SIZE // 2]


def test_the_backend_is_what_renders_and_is_told_of(monkeypatch):
    seen, render = [], tb.render
    monkeypatch.setattr(tb, "render", lambda scene, **how: seen.append(how["backend"]) or render(scene, **how))
    clip = square_clip((12.0, -6.0, 0.0))
    auto, plain = (render_sample(clip, plan(**more), 0, 0) for more in ({}, {"backend": "torch"}))
    assert seen == ["auto", "torch"] == [sample.meta["backend"] for sample in (auto, plain)]
    torch.testing.assert_close(auto.blurred, plain.blurred, atol=2e-5, rtol=0)


def test_curved_motion_to_the_neighbours_is_that_of_their_sharp_instants():
    sway = Sway((0.6, 0.3, 0.0), 30.0, 0.4)
    sample = render_sample(square_clip(sways=(sway,)), plan(), 1, 1)

    def place(time_s):
        return torch.tensor([0.6, -0.3]) * PX * math.sin(30.0 * time_s + 0.4)

    now = place(1 / 24)
    torch.testing.assert_close(middle(sample.motion_next_px).float(), place(2 / 24) - now, atol=0.1, rtol=0)
    torch.testing.assert_close(middle(sample.motion_previous_px).float(), place(0.0) - now, atol=0.1, rtol=0)
    exposed = place(1 / 24 + 1 / 96) - place(1 / 24 - 1 / 96)
    torch.testing.assert_close(middle(sample.motion_px).float(), exposed, atol=0.1, rtol=0)


def test_next_of_a_frame_leads_to_where_the_next_frame_is_sharp():
    clip, here = square_clip((9.0, 0.0, 0.0)), plan()
    first, second = (render_sample(clip, here, i, i) for i in (0, 1))
    step = 9.0 * PX / 24  # 2.25 px
    assert float(middle(first.motion_next_px)[0]) == pytest.approx(step, abs=1e-3)
    centre = [float((s.mesh_id == 0).nonzero()[:, 1].double().mean()) for s in (first, second)]
    assert centre[1] - centre[0] == pytest.approx(step, abs=0.5)


def test_sharp_and_blurred_agree_where_nothing_moves():
    sample = render_sample(square_clip(), plan(rays_per_pixel=3), 0, 0)
    torch.testing.assert_close(sample.sharp, sample.blurred, atol=1e-6, rtol=0)
    assert float(sample.motion_px.abs().max()) == 0
    assert float(sample.motion_next_px.abs().max()) < 1e-5  # the visible point is kept in float32
    assert sample.meta["meshes"][0]["segments"] == 0
    moving = render_sample(square_clip((20.0, 0.0, 0.0)), plan(rays_per_pixel=3), 0, 0)
    assert float((moving.sharp - moving.blurred).abs().max()) > 0.1


def test_the_blur_lasts_as_long_as_the_exposure():
    clip = square_clip((24.0, 0.0, 0.0))
    motions = [float(middle(render_sample(clip, plan(exposure=e), 0, 0).motion_px)[0]) for e in (0.25, 0.5, 1.0)]
    assert motions == pytest.approx([PX * e for e in (0.25, 0.5, 1.0)], abs=1e-3)


def test_depth_ids_alpha_and_coverage():
    sample = render_sample(square_clip((10.0, 0.0, 0.0)), plan(), 0, 0)
    seen = sample.mesh_id >= 0
    assert bool(seen.any())
    assert not bool(seen.all())
    torch.testing.assert_close(sample.depth_view[seen].double(), torch.full_like(sample.depth_view[seen], 5).double())
    assert bool(torch.isinf(sample.depth_view[~seen]).all())
    assert sample.coverage.shape == (SIZE, SIZE, 1)
    torch.testing.assert_close(sample.coverage[..., 0], sample.blurred[..., 3], atol=1e-6, rtol=0)  # opaque
    data = sample_parts(sample)["data"]
    assert ((data["id.mesh"] == 0) == ~seen.numpy()).all()
    assert data["id.face"].max() == 8


def test_sample_7_alone_is_sample_7_of_10():
    text = plan(width=12, height=12, seed=5).to_json()
    many = [make_sample(text, i) for i in range(10)]
    make_sample(plan(width=12, height=12, seed=6).to_json(), 3)  # another data set in between changes nothing
    alone = make_sample(plan(width=12, height=12, seed=5, count=8).to_json(), 7)
    assert encode_exr(sample_parts(many[7]), many[7].meta) == encode_exr(sample_parts(alone), alone.meta)
    other = make_sample(plan(width=12, height=12, seed=6).to_json(), 7)
    assert encode_exr(sample_parts(many[7]), {}) != encode_exr(sample_parts(other), {})
    with pytest.raises(ValueError, match="index: expected"):
        make_sample(text, -1)


def test_frames_of_a_clip_share_the_scene_and_other_clips_do_not():
    text = plan(width=12, height=12).to_json()
    metas = [make_sample(text, i).meta for i in (0, 3, 4)]
    names = [[m["name"] for m in meta["meshes"]] for meta in metas]
    assert names[0] == names[1] != names[2]
    assert [(m["clip"], m["frame"]) for m in metas] == [(0, 0), (0, 3), (1, 0)]


def test_metadata_says_when_and_how():
    here = plan(fps=30.0, exposure=0.6)
    meta = render_sample(square_clip((30.0, 0.0, 0.0)), here, 2, 2).meta
    json.dumps(meta, allow_nan=False)
    assert meta["time_s"]["close"] - meta["time_s"]["open"] == pytest.approx(0.02)
    assert meta["time_s"]["sharp"] == pytest.approx(2 / 30)
    assert meta["time_s"]["next"] - meta["time_s"]["previous"] == pytest.approx(2 / 30)
    assert meta["exposure_s"] == pytest.approx(0.02)
    assert (meta["width"], meta["height"], meta["index"]) == (SIZE, SIZE, 2)
    assert meta["meshes"][0]["name"] == "square"
    assert meta["meshes"][0]["segments"] == 1
    assert meta["meshes"][0]["chord_error_px"] < meta["chord_tolerance_px"]
    assert len(meta["camera"]["world_to_clip"]) == meta["camera"]["segments"] + 1
    assert meta["config_sha256"] == here.config_sha256
    assert set(meta["units"]) >= {"forward", "next", "previous", "Z", "A", "id", "coverage", "motion"}


def test_times_of_a_frame_are_centred_on_its_sharp_instant():
    times = frame_times(plan(fps=10.0, exposure=0.5), 3)
    assert (times.open_s, times.sharp_s, times.close_s) == pytest.approx((0.275, 0.3, 0.325))
    assert (times.previous_s, times.next_s) == pytest.approx((0.2, 0.4))


def test_built_in_scenes_are_valid_varied_and_small():
    backdrops, cameras, shapes, clear, lamps = set(), set(), set(), 0, 0
    for number in range(60):
        clip = build_clip(plan(seed=2), number)
        backdrops.add(clip.notes["backdrop"])
        cameras.add(clip.notes["camera"])
        assert sum(len(a.faces) for a in clip.actors) <= 8000
        for actor in clip.actors:
            shapes.add(actor.name.split("-")[0])
            clear += float(torch.as_tensor(actor.opacity).min()) < 1
            lamps += float(actor.color.max()) > 1.5
            assert bool(torch.isfinite(actor.color).all())
            assert float(actor.color.min()) >= 0
    assert len(backdrops) == 6
    assert len(cameras) == 6
    assert len(shapes) >= 15
    assert clear > 10
    assert lamps >= 3


def test_a_plan_travels_as_text():
    here = Plan(parse_spec({"width": 9}), ("a.obj", "b/ü.ply"), "ff")
    assert plan_from_json(here.to_json()) == here
