"""Flow files: motion in the formats that training code reads (the only door to kornia_rs and h5py).

Before: nothing.  After: export.py.
Motion is (H, W, 2) in pixels, x right, y down, row 0 on top: `p(later) = p + motion`; NaN where it is unknown.

| suffix | holds | unknown | exact |
|---|---|---|---|
| `.flo` | Middlebury's and Sintel's: float32 pairs | 1e10 | yes |
| `.pfm` | FlyingThings3D's: float32 triples, the third 0, bottom row first | NaN | yes |
| `.png` | KITTI's: 16 bits, 64 · motion + 32768, third channel 1 where known | third channel 0 | to 1/128 px |
| `.flo5` | Spring's: HDF5 with the float32 array `flow` | NaN | yes |

Source: the formats' own descriptions by Middlebury, Freiburg, KITTI and Spring.
"""

from __future__ import annotations

import io
import re
import tempfile
from pathlib import Path
from types import ModuleType

import kornia_rs.io
import numpy as np

FLOW_SUFFIXES = (".flo", ".pfm", ".png", ".flo5")
FLO_TAG = b"PIEH"  # 202021.25 as a little-endian float32
FLO_UNKNOWN, FLO_UNKNOWN_ABOVE = 1e10, 1e9
KITTI_STEPS_PER_PX, KITTI_ZERO = 64, 32768
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


class FlowFileError(ValueError):
    """A flow file that cannot be read, or motion that a format cannot hold, and why."""


def encode_flow(flow_px: np.ndarray, suffix: str) -> bytes:
    """Return motion as the bytes of a file.

    Args:
        flow_px: (H, W, 2) float32 [px, x right, y down], any memory layout; both NaN where unknown.
        suffix: one of FLOW_SUFFIXES.

    Raises:
        ValueError: another shape, dtype or suffix.
        FlowFileError: motion that is infinite or beyond what the format holds; nothing is clipped.
        ModuleNotFoundError: `.flo5` without the package h5py.

    Source: the format's description; see the table above.
    """
    if suffix not in FLOW_SUFFIXES:
        raise ValueError(f"suffix: expected one of {', '.join(FLOW_SUFFIXES)}, got {suffix!r}")
    if flow_px.ndim != 3 or flow_px.shape[2] != 2 or not flow_px.size or flow_px.dtype != np.float32:
        raise ValueError(f"flow_px: expected (H, W, 2) float32, got {flow_px.shape} {flow_px.dtype}")
    unknown = np.isnan(flow_px).any(-1)
    known = np.ascontiguousarray(flow_px)[~unknown]
    farthest = float(np.abs(known).max(initial=0.0))
    if not farthest < FLO_UNKNOWN_ABOVE:
        raise FlowFileError(f"flow_px: expected motion below {FLO_UNKNOWN_ABOVE:g} px, got {farthest:g}")
    if suffix == ".png":
        return _encode_kitti(flow_px, unknown)
    if suffix == ".flo5":
        return _encode_flo5(np.where(unknown[..., None], np.float32(np.nan), flow_px))
    height, width = unknown.shape
    if suffix == ".flo":
        pairs = np.where(unknown[..., None], np.float32(FLO_UNKNOWN), flow_px)
        return FLO_TAG + np.array([width, height], "<i4").tobytes() + pairs.astype("<f4").tobytes()
    triples = np.zeros((height, width, 3), "<f4")
    triples[..., :2] = np.where(unknown[..., None], np.float32(np.nan), flow_px)
    return f"PF\n{width} {height}\n-1.0\n".encode() + triples[::-1].tobytes()  # negative: little-endian


def read_flow(path: str | Path) -> np.ndarray:
    """Return the motion of a file as (H, W, 2) float32 [px, x right, y down], NaN where it is unknown.

    Args:
        path: of a file with one of FLOW_SUFFIXES, written here or elsewhere.

    Raises:
        ValueError: another suffix.
        FlowFileError: the file is missing, cut short or in another format; it is named.
        ModuleNotFoundError: `.flo5` without the package h5py.

    Source: the format's description; see the table above.
    """
    path = Path(path)
    readers = {".flo": _decode_flo, ".pfm": _decode_pfm, ".png": _decode_kitti, ".flo5": _decode_flo5}
    if path.suffix not in readers:
        raise ValueError(f"path: expected a suffix of {', '.join(FLOW_SUFFIXES)}, got {str(path)!r}")
    try:
        flow_px = readers[path.suffix](path.read_bytes())
    except ModuleNotFoundError:
        raise
    except Exception as error:  # the libraries raise many kinds
        text = " ".join(str(error).split())[:200]
        raise FlowFileError(f"{path}: expected a {path.suffix} flow file, got {type(error).__name__}: {text}") from None
    flow_px = flow_px.astype(np.float32)
    flow_px[np.isnan(flow_px).any(-1)] = np.nan
    return flow_px


