"""Writer: a sample as one multi-part EXR and two PNGs, each there as a whole or not at all (the only door to OpenEXR).

Before: samples.py.  After: manifest.py and shards.py list what is finished; dataset.py reads with `decode_exr`.
Symbols: H, W image size. Parts of the EXR, ZIP-compressed, which carries a checksum:
`sharp` R G B A and `blurred` R G B in half; `data` in float32 (ids in uint32), with `shadow` where lamps shine;
`coverage` one float32 channel a mesh; `baseline.NAME` R G B in half for each filter that was asked for.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import OpenEXR
from torch import Tensor

from datagen.colour import bytes_from_linear
from datagen.pictures import encode_png
from datagen.samples import Sample

META_NAME = "torchblur:meta"
TEMPORARY_PREFIX = ".tmp-"
FOLDERS = ("frames", "sharp", "blur")
HALF_MAX = 65504.0
_counter = itertools.count()


class FrameFileError(ValueError):
    """A stored frame that cannot be read, and why."""


def frame_paths(index: int) -> dict[str, str]:
    """Return the relative paths of a frame's files: `exr`, `sharp` and `blur`, equal but for folder and suffix.

    Source: ours.
    """
    name = f"{index:08d}"
    return {"exr": f"frames/{name}.exr", "sharp": f"sharp/{name}.png", "blur": f"blur/{name}.png"}


def write_frame(folder: str | Path, index: int, sample: Sample) -> dict[str, Any]:
    """Write a sample's three files and return the manifest's entry for it.

    Args:
        folder: of the data set; its sub-folders exist.
        index: number of the frame.
        sample: what to write.

    Raises:
        OSError: the disk is full or not writable; nothing half written bears a final name.
        ValueError: a colour beyond what half floats hold.

    Source: ours.
    """
    paths = frame_paths(index)
    files = []
    for kind, data in frame_contents(sample).items():
        write_atomically(Path(folder) / paths[kind], data)
        files.append(list_file(paths[kind], data))
    return frame_entry(index, sample, files)


def frame_contents(sample: Sample) -> dict[str, bytes]:
    """Return the bytes of a frame's files: `exr`, `sharp` and `blur`.

    Raises:
        ValueError: a colour beyond what half floats hold.

    Source: ours.
    """
    images = {"sharp": sample.sharp, "blur": sample.blurred}
    pictures = sample.pictures or {name: bytes_from_linear(image[..., :3]) for name, image in images.items()}
    return {
        "exr": encode_exr(sample_parts(sample), sample.meta),
        "sharp": encode_png(pictures["sharp"].numpy()),
        "blur": encode_png(pictures["blur"].numpy()),
    }


def list_file(path: str, data: bytes) -> dict[str, Any]:
    """Return how a list names a file. Source: ours."""
    return {"path": path, "sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}


def frame_notes(sample: Sample) -> dict[str, list[str]]:
    """Return what a list says of a frame beside its files: the effects called for and its baselines. Source: ours."""
    effects = [name for name, effect in sample.meta["plan"]["effects"].items() if effect["needed"]]
    return {"effects": effects} | baselines_entry(tuple(sample.baselines))


def baselines_entry(names: tuple[str, ...]) -> dict[str, list[str]]:
    """Return what a list's entry of a frame says of its baselines: nothing if there are none. Source: ours."""
    return {"baselines": list(names)} if names else {}


