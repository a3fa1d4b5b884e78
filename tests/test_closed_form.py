"""The hard cases of methods.md, section 13, that need no texture, light or shadow, each with its exact answer.

Mostly one pixel: the camera is the identity, so NDC is world x, y and the only pixel centre is the origin; or w is
world z. Tolerances, unless a test says otherwise: float64 1e-9, the stated exactness (rounding alone is 1e-15; most
cases reach 1e-14). float32 1e-6: geometry is solved in float64, but the vertices were rounded to 6e-8 of their size on
the way in, which moves an event by that over the speed, and the result is rounded once more.
"""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import oracles
import pytest
import scene_makers as make
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import PlainMesh, PlainScene

import torchblur as tb

BIG = 9.0
W_IS_Z = make.w_is_z(0.1, 100.0)
ORIGIN = PlainScene([])


def tolerance(dtype: torch.dtype) -> float:
    """Return the module's tolerance, see above."""
    return 1e-9 if dtype == torch.float64 else 1e-6


def one_pixel(meshes, matrix=make.IDENTITY, background=(0, 0, 0)) -> PlainScene:
    """Return a scene of one pixel whose centre is NDC (0, 0)."""
    return PlainScene(list(meshes), matrix, 1, 1, background)


def coverage(mesh: PlainMesh, dtype=torch.float64, window=(0.0, 1.0), matrix=make.IDENTITY, device="cpu") -> float:
    """Return the share of the window in which a mesh covers the one pixel."""
    return float(make.render(one_pixel([mesh], matrix), dtype, device, *window).coverage[0, 0, 0])


def rgba(
    meshes, dtype=torch.float64, background=(0, 0, 0), matrix=make.IDENTITY, window=(0.0, 1.0), **options
) -> np.ndarray:
    """Return the one pixel's RGBA as float64."""
    frame = make.render(one_pixel(meshes, matrix, background), dtype, "cpu", *window, **options)
    return frame.rgba[0, 0].double().numpy()


def assert_intervals(mesh: PlainMesh, expected, matrix=make.IDENTITY, atol=1e-9) -> None:
    """Check that the pixel is covered in exactly these intervals: full inside each, empty in each gap."""
    edges = [0.0]
    for start, end in expected:
        edges += [start, end]
    edges.append(1.0)
    for k, (a, b) in enumerate(itertools.pairwise(edges)):
        if b > a:
            share = coverage(mesh, window=(a, b), matrix=matrix)
            assert share == pytest.approx(k % 2, abs=atol / (b - a)), f"window {a} to {b}"


# ---- 1, 2: translation -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("width", "v", "x"),
    [
        (0.5, 2.0, 0.75),
        (0.25, 1.0, 0.5),
        (3.0, 2.0, 1.5),
        (1.0, -2.0, -0.3),
        (1.0, 40.0, 5.0),
        (1e-3, 3.0, 1.1),
        (0.5, 0.25, 0.4),
    ],
)
def test_01_sliding_box(width, v, x, dtype, device):
    box = make.quad(-x, width - x, -BIG, BIG + 1, 0.0, shift=(v, 0.0))  # the box is [0, width] + v t seen from x
    ends = sorted(((x - width) / v, x / v))
    expected = max(0.0, min(1.0, ends[1]) - max(0.0, ends[0]))
    assert coverage(box, dtype, device=device) == pytest.approx(expected, abs=tolerance(dtype))


@given(
    width=st.floats(0.01, 4), v=st.floats(0.05, 20), x=st.floats(-3, 20), angle=st.floats(0, 6.28), y=st.floats(-5, 5)
)
def test_01_sliding_box_any_direction(width, v, x, angle, y):
    box = make.quad(-x, width - x, -BIG - y, BIG - y, 0.0, shift=(v, 0.0))
    box.vertices = box.vertices @ make.rotation_z(angle).T
    expected = max(0.0, min(1.0, x / v) - max(0.0, (x - width) / v))
    assert coverage(box) == pytest.approx(expected, abs=1e-9)


