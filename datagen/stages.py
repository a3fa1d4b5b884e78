"""Stages: the camera and its way, and what stands behind the actors.

Before: motions.py, shapes.py, patterns.py, clips.py.  After: lit_stages.py, scenes.py.
Symbols: D distance of the eye from the origin, about which the actors play; the view there is VIEW_HEIGHT high.
Speeds are drawn as shares of the image height that are crossed in REFERENCE_S, and so do not depend on the
specification's fps and exposure: a longer exposure blurs more, as it does in a real camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from datagen.clips import Actor
from datagen.lamps import Lamp
from datagen.motions import CameraPath, Path, RigidBody, RigidMotion, Sway, Vector
from datagen.patterns import lit_color, paint, smooth_noise
from datagen.shapes import Shape, box, sheet

VIEW_HEIGHT = 4.0  # [scene units] seen at the origin, from top to bottom
HEADROOM = 0.5  # [scene units] from the eye to the ceiling, at least; matters to tall images, whose eye is far away
REFERENCE_S = 1 / 48  # half of a frame time at 24 fps: a cinema camera's usual exposure
CAMERA_KINDS = ("still", "truck", "dolly", "orbit", "pan", "shake")
CAMERA_WEIGHTS = (0.18, 0.18, 0.16, 0.18, 0.14, 0.16)
BACKDROP_KINDS = ("room", "wall", "ground", "gradient", "clouds", "flat")
BACKDROP_WEIGHTS = (0.30, 0.26, 0.24, 0.10, 0.07, 0.03)


@dataclass(frozen=True, eq=False)
class Stage:
    """Where a clip plays."""

    camera: CameraPath
    actors: tuple[Actor, ...]  # the backdrop's meshes, all still
    background: Tensor  # (3,) or (H, W, 3) linear
    kinds: dict[str, str]  # what was chosen, for the metadata
    lamps: tuple[Lamp, ...] = ()
    ambient: tuple[float, float, float] = (0.0, 0.0, 0.0)


def speed_of(share_per_exposure: float) -> float:
    """Return the speed [scene units / s] at the origin of what crosses that share of the image height in REFERENCE_S.

    Source: ours.
    """
    return share_per_exposure * VIEW_HEIGHT / REFERENCE_S


def choose_camera(
    rng: np.random.Generator, aspect: float, pitch_rad: tuple[float, float] = (-0.03, 0.3)
) -> tuple[CameraPath, str]:
    """Return a camera path and its kind. A tall image gets more distance, so that the actors stay inside.

    Args:
        rng: stream `camera`.
        aspect: width / height.
        pitch_rad: from where to where the camera may look down.

    Source: ours.
    """
    kind = str(rng.choice(CAMERA_KINDS, p=CAMERA_WEIGHTS))
    fov_deg = float(rng.uniform(32, 58))
    distance = VIEW_HEIGHT / 2 / math.tan(math.radians(fov_deg) / 2) / min(1.0, max(aspect, 0.5))
    yaw, pitch = float(rng.uniform(-0.45, 0.45)), float(rng.uniform(*pitch_rad))
    away = (math.sin(yaw) * math.cos(pitch), math.sin(pitch), math.cos(yaw) * math.cos(pitch))
    right = (math.cos(yaw), 0.0, -math.sin(yaw))
    eye = tuple(distance * c for c in away)
    speed = speed_of(float(np.exp(rng.uniform(math.log(0.006), math.log(0.045)))))
    swing, phase = float(rng.uniform(0.35, 0.8)), float(rng.uniform(-0.9, 0.9))
    rate = speed / swing  # a sway passes its middle at `speed`
    eye_sways: tuple[Sway, ...] = ()
    target_sways: tuple[Sway, ...] = ()
    roll_rad = roll_rate = 0.0
    if kind == "truck":  # eye and target glide aside together
        eye_sways = target_sways = (Sway(_times(right, swing), rate, phase),)
    elif kind == "dolly":  # nearer objects spread faster: more speed for the same blur
        eye_sways = (Sway(_times(away, min(1.4 * swing, 0.22 * distance)), 1.6 * rate, phase),)
    elif kind == "orbit":
        eye_sways = (Sway(_times(right, min(2.0 * swing, 0.3 * distance)), rate, phase),)
    elif kind == "pan":
        lift = (0.0, float(rng.uniform(-0.4, 0.4)), 0.0)
        target_sways = (Sway(_times(right, swing), rate, phase), Sway(_times(lift, swing), rate, phase + 0.7))
    elif kind == "shake":  # a hand: several small movements at 3 to 9 Hz
        rates = rng.uniform(18, 56, 4)
        phases = rng.uniform(0, 2 * math.pi, 4)
        sizes = speed / rates
        shakes = [Sway(_times(right if k % 2 else (0.0, 1.0, 0.0), float(sizes[k])), float(rates[k]), float(phases[k]))
                  for k in range(4)]  # fmt: skip
        target_sways, eye_sways = tuple(shakes[:3]), (shakes[3],)
        roll_rad, roll_rate = float(rng.uniform(0.005, 0.02)), float(rng.uniform(15, 35))
    path = CameraPath(
        eye=Path(eye, sways=eye_sways),
        target=Path((0.0, 0.0, 0.0), sways=target_sways),
        fov_y_deg=fov_deg,
        near=0.3,
        far=100.0,
        roll_rad=roll_rad,
        roll_rate_rad_s=roll_rate,
    )
    return path, kind


def choose_stage(
    rngs: tuple[np.random.Generator, np.random.Generator], colours: Tensor, size: tuple[int, int]
) -> Stage:
    """Return camera and backdrop.

    Args:
        rngs: streams `camera` and `backdrop`.
        colours: (5, 3) palette, the backdrop's colour first.
        size: width and height of the image [px].

    Source: ours.
    """
    camera_rng, rng = rngs
    width, height = size
    camera, camera_kind = choose_camera(camera_rng, width / height)
    kind = str(rng.choice(BACKDROP_KINDS, p=BACKDROP_WEIGHTS))
    main, second = backdrop_colours(rng, colours)
    pair = torch.stack([main, second])
    distance = math.hypot(*camera.eye.start)
    sky = gradient_image(rng, (main * 1.25).clamp(max=1), second, size)
    actors: tuple[Actor, ...] = ()
    if kind == "room":
        half = (3.4 + 0.5 * distance, max(3.1, camera.highest_y + HEADROOM), 1.4 + distance)
        shape = box(10, half)
        inside = Shape(shape.vertices, shape.faces.flip(1), shape.cell_uv, True)
        actors = (still("room", inside, paint(inside, pair, quiet(rng), rng)),)
    elif kind == "wall":
        shape = sheet(32, 0.0, 0.7).scaled((12.0, 12.0, 1.0))  # beyond the view from every eye
        actors = (still("wall", shape, paint(shape, pair, quiet(rng), rng), (0.0, 0.0, -3.2)),)
    elif kind == "ground":
        shape = laid(sheet(26, 0.0, 1.0)).scaled((11.0, 1.0, 11.0))
        actors = (still("ground", shape, paint(shape, pair, quiet(rng), rng), (0.0, -1.75, -4.0)),)
    if kind == "clouds":
        background = cloud_image(rng, main, second, size)
    elif kind == "flat":
        background = main
    else:
        background = sky
    return Stage(camera, actors, background.to(torch.float32), {"camera": camera_kind, "backdrop": kind})


def backdrop_colours(rng: np.random.Generator, colours: Tensor) -> tuple[Tensor, Tensor]:
    """Return two colours (3,) that stay behind: the palette's first, and it mixed with another. Source: ours."""
    other = colours[int(rng.integers(1, len(colours)))]
    share = float(rng.uniform(0.18, 0.5))
    return colours[0], colours[0] * (1 - share) + other * share


