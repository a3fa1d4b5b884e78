"""The shadow methods of the papers: their known faults are there, and nothing else is wrong with them."""

from __future__ import annotations

import dataclasses

import lit_scenes as lit
import numpy as np
import pytest
import scene_makers as make
import torch
from oracle_looks import LookMesh, LookScene
from oracle_shadows import instant_with_shadows, mean_with_shadows, midpoints

import torchblur as tb
from datagen.baselines.shadow_maps import rasterise, view_from_light
from datagen.baselines.shadow_rays import trace_shadows
from datagen.baselines.shadow_samples import gather_faces
from datagen.baselines.shadows_hong2018 import (
    build_patches,
    build_range_map,
    cross_edges,
    pair_fragments,
    render_hong2018,
)
from datagen.baselines.shadows_tsm import render_tsm

FLOOR = np.array([[-5.0, -1.5, 5], [5, -1.5, 5], [5, -1.5, -5], [-5, -1.5, -5]])
TWO = [[0, 1, 2], [0, 2, 3]]
LAMPS = {
    "point": lit.point((0.5, 4, 1), 50.0),
    "spot": lit.spot((0.5, 4, 1), (0, -1, 0), 50.0, (30, 55)),
    "sun": lit.sun((0.2, -1, 0.1), 3.0),
}
TEXEL_BIAS = 0.05  # covers the slope of surfaces within a texel of the maps below


def seeded(seed: int = 3) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def ball_over_floor(lamp, travel=1.2, size=32) -> LookScene:
    vertices, faces = lit.ball(n_around=8)
    half = np.array([travel / 2, 0, 0])
    ball = LookMesh(np.stack([vertices * 0.6 - half, vertices * 0.6 + half]), faces, color=(0.9, 0.5, 0.3))
    matrix = make.perspective((0.3, 3, 6))
    return LookScene([ball, LookMesh(FLOOR, TWO)], matrix, size, size, lights=[lamp], ambient=(0.1, 0.1, 0.1))


def rising_plate(speed: float) -> LookScene:
    """A level plate that rises towards a sun overhead, seen from above."""
    plate = np.array([[-3.1, -3, -0.8], [3, -3.3, -0.8], [3.2, 3, -0.8], [-3, 3.6, -0.8]])
    mesh = LookMesh(np.stack([plate, plate + [[0, 0, speed]] * 4]), TWO)
    return LookScene([mesh], lit.UPRIGHT, 16, 16, lights=[lit.sun((0, 0, -1), 2.0)])


def rmse(got: torch.Tensor, want: np.ndarray) -> float:
    return float(np.sqrt(((got.numpy() - want) ** 2).mean()))


def both(scene: tb.Scene, n: int, size_px: int, seed: int = 3):
    options = {"size_px": size_px, "bias": TEXEL_BIAS}
    return {
        "hong2018": render_hong2018(scene, n_samples=n, generator=seeded(seed), **options),
        "tsm": render_tsm(scene, n_layers=n, generator=seeded(seed), **options),
    }


@pytest.mark.parametrize("kind", LAMPS)
def test_shadow_rays_are_those_of_the_oracle(kind):
    plain = ball_over_floor(LAMPS[kind], size=24)
    got, want = trace_shadows(lit.to_torch(plain), n_subframes=7), mean_with_shadows(plain, midpoints(7))
    assert want.visibility.min() < 0.5
    assert got.rgba.numpy() == pytest.approx(want.rgba, abs=1e-12)
    assert got.visibility.numpy() == pytest.approx(want.visibility, abs=1e-12)


@pytest.mark.parametrize("name", ["spinning_box", "smooth_ball"])
def test_shadow_rays_on_turning_bodies(name):
    plain = lit.SCENES[name]()
    still = [dataclasses.replace(k, position=np.atleast_2d(k.position)[0]) for k in plain.lights[-1:]]
    plain = dataclasses.replace(plain, lights=still)
    got, want = trace_shadows(lit.to_torch(plain), n_subframes=9), mean_with_shadows(plain, midpoints(9))
    assert got.rgba.numpy() == pytest.approx(want.rgba, abs=1e-12)


