"""Image metrics: closed forms and laws that need nothing else, then scikit-image and FLIP's authors' own program."""

from __future__ import annotations

import doctest
import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from torchblur import metrics

METRICS = [metrics.psnr, metrics.ssim, metrics.flip_ldr, metrics.flip_hdr]
NAMES = [m.__name__ for m in METRICS]
FLIPS = METRICS[2:]
NAN, INF = float("nan"), float("inf")
EPS = {"rtol": 0, "atol": 1e-12}  # float64 sums of some hundred terms near 1, with a margin of 100
# A root turns the float32 rounding of a filtered luminance, 1e-7, into 3e-4 of a feature's strength: where colours
# differ, a pixel moves by that times e ln e, less than 2e-4.
FLOAT32 = {"rtol": 0, "atol": 2e-4}


def pairs(h: int, w: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return images and references in [0, 1] by name."""
    rng = np.random.default_rng([h, w])
    y, x = np.mgrid[:h, :w] / max(h, w)
    ramp = np.stack([x, y, np.full_like(x, 0.5)], -1)
    checks = ((np.floor(8 * x) + np.floor(8 * y)) % 2)[..., None] * np.array([0.9, 0.3, 0.1])
    square = np.zeros((h, w, 3))
    square[h // 3 : h // 2 + 1, w // 4 : w // 2 + 1] = [1.0, 0.2, 0.0]
    lines = (np.arange(w) % 3 == 0)[None, :, None] * np.ones((h, 1, 3))
    return {
        "random": (rng.random((h, w, 3)), rng.random((h, w, 3))),
        "noise on a ramp": ((ramp + 0.05 * rng.standard_normal(ramp.shape)).clip(0, 1), ramp),
        "shifted checks": (np.roll(checks, 1, 1), checks),
        "shifted square": (np.roll(square, 1, 0), square),
        "darker lines": (0.8 * lines, lines),
        "flat": (np.full((h, w, 3), 0.7), np.full((h, w, 3), 0.65)),
        "green and blue": (np.full((h, w, 3), [0.0, 1, 0]), np.full((h, w, 3), [0.0, 0, 1])),
    }


KINDS = list(pairs(3, 3))


def two(h: int = 19, w: int = 23, kind: str = "random", dtype: torch.dtype = torch.float64) -> list[torch.Tensor]:
    """Return an image and a reference as tensors."""
    return [torch.tensor(v, dtype=dtype) for v in pairs(h, w)[kind]]


def flat(r: float, g: float, b: float, size: int = 11) -> torch.Tensor:
    """Return an image of one colour, as large as SSIM's window."""
    return torch.tensor([r, g, b], dtype=torch.float64).expand(size, size, 3)


def flip_of_colors(srgb: tuple, other: tuple) -> float:
    """Return LDR-FLIP of two flat images in plain Python: no blur, no feature is left of the published formulas."""

    def lab(color: tuple) -> tuple[float, float, float]:
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in color]
        rows = [(0.41238656, 0.35759149, 0.18045049), (0.21263682, 0.71518298, 0.07218020)]  # to XYZ, D65
        rows += [(0.01933062, 0.11919716, 0.95037259)]
        f = []
        for row in rows:
            t = sum(m * c for m, c in zip(row, linear, strict=True)) / sum(row)
            f.append(t ** (1 / 3) if t > (6 / 29) ** 3 else t / (3 * (6 / 29) ** 2) + 4 / 29)
        lightness = 116 * f[1] - 16
        return lightness, 0.01 * lightness * 500 * (f[0] - f[1]), 0.01 * lightness * 200 * (f[1] - f[2])

    def distance(one: tuple, two: tuple) -> float:
        p, q = lab(one), lab(two)
        return (abs(p[0] - q[0]) + math.hypot(p[1] - q[1], p[2] - q[2])) ** 0.7

    greatest = distance((0, 1, 0), (0, 0, 1))
    error = distance(srgb, other)
    knee = 0.4 * greatest
    return error * 0.95 / knee if error < knee else 0.95 + 0.05 * (error - knee) / (greatest - knee)


# closed forms