def gradient_image(rng: np.random.Generator, top: Tensor, bottom: Tensor, size: tuple[int, int]) -> Tensor:
    """Return an (H, W, 3) linear gradient, roughly from top to bottom. Source: ours."""
    x, y = _pixel_places(size)
    tilt = float(rng.uniform(-0.5, 0.5))
    share = (0.5 + (y + tilt * x) / 2).clamp(0, 1).unsqueeze(-1)
    return top * (1 - share) + bottom * share


def cloud_image(rng: np.random.Generator, first: Tensor, second: Tensor, size: tuple[int, int]) -> Tensor:
    """Return an (H, W, 3) linear image of smooth clouds of two colours. Source: ours."""
    x, y = _pixel_places(size)
    points = torch.stack([x.flatten(), y.flatten(), torch.zeros(x.numel(), dtype=torch.float64)], -1) * 2.2
    share = smooth_noise(points, rng).reshape(*x.shape, 1)
    return first * (1 - share) + second * share


def _pixel_places(size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return (H, W) x and y of the pixel centres, y in [-1, 1] downward, x in the same unit."""
    width, height = size
    x = (torch.arange(width, dtype=torch.float64) + 0.5 - width / 2) * (2 / height)
    y = (torch.arange(height, dtype=torch.float64) + 0.5) * (2 / height) - 1
    return x.expand(height, width), y[:, None].expand(height, width)


def quiet(rng: np.random.Generator) -> str:
    """Return a pattern for large surfaces. Source: ours."""
    return str(
        rng.choice(
            ("checker", "stripes", "bands", "noise", "patches", "gradient"), p=(0.3, 0.14, 0.12, 0.2, 0.12, 0.12)
        )
    )


def still(name: str, shape: Shape, colours: Tensor, place: Vector = (0.0, 0.0, 0.0), is_lit: bool = False) -> Actor:
    """Return an actor that never moves.

    Args:
        name: of the actor.
        shape: what it is.
        colours: (F, 3) linear, without light.
        place: of the shape's origin [scene units].
        is_lit: whether lamps light it; otherwise a fixed light is painted in.

    Source: ours.
    """
    body = RigidBody(shape.vertices, RigidMotion(Path(place)))
    return Actor(name, shape.faces, lit_color(shape, colours, is_lit, two_sided=True), body, is_lit=is_lit)


def laid(shape: Shape) -> Shape:
    """Return a sheet of the x-y plane turned into the x-z plane, facing up. Source: ours."""
    x, y, z = shape.vertices.unbind(-1)
    return Shape(torch.stack([x, z, -y], -1), shape.faces, shape.cell_uv, shape.is_closed)


def _times(vector: Vector, factor: float) -> Vector:
    """Return a vector stretched by a factor."""
    return (vector[0] * factor, vector[1] * factor, vector[2] * factor)
