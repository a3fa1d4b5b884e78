"""Shadows against closed forms and against brute-force shadow rays; laws that they must keep."""

from __future__ import annotations

import dataclasses
import math

import lit_scenes as lit
import numpy as np
import pytest
import scene_makers as make
import torch
from oracle_looks import LookMesh, LookScene
from oracle_shadows import instant_with_shadows, mean_with_shadows, midpoints

import torchblur as tb
from torchblur import light_bends, nodes, shadow_pairs, shadows

FLOOR = np.array([[-5.0, -5, -1], [5, -5, -1], [5, 6, -1], [-5, 6, -1]])  # its diagonal misses the centre
TWO = [[0, 1, 2], [0, 2, 3]]
SUN = lit.sun((0, 0, -1), math.pi)
LAMPS = {
    "sun": SUN,
    "point": lit.point((0, 0, 3), 16 * math.pi),
    "spot": lit.spot((0, 0, 3), (0, 0, -1), 16 * math.pi),
}


def floor(corners=FLOOR, **material) -> LookMesh:
    return LookMesh(np.asarray(corners, dtype=float), TWO, color=(1.0, 1.0, 1.0), **material)


def caster(corners, faces=TWO, **material) -> LookMesh:
    """Return a mesh turned so that only its back is there for a viewer above: it casts, and is not seen."""
    faces = np.asarray(faces)[:, ::-1].copy()
    return LookMesh(np.asarray(corners, dtype=float), faces, double_sided=False, **material)


def slab(x0, x1, z=0.5, shift=(0.0, 0.0, 0.0), **material) -> LookMesh:
    """Return a rectangle x0..x1 at height z that moves by `shift`."""
    corners = np.array([[x0, -4, z], [x1, -4, z], [x1, 5, z], [x0, 5, z]], dtype=float)
    return caster(np.stack([corners, corners + shift]), **material)


def from_above(meshes, lights, n=1, **options) -> LookScene:
    return LookScene(meshes, lit.UPRIGHT, n, n, lights=lights, **options)


def render(plain: LookScene, dtype=torch.float64, **options) -> tb.Frame:
    return tb.render(lit.to_torch(plain, dtype, casts_shadows=True), **options)


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("accuracy", ["exact", "linear"])
@pytest.mark.parametrize("alpha", [1.0, 0.3])
@pytest.mark.parametrize("kind", list(LAMPS))
def test_a_caster_takes_its_opacity_of_the_light_while_it_is_between(kind, alpha, accuracy, dtype):
    """Case 22: the lit share of a still receiver is 1 - (t2 - t1)."""
    moving = slab(-0.375, -0.125, shift=(1.0, 0, 0), opacity=alpha)  # at x = 0 from t = 1/8 to 3/8
    frame = render(from_above([floor(), moving], [LAMPS[kind]]), dtype)
    share = 1 - 0.25 * alpha
    assert frame.rgba[0, 0, :3].tolist() == pytest.approx([share] * 3, abs=1e-12 if dtype == torch.float64 else 1e-6)
    assert float(frame.shadow) == pytest.approx(share, abs=1e-12 if dtype == torch.float64 else 1e-6)
    if accuracy == "linear":
        whole = render(from_above([floor(), moving], [LAMPS[kind]]), dtype, accuracy=tb.Accuracy.linear())
        assert float(whole.shadow) in (1.0, pytest.approx(1 - alpha))  # the middle of the exposure stands for it


def test_times_pair_by_time():
    """Case 24: a mesh blocks the light from .1 to .3 and from .6 to .8, at the depths 5, 2 and 3, 4."""
    across = np.array([2.0, 1, 0, 1, 2, 2, 1, 0, 1, 2, 2])  # half-widths beside x = 0, at knots of a tenth
    height = 4 - 0.5 * np.array([5.0, 5, 3.5, 2, 2.5, 2.8, 3, 3.5, 4, 4, 4])
    corners = np.array([[-1.0, -4, 0], [1, -4, 0], [1, 5, 0], [-1, 5, 0]])
    knots = np.stack([corners + np.array([x, 0, z]) for x, z in zip(across, height, strict=True)])
    scene = from_above([floor(), caster(knots)], [lit.sun((0, 0, -1), math.pi)])
    assert float(render(scene).shadow) == pytest.approx(0.6, abs=1e-12)
    windows = [(0.0, 0.1), (0.1, 0.3), (0.3, 0.6), (0.6, 0.8), (0.8, 1.0), (0.05, 0.15)]
    got = [float(render(scene, shutter=tb.Shutter.box(*w)).shadow) for w in windows]
    assert got == pytest.approx([1, 0, 1, 0, 1, 0.5], abs=1e-11)