def _encode_kitti(flow_px: np.ndarray, unknown: np.ndarray) -> bytes:
    """Return KITTI's 16-bit PNG."""
    steps = np.rint(np.where(unknown[..., None], 0.0, flow_px).astype(np.float64) * KITTI_STEPS_PER_PX) + KITTI_ZERO
    if steps.min() < 0 or steps.max() > 65535:
        farthest = float(np.nanmax(np.abs(flow_px)))
        raise FlowFileError(f"flow_px: expected motion from -512 to 511.98 px for a .png, got {farthest:g} px")
    planes = np.zeros((*unknown.shape, 3), np.uint16)
    planes[..., :2] = steps
    planes[..., 2] = ~unknown
    planes[unknown] = 0
    with tempfile.TemporaryDirectory() as folder:  # the library writes to paths only
        place = Path(folder) / "flow.png"
        kornia_rs.io.write_image_png_u16(str(place), planes, mode="rgb")
        return place.read_bytes()


def _decode_kitti(data: bytes) -> np.ndarray:
    """Return the motion in KITTI's PNG."""
    depth, colour = data[24:26]
    if data[:8] != PNG_SIGNATURE or (depth, colour) != (16, 2):
        raise ValueError("expected a PNG of 3 channels of 16 bits")
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "flow.png"
        place.write_bytes(data)
        planes = kornia_rs.io.read_image_png_u16(str(place), mode="rgb")
    flow_px = (planes[..., :2].astype(np.float32) - KITTI_ZERO) / KITTI_STEPS_PER_PX
    flow_px[planes[..., 2] == 0] = np.nan
    return flow_px


def _decode_flo(data: bytes) -> np.ndarray:
    """Return the motion in a Middlebury file."""
    width, height = (int(n) for n in np.frombuffer(data[4:12], "<i4"))
    if data[:4] != FLO_TAG or width < 1 or height < 1 or len(data) != 12 + 8 * width * height:
        raise ValueError(f"expected PIEH, a size and that many pairs, got {len(data)} bytes")
    flow_px = np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2).copy()
    flow_px[~(np.abs(flow_px) <= FLO_UNKNOWN_ABOVE).all(-1)] = np.nan
    return flow_px


def _decode_pfm(data: bytes) -> np.ndarray:
    """Return the motion in a portable float map of three channels."""
    header = re.match(rb"PF\s+(\d+)\s+(\d+)\s+(-?[\d.eE+-]+)\n", data)
    if header is None:
        raise ValueError("expected a PF header")
    width, height = int(header[1]), int(header[2])
    kind = "<f4" if float(header[3]) < 0 else ">f4"
    if len(data) - header.end() != 12 * width * height:
        raise ValueError(f"expected {12 * width * height} bytes of pixels, got {len(data) - header.end()}")
    return np.frombuffer(data, kind, offset=header.end()).reshape(height, width, 3)[::-1, :, :2].copy()


def _encode_flo5(flow_px: np.ndarray) -> bytes:
    """Return Spring's HDF5 file."""
    buffer = io.BytesIO()
    with _h5py().File(buffer, mode="w") as file:
        file.create_dataset("flow", data=flow_px, compression="gzip", compression_opts=5)
    return buffer.getvalue()


def _decode_flo5(data: bytes) -> np.ndarray:
    """Return the motion in Spring's HDF5 file."""
    with _h5py().File(io.BytesIO(data), mode="r") as file:
        flow_px = np.asarray(file["flow"])
    if flow_px.ndim != 3 or flow_px.shape[2] != 2:
        raise ValueError(f"expected (H, W, 2), got {flow_px.shape}")
    return flow_px


def _h5py() -> ModuleType:
    """Return the module h5py, an optional package."""
    try:
        import h5py
    except ModuleNotFoundError:
        raise ModuleNotFoundError("h5py: expected the package for .flo5, got none; install torchblur[export]") from None
    return h5py
