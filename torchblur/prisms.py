"""Turn a scene into prisms: the clip-space triangle at both ends of each linear piece of its motion.

Before: surfaces.py.  After: intervals.py.
Symbols: P prisms, F faces of all meshes; (x, y, z, w) clip space; t shutter time; "open" and "close" are the ends of
a prism's own slice of the exposure. Within a face the corners are stored in a canonical order (by position, then by
time), so that two faces that share an edge compute it from the same numbers in the same order.
Source: Ronnow et al. 2021, sec. 3 (prism); near-clipped bounds, canonical order, segments: ours.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchblur.camera import clip_to_px
from torchblur.scene import Mesh, Scene
from torchblur.surfaces import Surfaces

OPEN_CORNERS = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2))  # (end of the prism, corner)
SAME_KNOT = 1e-12  # of the window; knots of a mesh, the camera and the shutter closer than this are one
BOUND_SLACK_PX = 1e-6  # widening of the bounds against rounding; far above float64 error, far below a pixel


@dataclass(frozen=True)
class Prisms:
    """The moving triangles of a scene under its camera."""

    clip: Tensor  # (2, 3, 4, P) float64: end (open, close), corner in canonical order, x y z w
    t_open: Tensor  # (P,) float64 shutter time at which the prism's slice begins
    t_close: Tensor  # (P,) float64 and ends
    face_of: Tensor  # (P,) int64 face of the scene (all meshes end to end)
    corner_of: Tensor  # (3, P) int64 which corner of the face is stored at each place
    parity: Tensor  # (P,) float64, +1 where the stored corners turn as the face's do, else -1
    is_clipped: Tensor  # (P,) bool: reaches beyond the near or the far plane
    bounds_px: Tensor  # (4, P) float64 x0 y0 x1 y1 of the swept area on screen [px], conservative
    world: Tensor  # (2, 3, 3, P) float64: end, corner, x y z; (2, 3, 3, 0) where the scene has nothing to light
    normal: Tensor  # (2, 3, 3, P) float64 normals at the corners, of any length, 0 where there are none; or as `world`
    corners_px: Tensor  # (2, 6, P) float64 x, y of the corners on screen [px]; NaN where one is behind the near plane
    surfaces: Surfaces  # what the faces look like
    orders_by_w: bool  # depth order by 1 / w, else by z / w
    window: tuple[float, float]  # shutter times between which the prisms lie

    @property
    def count(self) -> int:
        """Number of prisms."""
        return len(self.face_of)

    def choose(self, chosen: Tensor) -> Prisms:
        """Return the prisms `chosen` (C,)."""
        ends = ("clip", "t_open", "t_close", "face_of", "corner_of", "parity", "is_clipped", "bounds_px", "corners_px")
        parts = {name: getattr(self, name)[..., chosen] for name in ends}
        if self.world.shape[-1]:
            parts |= {"world": self.world[..., chosen], "normal": self.normal[..., chosen]}
        return replace(self, **parts)

    def corner_uv(self, prism: Tensor) -> Tensor:
        """Return (2, 3, K) texture coordinates of the corners of prisms `prism` (K,) in their stored order."""
        return self.surfaces.uv[self.face_of[prism], self.corner_of[:, prism]].permute(2, 0, 1)


def build_prisms(scene: Scene, surfaces: Surfaces, window: tuple[float, float]) -> Prisms:
    """Return the prisms of all faces that can be seen in a window of time.

    Args:
        scene: meshes and camera; their motions may have different numbers of knots.
        surfaces: of the same scene.
        window: shutter times to which the prisms are cut.

    Returns:
        Prisms. Left out are only faces of opacity 0 (when opacity asks for no gradient) and prisms that lie
        wholly outside the view. Gradient: to vertices and camera through `clip`.

    Source: Ronnow et al. 2021, sec. 3; segments ours.
    """
    pieces: dict[tuple[float, float], list[tuple[Tensor, ...]]] = {}  # of all meshes, by slice of time
    for i, mesh in enumerate(scene.meshes):
        if mesh.n_faces == 0:
            continue
        is_static = scene.is_still(mesh)
        times = list(window) if is_static else window_times(scene, mesh, window)
        face = torch.arange(mesh.n_faces, device=scene.device) + surfaces.first_face[i]
        if not surfaces.opacity.requires_grad:
            face = face[surfaces.opacity[face] > 0]
        corners = mesh.faces[face - surfaces.first_face[i]]
        at = torch.tensor(times, dtype=torch.float64, device=scene.device)
        clip_vertices = scene.clip_at(mesh, at)
        attributes = [mesh.vertices_at(at), mesh.normals_at(at)] if surfaces.is_lit.any() else []
        for k in range(len(times) - 1):
            clip_open = clip_vertices[k, corners].permute(1, 2, 0)  # (3, 4, F)
            clip_close = clip_open if is_static else clip_vertices[k + 1, corners].permute(1, 2, 0)
            moving = [a[k : k + 2, corners].permute(0, 2, 3, 1) for a in attributes]  # (2, 3, 3, F)
            piece = (torch.stack([clip_open, clip_close]), *moving, face)
            pieces.setdefault((times[k], times[k + 1]), []).append(piece)
    parts = [_no_prisms(scene.device)]
    for times, own in pieces.items():
        *corners, face = (torch.cat(p, dim=-1) for p in zip(*own, strict=True))
        parts.append(_seen(scene, tuple(corners), times, face))
    clip, t_open, t_close, face_of, corner_of, parity, is_clipped, bounds, world, normal, corners_px = (
        torch.cat(p, dim=-1) for p in zip(*parts, strict=True)
    )
    return Prisms(
        clip=clip,
        t_open=t_open,
        t_close=t_close,
        face_of=face_of,
        corner_of=corner_of,
        parity=parity,
        is_clipped=is_clipped,
        bounds_px=bounds,
        world=world,
        normal=normal,
        corners_px=corners_px,
        surfaces=surfaces,
        orders_by_w=scene.camera.orders_by_w,
        window=window,
    )


def window_times(scene: Scene, mesh: Mesh, window: tuple[float, float]) -> list[float]:
    """Return the ends of a window of shutter time and the knots of a mesh's motion between them."""
    times = [window[0]]
    least = SAME_KNOT * (window[1] - window[0])
    for t in scene.knot_times(mesh):
        if t - times[-1] > least and window[1] - t > least:
            times.append(t)
    return [*times, window[1]]


