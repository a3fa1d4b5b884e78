"""The scatter filter of 2015 against a plain transcription, closed forms of its curves and weights, and exact blur."""

import math
import time

import filter_transcriptions as plain
import numpy as np
import pytest
import torch

import torchblur as tb
from datagen.baselines.curves import fit_curves
from datagen.baselines.guertin2015 import Lines, guertin2015
from datagen.baselines.views import Layer, Paths, find_paths, find_view

F64 = torch.float64
THREE, FOUR = (0.0, 0.5, 1.0), (0.0, 0.25, 0.5, 1.0)
H, W = 10, 13


def whole_bound(curves):
    """The bound of the speed over all of the exposure, (n,)."""
    n = len(curves.control)
    return curves.speed_bound(torch.arange(n), torch.zeros(n, dtype=F64), torch.ones(n, dtype=F64))


def random_paths(generator, times=THREE, batch=1, reach=6.0, h=H, w=W):
    """Noise in which a part stands still and a part has nothing in it; depths change along the paths."""
    k = len(times)
    offset = reach * (2 * torch.rand(batch, k, 2, h, w, generator=generator, dtype=F64) - 1)
    offset[:, times.index(0.5)] = 0
    offset[:, :, :, : h // 3] *= 0.05
    depth = 1 + torch.rand(batch, k, h, w, generator=generator, dtype=F64)
    depth[:, :, :, w // 2 : w // 2 + 2] = torch.inf
    return Paths(offset, depth, times)


def random_color(generator, batch=1, h=H, w=W):
    return torch.rand(batch, 3, h, w, generator=generator, dtype=F64)


def random_static(generator):
    return Layer(random_color(generator), 1.2 + torch.rand(1, 1, H, W, generator=generator, dtype=F64))


@pytest.mark.parametrize("with_static", [False, True])
@pytest.mark.parametrize(
    ("times", "curve", "weighting"),
    [
        (THREE, "bezier", "published"),
        (THREE, "bezier", "time"),
        (THREE, "arc", "published"),
        (THREE, "arc", "time"),
        ((0.0, 0.5, 0.75), "bezier", "published"),
        ((0.1, 0.5, 0.75), "arc", "published"),
        (FOUR, "bezier", "published"),
        (FOUR, "bezier", "time"),
    ],
)
def test_it_is_its_pseudo_code(generator, times, curve, weighting, with_static):
    color, paths = random_color(generator), random_paths(generator, times)
    static = random_static(generator) if with_static else None
    lines = Lines(points=7, background_weight=3.0, sigma=0.4) if weighting == "published" else None
    blurred = guertin2015(color, paths, static=static, curve=curve, weighting=weighting, lines=lines)
    options = {"static": None, "arc": curve == "arc", "by_time": weighting == "time"}
    options |= {"points": 7, "background_weight": 3.0, "sigma": 0.4}
    if static is not None:
        options["static"] = (static.color[0].permute(1, 2, 0).tolist(), static.depth_view[0, 0].tolist())
    if weighting == "time":
        options["counts"] = sample_counts(paths, curve)
    arguments = (color[0].permute(1, 2, 0), paths.offset_px[0].permute(0, 2, 3, 1), paths.depth_view[0])
    expected = np.array(plain.guertin2015(*(a.tolist() for a in arguments), list(times), options))
    np.testing.assert_allclose(blurred[0].permute(1, 2, 0).numpy(), expected, rtol=0, atol=1e-5)
    assert float((blurred - color).abs().max()) > 0.1


def sample_counts(paths, curve):
    """How many samples each curve gets: any number serves, as long as both use the same."""
    moving = paths.is_moving[0]
    counts = torch.ones(moving.shape, dtype=torch.int64)
    for y, x in moving.nonzero().tolist():
        points = torch.cat([paths.offset_px[0, :, :, y, x], paths.depth_view[0, :, y, x, None]], dim=1).unsqueeze(0)
        points = points + torch.tensor([x + 0.5, y + 0.5, 0.0], dtype=F64)
        counts[y, x] = math.ceil(2 * float(whole_bound(fit_curves(points, paths.times, curve))))
    return counts.tolist()


def test_the_control_point_makes_the_curve_pass_through_the_middle():
    straight = torch.tensor([[[1.0, 2.0, 3.0], [3.0, 5.0, 4.0], [5.0, 8.0, 5.0]]], dtype=F64)
    curves = fit_curves(straight, THREE, "bezier")
    torch.testing.assert_close(curves.control, straight, rtol=0, atol=1e-12)  # B1 = p(0): a straight, even motion
    bent = torch.tensor([[[1.0, 2.0, 3.0], [4.0, -1.0, 2.0], [5.0, 8.0, 5.0]]], dtype=F64)
    control = fit_curves(bent, THREE, "bezier").control
    torch.testing.assert_close(control[:, 1], 2 * bent[:, 1] - (bent[:, 0] + bent[:, 2]) / 2, rtol=0, atol=1e-12)


@pytest.mark.parametrize("times", [THREE, (0.2, 0.5, 0.6), FOUR])
@pytest.mark.parametrize("kind", ["bezier", "arc"])
def test_curves_pass_through_their_points(generator, times, kind):
    if kind == "arc" and len(times) == 4:
        with pytest.raises(ValueError, match=r"^curve: expected bezier"):
            fit_curves(torch.zeros(1, 4, 3, dtype=F64), times, kind)
        return
    points = 20 * torch.rand(200, len(times), 3, generator=generator, dtype=F64)
    curves = fit_curves(points, times, kind)
    every = torch.arange(200)
    for k, t in enumerate(times):
        torch.testing.assert_close(curves.at(every, torch.full((200,), t, dtype=F64)), points[:, k], rtol=0, atol=1e-7)
    fine = torch.linspace(0, 1, 401, dtype=F64)
    bound = whole_bound(curves)
    for n in range(0, 200, 20):
        place = curves.at(torch.full((401,), n), fine)[:, :2]
        assert float(torch.linalg.vector_norm(place.diff(dim=0), dim=1).max()) * 400 <= float(bound[n]) * (1 + 1e-9)


@pytest.mark.parametrize("turn", [0.3, -0.3, 1.5, -1.5, 2.9])
def test_an_arc_follows_a_rotation_at_its_speed(turn):
    """A point turned by up to 2.9 rad to either side of the sharp instant stays on its circle, evenly in time."""

    def place(s):
        angle = 0.4 + turn * (2 * s - 1)
        return torch.tensor([3 + 7 * math.cos(angle), -2 + 7 * math.sin(angle), 5.0], dtype=F64)

    curves = fit_curves(torch.stack([place(s) for s in THREE]).unsqueeze(0), THREE, "arc")
    assert bool(curves.is_arc[0])
    for s in np.linspace(0, 1, 9):
        found = curves.at(torch.tensor([0]), torch.tensor([s], dtype=F64))[0]
        torch.testing.assert_close(found, place(s), rtol=0, atol=1e-9)
    assert float(whole_bound(curves)) == pytest.approx(14 * abs(turn))


def test_points_on_a_line_make_no_arc():
    points = torch.tensor([[[0.0, 0, 1], [1, 2, 1], [3, 6, 1]], [[2.0, 2, 1], [2, 2, 1], [5, 2, 1]]], dtype=F64)
    curves = fit_curves(points, THREE, "arc")
    assert not bool(curves.is_arc.any())
    middle = curves.at(torch.arange(2), torch.full((2,), 0.5, dtype=F64))
    torch.testing.assert_close(middle, points[:, 1], rtol=0, atol=1e-12)


def bar(width_px, length_px, size=64):
    """A white bar of the given width, moving by the given length in one row, alone in its layer."""
    first = size // 2 - width_px // 2
    color, depth = torch.zeros(1, 1, 1, size, dtype=F64), torch.full((1, 3, 1, size), torch.inf, dtype=F64)
    offset = torch.zeros(1, 3, 2, 1, size, dtype=F64)
    color[..., first : first + width_px], depth[..., first : first + width_px] = 1, 1
    offset[:, 0, 0, :, first : first + width_px] = -length_px / 2
    offset[:, 2, 0, :, first : first + width_px] = length_px / 2
    return color, Paths(offset, depth)


def black(size=64):
    return Layer(torch.zeros(1, 1, 1, size, dtype=F64), torch.full((1, 1, 1, size), 2.0, dtype=F64))


@pytest.mark.parametrize(("width_px", "length_px"), [(5, 20), (21, 20), (21, 5), (7, 8)])
def test_weighed_by_time_a_bar_is_as_opaque_as_long_as_it_stays(width_px, length_px):
    """The weight at the trail's centre is min(1, W / L), and elsewhere the time for which the bar is there."""
    blurred = guertin2015(bar(width_px, length_px)[0], bar(width_px, length_px)[1], static=black(), weighting="time")
    assert float(blurred[0, 0, 0, 32]) == pytest.approx(min(1, width_px / length_px), abs=1e-9)
    first = 32 - width_px // 2
    for x in range(64):  # the share of the exposure with the pixel's centre under the bar
        low, high = (x + 0.5 - first - width_px) / length_px, (x + 0.5 - first) / length_px  # displacement / L
        share = max(0.0, min(high, 0.5) - max(low, -0.5))
        assert float(blurred[0, 0, 0, x]) == pytest.approx(share, abs=0.51 / length_px)


@pytest.mark.parametrize(("width_px", "length_px", "share"), [(5, 20, 0.5), (21, 20, 0.8), (21, 5, 0.5)])
def test_as_published_the_share_depends_on_the_count_of_trails_only(width_px, length_px, share):
    """n trails over a pixel make n / (n + w_b), though 1/4, 1 and 1 of the time is spent there."""
    color, paths = bar(width_px, length_px)
    blurred = guertin2015(color, paths, static=black(), lines=Lines(sigma=1e6))
    assert float(blurred[0, 0, 0, 32]) == pytest.approx(share, abs=1e-6)


def test_in_one_pass_the_sharp_object_shows_through():
    color, paths = bar(5, 20)
    depth = torch.where(torch.isinf(paths.depth_view), 2.0, paths.depth_view)
    blurred = guertin2015(color, Paths(paths.offset_px, depth), weighting="time")[0, 0, 0]
    assert float(blurred[32]) == pytest.approx(1)
    assert float(blurred[26]) == pytest.approx(0.25)


def test_trails_go_behind_what_is_nearer():
    color, paths = bar(6, 20)
    nearer = torch.full((1, 1, 1, 64), 3.0, dtype=F64)
    nearer[..., 36:] = 0.5
    static = Layer(torch.full((1, 1, 1, 64), 0.2, dtype=F64), nearer)
    blurred = guertin2015(color, paths, static=static, weighting="time")[0, 0, 0]
    assert float((blurred[36:] - 0.2).abs().max()) == 0
    assert float(blurred[24:36].min()) > 0.25


def test_the_gaussian_weighs_the_middle_of_the_exposure_most():
    color, paths = bar(1, 20)
    blurred = guertin2015(color, paths, static=black(), lines=Lines(sigma=0.2))[0, 0, 0]
    torch.testing.assert_close(blurred[32] / (1 - blurred[32]), torch.tensor(0.2, dtype=F64))  # weight 1 against 5
    end = math.exp(-0.5 * (0.45 / 0.2) ** 2)
    torch.testing.assert_close(blurred[23] / (1 - blurred[23]), torch.tensor(0.2 * end, dtype=F64))


@pytest.mark.parametrize("weighting", ["published", "time"])
@pytest.mark.parametrize("with_static", [False, True])
def test_constant_images_and_still_ones_stay(generator, device, dtype, weighting, with_static):
    paths = random_paths(generator)
    paths = Paths(paths.offset_px.to(device, dtype), paths.depth_view.to(device, dtype))
    color = random_color(generator).to(device, dtype)
    flat = torch.full_like(color, 0.37)
    static = Layer(flat, torch.full_like(flat[:, :1], 5)) if with_static else None
    blurred = guertin2015(flat, paths, static=static, weighting=weighting)
    torch.testing.assert_close(blurred, flat, rtol=0, atol=1e-6)
    there = torch.full_like(paths.depth_view, 2.0)
    for reach in (0.0, 0.25, 0.5):
        offset = torch.zeros_like(paths.offset_px)
        offset[:, 0, 0], offset[:, 2, 0] = -reach, reach
        still = guertin2015(color, Paths(offset, there), static=static, weighting=weighting)
        torch.testing.assert_close(still, color, rtol=0, atol=1e-6)
    assert (blurred.dtype, blurred.device) == (dtype, color.device)


@pytest.mark.parametrize("weighting", ["published", "time"])
def test_an_image_does_not_depend_on_its_batch(generator, weighting):
    color, paths = random_color(generator, 3), random_paths(generator, batch=3)
    together = guertin2015(color, paths, curve="arc", weighting=weighting)
    for b in range(3):
        alone = Paths(paths.offset_px[b : b + 1], paths.depth_view[b : b + 1])
        found = guertin2015(color[b : b + 1], alone, curve="arc", weighting=weighting)
        torch.testing.assert_close(found[0], together[b], rtol=0, atol=1e-13)


def test_many_trails_are_done_in_portions(generator, monkeypatch):
    color, paths = random_color(generator), random_paths(generator)
    for weighting in ("published", "time"):
        whole = guertin2015(color, paths, weighting=weighting)
        with monkeypatch.context() as patch:
            patch.setattr("datagen.baselines.guertin2015.MAX_FRAGMENTS", 7)
            torch.testing.assert_close(guertin2015(color, paths, weighting=weighting), whole, rtol=0, atol=1e-13)


def test_nothing_there_and_far_away_ends_are_no_trouble():
    color = torch.rand(1, 3, 4, 5, dtype=F64)
    empty = Paths(torch.zeros(1, 3, 2, 4, 5, dtype=F64), torch.full((1, 3, 4, 5), torch.inf, dtype=F64))
    torch.testing.assert_close(guertin2015(color, empty), color, rtol=0, atol=1e-15)
    offset = torch.zeros(1, 3, 2, 4, 5, dtype=F64)
    offset[:, 0, 0], offset[:, 2, 0] = -1e9, 1e9
    assert bool(torch.isfinite(guertin2015(color, Paths(offset, torch.ones(1, 3, 4, 5, dtype=F64)))).all())


@pytest.mark.parametrize("weighting", ["published", "time"])
def test_gradients_to_colour(generator, weighting):
    color = random_color(generator, h=5, w=6)[:, :1].clone().requires_grad_()
    paths = random_paths(generator, reach=3.0, h=5, w=6)
    static = Layer(torch.zeros_like(color), torch.ones_like(color))
    assert torch.autograd.gradcheck(lambda c: guertin2015(c, paths, weighting=weighting), (color,))
    assert torch.autograd.gradcheck(lambda c: guertin2015(c, paths, static=static, weighting=weighting), (color,))


def turning_bar(size=48):
    """A bar that turns by 80 degrees in 16 pieces and recedes, before nothing."""
    corner = torch.tensor([[-1.2, -0.35, 0], [1.2, -0.35, 0], [1.2, 0.35, 0], [-1.2, 0.35, 0]], dtype=F64)
    poses = []
    for k in range(17):
        a = math.radians(80 * k / 16 - 40)
        x, y = corner[:, 0], corner[:, 1]
        poses.append(torch.stack([x * math.cos(a) - y * math.sin(a), x * math.sin(a) + y * math.cos(a),
                                  torch.full_like(x, -0.02 * k)], dim=1))  # fmt: skip
    mesh = tb.Mesh(torch.stack(poses), torch.tensor([[0, 1, 2], [0, 2, 3]]), tb.Material((0.9, 0.6, 0.2)))
    camera = tb.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y_deg=45, width=size, height=size, near=0.1, far=20)
    return tb.Scene([mesh], camera, (0.05, 0.1, 0.2))


def test_paths_of_a_scene_lead_to_where_its_points_are():
    scene = turning_bar()
    now = tb.render_instant(scene)
    paths = find_paths(scene, now, FOUR)
    seen = now.mesh_id >= 0
    assert bool(seen.any())
    for k, t in enumerate(FOUR):
        there = torch.zeros_like(now.motion_px) if t == 0.5 else tb.motion_to(now, scene, t)
        torch.testing.assert_close(paths.offset_px[0, k].permute(1, 2, 0), there)
        depth = paths.depth_view[0, k]
        torch.testing.assert_close(depth[seen], torch.full_like(depth[seen], 4 + 0.32 * t), rtol=0, atol=1e-9)
        assert bool(torch.isinf(depth[~seen]).all())
    view, unknown = find_view(scene, now)
    assert unknown == 0
    torch.testing.assert_close(view.motion_px[0].permute(1, 2, 0), now.motion_px)
    assert view.color.shape == (1, 3, 48, 48)
    flat = tb.Camera.orthographic((0, 0, 4), (0, 0, 0), height_world=3, width=8, height=8, near=0.1, far=20)
    other = tb.Scene(scene.meshes, flat)
    with pytest.raises(ValueError, match=r"^scene: expected a perspective camera"):
        find_paths(other, tb.render_instant(other))


def test_points_behind_the_camera_are_left_still_and_counted():
    corner = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]], dtype=F64)
    motion = torch.stack([corner + torch.tensor([0.0, 0, z], dtype=F64) for z in (0.0, 0.0, 9.0)])
    camera = tb.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y_deg=60, width=12, height=12, near=0.1, far=20)
    scene = tb.Scene([tb.Mesh(motion, torch.tensor([[0, 1, 2]]))], camera)
    now = tb.render_instant(scene)
    view, unknown = find_view(scene, now)
    assert unknown == int((now.mesh_id >= 0).sum()) > 0
    assert float(view.motion_px.abs().max()) == 0
    assert not bool(find_paths(scene, now).is_moving.any())


