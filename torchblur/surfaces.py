"""What the faces of a scene look like, all meshes end to end, and which of two coplanar ones is in front.

Before: scene.py, atlas.py, casters.py.  After: prisms.py, fragments.py, texture.py.
Symbols: F faces of all meshes.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur.atlas import Atlas, build_atlas
from torchblur.casters import Casters, find_casters
from torchblur.lights import Light
from torchblur.scene import Mesh, Scene


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
    is_varying: Tensor  # (F,) bool: its look may change while the shutter is open
    rests: Tensor  # (F,) bool: lit, and only by the shadows on it
    is_lit: Tensor  # (F,) bool: shows its colour times the light that it gets
    has_normals: Tensor  # (F,) bool: its corners have normals; otherwise it is flat
    lights: tuple[Light, ...]
    casters: Casters | None  # what casts shadows; None where nothing does, on nothing
    ambient: Tensor  # (3,) float64 radiance from everywhere
    handedness: float  # of the camera
    first_face: tuple[int, ...]  # index of the first face of each mesh

    @property
    def has_mipmaps(self) -> bool:
        """Whether any texture has smaller copies."""
        return len(self.atlas.first) > 1


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
    lights_move = any(p.ndim == 2 for light in scene.lights for p in light.tensors().values())
    casters = find_casters(scene)
    light_changes = lights_move or (casters is not None and casters.moves)
    casts = casters is not None and casters.moves and not lights_move
    varying = [
        (m.material.texture is not None and not scene.is_still(m))
        or (m.material.shading == "lambert" and bool(scene.lights) and (light_changes or not scene.is_still(m)))
        for m in meshes
    ]
    is_lit = per_face([m.material.shading == "lambert" for m in meshes])
    return Surfaces(
        rgb=cat([m.face_rgb() for m in meshes], (0, 3), f64),
        opacity=opacity,
        mesh_of=cat([torch.full((m.n_faces,), i, dtype=i64, device=device) for i, m in numbered], (0,), i64),
        is_one_sided=per_face([not m.material.double_sided for m in meshes]),
        tie_rank=_tie_ranks(meshes, device),
        is_opaque=is_opaque & (not opacity.requires_grad),
        is_textured=per_face([t is not None for t in textures]),
        has_varying_opacity=per_face(varies),
        uv=cat([_face_uv(m) for m in meshes], (0, 3, 2), f64),
        atlas=build_atlas(meshes, device),
        is_varying=per_face(varying),
        rests=is_lit & per_face([casts and scene.is_still(m) for m in meshes]),
        is_lit=is_lit,
        has_normals=per_face([m.normals is not None for m in meshes]),
        lights=scene.lights,
        casters=casters,
        ambient=scene.ambient.to(device, f64),
        handedness=scene.camera.handedness,
        first_face=first,
    )


def _face_uv(mesh: Mesh) -> Tensor:
    """Return (F, 3, 2) float64 texture coordinates, 0 where the mesh has none."""
    if mesh.uv is None:
        return torch.zeros(mesh.n_faces, 3, 2, dtype=torch.float64, device=mesh.vertices.device)
    return mesh.uv.to(mesh.vertices.device, torch.float64)


def _tie_ranks(meshes: tuple[Mesh, ...], device: torch.device) -> Tensor:
    """Return (F,) ranks that order coplanar faces by a hash of their content: mesh first, then face."""
    mesh_keys, face_keys = [], []
    for mesh in meshes:
        with torch.no_grad():
            knots = mesh.vertices.to(torch.float64)
            knots = knots if knots.ndim == 3 else knots.unsqueeze(0)
            content = [*knots[:, mesh.faces]]  # (F, 3 corners, numbers) each
            if mesh.normals is not None:
                normals = mesh.normals.to(device, torch.float64)
                content += [*(normals if normals.ndim == 3 else normals.unsqueeze(0))[:, mesh.faces]]
            if mesh.uv is not None:
                content.append(mesh.uv.to(device, torch.float64))
            corner = torch.zeros(mesh.n_faces, 3, dtype=torch.int64, device=device)
            for part in content:
                for numbers in (part + 0.0).contiguous().view(torch.int64).unbind(2):  # -0.0 becomes 0.0
                    corner = _mix(corner ^ numbers)
            look = torch.cat([mesh.face_rgb(), mesh.face_opacity().unsqueeze(1)], dim=1) + 0.0
            material = mesh.material
            flags = (material.double_sided, material.mipmap, material.wrap == "clamp", material.shading == "lambert")
            key = corner.sum(1) + sum(flag << k for k, flag in enumerate(flags))
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
