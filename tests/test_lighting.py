"""Lights and normals against closed forms.

One pixel looks along -z at the origin of the plate z = 0, unless a test says otherwise. Each closed form is asked of
the oracle too (1e-10). What does not change over the exposure is right to rounding (1e-12); what does, to the stated
1e-6 of the brightest the surface could be.
"""

from __future__ import annotations

import itertools

import lit_scenes as lit
import numpy as np
import pytest
import scene_makers as make
import torch
from lit_scenes import MIRRORED, UPRIGHT, one_pixel, plate, point, spot, sun
from oracle_looks import LookMesh, LookScene, mean_over_exposure

import torchblur as tb

ALBEDO = np.array([0.8, 0.5, 0.3])
POWER = np.array([3.0, 4.0, 5.0])
FLIPPED = [[0, 2, 1], [0, 3, 2]]  # the faces of a plate with their vertices clockwise
TILTED = np.array([0.3, -0.4, -1.2])


def check(scene: LookScene, expected, still: bool = True) -> None:
    """Compare the oracle and the renderer with the expected RGB of the one pixel."""
    answer = mean_over_exposure(scene, 0, 0)
    np.testing.assert_allclose(answer.rgba[:3], np.broadcast_to(expected, 3), rtol=0, atol=1e-10)
    got = tb.render(lit.to_torch(scene)).rgba[0, 0, :3].numpy()
    tolerance = 1e-12 if still else 1e-6 * answer.brightest
    np.testing.assert_allclose(got, np.broadcast_to(expected, 3), rtol=0, atol=tolerance)


def colored(corners=None, **material) -> LookMesh:
    """Return a plate of the tests' colour."""
    return plate(corners, color=ALBEDO, **material)


def still_or_moving(mesh: LookMesh) -> list[LookMesh]:
    """Return the mesh at rest, and sliding in its own plane, which must look the same in the middle."""
    slid = LookMesh(np.stack([mesh.vertices, mesh.vertices + np.array([0.4, -0.3, 0])]), mesh.faces, color=mesh.color)
    return [mesh, slid]


@pytest.mark.parametrize("position", [(0, 0, 2), (0.5, -1.0, 0.7), (30, 10, 0.01)])
@pytest.mark.parametrize("power", [2.5, tuple(POWER)])
def test_point_light(position, power):
    p = np.array(position, dtype=float)
    expected = ALBEDO / np.pi * np.array(power) * p[2] / np.linalg.norm(p) ** 3
    for mesh in still_or_moving(colored()):
        check(one_pixel(mesh, [point(position, power)]), expected)


@pytest.mark.parametrize("length", [1.0, 1e-3, 50.0])
def test_directional_light_of_any_length(length):
    expected = ALBEDO / np.pi * POWER * 1.2 / np.linalg.norm(TILTED)
    for mesh in still_or_moving(colored()):
        check(one_pixel(mesh, [sun(TILTED * length, POWER)]), expected)


@pytest.mark.parametrize(
    ("angle", "angles", "share"),
    [
        (10, (20, 40), 1.0),
        (30, (20, 40), None),
        (50, (20, 40), 0.0),
        (12, (0, 90), None),
        (29.999, (30, 30), 1.0),
        (30.001, (30, 30), 0.0),
    ],
)
def test_spot_light_fades_as_the_square_between_its_cones(angle, angles, share):
    if share is None:
        inner, outer, here = np.cos(np.radians([*angles, angle]))
        share = ((here - outer) / (inner - outer)) ** 2
    light = spot((0, 0, 2), (2 * np.tan(np.radians(angle)), 0, 0), POWER, angles)
    check(one_pixel(colored(), [light]), ALBEDO / np.pi * POWER / 4 * share)