def test_an_edge_that_pivots_passes_at_its_own_time():
    """Case 24: the ray from the floor is passed when the fixed end, the moving end and the ray are in line."""
    for seed in range(20):
        generator = np.random.default_rng(seed)
        fixed = generator.uniform(-2, -0.5, 2)
        first, last = np.array([3.0, -3 - generator.uniform()]), np.array([1 + generator.uniform(), 5.0])
        slope = np.cross(np.append(fixed, 0), np.append(last - first, 0))[2]
        t = -np.cross(np.append(fixed, 0), np.append(first, 0))[2] / slope
        assert 0 < t < 1
        corners = [np.array([[*fixed, 30], [*end, 30], [9.0, -9, 30]]) for end in (first, last)]  # out of view
        scene = from_above([floor(), caster(np.stack(corners), [[0, 1, 2]])], [SUN])
        assert float(render(scene).shadow) == pytest.approx(t, abs=1e-12)


@pytest.mark.parametrize("kind", list(LAMPS))
def test_caster_and_receiver_that_move_together_keep_their_shadow(kind):
    """Case 22, with the light moving along, too."""
    shift = np.array([0, 0, 0.7])
    lamp = LAMPS[kind]
    if kind != "sun":
        ends = {k: np.array([np.add(getattr(lamp, k), d) for d in (0, shift)]) for k in ("position", "target")}
        lamp = dataclasses.replace(lamp, **ends)
    scene = from_above([floor(np.stack([FLOOR, FLOOR + shift])), slab(-0.3, 0.1, shift=shift)], [lamp], n=16)
    got = render(scene).shadow
    assert got.numpy() == pytest.approx(instant_with_shadows(scene, 0.0).visibility, abs=1e-12)
    assert 0 < float(got.mean()) < 1


@pytest.mark.parametrize("lamp", [lit.point((0.3, 0.1, 4), 9.0), lit.sun((0.3, 0.2, -1))], ids=["point", "sun"])
def test_a_plane_that_rises_towards_the_light_never_shades_itself(lamp, dtype):
    """Case 23."""
    start = np.array([[-5, -5, -0.9], [5, -5, -0.5], [5, 5, -0.4], [-5, 5, -0.8]])  # not flat: two faces
    for rise in (0.3, 3.0):
        scene = from_above([floor(np.stack([start, start + np.array([0, 0, rise])]))], [lamp], n=24)
        assert (render(scene, dtype).shadow == 1).all()


def test_shadows_of_two_glasses_multiply_at_each_time():
    glasses = [slab(-1.125, -0.125, z=z, shift=(1.0, 0, 0), opacity=a) for z, a in ((0.2, 0.5), (0.4, 0.25))]
    glasses[1].vertices -= [0.25, 0, 0]  # over x = 0 from 1/8, and from 3/8
    got = float(render(from_above([floor(), *glasses], [SUN])).shadow)
    assert got == pytest.approx(1 / 8 + 0.5 * 2 / 8 + 0.5 * 0.75 * 5 / 8, abs=1e-12)


def test_light_that_passes_a_textured_glass_keeps_what_the_texture_lets_through():
    """The glass slides by: at time t the ray meets u = t, whose opacity is t."""
    texture = np.zeros((1, 2, 4))
    texture[..., 3] = [0.0, 1.0]  # from u = 1/4 to u = 3/4 the opacity rises from 0 to 1
    corners = np.array([[-1.0, -4, 0], [0, -4, 0], [0, 5, 0], [-1, 5, 0]])
    mesh = caster(corners + np.array([[[1.0, 0, 0]], [[0, 0, 0]]]))
    mesh = dataclasses.replace(
        mesh, texture=texture, wrap="clamp", mipmap=False, uv=lit.square_uv([[0, 0], [1, 0], [1, 1], [0, 1]])[:, ::-1]
    )
    got = float(render(from_above([floor(), mesh], [SUN])).shadow)
    assert got == pytest.approx(0.5, abs=1e-4)
    early = float(render(from_above([floor(), mesh], [SUN]), shutter=tb.Shutter.box(0.25, 0.5)).shadow)
    assert early == pytest.approx(0.75, abs=1e-4)


