"""Lit stages: a floor or walls for shadows to fall on, and the lamps that cast them.

Before: stages.py, lamps.py.  After: scenes.py.
All of it is drawn from the stream `lamps` (the camera from `camera`, as ever), so painted clips are not moved by it.
Power is set as a photographer would, by how bright the floor is to be, or the wall: at the origin, with a direct light
of irradiance E from an angle a and an ambient radiance A, it sends its colour times A + E cos(a) / pi.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from datagen.clips import Actor
from datagen.lamps import KINDS, Lamp
from datagen.motions import CameraPath, Path, Sway, Vector
from datagen.patterns import paint
from datagen.seeds import open_stream
from datagen.shapes import Shape, box, sheet
from datagen.stages import (
    HEADROOM,
    Stage,
    backdrop_colours,
    choose_camera,
    gradient_image,
    laid,
    quiet,
    speed_of,
    still,
)

PLACES = ("floor", "corner", "wall", "room")
PLACE_WEIGHTS = (0.36, 0.3, 0.14, 0.2)
PITCH_RAD = {"floor": (0.2, 0.6), "corner": (0.12, 0.5), "wall": (-0.03, 0.3), "room": (0.1, 0.45)}
KIND_WEIGHTS = (0.5, 0.22, 0.28)
TINTS = ((1.0, 0.97, 0.92), (1.0, 0.86, 0.68), (0.82, 0.91, 1.0), (1.0, 0.93, 0.8))
MOVING_SHARE = 0.45  # of the lamps
LOWEST, HIGHEST = -2.6, -1.2  # of the floor [scene units]
PLAYED_S = 2.0  # during which the floor is to stay below the actors
WALL_Z = -3.4
PICTURE_ALBEDO = 0.35  # of a bright photograph
WHITE = (0.75, 1.7)  # least and most that a white floor sends


def is_clip_lit(lighting: str, seed: int, clip: int) -> bool:
    """Tell whether lamps light a clip. Source: ours."""
    return lighting == "lamps" or (lighting == "mixed" and open_stream(seed, "lamps", clip).random() < 0.5)


def choose_lit_stage(
    rngs: tuple[np.random.Generator, np.random.Generator],
    colours: Tensor,
    size: tuple[int, int],
    cast: Sequence[Actor],
    is_open: bool = False,
    has_textures: bool = False,
) -> Stage:
    """Return camera, floor or walls, and lamps.

    Args:
        rngs: streams `camera` and `lamps`.
        colours: (5, 3) palette, the backdrop's colour first.
        size: width and height of the image [px].
        cast: who moves above the floor.
        is_open: the background must be in view: a floor and no walls.
        has_textures: floor and walls will wear pictures instead of the palette's colours.

    Source: ours.
    """
    camera_rng, rng = rngs
    rng.random()  # whether the clip is lit, see `is_clip_lit`
    kind = str(rng.choice(PLACES, p=PLACE_WEIGHTS))
    kind = "floor" if is_open else kind
    camera, camera_kind = choose_camera(camera_rng, size[0] / size[1], PITCH_RAD[kind])
    main, second = backdrop_colours(rng, colours)
    main, second = (0.12 + 0.88 * c for c in (main, second))  # on black no shadow is seen
    floor_y = min(max(lowest_y(cast) - float(rng.uniform(0.05, 0.4)), LOWEST), HIGHEST)
    sky = gradient_image(rng, (main * 1.25).clamp(max=1), second, size)
    actors = []
    for name, shape, place in _surfaces(kind, floor_y, camera):
        pair = torch.stack([main, second] if name != "wall" else [second, main])
        actors.append(still(name, shape, paint(shape, pair, quiet(rng), rng), place, is_lit=True))
    lamps, ambient = choose_lamps(rng, kind, PICTURE_ALBEDO if has_textures else float((main + second).mean() / 2))
    kinds = {"camera": camera_kind, "backdrop": kind, "lamps": " ".join(lamp.kind for lamp in lamps)}
    return Stage(camera, tuple(actors), sky.to(torch.float32), kinds, lamps, ambient)


def choose_lamps(rng: np.random.Generator, place: str, albedo: float) -> tuple[tuple[Lamp, ...], Vector]:
    """Return one or two lamps, and the ambient light.

    Args:
        rng: stream `lamps`.
        place: one of PLACES.
        albedo: of the floor or wall.

    Source: ours.
    """
    count = 1 if rng.random() < 0.6 else 2
    white = min(max(float(rng.uniform(0.3, 0.5)) / albedo, WHITE[0]), WHITE[1])  # what a white floor sends in all
    ambient = white * float(rng.uniform(0.12, 0.3))
    key = float(rng.uniform(0.55, 0.8)) if count == 2 else 1.0
    lamps = []
    for share in (key, 1 - key)[:count]:
        kind = str(rng.choice(KINDS, p=KIND_WEIGHTS if place != "room" else (0.6, 0.4, 0.0)))
        tint = TINTS[int(rng.integers(len(TINTS)))]
        start = _place(rng, place, kind)
        target = tuple(float(c) for c in rng.uniform((-0.4, -1.2, -0.6), (0.4, -0.2, 0.4)))
        distance = math.hypot(*start)
        toward = (start[2] if place == "wall" else start[1]) / distance
        irradiance = math.pi * (white - ambient) * share / max(toward, 0.35)
        power = irradiance * (1.0 if kind == "directional" else distance**2)
        inner = float(rng.uniform(17, 27))
        outer = inner + float(rng.uniform(4, 16))
        paths = _paths(rng, start, target)
        lamps.append(Lamp(kind, *paths, tuple(power * c for c in tint), inner, outer))
    return tuple(lamps), (ambient, ambient, ambient * float(rng.uniform(1.0, 1.15)))


def lowest_y(cast: Sequence[Actor]) -> float:
    """Return the height of the lowest vertex of any actor in the first PLAYED_S. Source: ours."""
    times = torch.linspace(0, PLAYED_S, 49, dtype=torch.float64)
    lowest = [float(actor.motion.at(times[: 1 if actor.motion.is_static else None])[..., 1].min()) for actor in cast]
    return min(lowest, default=0.0)


def _surfaces(kind: str, floor_y: float, camera: CameraPath) -> list[tuple[str, Shape, Vector]]:
    """Return name, shape and place of what shadows fall on."""
    floor = laid(sheet(20, 0.0, 1.0)).scaled((11.0, 1.0, 11.0))
    wall = sheet(20, 0.0, 0.7).scaled((12.0, 12.0, 1.0))
    if kind == "floor":
        return [("floor", floor, (0.0, floor_y, -3.0))]
    if kind == "wall":
        return [("wall", wall, (0.0, 0.0, WALL_Z))]
    if kind == "corner":  # the floor ends at the wall, which stands on it
        half_height = 0.7 * 12.0
        return [("floor", floor, (0.0, floor_y, WALL_Z + 11.0)), ("wall", wall, (0.0, floor_y + half_height, WALL_Z))]
    distance = math.hypot(*camera.eye.start)
    half = (3.4 + 0.5 * distance, max(3.9, (camera.highest_y + HEADROOM - floor_y) / 2), 1.4 + distance)
    shape = box(8, half)
    return [("room", Shape(shape.vertices, shape.faces.flip(1), shape.cell_uv, True), (0.0, floor_y + half[1], 0.0))]


def _place(rng: np.random.Generator, place: str, kind: str) -> Vector:
    """Return where a lamp stands, far enough from the actors for its light to be even."""
    if place == "room":  # below the ceiling
        return tuple(float(c) for c in rng.uniform((-3.0, 3.2, -0.8), (3.0, 4.6, 3.2)))
    side, low, high = (1.0, 0.25, 0.8) if place == "wall" else (1.25 if place == "corner" else 2.2, 0.6, 1.2)
    azimuth, elevation = float(rng.uniform(-side, side)), float(rng.uniform(low, high))  # from +z, where the eye is
    distance = float(rng.uniform(6.0, 9.0)) if kind == "spot" else float(rng.uniform(5.0, 7.0))
    flat = distance * math.cos(elevation)
    return (flat * math.sin(azimuth), distance * math.sin(elevation), flat * math.cos(azimuth))


def _paths(rng: np.random.Generator, start: Vector, target: Vector) -> tuple[Path, Path]:
    """Return the ways of a lamp and its target: at rest, or swinging as fast as slow actors move."""
    is_moving, way = rng.random() < MOVING_SHARE, str(rng.choice(("swing", "circle", "sweep")))
    speed = speed_of(float(np.exp(rng.uniform(math.log(0.01), math.log(0.06)))))
    swing, angle, phase = float(rng.uniform(0.4, 0.9)), float(rng.uniform(0, math.pi)), float(rng.uniform(-0.8, 0.8))
    if not is_moving:
        return Path(start), Path(target)
    across = (swing * math.cos(angle), 0.0, swing * math.sin(angle))
    first = Sway(across, speed / swing, phase)
    if way == "swing":
        return Path(start, sways=(first,)), Path(target)
    if way == "sweep":  # a torch that is pointed elsewhere; of a point light nothing moves then
        return Path(start), Path(target, sways=(first,))
    second = Sway((-across[2], 0.0, across[0]), speed / swing, phase + math.pi / 2)
    return Path(start, sways=(first, second)), Path(target)
