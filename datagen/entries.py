"""Entries: the finished frames of a data set, whichever way it is stored.

Before: manifest.py, shards.py.  After: dataset.py, checks.py, export.py.
An entry is {`index`, `clip`, `frame`, `config_sha256`, `effects`, `files`}, and `baselines` if asked for; the files
are what listed_files.py reads.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from datagen.folders import SHARD_FOLDER
from datagen.manifest import MANIFEST_NAME, ManifestError, read_manifest
from datagen.shards import marker_entries, scan_shards


def is_sharded(folder: str | Path) -> bool:
    """Tell whether a data set is stored in tar files: without the list that a folder of files has. Source: ours."""
    return (Path(folder) / SHARD_FOLDER).is_dir() and not (Path(folder) / MANIFEST_NAME).exists()


def read_entries(folder: str | Path) -> dict[int, dict[str, Any]]:
    """Return the entries of the frames that are finished by now, by frame number, in that order.

    Raises:
        ManifestError: the lists are damaged.
        FileNotFoundError: there are none.

    Source: ours.
    """
    if not is_sharded(folder):
        return read_manifest(folder)
    markers, notes = scan_shards(Path(folder))
    if notes:
        raise ManifestError(f"{folder}: {notes[0]}")
    return {entry["index"]: entry for marker in markers for entry in marker_entries(marker)}