def test_02_translation_in_perspective_is_linear(dtype):
    corners = np.array([[-3.0, -2.0, 2.0], [4.0, -1.5, 3.0], [0.5, 3.0, 6.0]])
    shift = np.array([-7.0, 1.0, 3.0])
    mesh = make.triangle(corners, corners + shift)
    e0 = oracles.edges_at(corners[:, :2], corners[:, :2], 0.0)
    e1 = oracles.edges_at(corners[:, :2] + shift[:2], corners[:, :2] + shift[:2], 0.0)
    inside = [0.0, 1.0]  # every e is linear in t: cut with three half-lines
    for a, b in zip(e0, e1, strict=True):
        if a > 0 > b:
            inside[1] = min(inside[1], a / (a - b))
        elif a < 0 < b:
            inside[0] = max(inside[0], a / (a - b))
        else:
            assert a > 0
            assert b > 0
    expected = inside[1] - inside[0]
    assert 0.1 < expected < 0.9
    assert coverage(mesh, dtype, matrix=W_IS_Z) == pytest.approx(expected, abs=tolerance(dtype))
    scene = make.to_torch(one_pixel([mesh], W_IS_Z), dtype)
    times = np.linspace(inside[0] + 0.02, inside[1] - 0.02, 5)
    now = [tb.render_instant(scene, t=float(t)) for t in times]
    for values in ([float(n.depth_view[0, 0]) for n in now], *[[float(n.bary[0, 0, k]) for n in now] for k in (0, 1)]):
        # second differences of a linear function are zero; values of order 1 to 6 carry one rounding each
        assert np.abs(np.diff(values, 2)).max() < (1e-12 if dtype == torch.float64 else 4e-6)


# ---- 3, 4, 5: events that parity and inclusive tests get wrong -----------------------------------------------------


@pytest.mark.parametrize("turn", range(4))
@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 1, 0)])
def test_03_apex_through_the_pixel(turn, order):
    quarter = np.round(make.rotation_z(np.pi / 2 * turn))
    corners = np.array([[0, 0, 0], [-1, 1, 0], [-1, -1, 0]], dtype=np.float64)
    start, end = (corners + np.array([x, 0, 0]) for x in (-0.5, 1.5))
    mesh = PlainMesh(np.stack([start, end]) @ quarter.T, [order])
    assert_intervals(mesh, [(0.25, 0.75)], atol=1e-12)


@pytest.mark.parametrize("scale", [1.0, 0.25, 1e-3])
@pytest.mark.parametrize(("sign", "expected"), [(1.0, 1.0), (-1.0, 0.0)])
def test_04_edge_touches_at_half_time(scale, sign, expected, dtype):
    # e0 = cr(A1, A2) = sign (t - 1/2)^2: the edge turns about a point that slides through the pixel
    at = [np.array([(0, 3.0), (-1 + s / 2, -sign * s), (1 + s / 2, sign * s)]) * scale for s in (-0.5, 0.5)]
    np.testing.assert_allclose([oracles.edges_at(a, a, 0.0)[0] for a in at], sign * 0.25 * scale**2, rtol=1e-12)
    # float32: a vertex off by 6e-8 of its size opens a gap of the square root of that, 2.5e-4; dyadic scales have none
    exact = dtype == torch.float64 or scale in (1.0, 0.25)
    bound = 1e-7 if scale == 1e-3 else 1e-12  # 1e-3 is not dyadic: sqrt(eps) is allowed by the table of methods 1.4
    assert coverage(make.triangle(*at), dtype) == pytest.approx(expected, abs=bound if exact else 5e-4)


@pytest.mark.parametrize(("sign", "expected"), [(1.0, 1.0), (-1.0, 0.0)])
def test_04_touch_in_any_direction(sign, expected):
    """Turned and scaled, the edge function at the touch is rounding of either sign, and must decide nothing."""
    generator = np.random.default_rng(1)
    n = 60
    meshes = []
    for _ in range(n):
        turn, scale = make.rotation_z(generator.uniform(0, 2 * np.pi)), generator.uniform(0.3, 3)
        at = [np.array([(0, 3.0, 0), (-1 + s / 2, -sign * s, 0), (1 + s / 2, sign * s, 0)]) for s in (-0.5, 0.5)]
        meshes.append(make.triangle(*(scale * a @ turn.T for a in at), opacity=0.5))
    got = make.render(one_pixel(meshes)).coverage[0, 0].numpy()
    np.testing.assert_allclose(got, np.full(n, expected), rtol=0, atol=1e-7)  # sqrt(eps), as the table allows