def _no_prisms(device: torch.device) -> tuple[Tensor, ...]:
    """Return the fields of no prisms, in the order of `_seen`."""
    empty = torch.zeros(0, dtype=torch.float64, device=device)
    clip, no_face = empty.reshape(2, 3, 4, 0), empty.long()
    faces = no_face, no_face.reshape(3, 0), empty, empty.bool()
    moving = empty.reshape(2, 3, 3, 0)
    return clip, empty, empty, *faces, empty.reshape(4, 0), moving, moving, empty.reshape(2, 6, 0)


def _seen(scene: Scene, corners: tuple[Tensor, ...], times: tuple[float, float], face_of: Tensor) -> tuple[Tensor, ...]:
    """Return the fields of the prisms of one slice of time that are not wholly outside the view, with their corners in
    canonical order; `corners` are clip space (2, 3, 4, F) and, where there is something to light, world positions and
    normals (2, 3, 3, F).
    """
    clip, *moving = corners
    width, height = scene.camera.width, scene.camera.height
    with torch.no_grad():
        corner_of, parity = canonical_corners(clip)
        near = clip[:, :, 2] + clip[:, :, 3]  # (2, 3, F): inside where >= 0
        far = clip[:, :, 3] - clip[:, :, 2]
        bounds = swept_bounds_px(clip, near, width, height)
        outside = (near < 0).all(0).all(0) | (far < 0).all(0).all(0)
        outside |= (bounds[0] > width) | (bounds[1] > height) | (bounds[2] < 0) | (bounds[3] < 0)
        is_clipped = ((near < 0) | (far < 0)).any(0).any(0)
        kept = (~outside).nonzero().flatten()
        has_hull = ((near >= 0) & (clip[:, :, 3] > 0)).all(0).all(0)
        corners_px = clip_to_px(clip.movedim(2, -1), width, height).movedim(-1, 0).flatten(1, 2)
        corners_px = torch.where(has_hull, corners_px, torch.nan)
    order = corner_of[:, kept].reshape(1, 3, 1, -1)

    def stored(corners: Tensor) -> Tensor:
        return corners[..., kept].gather(1, order.expand(2, 3, corners.shape[2], -1))

    one = torch.ones(len(kept), dtype=torch.float64, device=clip.device)
    return (
        stored(clip),
        times[0] * one,
        times[1] * one,
        face_of[kept],
        corner_of[:, kept],
        parity[kept],
        is_clipped[kept],
        bounds[:, kept],
        *(map(stored, moving) if moving else (clip.new_zeros(2, 3, 3, 0),) * 2),
        corners_px[..., kept],
    )


