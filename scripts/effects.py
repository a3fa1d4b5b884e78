"""What leaving out effects saves, and what each effect costs, side by side in one run.

    python scripts/effects.py [--size 192] [--repeats 5]

First table: typical scenes, with the effects that they call for against all of them. Second table: the cheapest scene,
and the same with one effect more. Times are CPU times of a single thread, the least of interleaved repetitions.
"""

from __future__ import annotations

import argparse
import functools
import platform
import time
from collections.abc import Callable

import torch
import trimesh

import torchblur as tb


def ball(shift: tuple[float, ...] | None, radius: float = 1.2, **material) -> tb.Mesh:
    """Return a ball of 1,500 triangles that may move."""
    solid = trimesh.creation.uv_sphere(radius=radius, count=[28, 28])
    start = torch.tensor(solid.vertices, dtype=torch.float32)
    knots = start if shift is None else torch.stack([start, start + torch.tensor(shift)])
    uv = None
    if "texture" in material:
        places = torch.tensor(solid.vertices[solid.faces], dtype=torch.float32)
        uv = 0.5 + 0.4 * places[..., :2]
    return tb.Mesh(knots, solid.faces, tb.Material(**material), uv=uv)


def wall(z: float = -2.0, shift: float | None = None, cells: int = 16, **material) -> tb.Mesh:
    """Return a wall that fills the view, of 2 cells^2 triangles."""
    place = torch.linspace(-6, 6, cells + 1)
    y, x = torch.meshgrid(place, place, indexing="ij")
    start = torch.stack([x.flatten(), y.flatten(), torch.full_like(x.flatten(), z)], 1)
    k = torch.arange(cells * (cells + 1)).reshape(cells, -1)[:, :-1].flatten()
    faces = torch.cat([torch.stack([k, k + 1, k + cells + 2], 1), torch.stack([k, k + cells + 2, k + cells + 1], 1)])
    knots = start if shift is None else torch.stack([start, start + torch.tensor([shift, 0.0, 0.0])])
    return tb.Mesh(knots, faces, tb.Material(**material), uv=start[faces][..., :2] / 12 + 0.5)


def scenes(size: int) -> dict[str, tb.Scene]:
    """Return eight typical scenes."""
    image = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0))
    clear = torch.cat([image, image[..., :1]], 2)
    lamp = [tb.PointLight((2.0, 3.0, 4.0), 60.0)]
    aside = (0.3, 0.1, 0.0)
    meshes = {
        "static textured background, small ball": ([wall(texture=image), ball(aside, 0.4)], []),
        "static lit background, small ball": ([wall(shading="lambert"), ball(aside, 0.4)], lamp),
        "all at rest": ([wall(texture=image), ball(None, shading="lambert")], lamp),
        "opaque: ball before a moving wall": ([wall(shift=0.2), ball(aside)], []),
        "opaque: one-sided ball": ([ball(aside, double_sided=False)], []),
        "flat: half-transparent balls": ([ball(aside, opacity=0.5), ball((0.0, 0.3, 0.1), 0.8, opacity=0.5)], []),
        "textured and lit, all moving": ([wall(texture=image, shift=0.2), ball(aside, shading="lambert")], lamp),
        "textured opacity, all moving": ([wall(texture=image, shift=0.2), ball(aside, texture=clear)], []),
    }
    return {name: scene(size, *parts) for name, parts in meshes.items()}


def ablation(size: int) -> dict[str, tb.Scene]:
    """Return the cheapest scene, and it with one effect more each."""
    image = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0))
    lamp = [tb.PointLight((2.0, 3.0, 4.0), 60.0)]
    moving = {"shift": (0.3, 0.1, 0.0), "double_sided": False}
    return {
        "opaque, at rest": scene(size, [ball(None, double_sided=False)]),
        "+ motion": scene(size, [ball(**moving)]),
        "+ motion, transparency": scene(size, [ball(**moving, opacity=0.5)]),
        "+ motion, texture": scene(size, [ball(**moving, texture=image)]),
        "+ motion, lighting": scene(size, [ball(**moving, shading="lambert")], lamp),
        "+ motion, two sides": scene(size, [ball(**moving | {"double_sided": True})]),
    }


def scene(size: int, meshes: list[tb.Mesh], lights: list | None = None) -> tb.Scene:
    """Return a scene of meshes."""
    camera = tb.Camera.look_at((0, 0, 5), (0, 0, 0), fov_y_deg=40, width=size, height=size, near=0.5, far=20)
    return tb.Scene(meshes, camera, (0.2, 0.3, 0.4), lights=lights or [], ambient=(0.1, 0.1, 0.1))


def timed(renders: dict[str, Callable[[], tb.Frame]], repeats: int) -> dict[str, tuple[float, float, tb.Frame]]:
    """Return the least CPU time of each, the share of a frame that planning took, and a frame; they take turns."""
    found: dict[str, list[tuple[float, float, float, tb.Frame]]] = {}
    for _ in range(repeats):
        for name, render in renders.items():
            start = time.process_time()
            frame = render()
            seconds = time.process_time() - start
            own = seconds, frame.timings["plan"], sum(frame.timings.values()), frame
            found.setdefault(name, []).append(own)
    least = {name: [min(each) for each in list(zip(*runs, strict=True))[:3]] for name, runs in found.items()}
    return {name: (seconds, plan / whole, found[name][0][3]) for name, (seconds, plan, whole) in least.items()}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=192, help="width and height [px]")
    parser.add_argument("--backend", choices=("auto", "torch"), default="auto", help="compiled, or plain torch")
    parser.add_argument("--repeats", type=int, default=5, help="interleaved repetitions that are timed")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    way = "plain torch" if arguments.backend == "torch" else "compiled where it can be"
    print(f"{arguments.size} px, float32, {platform.machine()}, one thread, torch {torch.__version__}, {way}\n")
    print("| scene | needs | auto | all | planning |\n|---|---|--:|--:|--:|")
    for name, each in scenes(arguments.size).items():
        make = functools.partial(tb.render, each, backend=arguments.backend)
        options = {effects: functools.partial(make, effects=effects) for effects in ("auto", "all")}
        found = timed(options, arguments.repeats)
        seconds, share, frame = found["auto"]
        needs = ", ".join(e.name for e in frame.plan.effects if e.needed)
        print(f"| {name} | {needs} | {seconds:.2f} s | {found['all'][0] / seconds:.1f}x | {share:.1%} |", flush=True)
    each = ablation(arguments.size).items()
    found = timed({n: functools.partial(tb.render, s, backend=arguments.backend) for n, s in each}, arguments.repeats)
    base = next(iter(found.values()))[0]
    print("\n| scene | time | intervals | nodes |\n|---|--:|--:|--:|")
    for name, (seconds, _, frame) in found.items():
        print(f"| {name} | {seconds / base:.1f}x | {frame.counts['intervals']:,} | {frame.counts['nodes']:,} |")


if __name__ == "__main__":
    main()
