"""The oracles agree with answers by hand and with each other, so that a red test elsewhere accuses torchblur."""

from __future__ import annotations

import numpy as np
import oracles
import pytest
import scene_makers as make
from oracles import PlainScene

W_IS_Z = make.w_is_z(0.1, 100.0)
CASE_8 = [[-1, -1], [1, -1], [0, 1]]


def test_pieces_of_hand_made_cases():
    nine = make.triangle([(-12, 18), (-27, -18), (110, 70)], [(10, -5), (-9, 6), (-110, -90)])
    pieces = oracles.find_pieces(PlainScene([nine]), 0, 0)
    root = 3 * np.sqrt(105)
    expected = [(0, 1 / 8), (3 / 10, 141 / 286), (2 / 3, (543 - root) / 628), ((543 + root) / 628, 1)]
    np.testing.assert_allclose([(p.t_start, p.t_end) for p in pieces], expected, atol=1e-13)
    through = make.triangle([(*p, 2.0) for p in CASE_8], [(*p, -2.0) for p in CASE_8])
    (piece,) = oracles.find_pieces(PlainScene([through], W_IS_Z), 0, 0)
    assert (piece.t_start, piece.t_end) == pytest.approx((0, 0.475), abs=1e-13)


def test_facing_is_cut_exactly():
    turning = make.triangle([(-0.3, -0.3), (0.7, 1.7), (1.7, 0.7)], [(-0.3, -0.3), (0.7, -2.3), (-2.3, 0.7)])
    pieces = oracles.find_pieces(PlainScene([turning]), 0, 0)
    assert sum(p.t_end - p.t_start for p in pieces if p.front) == pytest.approx(7 / 20, abs=1e-13)
    assert sum(p.t_end - p.t_start for p in pieces if not p.front) == pytest.approx(1 / 4, abs=1e-13)


def test_integral_of_two_crossing_planes():
    red = make.quad(-9, 9, -9, 9, 1, 0, color=(1, 0, 0), opacity=0.5)
    green = make.quad(-9, 9, -9, 9, 0, 1, color=(0, 1, 0), opacity=0.5)
    for mesh in (red, green):
        mesh.vertices = mesh.vertices - np.array([0.3, 0.1, 0])  # away from the diagonal: the oracle has no tie rule
    answer = oracles.integrate_pixel(PlainScene([red, green], background=(0, 0, 1)), 0, 0)
    np.testing.assert_allclose(answer.rgba, (0.375, 0.375, 0.25, 0.75), atol=1e-14)
    np.testing.assert_allclose(answer.coverage, (1, 1))


@pytest.mark.parametrize("seed", range(3))
def test_integral_is_what_samples_approach(seed):
    rng = np.random.default_rng(seed)
    scene = make.random_soup(rng, 25, n_segments=1 + seed)
    n = 1024
    times = (np.arange(n) + 0.5) / n
    for _ in range(3):
        row, col = int(rng.integers(scene.height)), int(rng.integers(scene.width))
        answer = oracles.integrate_pixel(scene, row, col)
        sampled = oracles.sample_pixel(scene, row, col, times).mean(0)
        # an event moves the mean of N midpoint samples by at most contrast / (2 N), and the contrast is at most 1
        assert np.abs(answer.rgba - sampled).max() <= (answer.n_events + 1) / (2 * n)


def test_rational_layers_agree_with_the_general_integral():
    layers = [
        (0.25, 0.75, 0.5, -0.5, (1, 0, 0), 0.5),
        (0.0, 0.5, -0.25, 0.25, (0, 1, 0), 1.0),
        (0.125, 1.0, 0.8, 0.9, (0, 0, 1), 0.5),
    ]
    meshes = [make.slab(a, b, z0, z1, color=c, opacity=o) for a, b, z0, z1, c, o in layers]
    for mesh in meshes:
        mesh.vertices = mesh.vertices - np.array([0, 0.3, 0])  # off the diagonal
    general = oracles.integrate_pixel(PlainScene(meshes, background=(1, 1, 1)), 0, 0).rgba
    fractions = [
        oracles.Layer(*(oracles.Fraction(str(v)) for v in (a, b, z0, z1)), color=c, alpha=o)
        for a, b, z0, z1, c, o in layers
    ]
    np.testing.assert_allclose(oracles.composite_layers(fractions, (1, 1, 1)), general, atol=1e-13)
