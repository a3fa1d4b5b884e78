"""Shutter: how much each shutter time weighs in the exposure.

Before: nothing.  After: cells.py (event times), resolve.py (weight of a cell).
Symbols: t in [0, 1] is shutter time, 0 opens, 1 closes; h(t) the weight, of unit integral; H its antiderivative.
Source: the h of the rendering integral in Ronnow et al. 2021, sec. 3.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchblur import check


@dataclass(frozen=True)
class Shutter:
    """A box shutter: open with equal weight between two shutter times, so that the frame is their mean.

    Args:
        t_open, t_close: shutter times [share of the exposure], 0 <= t_open < t_close <= 1.

    Raises:
        ValueError: the window is empty or leaves [0, 1].
    """

    t_open: float = 0.0
    t_close: float = 1.0

    def __post_init__(self) -> None:
        check.number("t_open", self.t_open, 0.0, 1.0)
        check.number("t_close", self.t_close, 0.0, 1.0)
        if not self.t_open < self.t_close:
            raise check.fail("t_close", f"a number above t_open = {self.t_open:g}", self.t_close)

    @classmethod
    def box(cls, t_open: float = 0.0, t_close: float = 1.0) -> Shutter:
        """Return the box shutter over [t_open, t_close]; without arguments, the whole exposure.

        Example:
            >>> Shutter.box(0.0, 0.5).t_close
            0.5
        """
        return cls(t_open, t_close)

    def weight(self, t_start: Tensor, t_end: Tensor) -> Tensor:
        """Return the integral of h over [t_start, t_end], which must lie inside the window. Source: ours."""
        return (t_end - t_start) / (self.t_close - self.t_open)
