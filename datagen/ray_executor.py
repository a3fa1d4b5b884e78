"""Ray executor: frames made by Ray's workers, of this machine or of the cluster that RAY_ADDRESS names (the only door
to ray).

Before: executors.py.  After: runs.py.
Only text and numbers travel; the workers must see the folder and the assets under the same paths.
Source: ours; Ray core's tasks.
"""

from __future__ import annotations

import contextlib
import importlib.util
import multiprocessing
import os
import shutil
import signal
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from datagen.executors import MAX_TRIES, Outcome, Task, attempt
from datagen.spec import SpecError

OBJECT_STORE_BYTES = 128 * 2**20  # nothing but short texts is stored
# Must be set before the import: no report to anyone, no warning about devices.
SETTINGS = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
ALONE = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}  # no port that other machines reach, where there is no cluster


def run_ray(task: Task, plan_json: str, folder: str, indices: Iterable[int], workers: int) -> Iterator[Outcome]:
    """Run the task on each index in Ray's workers; every index yields one outcome, in the order of finishing.

    A frame whose process dies is tried again, MAX_TRIES times in all; it takes no other frame with it.

    Args:
        task: a function of a module, found by name in the other process.
        plan_json, folder: handed to the task.
        indices: frames to make.
        workers: how many are made at a time, at least 1.

    Raises:
        ValueError: fewer than one worker.
        SpecError: ray is not installed.

    Source: ours.
    """
    if workers < 1:
        raise ValueError(f"workers: expected at least 1, got {workers}")
    with _session(workers) as ray:
        remote = ray.remote(num_cpus=1, max_retries=MAX_TRIES - 1)(_attempt_alone)
        waiting = iter(indices)
        running: dict[Any, int] = {}
        while True:
            for index in waiting:
                running[remote.remote(task, plan_json, os.path.abspath(folder), index)] = index  # noqa: PTH100
                if len(running) >= workers:
                    break
            if not running:
                return
            (finished,), _ = ray.wait(list(running), num_returns=1)
            index = running.pop(finished)
            try:
                yield Outcome(*ray.get(finished))
            except ray.exceptions.WorkerCrashedError:
                yield Outcome(index, error=f"its process died {MAX_TRIES} times")
            except ray.exceptions.RayError as error:
                yield Outcome(index, error=f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")


def check_ray() -> None:
    """Raise SpecError if the package is not installed. Source: ours."""
    if importlib.util.find_spec("ray") is None:
        wanted = "expected local, or ray with its package (pip install 'torchblur[ray]')"
        raise SpecError([f"executor: {wanted}, got 'ray' without it"])


def _attempt_alone(task: Task, plan_json: str, folder: str, index: int) -> tuple[int, str, str]:
    """Return the outcome's fields, made with one torch thread so that the bytes are those of any run."""
    import torch

    torch.set_num_threads(1)
    outcome = attempt(task, plan_json, folder, index)
    return outcome.index, outcome.text, outcome.error


@contextlib.contextmanager
def _session(workers: int) -> Iterator[Any]:
    """Lend a connected Ray: the one that this program already has, the cluster's, or one of its own that ends here."""
    for name, value in (SETTINGS | ({} if os.environ.get("RAY_ADDRESS") else ALONE)).items():
        os.environ.setdefault(name, value)
    check_ray()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about Ray's own future
        import ray
    if ray.is_initialized():
        yield ray
        return
    quiet = {"log_to_driver": False, "logging_level": "ERROR"}
    if os.environ.get("RAY_ADDRESS"):
        ray.init(**quiet)
        try:
            yield ray
        finally:
            ray.shutdown()
        return
    with tempfile.TemporaryDirectory(prefix="ray-", ignore_cleanup_errors=True) as place:
        own = {"num_cpus": workers, "include_dashboard": False, "object_store_memory": OBJECT_STORE_BYTES}
        watch = multiprocessing.get_context("spawn").Process(target=_end_with_driver, args=(place,), daemon=True)
        watch.start()
        ray.init(_temp_dir=place, **own, **quiet)
        try:
            yield ray
        finally:
            ray.shutdown()
            watch.kill()
            watch.join()


def _end_with_driver(place: str) -> None:
    """Wait for the driver to be killed, then end what Ray leaves alive: the processes with files open in its folder."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    for process in Path("/proc").glob("[0-9]*"):  # elsewhere than on Linux there is none
        with contextlib.suppress(OSError):  # ended, or another user's
            if any(str(file.readlink()).startswith(place) for file in (process / "fd").iterdir()):
                os.kill(int(process.name), signal.SIGKILL)
    shutil.rmtree(place, ignore_errors=True)
