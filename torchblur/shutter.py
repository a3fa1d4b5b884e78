"""Shutter: how much each shutter time weighs in the exposure of each line of the image.

Before: nothing.  After: prisms.py (window), resolve.py (weight of a cell), sampling.py.
Symbols: t in [0, 1] is shutter time, 0 opens, 1 closes; h(t) the weight, of unit integral; H its antiderivative.
A line is a row or a column of pixels; with a rolling shutter line k sees h delayed by k times the line delay.
Source: the h of the rendering integral in Ronnow et al. 2021, sec. 3; pieces and lines ours.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import check

DIRECTIONS = ("down", "up", "right", "left")
ROUNDING = 1e-9  # shutter time by which delays of many lines may pass 1 through rounding


@dataclass(frozen=True)
class Shutter:
    """A weight over the exposure, linear between given times, the same for all lines or delayed line by line.

    Args:
        times: at least 2 rising shutter times in [0, 1]; before the first and after the last nothing is seen.
        weights: of these times, at least 0 and not all 0; only their ratios matter.
        line_delay: shutter time between the openings of one line and the next; 0 is a global shutter.
        direction: in which the lines follow each other: rows "down" or "up", columns "right" or "left".

    Raises:
        TypeError, ValueError: a wrong argument, named.
    """

    times: tuple[float, ...] = (0.0, 1.0)
    weights: tuple[float, ...] = (1.0, 1.0)
    line_delay: float = 0.0
    direction: str = "down"

    def __post_init__(self) -> None:
        times = _numbers("times", self.times, 0.0, 1.0)
        weights = _numbers("weights", self.weights, 0.0, math.inf)
        if len(times) < 2 or any(a >= b for a, b in itertools.pairwise(times)):
            raise check.fail("times", "at least 2 rising shutter times", self.times)
        if len(weights) != len(times) or not any(weights):
            raise check.fail("weights", f"{len(times)} numbers, not all 0", self.weights)
        check.number("line_delay", self.line_delay, 0.0, 1.0)
        if self.direction not in DIRECTIONS:
            raise check.fail("direction", f"one of {', '.join(DIRECTIONS)}", self.direction)
        if not math.isfinite(sum(weights)):
            raise check.fail("weights", "numbers whose sum is finite", self.weights)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "weights", weights)

    @classmethod
    def box(cls, t_open: float = 0.0, t_close: float = 1.0) -> Shutter:
        """Return equal weight over [t_open, t_close]; without arguments, over the whole exposure.

        Example:
            >>> Shutter.box(0.0, 0.5).t_close
            0.5
        """
        check.number("t_open", t_open, 0.0, 1.0)
        check.number("t_close", t_close, 0.0, 1.0)
        if not t_open < t_close:
            raise check.fail("t_close", f"a number above t_open = {t_open:g}", t_close)
        return cls((t_open, t_close), (1.0, 1.0))

    @classmethod
    def trapezoid(cls, t_open: float, t_full: float, t_fade: float, t_close: float) -> Shutter:
        """Return a weight that rises from `t_open` to `t_full`, stays until `t_fade`, and falls until `t_close`.

        Steep sides (t_open == t_full, t_fade == t_close) are allowed; t_full == t_fade is a triangle.
        """
        given = {"t_open": t_open, "t_full": t_full, "t_fade": t_fade, "t_close": t_close}
        values = [check.number(name, value, 0.0, 1.0) for name, value in given.items()]
        if sorted(values) != values or t_open == t_close:
            raise check.fail("t_open, t_full, t_fade, t_close", "rising shutter times", str(values))
        points = {t_open: 0.0 if t_open < t_full else 1.0, t_full: 1.0, t_fade: 1.0}
        points[t_close] = 0.0 if t_fade < t_close else 1.0
        return cls(tuple(points), tuple(points.values()))

    @classmethod
    def rolling(cls, line_delay: float, line_exposure: float, direction: str = "down") -> Shutter:
        """Return a rolling shutter: each line is open for `line_exposure`, `line_delay` after the line before it.

        Args:
            line_delay: [shutter time] from one line to the next; all lines must fit into the exposure:
                line_delay * (lines - 1) + line_exposure <= 1, which rendering checks.
            line_exposure: [shutter time] each line sees, above 0.
            direction: the order of the lines, see the class.
        """
        check.number("line_exposure", line_exposure, 0.0, 1.0)
        if line_exposure == 0:
            raise check.fail("line_exposure", "a number above 0", line_exposure)
        return cls((0.0, line_exposure), (1.0, 1.0), line_delay, direction)

    @property
    def t_open(self) -> float:
        """Shutter time at which the first line opens."""
        return self.times[0]

    @property
    def t_close(self) -> float:
        """Shutter time at which the first line closes."""
        return self.times[-1]

    def window(self, t_start: float, t_end: float) -> Shutter:
        """Return the part of this shutter inside [t_start, t_end], as a shutter of its own with unit integral.

        Raises:
            ValueError: nothing is seen in the window, or the shutter rolls.
        """
        check.number("t_start", t_start, 0.0, 1.0)
        check.number("t_end", t_end, 0.0, 1.0)
        start, end = max(t_start, self.t_open), min(t_end, self.t_close)
        if self.line_delay:
            raise check.fail("shutter", "a global shutter, which can be cut", "a rolling one")
        if not start < end:
            raise check.fail("window", f"a part of [{self.t_open:g}, {self.t_close:g}]", f"[{t_start:g}, {t_end:g}]")
        inner = [t for t in self.times if start < t < end]
        weights = tuple(self._weight_at(t) for t in (start, *inner, end))
        if not any(weights):
            raise check.fail("window", "a part in which something is seen", f"[{t_start:g}, {t_end:g}]")
        return Shutter((start, *inner, end), weights)

    def span(self, n_lines: int) -> tuple[float, float]:
        """Return the shutter times at which the first of `n_lines` lines opens and the last closes.

        Raises:
            ValueError: the last line would close after the exposure.
        """
        end = self.t_close + self.line_delay * (n_lines - 1)
        if end > 1 + ROUNDING:
            raise check.fail(
                "shutter", f"{n_lines} lines that close by shutter time 1", f"the last one closing at {end:g}"
            )
        return self.t_open, min(end, 1.0)

    def n_lines(self, width: int, height: int) -> int:
        """Return the number of lines of an image."""
        return height if self.direction in ("down", "up") else width

    def line_of(self, column: Tensor, row: Tensor, size: tuple[int, int]) -> Tensor:
        """Return the line (n,) int64 of the pixels `column`, `row` (n,) of an image of `size` (width, height)."""
        width, height = size
        return {"down": row, "up": height - 1 - row, "right": column, "left": width - 1 - column}[self.direction]

    def weight(self, t_start: Tensor, t_end: Tensor, line: Tensor) -> Tensor:
        """Return the integral of h over [t_start, t_end] (n,) for pixels of `line` (n,). Source: ours."""
        delay = self.line_delay * line.to(t_start.dtype)
        return self._integral(t_end - delay) - self._integral(t_start - delay)

    def density(self, t: Tensor, line: Tensor) -> Tensor:
        """Return h at the shutter times `t` (n,) for pixels of `line` (n,); at a jump, either value. Source: ours."""
        t = t - self.line_delay * line.to(t.dtype)
        times, weights, before = self._pieces(t)
        k = (torch.searchsorted(times, t.detach(), right=True) - 1).clamp(0, len(times) - 2)
        h = weights[k] + (t - times[k]) / times.diff()[k] * weights.diff()[k]
        return torch.where((t >= self.t_open) & (t <= self.t_close), h / before[-1], 0.0)

    def time_of(self, share: Tensor) -> Tensor:
        """Return the shutter times (n,) of the first line until which `share` (n,) in [0, 1] of all weight has passed.

        Source: the inverse of the integral of h, a square root where h rises or falls.
        """
        times, weights, before = self._pieces(share)
        area = share * before[-1]
        piece = (torch.searchsorted(before, area.detach(), right=True) - 1).clamp(0, len(times) - 2)
        area, weight = (area - before[piece]).clamp(min=0.0), weights[piece]
        slope = (weights.diff() / times.diff())[piece]
        lower = weight + torch.sqrt((weight * weight + 2 * slope * area).clamp(min=0.0))
        into = torch.where(lower > 0, 2 * area / torch.where(lower > 0, lower, 1.0), 0.0)
        return torch.minimum(times[piece] + into, times[piece + 1])

    def _pieces(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return times, weights and the area under h until each of the times (k,), as `like` is stored."""
        times = torch.tensor(self.times, dtype=like.dtype, device=like.device)
        weights = torch.tensor(self.weights, dtype=like.dtype, device=like.device)
        areas = 0.5 * (weights[1:] + weights[:-1]) * times.diff()
        return times, weights, torch.cat([areas.new_zeros(1), areas.cumsum(0)])

    def _integral(self, t: Tensor) -> Tensor:
        """Return H (n,) at shutter times of the first line: 0 before it opens, 1 after it closes."""
        times, weights, before = self._pieces(t)
        length, rise = times.diff(), weights.diff()
        t = t.clamp(self.t_open, self.t_close)
        piece = (torch.searchsorted(times, t.detach(), right=True) - 1).clamp(0, len(length) - 1)
        into = t - times[piece]
        return (before[piece] + into * (weights[piece] + 0.5 * into * rise[piece] / length[piece])) / before[-1]

    def _weight_at(self, t: float) -> float:
        """Return h at the shutter time `t` inside the window, up to its scale."""
        k = max(i for i, s in enumerate(self.times[:-1]) if s <= t)
        share = (t - self.times[k]) / (self.times[k + 1] - self.times[k])
        return (1 - share) * self.weights[k] + share * self.weights[k + 1]


def _numbers(name: str, values: Sequence[float], low: float, high: float) -> tuple[float, ...]:
    if not isinstance(values, (tuple, list)):
        raise check.fail_type(name, "a sequence of numbers", values)
    return tuple(check.number(f"{name}[{i}]", v, low, high) for i, v in enumerate(values))
