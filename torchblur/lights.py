"""Lights: how much light arrives at a point at a time, and from where.

Before: camera.py (knots).  After: scene.py, lighting.py.
Symbols: K points; K+1 knots of a motion, equally spaced in shutter time, linear between; s the scale S of the points'
rational paths (point = P / S), so that S (light - point) = S light - P is a polynomial.
Source: radiometry: the irradiance of a point of radiant intensity I is I / r^2; the falloff of spots is that of the
glTF extension KHR_lights_punctual.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchblur import bernstein, check
from torchblur.camera import lerp_knots

LEAST_ANGLE_DEG = 0.01  # of a spot: below, cosines lose the angle


@dataclass(frozen=True, eq=False)
class PointLight:
    """A point that shines equally in all directions.

    Args:
        position: (3,) or (K+1, 3) floats at equally spaced shutter times [scene units].
        intensity: a number or (3,) linear RGB, at least 0 [W/sr].
        casts_shadows: whether faces between it and a lit point take its light away.

    Raises:
        TypeError, ValueError: a wrong argument, named.
    """

    position: Any
    intensity: Any
    casts_shadows: bool = field(default=True, kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", _moving("position", self.position))
        object.__setattr__(self, "intensity", _rgb("intensity", self.intensity))
        check.flag("casts_shadows", self.casts_shadows)

    @property
    def knots(self) -> list[float]:
        """Shutter times strictly inside the exposure at which the motion bends."""
        return _inner_knots(self.position)

    def tensors(self) -> dict[str, Tensor]:
        """Return the floating tensors by name."""
        return {"position": self.position, "intensity": self.intensity}

    def arriving(self, point: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return the unit vectors towards the light (3, K), and the irradiance (K, 3) of a surface that faces it.

        Args:
            point: (3, K) float64 [scene units].
            t: (K,) shutter times.

        Source: inverse-square law.
        """
        return _from_a_point(along(self.position, t) - point, self.intensity)

    def path(self, place: Tensor, scale: Tensor, times: Tensor) -> Tensor:
        """Return (4, 3, K) Bernstein coefficients of S (light - point) over slices of time without a knot inside.

        Args:
            place: (4, 3, K) coefficients of P = S point.
            scale: (3, K) coefficients of S.
            times: (2, K) shutter times at which the slices begin and end.
        """
        return _to_position(self.position, place, scale, times)


