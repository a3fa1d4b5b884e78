"""Measure the distance between two images: PSNR, SSIM, and FLIP for low and high dynamic range.

Before: render.py, or files read from elsewhere.  After: nothing in torchblur.
Symbols: B images of H × W pixels; Y luminance; ppd pixels per degree of visual angle; c exposure in stops.
Source: SSIM of Wang et al. 2004, sec. III.C; LDR-FLIP of Andersson et al. 2020; HDR-FLIP of Andersson et al. 2021.
Filters are sums of weighted shifts: convolutions of float32 may be rounded to 10 bits on some devices.

Images are (H, W, 3) or (B, H, W, 3), float32 or float64; both have one shape, dtype and device. The result has their
dtype and keeps the batch axis, if there is one.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchblur import check

IMAGES, MAPS = (("H", "W", 3), ("B", "H", "W", 3)), (("H", "W"), ("B", "H", "W"))  # shapes
SSIM_RADIUS_PX, SSIM_SIGMA_PX = 5, 1.5  # the 11 × 11 window of Wang et al.
SSIM_K1, SSIM_K2 = 0.01, 0.03
MIN_RANGE = 1e-30  # keeps the squares of K1 and K2 times it above 0

# CIE x, y of red, green, blue of sRGB and of the white D65, with FLIP's digits
PRIMARIES, WHITE = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06)), (0.31271, 0.32902)
# Terms (a, b) of the contrast sensitivity of each opponent channel Y, Cx, Cz; b in degrees²
SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
FEATURE_WIDTH_DEG = 0.082  # of the edges and points that an observer notices
COLOR_POWER, FEATURE_POWER = 0.7, 0.5  # q_c and q_f
COLOR_KNEE, ERROR_KNEE = 0.4, 0.95  # p_c and p_t: the colour error's first 40 % take 95 % of the scale
# Rational fit of the ACES tone curve, x exposed by 0.6: the default of the reference implementation
ACES = ((0.6**2 * 2.51, 0.6 * 0.03, 0.0), (0.6**2 * 2.43, 0.6 * 0.59, 0.14))
BRIGHTEST = 0.85  # tone-mapped value that ends the exposures
LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights of linear sRGB
MIN_LUMINANCE = 2.0**-23  # floor of the exposures' luminances, so that black pixels keep them finite


def psnr(image: Tensor, reference: Tensor, *, data_range: float = 1.0) -> Tensor:
    """Return 10 log10(data_range² / MSE) [dB], the mean taken over all pixels, the border included, and channels.

    Args:
        image, reference: any space, linear or sRGB, but the same; values beyond `data_range` are taken as they are.
        data_range: greatest less smallest value that the space allows.

    Returns:
        () or (B,); inf where the images are equal.

    Raises:
        TypeError, ValueError: shapes, dtypes or devices differ, NaN or inf, or `data_range` is not positive.

    Gradient: to both images; not finite where they are equal.  Accuracy: the mean is taken in float64.

    Example:
        >>> psnr(torch.full((2, 2, 3), 0.6), torch.full((2, 2, 3), 0.5))
        tensor(20.0000)
    """
    a, b, shape = _read_pair(image, reference)
    peak = check.number("data_range", data_range, low=MIN_RANGE)
    mse = (a.to(torch.float64) - b.to(torch.float64)).square().mean((1, 2, 3))
    return (20 * math.log10(peak) - 10 * torch.log10(mse)).to(a.dtype).reshape(shape[:-3])


def ssim(image: Tensor, reference: Tensor, *, data_range: float = 1.0) -> Tensor:
    """Return the structural similarity: the mean over the three channels, each taken alone, and the inner pixels.

    Inner pixels are those whose 11 × 11 window lies in the image, so nothing is made up beyond the border and the
    outer five rows and columns are window content only. Variances are the window's own (weights sum to 1).

    Args:
        image, reference: any space, linear or sRGB, but the same; at least 11 pixels high and wide.
        data_range: greatest less smallest value that the space allows.

    Returns:
        () or (B,), in [-1, 1]; 1 where the images are equal.

    Raises:
        TypeError, ValueError: as of `psnr`, or an image smaller than the window.

    Gradient: to both images.
    Accuracy: moments are taken in float64, since E[x²] - E[x]² cancels.
    Source: Wang et al. 2004, eq. 13 and sec. III.C.
    """
    a, b, shape = _read_pair(image, reference)
    peak = check.number("data_range", data_range, low=MIN_RANGE)
    side = 2 * SSIM_RADIUS_PX + 1
    if min(a.shape[1:3]) < side:
        raise check.fail("image", f"at least {side} pixels high and wide", image)
    x, y = a.to(torch.float64), b.to(torch.float64)
    weights = _gaussian(SSIM_RADIUS_PX, SSIM_SIGMA_PX)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = (
        _filter(_filter(v, weights, 2), weights, 1) for v in (x, y, x * x, y * y, x * y)
    )
    c1, c2 = (SSIM_K1 * peak) ** 2, (SSIM_K2 * peak) ** 2
    squares = mean_x.square() + mean_y.square()
    variances = (mean_xx - mean_x.square()) + (mean_yy - mean_y.square())
    covariance = mean_xy - mean_x * mean_y
    quotient = (2 * mean_x * mean_y + c1) * (2 * covariance + c2) / ((squares + c1) * (variances + c2))
    return quotient.mean((1, 2, 3)).to(a.dtype).reshape(shape[:-3])


def flip_ldr(image: Tensor, reference: Tensor, *, pixels_per_degree: float = 67.0) -> Tensor:
    """Return the LDR-FLIP error of each pixel: what an observer sees flipping between the two images.

    Args:
        image, reference: sRGB in [0, 1]; the border pixels are repeated outwards.
        pixels_per_degree: of visual angle; 67 is 3,840 pixels on 0.7 m seen from 0.7 m.

    Returns:
        (H, W) or (B, H, W) in [0, 1]; 0 where the images are equal. Pool it with `mean` or `weighted_median`.

    Raises:
        TypeError, ValueError: as of `psnr`; values outside [0, 1]; fewer than one pixel per degree.

    Gradient: to both images; 0 is taken where a root's is infinite: at equal pixels and on ground without features.
    Accuracy: in float32 a map differs from its float64 one by less than 2e-4, a root of its rounding.
    """
    a, b, shape = _read_pair(image, reference)
    ppd = check.number("pixels_per_degree", pixels_per_degree, low=1.0)
    check.unit_range("image", a)
    check.unit_range("reference", b)
    return _flip(_linear_of_srgb(a), _linear_of_srgb(b), ppd).reshape(shape[:-1])


def flip_hdr(image: Tensor, reference: Tensor, *, pixels_per_degree: float = 67.0) -> Tensor:
    """Return the HDR-FLIP error of each pixel: the greatest LDR-FLIP error over the reference's exposures.

    Both images are exposed as `find_exposures` says, each pair of a batch alone, mapped by the ACES tone curve and
    clipped to [0, 1].

    Args:
        image, reference: linear sRGB, at least 0; the border pixels are repeated outwards.
        pixels_per_degree: as of `flip_ldr`.

    Returns, raises and gradient: as of `flip_ldr`, but values may exceed 1; no gradient to the exposures.
    Cost: that of `flip_ldr` times the number of exposures, 2 at least, 26 or so where most of the reference is black.
    """
    a, b, shape = _read_pair(image, reference, low=0.0)
    ppd = check.number("pixels_per_degree", pixels_per_degree, low=1.0)
    maps = []
    for one, other in zip(a, b, strict=True):
        worst = one.new_zeros(one.shape[:-1])
        for stops in find_exposures(other):
            pair = (_aces(v[None] * 2.0**stops) for v in (one, other))
            worst = torch.maximum(worst, _flip(*pair, ppd)[0])
        maps.append(worst)
    return torch.stack(maps).reshape(shape[:-1])


def find_exposures(reference: Tensor) -> list[float]:
    """Return the exposures c [stops] at which HDR-FLIP compares an (H, W, 3) linear reference.

    They run in equal steps from the one that tone-maps the greatest luminance to 0.85 to the one that does so to the
    median, as many as the stops between them rounded up, at least two.

    Source: Andersson et al. 2021. Of an even number of pixels the median is the upper of the middle two, as
    in the reference implementation. Ours: luminances below 2⁻²³ count as 2⁻²³, so that a black image has exposures.
    """
    image = _read("reference", reference, ("H", "W", 3), low=0.0).detach().to(torch.float64)
    ordered = _mix(image, [LUMINANCE]).flatten().sort().values
    brightest, median = (max(float(v), MIN_LUMINANCE) for v in (ordered[-1], ordered[len(ordered) // 2]))
    # white is the log2 of the x > 0 at which the tone curve, a quotient of quadratics, is BRIGHTEST
    qa, qb, qc = (n - BRIGHTEST * d for n, d in zip(*ACES, strict=True))
    white = math.log2((-qb + math.sqrt(qb * qb - 4 * qa * qc)) / (2 * qa))
    start, stops = white - math.log2(brightest), math.log2(brightest / median)
    count = max(2, math.ceil(stops))
    return [start + stops * k / (count - 1) for k in range(count)]


def mean(error_map: Tensor) -> Tensor:
    """Return the mean of each error map, (H, W) → () or (B, H, W) → (B,): FLIP's usual single number."""
    maps = _read("error_map", error_map, *MAPS, low=0.0)
    return maps.to(torch.float64).mean((-2, -1)).to(maps.dtype)


