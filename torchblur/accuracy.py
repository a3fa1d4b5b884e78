"""Accuracy: how surfaces are followed in time, and what the resolve may leave out, with the error that each costs.

Before: nothing.  After: subdivide.py, nodes.py, resolve.py, render.py.
Symbols: t shutter time; z / w depth in normalised device coordinates, in [-1, 1]; a chord is the straight line in time
between the values at the ends of an interval.
"""

from __future__ import annotations

from dataclasses import dataclass

from torchblur import check

METHODS = ("exact", "linear", "adaptive")


@dataclass(frozen=True)
class Accuracy:
    """How exactly a frame is resolved; make one with `exact`, `linear` or `adaptive`.

    In all three the times at which a surface covers a ray are exact.

    Args:
        transmittance_cutoff: along a ray, stop where at most this share of the light is left; a pixel changes by at
            most this times the largest colour behind. 0 leaves out nothing.
        method: "exact", "linear" or "adaptive".
        tolerance: of "adaptive", in (0, 1]; 0 for the others.

    Raises:
        TypeError, ValueError: not a number in [0, 1); not a method; not a tolerance, or one where none belongs.
    """

    transmittance_cutoff: float = 0.0
    method: str = "exact"
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        check.number("transmittance_cutoff", self.transmittance_cutoff, 0.0, 1.0)
        if self.transmittance_cutoff == 1:
            raise check.fail("transmittance_cutoff", "a number below 1", self.transmittance_cutoff)
        if self.method not in METHODS:
            raise check.fail("method", " or ".join(METHODS), self.method)
        check.number("tolerance", self.tolerance, 0.0, 1.0)
        if self.method == "adaptive" and self.tolerance == 0:
            raise check.fail("tolerance", "a number above 0", self.tolerance)
        if self.method != "adaptive" and self.tolerance != 0:
            raise check.fail("tolerance", f"0, as {self.method} has none", self.tolerance)

    @classmethod
    def exact(cls, transmittance_cutoff: float = 0.0) -> Accuracy:
        """Return the accuracy that follows depth, place on the texture and shading through time as they are.

        Accuracy: a pixel is wrong by at most 1e-6 of the largest radiance in it (a texture's contrast, the light on a
            facing surface), the cut-off aside. Not certified are the last 2^-16 of an interval next to a time at which
            a face is seen edge-on, or a light or a vanishing normal is met.
        """
        return cls(transmittance_cutoff)

    @classmethod
    def linear(cls, transmittance_cutoff: float = 0.0) -> Accuracy:
        """Return the accuracy of Ronnow et al. 2021, which knows an interval by its two ends.

        Over each interval z / w, the texture coordinates and the position run straight in time between their values
        at the ends; the normal is that of the start. Straight in z / w is wrong even for a surface that moves evenly
        along the ray, whose w is straight: from w = 1 to 9 it passes w = 3 at t = 1/4, by its chord at t = 3/4.

        Cells are cut where the shutter bends; between, its weight counts as even. A texture's footprint is that at the
        interval's start.

        Accuracy: none stated: depth and texture may be wrong by their whole range within an interval.
        Source: Ronnow et al. 2021, sec. 4.
        """
        return cls(transmittance_cutoff, "linear")

    @classmethod
    def adaptive(cls, tolerance: float, transmittance_cutoff: float = 0.0) -> Accuracy:
        """Return the accuracy of Ronnow et al. 2022: `linear`, on intervals cut until their chords fit.

        Intervals are cut at the extrema of z / w that 20 samples per unit of shutter time show, then halved while the
        chord of z / w, or on textured faces of u or v, may be off by more than `tolerance`. The paper's Algorithm 1
        does not do that as printed; what is wrong there, and what stands here instead:

        1. Time moves on at the top of the loop, so each depth is filed one step late and the sample after the first
           is never taken: here sample k belongs to the time k / n of the interval.
        2. The loop looks past the end and may put an extremum there: here there are n - 1 inner samples, and the
           interval's own end is the last.
        3. The number of steps is a real number, so the test for the last step fires early, and an interval of no
           length divides by zero: here n = max(2, ceil(20 length)), in equal steps that end at the end.
        4. Depths are handed on only where an extremum was looked for, time always: after one skip they never match
           again. Here they are handed on always.
        5. Equal depths before and after a sample are skipped, which is what an extremum on a sample looks like: here
           a sample counts where the depth turns, and of several equal ones their middle.
        6. One halving, by the error at the middle: S-shapes pass it, and the halves are not tested. Here halving goes
           on, up to 12 times, by a bound that holds all along the chord.
        7. Six places are kept, which noise overruns; the text tests the middle of the depths, the code the middle of
           time. Here slopes below rounding count as none, any number of cuts is kept, and time is halved.
        8. Only depth is tested, so that a texture spinning at constant depth is never cut: here u and v are tested
           too.

        Args:
            tolerance: of z / w, u and v (1 is the whole texture), in (0, 1].
            transmittance_cutoff: as for `Accuracy`.

        Accuracy: z / w, u and v within `tolerance` at all times, unless 12 halvings do not reach it.
        Source: Ronnow et al. 2022, alg. 1; certificates ours.
        """
        return cls(transmittance_cutoff, "adaptive", tolerance)
