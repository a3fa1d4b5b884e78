"""Lamps: lights of a clip, where they are at any time, and what torchblur makes of them during an exposure.

Before: motions.py, knots.py (tolerance).  After: clips.py; lit_stages.py chooses them.
Symbols: K segments of a lamp, 0 (it rests) or a power of two, so that its knots nest with those of meshes and camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import torchblur as tb
from datagen.knots import MAX_SEGMENTS, TOLERANCE_PX, Knots
from datagen.motions import Path

KINDS = ("spot", "point", "directional")
PROBES = 8  # instants of a segment at which a lamp's way is compared with its chord


@dataclass(frozen=True)
class Lamp:
    """A light that casts shadows, whose place and target may move."""

    kind: str  # one of KINDS
    position: Path  # a directional one shines from here to the target, everywhere
    target: Path  # a point light has none to speak of
    power: tuple[float, float, float]  # linear RGB: W/sr; of a directional one, W/m^2 of what faces it
    inner_angle_deg: float = 30.0  # of a spot
    outer_angle_deg: float = 45.0

    @property
    def is_static(self) -> bool:
        """Whether its light never moves."""
        return self.position.is_static and (self.kind == "point" or self.target.is_static)

    def light(self, times_s: Tensor) -> tb.PointLight | tb.SpotLight | tb.DirectionalLight:
        """Return torchblur's light with knots at `times_s` (K + 1,) [s], or, for one time, at rest. Source: ours."""
        position, target = (_knots(path.at(times_s)) for path in (self.position, self.target))
        power = torch.tensor(self.power, dtype=torch.float64)
        if self.kind == "point":
            return tb.PointLight(position, power)
        if self.kind == "directional":
            return tb.DirectionalLight(target - position, power)
        angles = {"inner_angle_deg": self.inner_angle_deg, "outer_angle_deg": self.outer_angle_deg}
        return tb.SpotLight(position, target, power, **angles)

    def notes(self, times_s: Tensor) -> dict[str, Any]:
        """Return the lamp with its places at `times_s` as JSON values. Source: ours."""
        notes: dict[str, Any] = {"kind": self.kind, "power": list(self.power)}
        notes["position"] = self.position.at(times_s).tolist()
        if self.kind != "point":
            notes["target"] = self.target.at(times_s).tolist()
        if self.kind == "spot":
            notes |= {"inner_angle_deg": self.inner_angle_deg, "outer_angle_deg": self.outer_angle_deg}
        return notes


def choose_lamp_segments(lamp: Lamp, open_s: float, close_s: float, px_per_unit: float) -> Knots:
    """Return the fewest segments of a lamp's motion that keep its shadows within the tolerance of their exact way.

    A shadow strays from its way by no more than its lamp does, as long as what casts it is at least as far from the
    lamp as from what it falls on.

    Args:
        lamp: whose motion is cut.
        open_s, close_s: when the shutter opens and closes [s of the clip].
        px_per_unit: screen size of a scene unit where the action is [px].

    Source: ours; the chord of a curve, as in knots.py.
    """
    if lamp.is_static:
        return Knots(0, 0.0, False)
    segments = 1
    while True:
        ends = open_s + (close_s - open_s) * torch.arange(segments + 1, dtype=torch.float64) / segments
        share = (torch.arange(PROBES, dtype=torch.float64) + 1) / (PROBES + 1)
        times = (ends[:-1, None] + (ends[1:] - ends[:-1])[:, None] * share).flatten()
        error = 0.0
        for path in (lamp.position, lamp.target):
            at = path.at(ends)
            chord = at[:-1, None] + (at[1:] - at[:-1])[:, None] * share[None, :, None]
            error = max(error, float((path.at(times) - chord.reshape(-1, 3)).norm(dim=-1).max()) * px_per_unit)
        if error <= TOLERANCE_PX or segments >= MAX_SEGMENTS:
            return Knots(segments, error, error > TOLERANCE_PX)
        segments *= 2


def _knots(places: Tensor) -> Tensor:
    """Return (K + 1, 3) places as torchblur wants them: (3,) for one that rests."""
    return places[0] if len(places) == 1 else places
