"""Break a run of datagen at each of its steps in turn, start the same command again, and look at what is there.

    python scripts/fault_points.py --storage shards --workers 2 --victim worker --way kill-after

A step is whatever asks something of the disk: a file opened for writing, a write, a sync, a rename, a removal, a new
folder. Runs are forked from one process that has rendered the frames already, so that a hundred take seconds; their
workers are forked, too. The k-th step of the chosen victims kills its process before or after it is done, or finds
the disk full, for that step or from then on (its last write is then cut in half, as on a real disk).
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import functools
import hashlib
import io
import multiprocessing
import os
import pathlib
import select
import shutil
import signal
import stat
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import torch  # noqa: E402  after the path

import datagen.executors  # noqa: E402
import datagen.runs  # noqa: E402
from datagen import verify_dataset  # noqa: E402
from datagen.__main__ import main as datagen_main  # noqa: E402
from datagen.manifest import MANIFEST_NAME, scan_manifest  # noqa: E402
from datagen.run_log import LOG_NAME  # noqa: E402
from datagen.writer import FOLDERS, TEMPORARY_PREFIX  # noqa: E402

FIELDS = {"width": 8, "height": 6, "rays-per-pixel": 1, "frames-per-clip": 2, "frames-per-shard": 2, "seed": 4}
FIELDS |= {"backend": "torch"}  # nothing to compile
ORPHAN_SECONDS = 2.0
WAYS = ("kill-before", "kill-after", "full-once", "full")
VICTIMS = ("any", "driver", "worker")
GO_ON, STRIKE = b".", b"!"


@dataclass(frozen=True)
class Fault:
    """What happens at which step."""

    way: str  # one of WAYS
    victim: str  # one of VICTIMS: whose steps count
    step: int  # from 1
    times: int = 1  # for how many steps; a frame is given up when its process has died three times


@dataclass(frozen=True)
class Ending:
    """How a run ended."""

    status: int  # its exit code, or minus the signal that ended it
    was_hit: bool  # whether it came to that step
    is_alone: bool  # whether no process of it was left after ORPHAN_SECONDS
    told: str  # on stdout and stderr


def run(words: list[str], fault: Fault | None) -> Ending:
    """Run datagen's command in a forked process, with a fault or without."""
    tokens, feed = os.pipe()  # read by all processes of the run: whoever gets a STRIKE is struck
    os.write(feed, GO_ON * (fault.step - 1) + STRIKE * fault.times if fault else b"")
    os.close(feed)
    life, held = os.pipe()  # ends when the last process of the run has ended
    with tempfile.TemporaryFile() as told:
        pid = os.fork()
        if pid == 0:
            code = 99
            try:
                os.setpgid(0, 0)
                os.close(life)
                os.dup2(told.fileno(), 1)
                os.dup2(told.fileno(), 2)
                _fork_workers()
                if fault:
                    _arm(fault, tokens)
                code = datagen_main(words)
            finally:
                sys.stderr.flush()
                os._exit(code)
        os.close(held)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        is_alone = bool(select.select([life], [], [], ORPHAN_SECONDS)[0])
        os.close(life)
        if not is_alone:
            os.killpg(pid, signal.SIGKILL)
        left = os.read(tokens, 2**16).count(STRIKE)
        os.close(tokens)
        told.seek(0)
        return Ending(status, bool(fault) and left < fault.times, is_alone, told.read().decode(errors="replace"))


def _fork_workers() -> None:
    """Let workers be forked from the driver, so that they have the frames and the fault."""
    context = multiprocessing.get_context("fork")
    datagen.executors.multiprocessing.get_context = lambda _: context  # type: ignore[assignment]