def weighted_median(error_map: Tensor) -> Tensor:
    """Return the error that splits each map's total error in two halves, (H, W) → () or (B, H, W) → (B,).

    It is the smallest error e such that errors up to e add up to half of all, at least; 0 of a map of zeros. Large
    areas without error, which pull the mean down, do not count.

    Gradient: to the one pixel that it is.
    Source: the weighted histogram of Andersson et al. 2020.

    Example:
        >>> weighted_median(torch.tensor([[0.0, 0.0, 0.1, 0.5]]))
        tensor(0.5000)
    """
    ordered = _read("error_map", error_map, *MAPS, low=0.0).flatten(-2).sort(-1).values
    sums = ordered.detach().to(torch.float64).cumsum(-1)
    place = (sums < 0.5 * sums[..., -1:]).sum(-1, keepdim=True)
    return ordered.gather(-1, place).squeeze(-1)


def _read(name: str, value: Tensor, *shapes: tuple, low: float = -math.inf) -> Tensor:
    """Return `value` as a finite tensor of one of `shapes` with at least one entry, all of them at least `low`."""
    tensor = check.floats(name, value, *shapes)
    if tensor.numel() == 0:
        raise check.fail(name, "at least one pixel", tensor)
    lowest = float(tensor.detach().min())
    if lowest < low:
        raise check.fail(name, f"values of at least {low:g}", f"{lowest}")
    return tensor


