"""Approximate depth and texture along intervals by straight lines in time, on intervals cut as finely as asked.

Before: accuracy.py, intervals.py.  After: cells.py, nodes.py.
Symbols: N intervals, m pieces of them; u in [0, 1] time along an interval; M / D nearness 2 - z / w; S = sum of the
edge functions e_i; P / S texture coordinates. All four are kept by their Bernstein coefficients over the piece.
Source: Ronnow et al. 2021, sec. 4 (linear), 2022, alg. 1 (adaptive; its misprints: `Accuracy.adaptive`); bounds ours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import comb

import torch
from torch import Tensor

from torchblur import bernstein, edges, packed
from torchblur.accuracy import Accuracy
from torchblur.intervals import Intervals, nearness_coefficients
from torchblur.prisms import Prisms
from torchblur.stopwatch import spent_on

SAMPLES_PER_TIME = 20  # depths looked at per unit of shutter time, for extrema (the paper's number)
MAX_HALVINGS = 12  # of a piece between two extrema; what is left is accepted
MIN_PIECE = 1e-9  # of the window; shorter pieces are not cut: a pixel changes by at most as much a piece
ROUNDING = 1e-12  # of nearness and uv: smaller slopes and errors are rounding
VANISHING = 1e-10  # of the largest coefficient: S below it is 0, as e_i are known to about 1e-12
AT_ONCE = 1 << 16  # intervals cut together; fits the cache, and bounds the working memory
INSIDE = 1e-6  # of an interval: how far from an instant without depth the depth is looked at


@dataclass(frozen=True)
class _Curves:
    """Nearness and texture coordinates over m pieces, as ratios of Bernstein polynomials."""

    num: Tensor  # (4, m) float64 M
    den: Tensor  # (4, m) D
    s: Tensor  # (3, 1, m) S
    p: Tensor  # (3, 2, m) P, or (3, 0, m) where there is no texture

    def map(self, change: Callable[[Tensor], Tensor]) -> _Curves:
        """Return the curves with each tensor put through `change`."""
        return _Curves(*(change(c) for c in (self.num, self.den, self.s, self.p)))

    def __getitem__(self, chosen: Tensor) -> _Curves:
        return self.map(lambda c: c[..., chosen])

    def halves(self) -> _Curves:
        """Return the curves over all first halves, then all second halves."""
        return self.map(lambda c: torch.cat(bernstein.split(c, torch.full_like(c[0], 0.5)), dim=-1))

    def between(self, u_start: Tensor, u_end: Tensor) -> _Curves:
        """Return the curves over the parts [u_start, u_end] (m,)."""
        return self.map(lambda c: bernstein.restrict(c, u_start, u_end))

    def ends(self) -> Tensor:
        """Return nearness (2, m) at both ends."""
        den = self.den[[0, -1]]
        return torch.where(den != 0, self.num[[0, -1]] / torch.where(den != 0, den, 1.0), 1.0)

    def error_bound(self) -> Tensor:
        """Return (m,) how far nearness, u and v may be from their chords."""
        bound = chord_error_bound(self.num, self.den)
        return torch.cat([bound.unsqueeze(0), chord_error_bound(self.p, self.s)]).amax(0)


@dataclass(frozen=True)
class _Pieces:
    """Parts of intervals, with the nearness at their ends."""

    owner: Tensor  # (m,) int64 interval
    u: Tensor  # (2, m) float64 where in the interval the piece begins and ends
    nearness: Tensor  # (2, m) float64


@spent_on("curvature")
def approximate(prisms: Prisms, intervals: Intervals, accuracy: Accuracy) -> Intervals:
    """Return intervals along which nearness, and with it depth, is what `accuracy` asks for.

    Args:
        prisms: of the scene.
        intervals: N intervals of some pixels.
        accuracy: "exact" returns `intervals`; "linear" replaces nearness by its chord, 2 - z / w straight in time;
            "adaptive" does so after cutting the intervals.

    Returns:
        At least N intervals, sorted as before. Pieces of one interval share their inner ends bit for bit, and its own
        ends are untouched.

    Accuracy: see `Accuracy`. At an end where the surface turns edge-on, the value is the limit from inside.
    Gradient: through t_start and t_end of the original ends; where an interval is cut carries none.
    Source: Ronnow et al. 2021, sec. 4; 2022, alg. 1, repaired.
    """
    if accuracy.method == "exact":
        return intervals
    with torch.no_grad():
        every = torch.arange(intervals.count, device=intervals.prism.device)
        if accuracy.method == "linear":
            ends = _curves(prisms, intervals, every, has_uv=False).ends()
            pieces = _Pieces(every, torch.stack([torch.zeros_like(ends[0]), torch.ones_like(ends[0])]), ends)
        else:
            is_textured = prisms.surfaces.is_textured[prisms.face_of[intervals.prism]]
            least = MIN_PIECE * (prisms.window[1] - prisms.window[0])
            parts = []
            for has_uv in (False, True):
                for owner in (is_textured == has_uv).nonzero().flatten().split(AT_ONCE):
                    length = (intervals.t_end - intervals.t_start)[owner]
                    part = _cut(_curves(prisms, intervals, owner, has_uv), length, accuracy.tolerance, least)
                    parts.append(replace(part, owner=owner[part.owner]))
            pieces = _in_order(parts)
        first, last = pieces.nearness
        near_num = torch.stack([first, (2 * first + last) / 3, (first + 2 * last) / 3, last])
        start, length = intervals.t_start[pieces.owner], (intervals.t_end - intervals.t_start)[pieces.owner]
        cut_start, cut_end = (start + u * length for u in pieces.u)
    owner = pieces.owner
    return Intervals(
        offsets=packed.offsets_from_owners(packed.owners(intervals.offsets)[owner], len(intervals.offsets) - 1),
        prism=intervals.prism[owner],
        t_start=torch.where(pieces.u[0] > 0, cut_start, intervals.t_start[owner]),
        t_end=torch.where(pieces.u[1] < 1, cut_end, intervals.t_end[owner]),
        near_num=near_num,
        near_den=torch.ones_like(near_num),
        ray_ndc=intervals.ray_ndc,
        spacing_ndc=intervals.spacing_ndc,
    )


def chord_error_bound(num: Tensor, den: Tensor) -> Tensor:
    """Return how far a ratio of polynomials may be from the straight line between its ends, inf where `den` may vanish.

    The difference is tau (1 - tau) R / den with a polynomial R of one degree less, and R / den lies within the ratios
    of their Bernstein coefficients. Over short pieces the bound comes close to the error itself.

    Args:
        num, den: (d + 1, ...) Bernstein coefficients over the piece; the shapes broadcast.

    Returns:
        (...) at least the greatest distance over the piece.

    Source: ours.
    """
    proper = (den > 0).all(0) | (den < 0).all(0)
    den = torch.where(proper, den, 1.0)
    ends = torch.stack([num[0] / den[0], num[-1] / den[-1]])
    gap = bernstein.product(num, torch.ones_like(ends)) - bernstein.product(ends, den)
    degree = len(num) - 1
    weights = [comb(degree + 1, k) / comb(degree - 1, k - 1) for k in range(1, degree + 1)]
    r = torch.stack([weight * row for weight, row in zip(weights, gap[1:-1], strict=True)])
    ratio = bernstein.product(r, torch.ones_like(ends)) / den  # the ratio of R and den lies in the hull of these
    return torch.where(proper, 0.25 * ratio.abs().amax(0), torch.inf)


def sampled_extrema(num: Tensor, den: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Return where samples of a ratio of polynomials turn from rising to falling or back.

    Args:
        num, den: (d + 1, n) Bernstein coefficients over intervals.
        length: (n,) of the intervals [shutter time], which sets the number of samples.

    Returns:
        (X,) int64 which interval, (X,) u in (0, 1) in order for each. Of several equal samples at a turn, the middle.

    Source: Ronnow et al. 2022, alg. 1, first half, repaired (`Accuracy.adaptive`).
    """
    rise = bernstein.product(num.diff(dim=0), den) - bernstein.product(num, den.diff(dim=0))
    noise = 0.1 * ROUNDING * num.abs().amax(0) * den.abs().amax(0)
    changes, _, _ = bernstein.sign_changes(rise, noise)
    which = (changes > 0).nonzero().flatten()  # the others rise or fall throughout
    steps = torch.ceil(SAMPLES_PER_TIME * length[which]).clamp(min=2)
    num, den = num[:, which], den[:, which]
    before = _ratio(num, den, torch.zeros_like(steps))
    slope = torch.zeros_like(steps)  # sign of the last step that was not level
    since = torch.zeros_like(steps)  # and the sample at which it ended
    found_which, found_u = [which[:0]], [steps[:0]]
    for k in range(1, int(steps.max()) + 1 if len(steps) else 0):
        on = (steps >= k).nonzero().flatten()
        if len(on) < len(steps):
            which, steps, num, den, before, slope, since = (
                a[..., on] for a in (which, steps, num, den, before, slope, since)
            )
        now = _ratio(num, den, k / steps)
        step = now - before
        sign = step.sign() * (step.abs() > ROUNDING)
        turned = (sign * slope < 0).nonzero().flatten()
        found_which.append(which[turned])
        found_u.append((since[turned] + (k - 1)) / (2 * steps[turned]))
        slope = torch.where(sign != 0, sign, slope)
        since = torch.where(sign != 0, float(k), since)
        before = now
    return torch.cat(found_which), torch.cat(found_u)


