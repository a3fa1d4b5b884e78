"""Time and memory of the torch path, and what averaging sharp images costs for the same accuracy, in one run.

    python scripts/benchmark.py [--size 512] [--threads 2]

Prints Markdown tables. Ratios of one run on one machine are worth quoting; seconds are for orientation.
"""

from __future__ import annotations

import argparse
import math
import platform
import resource
import subprocess
import sys
import time

import torch
import trimesh

import torchblur as tb

AVERAGES = (8, 32, 128)
BUDGETS_MB = (64, 256, 1024)


def sphere(size: int, opacity: float) -> tb.Scene:
    """Return a ball of 5,000 triangles that fills the view and moves by about 20 px at 512 px."""
    ball = trimesh.creation.uv_sphere(radius=1.9, count=[36, 36])
    start = torch.tensor(ball.vertices, dtype=torch.float32)
    color = torch.rand(len(ball.faces), 3, generator=torch.Generator().manual_seed(0))
    mesh = tb.Mesh(
        torch.stack([start, start + torch.tensor([0.15, 0.05, 0.0])]), ball.faces, tb.Material(color, opacity)
    )
    camera = tb.Camera.look_at((0, 0, 5), (0, 0, 0), fov_y_deg=45, width=size, height=size, near=0.5, far=20)
    return tb.Scene([mesh], camera, background=(0.2, 0.3, 0.4))


def rotor(size: int) -> tb.Scene:
    """Return four blades that turn by 60 degrees in 16 linear pieces, over a still floor."""
    blade = trimesh.creation.box(extents=(3.6, 0.35, 0.05))
    cross = trimesh.creation.box(extents=(0.35, 3.6, 0.05))
    poses = [trimesh.transformations.rotation_matrix(math.radians(60) * k / 16, (0.1, 0.3, 1.0)) for k in range(17)]
    meshes = []
    for solid, color in ((blade, (0.9, 0.5, 0.1)), (cross, (0.2, 0.6, 0.9))):
        knots = [torch.tensor(trimesh.transform_points(solid.vertices, p), dtype=torch.float32) for p in poses]
        meshes.append(tb.Mesh(torch.stack(knots), solid.faces, tb.Material(color)))
    floor = trimesh.creation.box(extents=(8, 8, 0.1)).subdivide().subdivide()
    below = torch.tensor(floor.vertices, dtype=torch.float32) - torch.tensor([0.0, 0.0, 1.0])
    shade = torch.rand(len(floor.faces), 3, generator=torch.Generator().manual_seed(1))
    meshes.append(tb.Mesh(below, floor.faces, tb.Material(shade)))
    camera = tb.Camera.look_at((0, 0, 5), (0, 0, 0), fov_y_deg=45, width=size, height=size, near=0.5, far=20)
    return tb.Scene(meshes, camera)


def shards(size: int) -> tb.Scene:
    """Return 200 half-transparent triangles in random motion."""
    generator = torch.Generator().manual_seed(2)
    place = torch.rand(200, 1, 3, generator=generator) * 3 - 1.5
    shape = torch.rand(200, 3, 3, generator=generator) - 0.5
    motion = torch.rand(200, 1, 3, generator=generator) * 0.6 - 0.3
    start = (place + shape).reshape(-1, 3)
    end = (place + shape * 1.1 + motion).reshape(-1, 3)
    material = tb.Material(torch.rand(200, 3, generator=generator), 0.5)
    camera = tb.Camera.look_at((0, 0, 5), (0, 0, 0), fov_y_deg=45, width=size, height=size, near=0.5, far=20)
    return tb.Scene([tb.Mesh(torch.stack([start, end]), torch.arange(600).reshape(200, 3), material)], camera)


def seconds(function) -> tuple[float, object]:
    """Return the wall time of `function` and its result."""
    start = time.perf_counter()
    result = function()
    return time.perf_counter() - start, result


def compare(name: str, scene: tb.Scene) -> str:
    """Return a table row: the exact frame, and averages of N sharp images beside it."""
    exact_s, frame = seconds(lambda: tb.render(scene))
    cells = []
    for n in AVERAGES:
        average_s, average = seconds(lambda n=n: tb.accumulate(scene, n, backend="torch"))
        rmse = float((average.rgba - frame.rgba).double().square().mean().sqrt())
        cells.append(f"{average_s / exact_s:.1f}x, {-20 * math.log10(max(rmse, 1e-12)):.0f} dB")
    counts = f"{frame.counts['prisms']:,} prisms, {frame.counts['intervals']:,} intervals"
    return f"| {name} ({counts}) | {exact_s:.2f} s | " + " | ".join(cells) + " |"


def memory_row(size: int, budget_mb: int) -> str:
    """Return a table row with the peak memory and time of the ball in a fresh process."""
    options = {"--size": size, "--threads": torch.get_num_threads(), "--budget-mb": budget_mb}
    command = [sys.executable, __file__, *(str(x) for pair in options.items() for x in pair)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=512, help="width and height [px]")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="torch threads")
    parser.add_argument("--budget-mb", type=int, help="only measure the memory of the ball under this budget")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    if arguments.budget_mb:
        wall, frame = seconds(lambda: tb.render(sphere(arguments.size, 1.0), memory_bytes=arguments.budget_mb << 20))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"| {arguments.budget_mb} MB | {peak:.0f} MB | {wall:.1f} s | {frame.counts['blocks']} |")
        return
    where = f"{platform.machine()}, {arguments.threads} threads, torch {torch.__version__}"
    print(f"{arguments.size} x {arguments.size} px, float32, {where}\n")
    print("| scene | exact | " + " | ".join(f"mean of {n}" for n in AVERAGES) + " |")
    print("|---|--:|" + "--:|" * len(AVERAGES))
    for name, scene in (
        ("opaque ball", sphere(arguments.size, 1.0)),
        ("half-transparent ball", sphere(arguments.size, 0.5)),
        ("rotor, 16 pieces", rotor(arguments.size)),
        ("half-transparent shards", shards(arguments.size // 2)),
    ):
        print(compare(name, scene), flush=True)
    print("\n| memory budget | peak of the whole process | time | blocks |\n|--:|--:|--:|--:|")
    for budget in BUDGETS_MB:
        print(memory_row(arguments.size, budget), flush=True)


if __name__ == "__main__":
    main()