def test_by_time_on_arcs_before_a_static_layer_a_turning_bar_is_nearly_exact():
    """Nothing is hidden here, so all that is wrong is that whole pixels are scattered; straight lines do worse."""
    scene = turning_bar()
    exact = tb.render(scene).rgba[..., :3]
    now = tb.render_instant(scene)
    view, _ = find_view(scene, now)
    paths = find_paths(scene, now)
    h, w = now.mesh_id.shape
    back = torch.tensor([0.05, 0.1, 0.2], dtype=F64)[None, :, None, None].expand(1, 3, h, w)
    static = Layer(back, torch.full((1, 1, h, w), torch.inf, dtype=F64))
    ends = paths.offset_px[:, 2] - paths.offset_px[:, 0]
    line = Paths(torch.stack([-0.5 * ends, 0 * ends, 0.5 * ends], dim=1), paths.depth_view)

    def error(*arguments, **options):
        return float((guertin2015(*arguments, **options)[0].permute(1, 2, 0) - exact).square().mean().sqrt())

    arc = error(view.color, paths, static=static, curve="arc", weighting="time")
    assert arc < 0.02
    assert error(view.color, paths, static=static, weighting="time") < 1.5 * arc
    assert error(view.color, line, static=static, weighting="time") > 2 * arc
    assert error(view.color, paths, static=static) > 2 * arc
    assert error(view.color, paths, weighting="time") > 2 * arc


