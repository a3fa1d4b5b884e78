"""The brute-force shadow oracle against what can be worked out by hand, and against the oracle without shadows."""

from __future__ import annotations

import lit_scenes as lit
import numpy as np
import pytest
from oracle_looks import LookMesh, LookScene, image_at
from oracle_shadows import instant_with_shadows, mean_with_shadows, midpoints

FLOOR = np.array([[-5.0, -5, -1], [5, -5, -1], [5, 6, -1], [-5, 6, -1]])  # its diagonal misses the centre
TWO = [[0, 1, 2], [0, 2, 3]]


def floor(**material) -> LookMesh:
    return LookMesh(FLOOR, TWO, **material)


def slab(x0, x1, z=0.5, shift=(0.0, 0.0, 0.0), y=4.0, **material) -> LookMesh:
    """Return a rectangle x0..x1 at height z that moves by `shift`."""
    corners = np.array([[x0, -y, z], [x1, -y, z], [x1, y + 1, z], [x0, y + 1, z]], dtype=float)
    return LookMesh(np.stack([corners, corners + shift]), TWO, **material)


def seen_from_above(meshes, lights, n=1, **options) -> LookScene:
    return LookScene(meshes, lit.UPRIGHT, n, n, lights=lights, **options)


def hidden(mesh: LookMesh) -> LookMesh:
    """Return the mesh turned so that only its back is there for the viewer: it casts, and is not seen."""
    mesh.faces, mesh.double_sided = mesh.faces[:, ::-1].copy(), False
    return mesh


@pytest.mark.parametrize("alpha", [1.0, 0.3])
@pytest.mark.parametrize("kind", ["sun", "point", "spot"])
def test_a_caster_takes_its_opacity_of_the_light_while_it_is_between(kind, alpha):
    lamp = {
        "sun": lit.sun((0, 0, -1), 2.0),
        "point": lit.point((0, 0, 3), 32.0),
        "spot": lit.spot((0, 0, 3), (0, 0, -1), 32.0),
    }[kind]
    caster = hidden(slab(-0.25, 0.0, shift=(1.0, 0, 0), opacity=alpha))  # at x = 0 from t = 0 to 0.25
    caster.vertices[:, :, 0] -= 0.125  # from 0.125 to 0.375
    n = 800
    got = mean_with_shadows(seen_from_above([floor(color=(0.5, 1, 0.2)), caster], [lamp]), midpoints(n))
    assert got.visibility[0, 0] == pytest.approx(1 - 0.25 * alpha, abs=1e-12)  # the steps fall between sub-frames
    assert got.rgba[0, 0] == pytest.approx([*(np.array([0.5, 1, 0.2]) * 2 / np.pi * (1 - 0.25 * alpha)), 1], rel=1e-12)


def test_the_edge_of_a_shadow_lies_on_the_line_from_the_light():
    caster = hidden(slab(-9.0, 0.2, z=1.0))  # from (1, 0, 3) past (0.2, 0, 1) the ray meets the floor at x = -0.6
    answer = instant_with_shadows(seen_from_above([floor(), caster], [lit.point((1, 0, 3), 5.0)], n=40), 0.3)
    column = 2 * (np.arange(40) + 0.5) / 40 - 1
    assert answer.visibility[20].tolist() == (column > -0.6).astype(float).tolist()


def test_only_what_lies_between_casts():
    below, above = hidden(slab(-2, 2, z=-1.2)), hidden(slab(-2, 2, z=3.5))
    scene = seen_from_above([floor(), below, above], [lit.point((0, 0, 3), 5.0)])
    assert instant_with_shadows(scene, 0.5).visibility[0, 0] == 1
    scene.lights.append(lit.sun((0, 0, -1), 5.0))  # for a sun nothing is too far
    answer = instant_with_shadows(scene, 0.5)
    assert answer.visibility[0, 0] == pytest.approx(answer.due[0, 0] ** -1 * 3 * 5 / 16 / np.pi)
    assert instant_with_shadows(scene, 0.5, casting=[True, False]).visibility[0, 0] == 1


def test_caster_and_receiver_that_move_together_keep_their_shadow():
    rise = np.array([0, 0, 0.7])
    moving = LookMesh(np.stack([FLOOR, FLOOR + rise]), TWO)
    scene = seen_from_above([moving, hidden(slab(-0.3, 0.1, shift=rise))], [lit.sun((0.4, 0, -1))], n=16)
    each = [instant_with_shadows(scene, t).visibility for t in midpoints(8)]
    assert 0 < each[0].mean() < 1
    assert all((v == each[0]).all() for v in each)


