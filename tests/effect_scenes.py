"""Scenes of walls and boxes in which opaque things hide others, rest, barely move or touch, from small recipes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scene_makers as make
import torch
from hypothesis import strategies as st
from oracles import PlainMesh

import torchblur as tb

EYE = (0.3, 0.2, 5.0)
MOTIONS = ("still", "equal knots", "barely", "shift", "forward", "turn", "turn in pieces")
LOOKS = ("flat", "faces", "texture", "alpha texture", "lit", "lit texture")
OPACITIES = (1.0, 1.0, 1.0, 0.999, 1 - 1e-15, 0.5)


@dataclass(frozen=True)
class Body:
    """What decides a mesh."""

    shape: str  # "box", "wall", "slant", "open box"
    place: tuple[int, int, int]  # on a grid of half units, so that bodies touch and coincide
    motion: str
    look: str
    opacity: float
    double_sided: bool


@dataclass(frozen=True)
class Stage:
    """What decides a scene."""

    bodies: tuple[Body, ...]
    camera_moves: bool
    near: float
    light: str | None  # None, "still", "moving"
    n_rays: int
    is_double: bool
    seed: int


@st.composite
def stages(draw) -> Stage:
    """Draw a scene of 1 to 4 bodies."""
    body = st.builds(
        Body,
        shape=st.sampled_from(("box", "box", "wall", "slant", "open box")),
        place=st.tuples(st.integers(-2, 2), st.integers(-2, 2), st.integers(-3, 3)),
        motion=st.sampled_from(MOTIONS),
        look=st.sampled_from(LOOKS),
        opacity=st.sampled_from(OPACITIES),
        double_sided=st.booleans(),
    )
    return Stage(
        bodies=tuple(draw(st.lists(body, min_size=1, max_size=4))),
        camera_moves=draw(st.sampled_from((False, False, False, True))),
        near=draw(st.sampled_from((0.1, 0.1, 3.6, 4.0))),
        light=draw(st.sampled_from((None, "still", "moving"))),
        n_rays=draw(st.sampled_from((1, 1, 2))),
        is_double=draw(st.booleans()),
        seed=draw(st.integers(0, 99)),
    )


def build(stage: Stage) -> tb.Scene:
    """Return the scene of a recipe."""
    rng = np.random.default_rng(stage.seed)
    dtype = torch.float64 if stage.is_double else torch.float32
    end = np.add(EYE, (0.3, 0.0, -0.2))
    eye = np.stack([EYE, end]) if stage.camera_moves else np.array(EYE)
    camera = tb.Camera.look_at(eye, (0, 0, 0), fov_y_deg=40, width=9, height=7, near=stage.near, far=20)
    lights = []
    if stage.light:
        position = np.array([1.0, 2.0, 4.0])
        moving = np.stack([position, position + 0.5])
        lights = [tb.PointLight(moving if stage.light == "moving" else position, 30.0)]
    meshes = [mesh(body, rng, dtype) for body in stage.bodies]
    return tb.Scene(meshes, camera, (0.2, 0.3, 0.4), lights=lights, ambient=(0.1, 0.1, 0.1))


def mesh(body: Body, rng: np.random.Generator, dtype: torch.dtype) -> tb.Mesh:
    """Return a mesh of a recipe."""
    plain = shape_of(body.shape)
    n = len(plain.faces)
    knots = torch.tensor(moved(plain.vertices + 0.5 * np.array(body.place), body.motion, rng), dtype=dtype)
    color = rng.uniform(0, 1, (n, 3)) if body.look == "faces" else rng.uniform(0, 1, 3)
    texture = uv = None
    if "texture" in body.look:
        texture = rng.uniform(0, 1, (4, 5, 4 if body.look == "alpha texture" else 3))
        uv = torch.tensor(rng.uniform(0, 1.5, (n, 3, 2)))
    shading = "lambert" if "lit" in body.look else "unlit"
    material = tb.Material(color, body.opacity, texture=texture, shading=shading, double_sided=body.double_sided)
    return tb.Mesh(knots, plain.faces, material, uv=uv)


def shape_of(kind: str) -> PlainMesh:
    """Return a unit box, one without its far side, or a large sheet, upright or aslant."""
    if kind == "box":
        return make.box_mesh((0, 0, 0), (1, 1, 1))
    if kind == "open box":
        box = make.box_mesh((0, 0, 0), (1, 1, 1))
        return PlainMesh(box.vertices, box.faces[2:])
    vertices, faces = make.grid(2, 1.5)
    if kind == "slant":
        vertices[:, 2] = 0.4 * vertices[:, 0]
    return PlainMesh(vertices, faces)


def moved(vertices: np.ndarray, motion: str, rng: np.random.Generator) -> np.ndarray:
    """Return the vertices, or their knots."""
    if motion == "still":
        return vertices
    if motion == "equal knots":
        return np.stack([vertices] * 3)
    if motion == "barely":
        return np.stack([vertices, vertices + 10.0 ** -rng.uniform(3, 16)])
    if motion == "forward":
        return np.stack([vertices, np.add(vertices, (0, 0, 0.5 * rng.choice([-1, 1])))])
    if motion == "shift":
        return np.stack([vertices, vertices + rng.uniform(-0.6, 0.6, 3) * [1, 1, 0]])
    turns = 3 if motion == "turn in pieces" else 1
    return make.rotated(vertices, rng.uniform(-0.6, 0.6), turns, make.rotation_y)
