"""What a rendering did: counts, and seconds in each of its stages.

Before: nothing.  After: render.py.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch

from torchblur.shadows import Shadows

COUNTS = ("prisms", "blocks", "pairs", "still_pairs", "hidden_pairs", "intervals", "cells", "layers", "crossings")
COUNTS += ("nodes", "deepest_pixel", "shadow_pairs", "shadow_ranges", "shadow_bytes", "deepest_shadow")
TIMED_EFFECTS = ("texture", "lighting", "shadows", "crossings", "curvature")  # that have code of their own
STAGES = ("prisms", "plan", "intervals", "cells", "nodes", "shadows", "resolve")


@dataclass
class Ledger:
    """What was done so far."""

    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COUNTS, 0))
    timings: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))

    def add(self, name: str, n: int) -> None:
        """Count `n` more."""
        self.counts[name] += int(n)

    def add_many(self, counts: dict[str, int]) -> None:
        """Count all that `counts` says; of the deepest pixel, keep the largest."""
        for name, n in counts.items():
            if name == "deepest_pixel":
                self.deepest(name, n)
            else:
                self.add(name, n)

    def deepest(self, name: str, n: int) -> None:
        """Keep the largest."""
        self.counts[name] = max(self.counts[name], int(n))

    def add_shadows(self, shadows: Shadows | None) -> None:
        """Count what finding shadows took."""
        if shadows is not None:
            self.add("shadow_pairs", shadows.n_pairs)
            self.add("shadow_ranges", shadows.n_ranges)
            self.add("shadow_bytes", shadows.n_bytes)
            self.deepest("deepest_shadow", shadows.deepest)

    @contextmanager
    def stage(self, name: str, device: torch.device) -> Iterator[None]:
        """Time what is done inside."""
        start = time.perf_counter()
        yield
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        self.timings[name] += time.perf_counter() - start
