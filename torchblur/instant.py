"""The scene at one instant: colour, alpha, depth, motion and ids.

Before: fragments.py.  After: sampling.py, the user.
Symbols: B instants at once; bary_i barycentrics of a face's corners.
Source: ours; the displacement of a visible point is that of its barycentrics.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import check, packed
from torchblur.backends import choose_backend
from torchblur.camera import CENTRE, MAX_RAYS, Ray, clip_to_px, pixel_rays
from torchblur.fragments import Fragments, find_fragments
from torchblur.scene import Scene
from torchblur.shading import Points, look, needing_points
from torchblur.shadows import with_shadows
from torchblur.surfaces import Surfaces, build_surfaces


@dataclass(frozen=True)
class Instant:
    """An image of one instant, and the ground truth of what is visible at the centres of its pixels.

    The visible surface is the first one along the ray whose opacity is not 0.
    """

    rgba: Tensor  # (H, W, 4) linear: RGB is what the pixel sees, background included; A the meshes' opacity
    depth_view: Tensor  # (H, W) view depth [scene units]; inf where nothing is visible
    motion_px: Tensor  # (H, W, 2) x right, y down [px]: of the visible point, from shutter time 0 to 1; 0 if none
    motion_to_open_px: Tensor  # (H, W, 2) from this instant to shutter time 0; NaN if the point is behind the camera
    motion_to_close_px: Tensor  # (H, W, 2) from this instant to shutter time 1
    mesh_id: Tensor  # (H, W) int64 index of the mesh; -1 where nothing is visible
    face_id: Tensor  # (H, W) int64 index of the face in its mesh; -1
    bary: Tensor  # (H, W, 2) barycentrics of the face's corners 1 and 2 at the visible point; 0 if none


def render_instant(scene: Scene, t: float = 0.5, *, rays_per_pixel: int = 1, backend: str = "auto") -> Instant:
    """Return the scene at shutter time `t`.

    Args:
        scene: what to render.
        t: shutter time in [0, 1].
        rays_per_pixel: of the colour; depth, motion and ids always are those of the pixel's centre.
        backend: "torch", "cpu" (compiled), or "auto"; see `backends.choose_backend`. The results are the same.

    Returns:
        An `Instant` on the scene's device, in its floating type.

    Raises:
        TypeError, ValueError: a wrong argument, named.

    Gradient: to colour, opacity and background; depth and motion carry those of vertices and camera.
    Source: ours; motion is the exact displacement of the visible material point.
    """
    if not isinstance(scene, Scene):
        raise check.fail_type("scene", "a Scene", scene)
    check.number("t", t, 0.0, 1.0)
    check.positive_int("rays_per_pixel", rays_per_pixel, MAX_RAYS)
    backend = choose_backend(scene, backend)
    camera, device = scene.camera, scene.device
    at = torch.tensor([t], dtype=torch.float64, device=device)
    surfaces = build_surfaces(scene)
    once = torch.full((1, 1), 1 / rays_per_pixel, dtype=torch.float64, device=device)
    sum_them, find = instants_by(backend, surfaces)
    meshes_only = sum(sum_them(scene, surfaces, at, once, ray) for ray in pixel_rays(rays_per_pixel))
    n_pixels = camera.height * camera.width
    face = torch.full((n_pixels,), -1, dtype=torch.int64, device=device)
    bary = torch.zeros(3, n_pixels, dtype=torch.float64, device=device)
    depth = torch.full((n_pixels,), torch.inf, dtype=torch.float64, device=device)
    for fragments in find(scene, surfaces, at, CENTRE):
        alpha = look(surfaces, fragments.face, *_points(scene, surfaces, fragments)).alpha
        seen = (alpha.detach() > 0).nonzero().flatten()
        owner, count = torch.unique_consecutive(packed.owners(fragments.offsets)[seen], return_counts=True)
        first = seen[packed.offsets_from_counts(count)[:-1]]
        face = face.index_put((owner,), fragments.face[first])
        bary = bary.index_put((torch.arange(3, device=device).unsqueeze(1), owner), fragments.bary[:, first])
        depth = depth.index_put((owner,), fragments.depth_view[first])
    mesh_id = torch.where(face >= 0, surfaces.mesh_of[face] if len(surfaces.mesh_of) else face, -1)
    first_face = torch.tensor([*surfaces.first_face, 0], device=device)
    face_id = torch.where(face >= 0, face - first_face[mesh_id], -1)
    shape = (camera.height, camera.width)
    mesh_id, face_id = mesh_id.reshape(shape), face_id.reshape(shape)
    bary = bary[1:].T.reshape(*shape, 2)
    to_open, to_close = (_displacement_px(scene, (mesh_id, face_id, bary), s) for s in (0.0, 1.0))
    dtype = scene.dtype
    return Instant(
        rgba=scene.over_background(meshes_only).to(dtype),
        depth_view=depth.reshape(shape).to(dtype),
        motion_px=(to_close - to_open).to(dtype),
        motion_to_open_px=to_open.to(dtype),
        motion_to_close_px=to_close.to(dtype),
        mesh_id=mesh_id,
        face_id=face_id,
        bary=bary.to(dtype),
    )


def motion_to(now: Instant, scene: Scene, t: float) -> Tensor:
    """Return how far each visible point moves on screen to its place in another scene, or at another time.

    Args:
        now: an instant of the same meshes and faces.
        scene: where they are later, such as the scene of the next frame of a clip; same image size.
        t: shutter time of `scene`, in [0, 1].

    Returns:
        (H, W, 2) displacement [px], x right, y down; 0 where nothing is visible, NaN where the point is behind the
        camera at that time.

    Raises:
        TypeError, ValueError: a wrong argument, named; meshes or image size that cannot be the same.

    Source: ours.
    """
    if not isinstance(now, Instant):
        raise check.fail_type("now", "an Instant", now)
    if not isinstance(scene, Scene):
        raise check.fail_type("scene", "a Scene", scene)
    check.number("t", t, 0.0, 1.0)
    size = (scene.camera.height, scene.camera.width)
    if now.mesh_id.shape != size:
        raise check.fail(
            "scene", f"a camera of {now.mesh_id.shape[1]}x{now.mesh_id.shape[0]} px", f"{size[1]}x{size[0]}"
        )
    check.same_device(now=now.mesh_id, scene=scene.camera.world_to_clip)
    for i in torch.unique(now.mesh_id).tolist():
        if i >= len(scene.meshes):
            raise check.fail("scene", f"at least {i + 1} meshes, as in `now`", f"{len(scene.meshes)}")
        n_faces = int(now.face_id[now.mesh_id == i].max()) + 1 if i >= 0 else 0
        if i >= 0 and scene.meshes[i].n_faces < n_faces:
            raise check.fail(f"meshes[{i}]", f"at least {n_faces} faces, as in `now`", f"{scene.meshes[i].n_faces}")
    ids = now.mesh_id, now.face_id, now.bary.to(torch.float64)
    return _displacement_px(scene, ids, t).to(now.motion_px.dtype)


def _displacement_px(scene: Scene, visible: tuple[Tensor, Tensor, Tensor], t: float) -> Tensor:
    """Return (H, W, 2) float64 from the pixels' centres to the visible points' places at shutter time `t`."""
    mesh_id, face_id, bary = visible
    h, w = mesh_id.shape
    at = torch.tensor([t], dtype=torch.float64, device=mesh_id.device)
    out = torch.zeros(h, w, 2, dtype=torch.float64, device=mesh_id.device)
    for i, mesh in enumerate(scene.meshes):
        row, column = (mesh_id == i).nonzero(as_tuple=True)
        if len(row) == 0:
            continue
        corners = scene.clip_at(mesh, at)[0][mesh.faces[face_id[row, column]]]  # (n, 3, 4)
        weight = bary[row, column]
        weight = torch.cat([1 - weight.sum(1, keepdim=True), weight], dim=1)
        place = clip_to_px((weight.unsqueeze(2) * corners).sum(1), w, h)
        centre = torch.stack([column, row], dim=1).to(torch.float64) + 0.5
        out = out.index_put((row, column), place - centre)
    return out


def instants_by(backend: str, surfaces: Surfaces) -> tuple[Callable[..., Tensor], Callable[..., Iterator[Fragments]]]:
    """Return what does the work of `sum_of_instants` and `find_fragments` in "torch" or "cpu".

    Where looks are not compiled, what is visible is found by compiled code and looked at by torch. Source: ours.
    """
    if backend == "torch":
        return sum_of_instants, find_fragments
    from torchblur.cpu import instant as compiled  # slow to import

    if compiled.compiles_looks(surfaces):
        return compiled.sum_of_instants, compiled.find_fragments
    return functools.partial(sum_of_instants, find=compiled.find_fragments), compiled.find_fragments


def sum_of_instants(
    scene: Scene,
    surfaces: Surfaces,
    t: Tensor,
    weight: Tensor,
    ray: Ray,
    *,
    find: Callable[..., Iterator[Fragments]] | None = None,
) -> Tensor:
    """Return (H, W, 4) float64, the weighted sum of the meshes' premultiplied colour and opacity at the instants.

    Args:
        scene: what to look at.
        surfaces: of its faces.
        t: (B,) shutter times.
        weight: (B, H * W) or (B, 1).
        ray: place of the ray inside each pixel.
        find: finds the fragments; `find_fragments` if None.

    Source: ours.
    """
    camera = scene.camera
    n_pixels = camera.height * camera.width
    total = torch.zeros(n_pixels, 4, dtype=torch.float64, device=t.device)
    for fragments in (find or find_fragments)(scene, surfaces, t, ray):
        which, points = _points(scene, surfaces, fragments)
        seen = look(surfaces, fragments.face, which, with_shadows(surfaces, points))
        before, after = packed.transmittance(seen.alpha, fragments.offsets)
        light = (before * seen.alpha).unsqueeze(1) * seen.rgb
        rgba = torch.cat([packed.sum_by_owner(light, fragments.offsets), (1 - after).unsqueeze(1)], dim=1)
        total = total + (rgba.reshape(-1, n_pixels, 4) * weight.unsqueeze(2)).sum(0)
    return total.reshape(camera.height, camera.width, 4)


def _points(scene: Scene, surfaces: Surfaces, fragments: Fragments) -> tuple[Tensor, Points]:
    """Return which (J,) of the fragments need points, and these."""
    which = needing_points(surfaces, fragments.face)
    face, t = fragments.face[which], fragments.t[which]
    world = normal = fragments.bary.new_zeros(3, 3, 0)
    if surfaces.is_lit[face].any():
        world, normal = _corners_world(scene, surfaces, face, t)
    mips = which if fragments.slope.shape[-1] else which[:0]
    one = torch.ones_like(t)
    return which, Points(
        face=face,
        weight=fragments.bary[:, which],
        slope=fragments.slope[..., mips],
        uv=surfaces.uv[face].permute(2, 1, 0),
        world=world,
        normal=normal,
        turn=one,
        side=fragments.side[which],
        t=t,
    )


def _corners_world(scene: Scene, surfaces: Surfaces, face: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return positions and normals (3 corners, 3, n) of the corners of `face` (n,) at shutter times `t` (n,)."""
    times, place = torch.unique(t, return_inverse=True)
    mesh_of = surfaces.mesh_of[face]
    world = torch.zeros(len(face), 3, 3, dtype=torch.float64, device=face.device)
    normal = world
    for i in torch.unique(mesh_of).tolist():
        mesh, own = scene.meshes[i], (mesh_of == i).nonzero().flatten()
        corner = mesh.faces[face[own] - surfaces.first_face[i]]
        instant = place[own].unsqueeze(1)
        world = world.index_put((own,), mesh.vertices_at(times)[instant, corner])
        normal = normal.index_put((own,), mesh.normals_at(times)[instant, corner])
    return world.permute(1, 2, 0), normal.permute(1, 2, 0)
