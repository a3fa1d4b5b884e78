"""What exact shadows and the shadow maps of two papers cost, and how far off they are, side by side in one run.

    python scripts/shadow_comparison.py [--size 128] [--quick] [--out folder]

Scene: under a lamp, a floor rises and slides, a plate spins while it climbs, and a ball flies past. Prints a Markdown
table; with --out also writes shadow_comparison.json and .png. The reference is the mean of many sub-frames with exact
shadow rays, which has neither a shadow map nor time ranges; what its own sub-frames leave it off by is given as its
distance to the mean of half as many. Errors are RMSE and PSNR of linear RGB and of the light's visibility.
Both papers' maps have the same resolution and bias, as much as the slope of surfaces within a texel asks for.
Times are medians of interleaved repetitions, CPU time of a single thread. Memory is that of the map by the papers'
count, and that of the time ranges for torchblur.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import torchblur as tb
from datagen import shapes
from datagen.baselines.shadow_rays import trace_shadows
from datagen.baselines.shadow_samples import ShadowedImage
from datagen.baselines.shadows_hong2018 import render_hong2018
from datagen.baselines.shadows_tsm import render_tsm
from datagen.colour import bytes_from_linear
from datagen.pictures import encode_png, write_labels

COUNTS = (8, 20, 64)  # samples a pixel, layers
MAP_SIZE_PX = 512
BIAS = 0.03  # scene units; the scene is about 6 across
N_SPINS = 12  # linear pieces of a quarter turn
OURS = "torchblur"
GAIN = 4  # of the differences in the pictures
SEED = 1


def scene(size: int) -> tb.Scene:
    """Return a spinning and climbing plate and a fast ball over a floor that rises and slides."""
    f64 = torch.float64
    floor = torch.tensor([[-4.0, 0, 3.5], [4, 0, 3.5], [4.1, 0, -4], [-4, 0, -4.2]], dtype=f64)
    plate = torch.tensor([[-1.1, 0, 0.6], [1.1, 0, 0.6], [1.1, 0.1, -0.6], [-1.1, 0.1, -0.6]], dtype=f64)
    two = torch.tensor([[0, 1, 2], [0, 2, 3]])
    angles = torch.linspace(0.2, 0.2 + math.pi / 2, N_SPINS + 1, dtype=f64)
    spin = torch.stack([_about_y(float(a)) for a in angles])
    rise = torch.linspace(0.5, 1.5, N_SPINS + 1, dtype=f64)
    climb = torch.stack([torch.zeros_like(rise), rise, torch.zeros_like(rise)], 1).unsqueeze(1)
    round_one = shapes.ball(8)
    flight = torch.tensor([[[-2.3, 0.9, 1.2]], [[2.3, 0.9, 1.6]]], dtype=f64)
    solid = round_one.vertices.to(f64) * 0.4
    matte = {"shading": "lambert"}
    meshes = [
        tb.Mesh(
            torch.stack([floor, floor + floor.new_tensor([0.3, 0.4, 0])]), two, tb.Material((0.8, 0.8, 0.75), **matte)
        ),
        tb.Mesh(plate @ spin.transpose(1, 2) + climb, two, tb.Material((0.8, 0.35, 0.2), **matte)),
        tb.Mesh(solid + flight, round_one.faces, tb.Material((0.25, 0.45, 0.8), **matte)),
    ]
    camera = tb.Camera.look_at((0, 4.2, 6.2), (0, 0.5, 0), fov_y_deg=42, width=size, height=size, near=0.5, far=30)
    lamp = tb.SpotLight((1.0, 5.5, 1.5), (0, 0, 0), 75.0, inner_angle_deg=40.0, outer_angle_deg=48.0)
    return tb.Scene(meshes, camera, (0.05, 0.06, 0.08), lights=[lamp], ambient=(0.06, 0.06, 0.07))


def methods(what: tb.Scene) -> dict[str, Callable[[], ShadowedImage]]:
    """Return the ways to render a scene that are compared."""

    def sampled(render: Callable[..., ShadowedImage], name: str, n: int) -> Callable[[], ShadowedImage]:
        options = {name: n, "size_px": MAP_SIZE_PX, "bias": BIAS}
        return lambda: render(what, generator=torch.Generator().manual_seed(SEED), **options)

    ways = {OURS: lambda: exact(what)}
    ways |= {f"hong2018, {n} samples": sampled(render_hong2018, "n_samples", n) for n in COUNTS}
    ways |= {f"tsm, {n} layers": sampled(render_tsm, "n_layers", n) for n in COUNTS}
    return ways


def exact(what: tb.Scene) -> ShadowedImage:
    """Return torchblur's own image and shadow."""
    frame = tb.render(what)
    return ShadowedImage(frame.rgba, frame.shadow, frame.counts["shadow_bytes"], frame.counts)