GOOD = {"color": torch.rand(2, 3, 5, 6), "paths": Paths(torch.zeros(2, 3, 2, 5, 6), torch.ones(2, 3, 5, 6))}


@pytest.mark.parametrize(
    ("name", "given", "error"),
    [
        ("color", {"color": torch.rand(3, 5, 6)}, ValueError),
        ("color", {"color": torch.full((2, 3, 5, 6), torch.nan)}, ValueError),
        ("depth_view", {"color": torch.rand(2, 3, 5, 7)}, ValueError),
        ("depth_view", {"color": torch.rand(2, 3, 5, 6, dtype=F64)}, TypeError),
        ("paths", {"paths": torch.zeros(2, 3, 2, 5, 6)}, TypeError),
        ("curve", {"curve": "spline"}, ValueError),
        ("weighting", {"weighting": "uniform"}, ValueError),
        ("lines", {"weighting": "time", "lines": Lines()}, ValueError),
        ("lines", {"lines": 11}, ValueError),
        ("static", {"static": torch.rand(2, 3, 5, 6)}, TypeError),
        ("static", {"static": Layer(torch.rand(1, 3, 5, 6), torch.ones(1, 1, 5, 6))}, ValueError),
    ],
)
def test_wrong_arguments_are_refused_by_name(name, given, error):
    arguments = GOOD | given
    with pytest.raises(error, match=f"^{name}: expected .*, got "):
        guertin2015(arguments.pop("color"), arguments.pop("paths"), **arguments)


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("times", lambda: Paths(torch.zeros(1, 3, 2, 5, 6), torch.ones(1, 3, 5, 6), (0.0, 0.4, 1.0))),
        ("times", lambda: Paths(torch.zeros(1, 3, 2, 5, 6), torch.ones(1, 3, 5, 6), (1.0, 0.5, 0.0))),
        ("times", lambda: Paths(torch.zeros(1, 2, 2, 5, 6), torch.ones(1, 2, 5, 6), (0.0, 0.5))),
        (r"times\[2\]", lambda: Paths(torch.zeros(1, 3, 2, 5, 6), torch.ones(1, 3, 5, 6), (0.0, 0.5, 2.0))),
        ("offset_px", lambda: Paths(torch.zeros(1, 4, 2, 5, 6), torch.ones(1, 3, 5, 6))),
        ("offset_px", lambda: Paths(torch.ones(1, 3, 2, 5, 6), torch.ones(1, 3, 5, 6))),
        ("offset_px", lambda: Paths(torch.full((1, 3, 2, 5, 6), torch.nan), torch.ones(1, 3, 5, 6))),
        ("depth_view", lambda: Paths(torch.zeros(1, 3, 2, 5, 6), torch.ones(1, 1, 5, 6))),
        ("depth_view", lambda: Paths(torch.zeros(1, 3, 2, 5, 6), -torch.ones(1, 3, 5, 6))),
        ("points", lambda: Lines(points=1)),
        ("background_weight", lambda: Lines(background_weight=0.0)),
        ("sigma", lambda: Lines(sigma=-1.0)),
        ("depth_view", lambda: Layer(torch.rand(1, 3, 5, 6), torch.ones(1, 5, 6))),
    ],
)
def test_wrong_parts_are_refused_by_name(name, make):
    with pytest.raises((TypeError, ValueError), match=f"^{name}: expected .*, got "):
        make()


