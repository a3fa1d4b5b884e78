"""Light and accuracies where they are hard: lamps that all but touch, spots that light nothing, vanishing directions,
shutters that see a part of a cell, textures that meshes share.
"""

import math

import numpy as np
import pytest
import torch

import torchblur as tb
from torchblur.atlas import build_atlas

FLOAT64 = torch.float64
SQUARE = torch.tensor([[-3.0, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], dtype=FLOAT64)
FACES = [[0, 1, 2], [0, 2, 3]]
UV = torch.tensor([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], dtype=FLOAT64)
UPRIGHT = torch.diag(torch.tensor([1.0, 1, -0.1, 1], dtype=FLOAT64))


def plate(vertices=SQUARE, **material):
    return tb.Mesh(vertices, FACES, tb.Material((1.0, 1.0, 1.0), **material), uv=UV)


def one_pixel(mesh, size=(1, 1), **scene):
    return tb.Scene([mesh], tb.Camera(UPRIGHT, *size), **scene)


def passing_lamp(place, height):
    """Return a lamp that passes x = 0 at shutter time `place` and moves by 1."""
    knots = torch.tensor([[-place, 0.0, height], [1 - place, 0.0, height]], dtype=FLOAT64)
    return tb.PointLight(knots, 1.0)


def mean_of_lamp(place, height):
    """Return the mean of h / (h^2 + x^2)^(3/2) / pi along x from -place to 1 - place."""
    at = [x / math.hypot(x, height) for x in (-place, 1 - place)]
    return (at[1] - at[0]) / (math.pi * height)


@pytest.mark.parametrize("height", [1e-2, 1e-3])
@pytest.mark.parametrize("n", [1, 6, 12])
def test_lamps_that_all_but_touch_keep_the_bound(n, height):
    places = [(k + 0.5) / n + 0.0137 for k in range(n)]
    scene = one_pixel(plate(shading="lambert"), lights=[passing_lamp(p, height) for p in places])
    expected = sum(mean_of_lamp(p, height) for p in places)
    peak = 1 / (math.pi * height**2)
    assert float(tb.render(scene).rgba[0, 0, 0]) == pytest.approx(expected, abs=1e-6 * peak, rel=1e-9)


@pytest.mark.parametrize("outer_deg", [0.1, 1.0, 5.0, 30.0])
def test_a_spot_that_lights_nothing_changes_nothing(outer_deg):
    lamp = passing_lamp(0.43, 1e-3)
    spot = tb.SpotLight(
        (2.0, 0.0, 3.0), (2.0, 1.0, 0.0), 9.0, inner_angle_deg=0.8 * outer_deg, outer_angle_deg=outer_deg
    )
    alone, both = (tb.render(one_pixel(plate(shading="lambert"), lights=k)) for k in ([lamp], [lamp, spot]))
    assert float(both.rgba[0, 0, 0]) == pytest.approx(float(alone.rgba[0, 0, 0]), rel=1e-12)
    assert both.counts["nodes"] <= alone.counts["nodes"]


@pytest.mark.parametrize("accuracy", [tb.Accuracy.exact(), tb.Accuracy.linear()], ids=["exact", "linear"])
def test_directions_that_vanish_light_nothing_for_that_instant(accuracy):
    spot = tb.SpotLight((0.0, 0.0, 1.0), torch.tensor([[1.0, 0, 1], [-1, 0, 1]], dtype=FLOAT64), 1.0)
    sun = tb.DirectionalLight(torch.tensor([[0.0, 0, -1], [0, 0, 1]], dtype=FLOAT64), math.pi)
    scene = one_pixel(plate(shading="lambert"), lights=[spot, sun])
    assert torch.isfinite(tb.render(scene, accuracy=accuracy).rgba).all()
    assert tb.render_instant(scene, 0.5).rgba[0, 0].tolist() == [0, 0, 0, 1]
    half = tb.render(one_pixel(plate(shading="lambert"), lights=[sun])).rgba[0, 0, 0]
    assert float(half) == pytest.approx(0.5, abs=1e-9)  # it shines from the front for half of the exposure


@pytest.mark.parametrize("length", [1e-170, 1e170])
def test_normals_of_any_length(length):
    mesh = tb.Mesh(
        SQUARE,
        FACES,
        tb.Material((1.0, 1.0, 1.0), shading="lambert"),
        normals=torch.tensor([[0, 0, length]] * 4, dtype=FLOAT64),
    )
    scene = one_pixel(mesh, lights=[tb.DirectionalLight((0.0, 0.0, -1.0), math.pi)])
    assert float(tb.render(scene).rgba[0, 0, 0]) == pytest.approx(1, abs=1e-12)


def sliding_ramp(**scene):
    """Return a plate whose colour falls linearly along x and that slides by 1."""
    ramp = torch.linspace(0, 1, 129, dtype=FLOAT64)[:, None, None].expand(129, 1, 3).permute(1, 0, 2)
    knots = torch.stack([SQUARE, SQUARE + torch.tensor([1.0, 0, 0], dtype=FLOAT64)])
    return one_pixel(plate(knots, texture=ramp.contiguous(), wrap="clamp", mipmap=False), **scene)


@pytest.mark.parametrize("accuracy", [tb.Accuracy.linear(), tb.Accuracy.adaptive(0.01)], ids=["linear", "adaptive"])
def test_approximations_see_what_the_shutter_sees(accuracy):
    """A ramp that slides evenly is what linear gets right, window by window, whichever windows are asked for."""
    windows = [(0.0, 0.25), (0.25, 0.5), (0.1, 0.7), (0.75, 1.0)]
    together = tb.render_windows(sliding_ramp(), windows, accuracy=accuracy)
    for window, frame in zip(windows, together, strict=True):
        exact = tb.render(sliding_ramp(), shutter=tb.Shutter.box(*window)).rgba
        own = tb.render(sliding_ramp(), shutter=tb.Shutter.box(*window), accuracy=accuracy).rgba
        torch.testing.assert_close(frame.rgba, exact, rtol=0, atol=2e-3)  # the filter of few taps
        torch.testing.assert_close(own, exact, rtol=0, atol=2e-3)


def test_approximations_roll():
    shutter = tb.Shutter.rolling(0.3, 0.05)
    scene = sliding_ramp(size=(1, 4))
    linear, exact = (tb.render(scene, shutter=shutter, accuracy=a).rgba for a in (tb.Accuracy.linear(), None))
    torch.testing.assert_close(linear, exact, rtol=0, atol=2e-3)
    assert float((exact[0] - exact[3]).abs().max()) > 0.1, "all lines see the same: the comparison is blind"


def test_meshes_share_a_texture_in_the_atlas():
    texture = torch.rand(16, 8, 3, dtype=FLOAT64, generator=torch.Generator().manual_seed(0))
    meshes = tuple(plate(texture=texture, mipmap=k % 2 == 0) for k in range(6))
    atlas = build_atlas(meshes, torch.device("cpu"))
    pyramid = 16 * 8 + 8 * 4 + 4 * 2 + 2 + 1
    assert len(atlas.texels) == pyramid + 16 * 8
    assert atlas.n_levels.tolist() == [5, 1] * 3
    np.testing.assert_array_equal(atlas.texels[atlas.first[0, 5]][:3], texture[0, 0])


def test_weights_whose_sum_overflows_are_refused():
    with pytest.raises(ValueError, match="weights: expected"):
        tb.Shutter((0.0, 0.5, 1.0), (1e308, 1e308, 1e308))