def test_what_the_camera_does_not_see_casts_too():
    shift = (4.0, 0, 0)
    for height in (0.5, 30.0):  # NDC z of 30 lies before the near plane
        scene = from_above([floor(), slab(-2.5, -1.5, z=height, shift=shift)], [SUN])
        assert float(render(scene).shadow) == pytest.approx(0.75, abs=1e-12)


def test_only_lights_that_cast_do_and_each_has_its_own_shadow():
    plain = from_above([floor(), slab(-9, 9)], [SUN, lit.point((0, 0, 0.2), 1.44 * 3 * math.pi)])
    scene = lit.to_torch(plain, casts_shadows=True)
    assert float(tb.render(scene).shadow) == pytest.approx(0.75, abs=1e-12)  # the lamp hangs below the slab
    off = [dataclasses.replace(light, casts_shadows=k == 1) for k, light in enumerate(scene.lights)]
    assert float(tb.render(dataclasses.replace(scene, lights=off)).shadow) == 1
    none = [dataclasses.replace(light, casts_shadows=False) for light in scene.lights]
    assert tb.render(dataclasses.replace(scene, lights=none)).shadow is None


def test_no_light_is_due_on_what_is_unlit_or_turned_away():
    for meshes, lamp in (([floor(shading="unlit"), slab(-1, 1)], SUN), ([floor(), slab(-1, 1)], lit.sun((0, 0, 1)))):
        frame = render(from_above(meshes, [lamp]))
        assert frame.shadow is None or float(frame.shadow) == 1
        assert float(frame.rgba[..., 3]) == 1


# -- brute force -------------------------------------------------------------------------------------------------------


def moving_lamps() -> LookScene:
    """A ball and a glass plate that move over a floor and a wall, under three lights that move, too."""
    vertices, faces = lit.ball(radius=0.35)
    turned = make.rotated(vertices, 0.8, 1, make.rotation_y)
    ball = LookMesh(turned + np.array([[[-0.4, 0.1, 0.2]], [[0.5, -0.1, 0.3]]]), faces, color=(0.9, 0.5, 0.3))
    start = np.array([[-0.5, -0.4, 0.6], [0.3, -0.5, 0.8], [0.4, 0.3, 0.7], [-0.4, 0.4, 0.5]])
    plate = LookMesh(start + np.array([[[0.0, 0, 0]], [[0.2, 0.5, -0.2]], [[0.6, 0.3, 0]]]), TWO, opacity=0.4)
    ground = floor([[-2, -1.5, -0.6], [2, -1.6, -0.7], [1.9, 1.5, -0.5], [-2.1, 1.6, -0.6]])
    wall = LookMesh([[-2, 0.9, -1], [2, 0.8, -1], [2, 0.9, 2], [-2, 1, 2]], TWO, color=(0.5, 0.6, 0.9))
    lights = [
        lit.point(np.array([[0.3, -0.4, 2.0], [-0.2, 0.1, 1.6], [0.1, 0.3, 1.9]]), 9.0),
        lit.sun(np.array([[0.3, 0.2, -1], [-0.2, 0.4, -1]]), 1.5),
        lit.spot(np.array([[-1.0, -0.5, 2], [-0.8, -0.3, 2.2]]), (0, 0, 0), 12.0, (15, 30)),
    ]
    matrix = make.perspective((0.4, -1.8, 3.2), (0, 0, 0), fov_deg=34.0, aspect=1.2)
    return LookScene(
        [ground, wall, ball, plate], matrix, 12, 10, lit.BACKGROUND, lights=lights, ambient=(0.05, 0.1, 0.1)
    )


SCENES = {**lit.SCENES, "moving_lamps": moving_lamps}
TEXTURED = ("lit_texture", "flight", "leaving_plate")  # which the shadow oracle does not look up


@pytest.mark.parametrize("name", [n for n in SCENES if n not in TEXTURED])
def test_instants_are_the_oracle(name):
    plain = SCENES[name]()
    scene = lit.to_torch(plain, casts_shadows=True)
    for t in (0.137, 0.5, 0.71, 1.0):
        got = tb.render_instant(scene, t=t).rgba.numpy()
        assert got == pytest.approx(instant_with_shadows(plain, t).rgba, abs=1e-9)


