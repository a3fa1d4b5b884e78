"""Manifest: which frames of a folder are finished, and what they were made from.

Before: writer.py.  After: runs.py, dataset.py.
`run.json` holds the specification; `manifest.jsonl` one line for each finished frame, with the checksums of its files.
A frame counts from the moment its line is on the disk: that line is the commit point.
A run takes no frame on trust: the bytes of every listed file are compared, and what does not fit is made again.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torchblur as tb
from datagen.scenes import Plan
from datagen.spec import NOT_IN_THE_BYTES, SpecError
from datagen.writer import (
    FOLDERS,
    TEMPORARY_PREFIX,
    FrameFileError,
    frame_paths,
    sync_folder,
    write_atomically,
)

try:
    import fcntl
except ImportError:  # Windows has no such locks; two runs in one folder are then the user's to avoid
    fcntl = None  # type: ignore[assignment]

TEMPORARY_PATTERN = f"{TEMPORARY_PREFIX}[0-9]*-[0-9]*-*"
RUN_NAME, MANIFEST_NAME, LOCK_NAME = "run.json", "manifest.jsonl", ".lock"


class ManifestError(ValueError):
    """A manifest that is damaged other than by a line cut short at its end; a run repairs it."""


@dataclass(frozen=True)
class Holdings:
    """What a folder already holds at the start of a run."""

    entries: dict[int, dict[str, Any]]  # by frame, of those whose files are all as listed
    damaged: dict[int, str]  # by frame, of those that are listed but must be made again: why
    notes: tuple[str, ...]  # on lines of the manifest that are passed over


@contextmanager
def locked_folder(out: str | Path) -> Iterator[Path]:
    """Create the folder if need be and hold it: one run at a time. The system lets go when the process ends, however.

    Raises:
        SpecError: another run holds it, or the path is no folder.

    Source: ours.
    """
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / LOCK_NAME, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        why = f"{type(error).__name__}: {error.strerror}"
        raise SpecError([f"out: expected a folder that can be written, got {str(out)!r}: {why}"]) from None
    try:
        if fcntl is not None:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise SpecError([f"out: expected a folder no other run works in, got {str(out)!r}"]) from None
        yield folder
    finally:
        os.close(descriptor)


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
    wanted = _run_record(plan)
    place = folder / RUN_NAME
    if place.exists():
        problems = _differences(_read_run(place), wanted, folder)
        if problems:
            raise SpecError(problems)
    else:
        strange = sorted(p.name for p in folder.iterdir() if not _is_left_by_a_start(p))
        if strange:  # people's own files are not to be mixed with, still less swept
            found = ", ".join(strange[:3]) + (", …" if len(strange) > 3 else "")
            raise SpecError([f"out: expected an empty folder or a data set with its {RUN_NAME}, got {found}"])
    lines, notes = _scan_manifest(folder) if (folder / MANIFEST_NAME).exists() else ([], [])
    found = {entry["config_sha256"] for entry in lines}
    if found and plan.config_sha256 not in found:  # among fitting ones, a line that does not fit is a damaged line
        wanted_sum = plan.config_sha256
        raise SpecError([f"out: expected frames of configuration {wanted_sum} in {folder}, got {min(found)}"])
    for name in FOLDERS:
        (folder / name).mkdir(exist_ok=True)
    for holder in (folder, *(folder / name for name in FOLDERS)):
        for stale in holder.glob(TEMPORARY_PATTERN):
            stale.unlink(missing_ok=True)
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
    write_atomically(place, (json.dumps(wanted, indent=1, sort_keys=True) + "\n").encode())
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
    lines, notes = _scan_manifest(Path(folder))
    if notes:
        raise ManifestError(f"{folder}: {notes[0]}")
    for entry in lines:
        if entries.setdefault(entry["index"], entry) != entry:
            raise ManifestError(f"{folder}: expected one entry of frame {entry['index']}, got two that differ")
    return dict(sorted(entries.items()))


def read_run(folder: str | Path) -> dict[str, Any]:
    """Return what `run.json` of a data set holds.

    Raises:
        SpecError: it is missing or damaged.

    Source: ours.
    """
    return _read_run(Path(folder) / RUN_NAME)


def read_listed_file(folder: str | Path, entry: dict[str, Any], path: str) -> bytes:
    """Return the bytes of one of a frame's files.

    Args:
        folder: of the data set.
        entry: of the frame, from the manifest.
        path: as the entry has it.

    Raises:
        FrameFileError: the file is missing or its bytes are not those that the manifest lists.

    Source: ours.
    """
    file = next(f for f in entry["files"] if f["path"] == path)
    data, problem = _read_file(Path(folder), file)
    if problem:
        raise FrameFileError(f"{folder}: expected the files that the manifest lists, but {problem}")
    return data


def append_entry(folder: Path, entry: dict[str, Any]) -> None:
    """Commit a frame: its line is on the disk when this returns. Source: ours."""
    with (folder / MANIFEST_NAME).open("ab") as file:
        file.write(_line(entry))
        file.flush()
        os.fsync(file.fileno())


def write_manifest(folder: Path, entries: dict[int, dict[str, Any]]) -> None:
    """Write the whole manifest in the order of frames, whatever the order they were finished in. Source: ours."""
    write_atomically(folder / MANIFEST_NAME, b"".join(_line(entries[i]) for i in sorted(entries)))
    sync_folder(folder)


def verify_dataset(folder: str | Path) -> list[str]:
    """Return one line for each file of a data set that is missing or whose bytes have changed; empty if all is well.

    Raises:
        ManifestError: the manifest itself is damaged.
        FileNotFoundError: there is none.

    Source: ours.
    """
    problems = []
    for entry in read_manifest(folder).values():
        for file in entry["files"]:
            path = Path(folder) / file["path"]
            if not path.is_file():
                problems.append(f"{path}: expected a file, got none")
                continue
            found = hashlib.sha256(path.read_bytes()).hexdigest()
            if found != file["sha256"]:
                problems.append(f"{path}: expected sha256 {file['sha256']}, got {found}")
    return problems


def _is_left_by_a_start(path: Path) -> bool:
    """Tell whether a run that was killed before its run.json was there can have left this."""
    if path.name in FOLDERS:
        return path.is_dir() and not any(path.iterdir())
    return path.name == LOCK_NAME or path.match(TEMPORARY_PATTERN)


def _line(entry: dict[str, Any]) -> bytes:
    """Return an entry as its line."""
    return json.dumps(entry, sort_keys=True).encode() + b"\n"


def _run_record(plan: Plan) -> dict[str, Any]:
    """Return what run.json holds."""
    return {
        "format": 1,
        "spec": plan.spec.model_dump(),
        "assets_sha256": plan.assets_sha256,
        "asset_names": list(plan.asset_names),
        "config_sha256": plan.config_sha256,
        "torchblur_version": tb.__version__,
    }


def _read_run(path: Path) -> dict[str, Any]:
    """Return run.json."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(record["spec"], dict):
            return record
    except (OSError, ValueError, KeyError, TypeError):
        pass
    raise SpecError([f"out: expected a readable {RUN_NAME}, got {str(path)!r} damaged"])