def _read_pair(image: Tensor, reference: Tensor, low: float = -math.inf) -> tuple[Tensor, Tensor, torch.Size]:
    """Return both images as (B, H, W, 3), checked, and the shape in which they came."""
    a, b = (_read(n, v, *IMAGES, low=low) for n, v in (("image", image), ("reference", reference)))
    if a.shape != b.shape or a.dtype != b.dtype:
        raise check.fail("image", f"the shape and dtype of the reference, {check.describe(b)}", a)
    check.same_device(image=a, reference=b)
    return a.reshape(-1, *a.shape[-3:]), b.reshape(-1, *b.shape[-3:]), a.shape


def _gaussian(radius: int, sigma: float) -> list[float]:
    """Return 2 radius + 1 weights exp(-x² / 2 sigma²) that sum to 1."""
    weights = [math.exp(-0.5 * (x / sigma) ** 2) for x in range(-radius, radius + 1)]
    return [w / math.fsum(weights) for w in weights]


def _filter(planes: Tensor, weights: list[float], axis: int) -> Tensor:
    """Return the correlation with `weights` along one axis where they lie inside: shorter by all weights but one."""
    length = planes.shape[axis] - len(weights) + 1
    total = planes.narrow(axis, 0, length) * weights[0]
    for k, weight in enumerate(weights[1:], start=1):
        total = torch.add(total, planes.narrow(axis, k, length), alpha=weight)
    return total


def _filter_padded(plane: Tensor, along_x: list[float], along_y: list[float]) -> Tensor:
    """Return the separable correlation of (B, H, W), its border repeated outwards."""
    for axis, weights in ((-1, along_x), (-2, along_y)):
        size, radius = plane.shape[axis], len(weights) // 2
        places = torch.arange(-radius, size + radius, device=plane.device).clamp(0, size - 1)
        plane = _filter(plane.index_select(axis, places), weights, axis)
    return plane


def _power(base: Tensor, exponent: float | Tensor) -> Tensor:
    """Return base ** exponent of base >= 0; at 0 the value is 0 and so is the gradient, which is infinite else."""
    positive = base > 0
    return torch.where(positive, torch.where(positive, base, 1.0) ** exponent, 0.0)


def _relative_of_rgb() -> Tensor:
    """Return the (3, 3) float64 matrix from linear sRGB to XYZ relative to the white: (1, 1, 1) stays."""
    columns = torch.tensor([[x / y, 1.0, (1 - x - y) / y] for x, y in (*PRIMARIES, WHITE)], dtype=torch.float64).T
    matrix = columns[:, :3] * torch.linalg.solve(columns[:, :3], columns[:, 3])
    return matrix / columns[:, 3:]


def _mix(image: Tensor, rows: list) -> Tensor:
    """Return the weighted sums of the last axis that `rows` give; no matrix product, for the reason above."""
    return torch.stack([sum(w * c for w, c in zip(row, image.unbind(-1), strict=True)) for row in rows], -1)


def _linear_of_srgb(image: Tensor) -> Tensor:
    """Return linear sRGB of sRGB in [0, 1]."""
    return torch.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)


def _aces(image: Tensor) -> Tensor:
    """Return linear radiance mapped by the ACES tone curve to [0, 1]."""
    x = image.clamp_max(1e3)  # clipped to 1 from about 10 up; squares stay finite
    numerator, denominator = ((a * x + b) * x + c for a, b, c in ACES)
    return (numerator / denominator).clamp(0, 1)


