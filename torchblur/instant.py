"""The scene at one instant: colour, alpha, depth, motion and ids, by ordinary rasterisation.

Before: scene.py, surfaces.py.  After: sampling.py, the user.
Symbols: B instants at once, T triangles (faces at instants), n fragments; e_i edge function opposite corner i,
bary_i = e_i / sum e. Owner of a fragment: instant * H * W + pixel. Shares nothing with the interval code but the
camera, the motion of vertices, the appearance of faces, and the rules that make an image unambiguous (edges on a ray,
coplanar faces).
Source: Olano & Greer 1997 (homogeneous rasterisation).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchblur import check, packed
from torchblur.camera import clip_to_px, pixel_rays
from torchblur.scene import Scene
from torchblur.sort import argsort_by, is_tied, reorder_ties
from torchblur.surfaces import Surfaces, build_surfaces

MAX_PAIRS = 2_000_000  # pairs of triangle and pixel looked at together: about 1 GB of working memory
MAX_RAYS = 4096
MIN_W = 1e-300  # against division by zero where a corner is discarded anyway


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


@dataclass(frozen=True)
class _Fragments:
    """Surfaces seen by rays, by owner, nearest first."""

    offsets: Tensor  # (owners + 1,)
    face: Tensor  # (n,) int64 face of the scene
    bary: Tensor  # (3, n) float64
    depth_view: Tensor  # (n,) float64


def render_instant(scene: Scene, t: float = 0.5, *, rays_per_pixel: int = 1) -> Instant:
    """Return the scene at shutter time `t`.

    Args:
        scene: what to render.
        t: shutter time in [0, 1].
        rays_per_pixel: of the colour; depth, motion and ids always are those of the pixel's centre.

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
    camera, device = scene.camera, scene.device
    at = torch.tensor([t], dtype=torch.float64, device=device)
    surfaces = build_surfaces(scene)
    rgba = sum(mean_of_instants(scene, surfaces, at, ray) for ray in pixel_rays(rays_per_pixel)) / rays_per_pixel
    n_pixels = camera.height * camera.width
    face = torch.full((n_pixels,), -1, dtype=torch.int64, device=device)
    bary = torch.zeros(3, n_pixels, dtype=torch.float64, device=device)
    depth = torch.full((n_pixels,), torch.inf, dtype=torch.float64, device=device)
    for fragments in _fragments(scene, surfaces, at, (0.5, 0.5)):
        seen = (surfaces.opacity.detach()[fragments.face] > 0).nonzero().flatten()
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
        rgba=rgba.to(dtype),
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


def mean_of_instants(scene: Scene, surfaces: Surfaces, t: Tensor, ray_px: tuple[float, float]) -> Tensor:
    """Return (H, W, 4) float64, the mean over the instants `t` (B,) of the image through one ray per pixel. Ours."""
    camera = scene.camera
    n_pixels = camera.height * camera.width
    total = torch.zeros(n_pixels, 4, dtype=torch.float64, device=t.device)
    for fragments in _fragments(scene, surfaces, t, ray_px):
        alpha = surfaces.opacity[fragments.face]
        before, after = packed.transmittance(alpha, fragments.offsets)
        light = (before * alpha).unsqueeze(1) * surfaces.rgb[fragments.face]
        rgba = torch.cat([packed.sum_by_owner(light, fragments.offsets), (1 - after).unsqueeze(1)], dim=1)
        total = total + rgba.reshape(-1, n_pixels, 4).sum(0)
    image = (total / len(t)).reshape(camera.height, camera.width, 4)
    alpha = image[..., 3:]
    return torch.cat([image[..., :3] + (1 - alpha) * scene.background.to(image), alpha], dim=-1)


def _fragments(scene: Scene, surfaces: Surfaces, t: Tensor, ray_px: tuple[float, float]):
    """Yield the fragments of the instants `t` (B,), a few instants or a band of faces at a time."""
    camera = scene.camera
    parts = [scene.clip_at(m, t)[:, m.faces] for m in scene.meshes]
    if not parts:
        return
    clip = torch.cat(parts, dim=1)  # (B, F, 3, 4)
    visible = surfaces.opacity.detach() > 0
    if surfaces.opacity.requires_grad:
        visible = torch.ones_like(visible)
    box, count = _boxes(clip.detach().flatten(0, 1), camera.width, camera.height, ray_px)
    count = torch.where(visible.repeat(len(t)), count, 0)
    per_instant = count.reshape(len(t), -1).sum(1)
    first = 0
    running = torch.cumsum(per_instant, 0)
    while first < len(t):
        done = int(running[first - 1]) if first else 0
        last = max(first + 1, int(torch.searchsorted(running, done + MAX_PAIRS, right=True)))
        n_faces = clip.shape[1]
        chosen = slice(first * n_faces, last * n_faces)
        triangles = clip[first:last].flatten(0, 1)
        yield _rasterise(scene, surfaces, (triangles, box[:, chosen], count[chosen]), (t[first:last], ray_px))
        first = last