def _ratio(num: Tensor, den: Tensor, u: Tensor) -> Tensor:
    """Return num / den (n,) at `u` (n,), or close by where the denominator vanishes."""
    value = bernstein.value(den, u)
    lost = value.abs() <= VANISHING * den.abs().amax(0)
    if lost.any():
        u = torch.where(lost, torch.where(u < 0.5, u + INSIDE, u - INSIDE), u)
        value = bernstein.value(den, u)
    return torch.where(value != 0, bernstein.value(num, u) / torch.where(value != 0, value, 1.0), 1.0)


def _curves(prisms: Prisms, intervals: Intervals, chosen: Tensor, has_uv: bool) -> _Curves:
    """Return the curves of the intervals `chosen` (m,), finite at both ends."""
    prism = intervals.prism[chosen]
    ray = intervals.ray_ndc[:, packed.owners(intervals.offsets)[chosen]]
    t_open, span = prisms.t_open[prism], (prisms.t_close - prisms.t_open)[prism]
    u = (torch.stack([intervals.t_start[chosen], intervals.t_end[chosen]]) - t_open) / span
    corners = edges.reduce_corners(prisms.clip, prism, ray).between(u[0], u[1])
    num, den = nearness_coefficients(replace(prisms, orders_by_w=False), prism, corners, u)
    e = edges.edge_coefficients(corners)  # (3 coefficients, 3 edges, m)
    p = torch.stack([(e * uv).sum(1) for uv in prisms.corner_uv(prism)], dim=1) if has_uv else e[:, :0]
    return _finite_ends(_Curves(num, den, e.sum(1, keepdim=True), p))