@pytest.mark.parametrize("offset", [1e-6, 0.01, 0.25, 1.0])
def test_psnr_of_a_constant_offset(offset):
    image = torch.zeros(3, 5, 3, dtype=torch.float64)
    assert_close(metrics.psnr(image + offset, image).item(), -20 * math.log10(offset), **EPS)


def test_psnr_of_one_wrong_channel_of_one_pixel_on_the_border():
    image = torch.zeros(4, 5, 3)
    wrong = image.clone()
    wrong[0, 0, 2] = 1.0
    # float32 keeps 7 digits of 17.78
    assert_close(metrics.psnr(wrong, image).item(), 10 * math.log10(60), rtol=0, atol=1e-5)


def test_psnr_of_a_small_offset_in_a_large_image_keeps_its_digits():
    image = torch.full((500, 400, 3), 0.5)
    # 600,000 equal squares: a float32 sum could lose digits, the float64 one leaves the offset's own rounding, 6e-5
    assert_close(metrics.psnr(image + 2.0**-10, image).item(), 20 * math.log10(2**10), rtol=0, atol=1e-5)


@pytest.mark.parametrize(("a", "b"), [(0.0, 1.0), (0.2, 0.6), (0.5, 0.5)])
def test_ssim_of_constants(a, b):
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)  # no variance: only the luminance term is left
    assert_close(metrics.ssim(flat(a, a, a), flat(b, b, b)).item(), expected, **EPS)


def test_ssim_is_the_mean_of_three_channels():
    half = (2 * 0.5 * 1.0 + 1e-4) / (0.25 + 1.0 + 1e-4)
    expected = (2 + half) / 3
    assert_close(metrics.ssim(flat(0.3, 0.7, 0.5), flat(0.3, 0.7, 1.0)).item(), expected, **EPS)


def test_ssim_of_one_window_by_its_definition():
    image, reference = two(11, 11)
    x = torch.arange(-5.0, 6.0, dtype=torch.float64)
    weights = torch.exp(-(x[:, None] ** 2 + x[None] ** 2) / (2 * 1.5**2))
    weights = (weights / weights.sum())[..., None]
    total = lambda v: (weights * v).sum((0, 1))  # noqa: E731
    ma, mb = total(image), total(reference)
    va, vb, cov = total((image - ma) ** 2), total((reference - mb) ** 2), total((image - ma) * (reference - mb))
    expected = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    assert_close(metrics.ssim(image, reference), expected.mean(), **EPS)


@pytest.mark.parametrize(
    ("color", "other"),
    [
        ((0, 0, 0), (1, 1, 1)),
        ((0.5, 0.5, 0.5), (0.52, 0.5, 0.48)),
        ((0.02, 0.03, 0.01), (0, 0, 0.04)),
        ((1, 0, 0), (0, 1, 0)),
        ((0.9, 0.1, 0.4), (0.7, 0.2, 0.4)),
    ],
)
def test_flip_of_flat_colors(color, other):
    # a blur of a constant leaves 1e-16 of feature; its root, 1e-8, times 200 for the steepest pixel
    found = metrics.flip_ldr(flat(*color), flat(*other))
    assert_close(found, torch.full_like(found, flip_of_colors(color, other)), rtol=0, atol=2e-6)


def test_flip_of_green_and_blue_is_one(dtype):
    found = metrics.flip_ldr(flat(0, 1, 0).to(dtype), flat(0, 0, 1).to(dtype))
    assert_close(found, torch.ones_like(found), rtol=0, atol=1e-5)  # float32 L*a*b* of about 100 keeps 1e-5


@pytest.mark.parametrize("scale", [1e-4, 1.0, 100.0])
def test_exposures_by_hand(scale):
    """1 of 9 pixels is 64 times as bright as the rest: 6 stops lie between the greatest luminance and the median."""
    image = torch.full((3, 3, 3), scale, dtype=torch.float64)
    image[1, 2] *= 64  # exactly, so that the stops are not rounded up to 7
    found = metrics.find_exposures(image)
    assert len(found) == 6
    assert_close(found, list(np.linspace(found[0], found[0] + 6, 6)), **EPS)
    x = 0.6 * scale * 2 ** found[-1]
    assert_close((2.51 * x * x + 0.03 * x) / (2.43 * x * x + 0.59 * x + 0.14), 0.85, **EPS)