@pytest.mark.parametrize("spacing_px", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("moving", ["static", "slides along x", "slides along y"])
def test_05_quads_with_every_pixel_centre_on_edges_and_vertices(spacing_px, moving, dtype):
    n_px = 8
    n = int(20 / spacing_px)
    vertices, faces = make.grid(n, 20 / n_px)  # 20 cells of one px each way; spacing 2 / n_px a pixel
    vertices = vertices + np.array([1 / n_px, 1 / n_px, 0])  # a corner onto every centre that the spacing reaches
    step = {"static": (0, 0), "slides along x": (0.5, 0), "slides along y": (0, 0.25)}[moving]
    knots = np.stack([vertices, vertices + np.array([*step, 0])])
    mesh = PlainMesh(vertices if moving == "static" else knots, faces, opacity=0.5)
    scene = PlainScene([mesh], make.IDENTITY, n_px, n_px)
    frame = make.render(scene, dtype)
    torch.testing.assert_close(
        frame.coverage,
        torch.ones_like(frame.coverage),
        rtol=0,
        atol=tolerance(dtype) * 1e-3 + 1e-7 * (dtype == torch.float32),
    )
    torch.testing.assert_close(
        frame.rgba[..., 3],
        torch.full((n_px, n_px), 0.5, dtype=dtype),
        rtol=0,
        atol=1e-12 + 1e-7 * (dtype == torch.float32),
    )


@pytest.mark.parametrize("n", [3, 4, 5, 8, 12])
@pytest.mark.parametrize("matrix", ["orthographic", "perspective"])
@pytest.mark.parametrize("spin", [0.0, 0.7])
def test_05_fan_vertex_on_the_centre(n, matrix, spin):
    angles = 2 * np.pi * np.arange(n) / n + 0.1
    depth = 0.0 if matrix == "orthographic" else 4.0
    hub = np.array([[0, 0, depth]])
    ring = np.stack([3 * np.cos(angles), 3 * np.sin(angles), np.full(n, depth)], -1)
    vertices = np.concatenate([hub, ring])
    if spin:
        vertices = make.rotated(vertices, spin, 2)
    mesh = PlainMesh(vertices, [[0, 1 + k, 1 + (k + 1) % n] for k in range(n)], opacity=0.5)
    answer = rgba([mesh], matrix=make.IDENTITY if matrix == "orthographic" else W_IS_Z)
    assert answer[3] == pytest.approx(0.5, abs=1e-12)


def test_05_every_face_orientation_of_a_split_quad():
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float64)
    for first in ([0, 1, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0], [0, 2, 1]):
        for second in ([0, 2, 3], [2, 3, 0], [3, 2, 0], [0, 3, 2]):
            answer = rgba([PlainMesh(corners, [first, second], opacity=0.5)])
            assert answer[3] == pytest.approx(0.5, abs=1e-12), (first, second)


# ---- 6, 7: winding -------------------------------------------------------------------------------------------------


def flip(**material) -> PlainMesh:
    """Return the triangle that turns inside out at t = 1/2 with the pixel always inside."""
    return make.triangle([(-1, -1), (1, -1), (0, 2)], [(-1, 1), (1, 1), (0, -2)], **material)


def test_06_winding_flip(dtype):
    tol = tolerance(dtype)
    assert coverage(flip(), dtype) == pytest.approx(1.0, abs=tol)
    assert rgba([flip(opacity=0.5)], dtype)[3] == pytest.approx(0.5, abs=tol)
    assert coverage(flip(double_sided=False), dtype) == pytest.approx(0.5, abs=tol)
    assert coverage(flip(double_sided=False), dtype, (0.0, 0.5)) == pytest.approx(1.0, abs=tol)
    assert coverage(flip(double_sided=False), dtype, (0.5, 1.0)) == pytest.approx(0.0, abs=tol)
    scene = make.to_torch(one_pixel([flip()]), dtype)
    for t in (0.0, 0.25, 0.499999, 0.500001, 0.8, 1.0):
        bary = tb.render_instant(scene, t=t).bary[0, 0]
        torch.testing.assert_close(bary, torch.full_like(bary, 1 / 3), rtol=0, atol=tol)


@pytest.mark.parametrize(
    ("order", "double_sided", "expected"),
    [
        ((0, 1, 2), False, 7 / 20),
        ((0, 2, 1), False, 1 / 4),
        ((0, 1, 2), True, 3 / 5),
        ((2, 0, 1), False, 7 / 20),
    ],
)
def test_07_facing_changes_twice(order, double_sided, expected, dtype):
    start, end = (np.array(v) - 0.3 for v in ([(0, 0), (1, 2), (2, 1)], [(0, 0), (1, -2), (-2, 1)]))
    mesh = make.triangle(start[list(order)], end[list(order)], double_sided=double_sided)
    assert coverage(mesh, dtype) == pytest.approx(expected, abs=tolerance(dtype))
    if dtype == torch.float64 and expected == 7 / 20:
        assert_intervals(mesh, [(1 / 4, 3 / 5)])


# ---- 8, 9, 10: behind the camera, four intervals, degenerate -------------------------------------------------------


def test_08_passes_behind_the_camera(dtype):
    corners = [(-1, -1), (1, -1), (0, 1)]
    mesh = make.triangle([(*p, 2.0) for p in corners], [(*p, -2.0) for p in corners])
    assert coverage(mesh, dtype, matrix=W_IS_Z) == pytest.approx(0.475, abs=tolerance(dtype))
    if dtype == torch.float64:
        assert_intervals(mesh, [(0.0, 0.475)], matrix=W_IS_Z)


