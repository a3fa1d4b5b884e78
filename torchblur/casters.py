"""Casters: the moving triangles that may come between a light and what it shines on, in view or not.

Before: scene.py.  After: surfaces.py (which carries them), shadow_pairs.py, blocking.py.
Symbols: C casters, a face in a slice of the exposure in which neither its mesh nor a light has a knot, so that its
corners and the lights move linearly in it.
Source: ours.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur.scene import Scene


@dataclass(frozen=True, eq=False)
class Casters:
    """The triangles that cast shadows, over the whole exposure."""

    world: Tensor  # (2, 3, 3, C) float64: end of the slice (open, close), corner in the face's order, x y z
    t_open: Tensor  # (C,) float64 shutter time at which the slice begins
    t_close: Tensor  # (C,) and ends
    face: Tensor  # (C,) int64 face of the scene (all meshes end to end)
    centre: Tensor  # (3,) of the box around all casters: what is far from the origin is looked at from there
    extent: float  # the largest side of that box, or distance of the box from the origin: the size of rounding
    moves: bool  # whether one of them does

    @property
    def count(self) -> int:
        """Number of casters."""
        return len(self.face)


@torch.no_grad()
def find_casters(scene: Scene) -> Casters | None:
    """Return what casts shadows in a scene: every face, lit or not, from both sides, whose opacity is not 0 (or asks
    for a gradient). None where no light casts shadows, nothing is lit or there are no such faces. Source: ours.
    """
    lights = [light for light in scene.lights if light.casts_shadows]
    if not lights or all(mesh.material.shading != "lambert" or mesh.n_faces == 0 for mesh in scene.meshes):
        return None
    light_knots = {t for light in lights for t in light.knots}
    parts, moves, first_face = [], False, 0
    for mesh in scene.meshes:
        opacity = mesh.face_opacity()
        is_seen = torch.ones_like(opacity, dtype=torch.bool) if opacity.requires_grad else opacity > 0
        own = is_seen.nonzero().flatten()
        n, vertices = mesh.n_segments, mesh.vertices
        is_still = n == 0 or bool((vertices == vertices[:1]).all())
        knots = set() if is_still else {k / n for k in range(n)}
        times = sorted(knots | light_knots | {0.0, 1.0})
        at = mesh.vertices_at(torch.tensor(times, dtype=torch.float64, device=scene.device))
        corners = at[:, mesh.faces[own]].permute(0, 2, 3, 1)  # (T, 3, 3, F)
        for k, (start, end) in enumerate(itertools.pairwise(times)):
            slices = (torch.full_like(own, t, dtype=torch.float64) for t in (start, end))
            parts.append((corners[k : k + 2], *slices, own + first_face))
        moves = moves or (not is_still and len(own) > 0)
        first_face += mesh.n_faces
    world, t_open, t_close, face = (torch.cat(p, dim=-1) for p in zip(*parts, strict=True))
    if len(face) == 0:
        return None
    low, high = (find(world.movedim(2, 0).flatten(1), dim=1) for find in (torch.amin, torch.amax))
    extent = float(torch.cat([high - low, low.abs(), high.abs()]).max())
    return Casters(world, t_open, t_close, face, 0.5 * (low + high), extent, moves)
