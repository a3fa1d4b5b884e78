"""What the faces of a scene look like, all meshes end to end, and which of two coplanar ones is in front.

Before: scene.py.  After: prisms.py, fragments.py, texture.py.
Symbols: F faces of all meshes.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur.scene import Mesh, Scene


@dataclass(frozen=True)
class Atlas:
    """The textures of all meshes end to end; a mesh without one has a single white texel."""

    texels: Tensor  # (X, 4) float64 linear RGB and opacity, row by row from the top
    first: Tensor  # (M,) int64 first texel of each mesh's texture
    size: Tensor  # (2, M) int64 width, height
    repeats: Tensor  # (M,) bool


@dataclass(frozen=True)
class Surfaces:
    """What the faces of a scene look like, all meshes end to end."""

    rgb: Tensor  # (F, 3) float64 straight linear colour
    opacity: Tensor  # (F,) float64
    mesh_of: Tensor  # (F,) int64
    is_one_sided: Tensor  # (F,) bool
    tie_rank: Tensor  # (F,) int64 who is in front among coplanar faces; depends on content, not on input order
    is_opaque: Tensor  # (F,) bool: hides all behind it at all times; never where its opacity asks for gradients
    is_textured: Tensor  # (F,) bool
    has_varying_opacity: Tensor  # (F,) bool: its texture has opacities below 1, or asks for gradients
    uv: Tensor  # (F, 3, 2) float64 texture coordinates of the corners; 0 without texture
    atlas: Atlas
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
    opacity = cat([m.face_opacity() for m in meshes], (0,), f64)
    textures = [m.material.texture for m in meshes]
    varies = [t is not None and (t.requires_grad or bool((t[..., 3:] < 1).any())) for t in textures]

    def per_face(flags: list[bool]) -> Tensor:
        parts = [torch.full((m.n_faces,), f, device=device) for f, m in zip(flags, meshes, strict=True)]
        return cat(parts, (0,), torch.bool)

    is_opaque = (opacity.detach() == 1) & ~per_face(varies)
    return Surfaces(
        rgb=cat([m.face_rgb() for m in meshes], (0, 3), f64),
        opacity=opacity,
        mesh_of=cat([torch.full((m.n_faces,), i, dtype=i64, device=device) for i, m in numbered], (0,), i64),
        is_one_sided=cat(
            [torch.full((m.n_faces,), not m.material.double_sided, device=device) for m in meshes], (0,), torch.bool
        ),
        tie_rank=_tie_ranks(meshes, device),
        is_opaque=is_opaque & (not opacity.requires_grad),
        is_textured=per_face([t is not None for t in textures]),
        has_varying_opacity=per_face(varies),
        uv=cat([_face_uv(m) for m in meshes], (0, 3, 2), f64),
        atlas=_build_atlas(meshes, device),
        first_face=first,
    )


def _face_uv(mesh: Mesh) -> Tensor:
    """Return (F, 3, 2) float64 texture coordinates, 0 where the mesh has none."""
    if mesh.uv is None:
        return torch.zeros(mesh.n_faces, 3, 2, dtype=torch.float64, device=mesh.vertices.device)
    return mesh.uv.to(mesh.vertices.device, torch.float64)


def _build_atlas(meshes: tuple[Mesh, ...], device: torch.device) -> Atlas:
    """Return the textures of all meshes, opacity 1 added where a texture has none."""
    white = torch.ones(1, 1, 4, dtype=torch.float64, device=device)
    images = []
    for mesh in meshes:
        texture = mesh.material.texture
        image = white if texture is None else texture.to(device, torch.float64)
        opacity = torch.ones(*image.shape[:2], 4 - image.shape[2], dtype=torch.float64, device=device)
        images.append(torch.cat([image, opacity], dim=2))
    counts = [i.shape[0] * i.shape[1] for i in images]
    sizes = torch.tensor([[i.shape[1], i.shape[0]] for i in images], dtype=torch.int64, device=device)
    return Atlas(
        texels=torch.cat([i.reshape(-1, 4) for i in images]) if images else white.reshape(1, 4),
        first=torch.tensor([*itertools.accumulate(counts, initial=0)][:-1], dtype=torch.int64, device=device),
        size=sizes.reshape(-1, 2).T,
        repeats=torch.tensor([m.material.wrap == "repeat" for m in meshes], dtype=torch.bool, device=device),
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
            if mesh.material.texture is not None:
                image = mesh.material.texture.to(device, torch.float64).contiguous().view(torch.int64).flatten()
                place = torch.arange(len(image), device=device)
                key = _mix(key ^ _mix(image + place).sum())
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