def canonical_corners(clip: Tensor) -> tuple[Tensor, Tensor]:
    """Return the order of the corners by position, (3, P) int64, and whether it turns as given (+1) or not (-1), (P,).

    By position rather than by index, so that a mesh whose seams double its vertices, and two meshes that meet in one
    edge, abut as one mesh does. Source: ours.
    """
    keys = clip.permute(1, 0, 2, 3).reshape(3, 8, -1)  # corner, number, prism
    less = {(i, j): _less(keys[i], keys[j]) for i in range(3) for j in range(3) if i < j}
    place = [
        (~less[0, 1]).long() + (~less[0, 2]).long(),
        less[0, 1].long() + (~less[1, 2]).long(),
        less[0, 2].long() + less[1, 2].long(),
    ]
    corner_of = torch.argsort(torch.stack(place), dim=0, stable=True)
    even = (corner_of[1] - corner_of[0]) % 3 == 1
    return corner_of, torch.where(even, 1.0, -1.0).to(clip.dtype)


def _less(a: Tensor, b: Tensor) -> Tensor:
    """Return whether `a` (8, P) comes before or equals `b` number by number."""
    first = (a != b).to(torch.uint8).argmax(0, keepdim=True)
    return (a.gather(0, first) <= b.gather(0, first)).squeeze(0)


def swept_bounds_px(clip: Tensor, near: Tensor, width: int, height: int) -> Tensor:
    """Return (4, P) conservative screen bounds x0 y0 x1 y1 [px] of the swept triangles in front of the near plane.

    While all six corners are in front, the swept set lies in the hull of their projections. Otherwise the hull of
    the corners in front and of all pairwise crossings of the near plane is that set exactly.

    Args:
        clip: (2, 3, 4, P).
        near: (2, 3, P) z + w of the corners.
        width, height: image size [px].

    Source: ours.
    """
    points = torch.stack([clip[e, c] for e, c in OPEN_CORNERS])  # (6, 4, P)
    side = torch.stack([near[e, c] for e, c in OPEN_CORNERS])  # (6, P)
    low, high = _extent_px(points, side >= 0, width, height)
    crossing = ((side < 0).any(0) & (side >= 0).any(0)).nonzero().flatten()
    if len(crossing):
        p, g = points[..., crossing], side[:, crossing]
        cut, valid = [], []
        for i, j in itertools.combinations(range(6), 2):
            apart = (g[i] >= 0) != (g[j] >= 0)
            share = g[i] / torch.where(apart, g[i] - g[j], 1.0)
            cut.append(p[i] + share * (p[j] - p[i]))
            valid.append(apart)
        low_cut, high_cut = _extent_px(torch.stack(cut), torch.stack(valid), width, height)
        low[:, crossing] = torch.minimum(low[:, crossing], low_cut)
        high[:, crossing] = torch.maximum(high[:, crossing], high_cut)
    return torch.cat([low - BOUND_SLACK_PX, high + BOUND_SLACK_PX])


def _extent_px(points: Tensor, valid: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Return (2, P) least and greatest screen positions of the valid (K, 4, P) points; all of it where w fails."""
    w = points[:, 3]
    unsafe = (valid & ~(w > 0)).any(0)  # a matrix whose near plane does not imply w > 0: take the whole line
    safe = torch.where(valid & (w > 0), w, 1.0)
    position = torch.stack([(points[:, 0] / safe + 1) * (width / 2), (1 - points[:, 1] / safe) * (height / 2)], dim=1)
    mask = valid.unsqueeze(1)
    low = torch.where(mask, position, torch.inf).amin(0)
    high = torch.where(mask, position, -torch.inf).amax(0)
    return torch.where(unsafe, -torch.inf, low), torch.where(unsafe, torch.inf, high)