def test_median_of_two_is_the_upper():
    first, last = metrics.find_exposures(torch.tensor([[[1.0] * 3, [8.0] * 3]]))
    assert first == last


def test_exposures_of_black_are_finite():
    black = torch.zeros(4, 4, 3)
    assert len(metrics.find_exposures(black)) == 2
    one = black.clone()
    one[0, 0] = 8.0
    assert len(metrics.find_exposures(one)) == 26  # 3 + 23 stops
    assert metrics.flip_hdr(black, black).max() == 0
    assert metrics.flip_hdr(one, black).max() > 0.9


def test_flip_hdr_of_overexposed_light_keeps_its_surroundings():
    """Exposed by 2²⁴ for the black around it, the light's square exceeds float32."""
    reference = torch.zeros(3, 5, 3, dtype=torch.float64)
    reference[0, 0] = 1e15
    image = reference.clone()
    image[1, 2] = 1e-7
    found = metrics.flip_hdr(image, reference)
    assert found[1, 2] > 0.1
    assert_close(metrics.flip_hdr(image.float(), reference.float()), found.float(), **FLOAT32)


@pytest.mark.parametrize(
    ("kind", "ldr", "hdr"),
    [
        ("random", 0.46779, 0.45941),
        ("shifted checks", 0.29830, 0.41878),
        ("shifted square", 0.11221, 0.18344),
        ("darker lines", 0.41277, 0.14766),
    ],
)
def test_flip_means_that_flip_evaluator_1_7_returned(kind, ldr, hdr):
    """Numbers for a place where that package is missing: every filter of the features shows in them."""
    image, reference = two(17, 31, kind, torch.float32)
    found = [metrics.flip_ldr(image, reference), metrics.flip_hdr(30 * image**2, 30 * reference**2)]
    assert_close([metrics.mean(m).item() for m in found], [ldr, hdr], rtol=0, atol=3e-5)  # 5 digits, float32's roots


def test_pooling_by_hand():
    errors = torch.tensor([[[0.0, 0.0], [0.2, 0.6]], [[0.0, 0.0], [0.0, 0.0]]], dtype=torch.float64)
    assert_close(metrics.mean(errors), torch.tensor([0.2, 0.0], dtype=torch.float64), **EPS)
    assert metrics.weighted_median(errors).tolist() == [0.6, 0.0]
    ones = torch.tensor([[0.1, 0.3, 0.2, 0.15]])  # 0.1 + 0.15 < 0.375 <= 0.1 + 0.15 + 0.2
    assert metrics.weighted_median(ones) == torch.tensor(0.2)


def test_examples():
    failed, tried = doctest.testmod(metrics)
    assert failed == 0
    assert tried == 2


# laws


@pytest.mark.parametrize("kind", KINDS)
def test_equal_images(kind, dtype, device):
    image = two(kind=kind, dtype=dtype)[0].to(device)
    assert metrics.psnr(image, image.clone()) == INF
    assert metrics.ssim(image, image.clone()) == 1
    for flip in FLIPS:
        assert flip(image, image.clone()).max() == 0


@pytest.mark.parametrize("kind", KINDS)
def test_order_of_the_images_matters_to_hdr_flip_only(kind):
    image, reference = two(kind=kind)
    for metric in METRICS[:3]:
        assert_close(metric(image, reference), metric(reference, image), **EPS)
    bright = 20 * reference
    assert metrics.mean(metrics.flip_hdr(image, bright)) != metrics.mean(metrics.flip_hdr(bright, image))


def test_more_noise_is_more_error(rng):
    reference = torch.tensor(0.3 + 0.4 * pairs(24, 30)["noise on a ramp"][1])
    noise = torch.tensor(rng.uniform(-1, 1, reference.shape))
    found = {m.__name__: [] for m in METRICS}
    for amount in (0.01, 0.03, 0.1, 0.3):
        for m in METRICS:
            value = m(reference + amount * noise, reference)
            found[m.__name__].append(float(value if value.ndim == 0 else metrics.mean(value)))
    for name, values in found.items():
        assert values == sorted(values, reverse=name in ("psnr", "ssim")), (name, values)
        assert len(set(values)) == 4


