"""When lit surfaces bend in time: as they turn to or from a light, or pass the borders of a spot's cone.

Before: paths.py, lights.py.  After: nodes.py.
Symbols: K paths of lit layers; point = P / S; N the normal; V = S (light - point); the cosine has the sign of N V S;
A the axis of a spot, and its cone of cosine c the roots of (V A)^2 = c^2 V^2 A^2.
Source: ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import bernstein
from torchblur.blocking import Receivers
from torchblur.certificate import VECTOR_LIMIT, Divider
from torchblur.lights import SpotLight
from torchblur.paths import Paths
from torchblur.prisms import Prisms
from torchblur.stopwatch import spent_on

NOISE = 1e-14  # of the product of the factors' sizes
FLAT = 1e-9  # cosine of a cone that is a half-space
LINEAR = 0.5  # share of a cone's border (in cosine) that a path may cross, at the same place


@dataclass(frozen=True)
class LightPaths:
    """Normals and vectors to the lights of lit layers over spans."""

    paths: Paths  # K of them
    place: Tensor  # (4, 3, K) coefficients of P
    normals: tuple[
        tuple[Tensor, Tensor], ...
    ]  # of smooth and of flat faces: which (n,) of the paths, (d + 1, 3, n) coefficients of N
    vectors: tuple[Tensor, ...]  # (d + 1, 3, K) coefficients of V, light by light
    is_near: tuple[bool, ...]  # whether V holds S, light by light

    @classmethod
    @spent_on("lighting")
    def of(cls, prisms: Prisms, paths: Paths) -> LightPaths:
        """Return what the lit among the scene's layers, `paths`, do."""
        world = prisms.world.index_select(-1, paths.prism)
        place = paths.attribute(world)
        is_smooth = prisms.surfaces.has_normals[paths.face]
        smooth, flat = is_smooth.nonzero().flatten(), (~is_smooth).nonzero().flatten()
        ends = prisms.normal.index_select(-1, paths.prism[smooth])
        normals = (
            (smooth, paths.choose(smooth).attribute(ends)),
            (flat, _flat_normals(torch.stack([(1 - u) * world[0] + u * world[1] for u in paths.u])[..., flat])),
        )
        lights = prisms.surfaces.lights
        vectors = tuple(light.path(place, paths.scale, paths.t) for light in lights)
        return cls(paths, place, normals, vectors, tuple(len(v) > 2 for v in vectors))

    @spent_on("lighting")
    def bends(self, prisms: Prisms) -> tuple[Tensor, Tensor]:
        """Return the paths (B,) and times tau (B,) at which the light on them may bend."""
        paths, taus = [self.paths.span[:0]], [self.paths.t[0, :0]]
        for light, vector in zip(prisms.surfaces.lights, self.vectors, strict=True):
            for which, normal in self.normals:
                toward = vector[..., which]
                c = bernstein.product(normal, toward).sum(1)
                of, tau = bernstein.roots(c, NOISE * normal.abs().amax((0, 1)) * toward.abs().amax((0, 1)))
                paths.append(which[of])
                taus.append(tau)
            if isinstance(light, SpotLight):
                for of, tau in _cone_roots(light, vector, self.paths.t):
                    paths.append(of)
                    taus.append(tau)
        return torch.cat(paths), torch.cat(taus)

    def receivers(self) -> Receivers:
        """Return the points on the paths, as what light falls on."""
        paths = self.paths
        sign = paths.scale.mean(0).sign()  # of the face on screen
        return Receivers(sign * self.place, sign * paths.scale, paths.t, paths.face, torch.zeros_like(sign).bool())

    def due(self, prisms: Prisms) -> tuple[Tensor, ...]:
        """Return light by light (K,) bool: False where the path's surface faces away from it at all times."""
        paths, handedness = self.paths, prisms.surfaces.handedness
        sign_of_scale, parity = paths.scale.mean(0).sign(), prisms.parity[paths.prism]
        found = []
        for vector, is_near in zip(self.vectors, self.is_near, strict=True):
            is_away = torch.zeros_like(paths.span, dtype=torch.bool)
            for is_smooth, (which, normal) in zip((True, False), self.normals, strict=True):
                side = torch.full_like(parity[which], handedness)  # see shading.position_and_normal
                if is_smooth:  # N holds S; a flat one holds the turn of the stored corners
                    side = side * parity[which]
                if is_smooth == is_near:
                    side = side * sign_of_scale[which]
                cosine = side * bernstein.product(normal, vector[..., which]).sum(1)
                is_away[which] = (cosine <= 0).all(0)
            found.append(~is_away)
        return tuple(found)

    def dividers(self, prisms: Prisms) -> list[Divider]:
        """Return what the light on the paths divides by. Within the border of a cone vectors may vary by less, as the
        light falls off in it; beyond, not at all does it matter how.
        """
        spans = self.paths.span
        found = [Divider(spans[which], normal, VECTOR_LIMIT) for which, normal in self.normals]
        for light, vector in zip(prisms.surfaces.lights, self.vectors, strict=True):
            if not isinstance(light, SpotLight):
                found.append(Divider(spans, vector, VECTOR_LIMIT))
                continue
            axis = _axis(light, self.paths.t)

            def limit(which: Tensor, tau: Tensor, at=(light, vector, axis)) -> Tensor:
                return _cone_limit(*at, which, tau)

            found += [Divider(spans, axis, limit), Divider(spans, vector, limit)]
        return found