@pytest.mark.parametrize("kind", LAMPS)
def test_where_nothing_moves_only_texels_are_lost(kind):
    plain = ball_over_floor(LAMPS[kind], travel=0.0, size=64)
    want = instant_with_shadows(plain, 0.5)
    assert 0.01 < (want.visibility < 0.5).mean() < 0.5
    wrong = {}
    for size_px in (48, 384):
        for name, got in both(lit.to_torch(plain), 2, size_px).items():
            wrong[name, size_px] = float(np.abs(got.visibility.numpy() - want.visibility).mean())
    for name in ("hong2018", "tsm"):
        assert wrong[name, 384] < 0.006
        assert wrong[name, 384] < wrong[name, 48] / 2


@pytest.mark.parametrize("kind", LAMPS)
def test_more_samples_come_closer(kind):
    plain = ball_over_floor(LAMPS[kind], size=24)
    want = mean_with_shadows(plain, midpoints(100))
    scene = lit.to_torch(plain)
    few, many = both(scene, 4, 384), both(scene, 48, 384)
    for name in ("hong2018", "tsm"):
        assert rmse(few[name].rgba, want.rgba) > 2 * rmse(many[name].rgba, want.rgba)
        assert rmse(few[name].visibility, want.visibility) > 2 * rmse(many[name].visibility, want.visibility)
        assert rmse(many[name].visibility, want.visibility) < 0.02


def test_tsm_shades_itself_below_a_bias_of_speed_over_layers_and_not_above():
    speed, n = 1.6, 8
    scene = lit.to_torch(rising_plate(speed))
    low, high = (
        render_tsm(scene, n_layers=n, size_px=32, bias=share * speed / n, generator=seeded()) for share in (0.3, 1.0)
    )
    assert float(low.visibility.mean()) < 0.95
    assert float(low.visibility.min()) < 0.8
    assert (high.visibility == 1).all()


def test_hong2018_and_rays_do_not_shade_the_rising_plate():
    scene = lit.to_torch(rising_plate(1.6))
    assert (render_hong2018(scene, n_samples=8, size_px=32, bias=1e-9, generator=seeded()).visibility == 1).all()
    assert (trace_shadows(scene, n_subframes=8).visibility == 1).all()


def test_hong2018_pairs_four_fragments_by_depth():
    time, depth = torch.tensor([0.6, 0.1, 0.8, 0.3]), torch.tensor([3.0, 5.0, 4.0, 2.0])
    first, second = pair_fragments(torch.zeros(4, dtype=torch.int64), depth)
    ranges = {
        tuple(sorted((round(float(time[a]), 3), round(float(time[b]), 3)))) for a, b in zip(first, second, strict=True)
    }
    assert ranges == {(0.3, 0.6), (0.1, 0.8)}  # the face is there in [.1, .3] and [.6, .8]


def test_hong2018_pairs_only_twos_and_fours():
    owner = torch.tensor([7, 3, 3, 9, 9, 9, 5, 5, 5, 5, 3 + 8])
    depth = torch.tensor([1.0, 2, 1, 1, 2, 3, 4, 1, 3, 2, 0])
    first, second = pair_fragments(owner, depth)
    assert sorted(zip(first.tolist(), second.tolist(), strict=True)) == [(2, 1), (7, 9), (8, 6)]


def test_equation_1_as_printed_is_the_negative_of_the_truth():
    a, b, c, d = torch.randn(4, 1000, 2, dtype=torch.float64, generator=seeded())
    s, u = cross_edges(a, b, c, d)
    torch.testing.assert_close(a + s[:, None] * (b - a), c + u[:, None] * (d - c), rtol=1e-7, atol=1e-7)

    def pdp(v, w):
        return v[:, 0] * w[:, 1] - v[:, 1] * w[:, 0]

    area = pdp(b - a, d - c)
    torch.testing.assert_close(pdp(d - c, c - a) / area, -s)
    torch.testing.assert_close(pdp(b - a, c - a) / area, -u)