def test_range_scales_with_the_data():
    image, reference = two()
    for metric in METRICS[:2]:
        scaled = metric(255 * image, 255 * reference, data_range=255.0)
        assert_close(scaled, metric(image, reference), **EPS)
        assert abs(metric(image, reference, data_range=2.0) - scaled) > 1e-3


def test_exposing_both_images_alike_changes_nothing_in_hdr():
    image, reference = two(kind="noise on a ramp")
    # powers of two are exact, the exposures' logarithms are not: 1e-16 through a root
    assert_close(metrics.flip_hdr(32 * image, 32 * reference), metrics.flip_hdr(image, reference), rtol=0, atol=1e-7)
    assert (metrics.flip_ldr(image / 2, reference / 2) - metrics.flip_ldr(image, reference)).abs().max() > 1e-3


def test_hdr_flip_is_the_greatest_over_its_exposures():
    image, reference = (5 * v**2 for v in two(kind="noise on a ramp"))
    shown = []
    for stops in metrics.find_exposures(reference):
        pair = []
        for v in (image, reference):
            x = 0.6 * v * 2**stops
            y = ((2.51 * x * x + 0.03 * x) / (2.43 * x * x + 0.59 * x + 0.14)).clamp(0, 1)
            pair.append(torch.where(y <= 0.0031308, 12.92 * y, 1.055 * y ** (1 / 2.4) - 0.055).clamp(0, 1))
        shown.append(metrics.flip_ldr(*pair))
    # sRGB there and back: its published knee is off by 1e-8 of the curve, which the power 0.7 and a root enlarge
    assert_close(metrics.flip_hdr(image, reference), torch.stack(shown).amax(0), rtol=0, atol=1e-4)


@pytest.mark.parametrize("flip", FLIPS, ids=NAMES[2:])
def test_finer_pixels_show_less_of_their_noise(flip):
    found = [metrics.mean(flip(*two(), pixels_per_degree=ppd)) for ppd in (20.0, 67.0, 130.0)]
    assert found[0] > 1.2 * found[1] > 1.2**2 * found[2]


def test_flip_of_a_picture_turned_is_the_map_turned():
    image, reference = two()
    for turn in (lambda v: v.flip(0), lambda v: v.flip(1), lambda v: v.transpose(0, 1)):
        assert_close(metrics.flip_ldr(turn(image), turn(reference)), turn(metrics.flip_ldr(image, reference)), **EPS)


def test_a_firefly_shows_as_point_and_edges():
    """Colour alone would blur the error of one pixel: features make it stronger, and it ends with their reach."""
    reference = torch.full((31, 31, 3), 0.2, dtype=torch.float64)
    image = reference.clone()
    image[15, 15] = 1.0
    found = metrics.flip_ldr(image, reference)
    assert found[15, 15] == found.max()
    assert found[15, 15] > 3 * found[15, 25]


@pytest.mark.parametrize("metric", METRICS, ids=NAMES)
def test_batch_is_one_by_one(metric, dtype):
    kinds = ["random", "shifted square", "darker lines"]
    images, references = (torch.stack(v) for v in zip(*(two(kind=k, dtype=dtype) for k in kinds), strict=True))
    together = metric(images, references)
    alone = torch.stack([metric(a, b) for a, b in zip(images, references, strict=True)])
    assert together.dtype == dtype
    # the same operations; vectorised powers may round by an entry's place, which float32 roots enlarge
    assert_close(together, alone, **(FLOAT32 if dtype == torch.float32 else {"rtol": 0, "atol": 1e-7}))
    for pool in (metrics.mean, metrics.weighted_median) if together.ndim == 3 else ():
        assert_close(pool(together), torch.stack([pool(m) for m in together]), rtol=1e-6, atol=0)


