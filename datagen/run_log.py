"""Run log: how long the runs of a data set took, for its report; no byte of a frame depends on it.

Before: folders.py, writer.py.  After: runs.py writes it, pages.py and checks.py read it.
`.runs.log` has one line of JSON for each run that made or failed to make a frame; a run that was killed has none.
Slices append to the same file, one at a time. Each line has its checksum; a run of the whole set drops those
that were damaged.
"""

from __future__ import annotations

import errno
import json
import math
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from datagen.folders import one_at_a_time, record_sum
from datagen.writer import write_atomically

LOG_NAME = ".runs.log"


@dataclass
class RunNote:
    """What one run made, and in what time."""

    started_s: float  # since 1970, UTC
    seconds: float
    made: int  # frames
    failed: int
    workers: int
    part: str  # the slice as `3/100`; empty for a whole run

    @property
    def pairs_per_s(self) -> float:
        """Frames made in a second."""
        return self.made / self.seconds if self.seconds > 0 else 0.0


@contextmanager
def logged_run(folder: Path, workers: int, part: str) -> Iterator[RunNote]:
    """Give a note to count in, and add it to the log when the block ends, however; not if nothing was done.

    A log that cannot be written is told of on stderr: the frames do not depend on it.

    Args:
        folder: of the data set.
        workers: processes of the run.
        part: see `RunNote`.

    Source: ours.
    """
    note = RunNote(time.time(), 0.0, 0, 0, workers, part)
    start = time.monotonic()
    try:
        yield note
    finally:
        note.seconds = time.monotonic() - start
        if note.made or note.failed:
            try:
                with one_at_a_time(folder) if part else nullcontext():
                    _add_line(folder / LOG_NAME, encode_line(asdict(note)))
            except OSError as error:
                print(f"{folder / LOG_NAME}: expected to add a line, got {error.strerror}", file=sys.stderr)


def read_log(folder: str | Path) -> tuple[list[RunNote], int]:
    """Return the notes in the order of their lines, none if there is no log, and how many lines cannot be read.

    Source: ours.
    """
    try:
        lines = (Path(folder) / LOG_NAME).read_bytes().splitlines()
    except FileNotFoundError:
        return [], 0
    notes, unread = [], 0
    for line in lines:
        try:
            fields = json.loads(line)
            del fields["line_sha256"]
            note, is_written = RunNote(**fields), encode_line(fields) == line + b"\n"
            numbers = (note.started_s, note.seconds, note.made, note.failed, note.workers)
            is_valid = is_written and all(isinstance(n, (int, float)) and math.isfinite(n) and n >= 0 for n in numbers)
            is_valid = is_valid and isinstance(note.part, str)
        except (ValueError, TypeError, KeyError, RecursionError):
            is_valid = False
        if is_valid:
            notes.append(note)
        else:
            unread += 1
    return notes, unread


def drop_damaged_lines(folder: Path) -> None:
    """Write the log anew if lines of it cannot be read. Source: ours."""
    try:
        notes, unread = read_log(folder)
        if unread:
            write_atomically(folder / LOG_NAME, b"".join(encode_line(asdict(note)) for note in notes))
    except OSError as error:
        print(f"{folder / LOG_NAME}: expected a log that can be mended, got {error.strerror}", file=sys.stderr)


def encode_line(fields: dict[str, Any]) -> bytes:
    """Return a note's fields as its line of the log, with its checksum. Source: ours."""
    return json.dumps(fields | {"line_sha256": record_sum(fields)}, sort_keys=True).encode() + b"\n"


def _add_line(place: Path, line: bytes) -> None:
    """Add a line to the log, or nothing of it where the disk has no room for the whole."""
    descriptor = os.open(place, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        before = os.fstat(descriptor).st_size
        if os.write(descriptor, line) < len(line):
            os.ftruncate(descriptor, before)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    finally:
        os.close(descriptor)
