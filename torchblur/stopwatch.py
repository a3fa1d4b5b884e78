"""Seconds spent on single effects, wherever in a rendering they are spent.

Before: nothing.  After: all that serves one effect, ledger.py.
Source: ours.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_running: ContextVar[Watch | None] = ContextVar("torchblur_watch", default=None)


class Watch:
    """Seconds by effect, each second counted once: to the innermost effect that is being served."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._open: list[str] = []
        self._since = 0.0

    def turn(self, effect: str | None) -> None:
        """Go over to an effect, or back to the one before it where `effect` is none."""
        now = time.perf_counter()
        if self._open:
            self.seconds[self._open[-1]] = self.seconds.get(self._open[-1], 0.0) + now - self._since
        if effect is None:
            self._open.pop()
        else:
            self._open.append(effect)
        self._since = now


@contextmanager
def watching() -> Iterator[Watch]:
    """Collect what is spent inside, in this thread."""
    watch = Watch()
    token = _running.set(watch)
    try:
        yield watch
    finally:
        _running.reset(token)


@contextmanager
def spent_on(effect: str) -> Iterator[None]:
    """Count what is spent inside, or in what this decorates, as spent on `effect`, if anybody is watching."""
    watch = _running.get()
    if watch is None:
        yield
        return
    watch.turn(effect)
    try:
        yield
    finally:
        watch.turn(None)
