"""Dataset: what was written, as tensors for training.

Before: writer.py, shards.py, entries.py.  After: report.py and people's training code.
Images leave as (C, H, W) float32. Symbols: H, W image size.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from datagen.entries import read_entries
from datagen.listed_files import read_listed_file
from datagen.manifest import ManifestError
from datagen.shards import marker_entries, read_marker
from datagen.writer import FrameFileError, decode_exr, frame_paths

# name -> (part, channels)
PLANES: dict[str, tuple[str, tuple[str, ...]]] = {
    "sharp": ("sharp", ("R", "G", "B")),
    "blurred": ("blurred", ("R", "G", "B")),
    "motion": ("data", ("forward.u", "forward.v")),
    "motion_next": ("data", ("next.u", "next.v")),
    "motion_previous": ("data", ("previous.u", "previous.v")),
    "depth": ("data", ("Z",)),
    "alpha": ("data", ("A",)),
    "shadow": ("data", ("shadow",)),
    "sharp_alpha": ("sharp", ("A",)),
}
REMADE_TRIES, REMADE_WAIT_S = 20, 0.1
IDS = {"mesh_id": "id.mesh", "face_id": "id.face"}


class BlurDataset(Dataset[dict[str, Any]]):
    """The finished frames of a folder, in the order of their numbers, also while more are being written.

    An item is a dict of tensors: `sharp`, `blurred` (3, H, W) linear RGB; `motion` (2, H, W) [px, x right, y down]
    over the exposure, `motion_next` and `motion_previous` to the neighbour frames' sharp instants (NaN where the
    point is behind the camera then); `depth` (1, H, W) [scene units], inf where nothing is; `alpha` over the exposure
    and `sharp_alpha` (1, H, W); `shadow` (1, H, W), the share of the lamps' light that no shadow takes away over the
    exposure, 1 in frames without lamps, so that a batch may mix them; `mesh_id` and `face_id` (1, H, W) int64, -1 where
    nothing is; `baseline_NAME` (3, H, W) linear RGB for each filter that the data set was made with; `index`; and
    `meta`, the frame's metadata as JSON text, which the default collate of a DataLoader keeps as a list of str.

    Files are opened when an item is asked for; the object is small and can travel to worker processes.

    Args:
        folder: of the data set.
        keys: which of the tensors to read; all if not given.

    Raises:
        FileNotFoundError: no manifest there.
        ValueError: a key that does not exist, or a folder without any finished frame.

    Example:
        >>> BlurDataset("out")[0]["blurred"].shape  # doctest: +SKIP
        torch.Size([3, 256, 256])
    """

    def __init__(self, folder: str | Path, keys: Sequence[str] | None = None) -> None:
        self.folder = Path(folder)
        try:
            entries = read_entries(folder)
        except FileNotFoundError:
            raise FileNotFoundError(f"folder: expected a data set with a manifest.jsonl, got {str(folder)!r}") from None
        names = sorted(set.intersection(*(set(e.get("baselines", ())) for e in entries.values()))) if entries else []
        self.planes = PLANES | {f"baseline_{name}": (f"baseline.{name}", ("R", "G", "B")) for name in names}
        known = (*self.planes, *IDS)
        unknown = [k for k in keys or () if k not in known]
        if unknown:
            raise ValueError(f"keys: expected some of {', '.join(known)}, got {', '.join(unknown)}")
        self.keys = tuple(known if keys is None else keys)
        self.indices = tuple(entries)
        files = [file for e in entries.values() for file in e["files"] if file["path"].endswith(".exr")]
        # One array, as millions of texts would be slow to send to workers.
        rows = [(file["sha256"], file["bytes"], file.get("tar", ""), file.get("offset", 0)) for file in files]
        self._files = np.array(rows, dtype=[("sha256", "S64"), ("bytes", "i8"), ("tar", "S24"), ("offset", "i8")])
        if not self.indices:
            raise ValueError(f"folder: expected at least one finished frame, got none in {str(folder)!r}")

    def __len__(self) -> int:
        """Return the number of finished frames."""
        return len(self.indices)

    def __getitem__(self, item: int) -> dict[str, Any]:
        """Return one frame as a dict of tensors and its metadata.

        Raises:
            IndexError: no such item.
            FrameFileError: the file is missing or damaged; it is named.
        """
        index = self.indices[item]
        path, parts, meta = self._read(item)
        result: dict[str, Any] = {"index": index, "meta": json.dumps(meta, sort_keys=True)}
        try:
            for key in self.keys:
                if key in IDS:
                    result[key] = torch.from_numpy(parts["data"][IDS[key]].astype(np.int64)).unsqueeze(0) - 1
                elif key == "shadow" and key not in parts["data"]:
                    result[key] = torch.ones(1, *parts["data"]["A"].shape)
                else:
                    result[key] = _stack(parts, *self.planes[key])
        except KeyError as error:
            raise FrameFileError(f"{path}: expected a channel {error}, got a frame without it") from None
        return result

    def coverage(self, item: int) -> Tensor:
        """Return (M, H, W) float32, the share of the exposure in which mesh m is visible; M differs between clips.

        Raises:
            FrameFileError: the file is missing or damaged.

        Source: ours.
        """
        _, parts, _ = self._read(item)
        planes = parts.get("coverage", {})
        if not planes:
            return torch.zeros(0, *parts["data"]["A"].shape)
        return torch.from_numpy(np.stack([planes[name] for name in sorted(planes)]))

    def metadata(self, item: int) -> dict[str, Any]:
        """Return the metadata of a frame as a dict. Source: ours."""
        return self._read(item)[2]

    def _read(self, item: int) -> tuple[Path, dict[str, dict[str, np.ndarray]], dict[str, Any]]:
        """Return a frame's path, parts and metadata, its bytes checked against the manifest."""
        index, (sha256, size, tar, offset) = self.indices[item], self._files[item].tolist()
        path = frame_paths(index)["exr"]
        file: dict[str, Any] = {"path": path, "sha256": sha256.decode(), "bytes": size}
        if tar:
            file |= {"tar": tar.decode(), "offset": offset}
        try:
            data = read_listed_file(self.folder, {"files": [file]}, path)
        except FrameFileError:
            if not tar:
                raise
            data = self._read_remade(Path(tar.decode()), index, path)
        return (self.folder / path, *decode_exr(data, str(self.folder / path)))

    def _read_remade(self, tar: Path, index: int, path: str) -> bytes:
        """Return the bytes of a frame whose shard may have been made again, with frames that had failed, since."""
        entries: dict[int, dict[str, Any]] = {}
        for _ in range(REMADE_TRIES):
            try:
                entries = {e["index"]: e for e in marker_entries(read_marker(self.folder, int(tar.stem)))}
                break
            except ManifestError:  # a shard has no marker between the two renames
                time.sleep(REMADE_WAIT_S)
        if index not in entries:
            raise FrameFileError(
                f"{self.folder}: expected frame {index} in {tar}, got a shard that no marker puts it in"
            )
        return read_listed_file(self.folder, entries[index], path)


def _stack(parts: dict[str, dict[str, np.ndarray]], part: str, channels: tuple[str, ...]) -> Tensor:
    """Return channels as (C, H, W) float32."""
    return torch.from_numpy(np.stack([parts[part][c].astype(np.float32) for c in channels]))
