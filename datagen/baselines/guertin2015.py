"""Guertin & Nowrouzezahrai 2015: each moving pixel is scattered along the curve that its point takes.

Before: views.py, curves.py.  After: filters.py.
What it cannot do: whatever is hidden at the sharp instant leaves no trail; glass moves with the first surface seen
through the pixel, and takes along what is behind it; what is outside of the image stays there; a surface that grows
leaves holes. As published, each pixel adds a weight of about 1 to every pixel of its trail, however long: long trails
are too strong, short ones too weak, and the sharp object stays visible under its own blur. `weighting="time"` weighs
by time instead, and a static layer seen without the moving objects removes the overlay.
Symbols: A, alpha sums of weighted colour and of weights; w_b weight of the background; Delta points of a polyline.
Source: Guertin & Nowrouzezahrai 2015, with the control point and the polynomial corrected (curves.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from datagen.baselines.curves import Curves, fit_curves
from datagen.baselines.views import Layer, Paths, checked_images
from torchblur import check, packed

WEIGHTINGS = ("published", "time")
DEPTH_BIAS = 0.01  # share of the depth by which a trail may lie behind a surface and still be seen: its own
GRID_PX = 1 / 256  # to which the ends of lines are rounded, as graphics hardware does
TIME_SAMPLES_PER_PX = 2.0  # of a curve's length, at its fastest
WHOLE_PX, PIECE_PX = 2048.0, 64.0  # length of a curve from which on it is cut, and of a piece that is not cut further
MAX_FRAGMENTS = 1 << 21  # handled together


@dataclass(frozen=True)
class Lines:
    """How trails are drawn as published.

    Args:
        points: Delta, of a polyline, ends included.
        background_weight: w_b of what was there before, above 0.
        sigma: width of the Gaussian weight over shutter time, which is 1 at the middle, above 0.

    Raises:
        TypeError, ValueError: a wrong argument, named.
    """

    points: int = 11
    background_weight: float = 5.0
    sigma: float = 2.0

    def __post_init__(self) -> None:
        if check.positive_int("points", self.points, 1 << 16) < 2:
            raise check.fail("points", "at least 2", self.points)
        for name in ("background_weight", "sigma"):
            if check.number(name, getattr(self, name), 0.0) == 0:
                raise check.fail(name, "a number above 0", getattr(self, name))


class _Fragments(NamedTuple):
    """Pieces of trails in pixels."""

    source: Tensor  # (m,) which moving pixel they come from
    place: Tensor  # (m, 3) x, y [px] inside the pixel that is hit, and depth
    weight: Tensor  # (m,)


def guertin2015(
    color: Any,
    paths: Paths,
    *,
    static: Layer | None = None,
    curve: str = "bezier",
    weighting: str = "published",
    lines: Lines | None = None,
) -> Tensor:
    """Return the blurred images (B, C, H, W).

    Args:
        color: (B, C, H, W) float32 or float64, linear: the sharp images; with `static`, of the moving objects only.
        paths: where the visible points are during the exposure; three instants make quadratic curves, four cubic ones.
            With `static`, of the moving objects only: depth inf elsewhere.
        static: colour and depth without the moving objects; the sharp image itself serves if None.
        curve: "bezier", or "arc" for circular arcs through three instants.
        weighting: "published"; or "time": each pixel adds the share of the exposure that it spends somewhere, and the
            background what is left of it.
        lines: constants of the published weighting, which is the only one to use them; as published if None.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Gradient: to colour; none to where the pixels go.
    Source: Guertin & Nowrouzezahrai 2015, eq. 4; two passes: sec. 5.1, but objects that stay are put into the static
        layer, which answers its open question of low velocities; weighting by time: ours. Pixels that move by half a
        pixel and less from the sharp instant are not scattered. Trails are hidden by what is nearer than they are, by
        more than DEPTH_BIAS of the depth.
    """
    image = checked_images(color)
    if not isinstance(paths, Paths):
        raise check.fail_type("paths", "Paths", paths)
    if weighting not in WEIGHTINGS:
        raise check.fail("weighting", f"one of {', '.join(WEIGHTINGS)}", weighting)
    if lines is not None and (weighting == "time" or not isinstance(lines, Lines)):
        raise check.fail("lines", "Lines with the published weighting, else None", lines)
    depth = Layer(image, paths.sharp_depth.unsqueeze(1)).depth_view[:, 0]  # checks that they fit each other
    moving = paths.is_moving
    below, below_depth = image, depth
    if static is not None:
        if not isinstance(static, Layer):
            raise check.fail_type("static", "a Layer", static)
        static.check_fits("static", image)
        below, below_depth = static.color, static.depth_view[:, 0]
        stays = torch.isfinite(depth) & ~moving & (depth <= below_depth * (1 + DEPTH_BIAS))
        below = torch.where(stays.unsqueeze(1), image, below)
        below_depth = torch.where(stays, depth, below_depth)
    curves, pixel = _trails(paths, moving, curve)
    settings = Lines() if lines is None else lines
    size = moving.shape[1:]
    trails = _time_fragments(curves, size) if weighting == "time" else _line_fragments(curves, settings, size)
    light, alpha = _scatter(image, pixel, below_depth.detach(), trails)
    if weighting == "time":
        return (light + (1 - alpha).clamp(min=0) * below) / alpha.clamp(min=1)
    return (light + settings.background_weight * below) / (alpha + settings.background_weight)


def _trails(paths: Paths, moving: Tensor, curve: str) -> tuple[Curves, Tensor]:
    """Return the curves of the moving pixels in float64, and which pixels of the batch these are (n,)."""
    b, row, column = moving.nonzero(as_tuple=True)
    h, w = moving.shape[1:]
    centre = torch.stack([column, row], dim=1).to(torch.float64) + 0.5
    offset = paths.offset_px.detach().permute(0, 3, 4, 1, 2)[b, row, column].to(torch.float64)  # (n, K, 2)
    depth = paths.depth_view.detach().permute(0, 2, 3, 1)[b, row, column].to(torch.float64)  # (n, K)
    points = torch.cat([centre.unsqueeze(1) + offset, depth.unsqueeze(2)], dim=2)
    return fit_curves(points, paths.times, curve), (b * h + row) * w + column


def _line_fragments(curves: Curves, lines: Lines, size: tuple[int, int]) -> Iterator[_Fragments]:
    """Yield the pixels that the segments of each curve's polyline run through, one at a time along the longer axis.

    Along that axis they end with the image, of height and width `size`.

    A segment owns its start but not its end, so that joints are not hit twice.
    """
    n, device = len(curves.control), curves.control.device
    every = torch.arange(n, device=device)

    def point(k: int) -> Tensor:
        place = curves.at(every, torch.full((n,), k / (lines.points - 1), dtype=torch.float64, device=device))
        return torch.cat([torch.round(place[:, :2] / GRID_PX) * GRID_PX, place[:, 2:]], dim=1)

    start = point(0)
    for k in range(1, lines.points):
        end = point(k)
        step = end - start
        axis = (step[:, 1].abs() > step[:, 0].abs()).long().unsqueeze(1)  # the longer one: 1 where steep
        long = torch.cat([start.gather(1, axis), end.gather(1, axis)], dim=1)
        forward = (long[:, 1] >= long[:, 0]).unsqueeze(1)
        edge = torch.where(forward, torch.ceil(long - 0.5), torch.floor(long - 0.5))
        limit = torch.where(axis == 1, size[0], size[1])
        low, high = torch.where(forward, 0, -1), torch.where(forward, limit, limit - 1)
        edge = torch.minimum(torch.maximum(edge, low), high)
        count = (edge[:, 1] - edge[:, 0]).abs().long()
        for part in _portions(count):
            rank, which = packed.expand(torch.zeros_like(count[part]), count[part])
            which = which + part.start
            sign = torch.where(forward[which, 0], 1.0, -1.0)
            centre = edge[which, 0] + sign * rank + 0.5
            share = (centre - long[which, 0]) / (long[which, 1] - long[which, 0])
            place = start[which] + share.unsqueeze(1) * step[which]
            place = place.scatter(1, axis[which], centre.unsqueeze(1))  # exactly the centre along the longer axis
            s = (k - 1 + share) / (lines.points - 1)
            yield _Fragments(which, place, torch.exp(-0.5 * ((s - 0.5) / lines.sigma).square()))
        start = end


def _time_fragments(curves: Curves, size: tuple[int, int]) -> Iterator[_Fragments]:
    """Yield points at the middles of equal parts of pieces of the exposure, each weighing its part.

    A piece is the exposure; or, of a long curve, a part in which it may be inside the image, of height and width
    `size`.
    """
    which = torch.arange(len(curves.control), device=curves.control.device)
    start = torch.zeros(len(which), dtype=torch.float64, device=which.device)
    end, most_px = torch.ones_like(start), WHOLE_PX
    while len(which):
        length_px = curves.speed_bound(which, start, end) * (end - start)
        is_short = length_px <= most_px
        yield from _even_fragments(curves, *(part[is_short] for part in (which, start, end, length_px)))
        middle, reach = 0.5 * (start + end), 0.5 * length_px
        x, y, _ = curves.at(which, middle).unbind(1)
        is_seen = (x >= -reach) & (x <= size[1] + reach) & (y >= -reach) & (y <= size[0] + reach)
        kept = is_seen & ~is_short & (start < middle) & (middle < end)  # else shorter than times are rounded to
        which, start, middle, end = (part[kept] for part in (which, start, middle, end))
        which, start, end = torch.cat([which, which]), torch.cat([start, middle]), torch.cat([middle, end])
        most_px = PIECE_PX


def _even_fragments(
    curves: Curves, curve: Tensor, start: Tensor, end: Tensor, length_px: Tensor
) -> Iterator[_Fragments]:
    """Yield points of pieces (m,) of curves at the middles of equal parts of their times."""
    count = torch.ceil(TIME_SAMPLES_PER_PX * length_px).clamp(min=1).long()
    for part in _portions(count):
        rank, piece = packed.expand(torch.zeros_like(count[part]), count[part])
        piece = piece + part.start
        weight = (end - start)[piece] / count[piece]
        yield _Fragments(curve[piece], curves.at(curve[piece], start[piece] + (rank + 0.5) * weight), weight)


def _portions(count: Tensor) -> Iterator[slice]:
    """Yield runs of sources that have at most MAX_FRAGMENTS fragments together, or of one source."""
    total = count.cumsum(0)
    first = 0
    while first < len(count):
        before = int(total[first - 1]) if first else 0
        last = int(torch.searchsorted(total, before + MAX_FRAGMENTS, right=True))
        last = max(last, first + 1)
        yield slice(first, last)
        first = last


def _scatter(image: Tensor, pixel: Tensor, hiding_depth: Tensor, trails: Iterator[_Fragments]) -> tuple[Tensor, Tensor]:
    """Return A (B, C, H, W) and alpha (B, 1, H, W) of the trails of the pixels `pixel` (n,) of the batch."""
    b, c, h, w = image.shape
    colors = image.permute(0, 2, 3, 1).reshape(-1, c)[pixel]
    hiding = hiding_depth.flatten()
    total = image.new_zeros(b * h * w, c + 1)
    for source, place, weight in trails:
        x, y = torch.floor(place[:, 0]), torch.floor(place[:, 1])
        inside = ((x >= 0) & (x < w) & (y >= 0) & (y < h)).nonzero().flatten()
        source, depth, weight = source[inside], place[inside, 2], weight[inside]
        target = (pixel[source] // (h * w) * h + y[inside].long()) * w + x[inside].long()
        seen = depth <= hiding[target].to(torch.float64) * (1 + DEPTH_BIAS)
        source, target, weight = source[seen], target[seen], weight[seen].to(image.dtype).unsqueeze(1)
        total = total.index_add(0, target, torch.cat([weight * colors[source], weight], dim=1))
    total = total.reshape(b, h, w, c + 1).permute(0, 3, 1, 2)
    return total[:, :-1], total[:, -1:]
