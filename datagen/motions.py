"""Motions: where a body's vertices and the camera are at any time, exactly.

Before: seeds.py.  After: knots.py (samples them), scenes.py (chooses them).
Symbols: N times [s], V vertices; rotations are turned about an axis by an angle, never interpolated as matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

import torchblur as tb

Vector = tuple[float, float, float]
MAX_KINKS = 64  # in one exposure; beyond it no number of segments would follow them


@dataclass(frozen=True)
class Sway:
    """A harmonic movement: `direction` times sin(rate * time + phase)."""

    direction: Vector  # [scene units], amplitude included
    rate_rad_s: float
    phase_rad: float = 0.0


@dataclass(frozen=True)
class Path:
    """A point's way: a start, a constant velocity and any number of sways (two of them at right angles: a circle)."""

    start: Vector  # [scene units] at time 0
    velocity: Vector = (0.0, 0.0, 0.0)  # [scene units / s]
    sways: tuple[Sway, ...] = ()

    @property
    def is_static(self) -> bool:
        """Whether the point never moves."""
        return not any(self.velocity) and not any(any(s.direction) and s.rate_rad_s for s in self.sways)

    def at(self, times_s: Tensor) -> Tensor:
        """Return (N, 3) float64 positions [scene units] at times (N,) [s]. Source: ours."""
        times = times_s.to(torch.float64).unsqueeze(-1)
        position = _row(self.start) + times * _row(self.velocity)
        for sway in self.sways:
            position = position + _row(sway.direction) * torch.sin(times * sway.rate_rad_s + sway.phase_rad)
        return position.expand(len(times_s), 3)


@dataclass(frozen=True)
class RigidMotion:
    """A screw: a turn about an axis through the body's origin, while the origin follows a path.

    `rest` is a rotation vector (axis times angle) that is applied first: how the body stands at angle 0.
    """

    path: Path
    axis: Vector = (0.0, 1.0, 0.0)
    spin_rad_s: float = 0.0
    rest: Vector = (0.0, 0.0, 0.0)

    @property
    def is_static(self) -> bool:
        """Whether the body never moves."""
        return self.path.is_static and self.spin_rad_s == 0

    def place(self, vertices: Tensor, times_s: Tensor) -> Tensor:
        """Return (N, V, 3) float64 world positions of the body's vertices, (V, 3) or (N, V, 3), at times (N,) [s].

        Source: ours.
        """
        rest_angle = math.hypot(*self.rest)
        rest = turns(self.rest if rest_angle else (1.0, 0.0, 0.0), torch.tensor([rest_angle], dtype=torch.float64))[0]
        rotation = turns(self.axis, times_s.to(torch.float64) * self.spin_rad_s) @ rest  # (N, 3, 3)
        paths = "nij,vj->nvi" if vertices.ndim == 2 else "nij,nvj->nvi"
        turned = torch.einsum(paths, rotation, vertices.to(torch.float64))
        return turned + self.path.at(times_s).unsqueeze(1)


@dataclass(frozen=True, eq=False)
class RigidBody:
    """Vertices under a rigid motion."""

    vertices: Tensor  # (V, 3) float64, body space
    motion: RigidMotion

    @property
    def is_static(self) -> bool:
        """Whether nothing ever moves."""
        return self.motion.is_static

    def at(self, times_s: Tensor) -> Tensor:
        """Return (N, V, 3) float64 world positions at times (N,) [s]. Source: ours."""
        return self.motion.place(self.vertices, times_s)

    def resting(self) -> Tensor:
        """Return the (V, 3) vertices before any motion."""
        return self.vertices

    def kinks_s(self, open_s: float, close_s: float) -> list[float]:
        """Return the times inside the window at which the velocity jumps: none."""
        return []


