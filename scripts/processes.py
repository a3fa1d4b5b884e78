"""Which processes run and whose children they are, as /proc tells; read by tests and by `reliability.py`."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path


def state_and_parent(pid: int) -> tuple[str, int]:
    """Return the letter of a process's state and its parent; of one that is gone "X" and 0."""
    try:
        state, parent = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[:2]
    except OSError:
        return "X", 0
    return state, int(parent)


def is_running(pid: int) -> bool:
    """Tell whether a process runs; one that has ended may be listed for long, until its new parent asks how."""
    return state_and_parent(pid)[0] not in "ZX"


def children_of(pid: int) -> list[int]:
    """Return the running processes whose parent is `pid`."""
    pids = [int(place.name) for place in Path("/proc").glob("[0-9]*")]
    return [child for child in pids if is_running(child) and state_and_parent(child)[1] == pid]


def outlivers(pids: Iterable[int], seconds: float = 2.0) -> list[int]:
    """Return those processes that still run after some seconds."""
    deadline, left = time.monotonic() + seconds, [pid for pid in pids if is_running(pid)]
    while left and time.monotonic() < deadline:
        time.sleep(0.05)
        left = [pid for pid in left if is_running(pid)]
    return left
