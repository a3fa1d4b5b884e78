"""Shadow rays: the reference that the shadow methods are measured against, exact in space at each of many sub-frames.

Before: shadow_samples.py.  After: scripts.
Symbols: J hits, F faces at an instant.
Source: ours; the ray from a light to X passes the edge A B on the side that the sign of (A x B) X tells.
"""

from __future__ import annotations

import torch
from torch import Tensor

import torchblur as tb
from datagen.baselines.shadow_samples import Hits, MovingFaces, ShadowedImage, average_samples, gather_faces
from torchblur import check
from torchblur.lights import unit

MAX_TESTS = 2_000_000  # rays and faces looked at together
SKIPPED = 1e-9  # share of the way to the light that rays skip


@torch.no_grad()
def trace_shadows(scene: tb.Scene, *, n_subframes: int) -> ShadowedImage:
    """Return the mean of `n_subframes` images, at the middles of equal parts of the exposure, with exact shadows.

    Raises:
        TypeError, ValueError: as `gather_faces`; `n_subframes`.

    Source: ours.
    """
    faces = gather_faces(scene)
    check.positive_int("n_subframes", n_subframes)
    instants = (torch.arange(n_subframes, dtype=torch.float64, device=scene.device) + 0.5) / n_subframes
    times = instants.unsqueeze(1).expand(-1, scene.camera.height * scene.camera.width)

    def visible(hits: Hits) -> Tensor:
        share = torch.ones_like(hits.t)
        for k in torch.unique(hits.sample).tolist():
            own = (hits.sample == k).nonzero().flatten()
            share[own] = _visible_at(scene.lights[0], faces, float(instants[k]), (hits.world[own], hits.face[own]))
        return share

    image, visibility = average_samples(scene, faces, times, visible)
    return ShadowedImage(image, visibility, 0, {"subframes": n_subframes})


def _visible_at(light: object, faces: MovingFaces, t: float, hits: tuple[Tensor, Tensor]) -> Tensor:
    """Return (J,) 0 or 1 whether the light is seen from points (J, 3) on faces (J,)."""
    point, own = hits
    corner, face = faces.world_at(t)
    if isinstance(light, tb.DirectionalLight):
        origin = corner.new_zeros(3)
        way = -unit(light.direction.to(corner).reshape(-1, 3)[0])
    else:
        origin, way = light.position.to(corner).reshape(-1, 3)[0], None
    corner = corner - origin
    following, last = corner[:, [1, 2, 0]], corner[:, [2, 0, 1]]
    if way is None:
        side, constant = torch.linalg.cross(following, last), corner.new_zeros(len(face), 3)
    else:
        side = torch.linalg.cross(way.expand_as(corner), following - last)
        constant = (side * (following + last)).sum(-1) / 2
    normal = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    height = (normal * corner[:, 0]).sum(1)  # of the face's plane over the origin
    is_seen = torch.ones(len(point), dtype=torch.float64, device=point.device)
    size = (corner.amax((0, 1)) - corner.amin((0, 1))).max()
    for rays in torch.arange(len(point), device=point.device).split(max(1, MAX_TESTS // max(1, len(face)))):
        x = point[rays] - origin
        e = (x @ side.reshape(-1, 3).T - constant.reshape(-1)).reshape(len(rays), -1, 3)
        crosses = ((e >= 0).all(2) | (e <= 0).all(2)) & (face != own[rays].unsqueeze(1))
        ray, which = crosses.nonzero(as_tuple=True)
        above = height[which] - (normal[which] * x[ray]).sum(1)  # of the plane over the point
        if way is None:
            share = -above / (normal[which] * x[ray]).sum(1)
            blocked = (share > SKIPPED) & (share < 1)
        else:
            blocked = above / (normal[which] * way).sum(1) > SKIPPED * size
        is_seen[rays[ray[blocked]]] = 0.0
    return is_seen
