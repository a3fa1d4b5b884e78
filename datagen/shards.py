"""Shards: many frames in one tar file, as WebDataset's loaders read them, with a marker that says it is whole.

Before: folders.py, listed_files.py, manifest.py.  After: entries.py, runs.py.
`shards/000003.tar` holds, for each frame, `00000300.exr`, `00000300.sharp.png` and `00000300.blur.png`;
`shards/000003.json`, the marker, has the tar's checksum and each file's place, size and checksum, and one of its own.
The marker is the commit point: it is written last, by renaming, and taken away before its tar is replaced.
A frame that fails is left out and its shard made again by the next run.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from datagen.folders import (
    RUN_NAME,
    SHARD_FOLDER,
    Slice,
    check_run,
    drop_empty,
    one_at_a_time,
    record_sum,
    sweep,
    write_run,
)
from datagen.listed_files import entry_damage, file_damage, is_listed, read_listed_file
from datagen.manifest import Holdings, ManifestError
from datagen.samples import Sample
from datagen.scenes import Plan
from datagen.spec import DatasetSpec, SpecError
from datagen.writer import (
    FOLDERS,
    FrameFileError,
    atomic_file,
    frame_contents,
    frame_notes,
    frame_paths,
    list_file,
    sync_folder,
    write_atomically,
)

MEMBERS = {"exr": "{:08d}.exr", "sharp": "{:08d}.sharp.png", "blur": "{:08d}.blur.png"}
HASH_BLOCK_BYTES = 2**20


def tar_path(number: int) -> str:
    """Return the relative path of a shard's tar file. Source: ours."""
    return f"{SHARD_FOLDER}/{number:06d}.tar"


def marker_path(number: int) -> str:
    """Return the relative path of a shard's marker. Source: ours."""
    return f"{SHARD_FOLDER}/{number:06d}.json"


def shard_frames(spec: DatasetSpec, number: int) -> range:
    """Return the frames of a shard. Source: ours."""
    first = number * spec.frames_per_shard
    return range(first, min(first + spec.frames_per_shard, spec.count))