def frame_entry(index: int, sample: Sample, files: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a list's entry for a frame. Source: ours."""
    what = {name: sample.meta[name] for name in ("clip", "frame", "config_sha256")}
    return {"index": index, **what, **frame_notes(sample), "files": files}


def sample_parts(sample: Sample) -> dict[str, dict[str, np.ndarray]]:
    """Return the parts of a sample's EXR as {part: {channel: (H, W) array}}.

    Raises:
        ValueError: a colour beyond what half floats hold.

    Source: ours.
    """
    motions = {"forward": sample.motion_px, "next": sample.motion_next_px, "previous": sample.motion_previous_px}
    data = {f"{name}.{c}": _float(value[..., k]) for name, value in motions.items() for k, c in enumerate("uv")}
    data |= {"Z": _float(sample.depth_view), "A": _float(sample.blurred[..., 3])}
    data |= {"id.mesh": _id(sample.mesh_id), "id.face": _id(sample.face_id)}
    data |= {} if sample.shadow is None else {"shadow": _float(sample.shadow)}
    parts = {
        "sharp": {c: _half("sharp", sample.sharp[..., k]) for k, c in enumerate("RGBA")},
        "blurred": {c: _half("blurred", sample.blurred[..., k]) for k, c in enumerate("RGB")},
        "data": data,
    }
    if sample.coverage.shape[-1]:  # a part without channels cannot be stored
        parts["coverage"] = {f"mesh.{m:04d}": _float(sample.coverage[..., m]) for m in range(sample.coverage.shape[-1])}
    for name, image in sample.baselines.items():
        part = f"baseline.{name}"
        parts[part] = {c: _half(part, image[..., k]) for k, c in enumerate("RGB")}
    return parts


def encode_exr(parts: Mapping[str, Mapping[str, np.ndarray]], meta: Mapping[str, Any]) -> bytes:
    """Return a multi-part EXR as bytes, the same for the same input.

    Args:
        parts: {part: {channel: (H, W) array of float16, float32 or uint32}}, any memory layout.
        meta: JSON values, stored as text with every part.

    Raises:
        ValueError: another shape or dtype, sizes that differ, or NaN or inf in `meta`.

    Source: ours.
    """
    text = json.dumps(meta, sort_keys=True, allow_nan=False)
    exr_parts, sizes = [], set()
    for part_name, channels in parts.items():
        planes = {}
        for name, plane in channels.items():
            if plane.ndim != 2 or plane.dtype not in (np.float16, np.float32, np.uint32) or not plane.dtype.isnative:
                found = f"{plane.shape} {plane.dtype}"
                raise ValueError(f"{part_name}.{name}: expected (H, W) float16, float32 or uint32, got {found}")
            sizes.add(plane.shape)
            planes[name] = np.ascontiguousarray(plane)  # the library writes strided arrays wrong without any error
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, META_NAME: text}
        exr_parts.append(OpenEXR.Part(header, planes, name=part_name))
    if len(sizes) != 1:
        raise ValueError(f"parts: expected planes of one size, got {sorted(sizes)}")
    buffer = io.BytesIO()
    OpenEXR.File(exr_parts, num_threads=0).write(buffer)
    return buffer.getvalue()


def read_exr(path: str | Path) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, Any]]:
    """Return the parts and the metadata that `encode_exr` stored.

    Args:
        path: of the file.
            Damage to parts that did not shrink goes unnoticed: only the lists of the data set tell of it.

    Raises:
        FrameFileError: the file is missing, cut short, damaged or not one of ours; it is named.

    Source: ours.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise FrameFileError(f"{path}: expected a frame, got {type(error).__name__}: {error.strerror}") from None
    return decode_exr(data, str(path))


def decode_exr(data: bytes, name: str) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, Any]]:
    """Return the parts and the metadata that `encode_exr` stored.

    Args:
        data: what it returned.
        name: how an error calls it.

    Raises:
        FrameFileError: the bytes are cut short, damaged or not ours.

    Source: ours.
    """
    try:
        file = OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0)
        # A damaged file does not raise: it comes back with no parts.
        parts = {p.name(): {n: c.pixels for n, c in p.channels.items()} for p in file.parts}
        meta = json.loads(file.parts[0].header[META_NAME]) if file.parts else {}
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        raise FrameFileError(f"{name}: expected a readable EXR frame, got {type(error).__name__}: {error}") from None
    missing = [name for name in ("sharp", "blurred", "data") if name not in parts]
    if missing or any(plane is None for channels in parts.values() for plane in channels.values()):
        raise FrameFileError(f"{name}: expected parts sharp, blurred and data, got a damaged or foreign file")
    return parts, meta


def write_atomically(path: str | Path, data: bytes) -> None:
    """Write a file so that its name only ever stands for the whole of it, also after a crash.

    Raises:
        OSError: nothing was written under the final name, and the temporary file is gone.

    Source: ours.
    """
    with atomic_file(path) as file:
        file.write(data)


@contextmanager
def atomic_file(path: str | Path) -> Iterator[BinaryIO]:
    """Give a temporary file to write to, which gets its final name when the block ends without an exception.

    Raises:
        OSError: nothing was written under the final name, and the temporary file is gone.

    Source: ours.
    """
    path = Path(path)
    temporary = path.with_name(f"{TEMPORARY_PREFIX}{os.getpid()}-{next(_counter)}-{path.name}")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make renames in a folder last through a power cut, where the system can. Source: ours."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _float(plane: Tensor) -> np.ndarray:
    """Return a (H, W) plane as float32."""
    return plane.detach().numpy().astype(np.float32)


def _half(part: str, plane: Tensor) -> np.ndarray:
    """Return a (H, W) plane as float16, or raise where that would turn light into inf."""
    values = plane.detach().numpy()
    brightest = float(np.max(values, initial=0.0))
    if not brightest <= HALF_MAX:
        raise ValueError(f"{part}: expected colours of at most {HALF_MAX:g}, got {brightest:g}")
    return values.astype(np.float16)


def _id(plane: Tensor) -> np.ndarray:
    """Return ids as uint32 with 0 for nothing."""
    return (plane.detach().numpy() + 1).astype(np.uint32)
