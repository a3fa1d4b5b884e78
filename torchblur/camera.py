"""Camera: world space to clip space, clip space to pixels, and where the rays of a pixel are.

Before: nothing.  After: scene.py.
Symbols: (x, y, z, w) clip space in the OpenGL convention (-w <= x, y, z <= w, the camera looks down -z);
ndc = clip / w, y up; px = screen, x right, y down, the centre of pixel (i, j) at (i + 0.5, j + 0.5).
Source: the OpenGL clip convention.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchblur import check

MAX_SIZE_PX = 32768  # a side; keeps (pixel, prism) indices of one block far inside int64 and guards against slips
AFFINE = 1e-5  # rows of w smaller than this share of the rows of z are those of an orthographic camera, rounded


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera, static or moving, given by its matrix at equally spaced shutter times.

    Between two knots the entries of the matrix move linearly, so a rotating camera needs several knots.
    Keep the scale of w the same at all knots (w = view depth): the timing along a chord depends on it.

    Args:
        world_to_clip: (4, 4) static or (K+1, 4, 4) float, for column vectors, OpenGL clip convention.
        width, height: image size [px].
        depth_at_near: view depth of the near plane of an orthographic camera [scene units]; a perspective matrix
            carries its own depth in w, and this is ignored there.

    Raises:
        TypeError, ValueError: wrong shape or type, NaN or inf, or a matrix that maps everything to w = 0.
    """

    world_to_clip: Tensor
    width: int
    height: int
    depth_at_near: float = 0.0

    def __post_init__(self) -> None:
        matrix = check.floats("world_to_clip", self.world_to_clip, (4, 4), ("K+1", 4, 4))
        if matrix.ndim == 3 and len(matrix) < 2:
            raise check.fail("world_to_clip", "(4, 4), or (K+1, 4, 4) with at least 2 knots", matrix)
        if (matrix.detach()[..., 3, :] == 0).all(-1).any():
            raise check.fail("world_to_clip", "a last row that is not all zero", "a row of zeros")
        object.__setattr__(self, "world_to_clip", matrix)
        object.__setattr__(self, "width", check.positive_int("width", self.width, MAX_SIZE_PX))
        object.__setattr__(self, "height", check.positive_int("height", self.height, MAX_SIZE_PX))
        object.__setattr__(self, "depth_at_near", check.number("depth_at_near", self.depth_at_near))

    @property
    def n_segments(self) -> int:
        """Number of linear pieces of the motion; 0 if static."""
        return len(self.world_to_clip) - 1 if self.world_to_clip.ndim == 3 else 0

    @property
    def is_perspective(self) -> bool:
        """Whether w is the view depth, rather than 1 up to rounding, at every knot."""
        matrix = self.world_to_clip.detach()
        return bool((matrix[..., 3, :3].norm(dim=-1) > AFFINE * matrix[..., 2, :3].norm(dim=-1)).all())

    @property
    def orders_by_w(self) -> bool:
        """Whether 1 / w tells surfaces along a ray apart better than z / w does, at every knot.

        With z = a w + b, b < 0, as projections have it, w spans a factor of (a + 1) / (a - 1) between the clip
        planes: from a factor of 2 on, 1 / w is the better key, below it z / w, which orders any matrix.
        """
        row_z, row_w = self.world_to_clip.detach().to(torch.float64)[..., 2:, :].unbind(-2)
        slope = (row_z[..., :3] * row_w[..., :3]).sum(-1) / row_w[..., :3].square().sum(-1)
        offset = row_z[..., 3] - slope * row_w[..., 3]
        return self.is_perspective and bool(((slope > 1 - AFFINE) & (slope <= 3) & (offset < 0)).all())

    @property
    def handedness(self) -> float:
        """+1 where what turns counter-clockwise on screen does so seen from the eye, -1 in a mirrored image."""
        matrix = self.world_to_clip.detach().to(torch.float64).reshape(-1, 4, 4)[0]
        return -1.0 if torch.linalg.det(matrix) > 0 else 1.0  # view space is right-handed, NDC left-handed

    def world_to_clip_at(self, t: Tensor) -> Tensor:
        """Return (N, 4, 4) float64 matrices at the shutter times `t` (N,): linear between the knots."""
        matrix = self.world_to_clip.to(torch.float64)
        if matrix.ndim == 2:
            return matrix.expand(len(t), 4, 4)
        return lerp_knots(matrix, t)

    @classmethod
    def look_at(  # noqa: PLR0913  the field's own signature for a camera
        cls,
        eye: Any,
        target: Any,
        up: Any = (0.0, 1.0, 0.0),
        *,
        fov_y_deg: float,
        width: int,
        height: int,
        near: float,
        far: float,
    ) -> Camera:
        """Return a perspective camera; any of `eye`, `target`, `up` may move.

        Args:
            eye, target, up: (3,) or (K+1, 3) floats [scene units]; the moving ones must agree in K.
            fov_y_deg: vertical field of view [degrees], in (0, 180).
            width, height: image size [px]; pixels are square.
            near, far: view depths of the clip planes [scene units], 0 < near < far.

        Raises:
            TypeError, ValueError: a wrong argument, named.

        Example:
            >>> Camera.look_at((0, 0, 5), (0, 0, 0), fov_y_deg=40, width=64, height=48, near=0.1, far=50).n_segments
            0
        """
        check.number("fov_y_deg", fov_y_deg, 1e-3, 180 - 1e-3)
        check.positive_int("width", width, MAX_SIZE_PX)
        check.positive_int("height", height, MAX_SIZE_PX)
        check.number("near", near, 1e-12)
        check.number("far", far, 1e-12)
        if not far > near:
            raise check.fail("far", f"a number above near = {near:g}", far)
        view = _view_matrix(eye, target, up)
        focal = 1.0 / math.tan(math.radians(fov_y_deg) / 2)
        proj = torch.zeros(4, 4, dtype=torch.float64, device=view.device)
        proj[0, 0], proj[1, 1] = focal * height / width, focal
        proj[2, 2], proj[2, 3] = (far + near) / (near - far), 2 * far * near / (near - far)
        proj[3, 2] = -1.0
        return cls(proj @ view, width, height)

    @classmethod
    def orthographic(  # noqa: PLR0913  the twin of look_at
        cls,
        eye: Any,
        target: Any,
        up: Any = (0.0, 1.0, 0.0),
        *,
        height_world: float,
        width: int,
        height: int,
        near: float,
        far: float,
    ) -> Camera:
        """Return an orthographic camera that sees `height_world` [scene units] from top to bottom.

        Args:
            eye, target, up: as in `look_at`.
            height_world: height of the view [scene units]; pixels are square.
            width, height: image size [px].
            near, far: view depths of the clip planes [scene units], near < far; they may be negative. Faces that are
                nearer to each other than 1e-11 of far - near count as coplanar.

        Raises:
            TypeError, ValueError: a wrong argument, named.
        """
        check.number("height_world", height_world, 1e-12)
        check.positive_int("width", width, MAX_SIZE_PX)
        check.positive_int("height", height, MAX_SIZE_PX)
        check.number("near", near)
        check.number("far", far)
        if not far > near:
            raise check.fail("far", f"a number above near = {near:g}", far)
        view = _view_matrix(eye, target, up)
        proj = torch.eye(4, dtype=torch.float64, device=view.device)
        proj[1, 1] = 2.0 / height_world
        proj[0, 0] = proj[1, 1] * height / width
        proj[2, 2], proj[2, 3] = 2.0 / (near - far), (far + near) / (near - far)
        return cls(proj @ view, width, height, depth_at_near=near)