def _hunt_lab(relative: Tensor) -> Tensor:
    """Return L*a*b*, a* and b* scaled by 0.01 L* (Hunt effect), of (..., 3) XYZ relative to the white."""
    knee = (6 / 29) ** 3
    root = torch.where(relative > knee, relative.clamp_min(knee) ** (1 / 3), relative * (29**2 / 108) + 4 / 29)
    x, y, z = root.unbind(-1)
    lightness = 116 * y - 16
    return torch.stack([lightness, 5 * lightness * (x - y), 2 * lightness * (y - z)], -1)


def _hyab(lab: Tensor, other: Tensor) -> Tensor:
    """Return the HyAB distance of (..., 3) colours: city block in L*, Euclidean in a* and b*."""
    lightness, a, b = (lab - other).unbind(-1)
    return lightness.abs() + _power(a.square() + b.square(), 0.5)


def _flip(image: Tensor, reference: Tensor, ppd: float) -> Tensor:
    """Return the (B, H, W) error of (B, H, W, 3) linear sRGB in [0, 1]."""
    matrix = _relative_of_rgb()
    pair = [_mix(v, matrix.tolist()) for v in (image, reference)]
    color = _color_error(*(_seen(v, matrix, ppd) for v in pair), matrix)
    return _power(color, 1 - _feature_error(*(v[..., 1] for v in pair), ppd))


def _seen(relative: Tensor, matrix: Tensor, ppd: float) -> Tensor:
    """Return Hunt-adjusted L*a*b* after the eye's blur of the opponent channels Y, X - Y and Y - Z."""
    x, y, z = relative.unbind(-1)
    radius = math.ceil(3 * ppd * math.sqrt(max(b for terms in SENSITIVITY for _, b in terms) / 2) / math.pi)
    opponents = zip((y, x - y, y - z), SENSITIVITY, strict=True)
    y, red_green, blue_yellow = (_sensitivity(v, terms, radius, ppd) for v, terms in opponents)
    rgb = _mix(torch.stack([y + red_green, y, y - blue_yellow], -1), matrix.inverse().tolist()).clamp(0, 1)
    return _hunt_lab(_mix(rgb, matrix.tolist()))


def _color_error(lab: Tensor, other: Tensor, matrix: Tensor) -> Tensor:
    """Return the (B, H, W) difference of colours, 1 between green and blue, which are the farthest two."""
    greatest = float(_hyab(*_hunt_lab(matrix.T[1:]))) ** COLOR_POWER
    error = _power(_hyab(lab, other), COLOR_POWER) / greatest
    steep = error * (ERROR_KNEE / COLOR_KNEE)
    flat = ERROR_KNEE + (error - COLOR_KNEE) * ((1 - ERROR_KNEE) / (1 - COLOR_KNEE))
    return torch.where(error < COLOR_KNEE, steep, flat)


def _sensitivity(plane: Tensor, terms: tuple, radius: int, ppd: float) -> Tensor:
    """Return (B, H, W) after the filter Σ a √(π/b) exp(-π² (x² + y²) / b), scaled to sum 1."""
    filtered, total = 0.0, 0.0
    for a, b in terms:
        sigma = ppd * math.sqrt(b / 2) / math.pi
        mass = math.fsum(math.exp(-0.5 * (x / sigma) ** 2) for x in range(-radius, radius + 1)) ** 2
        weight = a * math.sqrt(math.pi / b) * mass
        weights = _gaussian(radius, sigma)
        filtered = filtered + weight * _filter_padded(plane, weights, weights)
        total += weight
    return filtered / total


def _feature_error(image: Tensor, reference: Tensor, ppd: float) -> Tensor:
    """Return the (B, H, W) difference of edges and points of luminance."""
    sigma = 0.5 * FEATURE_WIDTH_DEG * ppd
    radius = math.ceil(3 * sigma)
    smooth = _gaussian(radius, sigma)
    places = [(w, (k - radius) / sigma) for k, w in enumerate(smooth)]
    edge = _unit_halves([-u * w for w, u in places])
    point = _unit_halves([(u * u - 1) * w for w, u in places])

    def strength(plane: Tensor, weights: list[float]) -> Tensor:
        dx, dy = _filter_padded(plane, weights, smooth), _filter_padded(plane, smooth, weights)
        return _power(dx.square() + dy.square(), 0.5)

    differences = [(strength(image, w) - strength(reference, w)).abs() for w in (edge, point)]
    return _power(torch.maximum(*differences) / math.sqrt(2), FEATURE_POWER)


def _unit_halves(weights: list[float]) -> list[float]:
    """Return weights whose positive ones are scaled to sum 1 and whose negative ones to sum -1."""
    up, down = (math.fsum(w for w in weights if w * sign > 0) for sign in (1, -1))
    return [w / up if w > 0 else -w / down for w in weights]