@pytest.mark.parametrize("metric", METRICS, ids=NAMES)
def test_strided_and_foreign_input(metric, device):
    image, reference = two()
    strided = [v.permute(2, 0, 1).contiguous().permute(1, 2, 0) for v in (image, reference)]
    expected = metric(image, reference)
    assert_close(metric(*strided), expected, **EPS)
    assert_close(metric(image.numpy(), reference.numpy()), expected, **EPS)
    # another device's powers differ in the last bit: 1e-16 through a root
    assert_close(metric(image.to(device), reference.to(device)).cpu(), expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_float32_is_near_float64(kind):
    for metric in METRICS:
        exact = metric(*two(kind=kind))
        rough = metric(*two(kind=kind, dtype=torch.float32))
        assert rough.dtype == torch.float32
        if metric in FLIPS:
            assert_close(rough.to(exact), exact, **FLOAT32)
            assert_close(metrics.mean(rough).to(exact), metrics.mean(exact), **FLOAT32)
        else:
            assert_close(rough.to(exact), exact, rtol=1e-6, atol=1e-6)  # rounding of the input and the result


# gradients


@pytest.mark.parametrize("metric", METRICS, ids=NAMES)
def test_gradients(metric):
    h, w = (12, 11) if metric is metrics.ssim else (3, 4)
    options = {"pixels_per_degree": 8.0} if metric in FLIPS else {}
    image, reference = (0.25 + 0.5 * v for v in two(h, w))  # away from black and white, where colours are clipped
    image.requires_grad_()
    assert torch.autograd.gradcheck(lambda a: metric(a, reference, **options), (image,))
    reference.requires_grad_(metric is not metrics.flip_hdr)  # whose exposures count as constants
    if reference.requires_grad:
        assert torch.autograd.gradcheck(lambda b: metric(image.detach(), b, **options), (reference,))


@pytest.mark.parametrize("flip", FLIPS, ids=NAMES[2:])
@pytest.mark.parametrize("kind", ["shifted square", "darker lines", "flat"])
def test_flip_gradients_are_finite_where_images_agree(flip, kind, dtype):
    image, reference = two(kind=kind, dtype=dtype)
    image.requires_grad_()
    error_map = flip(image, reference)
    (metrics.mean(error_map) + metrics.weighted_median(error_map)).backward()
    assert image.grad.isfinite().all()
    assert image.grad.abs().max() > 0


# bad input

GOOD = torch.full((12, 12, 3), 0.5)


def with_value(value: float) -> torch.Tensor:
    """Return a good image but for its last value."""
    image = GOOD.clone()
    image[-1, -1, -1] = value
    return image


@pytest.mark.parametrize("metric", METRICS, ids=NAMES)
@pytest.mark.parametrize(
    ("image", "reference", "error", "words"),
    [
        (GOOD[:11], GOOD, ValueError, r"^image: expected the shape and dtype of the reference, \(12, 12, 3\).* got"),
        (GOOD[None], GOOD, ValueError, r"^image: expected the shape .*got \(1, 12, 12, 3\) float32$"),
        (GOOD.double(), GOOD, ValueError, r"^image: expected the shape .*float32, got .*float64$"),
        (GOOD[..., :1], GOOD[..., :1], ValueError, r"^image: expected \(H, W, 3\) or \(B, H, W, 3\)"),
        (GOOD, torch.ones(12, 12, 4), ValueError, r"^reference: expected \(H, W, 3\) or .*got \(12, 12, 4\)"),
        (GOOD[:0], GOOD[:0], ValueError, r"^image: expected at least one pixel"),
        (GOOD.new_zeros(0, 12, 12, 3), GOOD.new_zeros(0, 12, 12, 3), ValueError, r"^image: expected at least one"),
        (torch.ones(12, 12, 3, dtype=torch.uint8), GOOD, TypeError, r"^image: .*float32 or float64, got .*uint8"),
        (GOOD.half(), GOOD, TypeError, r"^image: .*float32 or float64, got .*float16"),
        (with_value(NAN), GOOD, ValueError, r"^image: expected finite values, got nan at index \(11, 11, 2\)"),
        (GOOD, with_value(INF), ValueError, r"^reference: expected finite values, got inf at index \(11, 11, 2\)"),
        ("picture.png", GOOD, TypeError, r"^image: expected .*numbers, got str"),
    ],
)
def test_bad_images(metric, image, reference, error, words):
    with pytest.raises(error, match=words):
        metric(image, reference)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: metrics.psnr(GOOD, GOOD, data_range=0.0), ValueError, r"^data_range: expected a finite number in \["),
        (lambda: metrics.ssim(GOOD, GOOD, data_range=-1.0), ValueError, r"^data_range: expected .*got float -1.0"),
        (lambda: metrics.psnr(GOOD, GOOD, data_range="1"), TypeError, r"^data_range: "),
        (lambda: metrics.ssim(GOOD, GOOD, data_range=INF), ValueError, r"^data_range: "),
        (lambda: metrics.ssim(GOOD[:10], GOOD[:10]), ValueError, r"^image: expected at least 11 pixels high and wide"),
        (lambda: metrics.ssim(GOOD[:, :10], GOOD[:, :10]), ValueError, r"^image: expected at least 11 pixels"),
        (lambda: metrics.flip_ldr(with_value(1.01), GOOD), ValueError, r"^image: expected values in \[0, 1\], got 1.0"),
        (lambda: metrics.flip_ldr(GOOD, with_value(-0.5)), ValueError, r"^reference: .*\[0, 1\], got -0.5"),
        (
            lambda: metrics.flip_hdr(with_value(-0.5), GOOD),
            ValueError,
            r"^image: expected values of at least 0, got -0",
        ),
        (lambda: metrics.flip_hdr(GOOD, with_value(-0.5)), ValueError, r"^reference: .* at least 0, got -0.5"),
        (lambda: metrics.flip_ldr(GOOD, GOOD, pixels_per_degree=0.5), ValueError, r"^pixels_per_degree: .*got float"),
        (lambda: metrics.flip_hdr(GOOD, GOOD, pixels_per_degree=None), TypeError, r"^pixels_per_degree: "),
        (lambda: metrics.find_exposures(GOOD[None]), ValueError, r"^reference: expected \(H, W, 3\)"),
        (lambda: metrics.find_exposures(with_value(-1.0)), ValueError, r"^reference: .*at least 0, got -1.0"),
        (lambda: metrics.mean(GOOD[0, 0]), ValueError, r"^error_map: expected \(H, W\) or \(B, H, W\)"),
        (lambda: metrics.weighted_median(torch.zeros(2, 0)), ValueError, r"^error_map: expected at least one pixel"),
        (lambda: metrics.weighted_median(-torch.ones(2, 2)), ValueError, r"^error_map: .* at least 0, got -1.0"),
    ],
)
def test_bad_arguments(call, error, words):
    with pytest.raises(error, match=words):
        call()


