"""Listed files: the bytes of a frame's files, checked against the list that names them.

Before: writer.py.  After: manifest.py, shards.py, entries.py.
A listed file is {`path`, `bytes`, `sha256`}; inside a shard it has `tar`, the shard's path, and `offset` as well.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path
from typing import Any

from datagen.spec import DatasetSpec
from datagen.writer import FrameFileError, baselines_entry

MAX_PLACE = 2**50  # bytes of a file or before a place in it


def read_listed_file(folder: str | Path, entry: dict[str, Any], path: str) -> bytes:
    """Return the bytes of one of a frame's files.

    Args:
        folder: of the data set.
        entry: of the frame, from `entries.read_entries`.
        path: as the entry has it.

    Raises:
        FrameFileError: the file is missing or its bytes are not those that are listed.

    Source: ours.
    """
    file = next(f for f in entry["files"] if f["path"] == path)
    data, problem = _read(Path(folder), file)
    if problem:
        raise FrameFileError(f"{folder}: expected the files that are listed, but {problem}")
    return data


def is_listed(file: dict[str, Any]) -> bool:
    """Tell whether a file of a list has a checksum, and numbers that a place in a file can have.

    Raises:
        KeyError, TypeError: it has not.

    Source: ours.
    """
    numbers = [file["bytes"], *([file["offset"]] if "offset" in file else [])]
    is_number = all(type(n) is int and 0 <= n < MAX_PLACE for n in numbers)
    return is_number and re.fullmatch("[0-9a-f]{64}", file["sha256"]) is not None


def is_of_configuration(entry: dict[str, Any], spec: DatasetSpec, config_sha256: str) -> bool:
    """Tell whether an entry is that of its frame in a data set of this configuration. Source: ours."""
    clip, frame = spec.clip_and_frame(entry["index"])
    expected = {"index": entry["index"], "clip": clip, "frame": frame, "config_sha256": config_sha256}
    expected |= baselines_entry(spec.baseline_names)
    return {name: value for name, value in entry.items() if name not in ("effects", "files")} == expected


def file_damage(folder: Path, file: dict[str, Any]) -> str:
    """Return what is wrong with a listed file, or an empty string. Source: ours."""
    return _read(folder, file)[1]


def entry_damage(folder: Path, entry: dict[str, Any]) -> str:
    """Return what is wrong with a frame's files, or an empty string. Source: ours."""
    return ", ".join(filter(None, (file_damage(folder, file) for file in entry["files"])))


def _read(folder: Path, file: dict[str, Any]) -> tuple[bytes, str]:
    """Return the bytes of a listed file, and what is wrong with them or an empty string."""
    held = file.get("tar", file["path"])
    name = f"{file['path']} in {held}" if "tar" in file else held
    try:
        if "tar" in file:
            with (folder / held).open("rb") as tar:
                tar.seek(file["offset"])
                data = tar.read(min(file["bytes"], os.fstat(tar.fileno()).st_size))  # no memory for what is not there
        else:
            data = (folder / held).read_bytes()
    except FileNotFoundError:
        return b"", f"{held} is missing"
    except OSError as error:
        return b"", f"{held} cannot be read ({error.strerror})"
    is_same = hashlib.sha256(data).hexdigest() == file["sha256"] and len(data) == file.get("bytes")
    return data, "" if is_same else f"{name} differs from the {'marker' if 'tar' in file else 'manifest'}"