@dataclass(frozen=True, eq=False)
class SpotLight:
    """A point that shines into a cone: fully inside the inner angle, not at all outside the outer one.

    Args:
        position, target: (3,) or (K+1, 3) floats [scene units]; the axis runs from one to the other.
        intensity: a number or (3,) linear RGB, at least 0, along the axis [W/sr].
        inner_angle_deg, outer_angle_deg: from the axis [degrees], 0 <= inner <= outer, 0.01 <= outer <= 90; between
            them the light falls by the square of a linear function of the angle's cosine; equal angles are a hard
            border, through which no gradient passes.
        casts_shadows: as for `PointLight`.

    Raises:
        TypeError, ValueError: a wrong argument, named; a target at the position.
    """

    position: Any
    target: Any
    intensity: Any
    inner_angle_deg: float = field(default=30.0, kw_only=True)
    outer_angle_deg: float = field(default=45.0, kw_only=True)
    casts_shadows: bool = field(default=True, kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", _moving("position", self.position))
        object.__setattr__(self, "target", _moving("target", self.target))
        object.__setattr__(self, "intensity", _rgb("intensity", self.intensity))
        check.flag("casts_shadows", self.casts_shadows)
        check.number("outer_angle_deg", self.outer_angle_deg, LEAST_ANGLE_DEG, 90.0)
        check.number("inner_angle_deg", self.inner_angle_deg, 0.0, self.outer_angle_deg)
        times = torch.tensor([0.0, *self.knots, 1.0], dtype=torch.float64, device=self.position.device)
        if (self.axis_at(times).detach().norm(dim=0) == 0).any():
            raise check.fail("target", "a point away from the position", "the position itself")

    @property
    def knots(self) -> list[float]:
        """Shutter times strictly inside the exposure at which the motion bends."""
        return sorted({*_inner_knots(self.position), *_inner_knots(self.target)})

    @property
    def cosines(self) -> tuple[float, float]:
        """Cosines of the inner and the outer angle."""
        return math.cos(math.radians(self.inner_angle_deg)), math.cos(math.radians(self.outer_angle_deg))

    def tensors(self) -> dict[str, Tensor]:
        """Return the floating tensors by name."""
        return {"position": self.position, "target": self.target, "intensity": self.intensity}

    def axis_at(self, t: Tensor) -> Tensor:
        """Return (3, K) float64 the axis, target - position, at the shutter times `t` (K,)."""
        return along(self.target, t) - along(self.position, t)

    def arriving(self, point: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return what `PointLight.arriving` does, within the cone. Source: glTF, KHR_lights_punctual."""
        to_light, irradiance = _from_a_point(along(self.position, t) - point, self.intensity)
        axis = self.axis_at(t)
        cosine = -(unit(axis) * to_light).sum(0)
        inner, outer = self.cosines
        if inner > outer:
            share = ((cosine - outer) / (inner - outer)).clamp(0, 1).square()
        else:
            share = (cosine >= outer).to(cosine.dtype)
        return to_light, irradiance * share.unsqueeze(1)

    def path(self, place: Tensor, scale: Tensor, times: Tensor) -> Tensor:
        """Return what `PointLight.path` does."""
        return _to_position(self.position, place, scale, times)


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """A light infinitely far away: the same everywhere.

    Args:
        direction: (3,) or (K+1, 3) floats, the way the light travels, of any length above 0.
        irradiance: a number or (3,) linear RGB, at least 0, of a surface that faces the light [W/m^2].
        casts_shadows: as for `PointLight`.

    Raises:
        TypeError, ValueError: a wrong argument, named.
    """

    direction: Any
    irradiance: Any
    casts_shadows: bool = field(default=True, kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", _moving("direction", self.direction))
        object.__setattr__(self, "irradiance", _rgb("irradiance", self.irradiance))
        check.flag("casts_shadows", self.casts_shadows)
        if (self.direction.detach() == 0).all(-1).any():
            raise check.fail("direction", "a vector that is not 0", "a vector of zeros")

    @property
    def knots(self) -> list[float]:
        """Shutter times strictly inside the exposure at which the motion bends."""
        return _inner_knots(self.direction)

    def tensors(self) -> dict[str, Tensor]:
        """Return the floating tensors by name."""
        return {"direction": self.direction, "irradiance": self.irradiance}

    def arriving(self, point: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return what `PointLight.arriving` does."""
        back = -along(self.direction, t)  # between opposite knots it passes through 0, and lights nothing
        irradiance = self.irradiance.to(back.device, torch.float64).expand(point.shape[1], 3)
        return unit(back), irradiance

    def path(self, place: Tensor, scale: Tensor, times: Tensor) -> Tensor:
        """Return (2, 3, K) Bernstein coefficients of the vector towards the light; see `PointLight.path`."""
        return -torch.stack([along(self.direction, t) for t in times]).detach()


LIGHTS = (PointLight, SpotLight, DirectionalLight)
Light = PointLight | SpotLight | DirectionalLight


def along(knots: Tensor, t: Tensor) -> Tensor:
    """Return (3, K) float64 values at the shutter times `t` (K,) of (3,) or (K+1, 3) knots."""
    knots = knots.to(t.device, torch.float64)
    return knots.unsqueeze(1).expand(3, len(t)) if knots.ndim == 1 else lerp_knots(knots, t).T


def unit(vector: Tensor) -> Tensor:
    """Return vectors (3, K) at length 1, or 0 where they are, however small or large they are. Source: ours."""
    largest = vector.detach().abs().amax(0)
    vector = vector / torch.where(largest > 0, largest, 1.0)
    square = vector.square().sum(0)
    return vector / torch.where(square > 0, square, 1.0).sqrt()


def _from_a_point(vector: Tensor, intensity: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit vectors (3, K) and irradiance (K, 3) of vectors (3, K) towards a light; 0 at the light itself."""
    square = vector.square().sum(0)
    is_away = square > 0
    square = torch.where(is_away, square, 1.0)
    irradiance = torch.where(is_away, 1 / square, 0.0).unsqueeze(1) * intensity.to(vector.device, torch.float64)
    return vector / square.sqrt(), irradiance


def _to_position(position: Tensor, place: Tensor, scale: Tensor, times: Tensor) -> Tensor:
    """Return (4, 3, K) coefficients of S position - P."""
    light = torch.stack([along(position, t) for t in times]).detach()
    return bernstein.product(scale.unsqueeze(1), light) - place


def _moving(name: str, value: Any) -> Tensor:
    """Return `value` as (3,) or (K+1, 3) floats with at least 2 knots."""
    tensor = check.floats(name, value, (3,), ("K+1", 3))
    if tensor.ndim == 2 and len(tensor) < 2:
        raise check.fail(name, "(3,), or (K+1, 3) with at least 2 knots", tensor)
    return tensor


def _rgb(name: str, value: Any) -> Tensor:
    """Return `value` as (3,) floats of at least 0."""
    tensor = check.floats(name, value, (), (3,))
    if (tensor.detach() < 0).any():
        raise check.fail(name, "values of at least 0", f"{float(tensor.detach().min())}")
    return tensor.expand(3)


def _inner_knots(knots: Tensor) -> list[float]:
    """Return the shutter times of the knots between the first and the last."""
    n = len(knots) - 1 if knots.ndim == 2 else 1
    return [k / n for k in range(1, n)]