def run_shards(spec: DatasetSpec, part: Slice | None) -> list[int]:
    """Return the numbers of the shards that a run makes. Source: ours."""
    return [n for n in range(-(-spec.count // spec.frames_per_shard)) if part is None or part.holds(n)]


def begin_shards(folder: Path, plan: Plan, part: Slice | None = None) -> Holdings:
    """Prepare a locked folder for a run and return what it already holds of the run's shards.

    Files of theirs left behind by a killed run are removed. Every byte is read and compared with its checksum.

    Args:
        folder: held by `locked_folder`.
        plan: what will be made, its storage `shards`.
        part: the slice that the run is to make; all if none. Slices begin one at a time.

    Raises:
        SpecError: the folder holds data of another configuration; the fields that differ are named.

    Source: ours.
    """
    numbers = run_shards(plan.spec, part)
    with one_at_a_time(folder):
        notes = check_run(folder, plan, lambda: _bear_out(folder, plan))
        drop_empty(folder, FOLDERS)  # of a start with the other storage
        (folder / SHARD_FOLDER).mkdir(exist_ok=True)
        if part is not None:
            sweep((folder,), (RUN_NAME, f"*-{part.number}-of-{part.of}.json"))
        sweep_shards(folder, plan.spec, part)
        write_run(folder, plan)
    entries: dict[int, dict[str, Any]] = {}
    damaged: dict[int, str] = {}
    for number in numbers:
        if not (folder / marker_path(number)).exists():
            continue
        try:
            marker = read_marker(folder, number)
        except ManifestError as error:
            notes.append(str(error))
            continue
        if marker["config_sha256"] != plan.config_sha256:
            wanted, found = plan.config_sha256, marker["config_sha256"]
            raise SpecError([f"out: expected frames of configuration {wanted} in {folder}, got {found}"])
        held = marker_entries(marker)
        if problems := shard_damage(folder, number, marker):
            lost = {entry["index"]: entry_damage(folder, entry) for entry in held}
            damaged |= {index: problem for index, problem in lost.items() if problem}
            notes += [] if any(lost.values()) else problems
        elif [entry["index"] for entry in held] == list(shard_frames(plan.spec, number)):
            entries |= {entry["index"]: entry for entry in held}
    return Holdings(entries, damaged, tuple(notes))


def sweep_shards(folder: Path, spec: DatasetSpec, part: Slice | None = None) -> None:
    """Remove what killed processes left of a run's shards; without a slice, all that was left. Source: ours."""
    if part is None:
        sweep((folder, folder / SHARD_FOLDER))
        return
    numbers = run_shards(spec, part)  # other slices may be at work on the other shards
    sweep((folder / SHARD_FOLDER,), [Path(path(n)).name for n in numbers for path in (tar_path, marker_path)])


def write_shard(
    folder: str | Path, number: int, plan: Plan, make: Callable[[int], Sample]
) -> tuple[list[dict[str, Any]], list[tuple[int, str]]]:
    """Make what is missing of a shard, write tar and marker, and return (entries, failures as (frame, reason)).

    Args:
        folder: of the data set; its sub-folder exists.
        number: of the shard.
        plan: what the shard belongs to.
        make: returns a frame's sample. An exception in it is that frame's failure.

    Raises:
        OSError: the disk is full or not writable; an earlier state of the shard stays as long as the new one is not
            written in full.

    Source: ours.
    """
    folder = Path(folder)
    marker_place = folder / marker_path(number)
    frames: list[dict[str, Any]] = []
    failed: list[tuple[int, str]] = []
    held = _held_frames(folder, number, plan)
    try:
        with atomic_file(folder / tar_path(number)) as file:
            with tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as tar:
                for index in shard_frames(plan.spec, number):
                    try:
                        contents = _read_held(folder, held[index]) if index in held else None
                        if contents is None:
                            sample = make(index)
                            contents, notes = frame_contents(sample), frame_notes(sample)
                        else:
                            notes = {k: held[index][k] for k in ("effects", "baselines") if k in held[index]}
                    except Exception as error:
                        failed.append((index, f"{type(error).__name__}: {' '.join(str(error).split())}"))
                        continue
                    files = [_add(tar, file, MEMBERS[kind].format(index), data) for kind, data in contents.items()]
                    clip, frame = plan.spec.clip_and_frame(index)
                    frames.append({"index": index, "clip": clip, "frame": frame, **notes, "files": files})
            if not frames:
                raise _EveryFrameFailed
            file.flush()
            os.fsync(file.fileno())
            size, tar_sum = file.tell(), _sum_of(Path(file.name))
            if marker_place.exists():  # a marker must never stand beside another tar than its own
                marker_place.unlink()
                sync_folder(marker_place.parent)
    except _EveryFrameFailed:
        return [], failed
    marker = {
        "format": 1,
        "shard": number,
        "bytes": size,
        "sha256": tar_sum,
        "config_sha256": plan.config_sha256,
        "frames": frames,
    }
    marker["record_sha256"] = record_sum(marker)
    write_atomically(marker_place, _encode_marker(marker))
    return marker_entries(marker), failed


def read_marker(folder: Path, number: int) -> dict[str, Any]:
    """Return a shard's marker, every byte of it checked.

    Raises:
        ManifestError: it is damaged.

    Source: ours.
    """
    place = folder / marker_path(number)
    try:
        data = place.read_bytes()
        marker = json.loads(data)
        is_valid = marker["record_sha256"] == record_sum(marker) and _encode_marker(marker) == data
        is_valid = is_valid and marker["shard"] == number and type(marker["bytes"]) is int
        files = [file for entry in marker_entries(marker) for file in entry["files"]]
        is_valid = is_valid and bool(files) and all(is_listed(file) and "offset" in file for file in files)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        is_valid = False
    if not is_valid:
        raise ManifestError(f"{marker_path(number)}: expected a shard's marker, got one that is damaged")
    return marker


def scan_shards(folder: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the markers that are there, by shard number, and a note on each that is damaged. Source: ours."""
    markers, notes = [], []
    for place in sorted((folder / SHARD_FOLDER).glob("[0-9]*.json")):
        number = int(place.stem) if place.stem.isdecimal() else -1
        if number < 0 or marker_path(number) != f"{SHARD_FOLDER}/{place.name}":
            notes.append(f"{SHARD_FOLDER}/{place.name}: expected a shard's marker, got another name")
            continue
        try:
            markers.append(read_marker(folder, number))
        except ManifestError as error:
            if place.exists():  # else its shard is being made once more
                notes.append(str(error))
    return markers, notes


def marker_entries(marker: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the frames of a marker as entries such as a manifest has, with the place of each file. Source: ours."""
    entries = []
    for frame in marker["frames"]:
        paths = frame_paths(frame["index"])
        kinds = {MEMBERS[kind].format(frame["index"]): kind for kind in MEMBERS}
        files = [
            file | {"path": paths[kinds[file["path"]]], "tar": tar_path(marker["shard"])} for file in frame["files"]
        ]
        entries.append({**frame, "config_sha256": marker["config_sha256"], "files": files})
    return entries


def shard_damage(folder: Path, number: int, marker: dict[str, Any]) -> list[str]:
    """Return what is wrong with a marked tar, down to the frames' files; empty if every byte is as marked.

    Source: ours.
    """
    place = folder / tar_path(number)
    try:
        if place.stat().st_size == marker["bytes"] and _sum_of(place) == marker["sha256"]:
            return []
    except FileNotFoundError:
        return [f"{tar_path(number)} is missing"]
    except OSError as error:
        return [f"{tar_path(number)} cannot be read ({error.strerror})"]
    files = [file for entry in marker_entries(marker) for file in entry["files"]]
    damages = [damage for damage in (file_damage(folder, file) for file in files) if damage]
    return damages or [f"{tar_path(number)} differs from its marker between its files"]


def _bear_out(folder: Path, plan: Plan) -> bool | None:
    """Tell whether all frames that are listed are in the shards where a plan puts them; none if there are no frames."""
    markers, _ = scan_shards(folder)
    if not markers:
        return None
    return all(
        marker["config_sha256"] == plan.config_sha256
        and all(frame["index"] in shard_frames(plan.spec, marker["shard"]) for frame in marker["frames"])
        for marker in markers
    )


class _EveryFrameFailed(Exception):
    """There is nothing to put into the tar."""


def _held_frames(folder: Path, number: int, plan: Plan) -> dict[int, dict[str, Any]]:
    """Return the entries, by frame, of what an earlier run has put into the shard."""
    try:
        marker = read_marker(folder, number)
    except ManifestError:
        return {}
    held = marker_entries(marker) if marker["config_sha256"] == plan.config_sha256 else []
    return {entry["index"]: entry for entry in held}


def _read_held(folder: Path, entry: dict[str, Any]) -> dict[str, bytes] | None:
    """Return the bytes of a frame's files, or none if they are damaged."""
    try:
        return {kind: read_listed_file(folder, entry, path) for kind, path in frame_paths(entry["index"]).items()}
    except FrameFileError:
        return None


def _add(tar: tarfile.TarFile, file: Any, name: str, data: bytes) -> dict[str, Any]:
    """Add a file to a tar, the same bytes for the same input, and return how the marker lists it."""
    start = file.tell()
    member = tarfile.TarInfo(name)  # time, owner and group 0
    member.size = len(data)
    tar.addfile(member, io.BytesIO(data))
    return list_file(name, data) | {"offset": start + tarfile.BLOCKSIZE}


def _sum_of(path: Path) -> str:
    """Return a file's checksum, read in blocks."""
    total = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(HASH_BLOCK_BYTES):
            total.update(block)
    return total.hexdigest()


def _encode_marker(marker: dict[str, Any]) -> bytes:
    """Return a marker as the bytes of its file."""
    return json.dumps(marker, sort_keys=True).encode() + b"\n"
