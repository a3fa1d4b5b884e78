"""Where image-space motion blur fails, in numbers and pictures, beside the exact image.

    python scripts/filter_failures.py [--size 256] [--pictures folder]

Prints a Markdown table of one run, everything relative to the exact image:
- rotor: how uneven its circles are, relative to the sharp image. In truth they are even; filters that follow straight
  lines make a pinwheel of them. Beside it the error outside of the rotor, where nothing should change.
- gears: how much is left of the edges across the motion of a small gear where a large one behind it moves another way,
  relative to the sharp image, and without the large one: blur that is lacking.
- pills: how much of their blur the pills and the wall get that are seen through a resting bottle; and the wall beside:
  the part of the exact image's difference to the sharp one that an image has, 1 being all.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import filter_scenes
import numpy as np
import torch
from torch import Tensor

import torchblur as tb
from datagen.baselines import gather
from datagen.baselines.filters import FILTERS, filter_instant
from datagen.baselines.guertin2015 import guertin2015
from datagen.baselines.views import find_paths, find_view
from datagen.colour import bytes_from_linear
from datagen.pictures import encode_png, write_labels

TILE_PX = 20  # of McGuire's filter, by which the gears' motions are compared
CROSSING = 0.5  # cosine below which two directions count as different
LEAST_PX = 4.0  # motion below which nothing is measured
CURVED = "2015, arcs by time"


def images(scene: tb.Scene) -> dict[str, Tensor]:
    """Return (H, W, 3) the sharp and the exact image, and what each filter makes of the sharp one."""
    now = tb.render_instant(scene)
    found = {"sharp": now.rgba[..., :3], "exact": tb.render(scene).rgba[..., :3]}
    found |= filter_instant(scene, now, tuple(FILTERS))[0]
    view, _ = find_view(scene, now)
    curved = guertin2015(view.color, find_paths(scene, now), curve="arc", weighting="time")
    return found | {CURVED: curved[0].permute(1, 2, 0)}


def share_of_blur(image: Tensor, found: dict[str, Tensor], where: Tensor) -> float:
    """Return how much of the exact blur an image has in the pixels `where` (H, W): 0 if sharp, 1 if exact."""
    true, made = (found["exact"] - found["sharp"])[where], (image - found["sharp"])[where]
    return float((true * made).sum() / true.square().sum())


def edges_left(image: Tensor, sharp: Tensor, motion_px: Tensor, where: Tensor) -> float:
    """Return how much of the sharp image's change along the motion (H, W, 2) is left in the pixels `where` (H, W)."""
    left, there = (_change(part, motion_px)[where] for part in (image, sharp))
    return float((left * there).sum() / there.square().sum())


def _change(image: Tensor, motion_px: Tensor) -> Tensor:
    """Return (H, W, 3) how an image changes from pixel to pixel along the motion; 0 at the border."""
    along = motion_px / torch.linalg.vector_norm(motion_px, dim=-1, keepdim=True).clamp(min=1e-9)
    x, y = torch.zeros_like(image), torch.zeros_like(image)
    x[:, 1:-1] = (image[:, 2:] - image[:, :-2]) / 2
    y[1:-1] = (image[2:] - image[:-2]) / 2
    return x * along[..., :1] + y * along[..., 1:]


def circles(scene: tb.Scene) -> Tensor:
    """Return (H, W) the distance of each pixel from the middle of the image, in radii of the rotor."""
    h, w = scene.camera.height, scene.camera.width
    y, x = torch.meshgrid(torch.arange(h) + 0.5 - h / 2, torch.arange(w) + 0.5 - w / 2, indexing="ij")
    return torch.hypot(x, y) * (filter_scenes.VIEW_HEIGHT / h) / filter_scenes.ROTOR_RADIUS


def unevenness(image: Tensor, radius: Tensor) -> float:
    """Return the root mean square by which an image differs from the mean of each circle, between .3 and .9 radii."""
    ring = (radius * (image.shape[0] * filter_scenes.ROTOR_RADIUS / filter_scenes.VIEW_HEIGHT)).long()  # 1 px wide
    inside = (radius > 0.3) & (radius < 0.9)
    value, which = image[inside], ring[inside]
    count = torch.bincount(which).clamp(min=1).unsqueeze(1)
    mean = torch.zeros(len(count), 3, dtype=image.dtype).index_add(0, which, value) / count
    return float((value - mean[which]).square().mean().sqrt())