def test_08_passes_the_far_plane(dtype):
    corners = [(-1, -1), (1, -1), (0, 1)]
    mesh = make.triangle([(*p, 2.0) for p in corners], [(*p, 6.0) for p in corners])
    assert coverage(mesh, dtype, matrix=make.w_is_z(0.1, 5.0)) == pytest.approx(0.75, abs=tolerance(dtype))


def test_09_four_intervals(dtype):
    mesh = make.triangle([(-12, 18), (-27, -18), (110, 70)], [(10, -5), (-9, 6), (-110, -90)])
    root = 3 * np.sqrt(105)
    expected = [(0, 1 / 8), (3 / 10, 141 / 286), (2 / 3, (543 - root) / 628), ((543 + root) / 628, 1)]
    assert sum(b - a for a, b in expected) == pytest.approx(0.553439522844, abs=1e-12)
    assert coverage(mesh, dtype) == pytest.approx(11177 / 17160 - root / 314, abs=tolerance(dtype))
    if dtype == torch.float64:
        assert_intervals(mesh, expected)


@pytest.mark.parametrize(
    "name", ["equal vertices", "collinear", "all equal", "collinear and moving", "shrinks to a line"]
)
def test_10_degenerate_triangles(name, dtype):
    line = [(-1, -1), (0, 0), (1, 1)]
    start, end, expected = {
        "equal vertices": ([(-1, 0), (-1, 0), (1, 0)], None, 0),
        "collinear": (line, None, 0),
        "all equal": ([(0, 0)] * 3, None, 0),
        "collinear and moving": (line, [(x - 1, y + 1) for x, y in line], 0),
        "shrinks to a line": ([(-1, -1), (1, -1), (0, 2)], [(-1, 0), (1, 0), (0, 0)], 1),
    }[name]
    mesh = make.triangle(start, end)
    assert coverage(mesh, dtype) == pytest.approx(expected, abs=tolerance(dtype))
    scene = make.to_torch(one_pixel([mesh], background=(0.5, 0.5, 0.5)), dtype)
    vertices = scene.meshes[0].vertices.clone().requires_grad_()
    again = tb.Scene([tb.Mesh(vertices, scene.meshes[0].faces)], scene.camera, scene.background)
    tb.render(again).rgba.sum().backward()
    assert torch.isfinite(vertices.grad).all()


def test_10_zero_motion_given_as_two_equal_knots(dtype):
    still = make.triangle([(-1, -1), (1, -1), (0, 2)])
    moving = make.triangle([(-1, -1), (1, -1), (0, 2)], [(-1, -1), (1, -1), (0, 2)])
    assert coverage(still, dtype) == 1.0
    assert coverage(moving, dtype) == pytest.approx(1.0, abs=tolerance(dtype))


# ---- 11: watertight ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n_segments", [1, 3])
def test_11_swept_mesh_covers_every_pixel_once(seed, n_segments, dtype):
    generator = np.random.default_rng(seed)
    vertices, faces = make.grid(8, 2.0)
    jitter = generator.uniform(-0.24, 0.24, (n_segments + 1, len(vertices), 3)) * np.array([0.5, 0.5, 0.5])
    mesh = PlainMesh(vertices + jitter, generator.permutation(faces), opacity=0.5)  # cells of 0.5: never folds
    scene = PlainScene([mesh], make.IDENTITY, 15, 13)
    frame = make.render(scene, dtype)
    # one ulp per abutting interval; about 10 intervals a pixel in float64, and one rounding to float32 at the end
    atol = 1e-14 if dtype == torch.float64 else 6e-8
    torch.testing.assert_close(frame.rgba[..., 3], torch.full_like(frame.rgba[..., 3], 0.5), rtol=0, atol=atol)
    torch.testing.assert_close(frame.coverage, torch.ones_like(frame.coverage), rtol=0, atol=2 * atol)


# ---- 12, 13, 15, 16: crossings --------------------------------------------------------------------------------------

RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def plane(z0, z1, color, opacity=1.0) -> PlainMesh:
    """Return a rectangle that covers the pixel all the time, from depth z0 to z1."""
    return make.quad(-BIG, BIG, -BIG, BIG + 1, z0, z1, color=color, opacity=opacity)


@pytest.mark.parametrize(("opacity", "expected"), [(1.0, (0.5, 0.5, 0, 1)), (0.5, (0.375, 0.375, 0.25, 0.75))])
def test_12_two_planes_cross(opacity, expected, dtype):
    answer = rgba([plane(1, 0, RED, opacity), plane(0, 1, GREEN, opacity)], dtype, BLUE)
    np.testing.assert_allclose(answer, expected, rtol=0, atol=1e-9 if dtype == torch.float64 else 1e-7)  # dyadic input
    coverage_of = make.render(one_pixel([plane(1, 0, RED, opacity), plane(0, 1, GREEN, opacity)]), dtype).coverage[0, 0]
    np.testing.assert_allclose(coverage_of.numpy(), (0.5, 0.5) if opacity == 1 else (1, 1), rtol=0, atol=1e-7)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0), (0, 2, 1)])