def _view_matrix(eye: Any, target: Any, up: Any) -> Tensor:
    """Return world → view as (4, 4) or (K+1, 4, 4) float64; right-handed, looking down -z."""
    parts = {"eye": eye, "target": target, "up": up}
    tensors = {n: check.floats(n, v, (3,), ("K+1", 3)).to(torch.float64) for n, v in parts.items()}
    check.same_device(**tensors)
    knots = {n: len(v) for n, v in tensors.items() if v.ndim == 2}
    if len(set(knots.values())) > 1 or 1 in knots.values():
        raise check.fail("eye, target, up", "one number of knots, at least 2, among the moving ones", str(knots))
    eye_w, target_w, up_w = torch.broadcast_tensors(*tensors.values())
    back = eye_w - target_w
    distance = back.norm(dim=-1, keepdim=True)
    right = torch.linalg.cross(up_w, back, dim=-1)
    size = right.norm(dim=-1, keepdim=True)
    if (distance == 0).any():
        raise check.fail("target", "a point away from the eye", "the eye itself")
    if (size <= 1e-9 * distance * up_w.norm(dim=-1, keepdim=True)).any():
        raise check.fail("up", "a direction not along the line of sight", "one along it")
    back, right = back / distance, right / size
    rows = torch.stack([right, torch.linalg.cross(back, right, dim=-1), back], dim=-2)
    offset = -(rows @ eye_w.unsqueeze(-1))
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64, device=rows.device).expand(*rows.shape[:-2], 1, 4)
    return torch.cat([torch.cat([rows, offset], dim=-1), last], dim=-2)


