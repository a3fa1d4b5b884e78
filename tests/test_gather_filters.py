"""The directional and the gather filters against plain transcriptions, and what holds of each of them."""

import filter_transcriptions as plain
import numpy as np
import pytest
import torch

from datagen.baselines import gather
from datagen.baselines.directional import directional, directional_image
from datagen.baselines.guertin2014 import guertin2014
from datagen.baselines.mcguire2012 import mcguire2012
from datagen.baselines.views import View

FILTERS = {
    "directional": lambda view, **options: directional(view.color, view.motion_px, **options),
    "mcguire2012": mcguire2012,
    "guertin2014": guertin2014,
}
H, W = 11, 14


def random_view(generator, batch=1, dtype=torch.float64, speed=9.0, h=H, w=W):
    """Noise in which a part stands still, a part moves as one, and a part has nothing in it."""
    color = torch.rand(batch, 3, h, w, generator=generator, dtype=torch.float64)
    motion = speed * (torch.rand(batch, 2, h, w, generator=generator, dtype=torch.float64) - 0.5)
    depth = 1 + torch.rand(batch, 1, h, w, generator=generator, dtype=torch.float64)
    motion[:, :, : h // 3] = 0
    motion[:, :, :, : w // 3] = torch.tensor([0.6 * speed, -0.3 * speed], dtype=torch.float64)[:, None, None]
    depth[:, :, :, w // 2 : w // 2 + 2] = torch.inf
    depth[:, :, h // 2 :, : w // 4] = 0.5
    return View(color.to(dtype), motion.to(dtype), depth.to(dtype))


def lists(view):
    """The first image of a view as lists for the transcriptions."""
    color, motion = (p[0].permute(1, 2, 0).tolist() for p in (view.color, view.motion_px))
    return color, motion, view.depth_view[0, 0].tolist()


def assert_same(image, expected):
    expected = torch.from_numpy(np.array(expected)).permute(2, 0, 1)
    torch.testing.assert_close(image[0].double(), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("seed", [None, 3])
@pytest.mark.parametrize(("samples", "tile_px", "soft_depth"), [(15, 4, 0.3), (5, 20, 0.05), (9, 3, 10.0)])
def test_mcguire2012_is_its_pseudo_code(generator, samples, tile_px, soft_depth, seed):
    view = random_view(generator)
    noise = None if seed is None else gather.pixel_noise(view.color, 1, seed)[0].tolist()
    blurred = mcguire2012(view, samples=samples, tile_px=tile_px, soft_depth=soft_depth, seed=seed)
    assert_same(blurred, plain.mcguire2012(*lists(view), samples, tile_px, soft_depth, noise))
    assert float((blurred - view.color).abs().max()) > 0.1


@pytest.mark.parametrize("seed", [None, 3])
@pytest.mark.parametrize(("samples", "tile_px"), [(35, 4), (7, 40), (12, 3)])
def test_guertin2014_is_its_pseudo_code(generator, samples, tile_px, seed):
    view = random_view(generator)
    noise = None if seed is None else gather.pixel_noise(view.color, 3, seed).tolist()
    blurred = guertin2014(view, samples=samples, tile_px=tile_px, seed=seed)
    assert_same(blurred, plain.guertin2014(*lists(view), samples, tile_px, noise))
    assert float((blurred - view.color).abs().max()) > 0.1


@pytest.mark.parametrize("samples", [1, 4, 32])
def test_directional_is_the_mean_along_each_motion(generator, samples):
    view = random_view(generator)
    color, motion, _ = lists(view)
    assert_same(directional(view.color, view.motion_px, samples=samples), plain.directional(color, motion, samples))


@pytest.mark.parametrize("motion", [(6.0, 0.0), (0.0, 7.5), (4.0, -3.0), (-5.0, -2.0), (0.7, 0.7)])
def test_directional_image_is_one_kernel(generator, motion):
    view = random_view(generator)
    blurred = directional_image(view.color, torch.tensor([motion], dtype=torch.float64))
    assert_same(blurred, plain.directional_image(lists(view)[0], motion))


def test_a_line_kernel_has_the_motions_direction():
    """y points down: a motion to the right and down smears a dot to the right and down, and to the left and up."""
    dot = torch.zeros(1, 1, 9, 9, dtype=torch.float64)
    dot[..., 4, 4] = 1
    blurred = directional_image(dot, torch.tensor([[4.0, 4.0]], dtype=torch.float64))[0, 0]
    assert float(blurred[5, 5]) > 0.1 < float(blurred[3, 3])
    assert float(blurred[3, 5]) == pytest.approx(0, abs=1e-12) == float(blurred[5, 3])


def test_in_one_motion_the_weights_of_2012_are_2_plus_a_cone():
    """2 (1 - |t|) + 2 at t = -1 + 2 (i + 1) / 16 of 15 taps, from 2.25 to 4, and 1 / |V| in the middle."""
    n, v = 15, 8.0
    image = torch.eye(33, dtype=torch.float64).reshape(33, 1, 1, 33)  # the 33 unit impulses
    view = View(image, torch.zeros(33, 2, 1, 33, dtype=torch.float64) + torch.tensor([2 * v, 0.0])[:, None, None],
                torch.ones(33, 1, 1, 33, dtype=torch.float64))  # fmt: skip
    kernel = mcguire2012(view, samples=n, tile_px=20, seed=None)[:, 0, 0, 16]
    expected = torch.zeros(33, dtype=torch.float64)
    for i in range(n):
        t = -1 + 2 * (i + 1) / (n + 1)
        expected[16 + round(t * v)] += 1 / v if i == n // 2 else 2 * (1 - abs(t)) + 2
    assert float(expected[9]) == 2.25  # the outermost tap
    torch.testing.assert_close(kernel, expected / expected.sum(), rtol=0, atol=1e-5)  # V is 1e-5 px short


@pytest.mark.parametrize("name", FILTERS)
def test_constant_images_and_still_ones_stay(generator, device, dtype, name):
    view = random_view(generator, dtype=dtype)
    view = View(*(p.to(device) for p in (view.color, view.motion_px, view.depth_view)))
    flat = torch.full_like(view.color, 0.37)
    torch.testing.assert_close(FILTERS[name](View(flat, view.motion_px, view.depth_view)), flat, rtol=0, atol=1e-6)
    for speed in (0.0, 0.5, 1.0):
        motion = torch.zeros_like(view.motion_px)
        motion[:, 0] = speed
        blurred = FILTERS[name](View(view.color, motion, view.depth_view))
        assert bool((blurred == view.color).all())
    assert blurred.dtype == dtype
    assert blurred.device == view.color.device


@pytest.mark.parametrize("name", FILTERS)
def test_an_image_does_not_depend_on_its_batch(generator, name):
    view = random_view(generator, batch=3)
    together = FILTERS[name](view)
    for b in range(3):
        alone = View(*(p[b : b + 1] for p in (view.color, view.motion_px, view.depth_view)))
        torch.testing.assert_close(FILTERS[name](alone)[0], together[b], rtol=0, atol=0)


def test_kernels_of_different_lengths_share_a_batch(generator):
    color = random_view(generator, batch=3).color
    motion = torch.tensor([[5.0, 1.0], [0.0, 0.2], [-2.0, 8.0]], dtype=torch.float64)
    together = directional_image(color, motion)
    for b in range(3):
        torch.testing.assert_close(
            directional_image(color[b : b + 1], motion[b : b + 1])[0], together[b], rtol=0, atol=0
        )
    assert bool((together[1] == color[1]).all())


@pytest.mark.parametrize("name", ["mcguire2012", "guertin2014"])
def test_the_seed_decides_the_noise(generator, name):
    view = random_view(generator)
    first, again, other, none = (FILTERS[name](view, seed=s) for s in (1, 1, 2, None))
    assert bool((first == again).all())
    assert float((first - other).abs().max()) > 1e-3
    assert float((first - none).abs().max()) > 1e-3


@pytest.mark.parametrize("name", FILTERS)
def test_gradients_to_colour(generator, name):
    view = random_view(generator, h=6, w=7, speed=7.0)
    color = view.color[:, :1].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda c: FILTERS[name](View(c, view.motion_px, view.depth_view)), (color,))


@pytest.mark.parametrize("name", FILTERS)
def test_gradients_to_motion_and_depth(generator, name):
    """No two depths are equal: there the weights have kinks. Motions decide in steps too, where a tap changes pixel."""
    color, motion = torch.rand(1, 1, 4, 5, generator=generator), 6 * torch.rand(1, 2, 4, 5, generator=generator)
    depth = 1 + torch.rand(1, 1, 4, 5, generator=generator)
    color, motion, depth = (p.double() for p in (color, motion, depth))
    if name != "directional":
        assert torch.autograd.gradcheck(
            lambda d: FILTERS[name](View(color, motion, d)), (depth.clone().requires_grad_(),)
        )
    assert torch.autograd.gradcheck(lambda m: FILTERS[name](View(color, m, depth)), (motion.clone().requires_grad_(),))


@pytest.mark.parametrize("name", FILTERS)
def test_gradients_are_finite_where_nothing_is_and_nothing_moves(generator, name):
    view = random_view(generator)
    leaves = [p.clone().requires_grad_() for p in (view.color, view.motion_px, view.depth_view)]
    FILTERS[name](View(*leaves)).square().sum().backward()
    for leaf in leaves[: 2 if name == "directional" else 3]:
        assert bool(torch.isfinite(leaf.grad).all())
        assert float(leaf.grad.abs().max()) > 0


def test_a_moving_square_smears_over_what_stands_behind(generator):
    """Both gather filters carry a near mover over a still ground, no further to one side than to the other."""
    color = torch.zeros(1, 1, 40, 40, dtype=torch.float64)
    color[..., 16:24, 14:26] = 1
    motion = torch.zeros(1, 2, 40, 40, dtype=torch.float64)
    motion[:, 0, 16:24, 14:26] = 12
    depth = 2 - color
    for blur in (mcguire2012, guertin2014):
        blurred = blur(View(color, motion, depth), seed=None)[0, 0]
        assert 0.1 < float(blurred[20, 11]) < 0.9  # 3 px outside the sharp outline
        assert float(blurred[20, 11] - blurred[20, 9]) > 0.05
        assert 0.8 < float(blurred[20, 15]) < 0.95  # as far inside: sharper than the 0.62 of a true blur
        torch.testing.assert_close(blurred, blurred.flip(1), rtol=0, atol=1e-9)
        assert float(blurred[:, :4].abs().max()) == 0
        assert float(blurred[:15].abs().max()) == 0


GOOD = {"color": torch.rand(2, 3, 5, 6), "motion_px": torch.zeros(2, 2, 5, 6), "depth_view": torch.ones(2, 1, 5, 6)}
BAD_VIEWS = {
    "shape of colour": ("color", torch.rand(3, 5, 6), ValueError),
    "whole colours": ("color", torch.ones(2, 3, 5, 6, dtype=torch.int64), TypeError),
    "NaN colour": ("color", torch.full((2, 3, 5, 6), torch.nan), ValueError),
    "motion of another size": ("motion_px", torch.zeros(2, 2, 5, 7), ValueError),
    "motion of another type": ("motion_px", torch.zeros(2, 2, 5, 6, dtype=torch.float64), TypeError),
    "NaN motion": ("motion_px", torch.full((2, 2, 5, 6), torch.nan), ValueError),
    "depth of one image": ("depth_view", torch.ones(1, 1, 5, 6), ValueError),
    "depth 0": ("depth_view", torch.zeros(2, 1, 5, 6), ValueError),
    "NaN depth": ("depth_view", torch.full((2, 1, 5, 6), torch.nan), ValueError),
    "no data": ("depth_view", torch.ones(2, 1, 5, 6, device="meta"), TypeError),
}


@pytest.mark.parametrize("case", BAD_VIEWS)
def test_a_wrong_view_is_refused_by_name(case):
    name, value, error = BAD_VIEWS[case]
    with pytest.raises(error, match=f"^{name}: expected .*, got "):
        View(**(GOOD | {name: value}))


@pytest.mark.parametrize(
    ("name", "call", "error"),
    [
        ("view", lambda v: mcguire2012(v.color), TypeError),
        ("view", lambda v: guertin2014(v.color), TypeError),
        ("samples", lambda v: mcguire2012(v, samples=4), ValueError),
        ("samples", lambda v: guertin2014(v, samples=0), ValueError),
        ("samples", lambda v: directional(v.color, v.motion_px, samples=2.0), TypeError),
        ("tile_px", lambda v: mcguire2012(v, tile_px=0), ValueError),
        ("tile_px", lambda v: guertin2014(v, tile_px=True), TypeError),
        ("soft_depth", lambda v: mcguire2012(v, soft_depth=0.0), ValueError),
        ("motion_px", lambda v: directional(v.color, v.color), ValueError),
        ("motion_px", lambda v: directional_image(v.color, torch.zeros(3, 2)), ValueError),
        ("motion_px", lambda v: directional_image(v.color, torch.full((2, 2), 1e6)), ValueError),
        ("seed", lambda v: mcguire2012(v, seed=1.5), TypeError),
        ("seed", lambda v: guertin2014(v, seed=-1), ValueError),
    ],
)
def test_wrong_arguments_are_refused_by_name(name, call, error):
    with pytest.raises(error, match=f"^{name}: expected .*, got "):
        call(View(**GOOD))


def test_tensors_on_two_devices_are_refused():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device on this machine")
    with pytest.raises(ValueError, match="devices: expected one device"):
        View(**(GOOD | {"motion_px": GOOD["motion_px"].cuda()}))
