"""`render` against `accumulate`, and both against the oracle, on varied scenes.

The gap between the exact exposure and the mean of N midpoint instants comes from events only: colours are flat between
events, and one event of contrast c moves the mean by at most c / (2 N). So no pixel may differ by more than 2 / N times
its number of events (contrast is at most 1, the rest is slack), and the mean gap over the image falls as 1 / N.
"""

from __future__ import annotations

import functools

import numpy as np
import oracles
import pytest
import scene_makers as make
import torch
from agreement_scenes import SCENES

import torchblur as tb

COUNTS = (64, 256, 1024, 4096)
ATOL = 1e-9  # the stated exactness in float64


@functools.cache
def exact(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the oracle's RGBA (H, W, 4), coverage (H, W, M) and number of events (H, W) of a scene."""
    scene = SCENES[name]()
    answers = [[oracles.integrate_pixel(scene, r, c) for c in range(scene.width)] for r in range(scene.height)]
    return tuple(
        np.array([[getattr(a, key) for a in row] for row in answers]) for key in ("rgba", "coverage", "n_events")
    )


@pytest.mark.parametrize("name", list(SCENES))
def test_every_pixel_is_the_oracles(name):
    rgba, coverage, n_events = exact(name)
    frame = make.render(SCENES[name]())
    np.testing.assert_allclose(frame.rgba.numpy(), rgba, rtol=0, atol=ATOL)
    np.testing.assert_allclose(frame.coverage.numpy(), coverage, rtol=0, atol=ATOL)
    assert n_events.max() >= 4, "nothing happens in this scene"
    assert rgba.std() > 0.02, "nothing to see in this scene"


@pytest.mark.parametrize("name", list(SCENES))
def test_float32_is_close_to_the_oracle(name):
    rgba, _, n_events = exact(name)
    gap = np.abs(make.render(SCENES[name](), torch.float32).rgba.double().numpy() - rgba).max(-1)
    # vertices rounded to 6e-8 move an event by that over the edge's speed, here above 1e-3 NDC a shutter: 1e-4 an event
    assert (gap <= 1e-6 + 1e-4 * n_events).all()
    assert gap.mean() < 1e-5  # and far less on the average


@pytest.mark.parametrize("name", list(SCENES))
def test_gap_to_accumulation_falls_as_one_over_n(name):
    scene = make.to_torch(SCENES[name]())
    _, _, n_events = exact(name)
    blurred = tb.render(scene).rgba.numpy()
    means = []
    for n in COUNTS:
        gap = np.abs(tb.accumulate(scene, times=n).rgba.numpy() - blurred)
        assert (gap.max(-1) <= 2 / n * n_events + 1e-12).all(), f"N = {n}"
        means.append(gap.mean())
    slope = np.polyfit(np.log(COUNTS), np.log(means), 1)[0]
    # -1 in the mean; some hundred events of random phase make it uncertain by a few hundredths over six doublings
    assert slope <= -0.9, (slope, means)


def test_accumulation_is_the_mean_of_midpoint_instants():
    scene = make.to_torch(SCENES["moving camera"]())
    mean = sum(tb.render_instant(scene, t=(k + 0.5) / 5).rgba for k in range(5)) / 5
    torch.testing.assert_close(tb.accumulate(scene, times=5).rgba, mean, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["opaque", "moving camera", "four segments"])
def test_accumulation_follows_the_window_and_the_rays(name):
    scene, n = make.to_torch(SCENES[name]()), 256
    options = {"shutter": tb.Shutter.box(0.3, 0.85), "rays_per_pixel": 3}
    gap = np.abs(tb.accumulate(scene, times=n, **options).rgba.numpy() - tb.render(scene, **options).rgba.numpy())
    # three rays, each with the events of a neighbourhood of its pixel: at most three times the most of any pixel
    assert gap.max() <= 2 / n * 3 * exact(name)[2].max()
    assert gap.mean() < 1 / (2 * n)  # an event of contrast 1 moves the mean by at most as much; most are smaller
    assert np.abs(tb.render(scene).rgba.numpy() - tb.render(scene, **options).rgba.numpy()).max() > 0.05


@pytest.mark.parametrize("seed", range(8))
def test_random_pixels_of_random_scenes(seed):
    generator = np.random.default_rng(100 + seed)
    scene = make.random_soup(
        generator,
        60,
        width=40,
        height=30,
        n_segments=1 + seed % 4,
        size=0.2 + 0.1 * (seed % 3),
        motion=0.2 + 0.3 * (seed % 4),
    )
    window = [(0.0, 1.0), (0.2, 0.7)][seed % 2]
    frame = make.render(scene, t_open=window[0], t_close=window[1])
    for _ in range(30):
        row, col = int(generator.integers(scene.height)), int(generator.integers(scene.width))
        answer = oracles.integrate_pixel(scene, row, col, *window)
        np.testing.assert_allclose(
            frame.rgba[row, col].numpy(), answer.rgba, rtol=0, atol=ATOL, err_msg=f"{row}, {col}"
        )
        np.testing.assert_allclose(frame.coverage[row, col].numpy(), answer.coverage, rtol=0, atol=ATOL)