def test_ambient_and_several_lights_add_up():
    ambient = np.array([0.3, 0.2, 0.1])
    check(one_pixel(colored(), (), ambient), ALBEDO * ambient)
    lights = [point((0, 0, 2), POWER), sun((0, 0, -1), 2.0), sun((0, 0, 1), 9.0)]
    check(one_pixel(colored(), lights, ambient), ALBEDO * (ambient + (POWER / 4 + 2) / np.pi))
    check(one_pixel(colored(), ()), 0.0)


def test_unlit_is_the_default_and_takes_no_light():
    assert tb.Material().shading == "unlit"
    assert tb.Material().mipmap is True
    check(one_pixel(colored(shading="unlit"), [sun((0, 0, -1))], (9.0, 9, 9)), ALBEDO)


@pytest.mark.parametrize("matrix", [UPRIGHT, MIRRORED])
@pytest.mark.parametrize("faces", [[[0, 1, 2], [0, 2, 3]], FLIPPED])
def test_light_falls_on_the_side_that_is_seen(matrix, faces):
    towards_viewer = -matrix[2, 2]
    mesh = LookMesh(plate().vertices, faces, color=ALBEDO)
    for side, expected in ((1, ALBEDO / np.pi * POWER / 4), (-1, 0 * ALBEDO)):
        place = (0, 0, 2 * side * towards_viewer)
        check(one_pixel(mesh, [point(place, POWER)], matrix=matrix), expected)
        check(one_pixel(mesh, [spot(place, (0, 0, 0), POWER)], matrix=matrix), expected)
        check(one_pixel(mesh, [sun((0, 0, -side * towards_viewer), POWER / 4)], matrix=matrix), expected)


def test_one_sided_faces_are_lit_in_front_and_not_there_from_behind():
    lights = [point((0, 0, 2), POWER)]
    check(one_pixel(colored(double_sided=False), lights), ALBEDO / np.pi * POWER / 4)
    behind = LookMesh(plate().vertices, FLIPPED, color=ALBEDO, double_sided=False)
    check(one_pixel(behind, lights, background=(0.1, 0.2, 0.3)), (0.1, 0.2, 0.3))


def test_opacity_is_over_the_background():
    background = np.array([0.1, 0.2, 0.3])
    scene = one_pixel(colored(opacity=0.5), [point((0, 0, 2), POWER)], background=background)
    check(scene, 0.5 * ALBEDO / np.pi * POWER / 4 + 0.5 * background)


def test_texture_and_light_multiply_at_every_pixel():
    texture = np.random.default_rng(0).uniform(0, 1, (3, 4, 3))
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    uv = lit.square_uv([[0, 0], [1, 0], [1, 1], [0, 1]])
    mesh = colored(square, uv=uv, texture=texture, wrap="clamp")
    light = np.array([0.3, -0.2, 0.9])
    scene = LookScene([mesh], UPRIGHT, 4, 3, lights=[point(light, POWER)])
    got = tb.render(lit.to_torch(scene)).rgba[..., :3].numpy()
    for row in range(3):
        for col in range(4):
            away = light - [*scene.pixel_ndc(row, col), 0]
            expected = ALBEDO * texture[row, col] / np.pi * POWER * away[2] / np.linalg.norm(away) ** 3
            np.testing.assert_allclose(got[row, col], expected, rtol=0, atol=1e-12)


def over_track(x, h, a=0.0):
    """Return the antiderivative in x of h / (h^2 + a^2 + x^2)^(3/2)."""
    return h * x / ((h**2 + a**2) * np.sqrt(h**2 + a**2 + x**2))


def track_mean(x0, x1, h, a=0.0):
    """Return the mean of the cosine over the squared distance, of a light that moves from x0 to x1."""
    return (over_track(x1, h, a) - over_track(x0, h, a)) / (x1 - x0)


def test_light_moves_over_a_still_plate():
    light = point([(-1.5, 0.4, 0.6), (0.9, 0.4, 0.6)], POWER)
    check(one_pixel(colored(), [light]), ALBEDO / np.pi * POWER * track_mean(-1.5, 0.9, 0.6, 0.4), still=False)