@pytest.mark.parametrize(("times", "curve"), [(THREE, "bezier"), (THREE, "arc"), (FOUR, "bezier")])
def test_speeds_stay_below_their_bound_in_each_piece(generator, times, curve):
    curves = fit_curves(20 * torch.rand(200, len(times), 3, generator=generator, dtype=F64), times, curve)
    which = torch.arange(200)
    start, end = torch.sort(torch.rand(2, 200, generator=generator, dtype=F64), dim=0).values
    bound, seen = curves.speed_bound(which, start, end), torch.zeros(200, dtype=F64)
    for k in range(64):
        a, b = (start + (end - start) * (k + n) / 64 for n in (0, 1))
        moved = (curves.at(which, b) - curves.at(which, a))[:, :2].norm(dim=1)
        assert (moved <= bound * (b - a) * (1 + 1e-9) + 1e-12).all()
        seen = torch.maximum(seen, moved / (b - a))
    assert (bound <= 4.0 * seen).all()  # about the speed itself, but for the bend of a cubic


@pytest.mark.parametrize("curve", ["bezier", "arc"])
def test_what_moves_far_outside_adds_the_time_that_it_spends_inside(curve):
    """Points that come from far away: the whole way is not sampled, but what is inside of the image is, evenly."""
    reach = 60_000.0
    offset = torch.zeros(1, 3, 2, 1, 9, dtype=F64)
    offset[0, 0, 0], offset[0, 2, 0], offset[0, 2, 1] = -reach, 3.0, 1e-3
    depth = torch.full((1, 3, 1, 9), torch.inf, dtype=F64)
    depth[..., 4] = 1.0
    color = torch.ones(1, 1, 1, 9, dtype=F64)
    color[..., 4] = 5.0
    seen = guertin2015(color, Paths(offset * torch.isfinite(depth).unsqueeze(2), depth), curve=curve, weighting="time")
    points = torch.cat([offset[0, :, :, 0, 4] + torch.tensor([4.5, 0.5]), torch.ones(3, 1, dtype=F64)], 1).unsqueeze(0)
    t = (torch.arange(4_000_000, dtype=F64) + 0.5) / 4_000_000
    place = fit_curves(points, THREE, curve).at(torch.zeros(len(t), dtype=torch.int64), t)
    inside = (place[:, 0] >= 0) & (place[:, 0] < 9) & (place[:, 1] >= 0) & (place[:, 1] < 1)
    share = torch.bincount(place[inside, 0].long(), minlength=9) / len(t)
    others = [0, 1, 2, 3, 5, 6, 7, 8]  # its own pixel has its colour anyway
    added, wanted = (seen[0, 0, 0, others] - 1) / 4, share[others].to(F64)
    assert float(added.sum()) == pytest.approx(float(wanted.sum()), rel=0.05)
    assert ((added / wanted - 1).abs() < 0.6).all()  # of 2 samples a pixel or so


@pytest.mark.parametrize("curve", ["bezier", "arc"])
def test_motion_of_any_length_takes_no_time(generator, curve):
    began = time.process_time()
    for reach in (1e6, 1e12, 1e30):
        paths = random_paths(generator, reach=reach)
        assert torch.isfinite(guertin2015(random_color(generator), paths, curve=curve, weighting="time")).all()
    assert time.process_time() - began < 60
