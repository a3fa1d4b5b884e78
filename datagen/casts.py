"""Casts: the moving bodies of a clip, their looks and their motions.

Before: shapes.py, patterns.py, clips.py, stages.py.  After: scenes.py.
Symbols: F faces; colours linear RGB.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datagen.clips import Actor
from datagen.motions import Path, RigidBody, RigidMotion, Sway, Vector
from datagen.patterns import PATTERNS, lit_color, paint
from datagen.shapes import (
    Shape,
    ball,
    box,
    cylinder,
    fan,
    gear,
    knot,
    polyhedron,
    revolve,
    sheet,
    star,
    torus,
    vase,
)
from datagen.stages import speed_of

KINDS = (
    "box", "slab", "ball", "cone", "cylinder", "vase", "ring", "knot", "star", "gear", "fan", "sheet", "rod", "disc",
    "polyhedron", "lamp",
)  # fmt: skip
KIND_WEIGHTS = (0.11, 0.06, 0.11, 0.06, 0.05, 0.07, 0.09, 0.05, 0.06, 0.07, 0.06, 0.05, 0.04, 0.03, 0.06, 0.03)
MOTION_KINDS = ("still", "spin", "fly", "screw", "circle")
MOTION_WEIGHTS = (0.12, 0.24, 0.34, 0.18, 0.12)
SLOWEST, FASTEST = 0.012, 0.16  # share of the image height in REFERENCE_S: 3 to 40 px at 256 px
MAX_SWAY_RAD_S = 22.0  # keeps a sway's turning points out of most exposures
MAX_SPIN_RAD_S = 75.0  # 90 degrees in REFERENCE_S
CLEAR_SHARE = 0.16  # of the bodies are semi-transparent


def build_cast(
    rngs: tuple[np.random.Generator, ...], colours: Tensor, aspect: float, is_lit: bool = False
) -> list[Actor]:
    """Return four to eight bodies that fly, turn or stand about the origin.

    Args:
        rngs: streams `cast`, `motion` and `colour`.
        colours: (5, 3) palette, the backdrop's colour first.
        aspect: width / height of the image.
        is_lit: whether lamps light them; otherwise a fixed light is painted in.

    Source: ours.
    """
    cast_rng, motion_rng, colour_rng = rngs
    n = int(cast_rng.integers(4, 9))
    actors = []
    for k, place in enumerate(choose_places(cast_rng, n, aspect)):
        kind = str(cast_rng.choice(KINDS, p=KIND_WEIGHTS))
        size = float(cast_rng.uniform(0.62, 1.15)) * (1.3 if n < 6 else 1.0)
        shape = build_shape(kind, cast_rng).scaled([size] * 3)
        body = RigidBody(shape.vertices, choose_motion(motion_rng, place, size))
        actors.append(
            Actor(f"{kind}-{k}", shape.faces, motion=body, **_looks(shape, kind, colours, colour_rng, is_lit))
        )
    return actors


def choose_places(rng: np.random.Generator, n: int, aspect: float) -> list[Vector]:
    """Return `n` places spread over the view and in depth, so that they do not all hide each other.

    Source: Roberts, the R sequence.
    """
    half = 1.8 * min(max(aspect, 0.6), 2.4)
    shift = rng.uniform(size=3)
    places = []
    for k in range(n):
        # a sequence whose points keep apart (Roberts' R3), so that no two bodies start in one place
        even = (shift + (k + 1) * np.array([0.8191725, 0.6710436, 0.5497005])) % 1.0
        x, y, z = float(even[0] * 2 - 1) * half, float(even[1] * 2 - 1) * 1.45, float(even[2]) * 3.2 - 2.3
        spread = 1 - 0.11 * z  # farther away more fits in
        places.append((x * spread, y * spread, z))
    return places


def choose_motion(rng: np.random.Generator, place: Vector, size: float) -> RigidMotion:
    """Return a rigid motion about `place` for a body of that size, at a random speed.

    Args:
        rng: stream `motion`.
        place: middle of the motion [scene units].
        size: radius of the body [scene units].

    Source: ours.
    """
    kind = str(rng.choice(MOTION_KINDS, p=MOTION_WEIGHTS))
    speed = speed_of(float(np.exp(rng.uniform(math.log(SLOWEST), math.log(FASTEST)))))
    rest = tuple(float(c) for c in rng.uniform(-1.2, 1.2, 3))
    axis, across = unit_vector(rng), unit_vector(rng)
    heading = unit_vector(rng, flat=0.5)
    swing, phase = max(float(rng.uniform(0.35, 0.9)), speed / MAX_SWAY_RAD_S), float(rng.uniform(-0.8, 0.8))
    spin = min(speed / size, MAX_SPIN_RAD_S) * float(rng.choice((-1, 1)))
    if kind == "still":
        return RigidMotion(Path(place), rest=rest)
    if kind == "spin":
        return RigidMotion(Path(place), axis, spin, rest)
    sway = Sway(tuple(swing * c for c in heading), speed / swing, phase)
    if kind == "fly":
        return RigidMotion(Path(place, sways=(sway,)), axis, 0.35 * spin * float(rng.random()), rest)
    if kind == "screw":  # turns about the way it goes
        return RigidMotion(Path(place, sways=(sway,)), heading, spin, rest)
    second = Sway(tuple(swing * c for c in across), speed / swing, phase + math.pi / 2)
    return RigidMotion(Path(place, sways=(sway, second)), axis, 0.3 * spin, rest)


def build_shape(kind: str, rng: np.random.Generator) -> Shape:
    """Return a random shape of one of KINDS, about 1 in radius.

    Raises:
        ValueError: an unknown kind.

    Source: ours.
    """
    if kind == "box":
        return box(int(rng.integers(4, 7)), tuple(float(s) for s in rng.uniform(0.45, 0.75, 3)))
    if kind == "slab":
        return box(5, (float(rng.uniform(0.6, 0.95)), float(rng.uniform(0.35, 0.7)), 0.06))
    if kind == "ball":
        return ball(11) if rng.random() < 0.7 else polyhedron("icosahedron", 2, is_round=True)
    if kind in ("cone", "cylinder"):
        top = 0.0 if kind == "cone" else float(rng.choice((1.0, 0.6)))
        return cylinder(20, float(rng.uniform(0.7, 1.3)), top).scaled([0.72] * 3)
    if kind == "vase":
        heights = np.linspace(0, 1, 12)
        radii = 0.42 + 0.26 * np.sin(heights * rng.uniform(2.5, 9.5) + rng.uniform(0, 6))
        return vase([float(r) for r in radii], 20)
    if kind == "ring":
        return torus(float(rng.uniform(0.12, 0.36)))
    if kind == "knot":
        return knot()
    if kind == "star":
        return star(int(rng.integers(4, 9)), float(rng.uniform(0.4, 0.62)), float(rng.uniform(0.1, 0.3)))
    if kind == "gear":
        return gear(int(rng.integers(7, 14)), float(rng.uniform(0.1, 0.25)))
    if kind == "fan":
        return fan(int(rng.integers(3, 7)), float(rng.uniform(0.2, 0.9)))
    if kind == "sheet":
        return sheet(10, float(rng.uniform(0, 0.25)), float(rng.uniform(0.5, 1.0))).scaled([0.9] * 3)
    if kind == "rod":
        return cylinder(8, 1.4, 1.0).scaled((0.05, 1.0, 0.05))
    if kind == "disc":
        return revolve([(0.0, 0.0), (0.35, 0.0), (0.7, 0.0), (1.0, 0.0)], 24)
    if kind == "polyhedron":
        return polyhedron(str(rng.choice(("tetrahedron", "octahedron", "icosahedron"))), int(rng.integers(1, 3)))
    if kind == "lamp":
        return ball(7).scaled([0.16] * 3)
    raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")


def unit_vector(rng: np.random.Generator, flat: float = 1.0) -> Vector:
    """Return a random direction; `flat` < 1 keeps it closer to the image plane. Source: ours."""
    vector = rng.normal(size=3) * np.array([1.0, 1.0, flat])
    return tuple(float(c) for c in vector / np.linalg.norm(vector))


def _looks(shape: Shape, kind: str, colours: Tensor, rng: np.random.Generator, is_lit: bool) -> dict[str, Any]:
    """Return an actor's colours, opacity and sides, and whether lamps light it."""
    order = rng.permutation(len(colours) - 1) + 1
    own = colours[torch.from_numpy(order)]
    if rng.random() < 0.3:
        own = torch.cat([own[:1], torch.tensor([[0.93, 0.92, 0.88]], dtype=own.dtype), own[1:]])
    pattern = str(rng.choice(PATTERNS, p=(0.2, 0.16, 0.12, 0.14, 0.1, 0.1, 0.1, 0.08)))
    is_clear, opacity = rng.random() < CLEAR_SHARE, float(rng.uniform(0.3, 0.65))
    is_open = not shape.is_closed
    if kind == "lamp":  # brighter than white: leaves saturated streaks
        color = ((own[0] * 0.5 + 0.5) * float(rng.uniform(3, 8))).to(torch.float32)
        is_clear = is_lit = False
    else:
        color = lit_color(shape, paint(shape, own, pattern, rng), is_lit, two_sided=is_open)
    one_sided = shape.is_closed and not is_clear and rng.random() < 0.7
    return {
        "color": color,
        "opacity": opacity if is_clear else 1.0,
        "double_sided": not one_sided,
        "is_lit": is_lit,
    }