def test_images_on_two_devices(device):
    if device.type == "cpu":
        pytest.skip("needs a second device")
    with pytest.raises(ValueError, match=r"^devices: expected one device"):
        metrics.psnr(GOOD, GOOD.to(device))


# the authors' programs


@pytest.fixture(scope="module")
def skimage_metrics():
    """Return scikit-image's metrics."""
    return pytest.importorskip("skimage.metrics", reason="scikit-image is the oracle of PSNR and SSIM")


@pytest.fixture(scope="module")
def flip_evaluator():
    """Return FLIP as its authors publish it; it computes in float32."""
    return pytest.importorskip("flip_evaluator", reason="flip-evaluator is the oracle of FLIP")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [(11, 11), (11, 40), (17, 31), (40, 53)])
def test_ssim_and_psnr_agree_with_scikit_image(skimage_metrics, size, kind, dtype):
    image, reference = (v.astype(str(dtype).removeprefix("torch.")) for v in pairs(*size)[kind])
    expected = skimage_metrics.structural_similarity(
        image,
        reference,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        channel_axis=-1,
        data_range=1,
    )
    ours = [f(torch.tensor(image), torch.tensor(reference)).item() for f in METRICS[:2]]
    # float64: sums in another order. float32: scikit-image's own E[x²] - E[x]² loses digits against 9e-4
    assert_close(ours[1], float(expected), rtol=0, atol=1e-12 if dtype == torch.float64 else 1e-5)
    expected = skimage_metrics.peak_signal_noise_ratio(reference, image, data_range=1)
    assert_close(ours[0], float(expected), rtol=0, atol=1e-12 if dtype == torch.float64 else 1e-5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("size", "ppd"),
    [((1, 1), 67.0), ((2, 7), 20.0), ((5, 3), 130.5), ((17, 31), 67.0), ((40, 53), 20.0), ((40, 53), 67.0)],
)
@pytest.mark.parametrize("flip", FLIPS, ids=NAMES[2:])
def test_flip_agrees_with_its_authors(flip_evaluator, flip, size, kind, ppd):
    image, reference = pairs(*size)[kind]
    if flip is metrics.flip_hdr:
        image, reference = 30 * image**2 + 1e-3, 30 * reference**2 + 1e-3
    image, reference = image.astype(np.float32), reference.astype(np.float32)
    mode = flip.__name__.removeprefix("flip_").upper()
    expected, pooled, used = flip_evaluator.evaluate(reference, image, mode, True, False, True, {"ppd": ppd})
    for dtype in (torch.float32, torch.float64):
        ours = flip(*(torch.tensor(v, dtype=dtype) for v in (image, reference)), pixels_per_degree=ppd)
        # float32's roots, here and there; the authors' float32 mean of equal values drifts as well
        assert_close(ours, torch.tensor(expected[..., 0], dtype=dtype), **FLOAT32)
        assert_close(metrics.mean(ours).item(), float(pooled), **FLOAT32)
    if mode == "HDR":
        exposures = metrics.find_exposures(torch.tensor(reference))
        assert len(exposures) == used["numExposures"]
        ends = [used["startExposure"], used["stopExposure"]]
        assert_close([exposures[0], exposures[-1]], ends, rtol=0, atol=1e-5)  # float32 logarithms up to 10


