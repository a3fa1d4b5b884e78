"""Checks: is every byte of a data set as it was written, and how far is it.

Before: folders.py, manifest.py, shards.py, entries.py, report.py, run_log.py.  After: commands.py.
What is covered: `run.json` and the shards' markers by checksums of their own, every line of `manifest.jsonl` by being
just what that configuration writes, the lists of failures and the lines of the log by checksums of their own, the
contact sheet by those that PNG has, all else by the checksums in the lists.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.entries import is_sharded, read_entries
from datagen.folders import RUN_NAME, RecordError, encode_run, read_run, read_whole_run, record_sum
from datagen.listed_files import file_damage, is_of_configuration
from datagen.manifest import MANIFEST_NAME, ManifestError, encode_entry, scan_manifest
from datagen.report import SHEET_NAME
from datagen.run_log import LOG_NAME, read_log
from datagen.shards import marker_entries, marker_path, scan_shards, shard_damage
from datagen.spec import DatasetSpec, SpecError, recorded_spec

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


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
        spec, config = recorded_spec(run["spec"]), run["config_sha256"]
    except (SpecError, RecordError, KeyError) as error:
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
        return [f"{folder}: {problem}" for problem in (*problems, *notes, *_side_damages(folder))]
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
    return [f"{folder}: {problem}" for problem in (*problems, *notes, *_side_damages(folder))]


def read_status(folder: str | Path) -> Status:
    """Return how far a data set is.

    Raises:
        RecordError, SpecError: the lists are damaged.
        FileNotFoundError: there is no list of frames.

    Source: ours.
    """
    folder = Path(folder)
    spec, entries = recorded_spec(read_whole_run(folder)["spec"]), read_entries(folder)
    failed: dict[int, str] = {}
    refused: dict[str, str] = {}
    for place in sorted(folder.glob("failures*.json")):
        lists = _failures(place)
        if lists is None:
            raise ManifestError(f"{place}: expected a list of failures, got one that is damaged; the next run mends it")
        failed |= {f["index"]: f["reason"] for f in lists["frames"] if f["index"] not in entries}
        refused |= {f["path"]: f["reason"] for f in lists["assets"]}
    return Status(spec, len(entries), tuple(sorted(failed.items())), tuple(refused.items()))


def _side_damages(folder: Path) -> list[str]:
    """Return what is wrong with the files that tell about a data set; the next whole run writes them anew."""
    problems = []
    for place in sorted(folder.glob("failures*.json")):
        if _failures(place) is None:
            problems.append(f"{place.name}: expected a list of failures with its checksum, got another")
    try:
        if (unread := read_log(folder)[1]) > 0:
            problems.append(f"{LOG_NAME}: expected lines with their checksums, got {unread} others")
    except OSError as error:
        problems.append(f"{LOG_NAME} cannot be read ({error.strerror})")
    sheet = folder / SHEET_NAME
    if sheet.exists() and not _is_whole_png(sheet.read_bytes()):
        problems.append(f"{SHEET_NAME}: expected a PNG with its checksums, got another")
    return problems


def _failures(place: Path) -> dict[str, Any] | None:
    """Return a list of failures, or none if it is not as written."""
    try:
        data = place.read_bytes()
        lists = json.loads(data)
        is_whole = lists["record_sha256"] == record_sum(lists) and encode_run(lists) == data
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return lists if is_whole else None


def _is_whole_png(data: bytes) -> bool:
    """Tell whether the chunks of a PNG fill it and have the checksums that they say."""
    place, kind = len(PNG_SIGNATURE), b""
    if not data.startswith(PNG_SIGNATURE):
        return False
    while kind != b"IEND":
        length = int.from_bytes(data[place : place + 4], "big")
        body, end = data[place + 4 : place + 8 + length], place + 12 + length
        if end > len(data) or zlib.crc32(body) != int.from_bytes(data[end - 4 : end], "big"):
            return False
        place, kind = end, body[:4]
    return place == len(data)


def _misfit(entry: dict[str, Any], spec: DatasetSpec, config: str) -> str:
    """Return in what an entry is not one of this configuration, or an empty string."""
    is_same = is_of_configuration(entry, spec, config) and entry["index"] < spec.count
    return "" if is_same else f"expected frame {entry['index']} of this configuration, got another"