def _boxes(clip: Tensor, width: int, height: int, ray_px: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Return first column, first row and columns (3, T) of the pixels a triangle (T, 3, 4) may cover, and how many."""
    near = clip[..., 2] + clip[..., 3]
    points, valid = [clip], [near >= 0]
    following = clip.roll(-1, dims=1)
    near_following = near.roll(-1, dims=1)
    apart = (near >= 0) != (near_following >= 0)
    share = near / torch.where(apart, near - near_following, 1.0)
    points.append(clip + share.unsqueeze(-1) * (following - clip))
    valid.append(apart)
    point, ok = torch.cat(points, dim=1), torch.cat(valid, dim=1)
    w = torch.where(ok, point[..., 3], 1.0)
    everywhere = (w <= 0).any(1)
    w = w.clamp(min=MIN_W)
    first, count = [], []
    for axis, size, sign in ((0, width, 1), (1, height, -1)):
        place = (sign * point[..., axis] / w + 1) * (size / 2) - ray_px[axis]
        low = torch.where(ok, place, torch.inf).amin(1)
        high = torch.where(ok, place, -torch.inf).amax(1)
        low = torch.where(everywhere, -torch.inf, low - 1e-6).clamp(0, size).ceil()
        high = torch.where(everywhere, torch.inf, high + 1e-6).clamp(-1, size - 1).floor()
        first.append(low.long())
        count.append((high - low + 1).clamp(min=0).long())
    return torch.stack([*first, count[0]]), count[0] * count[1]


def _rasterise(
    scene: Scene,
    surfaces: Surfaces,
    triangles: tuple[Tensor, Tensor, Tensor],
    instants: tuple[Tensor, tuple[float, float]],
) -> _Fragments:
    """Return the fragments of triangles (T, 3, 4) with their boxes and pixel counts, T = instants * faces."""
    clip, box, count = triangles
    t, ray_px = instants
    camera = scene.camera
    n_faces, n_pixels = len(surfaces.opacity), camera.width * camera.height
    local, triangle = packed.expand(torch.zeros_like(count), count)
    column = box[0][triangle] + local % box[2][triangle]
    row = box[1][triangle] + local // box[2][triangle]
    x_ndc = 2 * (column.to(torch.float64) + ray_px[0]) / camera.width - 1
    y_ndc = 1 - 2 * (row.to(torch.float64) + ray_px[1]) / camera.height
    sign = _inside(clip.detach(), triangle, (x_ndc, y_ndc))
    front_only = surfaces.is_one_sided[triangle % n_faces]
    kept = ((sign != 0) & ~(front_only & (sign < 0))).nonzero().flatten()
    triangle, row, column, x_ndc, y_ndc = (a[kept] for a in (triangle, row, column, x_ndc, y_ndc))
    corner = clip[triangle]  # (n, 3, 4)
    z, w = corner[..., 2].T, corner[..., 3].T
    e = _edge_values(corner[..., 0].T - x_ndc * w, corner[..., 1].T - y_ndc * w)
    bary = e / e.sum(0)
    z_hit, w_hit = (bary * z).sum(0), (bary * w).sum(0)
    kept = ((z_hit + w_hit >= 0) & (w_hit - z_hit >= 0) & torch.isfinite(bary).all(0)).nonzero().flatten()
    z_hit, w_hit, triangle = z_hit[kept], w_hit[kept], triangle[kept]
    owner = (triangle // n_faces) * n_pixels + row[kept] * camera.width + column[kept]
    face = triangle % n_faces
    nearness = 1 / w_hit if camera.is_perspective else 2 - z_hit / w_hit
    order = argsort_by(owner, -nearness.detach())
    tied = is_tied(owner[order], nearness.detach()[order])
    order = reorder_ties(order, tied, surfaces.tie_rank[face])
    depth = w_hit
    if not camera.is_perspective:
        scale = camera.world_to_clip_at(t)[triangle // n_faces][:, 2, :3].norm(dim=1)
        depth = camera.depth_at_near + (z_hit / w_hit + 1) / scale
    offsets = packed.offsets_from_owners(owner[order], len(t) * n_pixels)
    return _Fragments(offsets, face[order], bary[:, kept][:, order], depth[order])


def _edge_values(x: Tensor, y: Tensor) -> Tensor:
    """Return e (3, n) of reduced corners x, y (3, n), e_i opposite corner i."""
    return x.roll(-1, 0) * y.roll(-2, 0) - y.roll(-1, 0) * x.roll(-2, 0)


def _inside(clip: Tensor, triangle: Tensor, ray_ndc: tuple[Tensor, Tensor]) -> Tensor:
    """Return +1 where the ray is inside and the face turns counter-clockwise, -1 where clockwise, 0 outside (n,)."""
    w = clip[:, :, 3].T[:, triangle]
    x = clip[:, :, 0].T[:, triangle] - ray_ndc[0] * w
    y = clip[:, :, 1].T[:, triangle] - ray_ndc[1] * w
    e = _edge_values(x, y)
    if (e == 0).any():  # an edge on the ray counts as if the ray were moved by (eps, eps^2)
        along_x, along_y = _edge_values(y, w), _edge_values(w, x)
        e = torch.where(e != 0, e, torch.where(along_x != 0, along_x, along_y))
    return (e > 0).all(0).long() - (e < 0).all(0).long()
