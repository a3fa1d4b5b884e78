"""Random streams: every clip has its own, found from (seed, stream, clip) alone.

Before: spec.py.  After: scenes.py and what it calls, sensor.py.
"""

from __future__ import annotations

import numpy as np

# Each kind of decision draws from its own stream, so that a new kind moves none of the old ones.
STREAMS = ("stage", "camera", "cast", "motion", "colour", "backdrop", "sensor", "noise", "lamps", "pictures")


def open_stream(seed: int, stream: str, clip: int) -> np.random.Generator:
    """Return the generator of one `stream` of one clip: a counter-based Philox, stateless between clips.

    Args:
        seed: the data set's seed.
        stream: one of STREAMS.
        clip: index of the clip, for `noise` of the frame; at least 0.

    Raises:
        ValueError: an unknown stream.

    Source: numpy's SeedSequence with a spawn key.
    """
    if stream not in STREAMS:
        raise ValueError(f"stream: expected one of {', '.join(STREAMS)}, got {stream!r}")
    key = (STREAMS.index(stream), clip)
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=key)))
