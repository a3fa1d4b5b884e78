"""Shutters: weights in closed form, windows from one set of intervals, rolling lines, and accumulation as referee."""

import numpy as np
import pytest
import torch

import torchblur as tb

FLOAT64 = torch.float64


def sliding_edge(n=8, speed=2.0, height=1):
    """Return a scene in which a half-plane's left edge passes column i at shutter time (1 - (i + 0.5) / n)."""
    square = torch.tensor([[1.0, -3, 0], [9, -3, 0], [9, 3, 0], [1, 3, 0]], dtype=FLOAT64)
    shift = torch.tensor([-speed, 0.0, 0.0], dtype=FLOAT64)
    mesh = tb.Mesh(torch.stack([square, square + shift]), [[0, 1, 2], [0, 2, 3]], tb.Material((1.0, 1.0, 1.0)))
    return tb.Scene([mesh], tb.Camera(torch.eye(4, dtype=FLOAT64), n, height))


def passing_times(n=8):
    return 1 - (np.arange(n) + 0.5) / n


def integral(shutter, start):
    """Return the share of the shutter's weight after `start`, by fine midpoints."""
    t = (np.arange(400_000) + 0.5) / 400_000
    h = np.interp(t, shutter.times, shutter.weights, left=0, right=0)
    return h[t > start].sum() / h.sum()


SHUTTERS = {
    "box": tb.Shutter.box(),
    "late box": tb.Shutter.box(0.25, 0.7),
    "trapezoid": tb.Shutter.trapezoid(0.1, 0.3, 0.6, 0.9),
    "triangle": tb.Shutter.trapezoid(0.0, 0.5, 0.5, 1.0),
    "steep": tb.Shutter.trapezoid(0.2, 0.2, 0.5, 1.0),
    "pieces": tb.Shutter((0.0, 0.2, 0.3, 0.8, 1.0), (1.0, 0.0, 3.0, 0.5, 0.5)),
}


@pytest.mark.parametrize("name", list(SHUTTERS))
def test_an_edge_is_weighed_by_the_time_after_it_passes(name):
    shutter = SHUTTERS[name]
    seen = tb.render(sliding_edge(), shutter=shutter).coverage[0, :, 0].numpy()
    expected = [integral(shutter, t) for t in passing_times()]
    np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-5)  # the sum above has steps of 1 / 400,000
    if name == "triangle":
        t = passing_times()
        exact = np.where(t < 0.5, 1 - 2 * t**2, 2 * (1 - t) ** 2)
        np.testing.assert_allclose(seen, exact, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", list(SHUTTERS))
def test_accumulation_under_the_same_shutter_agrees(name):
    generator = torch.Generator().manual_seed(5)
    vertices = (torch.rand(2, 36, 3, dtype=FLOAT64, generator=generator) - 0.5) * 3
    material = tb.Material(torch.rand(12, 3, generator=generator), 0.6)
    camera = tb.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y_deg=40, width=9, height=7, near=0.1, far=10)
    scene = tb.Scene([tb.Mesh(vertices, torch.arange(36).reshape(12, 3), material)], camera, background=(0.1, 0.2, 0.3))
    exact = tb.render(scene, shutter=SHUTTERS[name]).rgba
    gaps = [float((tb.accumulate(scene, n, shutter=SHUTTERS[name]).rgba - exact).abs().mean()) for n in (100, 1600)]
    assert gaps[1] < gaps[0] / 8  # 1 / N would be 16; one draw of events leaves room of 2
    assert gaps[1] < 1e-3


def test_windows_are_the_frames_of_their_own_shutters_and_average_to_the_whole():
    scene = sliding_edge()
    whole = SHUTTERS["pieces"]
    windows = [(0.0, 0.25), (0.25, 0.5), (0.5, 1.0), (0.1, 0.9)]
    frames = tb.render_windows(scene, windows, shutter=whole)
    for (start, end), frame in zip(windows, frames, strict=True):
        alone = tb.render(scene, shutter=whole.window(start, end))
        torch.testing.assert_close(frame.rgba, alone.rgba, rtol=0, atol=1e-14)
        torch.testing.assert_close(frame.coverage, alone.coverage, rtol=0, atol=1e-14)
    shares = [1 - integral(whole, 0.25), integral(whole, 0.25) - integral(whole, 0.5), integral(whole, 0.5)]
    mean = sum(s * f.rgba for s, f in zip(shares, frames[:3], strict=True))
    torch.testing.assert_close(mean, tb.render(scene, shutter=whole).rgba, rtol=0, atol=1e-5)  # shares by sums


def test_windows_share_one_set_of_intervals():
    scene = sliding_edge()
    frames = tb.render_windows(scene, [(0, 0.5), (0.5, 1), (0.2, 0.4)])
    assert frames[0].counts["intervals"] == tb.render(scene).counts["intervals"]
    assert frames[0].counts is frames[2].counts


@pytest.mark.parametrize("direction", ["down", "up", "right", "left"])
def test_a_rolling_shutter_delays_line_by_line(direction):
    n, height, delay, exposure = 8, 5, 0.08, 0.3
    seen = tb.render(sliding_edge(n, height=height), shutter=tb.Shutter.rolling(delay, exposure, direction))
    passing = passing_times(n)
    for row in range(height):
        for column in range(n):
            line = {"down": row, "up": height - 1 - row, "right": column, "left": n - 1 - column}[direction]
            start = line * delay
            expected = np.clip((start + exposure - passing[column]) / exposure, 0, 1)
            assert float(seen.coverage[row, column, 0]) == pytest.approx(expected, abs=1e-13)