def lerp_knots(knots: Tensor, t: Tensor) -> Tensor:
    """Return (N, ...) values at the shutter times `t` (N,) of `knots` (K+1, ...), equally spaced and linear between.

    At a knot the value is that of the knot, bit for bit. Source: ours.
    """
    n_segments = len(knots) - 1
    scaled = t.to(knots.dtype) * n_segments
    nearest = scaled.round()
    scaled = torch.where((scaled - nearest).abs() <= 1e-12 * n_segments, nearest, scaled)
    first = scaled.floor().clamp(0, n_segments - 1)
    local = (scaled - first).reshape(-1, *[1] * (knots.ndim - 1))
    index = first.long()
    return knots[index] * (1 - local) + knots[index + 1] * local


def project_world(vertices_world: Tensor, world_to_clip: Tensor) -> Tensor:
    """Return clip-space (..., V, 4) of world points (..., V, 3) under matrices (..., 4, 4), all float64.

    Written out component by component: a matrix product may round equal points differently in different rows, and
    equal points must stay equal bit for bit, or neighbours that share an edge would not abut. Source: ours.
    """
    x, y, z = vertices_world.unbind(-1)
    m = world_to_clip.unsqueeze(-3)  # (..., 1, 4, 4)
    rows = [x * m[..., r, 0] + y * m[..., r, 1] + z * m[..., r, 2] + m[..., r, 3] for r in range(4)]
    return torch.stack(rows, dim=-1)


def clip_to_px(clip: Tensor, width: int, height: int) -> Tensor:
    """Return screen positions (..., 2) [px] of clip-space points (..., 4); NaN where w <= 0 (behind the camera)."""
    w = clip[..., 3]
    in_front = w > 0
    safe = torch.where(in_front, w, torch.ones_like(w))
    x_px = (clip[..., 0] / safe + 1) * (width / 2)
    y_px = (1 - clip[..., 1] / safe) * (height / 2)
    return torch.where(in_front.unsqueeze(-1), torch.stack([x_px, y_px], dim=-1), torch.nan)


MAX_RAYS = 4096  # a pixel


class Ray(NamedTuple):
    """The place of a ray inside its pixel, and the side of the square that it stands for."""

    x_px: float
    y_px: float
    spacing_px: float


CENTRE = Ray(0.5, 0.5, 1.0)


def pixel_rays(n: int) -> list[Ray]:
    """Return `n` places inside the pixel, in [0, 1): the centre for 1, else Hammersley points about the centre.

    The set's mean is the centre exactly, so that no image is shifted. Source: the Hammersley point set.
    """
    xs = [(k + 0.5) / n for k in range(n)]
    ys = [_radical_inverse(k) for k in range(n)]
    mean = sum(ys) / n
    return [Ray(x, y - mean + 0.5, n**-0.5) for x, y in zip(xs, ys, strict=True)]


def _radical_inverse(k: int) -> float:
    """Return the bits of `k` mirrored about the binary point (van der Corput, base 2)."""
    value, digit = 0.0, 0.5
    while k:
        value += digit * (k & 1)
        k, digit = k >> 1, digit / 2
    return value