@pytest.mark.parametrize("xs", [(-1.0, 2.0, 0.1), (0.3, -0.7, 0.5, 2.0, -1.2)])
def test_light_moves_along_knots(xs):
    parts = [track_mean(a, b, 0.5) for a, b in itertools.pairwise(xs)]
    light = point([(x, 0, 0.5) for x in xs], POWER)
    check(one_pixel(colored(), [light]), ALBEDO / np.pi * POWER * np.mean(parts), still=False)


def test_camera_pans_over_a_still_plate():
    knots = np.stack([UPRIGHT, UPRIGHT])
    knots[:, 0, 3] = -0.5, 1.3  # the pixel sees x = 0.5, then -1.3
    expected = ALBEDO / np.pi * POWER * track_mean(0.5, -1.3, 0.4, 0.2)
    check(one_pixel(colored(), [point((0, 0.2, 0.4), POWER)], matrix=knots), expected, still=False)


def test_plate_sinks_away_from_a_light():
    knots = np.stack([plate().vertices + np.array([0, 0, 0.5]), plate().vertices - [0, 0, 0.75]])
    heights, a = (1.0 - 0.5, 1.0 + 0.75), 0.3

    def antiderivative(h):
        return -1 / np.sqrt(a * a + h * h)

    mean = (antiderivative(heights[1]) - antiderivative(heights[0])) / (heights[1] - heights[0])
    check(one_pixel(colored(knots), [point((a, 0, 1), POWER)]), ALBEDO / np.pi * POWER * mean, still=False)


def turning_cosine(start, end, way, t0=0.0, t1=1.0):
    """Return the integral over [t0, t1] of n l, where n is the unit vector along (1 - t) start + t end."""
    start, step, way = np.asarray(start, float), np.subtract(end, start), np.asarray(way, float)
    a, b = way @ start, way @ step
    alpha, beta, gamma = start @ start, start @ step, step @ step

    def antiderivative(t):
        root = np.sqrt(alpha + 2 * beta * t + gamma * t * t)
        inverse = np.arcsinh((gamma * t + beta) / np.sqrt(alpha * gamma - beta**2))
        return b / gamma * root + (a - b * beta / gamma) / np.sqrt(gamma) * inverse

    return antiderivative(t1) - antiderivative(t0)


def normals_about_y(*angles):
    """Return the vectors that e_z becomes when it turns about y."""
    return [make.rotation_y(angle) @ [0, 0, 1.0] for angle in angles]


@pytest.mark.parametrize("matrix", [UPRIGHT, MIRRORED])
def test_plate_turns_under_a_sun(matrix):
    """Vertices move linearly between two poses, so the normal is along the mean of the poses' normals."""
    knots = np.stack([plate().vertices @ make.rotation_y(angle).T for angle in (-0.6, 0.9)])
    way = np.array([0.3, 0.2, 1]) / np.linalg.norm([0.3, 0.2, 1]) * -matrix[2, 2]
    seen = [-matrix[2, 2] * n for n in normals_about_y(-0.6, 0.9)]
    expected = ALBEDO / np.pi * POWER * turning_cosine(*seen, way)
    check(one_pixel(colored(knots), [sun(-way, POWER)], matrix=matrix), expected, still=False)


def test_terminator_passes_in_mid_exposure():
    knots = np.stack([plate().vertices @ make.rotation_y(angle).T for angle in (-0.7, 0.9)])
    way = np.array([1, 0, 0.2]) / np.linalg.norm([1, 0, 0.2])
    start, end = normals_about_y(-0.7, 0.9)
    dawn = (way @ start) / (way @ start - way @ end)
    assert 0.2 < dawn < 0.8
    expected = ALBEDO / np.pi * POWER * turning_cosine(start, end, way, dawn, 1)
    check(one_pixel(colored(knots), [sun(-way, POWER)]), expected, still=False)