def test_shadows_of_two_glasses_multiply():
    glasses = [hidden(slab(-1, 1, z=z, opacity=a)) for z, a in ((0.2, 0.5), (0.4, 0.25))]
    scene = seen_from_above([floor(), *glasses], [lit.sun((0, 0, -1))])
    assert instant_with_shadows(scene, 0.5).visibility[0, 0] == pytest.approx(0.5 * 0.75)


def test_light_behind_glass_counts_with_the_share_that_is_seen():
    glass = slab(-1, 1, z=0.2, opacity=0.25, color=(1.0, 0, 0))
    answer = instant_with_shadows(seen_from_above([floor(), glass], [lit.sun((0, 0, -1))]), 0.5)
    # the glass is lit wholly and makes up 0.25, the floor gets 0.75 of the light and makes up 0.75
    assert answer.visibility[0, 0] == pytest.approx(0.25 + 0.75 * 0.75)
    assert answer.rgba[0, 0] == pytest.approx([*(np.array([0.8125, 0.5625, 0.5625]) / np.pi), 1])


def test_a_plane_that_rises_towards_the_light_never_shades_itself():
    start = np.array([[-5, -5, -0.9], [5, -5, -0.5], [5, 5, -0.4], [-5, 5, -0.8]])  # not flat: two faces
    plane = LookMesh(np.stack([start, start + np.array([0, 0, 1.2])]), TWO)
    for lamp in (lit.point((0.3, 0.1, 4), 9.0), lit.sun((0.3, 0.2, -1))):
        assert (mean_with_shadows(seen_from_above([plane], [lamp], n=24), midpoints(5)).visibility == 1).all()


def test_no_light_is_due_on_what_is_unlit_or_turned_away():
    scene = seen_from_above([floor(shading="unlit"), hidden(slab(-1, 1))], [lit.sun((0, 0, -1))])
    answer = instant_with_shadows(scene, 0.5)
    assert (answer.visibility[0, 0], answer.due[0, 0]) == (1, 0)
    scene = seen_from_above([floor(), hidden(slab(-1, 1))], [lit.sun((0, 0, 1))], ambient=(0.5, 0.5, 0.5))
    answer = instant_with_shadows(scene, 0.5)
    assert (answer.visibility[0, 0], answer.due[0, 0]) == (1, 0)
    assert answer.rgba[0, 0] == pytest.approx([0.5, 0.5, 0.5, 1])


@pytest.mark.parametrize("name", ["sliding_plate", "spinning_box", "smooth_ball", "sweeping_spots", "crossing_planes"])
def test_without_shadows_it_agrees_with_the_other_oracle(name):
    scene = lit.SCENES[name]()
    for t in (0.137, 0.71):
        got = instant_with_shadows(scene, t, casting=[False] * len(scene.lights))
        assert got.rgba == pytest.approx(image_at(scene, t), abs=1e-12)
        assert (got.visibility == 1).all()


def test_convex_bodies_shade_only_their_own_far_side():
    vertices, faces = lit.ball(n_around=8)
    generator = np.random.default_rng(2)
    for _ in range(10):
        turn, _ = np.linalg.qr(generator.normal(size=(3, 3)))
        turn[:, 0] *= np.sign(np.linalg.det(turn))
        lamp = [lit.sun(generator.normal(size=3)), lit.point(turn[0] * 2.5, 4.0)][generator.integers(2)]
        answer = instant_with_shadows(seen_from_above([LookMesh(vertices @ turn, faces)], [lamp], n=40), 0.0)
        assert (answer.visibility == 1).all()


@pytest.mark.parametrize("alpha", [1.0, 0.5])
def test_rays_through_shared_edges_meet_one_face(alpha):
    square = np.array([[-2.0, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]])  # diagonals through the pixels' centres
    for lamp in (lit.sun((0, 0, -1)), lit.point((0, 0, 2), 3.0)):
        for faces in (TWO, [[0, 1, 3], [3, 1, 2]]):
            caster = hidden(LookMesh(square, faces, opacity=alpha))
            scene = seen_from_above([LookMesh(square - [0, 0, 0.5], TWO), caster], [lamp], n=8)
            answer = instant_with_shadows(scene, 0.0)
            assert (answer.rgba[..., 3] == 1).all()
            assert (answer.visibility == 1 - alpha).all()
