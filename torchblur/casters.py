"""Casters: the moving triangles that may come between a light and what it shines on, in view or not.

Before: scene.py.  After: surfaces.py (which carries them), shadow_pairs.py, blocking.py.
Symbols: C casters, a face in a slice of the exposure in which neither its mesh nor a light has a knot, so that its
corners and the lights move linearly in it.
Source: ours.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchblur.lights import Light
from torchblur.scene import Scene
from torchblur.stopwatch import spent_on

# what vertices are known to, as a share of their coordinates: a caster nearer than this to a point does not block it
GAP = {torch.float32: 1e-6, torch.float64: 1e-11}


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
    gap: float  # share of coordinates that a caster must be away from what it blocks
    views: dict[Light, list] = field(default_factory=dict)  # what lights see of them, as shadow_pairs.py has found it

    @property
    def count(self) -> int:
        """Number of casters."""
        return len(self.face)


@spent_on("shadows")
@torch.no_grad()
def find_casters(scene: Scene) -> Casters | None:
    """Return what casts shadows in a scene: every face, lit or not, from both sides, whose opacity is not 0 (or asks
    for a gradient). None where no light casts shadows, nothing is lit, there are no such faces, or all of
    them lie in one plane that does not turn, so that none can come before another. Source: ours.
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
    gap = max(GAP[mesh.vertices.dtype] for mesh in scene.meshes)
    times = torch.unique(torch.cat([t_open, t_close])).tolist()
    if all(_is_flat(_at(world, (t_open, t_close), ends), gap * extent) for ends in itertools.pairwise(times)):
        return None
    return Casters(world, t_open, t_close, face, 0.5 * (low + high), extent, moves, gap)


def _at(world: Tensor, slices: tuple[Tensor, Tensor], ends: tuple[float, float]) -> Tensor:
    """Return (2, 3, 3, F) corners at both `ends` of a time in which none has a knot, of slices (open, close) (C,)."""
    t_open, t_close = slices
    own = ((t_open <= ends[0]) & (t_close >= ends[1])).nonzero().flatten()
    first, last = world[..., own]
    shares = ((t - t_open[own]) / (t_close - t_open)[own] for t in ends)
    return torch.stack([(1 - u) * first + u * last for u in shares])


def _is_flat(world: Tensor, slack: float) -> bool:
    """Return whether corners (2, 3, 3, C) lie in one plane, to `slack`, and all move alike."""
    shift = world[1] - world[0]
    if float((shift.amax((0, 2)) - shift.amin((0, 2))).max()) > slack:
        return False
    first = world[0, 0]
    normal = torch.linalg.cross(world[0, 1] - first, world[0, 2] - first, dim=0)
    area = normal.square().sum(0)
    largest = int(area.argmax())
    across = normal[:, largest] / area[largest].sqrt().clamp(min=torch.finfo(area.dtype).tiny)
    away = torch.einsum("d,kdn->kn", across, world[0] - first[:, largest].unsqueeze(1))
    return float(away.abs().max()) <= slack