def _differences(found: dict[str, Any], wanted: dict[str, Any], folder: Path) -> list[str]:
    """Return one line for each field in which a folder's data differ from what is asked for."""
    problems = []
    fields = sorted(set(found["spec"]) | set(wanted["spec"]))
    for name in fields:
        was, now = found["spec"].get(name), wanted["spec"].get(name)
        if name not in NOT_IN_THE_BYTES and was != now:
            problems.append(f"{name}: expected {was!r} as in {folder}, got {now!r}")
    if found["spec"].get("count", 0) > wanted["spec"]["count"]:
        had, asked = found["spec"]["count"], wanted["spec"]["count"]
        problems.append(f"count: expected at least the {had} frames of {folder}, got {asked}")
    for name in ("format", "assets_sha256", "torchblur_version"):
        if found.get(name) != wanted[name] and not (name == "assets_sha256" and problems):
            problems.append(f"{name}: expected {found.get(name)!r} as in {folder}, got {wanted[name]!r}")
    return problems


def _scan_manifest(folder: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the entries in the order of their lines, and a note on each line that is none."""
    lines = (folder / MANIFEST_NAME).read_bytes().split(b"\n")
    entries, notes = [], []
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


def _is_entry(entry: Any) -> bool:
    """Tell whether a JSON value is the entry of a frame, with just its files."""
    index, files = entry["index"], entry["files"]
    if type(index) is not int or index < 0 or not isinstance(entry["config_sha256"], str):
        return False
    sums_fit = all(re.fullmatch("[0-9a-f]{64}", file["sha256"]) for file in files)
    return sums_fit and sorted(file["path"] for file in files) == sorted(frame_paths(index).values())


def _damage(folder: Path, entry: dict[str, Any], plan: Plan) -> str:
    """Return what is wrong with a listed frame, or an empty string if every byte of it is as listed."""
    clip, frame = plan.spec.clip_and_frame(entry["index"])
    expected = {"index": entry["index"], "clip": clip, "frame": frame, "config_sha256": plan.config_sha256}
    if {name: value for name, value in entry.items() if name != "files"} != expected:
        return f"its line in {MANIFEST_NAME} is not of this configuration"
    return ", ".join(filter(None, (_file_damage(folder, file) for file in entry["files"])))


def _file_damage(folder: Path, file: dict[str, Any]) -> str:
    """Return what is wrong with a listed file, or an empty string."""
    return _read_file(folder, file)[1]


def _read_file(folder: Path, file: dict[str, Any]) -> tuple[bytes, str]:
    """Return the bytes of a listed file, and what is wrong with them or an empty string."""
    try:
        data = (folder / file["path"]).read_bytes()
    except FileNotFoundError:
        return b"", f"{file['path']} is missing"
    except OSError as error:
        return b"", f"{file['path']} cannot be read ({error.strerror})"
    is_same = hashlib.sha256(data).hexdigest() == file["sha256"] and len(data) == file.get("bytes")
    return data, "" if is_same else f"{file['path']} differs from the manifest"