def timed(
    ways: dict[str, Callable[[], ShadowedImage]], repeats: int
) -> tuple[dict[str, ShadowedImage], dict[str, float]]:
    """Return the image of each way and the median of its seconds; they take turns."""
    images, seconds = {}, {name: [] for name in ways}
    for _ in range(repeats):
        for name, render in ways.items():
            start = time.process_time()
            images[name] = render()
            seconds[name].append(time.process_time() - start)
    return images, {name: statistics.median(s) for name, s in seconds.items()}


def errors(image: ShadowedImage, reference: ShadowedImage) -> dict[str, float]:
    """Return the RMSE of linear RGB and of the visibility."""
    off = image.rgba[..., :3] - reference.rgba[..., :3], image.visibility - reference.visibility
    return dict(zip(("rgb_rmse", "visibility_rmse"), (float(d.square().mean().sqrt()) for d in off), strict=True))


def row(name: str, numbers: dict[str, float]) -> str:
    """Return a line of the table."""
    kinds = ("rgb_rmse", "visibility_rmse")
    each = (f"{numbers[k]:.1e}, {-20 * math.log10(max(numbers[k], 1e-20)):.0f} dB" for k in kinds)
    cost = " | | "
    if "bytes" in numbers:
        cost = f"{numbers['seconds']:.2f} s | {numbers['seconds_ratio']:.2f}x | {numbers['bytes'] / 2**20:.2f} MiB"
    return f"| {name} | {' | '.join(each)} | {cost} |"


def picture(images: dict[str, ShadowedImage], reference: ShadowedImage) -> np.ndarray:
    """Return (H, W, 3) uint8: columns of methods; image, visibility, and what the visibility is off by, enlarged."""
    columns, names = [], ["reference", *images]
    for image in (reference, *images.values()):
        off = (GAIN * (image.visibility - reference.visibility).abs()).clamp(0, 1)
        greys = [(255 * v).round().to(torch.uint8).unsqueeze(2).expand(-1, -1, 3) for v in (image.visibility, off)]
        columns.append(np.concatenate([bytes_from_linear(image.rgba[..., :3]).numpy(), *(g.numpy() for g in greys)]))
    sheet = np.concatenate(columns, axis=1)
    width = reference.rgba.shape[1]
    title = np.full((16, sheet.shape[1], 3), 255, dtype=np.uint8)
    return np.concatenate([write_labels(title, [(k * width + 3, 2, name) for k, name in enumerate(names)]), sheet])


def _about_y(angle: float) -> Tensor:
    """Return the rotation (3, 3) about the y axis."""
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)


def main() -> None:
    """Print the table; write the numbers and the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=128, help="width and height [px]")
    parser.add_argument("--quick", action="store_true", help="few sub-frames, each method once")
    parser.add_argument("--out", type=Path, help="folder for the JSON and PNG files")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    n_subframes, repeats = (128, 1) if arguments.quick else (512, 3)
    what = scene(arguments.size)
    reference, half = (trace_shadows(what, n_subframes=n) for n in (n_subframes, n_subframes // 2))
    images, seconds = timed(methods(what), repeats)
    found = {}
    for name, image in images.items():
        cost = {"seconds": seconds[name], "seconds_ratio": seconds[name] / seconds[OURS], "bytes": image.n_bytes}
        found[name] = errors(image, reference) | cost
    found["half the sub-frames"] = errors(half, reference)
    setting = {
        "size_px": arguments.size,
        "map_size_px": MAP_SIZE_PX,
        "bias": BIAS,
        "subframes": n_subframes,
        "repeats": repeats,
        "machine": f"{platform.machine()}, one thread, torch {torch.__version__}",
    }
    print(", ".join(f"{key} {value}" for key, value in setting.items()) + "\n")
    print("| method | error of RGB | of visibility | time | relative | memory |\n|---|--:|--:|--:|--:|--:|")
    print(*(row(name, numbers) for name, numbers in found.items()), sep="\n")
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"setting": setting, "methods": found}, indent=1) + "\n"
        (arguments.out / "shadow_comparison.json").write_text(text, encoding="utf-8")
        (arguments.out / "shadow_comparison.png").write_bytes(encode_png(picture(images, reference)))


if __name__ == "__main__":
    main()