@pytest.mark.parametrize(
    "name",
    [
        "crossing at an event",
        "three through one point",
        "equal start and depth",
        "meet at the start, red behind",
        "meet at the start, red in front",
        "meet at the end",
    ],
)
def test_13_coincident_events(name, order):
    even, far = plane(0.375, 0.375, GREEN), plane(0.9, 0.9, BLUE)
    meshes, expected = {
        "crossing at an event": (
            [plane(0.5, 0.0, RED), plane(0.0, 0.5, GREEN), make.slab(0.5, 1.0, 0.9, 0.9, color=BLUE)],
            (0.5, 0.5, 0),
        ),
        "three through one point": ([plane(0, 1, RED), plane(1, 0, GREEN), plane(0.5, 0.5, BLUE)], (0.5, 0.5, 0)),
        "equal start and depth": ([plane(0.5, 0.9, RED), plane(0.5, 0.1, GREEN), plane(0.5, 1.0, BLUE)], (0, 1, 0)),
        "meet at the start, red behind": ([make.slab(0.25, 0.75, 0.25, 0.75, color=RED), even, far], (0, 1, 0)),
        "meet at the start, red in front": ([make.slab(0.25, 0.75, 0.5, 0.0, color=RED), even, far], (0.5, 0.5, 0)),
        "meet at the end": ([make.slab(0.25, 0.75, 0.0, 0.5, color=RED), even, far], (0.5, 0.5, 0)),
    }[name]
    answer = rgba([meshes[k] for k in order])
    np.testing.assert_allclose(answer[:3], expected, rtol=0, atol=1e-12)


def eighth_grid_layers(generator: np.random.Generator) -> list[oracles.Layer]:
    """Return random layers with times, depths and opacities on a 1/8 grid and no two on one depth line."""
    layers, seen = [], set()
    while len(layers) < 6:
        a, b = sorted(generator.choice(9, 2, replace=False))
        z = tuple(int(v) for v in generator.integers(-4, 5, 2))
        if z not in seen:
            seen.add(z)
            alpha = float(generator.choice([0.25, 0.5, 1.0]))
            color = tuple(generator.integers(0, 9, 3) / 8)
            layers.append(
                oracles.Layer(Fraction(int(a), 8), Fraction(int(b), 8), *(Fraction(v, 8) for v in z), color, alpha)
            )
    return layers


@pytest.mark.parametrize("seed", range(40))
def test_13_everything_on_an_eighth_grid(seed):
    generator = np.random.default_rng(seed)
    layers = eighth_grid_layers(generator)
    meshes = [
        make.slab(*(float(v) for v in (k.t_start, k.t_end, k.z0, k.z1)), color=k.color, opacity=k.alpha) for k in layers
    ]
    expected = oracles.composite_layers(layers, (0.5, 0.25, 1.0))
    answers = [
        rgba([meshes[k] for k in generator.permutation(len(meshes))], background=(0.5, 0.25, 1.0)) for _ in range(2)
    ]
    for answer in answers:
        np.testing.assert_allclose(answer, expected, rtol=0, atol=1e-11)  # 4e-12 is what the study reached


@pytest.mark.parametrize("seed", range(3))
def test_13_order_of_faces_and_of_meshes_does_not_matter(seed):
    generator = np.random.default_rng(seed)
    soup = make.random_soup(generator, 30, width=12, height=10)
    mesh = soup.meshes[0]
    order = generator.permutation(30)
    other = PlainMesh(mesh.vertices, mesh.faces[order], mesh.color[order], mesh.opacity[order])
    first = make.render(soup).rgba
    second = make.render(PlainScene([other], soup.world_to_clip, 12, 10, soup.background)).rgba
    torch.testing.assert_close(first, second, rtol=0, atol=1e-12)  # only sums may run in another order
    parts = [PlainMesh(mesh.vertices, mesh.faces[k::3], mesh.color[k::3], mesh.opacity[k::3]) for k in (2, 0, 1)]
    third = make.render(PlainScene(parts, soup.world_to_clip, 12, 10, soup.background)).rgba
    torch.testing.assert_close(first, third, rtol=0, atol=1e-12)


@pytest.mark.parametrize("reverse", [False, True])
def test_15_swap_time_in_perspective(reverse, dtype):
    moving = make.quad(-99, 99, -99, 98, 1, 9, color=RED)
    static = make.quad(-999, 999, -999, 998, 3, color=GREEN)
    meshes = [static, moving] if reverse else [moving, static]
    tol = tolerance(dtype)
    np.testing.assert_allclose(rgba(meshes, dtype, matrix=W_IS_Z), (0.25, 0.75, 0, 1), rtol=0, atol=tol)
    np.testing.assert_allclose(rgba(meshes, dtype, matrix=W_IS_Z, window=(0, 0.25)), (1, 0, 0, 1), rtol=0, atol=4 * tol)
    np.testing.assert_allclose(rgba(meshes, dtype, matrix=W_IS_Z, window=(0.25, 1)), (0, 1, 0, 1), rtol=0, atol=2 * tol)


