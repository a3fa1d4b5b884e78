"""Manifest: which frames of a folder are finished, and what they were made from.

Before: writer.py.  After: runs.py, dataset.py.
`run.json` holds the specification; `manifest.jsonl` one line for each finished frame, with the checksums of its files.
A frame counts from the moment its line is on the disk: that line is the commit point.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torchblur as tb
from datagen.scenes import Plan
from datagen.spec import NOT_IN_THE_BYTES, SpecError
from datagen.writer import FOLDERS, TEMPORARY_PREFIX, frame_paths, sync_folder, write_atomically

try:
    import fcntl
except ImportError:  # Windows has no such locks; two runs in one folder are then the user's to avoid
    fcntl = None  # type: ignore[assignment]

TEMPORARY_PATTERN = f"{TEMPORARY_PREFIX}[0-9]*-[0-9]*-*"
RUN_NAME, MANIFEST_NAME, LOCK_NAME = "run.json", "manifest.jsonl", ".lock"


class ManifestError(ValueError):
    """A manifest that is damaged other than by a line cut short at its end."""


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


def begin_run(folder: Path, plan: Plan) -> dict[int, dict[str, Any]]:
    """Prepare a locked folder for a run and return the entries of the frames it already holds.

    Files left behind by a killed run are removed. Frames whose files are gone or have another size are not returned.

    Args:
        folder: held by `locked_folder`.
        plan: what will be made.

    Raises:
        SpecError: the folder holds data of another configuration; the fields that differ are named.
        ManifestError: its manifest is damaged.

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
    for name in FOLDERS:
        (folder / name).mkdir(exist_ok=True)
    for holder in (folder, *(folder / name for name in FOLDERS)):
        for stale in holder.glob(TEMPORARY_PATTERN):
            stale.unlink(missing_ok=True)
    entries = read_manifest(folder) if (folder / MANIFEST_NAME).exists() else {}
    entries = {i: e for i, e in entries.items() if _files_are_there(folder, e)}
    write_atomically(place, (json.dumps(wanted, indent=1, sort_keys=True) + "\n").encode())
    write_manifest(folder, entries)  # without a torn line, so that new ones start on their own
    return entries


def read_manifest(folder: str | Path) -> dict[int, dict[str, Any]]:
    """Return the entries by frame number, in that order. A last line that was cut short is passed over.

    Raises:
        ManifestError: any other damage, or a frame listed twice with different files.
        FileNotFoundError: there is no manifest.

    Source: ours.
    """
    path = Path(folder) / MANIFEST_NAME
    lines = path.read_bytes().split(b"\n")
    entries: dict[int, dict[str, Any]] = {}
    for number, line in enumerate(lines[:-1]):  # what follows the last line end was not finished
        try:
            entry = json.loads(line)
            index = entry["index"]
            complete = isinstance(index, int) and index >= 0 and all(f["path"] and f["sha256"] for f in entry["files"])
        except (ValueError, KeyError, TypeError):
            complete = False
        if not complete:
            raise ManifestError(f"{path}: expected a finished frame in line {number + 1}, got {line[:60]!r}")
        if entries.setdefault(index, entry) != entry:
            raise ManifestError(f"{path}: expected one entry of frame {index}, got two that differ")
    return dict(sorted(entries.items()))


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


def _files_are_there(folder: Path, entry: dict[str, Any]) -> bool:
    """Tell whether all files of an entry exist with the size they were written with."""
    expected = set(frame_paths(entry["index"]).values())
    sizes = {f["path"]: f["bytes"] for f in entry["files"]}
    if set(sizes) != expected:
        return False
    return all((folder / p).is_file() and (folder / p).stat().st_size == n for p, n in sizes.items())
