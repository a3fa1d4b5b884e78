"""What accuracy costs in time: this package, brute force and filters of the sharp image, on the same scenes in one run.

    python scripts/accuracy_vs_time.py --out folder [--quick] [--size 128]

Writes results.json, a plot of error against time for each scene and one of all, a sheet of images, and index.html,
which holds all of them and opens offline. A scene is measured as a whole, its methods taking turns, and stored when it
is done: an interrupted run goes on with the next scene. Times are medians of CPU times of a single thread from the
scene to the image, the sharp image that a filter needs included; scenes are float32, so that whatever has a compiled
path takes it. Errors are against the exact frame; the frame's own is judged by the mean of many sharp images, which
shares no interval with it and is itself wrong by about 1 / N an event.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import accuracy_page
import filter_scenes
import motion_scenes
import paper_scenes
import torch
from torch import Tensor

import torchblur as tb
from datagen.baselines.filters import FILTERS
from datagen.baselines.guertin2015 import guertin2015
from datagen.baselines.views import find_paths, find_view
from datagen.colour import srgb_from_linear
from datagen.pictures import decode_png
from datagen.writer import write_atomically

RESULTS_NAME = "results.json"
RECORD = {"check", "check_times", "methods", "looks_per_pixel", "intervals_per_pixel", "cpu_s"}
SMALLEST_PX = 16  # SSIM needs 11
SCENES: dict[str, Callable[[int], tb.Scene]] = {
    **paper_scenes.SCENES,
    **filter_scenes.SCENES,
    **motion_scenes.SCENES,
    "rotor": lambda size: filter_scenes.rotor(size, 77),  # not whole pairs of sectors: few even times would be exact
}
QUICK_SCENES = ("plank", "rotor", "pills")
COUNTS = (1, 4, 8, 16, 32, 64, 128, 256, 1000)
QUICK_COUNTS = (1, 8, 32)
MOST_RANDOM = 128  # samples of the random references, whose errors fall along a line by then
CHECK_TIMES, QUICK_CHECK_TIMES = 1000, 256
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4)
TAPS = {"directional": (8, 32, 128), "mcguire2012": (5, 15, 45), "guertin2014": (9, 35, 99)}  # samples
SHOWN = ("exact", "mean of 32", "stochastic 32", "directional 32", "mcguire2012 15", "guertin2014 35", "guertin2015")

Method = Callable[[tb.Scene], Tensor | tb.Frame]  # (H, W, 3) linear RGB, or a frame


def single(scene: tb.Scene) -> tb.Scene:
    """Return a scene whose results are float32."""
    meshes = [dataclasses.replace(mesh, vertices=mesh.vertices.to(torch.float32)) for mesh in scene.meshes]
    return dataclasses.replace(scene, meshes=meshes)


def methods(counts: tuple[int, ...]) -> dict[str, tuple[str, Method]]:
    """Return {name: (family, what makes an image of a scene)}."""
    found: dict[str, tuple[str, Method]] = {"exact": ("exact", _rendered(tb.Accuracy.exact()))}
    found["linear"] = ("linear", _rendered(tb.Accuracy.linear()))
    for tolerance in TOLERANCES:
        found[f"adaptive {tolerance:g}"] = ("adaptive", _rendered(tb.Accuracy.adaptive(tolerance)))
    for n in counts:
        found[f"mean of {n}"] = ("mean of N", lambda scene, n=n: tb.accumulate(scene, n).rgba[..., :3])
        if n > MOST_RANDOM:
            continue
        found[f"Halton {n}"] = (
            "Halton N",
            lambda scene, n=n: tb.accumulate(scene, n, sequence="halton").rgba[..., :3],
        )
        found[f"stochastic {n}"] = (
            "stochastic N",
            lambda scene, n=n: tb.stochastic(scene, n, places="centre").rgba[..., :3],
        )
    for name, every in TAPS.items():
        for n in every:
            found[f"{name} {n}"] = (name, _filtered(name, n))
    found["guertin2015"] = ("guertin2015", _scattered("bezier", "published"))
    found["guertin2015, arcs by time"] = ("guertin2015, arcs by time", _scattered("arc", "time"))
    return found


def _rendered(accuracy: tb.Accuracy) -> Method:
    """Return what renders at an accuracy."""
    return lambda scene: tb.render(scene, accuracy=accuracy)


def _filtered(name: str, samples: int) -> Method:
    """Return what filters the sharp image with so many taps."""

    def make(scene: tb.Scene) -> Tensor:
        view, _ = find_view(scene, tb.render_instant(scene))
        function, settings = FILTERS[name]
        return function(view, None, **(settings | {"samples": samples}))[0].permute(1, 2, 0)

    return make


def _scattered(curve: str, weighting: str) -> Method:
    """Return what scatters the sharp image along curves."""

    def make(scene: tb.Scene) -> Tensor:
        now = tb.render_instant(scene)
        view, _ = find_view(scene, now)
        return guertin2015(view.color, find_paths(scene, now), curve=curve, weighting=weighting)[0].permute(1, 2, 0)

    return make


def errors(image: Tensor, reference: Tensor) -> dict[str, float]:
    """Return RMSE of linear RGB, PSNR [dB], SSIM and FLIP against a reference; PSNR is absent where they are equal."""
    mse = float((image - reference).square().mean())
    shown, wanted = (srgb_from_linear(i.to(torch.float64)) for i in (image, reference))
    found = {"rmse": mse**0.5, "ssim": float(tb.ssim(shown, wanted)), "flip": float(tb.flip_ldr(shown, wanted).mean())}
    return found | ({"psnr_db": float(tb.psnr(image, reference))} if mse else {})


def warm_up(scene: tb.Scene, small: tb.Scene) -> None:
    """Run all that has to be compiled once: what depends on how much there is on the scene itself, else on a small
    one.
    """
    tb.render(scene)
    tb.accumulate(small, 1)
    tb.stochastic(small, 1)
    tb.render_instant(small)


def measure(scene: tb.Scene, settings: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return a scene's record for results.json, and its images by method."""
    begun = time.process_time()
    every = methods(tuple(settings["counts"]))
    images: dict[str, Tensor] = {}
    seconds: dict[str, list[float]] = {name: [] for name in every}
    counts: dict[str, int] = {}
    for _ in range(settings["repeats"]):
        for name, (_, make) in every.items():
            start = time.process_time()
            made = make(scene)
            seconds[name].append(time.process_time() - start)
            images[name] = made.rgba[..., :3] if isinstance(made, tb.Frame) else made
            counts = made.counts if name == "exact" else counts
    exact, times = images["exact"], settings["check_times"]
    known = f"mean of {times}"
    check = images[known] if known in images else tb.accumulate(scene, times).rgba[..., :3]
    rows = {
        name: {"family": family, "time_s": statistics.median(seconds[name]), **errors(images[name], exact)}
        for name, (family, _) in every.items()
    }
    record = {"check": errors(exact, check), "check_times": times, "methods": rows}
    n_pixels = scene.camera.width * scene.camera.height
    record |= {"looks_per_pixel": counts["nodes"] / n_pixels, "intervals_per_pixel": counts["intervals"] / n_pixels}
    return record | {"cpu_s": time.process_time() - begun}, images


