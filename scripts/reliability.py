"""Longer versions of the tests of datagen's promises: kills, full disks and changed bits, and what becomes of the data.

    python scripts/reliability.py --kills 50 --flips 1000

Each round starts a run of two workers, kills the driver or a worker (SIGKILL) at a random time, looks at what is
left, and starts the same command again; at the end every byte must be that of a run that was left alone. Runs of
three workers are broken at each of their steps (fault_points.py). Runs write to disks in memory that are too small for
them, where this user may mount some, and finish once these have been made larger.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "scripts")]

from fault_points import listed_damage, sums  # noqa: E402  after the path
from processes import children_of, outlivers  # noqa: E402

from datagen import verify_dataset  # noqa: E402
from datagen.writer import TEMPORARY_PREFIX  # noqa: E402

FIELDS = {
    "count": 12,
    "width": 16,
    "height": 12,
    "rays-per-pixel": 1,
    "frames-per-clip": 2,
    "frames-per-shard": 2,
    "workers": 2,
}


def main() -> int:
    """Run what is asked for and return 0 if every promise was kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=10, help="rounds for each way of storage and each victim")
    parser.add_argument("--flips", type=int, default=1000, help="changed bits for each way of storage")
    parser.add_argument("--frames", type=int, default=6, help="of the runs that are broken at each step")
    parser.add_argument("--disks", type=int, default=20, help="sizes of small disks for each way of storage")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    rng = random.Random(chosen.seed)
    broken = 0
    with tempfile.TemporaryDirectory() as name:
        for storage in ("folder", "shards"):
            whole = Path(name) / f"{storage}-whole"
            start_s = time.monotonic()
            assert start(whole, storage).wait() == 0
            usual_s = time.monotonic() - start_s
            for victim in ("driver", "worker"):
                for _ in range(chosen.kills):
                    delay_s = usual_s * rng.random()
                    for problem in kill_and_finish(Path(name), storage, victim, delay_s):
                        print(f"{storage}: {victim} killed after {delay_s:.2f} s: {problem}")
                        broken += 1
                print(f"{storage}: {victim} killed {chosen.kills} times, {broken} problems so far", flush=True)
            missed = sum(not finds_a_flip(whole, rng) for _ in range(chosen.flips))
            print(f"{storage}: {chosen.flips} bits changed, {missed} not found")
            broken += missed
            broken += fill_disks(Path(name), storage, chosen.disks)
            broken += break_at_each_step(storage, chosen.frames)
    return min(broken, 1)


def start(out: Path, storage: str) -> subprocess.Popen[bytes]:
    """Start a run."""
    flags = [word for name, value in FIELDS.items() for word in (f"--{name}", str(value))]
    words = [sys.executable, "-m", "datagen", "--out", str(out), "--storage", storage, *flags]
    return subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def kill_and_finish(base: Path, storage: str, victim: str, delay_s: float) -> list[str]:
    """Kill a run once, finish it, and return in what it differs from what was promised."""
    with tempfile.TemporaryDirectory(dir=base) as name:
        out, problems = Path(name) / "data", []
        run = start(out, storage)
        time.sleep(delay_s)
        workers = children_of(run.pid)
        target = random.Random(delay_s).choice(workers) if victim == "worker" and workers else run.pid
        with contextlib.suppress(ProcessLookupError):  # it may just have ended
            os.kill(target, signal.SIGKILL)
        run.wait(timeout=300)
        if target == run.pid:
            alive = outlivers(workers)
            problems += [f"{len(alive)} processes alive 2 s later"] if alive else []
            outlivers(alive, seconds=float("inf"))
        problems += listed_damage(out)
        code = start(out, storage).wait()
        problems += [f"exit code {code}"] if code else []
        found, wanted = sums(out), sums(base / f"{storage}-whole")
        differing = sorted(key for key in {**found, **wanted} if found.get(key) != wanted.get(key))
        return problems + [f"{key} differs" for key in differing]


def break_at_each_step(storage: str, frames: int) -> int:
    """Break runs at each of their steps in all ways, and return how many ways broke a promise."""
    words = [sys.executable, "scripts/fault_points.py", "--storage", storage, "--count", str(frames)] if frames else []
    broken = 0
    for asked in (
        "--workers 1",
        "--workers 1 --begun 3",
        "--workers 3 --victim driver --way kill-before kill-after",
        "--workers 3 --victim worker --way kill-before kill-after",
        "--workers 3 --victim worker --way kill-before kill-after --times 5",
        "--workers 3 --way full full-once",
    ):
        if frames:
            broken += subprocess.run([*words, *asked.split()], cwd=ROOT, check=False).returncode != 0
    return broken


def fill_disks(base: Path, storage: str, count: int) -> int:
    """Run on disks that are too small, then make them larger; return how many problems there were."""
    whole, place = base / f"{storage}-whole", base / "disk"
    place.mkdir(exist_ok=True)
    needed_kib, wanted, broken, full = (
        4 * sum(-(-p.stat().st_size // 4096) for p in whole.rglob("*")),
        sums(whole),
        0,
        0,
    )
    for k in range(count):
        size = f"size={max(8, needed_kib * (k + 1) // (count + 1)) // 4 * 4}k"
        mount = ["mount", "-t", "tmpfs", "-o"]
        if subprocess.run([*mount, size, "none", str(place)], check=False, stderr=subprocess.DEVNULL).returncode:
            print(f"{storage}: small disks left out, this user may not mount any")
            return broken
        try:
            out, problems = place / "data", []
            code = start(out, storage).wait()
            full += code != 0
            if code == 0 and sums(out) != wanted:
                problems.append("exit code 0, but another data set")
            problems += [f"{path.name} left" for path in place.rglob(f"{TEMPORARY_PREFIX}*")]
            problems += listed_damage(out)
            subprocess.run(["mount", "-o", "remount,size=256m", str(place)], check=True)
            code = start(out, storage).wait()
            problems += [f"then exit code {code}"] if code else []
            problems += [] if sums(out) == wanted else ["then another data set"]
        finally:
            subprocess.run(["umount", str(place)], check=True)
        for problem in problems:
            print(f"{storage}: on a disk of {size}: {problem}")
        broken += len(problems)
    print(f"{storage}: {count} small disks, {full} of them too small, {broken} problems", flush=True)
    return broken


def finds_a_flip(folder: Path, rng: random.Random) -> bool:
    """Change one bit of what `verify` answers for, and tell whether it is found."""
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.stat().st_size]  # the locks are empty
    path = rng.choice(files)
    data = path.read_bytes()
    changed = bytearray(data)
    changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(bytes(changed))
    is_found = verify_dataset(folder) != []
    path.write_bytes(data)
    return is_found


if __name__ == "__main__":
    sys.exit(main())
