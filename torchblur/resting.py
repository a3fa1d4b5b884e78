"""Lit layers at rest: nothing but the shadows on them changes, so that they are points and need not be followed.

Before: paths.py, shading.py.  After: nodes.py.
Symbols: K pairs of a span and a layer at rest in its cell.
Source: ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import packed
from torchblur.blocking import Receivers
from torchblur.cells import Cells
from torchblur.intervals import Intervals
from torchblur.paths import Spans
from torchblur.prisms import Prisms
from torchblur.shading import points_on_prisms, position_and_normal


@dataclass(frozen=True)
class Resting:
    """The lit layers of spans that rest."""

    span: Tensor  # (K,) int64, sorted
    receivers: Receivers  # K of them
    due: tuple[Tensor, ...]  # light by light (K,) bool: whether their surface faces it

    @classmethod
    def of(cls, prisms: Prisms, intervals: Intervals, cells: Cells, spans: Spans, rests: Tensor) -> Resting:
        """Return the layers of spans that rest, of all those in the cells `rests` (L,) bool. Source: ours."""
        layer, span = packed.expand(cells.layer_offsets[spans.cell], cells.layer_offsets.diff()[spans.cell])
        chosen = rests[layer].nonzero().flatten()
        span, interval = span[chosen], cells.layer_interval[layer[chosen]]
        t = spans.t[:, span]
        points = points_on_prisms(prisms, intervals, interval, t.mean(0))
        place, normal = position_and_normal(prisms.surfaces, points, torch.arange(len(span), device=span.device))
        one = torch.ones(1, dtype=torch.float64, device=span.device).expand(3, len(span))
        receivers = Receivers(place.expand(4, -1, -1), one, t, points.face, torch.ones_like(span).bool())
        lights = prisms.surfaces.lights
        due = tuple((normal * light.arriving(place, points.t)[0]).sum(0) > 0 for light in lights)
        return cls(span, receivers, due)