@pytest.mark.parametrize("name", [n for n in SCENES if n not in TEXTURED])
def test_the_oracle_converges_to_the_render(name):
    """Sub-frames miss each edge by up to half a step: their distance is a bound times 1 / N, and falls so."""
    plain = SCENES[name]()
    frame = render(plain)
    distance = {}
    for n in (32, 256):
        brute = mean_with_shadows(plain, midpoints(n))
        distance[n] = np.abs(frame.rgba.numpy() - brute.rgba)
        brightest = max(1.0, float(brute.rgba.max()), float(frame.rgba.max()))
        assert distance[n].max() <= 6 * brightest / n
        assert frame.shadow.numpy() == pytest.approx(brute.visibility, abs=12 / n)
    assert distance[256].mean() < distance[32].mean() / 4 + 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_random_scenes_are_the_oracle(seed):
    for k in range(6):
        generator = np.random.default_rng(100 * seed + k)
        soup = make.random_triangles(
            generator, 12, size=0.9, n_segments=1 + k % 2, opacity=generator.choice([1.0, 0.5], 12)
        )
        mesh = LookMesh(soup.vertices, soup.faces, color=soup.color, opacity=soup.opacity)
        lamp = [lit.point, lit.sun][k % 2]
        place = generator.normal(size=(2, 3)) + np.array([0, 0, 2.5 if k % 2 == 0 else -2.5])
        plain = LookScene([mesh], lit.UPRIGHT, 8, 8, lights=[lamp(place if k % 3 else place[0], 3.0)])
        scene = lit.to_torch(plain, casts_shadows=True)
        for t in generator.uniform(0, 1, 3):
            assert tb.render_instant(scene, t=t).rgba.numpy() == pytest.approx(
                instant_with_shadows(plain, t).rgba, abs=1e-9
            )
        n = 256
        brute = mean_with_shadows(plain, midpoints(n))
        error = np.abs(tb.render(scene).rgba.numpy() - brute.rgba)
        assert error.max() <= 8 * max(1.0, brute.rgba.max()) / n
        assert error.mean() <= 0.5 * max(1.0, brute.rgba.max()) / n


# -- laws --------------------------------------------------------------------------------------------------------------


