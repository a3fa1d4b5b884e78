"""A real data set made by each executor: pairs per second, bytes per pair, and what a kill in the middle costs.

    python scripts/real_run.py --count 2000 --size 256 --workers 2 --out out/real_run

For each executor the set is made twice: left alone, and with the driver killed (SIGKILL) once half of the frames are
listed, after which the same command finishes it. Both must be the same, byte for byte. The time lost is that of both
parts of the second less that of the first. The most memory that one process of a run has taken is noted when a tenth of
the frames is listed and at the end; the share of the time in which nothing is rendered, with one process and 40 frames.
Options that the script does not know go to the generator. What is measured is kept in `results.json` of the folder:
stopped, the same command measures what is missing. Run it alone: it measures wall time.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import torch  # noqa: E402  after the path

import torchblur as tb  # noqa: E402
from datagen import generate, parse_spec  # noqa: E402
from datagen.ahead import compile_ahead  # noqa: E402
from datagen.entries import read_entries  # noqa: E402
from datagen.manifest import ManifestError  # noqa: E402

EXECUTORS = ("local", "ray")
POLL_S = 0.5
TIMED_FRAMES = 40


def main() -> int:
    """Measure what is asked for, print it, and return 0 if the killed runs came out the same."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000, help="frames")
    parser.add_argument("--size", type=int, default=256, help="width and height [px]")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--executors", default=",".join(EXECUTORS), help="some of local, ray, between commas")
    parser.add_argument("--out", default="out/real_run", help="folder for the data and the results")
    chosen, more = parser.parse_known_args()
    names = chosen.executors.split(",")
    if not set(names) <= set(EXECUTORS) or chosen.count < 2 or chosen.workers < 1:
        parser.error(f"expected executors of {', '.join(EXECUTORS)}, at least 2 frames and 1 worker")
    out = Path(chosen.out)
    out.mkdir(parents=True, exist_ok=True)
    fields = {"count": chosen.count, "width": chosen.size, "height": chosen.size, "workers": chosen.workers}
    flags = [word for name, value in fields.items() for word in (f"--{name}", str(value))] + more
    results = _kept(out / "results.json", flags)
    for name in names:
        if name not in results["runs"]:
            results["runs"][name] = measure(out, name, flags, chosen.count)
            (out / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    if "outside_rendering" not in results:
        results["outside_rendering"] = outside_rendering(out / "timed", chosen.size)
        (out / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    tell(results, chosen.count)
    sums = {results["runs"][name]["sha256"] for name in names}
    is_same = len(sums) == 1 and all(results["runs"][name]["is_same_after_kill"] for name in names)
    print("all runs came out the same" if is_same else "DIFFERENT: see results.json")
    return 0 if is_same else 1


def _kept(place: Path, flags: list[str]) -> dict[str, Any]:
    """Return the results of an earlier start with the same options, or none."""
    if place.exists():
        earlier = json.loads(place.read_text())
        if earlier["flags"] == flags:
            return earlier
    return {"flags": flags, "machine": f"{os.cpu_count()} CPUs, {platform.machine()}", "runs": {}}


def measure(out: Path, name: str, flags: list[str], count: int) -> dict[str, Any]:
    """Make the set twice with an executor, the second time with a kill in the middle, and return what was measured."""
    whole, killed = out / f"{name}-whole", out / f"{name}-killed"
    for folder in (whole, killed):
        shutil.rmtree(folder, ignore_errors=True)
    start_s = time.monotonic()
    early, late = _finish(start(whole, name, flags), whole, count // 10)
    whole_s = time.monotonic() - start_s
    entries = read_entries(whole)
    size = sum(file["bytes"] for entry in entries.values() for file in entry["files"])
    first_s, listed = run_and_kill(killed, name, flags, count // 2)
    start_s = time.monotonic()
    _finish(start(killed, name, flags), killed, count)
    second_s = time.monotonic() - start_s
    return {
        "seconds": whole_s,
        "pairs_per_second": count / whole_s,
        "bytes_per_pair": size / count,
        "peak_bytes_at_a_tenth": early,
        "peak_bytes": late,
        "listed_at_the_kill": listed,
        "seconds_before_the_kill": first_s,
        "seconds_after_the_kill": second_s,
        "seconds_lost_to_the_kill": first_s + second_s - whole_s,
        "is_same_after_kill": content_sum(killed) == content_sum(whole),
        "sha256": content_sum(whole),
    }


def start(folder: Path, name: str, flags: list[str]) -> subprocess.Popen[bytes]:
    """Start the generator."""
    words = [sys.executable, "-m", "datagen", "--out", str(folder.resolve()), "--executor", name, *flags]
    log = folder.with_suffix(".log").open("ab")
    return subprocess.Popen(words, cwd=ROOT, stdout=log, stderr=log, env=os.environ | {"OMP_NUM_THREADS": "1"})


def _finish(run: subprocess.Popen[bytes], folder: Path, early: int) -> tuple[int, int]:
    """Wait for a run that must succeed.

    Returns:
        The most memory that one process has taken when `early` frames are listed, and in all [bytes].
    """
    peak = peak_early = 0
    while run.poll() is None:
        peak = max(peak, _peak_of_descendants(run.pid))
        peak_early = peak if not peak_early and _listed(folder) >= early else peak_early
        time.sleep(POLL_S)
    if run.returncode != 0:
        raise SystemExit(f"a run ended with {run.returncode}: {' '.join(map(str, run.args))}")
    return peak_early, peak


def _peak_of_descendants(pid: int) -> int:
    """Return the most memory that a living process under `pid` has taken [bytes]; 0 where /proc does not tell."""
    parents, peaks = {}, {}
    for place in Path("/proc").glob("[0-9]*/status"):
        try:
            fields = dict(line.split(":", 1) for line in place.read_text().splitlines())
        except OSError:  # it has ended
            continue
        parents[int(fields["Pid"])] = int(fields["PPid"])
        peaks[int(fields["Pid"])] = int(fields.get("VmHWM", "0 kB").split()[0]) * 1024
    found = {pid}
    for _ in range(4):  # Ray's workers are its grandchildren
        found |= {child for child, parent in parents.items() if parent in found}
    return max((peaks.get(child, 0) for child in found - {pid}), default=0)


def outside_rendering(folder: Path, size: int) -> float:
    """Return the share of a serial run's time in which neither blurred nor sharp images are rendered."""
    torch.set_num_threads(1)
    compile_ahead()
    shutil.rmtree(folder, ignore_errors=True)
    rendered_s, originals = [0.0], (tb.render, tb.render_instant)

    def timed(original: Any) -> Any:
        def call(*arguments: Any, **options: Any) -> Any:
            start_s = time.perf_counter()
            try:
                return original(*arguments, **options)
            finally:
                rendered_s[0] += time.perf_counter() - start_s

        return call

    tb.render, tb.render_instant = map(timed, originals)
    try:
        start_s = time.perf_counter()
        generate(parse_spec({"count": TIMED_FRAMES, "width": size, "height": size}), folder)
        return 1 - rendered_s[0] / (time.perf_counter() - start_s)
    finally:
        tb.render, tb.render_instant = originals


def run_and_kill(folder: Path, name: str, flags: list[str], half: int) -> tuple[float, int]:
    """Kill a run once `half` of the frames are listed; return how long it ran [s] and how many were listed."""
    start_s = time.monotonic()
    run = start(folder, name, flags)
    while run.poll() is None and _listed(folder) < half:
        time.sleep(POLL_S)
    if run.poll() is not None:
        raise SystemExit(f"expected a run to kill, got one that had ended with {run.returncode}")
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    return time.monotonic() - start_s, _listed(folder)


def _listed(folder: Path) -> int:
    """Return how many frames are listed as finished."""
    try:
        return len(read_entries(folder))
    except (FileNotFoundError, ManifestError):  # not begun yet
        return 0


def content_sum(folder: Path) -> str:
    """Return one hash of the names and hashes of all frames' files."""
    files = sorted((f["path"], f["sha256"]) for e in read_entries(folder).values() for f in e["files"])
    return hashlib.sha256(json.dumps(files).encode()).hexdigest()


def tell(results: dict[str, Any], count: int) -> None:
    """Print the results as a table."""
    print(f"{count} frames, {' '.join(results['flags'])}; {results['machine']}")
    print("| executor | pairs per second | bytes per pair | listed at the kill | time lost | peak at a tenth | peak |")
    print("|---|--:|--:|--:|--:|--:|--:|")
    for name, run in results["runs"].items():
        share = run["seconds_lost_to_the_kill"] / run["seconds"]
        peaks = " | ".join(f"{run[k] / 2**20:.0f} MB" for k in ("peak_bytes_at_a_tenth", "peak_bytes"))
        print(
            f"| {name} | {run['pairs_per_second']:.3f} | {run['bytes_per_pair']:,.0f} | {run['listed_at_the_kill']} |"
            f" {run['seconds_lost_to_the_kill']:.1f} s, {share:.0%} of the run | {peaks} |"
        )
    print(f"outside rendering: {results['outside_rendering']:.1%} of the time")


if __name__ == "__main__":
    sys.exit(main())