@dataclass(frozen=True, eq=False)
class PlayedVertices:
    """A sequence of vertex positions played at its own rate, linear between its frames, back and forth for ever."""

    positions: Tensor  # (P, V, 3) float64, P >= 1 frames
    rate_hz: float
    start_s: float = 0.0  # place in the sequence at time 0 [s of the sequence]

    @property
    def is_static(self) -> bool:
        """Whether there is one frame only, or all are equal."""
        return len(self.positions) == 1 or bool((self.positions == self.positions[:1]).all())

    def at(self, times_s: Tensor) -> Tensor:
        """Return (N, V, 3) float64 positions at times (N,) [s]. Source: ours."""
        last = len(self.positions) - 1
        if last == 0:
            return self.positions.expand(len(times_s), -1, -1)
        phase = torch.remainder((times_s.to(torch.float64) + self.start_s) * self.rate_hz, 2 * last)
        place = torch.where(phase > last, 2 * last - phase, phase)
        first = place.floor().clamp(0, last - 1)
        share = (place - first)[:, None, None]
        index = first.long()
        return self.positions[index] * (1 - share) + self.positions[index + 1] * share

    def resting(self) -> Tensor:
        """Return the (V, 3) vertices of the first frame."""
        return self.positions[0]

    def kinks_s(self, open_s: float, close_s: float) -> list[float]:
        """Return the times of the sequence's frames strictly inside the window, MAX_KINKS at most [s]. Source: ours."""
        first = math.floor((open_s + self.start_s) * self.rate_hz) + 1
        last = math.ceil((close_s + self.start_s) * self.rate_hz) - 1
        step = max(1, -(-(last + 1 - first) // MAX_KINKS))
        times = [k / self.rate_hz - self.start_s for k in range(first, last + 1, step)]
        return [t for t in times if open_s < t < close_s]


@dataclass(frozen=True, eq=False)
class CarriedVertices:
    """A sequence that plays on while its whole body moves."""

    sequence: PlayedVertices
    motion: RigidMotion

    @property
    def is_static(self) -> bool:
        """Whether nothing ever moves."""
        return self.sequence.is_static and self.motion.is_static

    def at(self, times_s: Tensor) -> Tensor:
        """Return (N, V, 3) float64 world positions at times (N,) [s]. Source: ours."""
        return self.motion.place(self.sequence.at(times_s), times_s)

    def resting(self) -> Tensor:
        """Return the (V, 3) vertices of the first frame, before the whole body moves."""
        return self.sequence.resting()

    def kinks_s(self, open_s: float, close_s: float) -> list[float]:
        """Return the times of the sequence's frames strictly inside the window [s]. Source: ours."""
        return self.sequence.kinks_s(open_s, close_s)


@dataclass(frozen=True)
class CameraPath:
    """A perspective camera that looks from a moving eye at a moving target (dolly, pan, shake) and may orbit and roll.

    The eye first follows its path, then turns about the vertical through the target by orbit_rad_s * time.
    """

    eye: Path
    target: Path
    fov_y_deg: float
    near: float
    far: float
    orbit_rad_s: float = 0.0
    roll_rad: float = 0.0  # amplitude of a roll about the line of sight
    roll_rate_rad_s: float = 0.0

    @property
    def is_static(self) -> bool:
        """Whether the camera never moves."""
        rolls = self.roll_rad != 0 and self.roll_rate_rad_s != 0
        return self.eye.is_static and self.target.is_static and self.orbit_rad_s == 0 and not rolls

    @property
    def highest_y(self) -> float:
        """A height that the eye never passes [scene units], if its path only sways."""
        return self.eye.start[1] + sum(abs(sway.direction[1]) for sway in self.eye.sways)

    def matrices(self, times_s: Tensor, width: int, height: int) -> Tensor:
        """Return (N, 4, 4) float64 world-to-clip matrices at times (N,) [s] for an image of that size [px].

        Source: ours; the matrix itself is torchblur's `Camera.look_at`.
        """
        times = times_s.to(torch.float64)
        target = self.target.at(times)
        offset = self.eye.at(times) - target
        eye = target + (turns((0.0, 1.0, 0.0), times * self.orbit_rad_s) @ offset.unsqueeze(-1)).squeeze(-1)
        sight = (target - eye) / (target - eye).norm(dim=-1, keepdim=True)
        up = torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64).expand(len(times), 3)
        roll = (self.roll_rad * torch.sin(times * self.roll_rate_rad_s)).unsqueeze(-1)
        up = up * torch.cos(roll) + torch.linalg.cross(sight, up, dim=-1) * torch.sin(roll)
        pad = 2 if len(times) == 1 else 1  # look_at wants one or at least two knots; a doubled one is harmless
        camera = tb.Camera.look_at(
            eye.repeat(pad, 1),
            target.repeat(pad, 1),
            up.repeat(pad, 1),
            fov_y_deg=self.fov_y_deg,
            width=width,
            height=height,
            near=self.near,
            far=self.far,
        )
        return camera.world_to_clip[: len(times)]


def px_per_unit(camera: CameraPath, height: int) -> float:
    """Return the screen size [px] of a scene unit at the camera's target at time 0, for an image `height` high [px].

    Source: the pinhole camera.
    """
    distance = math.dist(camera.eye.at(torch.zeros(1))[0].tolist(), camera.target.at(torch.zeros(1))[0].tolist())
    return height / (2 * distance * math.tan(math.radians(camera.fov_y_deg) / 2))


def turns(axis: Vector, angles_rad: Tensor) -> Tensor:
    """Return (N, 3, 3) float64 rotations about `axis` (any length but 0) by angles (N,) [rad], right-handed.

    Raises:
        ValueError: the axis has no direction.

    Source: Rodrigues' formula.
    """
    length = math.hypot(*axis)
    if not length > 0:
        raise ValueError(f"axis: expected a direction, got {axis}")
    x, y, z = (c / length for c in axis)
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    angles = angles_rad.to(torch.float64)[:, None, None]
    eye = torch.eye(3, dtype=torch.float64)
    return eye + torch.sin(angles) * cross + (1 - torch.cos(angles)) * (cross @ cross)


def _row(vector: Vector) -> Tensor:
    """Return a vector as a (1, 3) float64 tensor."""
    return torch.tensor([vector], dtype=torch.float64)
