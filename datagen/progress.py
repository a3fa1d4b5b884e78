"""Progress: how far a run is, how fast, and how long it will take (the only door to tqdm).

Before: nothing.  After: runs.py. Writes to stderr only.
"""

from __future__ import annotations

import sys
import time
from types import TracebackType

from tqdm import tqdm

LINE_EVERY_S = 15.0  # without a terminal: a line now and then, fit for a log


class Progress:
    """A bar on a terminal, else lines; counts frames that are finished or failed.

    Args:
        total: frames in the data set.
        already: finished by an earlier run.
        is_quiet: write nothing.
    """

    def __init__(self, total: int, already: int = 0, is_quiet: bool = False) -> None:
        self.total, self.already, self.done, self.failed = total, already, 0, 0
        self.written = 0  # frames told of by the last line
        self.is_quiet = is_quiet
        self.start_s = self.line_s = time.monotonic()
        show = sys.stderr.isatty() and not is_quiet
        self.bar = tqdm(total=total, initial=already, unit="frame", file=sys.stderr, smoothing=0.1) if show else None

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.bar is not None:
            self.bar.close()
        elif self.done + self.failed > self.written:
            self._write_line()

    def step(self, is_done: bool) -> None:
        """Count one more frame, finished or failed. Source: ours."""
        self.done += is_done
        self.failed += not is_done
        if self.bar is not None:
            self.bar.update(1)
            if self.failed:
                self.bar.set_postfix(failed=self.failed)
        elif time.monotonic() - self.line_s >= LINE_EVERY_S:
            self._write_line()

    def say(self, text: str) -> None:
        """Write a line without breaking the bar. Source: ours."""
        if self.is_quiet:
            return
        if self.bar is not None:
            self.bar.write(text, file=sys.stderr)
        else:
            print(text, file=sys.stderr, flush=True)

    def _write_line(self) -> None:
        """Write how far the run is as one line."""
        self.line_s = time.monotonic()
        steps = self.written = self.done + self.failed
        rate = steps / max(self.line_s - self.start_s, 1e-9)
        left_s = (self.total - self.already - steps) / rate if rate else float("inf")
        place = f"{self.already + steps}/{self.total} frames"
        failed = f", {self.failed} failed" if self.failed else ""
        self.say(f"{place}{failed}, {rate:.2f} frames/s, {left_s:.0f} s left")
