"""Checks: is every byte of a data set as it was written, and how far is it.

Before: folders.py, manifest.py, shards.py, entries.py.  After: commands.py.
What is covered: `run.json` and the shards' markers by checksums of their own, every line of `manifest.jsonl` by being
just what that configuration writes, all else by the checksums in them. Not covered are `contact_sheet.png`, the
lists of failures and the log of runs.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.entries import is_sharded, read_entries
from datagen.folders import RUN_NAME, encode_run, read_run, record_sum
from datagen.listed_files import file_damage, is_of_configuration
from datagen.manifest import MANIFEST_NAME, encode_entry, scan_manifest
from datagen.shards import marker_entries, marker_path, scan_shards, shard_damage
from datagen.spec import DatasetSpec, SpecError, parse_spec


@dataclass(frozen=True)
class Status:
    """How far a data set is, by its lists; no frame is read."""

    spec: DatasetSpec
    finished: int  # frames listed
    failed: tuple[tuple[int, str], ...]  # (frame, reason) of the last run, without those made since
    refused: tuple[tuple[str, str], ...]  # (asset, reason) of the last run

    @property
    def is_complete(self) -> bool:
        """Whether every frame is listed."""
        return self.finished == self.spec.count


def verify_dataset(folder: str | Path) -> list[str]:
    """Return one line for each thing in a data set that is missing or changed; empty if all is well.

    A data set that is not finished yet is no damage; `read_status` tells of that.

    Raises:
        FileNotFoundError: there is no list of frames.

    Source: ours.
    """
    folder = Path(folder)
    problems = []
    try:
        run = read_run(folder)
        if record_sum(run) != run.get("record_sha256") or encode_run(run) != (folder / RUN_NAME).read_bytes():
            problems.append(f"{RUN_NAME}: expected a record with its checksum, got another")
        spec, config = parse_spec(run["spec"]), run["config_sha256"]
    except (SpecError, KeyError) as error:
        problems.append(f"{RUN_NAME}: expected the record of a run, got one that is missing or damaged ({error})")
        spec, config = None, None
    if is_sharded(folder):
        markers, notes = scan_shards(folder)
        for marker in markers:
            entries = marker_entries(marker)
            if spec is not None:
                name = marker_path(marker["shard"])
                problems += [f"{name}: {text}" for entry in entries if (text := _misfit(entry, spec, config))]
            problems += shard_damage(folder, marker["shard"], marker)
        return [f"{folder}: {problem}" for problem in (*problems, *notes)]
    lines, notes = scan_manifest(folder)
    written = set((folder / MANIFEST_NAME).read_bytes().splitlines(keepends=True))
    seen: set[int] = set()
    for entry in lines:
        index = entry["index"]
        misfit = _misfit(entry, spec, config) if spec is not None else ""
        if misfit or encode_entry(entry) not in written or index in seen:
            problems.append(
                f"{MANIFEST_NAME}: {misfit or f'expected one line of frame {index} as written, got another'}"
            )
        seen.add(index)
        problems += [f"frame {index}: {damage}" for file in entry["files"] if (damage := file_damage(folder, file))]
    return [f"{folder}: {problem}" for problem in (*problems, *notes)]


def read_status(folder: str | Path) -> Status:
    """Return how far a data set is.

    Raises:
        ManifestError, SpecError: the lists are damaged.
        FileNotFoundError: there is no list of frames.

    Source: ours.
    """
    folder = Path(folder)
    spec, entries = parse_spec(read_run(folder)["spec"]), read_entries(folder)
    failed: dict[int, str] = {}
    refused: dict[str, str] = {}
    for place in sorted(folder.glob("failures*.json")):
        lists = json.loads(place.read_text(encoding="utf-8"))
        failed |= {f["index"]: f["reason"] for f in lists["frames"] if f["index"] not in entries}
        refused |= {f["path"]: f["reason"] for f in lists["assets"]}
    return Status(spec, len(entries), tuple(sorted(failed.items())), tuple(refused.items()))


def _misfit(entry: dict[str, Any], spec: DatasetSpec, config: str) -> str:
    """Return in what an entry is not one of this configuration, or an empty string."""
    is_same = is_of_configuration(entry, spec, config) and entry["index"] < spec.count
    return "" if is_same else f"expected frame {entry['index']} of this configuration, got another"