def test_15_mean_inverse_depth():
    scene = make.to_torch(one_pixel([make.quad(-99, 99, -99, 98, 1, 9)], W_IS_Z))
    nodes, weights = np.polynomial.legendre.leggauss(24)
    inverse = [1 / float(tb.render_instant(scene, t=float(t)).depth_view[0, 0]) for t in (nodes + 1) / 2]
    assert np.dot(weights / 2, inverse) == pytest.approx(np.log(9) / 8, abs=1e-12)  # 24 Gauss nodes: 1e-13 for 1/(1+8t)


COPLANAR = {
    "flat": lambda x, y: 0.25 + 0 * x,
    "tilted": lambda x, y: 0.1 + 0.3 * x - 0.2 * y,
}


@pytest.mark.parametrize("opacity", [1.0, 0.5])
@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("surface", list(COPLANAR))
def test_16_coplanar_triangles_do_not_depend_on_input_order(surface, moving, opacity):
    generator = np.random.default_rng(7)
    corners = generator.uniform(-1, 1, (9, 3, 3))
    corners[:3] = corners[0]  # three faces with the same three vertices
    corners[..., 2] = COPLANAR[surface](corners[..., 0], corners[..., 1])
    knots = np.stack([corners, corners + np.array([0.25, -0.125, 0.0])]) if moving else corners
    vertices = knots.reshape(*knots.shape[:-3], 27, 3)
    faces, colors = np.arange(27).reshape(9, 3), generator.uniform(0, 1, (9, 3))

    def image(parts):
        meshes = [PlainMesh(vertices, faces[part], colors[part], opacity) for part in parts]
        return make.render(PlainScene(meshes, make.IDENTITY, 10, 10)).rgba

    one, three = [np.arange(9)], [np.array([0, 3, 4]), np.array([1, 5, 6]), np.array([2, 7, 8])]
    first = image(one)
    torch.testing.assert_close(image(one), first, rtol=0, atol=0)
    torch.testing.assert_close(image([generator.permutation(9)]), first, rtol=0, atol=1e-12)
    first = image(three)
    torch.testing.assert_close(image([generator.permutation(p) for p in three]), first, rtol=0, atol=1e-12)
    torch.testing.assert_close(image([three[k] for k in (2, 0, 1)]), first, rtol=0, atol=1e-12)


# ---- 17: opacities --------------------------------------------------------------------------------------------------


def test_17_opaque_in_front_hides_everything(dtype):
    answer = rgba([plane(0.5, 0.6, BLUE, 0.5), plane(0, 0.1, RED), plane(0.8, 0.8, GREEN)], dtype, (1, 1, 1))
    np.testing.assert_allclose(answer, (1, 0, 0, 1), rtol=0, atol=1e-12 if dtype == torch.float64 else 1e-7)


def test_17_opacity_zero_is_not_there(dtype):
    scene = one_pixel([plane(0, 0.5, RED, 0.0), plane(0.5, 0, GREEN, 0.5)], background=BLUE)
    frame = make.render(scene, dtype)
    np.testing.assert_allclose(frame.rgba[0, 0].numpy(), (0, 0.5, 0.5, 0.5), rtol=0, atol=1e-7)
    np.testing.assert_allclose(frame.coverage[0, 0].numpy(), (0, 1), rtol=0, atol=1e-7)


@pytest.mark.parametrize("alpha", [0.02, 0.3, 0.95])
def test_17_hundred_layers(alpha, dtype):
    generator = np.random.default_rng(3)
    depths, colors = generator.permutation(np.linspace(-0.9, 0.9, 100)), generator.uniform(0, 1, (100, 3))
    meshes = [plane(z, z + 0.005 * (k % 2), colors[k], alpha) for k, z in enumerate(depths)]
    weights = alpha * (1 - alpha) ** np.arange(100)
    expected = weights @ colors[np.argsort(depths)] + (1 - alpha) ** 100 * np.array([1, 1, 1])
    answer = rgba(meshes, dtype, (1, 1, 1))
    np.testing.assert_allclose(answer[:3], expected, rtol=0, atol=1e-12 if dtype == torch.float64 else 1e-6)
    assert answer[3] == pytest.approx(1 - (1 - alpha) ** 100, abs=1e-6)


