"""Knots: into how many linear pieces a motion is cut, so that the pieces stay within a tenth of a pixel of it.

Before: motions.py.  After: clips.py.
Symbols: K segments of a mesh, C of the camera, both 0 (static) or a power of two, so that their knots nest;
V vertices; w clip-space depth. torchblur moves clip-space vertices linearly between the union of both knot sets,
with the camera's matrix and the mesh's vertices each linear between their own knots: exactly that is measured.
Source: ours; the chord of a curve, methods of any text on splines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

TOLERANCE_PX = 0.1  # a tenth of a pixel cannot be seen and is far below what the pixel filter resolves
CAMERA_SHARE = 0.5  # of the tolerance; the rest is left to the meshes under that camera
MAX_SEGMENTS = 64  # every segment is one more prism per triangle; reached only by very fast rotation
MIN_PROBES = 24  # instants at which a motion is compared, however few the segments
PROBE_BLOCK = 16  # instants compared at a time; bounds the memory at about 2 kB a vertex


class Moving(Protocol):
    """Anything with vertices at any time: motions.RigidBody, motions.PlayedVertices."""

    @property
    def is_static(self) -> bool:
        """Whether nothing ever moves."""

    def at(self, times_s: Tensor) -> Tensor:
        """Return (N, V, 3) world positions at times (N,) [s]."""

    def resting(self) -> Tensor:
        """Return (V, 3) places before any motion."""

    def kinks_s(self, open_s: float, close_s: float) -> list[float]:
        """Return the times inside the window at which the velocity jumps."""


@dataclass(frozen=True)
class View:
    """The camera of a clip over one exposure: what the error is measured in."""

    matrices: Callable[[Tensor], Tensor]  # times (N,) [s] -> (N, 4, 4) float64
    is_static: bool
    width: int
    height: int
    near: float  # view depth of the near plane [scene units]
    open_s: float
    close_s: float


@dataclass(frozen=True)
class Knots:
    """How a mesh or a camera is cut, and what is left."""

    segments: int  # 0: static
    error_px: float  # largest distance from the exact motion found [px]
    limit_reached: bool  # the tolerance would need more than MAX_SEGMENTS


def choose_camera_segments(view: View, bodies: Sequence[tuple[Moving, Tensor]]) -> Knots:
    """Return the fewest segments of the camera that keep its own error under its share of the tolerance.

    Args:
        view: the camera and the exposure.
        bodies: motion and faces (F, 3) of what it sees; the motion is taken as exact here.

    Source: ours.
    """
    if view.is_static:
        return Knots(0, 0.0, False)
    return _fewest(lambda c: max((chord_error_px(b, view, None, c) for b in bodies), default=0.0), CAMERA_SHARE)


def choose_mesh_segments(body: tuple[Moving, Tensor], view: View, camera_segments: int) -> Knots:
    """Return the fewest segments of one mesh that keep the error of mesh and camera together under the tolerance.

    Args:
        body: the mesh's motion and faces (F, 3).
        view: the camera and the exposure.
        camera_segments: as chosen for the camera.

    Source: ours.
    """
    if body[0].is_static:
        error = chord_error_px(body, view, 0, camera_segments)
        return Knots(0, error, error > TOLERANCE_PX)
    return _fewest(lambda k: chord_error_px(body, view, k, camera_segments), 1.0)


def chord_error_px(body: tuple[Moving, Tensor], view: View, mesh_segments: int | None, camera_segments: int) -> float:
    """Return the largest screen distance [px] between the exact motion and what torchblur makes of the knots.

    Vertices count while a face of theirs may be seen. One on the screen counts with its exact distance; one outside,
    or nearer than the near plane, with the most that an edge to it can move anything on the screen, to first order.

    Args:
        body: the mesh's motion and faces (F, 3).
        view: the camera and the exposure.
        mesh_segments: 0 for a static mesh; None takes the mesh's motion as exact (the camera's error alone).
        camera_segments: 0 for a static camera.

    Source: ours.
    """
    mover, faces = body
    n = max(mesh_segments or 0, camera_segments, 1)
    inner = max(3, -(-MIN_PROBES // n))
    per_segment = (torch.arange(inner, dtype=torch.float64) + 1) / (inner + 1)
    places = (torch.arange(n, dtype=torch.float64)[:, None] + per_segment).flatten() / n  # shutter times, ends left out
    span_s = view.close_s - view.open_s
    kinks = torch.tensor(mover.kinks_s(view.open_s, view.close_s), dtype=torch.float64)
    places = torch.cat([places, ((kinks - view.open_s) / span_s).clamp(0, 1)])
    ends = torch.arange(n + 1, dtype=torch.float64) / n

    def seconds(t: Tensor) -> Tensor:
        return view.open_s + t * span_s

    exact_world, exact_matrix = mover.at(seconds(places)), view.matrices(seconds(places))
    if camera_segments == 0:
        matrix = view.matrices(seconds(ends[:1]))
    else:
        matrix = view.matrices(seconds(torch.linspace(0, 1, camera_segments + 1, dtype=torch.float64)))
    if mesh_segments is None:
        chord_world, chord_matrix, chord = exact_world, _lerp(matrix, places), None
    else:
        world = mover.at(seconds(torch.linspace(0, 1, mesh_segments + 1, dtype=torch.float64)))
        chord_world, chord_matrix, chord = _lerp(world, ends), _lerp(matrix, ends), places
    worst = 0.0
    for first in range(0, len(places), PROBE_BLOCK):  # bounds the memory
        block = slice(first, first + PROBE_BLOCK)
        exact = _to_clip(exact_world[block], exact_matrix[block])
        if chord is None:
            near = _to_clip(chord_world[block], chord_matrix[block])
        else:
            near = _lerp(_to_clip(chord_world, chord_matrix), chord[block])
        distance = _screen_distance_px(exact, near, view)
        worst = max(worst, float(torch.where(_may_be_seen(exact, faces), distance, 0.0).max()))
    return worst


def _may_be_seen(clip: Tensor, faces: Tensor) -> Tensor:
    """Return (N, V) whether some face of the vertex is not wholly beyond one side of the view, from clip (N, V, 4)."""
    x, y, z, w = clip.unbind(-1)
    sides = (x > w, x < -w, y > w, y < -w, z < -w, z > w)
    code = sum(side.to(torch.uint8) << k for k, side in enumerate(sides))
    a, b, c = faces.unbind(-1)
    kept = (code[:, a] & code[:, b] & code[:, c]) == 0  # (N, F)
    seen = torch.zeros_like(code)
    for corner in (a, b, c):
        seen.scatter_reduce_(1, corner.expand_as(kept), kept.to(torch.uint8), "amax")
    return seen > 0


def _screen_distance_px(exact: Tensor, chord: Tensor, view: View) -> Tensor:
    """Return (N, V) distances [px] between clip positions (N, V, 4), as `chord_error_px` explains."""
    w = exact[..., 3:].clamp(min=view.near)
    chord_w = chord[..., 3:].clamp(min=view.near)
    ndc = (exact[..., :2] / w).clamp(-1, 1)
    error = chord - exact
    ndc_error = (error[..., :2] - ndc * error[..., 3:]) / chord_w
    half = torch.tensor([view.width / 2, view.height / 2], dtype=torch.float64)
    return (ndc_error * half).norm(dim=-1)


def _fewest(error_of: Callable[[int], float], share: float) -> Knots:
    """Return the first power of two whose error is within `share` of the tolerance, or the limit."""
    segments = 1
    while True:
        error = error_of(segments)
        if error <= share * TOLERANCE_PX:
            return Knots(segments, error, False)
        if segments >= MAX_SEGMENTS:
            return Knots(segments, error, True)
        segments *= 2


def _lerp(knots: Tensor, t: Tensor) -> Tensor:
    """Return values at shutter times `t` (N,) of equally spaced knots; one knot is a constant."""
    last = len(knots) - 1
    if last == 0:
        return knots.expand(len(t), *knots.shape[1:])
    first = (t * last).floor().clamp(0, last - 1)
    share = (t * last - first).reshape(-1, *[1] * (knots.ndim - 1))
    return knots[first.long()] * (1 - share) + knots[first.long() + 1] * share


def _to_clip(world: Tensor, matrices: Tensor) -> Tensor:
    """Return (N, V, 4) clip positions of (N, V, 3) points."""
    return world @ matrices[:, :, :3].transpose(1, 2) + matrices[:, None, :, 3]
