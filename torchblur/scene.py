"""Scene: moving triangle meshes, what they are made of, the camera and the background.

Before: camera.py.  After: prisms.py (the exposure), instant.py (one instant).
Symbols: V vertices, F faces, K segments of a motion (K+1 knots at equally spaced shutter times).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchblur import check
from torchblur.camera import Camera, lerp_knots, project_world

WRAPS = ("repeat", "clamp")


@dataclass(frozen=True, eq=False)
class Material:
    """What a mesh is made of: straight (not premultiplied) linear colour and opacity, constant or per face.

    Args:
        color: (3,) or (F, 3) linear RGB, at least 0; above 1 is light that outshines white.
        opacity: a number or (F,), in [0, 1].
        texture: (h, w, 3) linear RGB that multiplies the colour, or (h, w, 4) with an opacity that multiplies the
            opacity; row 0 is the top, v = 0 the bottom edge; texel centres at (k + 0.5) / size; bilinear.
        wrap: "repeat" or "clamp": what uv outside [0, 1] mean.
        double_sided: show back faces too; otherwise only faces whose vertices turn counter-clockwise on screen,
            decided exactly in time.

    Raises:
        TypeError, ValueError: wrong shape or type, NaN, inf, or out of range.
    """

    color: Any = (0.8, 0.8, 0.8)
    opacity: Any = 1.0
    double_sided: bool = field(default=True, kw_only=True)
    texture: Any = field(default=None, kw_only=True)
    wrap: str = field(default="repeat", kw_only=True)

    def __post_init__(self) -> None:
        color = check.floats("color", self.color, (3,), ("F", 3))
        if (color.detach() < 0).any():
            raise check.fail("color", "values of at least 0", f"{float(color.detach().min())}")
        opacity = check.unit_range("opacity", check.floats("opacity", self.opacity, (), ("F",)))
        if not isinstance(self.double_sided, bool):
            raise check.fail_type("double_sided", "True or False", self.double_sided)
        if self.wrap not in WRAPS:
            raise check.fail("wrap", " or ".join(WRAPS), self.wrap)
        object.__setattr__(self, "color", color)
        object.__setattr__(self, "opacity", opacity)
        object.__setattr__(self, "texture", None if self.texture is None else _checked_texture(self.texture))


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh, static or with vertices that move linearly between knots.

    Args:
        vertices: (V, 3) static, or (K+1, V, 3) at equally spaced shutter times [scene units], float32 or float64.
        faces: (F, 3) integers in [0, V).
        material: colour, opacity, texture, sides; per-face values must be F long.
        uv: (F, 3, 2) float texture coordinates of the faces' corners; a texture needs them.
        name: for messages and metadata.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Example:
        >>> square = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
        >>> Mesh(torch.tensor(square, dtype=torch.float32), [[0, 1, 2], [0, 2, 3]]).n_faces
        2
    """

    vertices: Any
    faces: Any
    material: Material = field(default_factory=Material)
    name: str = field(default="mesh", kw_only=True)
    uv: Any = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise check.fail_type("name", "a str", self.name)
        vertices = check.floats("vertices", self.vertices, ("V", 3), ("K+1", "V", 3))
        if vertices.ndim == 3 and len(vertices) < 2:
            raise check.fail("vertices", "(V, 3), or (K+1, V, 3) with at least 2 knots", vertices)
        faces = check.indices("faces", self.faces, ("F", 3), vertices.shape[-2])
        if not isinstance(self.faces, Tensor):
            faces = faces.to(vertices.device)
        if not isinstance(self.material, Material):
            raise check.fail_type("material", "a Material", self.material)
        color, opacity = self.material.color, self.material.opacity
        if color.ndim == 2 and len(color) != len(faces):
            raise check.fail("color", f"(3,) or ({len(faces)}, 3), one row a face", color)
        if opacity.ndim == 1 and len(opacity) != len(faces):
            raise check.fail("opacity", f"a number or ({len(faces)},), one value a face", opacity)
        if self.uv is None and self.material.texture is not None:
            raise check.fail("uv", f"({len(faces)}, 3, 2) floats, as the material has a texture", "none")
        uv = None if self.uv is None else check.floats("uv", self.uv, (len(faces), 3, 2))
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        object.__setattr__(self, "uv", uv)

    @property
    def n_segments(self) -> int:
        """Number of linear pieces of the motion; 0 if static."""
        return len(self.vertices) - 1 if self.vertices.ndim == 3 else 0

    @property
    def n_faces(self) -> int:
        """Number of triangles."""
        return len(self.faces)

    def vertices_at(self, t: Tensor) -> Tensor:
        """Return (N, V, 3) float64 world positions at the shutter times `t` (N,): linear between the knots."""
        vertices = self.vertices.to(torch.float64)
        if vertices.ndim == 2:
            return vertices.expand(len(t), *vertices.shape)
        return lerp_knots(vertices, t)

    def face_rgb(self) -> Tensor:
        """Return (F, 3) float64 straight linear colour of the faces."""
        return self.material.color.to(self.vertices.device, torch.float64).expand(self.n_faces, 3)

    def face_opacity(self) -> Tensor:
        """Return (F,) float64 opacity of the faces."""
        return self.material.opacity.to(self.vertices.device, torch.float64).expand(self.n_faces)