def _arm(fault: Fault, tokens: int) -> None:
    """Let the steps of this process, and of those that it will fork, take a token each."""
    driver = os.getpid()

    def take() -> bytes:
        counts = fault.victim == "any" or (os.getpid() == driver) == (fault.victim == "driver")
        return os.read(tokens, 1) if counts else GO_ON

    def guarded(real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            token = take()
            _strike(fault, token, is_done=False)
            try:
                return real(*arguments, **options)
            finally:
                _strike(fault, token, is_done=True)

        return call

    class Disk(io.FileIO):
        def write(self, data: Any) -> int:  # type: ignore[override]
            return _write(super().write, data, fault, take())

    real_open, real_write = pathlib.Path.open, os.write

    def opened(path: Path, mode: str = "r", *arguments: Any, **options: Any) -> Any:
        if mode in ("wb", "ab"):
            return io.BufferedWriter(guarded(Disk)(str(path), mode[0]))
        assert not set(mode) & set("wax+"), f"a way of writing that is not watched: {mode}"
        return real_open(path, mode, *arguments, **options)

    def written(descriptor: int, data: bytes) -> int:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):  # a pipe between processes
            return real_write(descriptor, data)
        return _write(functools.partial(real_write, descriptor), data, fault, take())

    pathlib.Path.open = opened  # type: ignore[assignment]
    os.write = written
    real_mkdir, guarded_mkdir = os.mkdir, guarded(os.mkdir)

    def made(path: Any, *arguments: Any, **options: Any) -> None:  # one that is there asks for nothing
        (real_mkdir if Path(path).is_dir() else guarded_mkdir)(path, *arguments, **options)

    os.mkdir = made
    for name in ("fsync", "replace", "unlink"):
        if name == "unlink" and fault.way.startswith("full"):
            continue  # takes no room
        setattr(os, name, guarded(getattr(os, name)))