def rim_error(image: Tensor, found: dict[str, Tensor], radius: Tensor) -> float:
    """Return the root mean square error outside of the rotor, up to 1.3 radii, where nothing is ever seen of it."""
    outside = (radius > 1.03) & (radius < 1.3)
    return float((image - found["exact"])[outside].square().mean().sqrt())


def crossed(scene: tb.Scene, name: str) -> Tensor:
    """Return (H, W) where the mesh `name` moves across the dominant motion of the tiles around."""
    now = tb.render_instant(scene)
    half, speed = gather.limit_half_motion(find_view(scene, now)[0].motion_px, TILE_PX)
    around, _ = gather.neighbours(gather.tile_max(half, TILE_PX))
    column, row = gather.pixel_grid(half)
    dominant = gather.fetch(gather.longest(around), column // TILE_PX, row // TILE_PX)
    cosine = (half * dominant).sum(1).abs() / (speed * torch.linalg.vector_norm(dominant, dim=1)).clamp(min=1e-9)
    number = [mesh.name for mesh in scene.meshes].index(name)
    return (now.mesh_id == number) & (cosine[0] < CROSSING) & (2 * speed[0] > LEAST_PX)


def measure(size: int) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, Tensor]]]:
    """Return {column: {method: number}} and each scene's images."""
    scenes = {name: make(size) for name, make in filter_scenes.SCENES.items()}
    found = {name: images(scene) for name, scene in scenes.items()}
    alone = images(filter_scenes.small_gear(size))
    motion_px = tb.render_instant(filter_scenes.small_gear(size)).motion_px
    radius = circles(scenes["rotor"])
    where = crossed(scenes["gears"], "small gear")
    bottle = tb.render_instant(scenes["pills"]).mesh_id == len(scenes["pills"].meshes) - 1
    beside = tb.render_instant(scenes["pills"]).mesh_id == 0
    sharp_unevenness = unevenness(found["rotor"]["sharp"], radius)
    columns: dict[str, dict[str, float]] = {}
    for method in found["rotor"]:
        values = {
            "rotor: unevenness": unevenness(found["rotor"][method], radius) / sharp_unevenness,
            "rotor: error outside": rim_error(found["rotor"][method], found["rotor"], radius),
            "gears: edges left": edges_left(found["gears"][method], found["gears"]["sharp"], motion_px, where),
            "the same, small gear alone": edges_left(alone[method], alone["sharp"], motion_px, where),
            "pills: blur in the bottle": share_of_blur(found["pills"][method], found["pills"], bottle),
            "pills: blur beside it": share_of_blur(found["pills"][method], found["pills"], beside),
        }
        for column, value in values.items():
            columns.setdefault(column, {})[method] = value
    return columns, found


def picture(found: dict[str, Tensor]) -> np.ndarray:
    """Return (H, W, 3) uint8: a scene's images side by side in two rows, with their names."""
    cells = []
    for name, image in found.items():
        title = np.full((16, image.shape[1], 3), 255, dtype=np.uint8)
        cells.append(np.concatenate([write_labels(title, [(3, 2, name)]), bytes_from_linear(image).numpy()]))
    cells += [np.full_like(cells[0], 255)] * (len(cells) % 2)
    half = len(cells) // 2
    return np.concatenate([np.concatenate(cells[:half], axis=1), np.concatenate(cells[half:], axis=1)])


def main() -> None:
    """Print the table and write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=256, help="width and height of the images [px]")
    parser.add_argument("--pictures", type=Path, help="folder for PNG files, one a scene")
    arguments = parser.parse_args()
    columns, found = measure(arguments.size)
    methods = list(next(iter(columns.values())))
    print(f"| {arguments.size} px | " + " | ".join(methods) + " |")
    print("|---|" + "--:|" * len(methods))
    for column, values in columns.items():
        print(f"| {column} | " + " | ".join(f"{round(values[m], 3) + 0.0:.3f}" for m in methods) + " |")
    if arguments.pictures:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
        for name, of_scene in found.items():
            (arguments.pictures / f"filters_{name}.png").write_bytes(encode_png(picture(of_scene)))


if __name__ == "__main__":
    main()