def patch_times(q, q_end, p_end=(0.0, 0.0)):
    """Return the patches' and the true times at which the edge (0, 0) q, ending as p_end q_end, passes texels."""

    def place(xy):
        return torch.tensor([*xy, 1.0, 1.0], dtype=torch.float64)

    far = (-50.0, -60.0)  # the third corner, out of view, and its edges behind the first
    prisms = torch.stack([torch.stack([place(k) for k in ends]) for ends in (((0, 0), q, far), (p_end, q_end, far))])
    patches = build_patches(prisms.unsqueeze(1))
    side = slice(2, 6)  # after the two faces come the four of the first edge
    scene = lit.to_torch(rising_plate(1.0))
    views = view_from_light(scene, gather_faces(scene), 256)
    found = rasterise(views, patches.corners[side], torch.zeros(4, dtype=torch.int64))
    time = (found.bary * patches.time[side][found.triangle]).sum(1)
    x = 2 * (found.texel % 256 + 0.5) / 256 - 1
    y = 1 - 2 * (found.texel // 256 + 0.5) / 256
    return time.numpy(), x.numpy(), y.numpy()


def test_hong2018_patches_mistake_the_time_of_a_pivoting_edge_by_up_to_half_the_exposure():
    q, q_end = np.array([0.9, 0.1]), np.array([0.2, 0.9])
    time, x, y = patch_times(q, q_end, (q_end - q) * 1e-9)  # what rests exactly counts as a crossing
    before, after = (
        q[0] * y - q[1] * x,
        q_end[0] * y - q_end[1] * x,
    )  # the edge passes where (q + t (q' - q)) x (x, y) = 0
    error = np.abs(time - before / (before - after))
    assert 0.45 < error.max() < 0.501
    assert 0.02 < error.mean() < 0.2


def test_hong2018_patches_are_exact_where_an_edge_is_only_displaced():
    q, shift = np.array([0.7, 0.1]), np.array([-0.2, 0.6])
    time, x, y = patch_times(q, q + shift, shift)
    true = (q[0] * y - q[1] * x) / (q[0] * shift[1] - q[1] * shift[0])
    assert np.abs(time - true).max() < 1e-12


def test_hong2018_makes_two_triangles_of_edges_that_cross_and_four_of_others():
    corners = torch.tensor([[-0.5, -0.4, 1, 1], [0.5, -0.4, 1, 1], [0, 0.5, 1, 1]], dtype=torch.float64)
    upside_down = corners * torch.tensor([-1.0, -1, 1, 1])
    for end, n_crossing in ((corners + torch.tensor([0.1, 0.3, 0, 0]), 0), (upside_down.roll(1, 0), 3)):
        patches = build_patches(torch.stack([corners, end]).unsqueeze(1))
        assert len(patches.prism) == 14 - 2 * n_crossing


@pytest.mark.parametrize("turned", [False, True])
def test_hong2018_drops_faces_whose_back_is_to_the_light(turned):
    plate = np.array([[-1.0, 0, 1], [1, 0, 1], [1.1, 0, -1], [-1, 0, -1.2]])
    faces = np.array(TWO)[:, ::-1] if turned else np.array(TWO)
    plain = LookScene(
        [LookMesh(plate, faces), LookMesh(FLOOR, TWO)],
        make.perspective((0, 3, 6)),
        24,
        24,
        lights=[lit.spot((0, 4, 0), (0, 0, 0), 30.0, (50, 60))],
    )
    assert instant_with_shadows(plain, 0.5).visibility.min() == 0
    got = render_hong2018(lit.to_torch(plain), n_samples=2, size_px=128, bias=1e-6, generator=seeded())
    assert float(got.visibility.min()) == (1.0 if turned else 0.0)


def test_memory_is_counted_as_in_the_paper():
    scene = lit.to_torch(ball_over_floor(LAMPS["spot"], size=8))
    hong, tsm = (both(scene, 5, 32)[name] for name in ("hong2018", "tsm"))
    counts = hong.counts
    assert hong.n_bytes == 16 * counts["fragments"] + 24 * counts["ranges"] + 2 * 32 * 32 * 4
    assert counts["fragments"] == 2 * counts["ranges"] + counts["unpaired"]
    assert tsm.n_bytes == 5 * 4 * 32 * 32


def test_several_pieces_of_motion_are_as_many_prisms():
    vertices, faces = lit.ball(n_around=6)
    way = np.array([[-1.0, 0, 0], [0, 0.3, 0], [0.2, 0, 0.5]])
    ball = LookMesh(vertices * 0.5 + way[:, None], faces)
    plain = LookScene([ball, LookMesh(FLOOR, TWO)], make.perspective((0.3, 3, 6)), 24, 24, lights=[LAMPS["sun"]])
    scene = lit.to_torch(plain)
    moving = gather_faces(scene)
    found = build_range_map(view_from_light(scene, moving, 64), moving)
    assert set(found.time[found.face < len(faces)].flatten().tolist()) >= {0.0, 0.5, 1.0}
    assert (found.time[:, 0] <= found.time[:, 1]).all()
    assert -1e-12 < float(found.time.min()) < float(found.time.max()) < 1 + 1e-12
    want = mean_with_shadows(plain, midpoints(200))
    got = render_hong2018(scene, n_samples=64, size_px=256, bias=TEXEL_BIAS, generator=seeded())
    assert rmse(got.visibility, want.visibility) < 0.03


def test_the_seed_decides():
    scene = lit.to_torch(ball_over_floor(LAMPS["sun"], size=12))
    one, again, other = both(scene, 3, 64, 1), both(scene, 3, 64, 1), both(scene, 3, 64, 2)
    for name in one:
        assert torch.equal(one[name].rgba, again[name].rgba)
        assert not torch.equal(one[name].rgba, other[name].rgba)


def test_what_the_methods_cannot_do_is_refused():
    plain = ball_over_floor(LAMPS["sun"], size=4)
    scene = lit.to_torch(plain)
    options = {"size_px": 8, "bias": 0.0, "generator": seeded()}
    wide = dataclasses.replace(plain, lights=[lit.spot((0, 4, 0), (0, 0, 0), 3.0, (20, 85))])
    moving = dataclasses.replace(plain, lights=[lit.sun(np.array([[0, -1.0, 0], [0.1, -1, 0]]))])
    glass = dataclasses.replace(plain, meshes=[dataclasses.replace(plain.meshes[0], opacity=0.5)])
    two = dataclasses.replace(plain, lights=plain.lights * 2)
    for bad, name in ((wide, "outer_angle_deg"), (moving, "lights"), (glass, "opacity"), (two, "lights")):
        with pytest.raises(ValueError, match=f"{name}.*: expected"):
            render_hong2018(lit.to_torch(bad), n_samples=2, **options)
    with pytest.raises(TypeError, match="scene: expected"):
        render_tsm(plain, n_layers=2, **options)
    with pytest.raises(ValueError, match="n_layers: expected"):
        render_tsm(scene, n_layers=0, **options)
    with pytest.raises(ValueError, match="n_samples: expected"):
        render_hong2018(scene, n_samples=0, **options)
    with pytest.raises(ValueError, match="n_subframes: expected"):
        trace_shadows(scene, n_subframes=0)
    with pytest.raises(ValueError, match="size_px: expected"):
        render_tsm(scene, n_layers=2, **(options | {"size_px": 0}))
    with pytest.raises(ValueError, match="bias: expected"):
        render_tsm(scene, n_layers=2, **(options | {"bias": -1.0}))
