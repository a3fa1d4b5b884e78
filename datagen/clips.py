"""Clips: who acts in front of which camera, and the torchblur scene of any exposure or instant of it.

Before: motions.py, knots.py, lamps.py.  After: scenes.py builds clips, samples.py renders them.
Symbols: K segments of a mesh, C of the camera. Times in seconds from the clip's start.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

import torchblur as tb
from datagen.knots import Knots, Moving, View, choose_camera_segments, choose_mesh_segments
from datagen.lamps import Lamp, choose_lamp_segments
from datagen.motions import CameraPath, px_per_unit


@dataclass(frozen=True, eq=False)
class Actor:
    """One mesh of a clip: faces, looks, motion."""

    name: str
    faces: Tensor  # (F, 3) int64
    color: Tensor  # (3,) or (F, 3) linear, straight
    motion: Moving
    opacity: Tensor | float = 1.0  # or (F,)
    double_sided: bool = True
    texture: Tensor | None = None  # (h, w, 3) linear, which multiplies the colour
    uv: Tensor | None = None  # (F, 3, 2), with a texture
    is_lit: bool = False  # by lamps and ambient light; otherwise its colour is what is seen


@dataclass(frozen=True, eq=False)
class Clip:
    """Scene, motion, light and camera path that the frames of a clip share."""

    actors: tuple[Actor, ...]
    camera: CameraPath
    background: Tensor  # (3,) or (H, W, 3) linear
    notes: dict[str, Any] = field(default_factory=dict)  # JSON values for the metadata
    lamps: tuple[Lamp, ...] = ()
    ambient: tuple[float, float, float] = (0.0, 0.0, 0.0)  # linear RGB radiance from everywhere


@dataclass(frozen=True, eq=False)
class Exposure:
    """A clip between two times, ready to render, and how closely its knots follow the motion."""

    scene: tb.Scene
    open_s: float
    close_s: float
    camera_knots: Knots
    mesh_knots: tuple[Knots, ...]  # one per mesh
    lamp_knots: tuple[Knots, ...] = ()  # one per lamp


def expose(clip: Clip, width: int, height: int, open_s: float, close_s: float) -> Exposure:
    """Return the scene of the clip while the shutter is open, with as many knots as the chord error asks for.

    Args:
        clip: who acts.
        width, height: image size [px].
        open_s, close_s: when the shutter opens and closes [s of the clip].

    Raises:
        ValueError: the window is empty.

    Accuracy: vertices follow the exact motion within knots.TOLERANCE_PX, and shadows that of their lamps, unless the
        result says otherwise.
    Source: ours.
    """
    if not open_s < close_s:
        raise ValueError(f"close_s: expected a time after open_s = {open_s:g}, got {close_s:g}")
    path = clip.camera

    def matrices(times_s: Tensor) -> Tensor:
        return path.matrices(times_s, width, height)

    view = View(matrices, path.is_static, width, height, path.near, open_s, close_s)
    camera_knots = choose_camera_segments(view, [(a.motion, a.faces) for a in clip.actors])
    meshes, mesh_knots = [], []
    for actor in clip.actors:
        knots = choose_mesh_segments((actor.motion, actor.faces), view, camera_knots.segments)
        vertices = actor.motion.at(knot_times(knots.segments, open_s, close_s))
        meshes.append(_mesh(actor, vertices if knots.segments else vertices[0]))
        mesh_knots.append(knots)
    matrix = matrices(knot_times(camera_knots.segments, open_s, close_s))
    camera = tb.Camera(matrix if camera_knots.segments else matrix[0], width, height)
    lamp_knots = tuple(choose_lamp_segments(a, open_s, close_s, px_per_unit(path, height)) for a in clip.lamps)
    lights = [
        lamp.light(knot_times(knots.segments, open_s, close_s))
        for lamp, knots in zip(clip.lamps, lamp_knots, strict=True)
    ]
    scene = tb.Scene(meshes=meshes, camera=camera, background=clip.background, lights=lights, ambient=clip.ambient)
    return Exposure(scene, open_s, close_s, camera_knots, tuple(mesh_knots), lamp_knots)


def freeze(clip: Clip, width: int, height: int, time_s: float) -> tb.Scene:
    """Return the clip at one time as a scene in which nothing moves, placed exactly.

    Args:
        clip: who acts.
        width, height: image size [px].
        time_s: when [s of the clip].

    Source: ours.
    """
    times = torch.tensor([time_s], dtype=torch.float64)
    meshes = [_mesh(actor, actor.motion.at(times)[0]) for actor in clip.actors]
    camera = tb.Camera(clip.camera.matrices(times, width, height)[0], width, height)
    lights = [lamp.light(times) for lamp in clip.lamps]
    return tb.Scene(meshes=meshes, camera=camera, background=clip.background, lights=lights, ambient=clip.ambient)


def _mesh(actor: Actor, vertices: Tensor) -> tb.Mesh:
    """Return the actor as torchblur's mesh, vertices in float32: 1e-7 of the scene is far below a pixel."""
    material = tb.Material(
        color=actor.color,
        opacity=actor.opacity,
        double_sided=actor.double_sided,
        texture=actor.texture,
        shading="lambert" if actor.is_lit else "unlit",
    )
    places = vertices.to(torch.float32).contiguous()
    return tb.Mesh(places, actor.faces, material=material, uv=actor.uv, name=actor.name)


def knot_times(segments: int, open_s: float, close_s: float) -> Tensor:
    """Return the times of segments + 1 knots [s]; without segments, the opening. Source: ours."""
    if segments == 0:
        return torch.tensor([open_s], dtype=torch.float64)
    return open_s + (close_s - open_s) * torch.arange(segments + 1, dtype=torch.float64) / segments
