"""Samples: a clip's frame rendered into everything that is stored of it.

Before: scenes.py, baselines.  After: writer.py.
Symbols: H, W image size; M meshes. Motions in pixels, x right, y down: p(later) = p(now) + motion.
The sharp image is the instant in the middle of the exposure; depth, motions and ids belong to it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

import torchblur as tb
from datagen.baselines.filters import filter_instant
from datagen.clips import Clip, Exposure, expose, freeze, knot_times
from datagen.knots import MAX_SEGMENTS, TOLERANCE_PX
from datagen.scenes import Plan, build_clip, plan_from_json

UNITS = {
    "colour": "linear RGB; the background is included through what is not covered",
    "motion": "pixels, x right, y down; p(later) = p(earlier) + motion; NaN: behind the camera then; 0: nothing there",
    "forward": "from the opening to the closing of the shutter, of the point visible at the sharp instant",
    "next": "from this frame's sharp instant to the next frame's",
    "previous": "from this frame's sharp instant to the previous frame's",
    "Z": "view depth in scene units of the pixel centre at the sharp instant; inf: nothing there",
    "A": "mean opacity of the meshes over the exposure",
    "sharp.A": "mean opacity of the meshes at the sharp instant",
    "id": "mesh and face number plus 1 of the pixel centre at the sharp instant; 0: nothing there",
    "coverage": "share of the exposure in which a mesh is visible at the pixel, by mesh number",
    "baseline": "linear RGB of a filter of the sharp image, with the settings that `baselines` lists",
    "time": "seconds from the start of the clip",
    "camera": "world to clip, OpenGL convention, column vectors, at equal steps from opening to closing",
}
LIGHT_UNITS = {
    "shadow": "share of the lamps' light due to what the pixel sees over the exposure that no shadow takes away; "
    "1 where none is due",
    "lamps": "places in scene units at equal steps from opening to closing; power in W/sr, of a directional one, which "
    "shines everywhere from position to target, in W/m^2 of what faces it; ambient as radiance",
}


@dataclass(frozen=True, eq=False)
class Sample:
    """One frame: images, their ground truth and what they are."""

    sharp: Tensor  # (H, W, 4) linear RGB and alpha at the exposure's middle
    blurred: Tensor  # (H, W, 4) linear RGB and alpha, mean over the exposure
    motion_px: Tensor  # (H, W, 2) opening to closing
    motion_next_px: Tensor  # (H, W, 2) to the next frame's sharp instant
    motion_previous_px: Tensor  # (H, W, 2) to the previous frame's sharp instant
    depth_view: Tensor  # (H, W) [scene units], inf where nothing is
    mesh_id: Tensor  # (H, W) int64, -1 where nothing is
    face_id: Tensor  # (H, W) int64, -1 where nothing is
    coverage: Tensor  # (H, W, M) share of the exposure
    shadow: Tensor | None  # (H, W) share of the light due that arrives; none without lamps
    meta: dict[str, Any]  # JSON values
    baselines: dict[str, Tensor] = field(default_factory=dict)  # by filter: (H, W, 3) linear RGB
    pictures: dict[str, Tensor] | None = None  # `sharp` and `blur`, (H, W, 3) uint8; none: on the sRGB curve


@dataclass(frozen=True)
class FrameTimes:
    """When a frame's shutter opens and closes and when its neighbours are sharp [s from the start of the clip]."""

    open_s: float
    sharp_s: float
    close_s: float
    previous_s: float
    next_s: float


def frame_times(plan: Plan, frame: int) -> FrameTimes:
    """Return the times of frame number `frame` of a clip: the exposure is centred on frame / fps. Source: ours."""
    fps, half_s = plan.spec.fps, plan.spec.exposure_s / 2
    sharp_s = frame / fps
    return FrameTimes(sharp_s - half_s, sharp_s, sharp_s + half_s, (frame - 1) / fps, (frame + 1) / fps)


def make_sample(plan_json: str, index: int) -> Sample:
    """Return frame number `index` of the data set.

    Args:
        plan_json: what `Plan.to_json` returns; text, so that it can travel to another process.
        index: at least 0; it need not be below the specification's count.

    Raises:
        ValueError: a negative index.
        MeshError: an asset cannot be read any more.

    Source: ours.
    """
    if index < 0:
        raise ValueError(f"index: expected at least 0, got {index}")
    plan = _plan(plan_json)
    clip_number, frame = plan.spec.clip_and_frame(index)
    return render_sample(_clip(plan_json, clip_number), plan, index, frame)