def test_hard_spot_border_passes_in_mid_exposure():
    """The target moves by x = 2 tan(angle): the border of 30 degrees passes when x = 2 tan(30 degrees)."""
    light = spot((0, 0, 2), [(-0.3, 0, 0), (3.0, 0, 0)], POWER, (30, 30))
    share = (2 * np.tan(np.radians(30)) + 0.3) / 3.3
    check(one_pixel(colored(), [light]), ALBEDO / np.pi * POWER / 4 * share, still=False)


def corner_weights(x, y, corners):
    """Return the barycentrics of (x, y) in a triangle (3, 3) of the plane z = 0."""
    return np.linalg.solve(np.stack([corners[:, 0], corners[:, 1], np.ones(3)]), [x, y, 1])


@pytest.mark.parametrize("double_sided", [True, False])
def test_vertex_normals_are_interpolated_and_then_renormalised(double_sided):
    normals = np.array([[0.5, 0, 1], [-1, 0.3, 2], [0, -0.3, 0.4], [0.2, 0.9, 3]])
    mesh = colored(normals=normals, double_sided=double_sided)
    way = np.array([0.2, -0.1, 1]) / np.linalg.norm([0.2, -0.1, 1])
    scene = LookScene([mesh], UPRIGHT, 5, 3, lights=[sun(-way, POWER)])
    got = tb.render(lit.to_torch(scene)).rgba[..., :3].numpy()
    for row in range(3):
        for col in range(5):
            x, y = scene.pixel_ndc(row, col)
            found = [(corner_weights(x, y, mesh.vertices[f]), f) for f in mesh.faces]
            n = next(weights @ normals[face] for weights, face in found if (weights > 0).all())
            expected = ALBEDO / np.pi * POWER * (n @ way / np.linalg.norm(n))
            np.testing.assert_allclose(got[row, col], expected, rtol=0, atol=1e-12)


def test_moving_normals_are_linear_between_knots_and_renormalised():
    start, end = np.array([0.8, 0.1, 0.4]), np.array([-0.2, 0.3, 2.0])
    way = np.array([0.6, 0, 0.8])
    moving = np.stack([plate().vertices, plate().vertices + np.array([0.1, 0.2, 0])])
    for knots in ((start, end), (start, end, 3 * start)):
        vertices = moving if len(knots) == 2 else np.stack([*moving, moving[0]])
        mesh = colored(vertices, normals=np.repeat(np.array(knots)[:, None], 4, 1))
        parts = [turning_cosine(a, b, way) for a, b in itertools.pairwise(knots)]
        expected = ALBEDO / np.pi * POWER * np.mean(parts)
        check(one_pixel(mesh, [sun(-way, POWER)]), expected, still=False)


@pytest.mark.parametrize("matrix", [UPRIGHT, MIRRORED])
def test_vertex_normals_are_negated_on_the_back_and_never_turned_to_the_viewer(matrix):
    """The front is the side whose vertices turn counter-clockwise seen from the eye: on screen, or mirrored there."""
    towards_viewer = -matrix[2, 2]
    for faces, sign in (([[0, 1, 2], [0, 2, 3]], 1), (FLIPPED, -1)):
        for z in (1.0, -1.0):
            mesh = LookMesh(plate().vertices, faces, color=ALBEDO, normals=np.tile([0, 0, z], (4, 1)))
            for side in (1, -1):
                light = sun((0, 0, -side * towards_viewer), POWER)
                expected = ALBEDO / np.pi * POWER * (sign * z * towards_viewer == side * towards_viewer)
                check(one_pixel(mesh, [light], matrix=matrix), expected)


@pytest.mark.parametrize("smooth", [False, True])
def test_a_mirrored_camera_sees_the_mirrored_image(smooth):
    scene = lit.smooth_ball() if smooth else lit.spinning_box()
    image = tb.render(lit.to_torch(scene)).rgba
    scene.world_to_clip = np.diag([-1.0, 1, 1, 1]) @ scene.world_to_clip
    torch.testing.assert_close(tb.render(lit.to_torch(scene)).rgba.flip(1), image, rtol=0, atol=1e-11)
