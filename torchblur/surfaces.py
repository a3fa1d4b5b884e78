"""What the faces of a scene look like, all meshes end to end, and which of two coplanar ones is in front.

Before: scene.py.  After: prisms.py, instant.py.
Symbols: F faces of all meshes.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur.scene import Mesh, Scene


@dataclass(frozen=True)
class Surfaces:
    """What the faces of a scene look like, all meshes end to end."""

    rgb: Tensor  # (F, 3) float64 straight linear colour
    opacity: Tensor  # (F,) float64
    mesh_of: Tensor  # (F,) int64
    is_one_sided: Tensor  # (F,) bool
    tie_rank: Tensor  # (F,) int64 who is in front among coplanar faces; depends on content, not on input order
    first_face: tuple[int, ...]  # index of the first face of each mesh


def build_surfaces(scene: Scene) -> Surfaces:
    """Return the appearance of all faces of `scene`. Source: ours."""
    device, f64, i64 = scene.device, torch.float64, torch.int64
    meshes = scene.meshes
    counts = [m.n_faces for m in meshes]
    first = tuple(itertools.accumulate(counts, initial=0))[:-1]

    def cat(parts: list[Tensor], shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        return torch.cat(parts) if parts else torch.zeros(shape, dtype=dtype, device=device)

    numbered = list(enumerate(meshes))
    return Surfaces(
        rgb=cat([m.face_rgb() for m in meshes], (0, 3), f64),
        opacity=cat([m.face_opacity() for m in meshes], (0,), f64),
        mesh_of=cat([torch.full((m.n_faces,), i, dtype=i64, device=device) for i, m in numbered], (0,), i64),
        is_one_sided=cat(
            [torch.full((m.n_faces,), not m.material.double_sided, device=device) for m in meshes], (0,), torch.bool
        ),
        tie_rank=_tie_ranks(meshes, device),
        first_face=first,
    )


def _tie_ranks(meshes: tuple[Mesh, ...], device: torch.device) -> Tensor:
    """Return (F,) ranks that order coplanar faces by a hash of their content: mesh first, then face."""
    mesh_keys, face_keys = [], []
    for mesh in meshes:
        with torch.no_grad():
            knots = mesh.vertices.to(torch.float64)
            knots = knots if knots.ndim == 3 else knots.unsqueeze(0)
            content = (knots[:, mesh.faces] + 0.0).contiguous().view(torch.int64)  # (knots, F, 3, 3); -0.0 becomes 0.0
            corner = torch.zeros(mesh.n_faces, 3, dtype=torch.int64, device=device)
            for numbers in content:
                for axis in range(3):
                    corner = _mix(corner ^ numbers[..., axis])
            look = torch.cat([mesh.face_rgb(), mesh.face_opacity().unsqueeze(1)], dim=1) + 0.0
            key = corner.sum(1) + int(mesh.material.double_sided)
            for numbers in look.contiguous().view(torch.int64).unbind(1):
                key = _mix(key ^ numbers)
        face_keys.append(key)
        mesh_keys.append(int(_mix(key.sum().reshape(1))))
    if not face_keys:
        return torch.zeros(0, dtype=torch.int64, device=device)
    place_of_mesh = {m: p for p, m in enumerate(sorted(range(len(meshes)), key=lambda m: mesh_keys[m]))}
    mesh_place = torch.cat([torch.full_like(k, place_of_mesh[m]) for m, k in enumerate(face_keys)])
    order = torch.sort(torch.cat(face_keys), stable=True).indices
    order = order[torch.sort(mesh_place[order], stable=True).indices]
    rank = torch.zeros_like(order)
    rank[order] = torch.arange(len(order), device=device)
    return rank


def _mix(x: Tensor) -> Tensor:
    """Return a bijective scramble of int64 bits (xor-shift and odd multiplication)."""
    x = (x ^ (x >> 29)) * -0x61C8864680B583EB
    x = (x ^ (x >> 31)) * 0x2545F4914F6CDD1D
    return x ^ (x >> 30)
