"""Manifest: which frames of a folder are finished, and what they were made from.

Before: folders.py, listed_files.py.  After: shards.py, entries.py, runs.py.
`manifest.jsonl` has one line for each finished frame, with the effects that it called for and the checksums of its
files.
A frame counts from the moment its line is on the disk: that line is the commit point.
A run takes no frame on trust: the bytes of every listed file are compared, and what does not fit is made again.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torchblur as tb
from datagen.folders import RUN_NAME, SHARD_FOLDER, RecordError, check_run, drop_empty, sweep, write_run
from datagen.listed_files import entry_damage, is_listed, is_of_configuration
from datagen.scenes import Plan
from datagen.spec import BASELINES, SpecError
from datagen.writer import FOLDERS, frame_paths, sync_folder, write_atomically

MANIFEST_NAME = "manifest.jsonl"


class ManifestError(RecordError):
    """A manifest that is damaged other than by a line cut short at its end; a run repairs it."""


@dataclass(frozen=True)
class Holdings:
    """What a folder already holds at the start of a run."""

    entries: dict[int, dict[str, Any]]  # by frame, of those whose files are all as listed
    damaged: dict[int, str]  # by frame, of those that are listed but must be made again: why
    notes: tuple[str, ...]  # on lines of the manifest that are passed over


def begin_run(folder: Path, plan: Plan) -> Holdings:
    """Prepare a locked folder for a run and return what it already holds.

    Files left behind by a killed run are removed. Every listed file is read and compared with its checksum.

    Args:
        folder: held by `locked_folder`.
        plan: what will be made.

    Raises:
        SpecError: the folder holds data of another configuration; the fields that differ are named.

    Source: ours.
    """
    lines, notes = scan_manifest(folder) if (folder / MANIFEST_NAME).exists() else ([], [])
    ours = [e["config_sha256"] == plan.config_sha256 and e["index"] < plan.spec.count for e in lines]
    notes = check_run(folder, plan, lambda: all(ours) if ours else None) + notes
    found = {entry["config_sha256"] for entry in lines}
    if found and plan.config_sha256 not in found:  # among fitting ones, a line that does not fit is a damaged line
        wanted_sum = plan.config_sha256
        raise SpecError([f"out: expected frames of configuration {wanted_sum} in {folder}, got {min(found)}"])
    drop_empty(folder, (SHARD_FOLDER,))  # of a start with the other storage
    for name in FOLDERS:
        (folder / name).mkdir(exist_ok=True)
    sweep_frames(folder)
    entries, damaged = {}, {}
    for entry in lines:
        problem = _damage(folder, entry, plan)
        if problem:
            damaged[entry["index"]] = problem
        else:
            entries[entry["index"]] = entry
    for index in sorted(set(entries) & set(damaged)):  # of two lines for one frame, the one that its files fit counts
        notes.append(f"{MANIFEST_NAME}: expected one entry of frame {index}, got two that differ")
        del damaged[index]
    write_run(folder, plan)
    write_manifest(folder, entries)  # without a torn line, so that new ones start on their own
    return Holdings(entries, damaged, tuple(notes))


def read_manifest(folder: str | Path) -> dict[int, dict[str, Any]]:
    """Return the entries by frame number, in that order. A last line that was cut short is passed over.

    Raises:
        ManifestError: any other damage, or a frame listed twice with different files.
        FileNotFoundError: there is no manifest.

    Source: ours.
    """
    entries: dict[int, dict[str, Any]] = {}
    lines, notes = scan_manifest(Path(folder))
    if notes:
        raise ManifestError(f"{folder}: {notes[0]}")
    for entry in lines:
        if entries.setdefault(entry["index"], entry) != entry:
            raise ManifestError(f"{folder}: expected one entry of frame {entry['index']}, got two that differ")
    return dict(sorted(entries.items()))


def sweep_frames(folder: Path) -> None:
    """Remove what killed processes left in a folder of frames that only this run works in. Source: ours."""
    sweep((folder, *(folder / name for name in FOLDERS)))


def append_entry(folder: Path, entry: dict[str, Any]) -> None:
    """Commit a frame: its line is on the disk when this returns. Source: ours."""
    with (folder / MANIFEST_NAME).open("ab") as file:
        file.write(encode_entry(entry))
        file.flush()
        os.fsync(file.fileno())


def write_manifest(folder: Path, entries: dict[int, dict[str, Any]]) -> None:
    """Write the whole manifest in the order of frames, whatever the order they were finished in. Source: ours."""
    write_atomically(folder / MANIFEST_NAME, b"".join(encode_entry(entries[i]) for i in sorted(entries)))
    sync_folder(folder)


def encode_entry(entry: dict[str, Any]) -> bytes:
    """Return an entry as its line of the manifest. Source: ours."""
    return json.dumps(entry, sort_keys=True).encode() + b"\n"


def scan_manifest(folder: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the entries in the order of their lines, and a note on each line that is none.

    Raises:
        FileNotFoundError: no data set there.
        ManifestError: a data set without its manifest.

    Source: ours.
    """
    try:
        lines = (folder / MANIFEST_NAME).read_bytes().split(b"\n")
    except FileNotFoundError:
        if not (folder / RUN_NAME).exists():
            raise
        wanted = f"expected {MANIFEST_NAME} beside {RUN_NAME}, got none; the next run makes its frames anew"
        raise ManifestError(f"{folder}: {wanted}") from None
    entries, notes = [], []
    if _is_json(lines[-1][:-1]):  # a whole line whose end was changed, not one that was cut short
        notes.append(f"{MANIFEST_NAME}: expected a line end after line {len(lines)}, got {lines[-1][-1:]!r}")
    for number, line in enumerate(lines[:-1]):  # what follows the last line end was not finished
        try:
            entry = json.loads(line)
            is_valid = _is_entry(entry)
        except (ValueError, KeyError, TypeError, RecursionError):
            is_valid = False
        if is_valid:
            entries.append(entry)
        else:
            found = line[:60].decode("utf-8", "replace")
            notes.append(f"{MANIFEST_NAME}: expected a finished frame in line {number + 1}, got {found!r}")
    return entries, notes


def _is_json(text: bytes) -> bool:
    """Tell whether text is a JSON value."""
    try:
        json.loads(text)
    except (ValueError, RecursionError):
        return False
    return True


def _is_entry(entry: Any) -> bool:
    """Tell whether a JSON value is the entry of a frame, with just its files."""
    index, files = entry["index"], entry["files"]
    if type(index) is not int or index < 0 or not isinstance(entry["config_sha256"], str):
        return False
    known = (tb.EFFECTS, BASELINES)  # a flipped bit turns a name into none of these
    for names, some in zip((entry["effects"], entry.get("baselines", [])), known, strict=True):
        if not isinstance(names, list) or not all(name in some for name in names):
            return False
    return all(map(is_listed, files)) and sorted(file["path"] for file in files) == sorted(frame_paths(index).values())


def _damage(folder: Path, entry: dict[str, Any], plan: Plan) -> str:
    """Return what is wrong with a listed frame, or an empty string if every byte of it is as listed."""
    if not is_of_configuration(entry, plan.spec, plan.config_sha256):
        return f"its line in {MANIFEST_NAME} is not of this configuration"
    return entry_damage(folder, entry)