@dataclass(frozen=True, eq=False)
class Scene:
    """Meshes, a camera and what is behind them.

    Args:
        meshes: any number of meshes, none too.
        camera: sees them; its device must be that of the meshes.
        background: (3,) linear RGB, or an image (H, W, 3) the size of the camera's.

    Raises:
        TypeError, ValueError: a wrong argument, named; tensors on several devices.
    """

    meshes: list[Mesh] | tuple[Mesh, ...]
    camera: Camera
    background: Any = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not isinstance(self.meshes, (list, tuple)) or not all(isinstance(m, Mesh) for m in self.meshes):
            raise check.fail_type("meshes", "a sequence of Mesh", self.meshes)
        if not isinstance(self.camera, Camera):
            raise check.fail_type("camera", "a Camera", self.camera)
        object.__setattr__(self, "meshes", tuple(self.meshes))
        h, w = self.camera.height, self.camera.width
        background = check.floats("background", self.background, (3,), (h, w, 3))
        if (background.detach() < 0).any():
            raise check.fail("background", "values of at least 0", f"{float(background.detach().min())}")
        device = self.camera.world_to_clip.device
        named = {f"meshes[{i}].vertices": m.vertices for i, m in enumerate(self.meshes)}
        named |= {f"meshes[{i}].faces": m.faces for i, m in enumerate(self.meshes)}
        check.same_device(**{"camera.world_to_clip": self.camera.world_to_clip, **named})
        for i, mesh in enumerate(self.meshes):
            parts = {f"material.{part}": getattr(mesh.material, part) for part in ("color", "opacity", "texture")}
            for part, value in (parts | {"uv": mesh.uv}).items():
                if value is not None:
                    _same_device_if_large(f"meshes[{i}].{part}", value, device)
        _same_device_if_large("background", background, device)
        object.__setattr__(self, "background", background)

    @property
    def device(self) -> torch.device:
        """Device of all tensors."""
        return self.camera.world_to_clip.device

    @property
    def dtype(self) -> torch.dtype:
        """Floating type of the results: that of the meshes' vertices (of an empty scene: float32)."""
        dtype = torch.float32
        for mesh in self.meshes:
            dtype = torch.promote_types(dtype, mesh.vertices.dtype)
        return dtype

    def knot_times(self, mesh: Mesh) -> list[float]:
        """Return the shutter times at which the linear pieces of a mesh's motion on screen meet, 0 and 1 included."""
        return sorted({k / n for n in (mesh.n_segments, self.camera.n_segments, 1) for k in range(n + 1) if n})

    def clip_at(self, mesh: Mesh, t: Tensor) -> Tensor:
        """Return (B, V, 4) float64 clip-space vertices of `mesh` at the shutter times `t` (B,).

        This is the motion model: at the knots of mesh and camera together, vertices are where they are; between them
        clip space is linear in time. Bit for bit the same at a knot from either side.

        Source: Ronnow et al. 2021, sec. 3; several segments ours.
        """
        camera = self.camera
        if mesh.n_segments == camera.n_segments == 0:
            return project_world(mesh.vertices_at(t[:1]), camera.world_to_clip_at(t[:1])).expand(len(t), -1, -1)
        knots = torch.tensor(self.knot_times(mesh), dtype=torch.float64, device=t.device)
        clip = project_world(mesh.vertices_at(knots), camera.world_to_clip_at(knots))
        segment = (torch.searchsorted(knots, t, right=True) - 1).clamp(0, len(knots) - 2)
        share = ((t - knots[segment]) / (knots[segment + 1] - knots[segment])).reshape(-1, 1, 1)
        return (1 - share) * clip[segment] + share * clip[segment + 1]

    def over_background(self, premultiplied: Tensor) -> Tensor:
        """Return (H, W, 4) colour with the background behind it, and opacity, of (H, W, 4) premultiplied. Ours."""
        alpha = premultiplied[..., 3:]
        rgb = premultiplied[..., :3] + (1 - alpha) * self.background.to(premultiplied)
        return torch.cat([rgb, alpha], dim=-1)

    def tensors(self) -> list[Tensor]:
        """Return all floating tensors of the scene."""
        parts = [self.camera.world_to_clip, self.background]
        for mesh in self.meshes:
            parts += [mesh.vertices, mesh.material.color, mesh.material.opacity, mesh.material.texture, mesh.uv]
        return [part for part in parts if part is not None]

    @property
    def requires_grad(self) -> bool:
        """Whether anything in the scene asks for gradients."""
        return torch.is_grad_enabled() and any(t.requires_grad for t in self.tensors())


def _checked_texture(texture: Any) -> Tensor:
    """Return the texture as (h, w, 3 or 4) finite floats, colours at least 0 and opacities in [0, 1]."""
    image = check.floats("texture", texture, ("h", "w", 3), ("h", "w", 4))
    if 0 in image.shape:
        raise check.fail("texture", "at least one texel", image)
    if (image.detach() < 0).any():
        raise check.fail("texture", "values of at least 0", f"{float(image.detach().min())}")
    if image.shape[2] == 4:
        check.unit_range("texture's opacity", image[..., 3])
    return image


def _same_device_if_large(name: str, value: Tensor, device: torch.device) -> None:
    """Raise if an array lies on another device; a single colour or number may come from the CPU (it is a constant)."""
    if value.device != device and (value.ndim > 1 or value.device.type != "cpu" or value.requires_grad):
        raise check.fail(name, f"a tensor on {device}", value)