def render_sample(clip: Clip, plan: Plan, index: int, frame: int) -> Sample:
    """Return the sample of one frame of a clip.

    Args:
        clip: who acts.
        plan: size, rate, exposure, rays.
        index: number in the data set, for the metadata.
        frame: number in the clip.

    Source: ours.
    """
    spec, times = plan.spec, frame_times(plan, frame)
    size = (spec.width, spec.height)
    exposure = expose(clip, *size, times.open_s, times.close_s)
    blurred = tb.render(exposure.scene, rays_per_pixel=spec.rays_per_pixel, backend=spec.backend)
    now = tb.render_instant(exposure.scene, t=0.5, rays_per_pixel=spec.rays_per_pixel)
    baselines, settings = filter_instant(exposure.scene, now, spec.baseline_names)
    return Sample(
        sharp=now.rgba,
        blurred=blurred.rgba,
        motion_px=now.motion_px,
        motion_next_px=tb.motion_to(now, freeze(clip, *size, times.next_s), 0.5),
        motion_previous_px=tb.motion_to(now, freeze(clip, *size, times.previous_s), 0.5),
        depth_view=now.depth_view,
        mesh_id=now.mesh_id,
        face_id=now.face_id,
        coverage=blurred.coverage,
        shadow=blurred.shadow,
        meta=_metadata(clip, exposure, plan, index, times)
        | {"counts": dict(sorted(blurred.counts.items())), "plan": blurred.plan.to_dict(), "baselines": settings},
        baselines=baselines,
    )


def _metadata(clip: Clip, exposure: Exposure, plan: Plan, index: int, times: FrameTimes) -> dict[str, Any]:
    """Return what a reader needs to know about the frame, as JSON values."""
    spec, scene = plan.spec, exposure.scene
    clip_number, frame = spec.clip_and_frame(index)
    meshes = [
        {
            "name": mesh.name,
            "faces": mesh.n_faces,
            "segments": knots.segments,
            "chord_error_px": knots.error_px,
            "limit_reached": knots.limit_reached,
        }
        for mesh, knots in zip(scene.meshes, exposure.mesh_knots, strict=True)
    ]
    camera = exposure.camera_knots
    light = {"lamps": _lamp_notes(clip, exposure), "ambient": list(clip.ambient)} if clip.lamps else {}
    return light | {
        "format": 1,
        "index": index,
        "clip": clip_number,
        "frame": frame,
        "seed": spec.seed,
        "config_sha256": plan.config_sha256,
        "torchblur_version": tb.__version__,
        "width": spec.width,
        "height": spec.height,
        "fps": spec.fps,
        "exposure": spec.exposure,
        "exposure_s": spec.exposure_s,
        "time_s": {
            "open": times.open_s,
            "sharp": times.sharp_s,
            "close": times.close_s,
            "previous": times.previous_s,
            "next": times.next_s,
        },
        "rays_per_pixel": spec.rays_per_pixel,
        "backend": spec.backend,
        "camera": {
            "world_to_clip": scene.camera.world_to_clip.reshape(-1, 4, 4).tolist(),
            "near": clip.camera.near,
            "far": clip.camera.far,
            "segments": camera.segments,
            "chord_error_px": camera.error_px,
            "limit_reached": camera.limit_reached,
        },
        "meshes": meshes,
        "chord_tolerance_px": TOLERANCE_PX,
        "max_segments": MAX_SEGMENTS,
        "scene": clip.notes,
        "units": UNITS | (LIGHT_UNITS if clip.lamps else {}),
    }


def _lamp_notes(clip: Clip, exposure: Exposure) -> list[dict[str, Any]]:
    """Return the lamps during an exposure as JSON values."""
    return [
        lamp.notes(knot_times(knots.segments, exposure.open_s, exposure.close_s))
        | {"segments": knots.segments, "chord_error_px": knots.error_px, "limit_reached": knots.limit_reached}
        for lamp, knots in zip(clip.lamps, exposure.lamp_knots, strict=True)
    ]


@functools.lru_cache(maxsize=4)
def _plan(plan_json: str) -> Plan:
    """Return the plan, parsed once per process."""
    return plan_from_json(plan_json)


@functools.lru_cache(maxsize=2)  # the frames of a clip come one after the other
def _clip(plan_json: str, clip_number: int) -> Clip:
    """Return the clip, built once for its frames."""
    return build_clip(_plan(plan_json), clip_number)