def test_a_rolling_shutter_bends_a_moving_bar_as_accumulation_does():
    scene = sliding_edge(16, height=12)
    shutter = tb.Shutter.rolling(0.05, 0.2, "down")
    exact = tb.render(scene, shutter=shutter).rgba
    assert (exact[0] - exact[-1]).abs().max() > 0.9
    gap = (tb.accumulate(scene, 4000, shutter=shutter).rgba - exact).abs().max()
    assert gap < 2 / (4000 * 0.2)  # one event a line, whose exposure holds 0.2 * 4000 instants


def test_without_delay_a_rolling_shutter_is_a_box():
    scene = sliding_edge()
    rolling = tb.render(scene, shutter=tb.Shutter.rolling(0.0, 0.5))
    assert torch.equal(rolling.rgba, tb.render(scene, shutter=tb.Shutter.box(0, 0.5)).rgba)


def test_the_time_of_an_event_has_its_gradient_under_any_shutter():
    square = torch.tensor([[1.0, -3, 0], [9, -3, 0], [9, 3, 0], [1, 3, 0]], dtype=FLOAT64)
    faces = [[0, 1, 2], [0, 2, 3]]
    camera = tb.Camera(torch.eye(4, dtype=FLOAT64), 4, 3)

    def seen(vertices):
        scene = tb.Scene([tb.Mesh(vertices, faces)], camera)
        bent = tb.render(scene, shutter=tb.Shutter((0.0, 0.4, 0.8), (1.0, 3.0, 0.0), line_delay=0.1))
        return torch.cat([bent.rgba[..., 0], tb.render(scene, shutter=SHUTTERS["trapezoid"]).rgba[..., 0]])

    end = square + torch.tensor([-1.9, 0.1, 0.0], dtype=FLOAT64)
    vertices = torch.stack([square, end]).requires_grad_()
    assert torch.autograd.gradcheck(seen, (vertices,))


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: tb.Shutter((0.0,), (1.0,)), "times"),
        (lambda: tb.Shutter((0.0, 0.0), (1.0, 1.0)), "times"),
        (lambda: tb.Shutter((0.5, 0.2), (1.0, 1.0)), "times"),
        (lambda: tb.Shutter((0.0, 1.5), (1.0, 1.0)), r"times\[1\]"),
        (lambda: tb.Shutter("ab", (1.0, 1.0)), "times"),
        (lambda: tb.Shutter((0.0, 1.0), (1.0,)), "weights"),
        (lambda: tb.Shutter((0.0, 1.0), (0.0, 0.0)), "weights"),
        (lambda: tb.Shutter((0.0, 1.0), (1.0, -1.0)), r"weights\[1\]"),
        (lambda: tb.Shutter((0.0, 1.0), (1.0, float("nan"))), r"weights\[1\]"),
        (lambda: tb.Shutter(line_delay=-0.1), "line_delay"),
        (lambda: tb.Shutter(direction="sideways"), "direction"),
        (lambda: tb.Shutter.trapezoid(0.5, 0.2, 0.7, 0.9), "t_open, t_full, t_fade, t_close"),
        (lambda: tb.Shutter.rolling(0.1, 0.0), "line_exposure"),
        (lambda: tb.Shutter.box().window(0.5, 0.5), "window"),
        (lambda: tb.Shutter.box(0.0, 0.4).window(0.5, 0.8), "window"),
        (lambda: tb.Shutter((0, 0.4, 0.6, 1), (1, 0, 0, 1)).window(0.45, 0.55), "window"),
        (lambda: tb.Shutter.rolling(0.01, 0.5).window(0.1, 0.2), "shutter"),
        (lambda: tb.render(sliding_edge(height=9), shutter=tb.Shutter.rolling(0.1, 0.5)), "shutter"),
        (lambda: tb.render_windows(sliding_edge(), []), "windows"),
        (lambda: tb.render_windows(sliding_edge(), [(0, 0.5, 1)]), "windows"),
        (lambda: tb.render_windows(sliding_edge(), 0.5), "windows"),
        (lambda: tb.render_windows(sliding_edge(), [(0, 1)], shutter="box"), "shutter"),
    ],
)
def test_bad_shutters_are_refused_by_name(make, name):
    with pytest.raises((TypeError, ValueError), match=rf"^{name}: expected .*, got "):
        make()


@pytest.mark.parametrize(
    "shutter",
    [
        tb.Shutter.box(),
        tb.Shutter.box(0.2, 0.3),
        tb.Shutter.trapezoid(0.1, 0.2, 0.7, 0.9),
        tb.Shutter.trapezoid(0.0, 0.5, 0.5, 1.0),
        tb.Shutter((0.0, 0.3, 0.6, 1.0), (1.0, 0.0, 0.0, 2.0)),
        tb.Shutter((0.0, 0.5, 1.0), (0.0, 1e-9, 1.0)),
    ],
)
def test_time_of_is_the_inverse_of_the_weight_that_has_passed(shutter):
    share = torch.linspace(0, 1, 1001, dtype=torch.float64)
    t = shutter.time_of(share)
    assert (t.diff() >= 0).all()
    assert t[0] >= shutter.t_open
    assert t[-1] <= shutter.t_close
    passed = shutter.weight(torch.full_like(t, shutter.t_open), t, torch.zeros(1001, dtype=torch.int64))
    assert torch.allclose(passed, share, rtol=0, atol=1e-14)