def _strike(fault: Fault, token: bytes, is_done: bool) -> None:
    """Do what a fault does at a step with this token, before it or after."""
    if fault.way == ("kill-after" if is_done else "kill-before") and token == STRIKE:
        os.kill(os.getpid(), signal.SIGKILL)
    if not is_done and (token == STRIKE or not token) and fault.way == "full":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    if not is_done and token == STRIKE and fault.way == "full-once":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _write(real: Callable[[Any], int], data: Any, fault: Fault, token: bytes) -> int:
    """Write through a fault: a disk that stays full takes half of what did not fit."""
    if fault.way == "full" and token == STRIKE and len(data) > 1:
        return real(bytes(data)[: len(data) // 2])
    _strike(fault, token, is_done=False)
    count = real(data)
    _strike(fault, token, is_done=True)
    return count


def break_and_finish(out: Path, words: list[str], fault: Fault, whole: dict[str, str]) -> list[str] | None:
    """Break a run, finish it, and return in what that differs from what is promised; none if the fault came too late.

    Args:
        out: what the run writes to; there may be something of an earlier run.
        words: the command.
        fault: what breaks it.
        whole: checksums of what a run leaves that nothing breaks.
    """
    workers = int(words[words.index("--workers") + 1])
    ended, problems = run(words, fault), []
    if not ended.was_hit:
        return None
    is_full = fault.way.startswith("full")
    if is_full:
        is_only_told = f"{LOG_NAME}: expected" in ended.told  # how long the run took is lost, and no frame
        wanted: tuple[int, ...] = (0, 1) if is_only_told else (1, 2)
        if os.strerror(errno.ENOSPC) not in ended.told:
            problems.append(f"not told: {ended.told[-200:]!r}")
        problems += [f"{path.name} left" for path in out.rglob(f"{TEMPORARY_PREFIX}*")]
    elif fault.victim == "worker":
        wanted = (0,) if fault.times == 1 else (1,)
        if fault.times == 1 and sums(out) != whole:
            problems.append("another data set although the run went on")
    else:
        wanted = (-signal.SIGKILL,)
    if ended.status not in wanted:
        problems.append(f"ended with {ended.status}, not {wanted}: {ended.told[-300:]!r}")
    if not ended.is_alone:
        problems.append(f"processes alive {ORPHAN_SECONDS} s later")
    problems += listed_damage(out)
    if (unlisted := _finished(out) - _listed(out)) > workers:
        problems.append(f"{unlisted} finished but not listed, by {workers} workers")
    again = run(words, None)
    if again.status != 0:
        problems.append(f"the rerun ended with {again.status}: {again.told[-300:]!r}")
    found = sums(out)
    problems += [f"{name} differs" for name in sorted({**found, **whole}) if found.get(name) != whole.get(name)]
    return problems


def listed_damage(out: Path) -> list[str]:
    """Return what of that which is listed is not whole, right after a fault, be there a list or not."""
    is_begun = (out / "run.json").exists() and ((out / MANIFEST_NAME).exists() or (out / "shards").exists())
    return verify_dataset(out) if is_begun else []


def _finished(out: Path) -> int:
    """Return how many frames have all their files, or how many shards there are."""
    names = [{path.stem for path in (out / name).glob("0*.*")} for name in FOLDERS]
    return len(set.intersection(*names)) + len(list(out.glob("shards/0*.tar")))


def _listed(out: Path) -> int:
    """Return how many frames, or shards, are listed."""
    is_there = (out / MANIFEST_NAME).exists()
    return len(scan_manifest(out)[0]) if is_there else len(list(out.glob("shards/0*.json")))


def sums(folder: Path) -> dict[str, str]:
    """Return the checksum of every file but the locks and the log of how long runs took."""
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and not p.name.startswith((".lock", LOG_NAME))]
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def break_everywhere(base: Path, words: list[str], fault: Fault, begun: int, stride: int) -> tuple[int, int]:
    """Break a run at each of its steps in turn; return at how many, and how many problems there were.

    Args:
        base: a folder to work in.
        words: the command but for its folder.
        fault: its `step` is the first one, and `stride` the distance to the next.
        begun: frames that an earlier run has made; none if 0.
    """
    whole, start, out = base / "whole", base / "begun", base / "broken"
    for place, count in ((whole, []), (start, ["--count", str(begun)])):
        if not place.exists() and (begun or place == whole):
            ended = run([*words, "--out", str(place), *count], None)
            assert ended.status == 0, ended.told
    wanted, points, broken = sums(whole), 0, 0
    while True:
        if begun:
            shutil.copytree(start, out)
        at = replace(fault, step=fault.step + points * stride)
        problems = break_and_finish(out, [*words, "--out", str(out)], at, wanted)
        shutil.rmtree(out, ignore_errors=True)
        if problems is None:
            return points, broken
        for problem in problems:
            print(f"{fault.way} of {fault.victim} at step {at.step}: {problem}", flush=True)
        points, broken = points + 1, broken + len(problems)


def main() -> int:
    """Run what is asked for and return 0 if every promise was kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--storage", choices=("folder", "shards"), default="folder")
    parser.add_argument("--count", type=int, default=3, help="frames")
    parser.add_argument("--begun", type=int, default=0, help="frames that an earlier run has made")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--way", choices=WAYS, nargs="+", default=list(WAYS))
    parser.add_argument("--victim", choices=VICTIMS, default="any")
    parser.add_argument("--times", type=int, default=1, help="steps that go wrong, one after the other")
    parser.add_argument("--stride", type=int, default=1, help="from one step that is tried to the next")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    datagen.runs.make_sample = functools.cache(datagen.runs.make_sample)
    fields = FIELDS | {"storage": chosen.storage, "workers": chosen.workers, "count": chosen.count}
    words = [word for name, value in fields.items() for word in (f"--{name}", str(value))]
    total = 0
    in_memory = Path("/dev/shm")  # where there is such a place: a real disk takes its time for each sync
    with tempfile.TemporaryDirectory(dir=in_memory if os.access(in_memory, os.W_OK) else None) as name:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            datagen_main([*words, "--workers", "1", "--out", f"{name}/rendered"])  # what is forked has the frames
        for way in chosen.way:
            fault = Fault(way, chosen.victim, 1, chosen.times)
            points, broken = break_everywhere(Path(name), words, fault, chosen.begun, chosen.stride)
            asked = f"{chosen.storage}, {chosen.workers} workers: {way} of {chosen.victim}, {chosen.times} times"
            print(f"{asked}: {points} points, {broken} problems", flush=True)
            total += broken
    return min(total, 1)


if __name__ == "__main__":
    sys.exit(main())
