"""What each accuracy costs and how far it is off, on the scenes of the literature, in one run.

    python scripts/accuracy_table.py [--size 256] [--pictures folder]

Prints a Markdown table. Errors are RMSE and PSNR of linear RGB against the exact frame. Beside them stands the distance
of every frame to the mean of N sharp images, which has no intervals in common with any of them: a judge of all, down to
its own error, which falls as 1 / N. Times are medians of interleaved repetitions, relative to linear in the same one.
They are CPU times of a single thread, which other work on the machine disturbs least.
"""

from __future__ import annotations

import argparse
import math
import platform
import statistics
import time
from pathlib import Path

import numpy as np
import paper_scenes
import torch

import torchblur as tb
from datagen.colour import bytes_from_linear
from datagen.pictures import encode_png, write_labels

TABLE = ("plank", "chip", "character", "transparent")
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4)
SHOWN = ("linear", "adaptive 0.001", "exact")  # in the pictures
GAIN = 8  # of the differences in the pictures
ACCURACIES = {
    "linear": tb.Accuracy.linear(),
    **{f"adaptive {tolerance:g}": tb.Accuracy.adaptive(tolerance) for tolerance in TOLERANCES},
    "exact": tb.Accuracy.exact(),
}


def timed_frames(scene: tb.Scene, repeats: int) -> tuple[dict[str, tb.Frame], dict[str, list[float]]]:
    """Return the scene's frame at each accuracy, and the seconds of each repetition; the accuracies take turns."""
    frames, seconds = {}, {key: [] for key in ACCURACIES}
    for _ in range(repeats):
        for key, accuracy in ACCURACIES.items():
            start = time.process_time()
            frames[key] = tb.render(scene, accuracy=accuracy)
            seconds[key].append(time.process_time() - start)
    return frames, seconds


def rows(name: str, scene: tb.Scene, repeats: int, instants: int) -> tuple[list[str], dict[str, tb.Frame]]:
    """Return the table's rows for one scene, and its frames."""
    frames, seconds = timed_frames(scene, repeats)
    start = time.process_time()
    mean = tb.accumulate(scene, instants).rgba
    mean_s = time.process_time() - start
    linear_s = statistics.median(seconds["linear"])
    exact = frames["exact"].rgba
    lines = []
    for key, frame in frames.items():
        ratio = statistics.median(s / base for s, base in zip(seconds[key], seconds["linear"], strict=True))
        cost = f"{linear_s:.2f} s" if key == "linear" else f"{ratio:.1f}x"
        counts = f"{frame.counts['intervals']:,} | {frame.counts['nodes']:,}"
        lines.append(f"| {name} | {key} | {error(frame.rgba, exact)} | {error(frame.rgba, mean)} | {counts} | {cost} |")
    lines.append(f"| {name} | mean of {instants} | {error(mean, exact)} | | | | {mean_s / linear_s:.1f}x |")
    return lines, frames


def error(image: torch.Tensor, reference: torch.Tensor) -> str:
    """Return the RMSE of linear RGB and, as PSNR, in dB."""
    db = float(tb.psnr(image[..., :3], reference[..., :3]))
    return "0" if math.isinf(db) else f"{10 ** (-db / 20):.1e}, {db:.1f} dB"


def picture(frames: dict[str, tb.Frame]) -> np.ndarray:
    """Return (H, W, 3) uint8: frames side by side, and what the first ones are off by, enlarged."""
    rgb = {key: frames[key].rgba[..., :3] for key in SHOWN}
    panels = {key: bytes_from_linear(image).numpy() for key, image in rgb.items()}
    for key in SHOWN[:2]:
        off = GAIN * (rgb[key] - rgb["exact"]).abs()
        panels[f"{GAIN} |{key} - exact|"] = (255 * off.clamp(0, 1)).round().to(torch.uint8).numpy()
    width = rgb["exact"].shape[1]
    title = np.full((16, width * len(panels), 3), 255, dtype=np.uint8)
    title = write_labels(title, [(k * width + 3, 2, key) for k, key in enumerate(panels)])
    return np.concatenate([title, np.concatenate([*panels.values()], axis=1)])


def main() -> None:
    """Print the table and write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=256, help="height of the images [px]")
    parser.add_argument("--repeats", type=int, default=3, help="interleaved repetitions that are timed")
    parser.add_argument("--instants", type=int, default=128, help="sharp images in the mean")
    parser.add_argument("--pictures", type=Path, help="folder for PNG files, one a scene")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    where = f"{platform.machine()}, CPU time of a single thread, torch {torch.__version__}"
    print(f"{arguments.size} px high, float64, median of {arguments.repeats} runs, {where}\n")
    print(f"| scene | accuracy | error | to the mean of {arguments.instants} | intervals | nodes | time |")
    print("|---|---|--:|--:|--:|--:|--:|")
    for accuracy in ACCURACIES.values():
        tb.render(paper_scenes.plank(16), accuracy=accuracy)  # the first run of anything is slow
    for name, make in paper_scenes.SCENES.items():
        scene = make(arguments.size)
        if name in TABLE:
            lines, frames = rows(name, scene, arguments.repeats, arguments.instants)
            print(*lines, sep="\n", flush=True)
        elif arguments.pictures:
            frames = {key: tb.render(scene, accuracy=ACCURACIES[key]) for key in SHOWN}
        if arguments.pictures:
            arguments.pictures.mkdir(parents=True, exist_ok=True)
            path = arguments.pictures / f"{name.replace(' ', '_')}.png"
            path.write_bytes(encode_png(picture(frames)))


if __name__ == "__main__":
    main()
