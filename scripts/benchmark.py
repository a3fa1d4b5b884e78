"""Time and memory of exact frames at the papers' sizes, beside plain torch and means of sharp images, in one run.

    python scripts/benchmark.py [--threads 2] [--scenes character cloth] [--curves] [--out results.json]

Each scene is rendered in a process of its own, after a first call that compiles. Prints Markdown tables; ratios of one
run on one machine are worth quoting, seconds are for orientation. Means that the ray tracer Embree makes of opaque
scenes are compared by CPU time, as its binding casts on one thread; without embreex of the extra `dev` they are left
out. Large scenes are rendered once, what is compiled included, and beside nothing. `--curves` adds how time grows with
triangles, pixels, length of motion, depth of glass and threads, with the slope in log-log, and `--plot` draws it.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from benchmark_scenes import CASES, CURVES, LARGE

import torchblur as tb

AVERAGES = (8, 32, 128)
TRACED = 8
REPEATS = 5
MOST_PIXELS_IN_TORCH = 1920 * 1080


def best(
    function: Callable[[], Any], repeats: int = REPEATS, clock: Callable[[], float] = time.perf_counter
) -> tuple[float, Any]:
    """Return the least time of some calls by a clock [s], and the last result."""
    times, result = [], None
    for _ in range(repeats):
        start = clock()
        result = function()
        times.append(clock() - start)
    return min(times), result


def measure(name: str) -> dict[str, Any]:
    """Return what a scene takes, in this process."""
    case, is_large = (CASES | LARGE)[name], name in LARGE
    scene = case.make(case.width, case.height)
    before_mb = _peak_mb()
    first_s, frame = best(lambda: tb.render(scene, backend="cpu"), 1)
    exact_s, frame = (first_s, frame) if is_large else best(lambda: tb.render(scene, backend="cpu"))
    peak_mb = _peak_mb()
    found: dict[str, Any] = {
        "scene": name,
        "size_px": [case.width, case.height],
        "triangles": sum(m.n_faces for m in scene.meshes),
        **_counted(frame),
        "exact_s": exact_s,
        "first_s": first_s,
        "stages_s": frame.timings,
        "ns_per_interval": 1e9 * exact_s / max(1, frame.counts["intervals"]),
        "peak_mb": peak_mb,
        "before_mb": before_mb,
        "means": {},
    }
    for n in () if is_large else AVERAGES:
        tb.accumulate(scene, 1, backend="cpu")
        mean_s, mean = best(lambda n=n: tb.accumulate(scene, n, backend="cpu"), 1)
        found["means"][n] = {"ratio": mean_s / exact_s, "psnr_db": _psnr_db(mean.rgba, frame.rgba)}
    if not is_large:
        found["traced"] = traced(scene, frame)
    if case.width * case.height <= MOST_PIXELS_IN_TORCH:
        plain_s, plain = best(lambda: tb.render(scene, backend="torch"), 1)
        found |= {"torch_ratio": plain_s / exact_s, "largest_gap": float((plain.rgba - frame.rgba).abs().max())}
    return found


def traced(scene: tb.Scene, frame: tb.Frame) -> dict[str, float] | None:
    """Return what a mean of ray-traced images takes, by CPU time, and how near it is; None where it cannot be made."""
    try:
        from embree_mean import can_trace, embree_mean
    except ImportError:
        return None
    if not can_trace(scene):
        return None
    mean_s, mean = best(lambda: embree_mean(scene, TRACED), 1, time.process_time)
    exact_s, _ = best(lambda: tb.render(scene, backend="cpu"), 1, time.process_time)
    return {"ratio": mean_s / exact_s, "psnr_db": _psnr_db(mean, frame.rgba)}


def _psnr_db(image: torch.Tensor, exact: torch.Tensor) -> float:
    rmse = float((image - exact).double().square().mean().sqrt())
    return -20 * math.log10(max(rmse, 1e-12))


def measure_curve(name: str, threads: int) -> dict[str, Any]:
    """Return how time grows along one curve."""
    rows = []
    for value in CURVES[name][0]:
        scene = CURVES[name][1](value)
        tb.render(scene, backend="cpu")
        seconds, frame = best(lambda scene=scene: tb.render(scene, backend="cpu"), 3)
        triangles, pixels = sum(m.n_faces for m in scene.meshes), scene.camera.width * scene.camera.height
        rows.append({"value": value, "s": seconds, "triangles": triangles, "pixels": pixels, **_counted(frame)})
    by = {"triangles": "triangles", "pixels": "pixels"}.get(name, "intervals")
    return {"curve": name, "by": by, "threads": threads, "rows": rows, "slope": _slope([(r[by], r["s"]) for r in rows])}


def _counted(frame: tb.Frame) -> dict[str, int]:
    return {k: frame.counts[k] for k in ("prisms", "pairs", "intervals", "deepest_pixel", "cells", "layers")}


def _slope(points: list[tuple[float, float]]) -> float:
    """Return the slope of the line through points in log-log that is nearest in the mean square."""
    x, y = (torch.tensor(v, dtype=torch.float64).log() for v in zip(*points, strict=True))
    x = x - x.mean()
    return float((x * y).sum() / (x * x).sum())


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def in_own_process(kind: str, name: str, threads: int) -> dict[str, Any]:
    """Return what one scene or curve takes, measured in a process of its own."""
    command = [sys.executable, __file__, f"--only-{kind}", name, "--threads", str(threads)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{name}: {done.stderr.strip()[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def row(found: dict[str, Any]) -> str:
    """Return a row of the table of scenes."""
    found_means = [found["means"].get(str(n)) for n in AVERAGES]
    found_means.append(found.get("traced"))
    means = [f"{m['ratio']:.2f}x, {m['psnr_db']:.0f} dB" if m else "not run" for m in found_means]
    width, height = found["size_px"]
    plain = f"{found['torch_ratio']:.0f}x" if "torch_ratio" in found else "not run"
    cells = [
        f"{found['scene']}, {width} x {height}",
        f"{found['triangles']:,}",
        f"{found['intervals']:,}",
        f"{found['deepest_pixel']}",
        f"{1e3 * found['exact_s']:.0f} ms",
        f"{found['ns_per_interval']:.0f} ns",
        plain,
        *means,
        f"{found['peak_mb'] - found['before_mb']:.0f} MB",
    ]
    return "| " + " | ".join(cells) + " |"


def plot(curves: list[dict[str, Any]], path: Path) -> None:
    """Draw the curves."""
    from matplotlib import pyplot

    kinds = list(dict.fromkeys((curve["curve"], curve["by"]) for curve in curves))
    figure, axes = pyplot.subplots(1, len(kinds), figsize=(4 * len(kinds), 3.2), squeeze=False)
    for axis, (name, by) in zip(axes[0], kinds, strict=True):
        for curve in (c for c in curves if (c["curve"], c["by"]) == (name, by)):
            x, y = [r[by] for r in curve["rows"]], [r["s"] for r in curve["rows"]]
            axis.loglog(x, y, marker="o", label=f"threads: {curve['threads']}, slope {curve['slope']:.2f}")
        axis.set(xlabel=by, ylabel="s", title=name)
        axis.tick_params(axis="x", which="minor", labelbottom=False)
        axis.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="torch threads")
    parser.add_argument(
        "--scenes", nargs="*", choices=[*CASES, *LARGE], default=list(CASES), help="by default the smaller ones"
    )
    parser.add_argument("--curves", action="store_true", help="measure how time grows, too")
    parser.add_argument("--out", type=Path, help="JSON file to write all figures to")
    parser.add_argument("--plot", type=Path, help="picture of the curves to write")
    parser.add_argument("--only-scene", choices=[*CASES, *LARGE], help=argparse.SUPPRESS)
    parser.add_argument("--only-curve", choices=list(CURVES), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    if arguments.only_scene:
        print(json.dumps(measure(arguments.only_scene)))
        return
    if arguments.only_curve:
        print(json.dumps(measure_curve(arguments.only_curve, arguments.threads)))
        return
    print(f"float32, {platform.machine()}, {arguments.threads} threads, torch {torch.__version__}\n")
    head = ["scene", "triangles", "intervals", "deepest", "exact", "an interval", "plain torch"]
    head += [*(f"mean of {n}" for n in AVERAGES), f"Embree, {TRACED}", "memory"]
    print("| " + " | ".join(head) + " |\n|---|" + "--:|" * (len(head) - 1), flush=True)
    scenes, curves = [], []
    for name in arguments.scenes:
        scenes.append(in_own_process("scene", name, arguments.threads))
        print(row(scenes[-1]), flush=True)
    if arguments.curves or arguments.plot:
        print("\n| grows | threads | from | to | slope in log-log |\n|---|--:|--:|--:|--:|")
        for name in CURVES:
            for threads in sorted({1, arguments.threads}):
                curve = in_own_process("curve", name, threads)
                curves.append(curve)
                ends = [f"{1e3 * curve['rows'][k]['s']:.1f} ms at {curve['rows'][k][curve['by']]:,}" for k in (0, -1)]
                print(
                    f"| {curve['by']} ({name}) | {threads} | {ends[0]} | {ends[1]} | {curve['slope']:.2f} |", flush=True
                )
    if arguments.out:
        arguments.out.write_text(json.dumps({"scenes": scenes, "curves": curves}, indent=1))
    if arguments.plot:
        plot([c for c in curves if c["threads"] == arguments.threads], arguments.plot)


if __name__ == "__main__":
    main()
