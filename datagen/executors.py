"""Executors: where frames are made, in this process or in several of this machine.

Before: nothing (they know no frames, only numbers).  After: ray_executor.py, runs.py.
Only text and numbers travel between processes; what a frame is made of is found again there.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

# torch is imported in functions: a new process must watch over the driver before it spends seconds on that.
MAX_TRIES = 3  # of a frame whose process died; an exception is not tried again, as it would come again

Task = Callable[[str, str, int], str]  # (plan, folder, index) -> text


@dataclass(frozen=True)
class Outcome:
    """What became of one frame: `text` from the task, or `error`."""

    index: int
    text: str = ""
    error: str = ""


def run_serial(task: Task, plan_json: str, folder: str, indices: Iterable[int]) -> Iterator[Outcome]:
    """Run the task on each index in this process, with one torch thread so that the bytes are those of any run.

    Source: ours.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for index in indices:
            yield attempt(task, plan_json, folder, index)
    finally:
        torch.set_num_threads(before)


def run_processes(task: Task, plan_json: str, folder: str, indices: Iterable[int], workers: int) -> Iterator[Outcome]:
    """Run the task in `workers` processes; every index yields one outcome, in the order of finishing.

    A process that dies takes no other frame with it: the pool is made anew, the frames that were running are tried
    again one at a time, and one that has been there MAX_TRIES times is given up.

    Args:
        task: a function of a module, found by name in the other process.
        plan_json, folder: handed to the task.
        indices: frames to make.
        workers: number of processes, at least 1.

    Raises:
        ValueError: fewer than one worker.

    Source: ours.
    """
    if workers < 1:
        raise ValueError(f"workers: expected at least 1, got {workers}")
    waiting, suspects, tries = deque(indices), deque[int](), dict[int, int]()
    pool = _new_pool(workers)
    running: dict[Future[Outcome], int] = {}
    try:
        while waiting or suspects or running:
            alone = bool(suspects)  # then whoever kills the process is known
            room = (1 if alone else workers) - len(running)
            queue = suspects if alone else waiting
            while room > 0 and queue:
                try:
                    future = pool.submit(attempt, task, plan_json, folder, queue[0])
                except BrokenProcessPool:  # a process died between two frames: none of them is to blame
                    if running:
                        break  # they end with it, below
                    _end_pool(pool, is_idle=False)
                    pool = _new_pool(workers)
                    continue
                running[future] = queue.popleft()
                room -= 1
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            is_broken = False
            for future in finished:
                index = running.pop(future)
                try:
                    yield future.result()
                except BrokenProcessPool:
                    is_broken = True
                    running[future] = index
            if is_broken:
                for index in sorted(running.values()):
                    tries[index] = tries.get(index, 0) + 1
                    if tries[index] < MAX_TRIES:
                        suspects.append(index)
                    else:
                        yield Outcome(index, error=f"its process died {MAX_TRIES} times")
                running.clear()
                _end_pool(pool, is_idle=False)
                pool = _new_pool(workers)
    finally:
        _end_pool(pool, is_idle=not running)


def attempt(task: Task, plan_json: str, folder: str, index: int) -> Outcome:
    """Return the task's outcome; an exception becomes its text, so that the other frames go on. Source: ours."""
    try:
        return Outcome(index, text=task(plan_json, folder, index))
    except Exception as error:
        return Outcome(index, error=f"{type(error).__name__}: {' '.join(str(error).split())}")


def _new_pool(workers: int) -> ProcessPoolExecutor:
    """Return fresh processes: spawned, as forking a process with threads may hang."""
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"), initializer=_begin_process)


def _end_pool(pool: ProcessPoolExecutor, is_idle: bool) -> None:
    """End a pool; one that is not idle without waiting for its frames, which nobody would list."""
    if is_idle:
        pool.shutdown(wait=True)
        return
    processes = list((pool._processes or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        with contextlib.suppress(Exception):  # already gone
            process.terminate()
    for process in processes:
        with contextlib.suppress(Exception):
            process.join(timeout=10)


def _begin_process() -> None:
    """Prepare a worker: no life after the driver's, the interrupt left to the driver, one torch thread."""
    _end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import torch

    torch.set_num_threads(1)


def _end_with_parent() -> None:
    """Let this process end when its driver does, killed or not: by a thread, and where possible by the system.

    A thread waits for as long as an import or compiled code holds the interpreter; SIGIO, which is sent when the
    driver's end of the pipe closes, does not.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait_and_end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait_and_end, daemon=True).start()
    if fcntl is not None and hasattr(os, "O_ASYNC"):
        pipe = parent.sentinel
        fcntl.fcntl(pipe, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_ASYNC)