def read_results(path: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Return what an earlier run with the same settings has stored, or a fresh record."""
    if not path.exists():
        return {"settings": settings, "scenes": {}}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        every = [row["time_s"] for record in found["scenes"].values() for row in record["methods"].values()]
        is_whole = all(isinstance(time_s, float) for time_s in every) and isinstance(found["settings"], dict)
        is_whole = is_whole and all(record.keys() >= RECORD for record in found["scenes"].values())
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        is_whole = False
    if not is_whole:
        raise SystemExit(f"out: expected the results of an earlier run, got {path} damaged; without it all starts anew")
    if found["settings"] != settings:
        raise SystemExit(f"out: expected a folder for {settings}, got {path} of {found['settings']}")
    return found


def is_picture(path: Path) -> bool:
    """Return whether a file is there and a whole PNG."""
    try:
        decode_png(path.read_bytes())
    except (OSError, SyntaxError):  # cut short, or no picture
        return False
    return True


def main(argv: list[str] | None = None) -> None:
    """Measure what is not there yet and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder, created if need be")
    parser.add_argument("--size", type=int, help="height of the images [px]; 128, or 96 with --quick")
    parser.add_argument("--repeats", type=int, default=1, help="turns that are timed")
    parser.add_argument("--quick", action="store_true", help="fewer scenes and counts, smaller images")
    arguments = parser.parse_args(argv)
    if arguments.size is not None and arguments.size < SMALLEST_PX:
        parser.error(f"--size: expected at least {SMALLEST_PX}, got {arguments.size}")
    if arguments.repeats < 1:
        parser.error(f"--repeats: expected at least 1, got {arguments.repeats}")
    if arguments.out.exists() and not arguments.out.is_dir():
        parser.error(f"--out: expected a folder, got the file {str(arguments.out)!r}")
    size = arguments.size or (96 if arguments.quick else 128)
    counts, names = (QUICK_COUNTS, QUICK_SCENES) if arguments.quick else (COUNTS, tuple(SCENES))
    settings = {"size_px": size, "counts": list(counts), "repeats": arguments.repeats, "torch": torch.__version__}
    settings["check_times"] = QUICK_CHECK_TIMES if arguments.quick else CHECK_TIMES
    arguments.out.mkdir(parents=True, exist_ok=True)
    place = arguments.out / RESULTS_NAME
    results = read_results(place, settings)
    torch.set_num_threads(1)
    for k, name in enumerate(names):
        sheet = arguments.out / f"{accuracy_page.file_name(name)}.png"
        if name in results["scenes"] and is_picture(sheet):
            print(f"{k + 1}/{len(names)} {name}: kept", file=sys.stderr)
            continue
        print(f"{k + 1}/{len(names)} {name} ...", file=sys.stderr)
        scene = single(SCENES[name](size))
        warm_up(scene, single(SCENES[name](16)))
        record, images = measure(scene, settings)
        shown = {method: images[method] for method in SHOWN if method in images}
        write_atomically(sheet, accuracy_page.encode_sheet(shown))
        results["scenes"][name] = record
        write_atomically(place, json.dumps(results, indent=1).encode())
    page = accuracy_page.write_page(arguments.out, results)
    print(f"{sum(r['cpu_s'] for r in results['scenes'].values()):.0f} s of CPU time in all", file=sys.stderr)
    print(page)


if __name__ == "__main__":
    main()