@pytest.mark.parametrize("tau", [0.2, 1e-2, 1e-4])
def test_17_cutoff_error_is_at_most_tau(tau):
    generator = np.random.default_rng(5)
    soup = make.random_soup(generator, 60, width=12, height=12, opacity=0.7, size=0.8)
    exact = make.render(soup).rgba
    cut = make.render(soup, accuracy=tb.Accuracy.exact(transmittance_cutoff=tau)).rgba
    error = float((exact - cut).abs().max())
    assert error <= tau  # colours are at most 1
    assert tau < 1e-2 or error > 0, "the cut-off does nothing here"


# ---- 18, 19, 21: camera crossing, rotation, precision ---------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_18_prisms_through_the_camera_plane(seed):
    generator = np.random.default_rng(seed)
    n = 6
    xy = generator.uniform(-2, 2, (2, n * 3, 2))
    z = np.stack([generator.uniform(-1.0, 4, n * 3), generator.uniform(-3.0, 2, n * 3)])
    vertices = np.concatenate([xy, z[..., None]], -1)
    mesh = PlainMesh(vertices, np.arange(3 * n).reshape(n, 3), generator.uniform(0, 1, (n, 3)), 0.5)
    scene = PlainScene([mesh], W_IS_Z, 9, 7, background=(0.1, 0.2, 0.3))
    frame = make.render(scene)
    seen = 0
    for row in range(7):
        for col in range(9):
            answer = oracles.integrate_pixel(scene, row, col)
            np.testing.assert_allclose(frame.rgba[row, col].numpy(), answer.rgba, rtol=0, atol=1e-9)
            assert float(frame.coverage[row, col, 0]) == pytest.approx(answer.coverage[0], abs=1e-9)
            seen += answer.coverage[0] > 0
    assert seen > 5, "the scene shows nothing"


def half_plane_coverage(x: float, y: float, distance: float, theta: float) -> float:
    """Return the share of t in [0, 1] with p . n(theta t) <= distance, n(a) = (cos a, sin a)."""
    radius, phi = np.hypot(x, y), np.arctan2(y, x)
    if radius <= distance:
        return 1.0
    half = np.arccos(distance / radius)
    low, high = max(0.0, (phi - half) / theta), min(1.0, (phi + half) / theta)
    return 1.0 - max(0.0, high - low)


def test_19_rotation_error_falls_fourfold_per_doubling():
    theta, distance, n_px = np.pi / 2, 0.4, 12
    corners = np.array([[-8, -8, 0], [distance, -8, 0], [distance, 8, 0], [-8, 8, 0]], dtype=np.float64)
    errors = []
    for n in (1, 2, 4, 8, 16):
        mesh = PlainMesh(make.rotated(corners, theta, n), [[0, 1, 2], [0, 2, 3]])
        scene = PlainScene([mesh], make.IDENTITY, n_px, n_px)
        got = make.render(scene).coverage[..., 0].numpy()
        truth = [
            [half_plane_coverage(*scene.pixel_ndc(r, c), distance, theta) for c in range(n_px)] for r in range(n_px)
        ]
        errors.append(np.abs(got - np.array(truth)).mean())
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    assert (ratios[1:] > 3.3).all(), ratios  # 4 in the limit; the first, with a sagitta of 0.29 R, is not there yet
    assert (ratios[1:] < 4.8).all(), ratios


@pytest.mark.parametrize(("n", "sagitta"), [(1, 0.2929), (2, 0.0761), (4, 0.0192), (8, 0.0048)])
def test_19_sagitta_of_a_quarter_turn(n, sagitta):
    point = np.array([[1.0, 0, 0], [1.0, -1e-3, 0], [1.0, 1e-3, 0]])  # a sliver at radius 1; its middle is the point
    shape = np.concatenate([point[1:], [[0.2, 0.0, 0.0]]])
    mesh = PlainMesh(make.rotated(shape, np.pi / 2, n), [[0, 1, 2]])
    # at the middle of the first segment the outer edge stands at 1 - sagitta on the ray at angle theta / (2 n)
    angle, t = np.pi / (4 * n), 0.5 / n
    for radius, inside in ((1 - sagitta - 2e-4, True), (1 - sagitta + 2e-4, False)):
        matrix = np.eye(4)
        matrix[:2, 3] = -radius * np.cos(angle), -radius * np.sin(angle)
        now = tb.render_instant(make.to_torch(one_pixel([mesh], matrix)), t=t)
        assert (int(now.mesh_id[0, 0]) == 0) is inside