def _finite_ends(curves: _Curves) -> _Curves:
    """Return the curves with the factor tau, or 1 - tau, divided out where S vanishes at an end.

    There all e_i vanish together, as the ray lies in the plane of the surface, or the surface shrinks to a point (then
    twice), and all ratios are 0 / 0; with the factor gone they are their limits.
    """
    for end in (0, 0, -1, -1):
        at = (curves.s[end, 0].abs() <= VANISHING * curves.s[:, 0].abs().amax(0)).nonzero().flatten()
        if len(at):
            less = curves[at].map(_divided_by_tau if end == 0 else lambda c: _divided_by_tau(c.flip(0)).flip(0))
            pairs = zip(vars(curves).values(), vars(less).values(), strict=True)
            curves = _Curves(*(whole.index_copy(-1, at, part) for whole, part in pairs))
    return curves


def _divided_by_tau(c: Tensor) -> Tensor:
    """Return (d + 1, ...) coefficients of a polynomial without constant term, divided by its variable."""
    degree = len(c) - 1
    less = torch.stack([c[k] * (degree / k) for k in range(1, degree + 1)])
    return bernstein.product(less, torch.ones_like(c[:2]))


def _cut(curves: _Curves, length: Tensor, tolerance: float, least: float) -> _Pieces:
    """Return the pieces of intervals of `length` (m,) [shutter time], cut at extrema, then halved to `tolerance`.

    Pieces shorter than `least` stay whole. In no particular order.
    """
    which, u = sampled_extrema(curves.num, curves.den, length)
    kept = length[which] > least
    which, u = which[kept], u[kept]
    every = torch.arange(len(length), device=length.device)
    owner, u_start = torch.cat([every, which]), torch.cat([torch.zeros_like(length), u])
    order = torch.sort(owner + u_start).indices
    owner, u_start = owner[order], u_start[order]
    is_last = torch.ones_like(owner, dtype=torch.bool)
    is_last[:-1] = owner[1:] != owner[:-1]
    u = torch.stack([u_start, torch.where(is_last, 1.0, u_start.roll(-1))])
    if len(which):
        curves = curves[owner].between(u[0], u[1])

    done = []
    for halvings in range(MAX_HALVINGS + 1):
        curves = _finite_ends(curves)
        wide = curves.error_bound() > max(tolerance, ROUNDING)
        wide &= ((u[1] - u[0]) * length[owner] > least) & (halvings < MAX_HALVINGS)
        good = (~wide).nonzero().flatten()
        done.append(_Pieces(owner[good], u[:, good], curves[good].ends()))
        bad = wide.nonzero().flatten()
        if len(bad) == 0:
            break
        curves = curves[bad].halves()
        owner, u = owner[bad].repeat(2), u[:, bad]
        middle = 0.5 * (u[0] + u[1])
        u = torch.stack([torch.cat([u[0], middle]), torch.cat([middle, u[1]])])
    return _joined(done)


def _joined(parts: list[_Pieces]) -> _Pieces:
    """Return the pieces of all parts."""
    return _Pieces(*(torch.cat(a, dim=-1) for a in zip(*(vars(p).values() for p in parts), strict=True)))


def _in_order(parts: list[_Pieces]) -> _Pieces:
    """Return the pieces of all parts by interval, then time."""
    pieces = _joined(parts)
    order = torch.sort(pieces.owner + pieces.u[0]).indices  # one number: u < 1, and pieces lie 1e-5 apart
    return _Pieces(*(a[..., order] for a in vars(pieces).values()))
