"""Accuracy: what the resolve may leave out, with the error that it costs.

Before: nothing.  After: resolve.py, render.py.
"""

from __future__ import annotations

from dataclasses import dataclass

from torchblur import check


@dataclass(frozen=True)
class Accuracy:
    """How exactly a frame is resolved.

    Args:
        transmittance_cutoff: along a ray, stop where at most this share of the light is left; a pixel changes by at
            most this times the largest colour behind. 0 leaves out nothing.

    Raises:
        TypeError, ValueError: not a number in [0, 1).
    """

    transmittance_cutoff: float = 0.0

    def __post_init__(self) -> None:
        check.number("transmittance_cutoff", self.transmittance_cutoff, 0.0, 1.0)
        if self.transmittance_cutoff == 1:
            raise check.fail("transmittance_cutoff", "a number below 1", self.transmittance_cutoff)

    @classmethod
    def exact(cls, transmittance_cutoff: float = 0.0) -> Accuracy:
        """Return the accuracy that integrates over time without approximation."""
        return cls(transmittance_cutoff)