@pytest.mark.parametrize("kind", ["random", "noise on a ramp"])
@pytest.mark.parametrize("flip", FLIPS, ids=NAMES[2:])
def test_flip_of_noise_agrees_closely(flip_evaluator, flip, kind):
    """Every pixel differs and has features: no root is near 0, which leaves few of float32's last digits in doubt."""
    image, reference = (v.astype(np.float32) for v in pairs(40, 53)[kind])
    mode = flip.__name__.removeprefix("flip_").upper()
    expected, pooled, _ = flip_evaluator.evaluate(reference, image, mode, True, False, True, {"ppd": 67.0})
    ours = flip(torch.tensor(image).double(), torch.tensor(reference).double())
    assert_close(ours, torch.tensor(expected[..., 0]).double(), rtol=0, atol=2e-5)
    assert_close(metrics.mean(ours).item(), float(pooled), rtol=0, atol=3e-6)


def test_pooled_values_agree_with_the_authors_tool(flip_evaluator, tmp_path):
    image, reference = (np.rint(255 * v).astype(np.uint8) for v in pairs(40, 53)["noise on a ramp"])
    for name, pixels in (("image", image), ("reference", reference)):
        Image.fromarray(pixels).save(tmp_path / f"{name}.png")
    program = "import flip_evaluator.flip_python_api as api; api.main()"
    options = ["-r", "reference.png", "-t", "image.png", "-v", "2", "-ppd", "67", "-nexm", "-nerm"]
    done = subprocess.run(
        [sys.executable, "-c", program, *options], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    printed = dict(line.strip().split(": ", 1) for line in done.stdout.splitlines() if ": " in line)
    ours = metrics.flip_ldr(torch.tensor(image / 255), torch.tensor(reference / 255))
    assert_close(metrics.mean(ours).item(), float(printed["Mean"]), rtol=0, atol=1e-5)  # 6 digits are printed
    # one step in the order of 2,120 errors that reach from 0 to 0.3, where the tool interpolates
    assert_close(metrics.weighted_median(ours).item(), float(printed["Weighted median"]), rtol=0, atol=1e-3)
