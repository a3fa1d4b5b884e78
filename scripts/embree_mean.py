"""A mean of sharp images that a ray tracer makes: Embree, one ray a pixel, for opaque faces of plain colours.

An opponent from elsewhere for `benchmark.py`: the rays, the instants and the colours are those of `tb.accumulate`, and
so is the result, but for rays that graze an edge. Its Python binding casts on one thread.
"""

from __future__ import annotations

import embreex.mesh_construction
import embreex.rtcore_scene
import torch
from torch import Tensor

import torchblur as tb


def can_trace(scene: tb.Scene) -> bool:
    """Return whether `embree_mean` can make the image: opaque plain colours before a camera at rest."""
    looks = [m.material for m in scene.meshes]
    is_plain = all(k.texture is None and k.shading == "unlit" and k.double_sided for k in looks)
    is_opaque = all(bool((m.face_opacity() == 1).all()) for m in scene.meshes)
    return is_plain and is_opaque and scene.camera.world_to_clip.ndim == 2 and scene.camera.is_perspective


def embree_mean(scene: tb.Scene, times: int) -> Tensor:
    """Return (H, W, 4) the mean of sharp images at the midpoints of equal parts of the exposure.

    Args:
        scene: what to render; see `can_trace`.
        times: number of sharp images.
    """
    origin, direction = _rays(scene.camera)
    colours = torch.cat([m.face_rgb() for m in scene.meshes]).double()
    rgba = torch.cat([colours, torch.ones(len(colours), 1, dtype=torch.float64)], dim=1)
    rgba = torch.cat([rgba, torch.zeros(1, 4, dtype=torch.float64)])  # the last, for rays that meet nothing
    total = torch.zeros(len(direction), 4, dtype=torch.float64)
    for k in range(times):
        t = torch.tensor([(k + 0.5) / times], dtype=torch.float64)
        corners = torch.cat([m.vertices_at(t)[0][m.faces] for m in scene.meshes])
        traced = embreex.rtcore_scene.EmbreeScene()
        embreex.mesh_construction.TriangleMesh(traced, corners.float().numpy())
        face = torch.from_numpy(traced.run(origin.numpy(), direction.numpy()))
        total += rgba[face.long()]
    image = (total / times).reshape(scene.camera.height, scene.camera.width, 4)
    return scene.over_background(image).to(scene.dtype)


def _rays(camera: tb.Camera) -> tuple[Tensor, Tensor]:
    """Return (H W, 3) float32 origins and directions of the rays through the centres of the pixels."""
    inverse = torch.linalg.inv(camera.world_to_clip.double())
    x = 2 * (torch.arange(camera.width, dtype=torch.float64) + 0.5) / camera.width - 1
    y = 1 - 2 * (torch.arange(camera.height, dtype=torch.float64) + 0.5) / camera.height
    y, x = torch.meshgrid(y, x, indexing="ij")
    ends = []
    for z in (0.0, 1.0):  # on the near plane and on the far one
        place = torch.stack([x, y, torch.full_like(x, z), torch.ones_like(x)], dim=-1) @ inverse.T
        ends.append((place[..., :3] / place[..., 3:]).reshape(-1, 3))
    near, far = ends
    return near.float().contiguous(), (far - near).float().contiguous()