def test_21_float32_frame_is_close_to_float64():
    generator = np.random.default_rng(11)
    soup = make.random_soup(generator, 80, width=32, height=24)
    single = make.render(soup, torch.float32).rgba
    assert single.dtype == torch.float32
    rounded = PlainMesh(
        soup.meshes[0].vertices.astype(np.float32),
        soup.meshes[0].faces,
        soup.meshes[0].color.astype(np.float32),
        soup.meshes[0].opacity.astype(np.float32),
    )
    same_input = make.render(PlainScene([rounded], soup.world_to_clip, 32, 24, soup.background.astype(np.float32))).rgba
    # equal input: only the result is rounded (6e-8), with room for blocks summed in float32
    torch.testing.assert_close(single.double(), same_input, rtol=0, atol=1e-6)
    # rounded vertices: an event moves by 6e-8 / speed; the slowest edges here pass a pixel at about 0.01 NDC a shutter,
    # about 20 events a pixel: 6e-8 / 0.01 * 20 = 1.2e-4
    torch.testing.assert_close(single.double(), make.render(soup).rgba, rtol=0, atol=1.2e-4)


# ---- 28 lives in test_gradients.py ---
# ---- 29, 30: nothing there, odd numbers ---


@pytest.mark.parametrize(
    "name", ["no mesh", "mesh without faces", "mesh without vertices", "off screen", "behind", "beside, moving"]
)
@pytest.mark.parametrize("image", [False, True])
def test_29_nothing_to_see_gives_the_background(name, image, dtype):
    h, w = 3, 4
    background = np.random.default_rng(0).uniform(0, 1, (h, w, 3)) if image else np.array([0.25, 0.5, 1.0])
    meshes = {
        "no mesh": [],
        "mesh without faces": [PlainMesh(np.zeros((3, 3)), np.zeros((0, 3)))],
        "mesh without vertices": [PlainMesh(np.zeros((0, 3)), np.zeros((0, 3)))],
        "off screen": [make.quad(2, 3, 2, 3, 0)],
        "behind": [make.quad(-1, 1, -1, 1, -3)],
        "beside, moving": [make.quad(2, 3, -1, 1, 0, shift=(0, 2))],
    }[name]
    scene = PlainScene(meshes, make.IDENTITY, w, h, background)
    frame = make.render(scene, dtype)
    expected = torch.as_tensor(np.broadcast_to(background, (h, w, 3)).copy(), dtype=frame.rgba.dtype)
    torch.testing.assert_close(
        frame.rgba[..., :3], expected, rtol=0, atol=1e-7 if frame.rgba.dtype == torch.float32 else 1e-15
    )
    assert (frame.rgba[..., 3] == 0).all()
    assert frame.coverage.shape == (h, w, len(meshes))
    assert (frame.coverage == 0).all()
    now = tb.render_instant(make.to_torch(scene, dtype), t=0.5)
    torch.testing.assert_close(now.rgba[..., :3], expected, rtol=0, atol=1e-7)
    assert (now.mesh_id == -1).all()
    assert (now.face_id == -1).all()
    assert torch.isinf(now.depth_view).all()
    assert (now.motion_px == 0).all()


def test_29_one_empty_pixel_beside_full_ones(dtype):
    scene = PlainScene([make.quad(-1, 0, -2, 3, 0, color=RED)], make.IDENTITY, 2, 1, background=GREEN)
    got = make.render(scene, dtype).rgba[0].double().numpy()
    np.testing.assert_array_equal(got, [(1, 0, 0, 1), (0, 1, 0, 0)])


def test_30_minus_zero_is_zero(dtype):
    start, end = np.array([(-1.0, 0.0), (1.0, 0.0), (0.0, 2.0)]), np.array([(-1.0, -1.0), (1.0, -1.0), (0.0, 2.0)])
    plain, negative = make.triangle(start, end), make.triangle(start, end)
    negative.vertices = np.where(negative.vertices == 0, -0.0, negative.vertices)
    assert coverage(plain, dtype) == pytest.approx(1.0, abs=1e-7)
    assert coverage(negative, dtype) == coverage(plain, dtype)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["used vertex", "unused vertex"])
def test_30_vertices_that_are_not_finite_are_rejected(value, where):
    vertices = torch.zeros(2, 4, 3)
    vertices[1, 0 if where == "used vertex" else 3, 1] = value
    with pytest.raises(ValueError, match=r"vertices: expected finite values, got"):
        tb.Mesh(vertices, [[0, 1, 2]])


@pytest.mark.parametrize("size", [1e6, 1e30, 1e100])
def test_30_huge_neighbours_contaminate_nothing(size):
    small = make.quad(-0.5, 0.5, -0.5, 0.5, 0.1, 0.2, shift=(0.3, 0.1), color=RED, opacity=0.5)
    # off screen to the right, and a second that passes behind everything on its way
    huge = make.triangle([(2, -size), (size, 0), (2, size)], [(3, -size), (size, 1), (3, size)], color=GREEN)
    alone, together = (make.render(PlainScene(m, make.IDENTITY, 8, 8, BLUE)).rgba for m in ([small], [small, huge]))
    assert torch.isfinite(together).all()
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-12)
