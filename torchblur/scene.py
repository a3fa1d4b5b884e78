"""Scene: moving triangle meshes, the camera, the lights and the background.

Before: camera.py, lights.py, material.py.  After: prisms.py (the exposure), instant.py (one instant).
Symbols: V vertices, F faces, K segments of a motion (K+1 knots at equally spaced shutter times).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchblur import check
from torchblur.camera import Camera, lerp_knots, project_world
from torchblur.lights import LIGHTS, Light
from torchblur.material import Material

MAX_UV = 1e6  # in float32 a step from there is a sixteenth of a texture


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh, static or with vertices that move linearly between knots.

    Args:
        vertices: (V, 3) static, or (K+1, V, 3) at equally spaced shutter times [scene units], float32 or float64.
        faces: (F, 3) integers in [0, V).
        material: colour, opacity, texture, sides; per-face values must be F long.
        uv: (F, 3, 2) float texture coordinates of the faces' corners, of at most MAX_UV; a texture needs them.
        normals: (V, 3) static, or (K+1, V, 3) with the vertices' knots: directions of any length above 0 at the
            vertices, for smooth lighting; they turn linearly between knots. Without them faces are flat.
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
    normals: Any = field(default=None, kw_only=True)

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
        uv = None if self.uv is None else check.at_most("uv", check.floats("uv", self.uv, (len(faces), 3, 2)), MAX_UV)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        object.__setattr__(self, "uv", uv)
        if self.normals is not None:
            shapes = {tuple(vertices.shape[-2:]), tuple(vertices.shape)}  # moving normals need moving vertices
            normals = check.floats("normals", self.normals, *sorted(shapes, key=len))
            if (normals.detach() == 0).all(-1).any():
                raise check.fail("normals", "vectors that are not 0", "a vector of zeros")
            object.__setattr__(self, "normals", normals)

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

    def normals_at(self, t: Tensor) -> Tensor:
        """Return (N, V, 3) float64 normals, of any length, at the shutter times `t` (N,); 0 if the mesh has none."""
        if self.normals is None:
            return self.vertices.new_zeros((len(t), self.vertices.shape[-2], 3), dtype=torch.float64)
        normals = self.normals.to(self.vertices.device, torch.float64)
        return normals.expand(len(t), *normals.shape) if normals.ndim == 2 else lerp_knots(normals, t)

    def face_rgb(self) -> Tensor:
        """Return (F, 3) float64 straight linear colour of the faces."""
        return self.material.color.to(self.vertices.device, torch.float64).expand(self.n_faces, 3)

    def face_opacity(self) -> Tensor:
        """Return (F,) float64 opacity of the faces."""
        return self.material.opacity.to(self.vertices.device, torch.float64).expand(self.n_faces)


@dataclass(frozen=True, eq=False)
class Scene:
    """Meshes, a camera, what lights them and what is behind them.

    A face of shading "lambert" shows its colour times (ambient + sum of irradiance / pi * cosine) over the lights: with
    its own normal turned to the viewer, or with the mesh's vertex normals, negated where the eye sees the back of the
    face, from which its corners turn clockwise.
    Faces of shading "unlit" ignore lights and ambient. All faces cast the shadows of lights that cast any.

    Args:
        meshes: any number of meshes, none too.
        camera: sees them; its device must be that of the meshes.
        background: (3,) linear RGB, or an image (H, W, 3) the size of the camera's.
        lights: any number of `PointLight`, `SpotLight`, `DirectionalLight`.
        ambient: (3,) linear RGB of the light that comes equally from everywhere, as radiance.

    Raises:
        TypeError, ValueError: a wrong argument, named; tensors on several devices.
    """

    meshes: list[Mesh] | tuple[Mesh, ...]
    camera: Camera
    background: Any = (0.0, 0.0, 0.0)
    lights: list[Light] | tuple[Light, ...] = field(default=(), kw_only=True)
    ambient: Any = field(default=(0.0, 0.0, 0.0), kw_only=True)

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
        if not isinstance(self.lights, (list, tuple)) or not all(isinstance(light, LIGHTS) for light in self.lights):
            names = ", ".join(kind.__name__ for kind in LIGHTS)
            found = type(self.lights).__name__ if isinstance(self.lights, LIGHTS) else self.lights
            raise check.fail_type("lights", f"a sequence of {names}", found)
        object.__setattr__(self, "lights", tuple(self.lights))
        ambient = check.floats("ambient", self.ambient, (3,))
        if (ambient.detach() < 0).any():
            raise check.fail("ambient", "values of at least 0", f"{float(ambient.detach().min())}")
        object.__setattr__(self, "ambient", ambient)
        device = self.camera.world_to_clip.device
        named = {f"meshes[{i}].vertices": m.vertices for i, m in enumerate(self.meshes)}
        named |= {f"meshes[{i}].faces": m.faces for i, m in enumerate(self.meshes)}
        check.same_device(**{"camera.world_to_clip": self.camera.world_to_clip, **named})
        for i, mesh in enumerate(self.meshes):
            parts = {f"material.{part}": getattr(mesh.material, part) for part in ("color", "opacity", "texture")}
            for part, value in (parts | {"uv": mesh.uv, "normals": mesh.normals}).items():
                if value is not None:
                    _same_device_if_large(f"meshes[{i}].{part}", value, device)
        for i, light in enumerate(self.lights):
            for part, value in light.tensors().items():
                _same_device_if_large(f"lights[{i}].{part}", value, device)
        _same_device_if_large("background", background, device)
        _same_device_if_large("ambient", ambient, device)
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

    def is_still(self, mesh: Mesh) -> bool:
        """Return whether a mesh rests under the camera: no knot of either, nor of its normals, differs from another.

        What has knots and asks for gradients counts as moving: each knot has its own. Source: ours.
        """
        knots = [self.camera.world_to_clip, mesh.vertices, *([] if mesh.normals is None else [mesh.normals])]
        return all(k.ndim == 2 or (not k.requires_grad and bool((k == k[:1]).all())) for k in knots)

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
        rgb = torch.addcmul(premultiplied[..., :3], 1 - alpha, self.background.to(premultiplied))
        return torch.cat([rgb, alpha], dim=-1)

    def tensors(self) -> list[Tensor]:
        """Return all floating tensors of the scene. Source: ours."""
        parts = [self.camera.world_to_clip, self.background, self.ambient]
        for light in self.lights:
            parts += light.tensors().values()
        for mesh in self.meshes:
            parts += [mesh.vertices, mesh.normals, mesh.uv]
            parts += [mesh.material.color, mesh.material.opacity, mesh.material.texture]
        return [part for part in parts if part is not None]

    @property
    def requires_grad(self) -> bool:
        """Whether anything in the scene asks for gradients."""
        return torch.is_grad_enabled() and any(t.requires_grad for t in self.tensors())


def _same_device_if_large(name: str, value: Tensor, device: torch.device) -> None:
    """Raise if an array lies on another device; a single colour or number may come from the CPU (it is a constant)."""
    if value.device != device and (value.ndim > 1 or value.device.type != "cpu" or value.requires_grad):
        raise check.fail(name, f"a tensor on {device}", value)
