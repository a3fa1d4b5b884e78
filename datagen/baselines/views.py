"""Views: what an image-space filter knows of a scene, and where it comes from.

Before: nothing.  After: directional.py, mcguire2012.py, guertin2014.py, guertin2015.py.
Symbols: B images, C channels, H, W image size; K instants; s in [0, 1] is shutter time.
Motions in pixels, x right, y down. All of it belongs to the surface that is visible at the centre of each pixel in the
sharp image: what is hidden, transparent or outside the image is not there, which is where all such filters fail.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import torchblur as tb
from torchblur import check

STILL_PX = 0.5  # a point that is displaced by no more than this from the sharp instant counts as still
SHARP_TIME = 0.5  # shutter time of the sharp image


def checked_images(color: Any) -> Tensor:
    """Return images (B, C, H, W) of at least one channel and one pixel; the batch may be empty.

    Raises:
        TypeError, ValueError: another shape or type, NaN or inf.

    Source: ours.
    """
    images = check.floats("color", color, ("B", "C", "H", "W"))
    if 0 in images.shape[1:]:
        raise check.fail("color", "(B, C, H, W) with at least one channel and one pixel", images)
    return images


@dataclass(frozen=True, eq=False)
class View:
    """A batch of sharp images with the motion and depth of what they show.

    Args:
        color: (B, C, H, W) float32 or float64, linear.
        motion_px: (B, 2, H, W) displacement from the opening to the closing of the shutter.
        depth_view: (B, 1, H, W) view depth [scene units] above 0; inf where nothing is.

    Raises:
        TypeError, ValueError: wrong shape, type or device, NaN, or sizes that differ; the argument is named.
    """

    color: Tensor
    motion_px: Tensor
    depth_view: Tensor

    def __post_init__(self) -> None:
        color = checked_images(self.color)
        b, _, h, w = color.shape
        motion = check.floats("motion_px", self.motion_px, (b, 2, h, w))
        depth = _depth("depth_view", self.depth_view, (b, 1, h, w))
        _same_kind(color=color, motion_px=motion, depth_view=depth)
        for name, value in {"color": color, "motion_px": motion, "depth_view": depth}.items():
            object.__setattr__(self, name, value)


@dataclass(frozen=True, eq=False)
class Paths:
    """Where the visible points of a batch of images are at K instants of the exposure, one of them the sharp one.

    Args:
        offset_px: (B, K, 2, H, W) displacement from the pixel's centre; 0 at the sharp instant.
        depth_view: (B, K, H, W) view depth [scene units] above 0; inf where nothing is.
        times: K rising shutter times in [0, 1], 3 or 4 of them, with 0.5 among them.

    Raises:
        TypeError, ValueError: wrong shape, type or device, NaN, or sizes that differ; the argument is named.
    """

    offset_px: Tensor
    depth_view: Tensor
    times: tuple[float, ...] = (0.0, SHARP_TIME, 1.0)

    def __post_init__(self) -> None:
        times = tuple(check.number(f"times[{k}]", t, 0.0, 1.0) for k, t in enumerate(self.times))
        if len(times) not in (3, 4) or list(times) != sorted(set(times)) or SHARP_TIME not in times:
            raise check.fail("times", f"3 or 4 rising shutter times with {SHARP_TIME} among them", str(times))
        offset = check.floats("offset_px", self.offset_px, ("B", len(times), 2, "H", "W"))
        b, k, _, h, w = offset.shape
        depth = _depth("depth_view", self.depth_view, (b, k, h, w))
        _same_kind(offset_px=offset, depth_view=depth)
        if (offset[:, times.index(SHARP_TIME)] != 0).any():
            raise check.fail("offset_px", "0 at the sharp instant", "another displacement")
        for name, value in {"offset_px": offset, "depth_view": depth, "times": times}.items():
            object.__setattr__(self, name, value)

    @property
    def sharp_depth(self) -> Tensor:
        """Depth (B, H, W) at the sharp instant."""
        return self.depth_view[:, self.times.index(SHARP_TIME)]

    @property
    def is_moving(self) -> Tensor:
        """Whether (B, H, W) something is there that leaves its place by more than STILL_PX."""
        far = torch.linalg.vector_norm(self.offset_px.detach(), dim=2).amax(1)
        return (far > STILL_PX) & torch.isfinite(self.depth_view).all(1)


@dataclass(frozen=True, eq=False)
class Layer:
    """A batch of images with their depth.

    Args:
        color: (B, C, H, W) float32 or float64, linear.
        depth_view: (B, 1, H, W) view depth [scene units] above 0; inf where nothing is.

    Raises:
        TypeError, ValueError: wrong shape, type or device, NaN, or sizes that differ; the argument is named.
    """

    color: Tensor
    depth_view: Tensor

    def __post_init__(self) -> None:
        color = checked_images(self.color)
        b, _, h, w = color.shape
        depth = _depth("depth_view", self.depth_view, (b, 1, h, w))
        _same_kind(color=color, depth_view=depth)
        object.__setattr__(self, "color", color)
        object.__setattr__(self, "depth_view", depth)

    def check_fits(self, name: str, color: Tensor) -> None:
        """Raise unless the layer has the shape, type and device of `color`."""
        if self.color.shape != color.shape:
            raise check.fail(name, f"images of {tuple(color.shape)}", self.color)
        _same_kind(color=color, **{name: self.color})


def find_view(scene: tb.Scene, now: tb.Instant) -> tuple[View, int]:
    """Return a batch of one image as the filters see it.

    Args:
        scene: that is blurred.
        now: its sharp image, `render_instant(scene, t=0.5)`.

    Returns:
        The view, and the number of pixels whose motion is not known because the point is behind the camera at the
        opening or the closing; they are left still.

    Source: ours.
    """
    unknown = now.motion_px.isnan().any(-1)
    motion = torch.where(unknown.unsqueeze(-1), 0.0, now.motion_px)
    color = now.rgba[..., :3].permute(2, 0, 1)
    view = View(color.unsqueeze(0), motion.permute(2, 0, 1).unsqueeze(0), now.depth_view[None, None])
    return view, int(unknown.sum())


def find_paths(scene: tb.Scene, now: tb.Instant, times: tuple[float, ...] = (0.0, SHARP_TIME, 1.0)) -> Paths:
    """Return where the visible points of the sharp image `now` of `scene` are at the shutter times `times`.

    Points that are behind the camera at one of them are left still.

    Args:
        scene: that is blurred; its camera must be a perspective one.
        now: its sharp image, `render_instant(scene, t=0.5)`.
        times: see `Paths`.

    Raises:
        ValueError: an orthographic camera.

    Source: ours.
    """
    if not scene.camera.is_perspective:
        raise check.fail("scene", "a perspective camera, whose w is the depth", "an orthographic one")
    offsets, depths = [], []
    for t in times:
        if t == SHARP_TIME:
            offsets.append(torch.zeros_like(now.motion_px))
            depths.append(now.depth_view)
        else:
            offsets.append(tb.motion_to(now, scene, t))
            depths.append(_depth_at(now, scene, t))
    offset, depth = torch.stack(offsets), torch.stack(depths)
    unknown = offset.isnan().any(-1).any(0) | ~(depth > 0).all(0)
    offset = torch.where(unknown.unsqueeze(-1), 0.0, offset)
    depth = torch.where(unknown, now.depth_view, depth)
    return Paths(offset.permute(0, 3, 1, 2).unsqueeze(0), depth.unsqueeze(0), times)


def _depth_at(now: tb.Instant, scene: tb.Scene, t: float) -> Tensor:
    """Return (H, W) the view depth of the visible points at shutter time `t`; inf where nothing is."""
    at = torch.tensor([t], dtype=torch.float64, device=now.mesh_id.device)
    depth = now.depth_view.to(torch.float64)
    for i, mesh in enumerate(scene.meshes):
        row, column = (now.mesh_id == i).nonzero(as_tuple=True)
        w = scene.clip_at(mesh, at)[0][mesh.faces[now.face_id[row, column]]][..., 3]  # (n, 3 corners)
        weight = now.bary[row, column].to(torch.float64)
        weight = torch.cat([1 - weight.sum(1, keepdim=True), weight], dim=1)
        depth = depth.index_put((row, column), (weight * w).sum(1))
    return depth.to(now.depth_view.dtype)


def _depth(name: str, value: Any, shape: tuple[int, ...]) -> Tensor:
    """Return `value` as depths of `shape`: above 0, inf allowed."""
    tensor = check.as_tensor(name, value)
    check.floats(name, torch.where(torch.isposinf(tensor.detach()), 1.0, tensor.detach()), shape)
    if not (tensor.detach() > 0).all():
        raise check.fail(name, "depths above 0", f"{float(tensor.detach().min())}")
    return tensor


def _same_kind(**tensors: Tensor) -> None:
    """Raise unless all tensors share device and dtype."""
    check.same_device(**tensors)
    (first, model), *others = tensors.items()
    for name, tensor in others:
        if tensor.dtype != model.dtype:
            raise check.fail_type(name, f"the {str(model.dtype).removeprefix('torch.')} of {first}", tensor)