def _cone_limit(light: SpotLight, vector: Tensor, axis: Tensor, which: Tensor, tau: Tensor) -> Tensor:
    """Return by what share (n,) vectors to a spot may vary about the times `tau` of the paths `which` (n,)."""
    v, a = (bernstein.value(c[..., which], tau) for c in (vector, axis))
    size = bernstein.length(v, 0) * bernstein.length(a, 0)
    cosine = (v * a).sum(0).abs() / torch.where(size > 0, size, 1.0)  # V may have the sign of -S
    inner, outer = light.cosines
    limit = torch.full_like(cosine, VECTOR_LIMIT)
    limit[cosine < outer] = torch.inf
    limit[(cosine >= outer) & (cosine < inner)] = min(VECTOR_LIMIT, LINEAR * (inner - outer))
    return limit


def _flat_normals(world: Tensor) -> Tensor:
    """Return (3, 3, K) coefficients of the normals of corners (2 ends, 3 corners, 3, K) that move linearly."""
    a, b = world[:, 1] - world[:, 0], world[:, 2] - world[:, 0]
    mixed = torch.linalg.cross(a[0], b[1], dim=0) + torch.linalg.cross(a[1], b[0], dim=0)
    return torch.stack([torch.linalg.cross(a[0], b[0], dim=0), 0.5 * mixed, torch.linalg.cross(a[1], b[1], dim=0)])


def _axis(light: SpotLight, times: Tensor) -> Tensor:
    """Return (2, 3, K) coefficients of a spot's axis between the shutter times (2, K)."""
    return torch.stack([light.axis_at(t) for t in times]).detach()


def _cone_roots(light: SpotLight, vector: Tensor, times: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Return the paths and times at which `vector` (4, 3, K) lies on the borders of the cone."""
    axis = _axis(light, times)
    half = bernstein.product(vector, axis).sum(1)
    along = bernstein.product(half, half)
    square = bernstein.product(bernstein.product(vector, vector).sum(1), bernstein.product(axis, axis).sum(1))
    noise = NOISE * vector.abs().amax((0, 1)).square() * axis.abs().amax((0, 1)).square()
    found = []
    for cosine in set(light.cosines):
        if cosine > FLAT:
            found.append(bernstein.roots(along - cosine**2 * square, noise))
        else:
            found.append(bernstein.roots(half, noise.sqrt()))
    return found