def test_convex_bodies_shade_only_their_own_far_side(dtype):
    """200 random poses of an uneven octahedron that flies and grows: no pixel shades itself."""
    generator = np.random.default_rng(2)
    faces = [[i, 2 + j, 4 + k][:: 1 if (i + j + k) % 2 == 0 else -1] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    for _ in range(200 if dtype == torch.float32 else 20):
        vertices = np.concatenate([np.eye(3)[[k, k]] * [[1], [-1]] for k in range(3)]) * generator.uniform(
            0.3, 0.9, (6, 1)
        )
        turn, _ = np.linalg.qr(generator.normal(size=(3, 3)))
        start = vertices @ turn
        knots = np.stack([start, start * generator.uniform(0.6, 1.1) + generator.normal(size=3) * [0.3, 0.3, 0]])
        lamp = [lit.sun(generator.normal(size=3)), lit.point(turn[0] * 4, 4.0)][generator.integers(2)]
        assert (render(from_above([LookMesh(knots, faces)], [lamp], n=10), dtype).shadow == 1).all()


@pytest.mark.parametrize("alpha", [1.0, 0.5])
@pytest.mark.parametrize("moving", [False, True])
def test_rays_through_shared_edges_meet_one_face(alpha, moving):
    square = np.array([[-2.0, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]])  # diagonals through the pixels' centres
    knots = np.stack([square, square * [1, 1, 1] + [0, 0, 0.2 if moving else 0]])
    for lamp in (lit.sun((0, 0, -1)), lit.point((0, 0, 2), 3.0)):
        for faces in (TWO, [[0, 1, 3], [3, 1, 2]]):
            scene = from_above([floor(square - [0, 0, 0.5]), caster(knots, faces, opacity=alpha)], [lamp], n=8)
            assert (render(scene).shadow == 1 - alpha).all()


def test_a_saddle_lit_from_above_is_lit_wholly():
    """A height field z = 0.3 x y has no face above another; its neighbours must not shade each other."""
    side = np.linspace(-1.2, 1.2, 13)
    x, y = np.meshgrid(side, side)
    vertices = np.stack([x, y, 0.3 * x * y], -1).reshape(-1, 3)
    quads = [(13 * r + c, 13 * r + c + 1, 13 * r + c + 14, 13 * r + c + 13) for r in range(12) for c in range(12)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    mesh = LookMesh(vertices + np.array([[[0.0, 0, 0]], [[0.1, 0.05, 0.3]]]), faces)
    assert (render(from_above([mesh], [SUN, lit.point((0, 0, 9.0), 9.0)], n=24)).shadow == 1).all()


def test_pairs_that_are_left_out_would_not_have_blocked(monkeypatch):
    """Bounds, levels and surfaces turned away only save work: all pairs give the same image to the bit."""
    scenes = [lit.to_torch(SCENES[n](), casts_shadows=True) for n in ("moving_lamps", "mirrored_soup", "smooth_ball")]
    frames = [tb.render(scene) for scene in scenes]

    def all_pairs(_light, receivers, casters):
        i = torch.arange(receivers.count).repeat_interleave(casters.count)
        j = torch.arange(casters.count).repeat(receivers.count)
        keep = shadow_pairs._share_time(receivers, casters, i, j) & (receivers.face[i] != casters.face[j])
        yield i[keep], j[keep]

    monkeypatch.setattr("torchblur.shadows.candidate_pairs", all_pairs)
    every = light_bends.LightPaths.due
    monkeypatch.setattr(
        light_bends.LightPaths, "due", lambda self, prisms: tuple(torch.ones_like(d) for d in every(self, prisms))
    )
    for scene, frame in zip(scenes, frames, strict=True):
        torch.testing.assert_close(tb.render(scene).rgba, frame.rgba, rtol=0, atol=1e-9)
        assert tb.render(scene).counts["shadow_pairs"] > frame.counts["shadow_pairs"]


def test_portions_of_memory_change_nothing(monkeypatch):
    find, asked = shadows.find_shadows, []
    monkeypatch.setattr(nodes, "find_shadows", lambda *a: asked.append(a[1].count) or find(*a))
    scene = lit.to_torch(dataclasses.replace(moving_lamps(), width=24, height=20), casts_shadows=True)
    whole, n_receivers = tb.render(scene), sum(asked)
    asked.clear()
    tight = tb.render(scene, memory_bytes=1 << 22)
    assert len(asked) > 1
    assert sum(asked) == n_receivers  # each is looked at once, however many portions its shadows ask for
    torch.testing.assert_close(tight.rgba, whole.rgba, rtol=0, atol=1e-12)
    torch.testing.assert_close(tight.shadow, whole.shadow, rtol=0, atol=1e-12)
    assert tight.counts["shadow_ranges"] == whole.counts["shadow_ranges"] > 0
    assert 0 < whole.counts["deepest_shadow"] <= 6
    assert whole.counts["shadow_bytes"] >= 24 * whole.counts["shadow_ranges"]


def test_what_casts_on_nothing_costs_nothing():
    lamp = [lit.point((0, 0, 3), 5.0)]
    unlit = floor(shading="unlit"), slab(-1, 1, shading="unlit")
    for meshes, lights in ((unlit, lamp), ([floor()], []), ([floor()], lamp), ([], lamp)):
        frame = render(from_above(meshes, lights))
        assert frame.shadow is None if not lights else (frame.shadow == 1).all()
        assert frame.timings["shadows"] == 0
        assert all(frame.counts[k] == 0 for k in frame.counts if "shadow" in k)


def test_opacity_of_what_casts_has_a_gradient():
    opacity = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    scene = lit.to_torch(from_above([floor(), slab(-0.375, -0.125, shift=(1.0, 0, 0))], [SUN]), casts_shadows=True)
    glass = scene.meshes[1]
    glass = dataclasses.replace(glass, material=tb.Material(opacity=opacity, double_sided=False))
    tb.render(dataclasses.replace(scene, meshes=[scene.meshes[0], glass])).rgba[0, 0, 0].backward()
    assert float(opacity.grad) == pytest.approx(-0.25, abs=1e-12)


def test_frames_of_windows_have_their_own_shadows():
    scene = lit.to_torch(from_above([floor(), slab(-0.375, -0.125, shift=(1.0, 0, 0))], [SUN]), casts_shadows=True)
    frames = tb.render_windows(scene, [(0.0, 0.25), (0.25, 0.75), (0.75, 1.0)])
    assert [float(f.shadow) for f in frames] == pytest.approx([0.5, 0.75, 1.0], abs=1e-12)


def test_casts_shadows_must_be_a_flag():
    for make_light in (
        lambda **k: tb.PointLight((0, 0, 1.0), 1.0, **k),
        lambda **k: tb.SpotLight((0, 0, 1.0), (0, 0, 0.0), 1.0, **k),
        lambda **k: tb.DirectionalLight((0, 0, 1.0), 1.0, **k),
    ):
        with pytest.raises(TypeError, match="casts_shadows: expected True or False"):
            make_light(casts_shadows=1)
