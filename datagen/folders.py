"""Folders: who works in a data set's folder, and what it was asked to hold.

Before: scenes.py, writer.py.  After: manifest.py, shards.py, runs.py.
`run.json` holds the specification. Frames are stored in files of their own, listed in `manifest.jsonl` (manifest.py),
or in tar files with a marker each (shards.py).
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torchblur as tb
from datagen.scenes import Plan
from datagen.spec import ADDED_LATER, NOT_IN_THE_BYTES, DatasetSpec, SpecError
from datagen.writer import FOLDERS, TEMPORARY_PREFIX, write_atomically

try:
    import fcntl
except ImportError:  # Windows has no such locks; two runs in one folder are then the user's to avoid
    fcntl = None  # type: ignore[assignment]

TEMPORARY_PATTERN = f"{TEMPORARY_PREFIX}[0-9]*-[0-9]*-*"
RUN_NAME, LOCK_NAME, SHARD_FOLDER = "run.json", ".lock", "shards"
MAX_SLICE_DIGITS = 9
SHARDS_FROM = 1000  # frames; below, `auto` means a file for each thing


class RecordError(ValueError):
    """What a data set says of itself is damaged; a run repairs it."""


@dataclass(frozen=True)
class Slice:
    """A part of a run: of the shards 0, 1, … every one whose number leaves `number` - 1 when divided by `of`."""

    number: int  # from 1
    of: int

    def holds(self, shard: int) -> bool:
        """Tell whether a shard belongs to it."""
        return shard % self.of == self.number - 1


def parse_slice(text: str) -> Slice:
    """Return the slice written as `3/100`, the third of a hundred.

    Raises:
        SpecError: another form, or a number that is not from 1 to the number of slices.

    Example:
        >>> parse_slice("3/100")
        Slice(number=3, of=100)

    Source: ours.
    """
    number, slash, of = text.partition("/")
    is_valid = slash and all(p.isascii() and p.isdecimal() and len(p) <= MAX_SLICE_DIGITS for p in (number, of))
    if not is_valid or not 1 <= int(number) <= int(of):
        raise SpecError([f"slice: expected i/n with i from 1 to n, got {text!r}"])
    return Slice(int(number), int(of))


@contextmanager
def locked_folder(out: str | Path, part: Slice | None = None) -> Iterator[Path]:
    """Create the folder if need be and hold it: one run at a time, or one run for each slice.

    The system lets go when the process ends, however.

    Raises:
        SpecError: another run holds it, or the path is no folder.

    Source: ours.
    """
    folder = Path(out)
    names = [LOCK_NAME] if part is None else [LOCK_NAME, f"{LOCK_NAME}-{part.number}-of-{part.of}"]
    held = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held = [os.open(folder / name, os.O_RDWR | os.O_CREAT, 0o644) for name in names]
    except OSError as error:
        why = f"{type(error).__name__}: {error.strerror}"
        raise SpecError([f"out: expected a folder that can be written, got {str(out)!r}: {why}"]) from None
    try:
        if fcntl is not None:
            try:
                for number, descriptor in enumerate(held):
                    is_shared = part is not None and number == 0
                    fcntl.flock(descriptor, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            except OSError:
                raise SpecError([f"out: expected a folder no other run works in, got {str(out)!r}"]) from None
            if part is not None:
                _refuse_other_slicings(folder, part)
        yield folder
    finally:
        for descriptor in held:
            os.close(descriptor)


def _refuse_other_slicings(folder: Path, part: Slice) -> None:
    """Raise SpecError while a run makes a part of another number of parts: both would write the same shards."""
    for place in sorted(folder.glob(f"{LOCK_NAME}-*-of-*")):
        if place.name.endswith(f"-of-{part.of}"):
            continue
        with place.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except OSError:
                other = place.name.removeprefix(f"{LOCK_NAME}-").replace("-of-", "/")
                found = f"{part.number}/{part.of} while {other} is being made"
                raise SpecError([f"slice: expected parts of one slicing at a time, got {found}"]) from None


@contextmanager
def one_at_a_time(folder: Path) -> Iterator[None]:
    """Wait until no other slice begins in the folder, and keep the others waiting. Source: ours."""
    descriptor = os.open(folder / f"{LOCK_NAME}-begin", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def settle_storage(spec: DatasetSpec, folder: Path) -> DatasetSpec:
    """Return the specification with `auto` storage decided: what the folder has, else by the number of frames.

    Source: ours.
    """
    if spec.storage != "auto":
        return spec
    try:
        storage = read_run(folder)["spec"].get("storage", "folder")
    except (SpecError, RecordError):  # what is there tells, too
        held = (name for name in (SHARD_FOLDER, *FOLDERS) if next((folder / name).glob("[0-9]*"), None))
        by_count = SHARD_FOLDER if spec.count >= SHARDS_FROM else FOLDERS[0]
        storage = "shards" if next(held, by_count) == SHARD_FOLDER else "folder"
    return spec.model_copy(update={"storage": storage})


def check_run(folder: Path, plan: Plan, is_borne_out: Callable[[], bool | None]) -> list[str]:
    """Raise unless a locked folder is empty or holds what `plan` makes, or less of it; return what is to be told.

    Args:
        folder: of the data set.
        plan: what is to be made.
        is_borne_out: tells whether all frames that are listed are the plan's, none if there are no frames. It is asked
            where the record of the run is damaged or missing, and then decides.

    Raises:
        SpecError: the folder holds data of another configuration; the fields that differ are named.

    Source: ours.
    """
    if (folder / RUN_NAME).exists():
        try:
            record = read_run(folder)
            is_whole = record.get("record_sha256") == record_sum(record)
            problems = _differences(record, _run_record(plan), folder)
        except RecordError as error:
            is_whole, problems = False, [str(error)]
        except (TypeError, ValueError):  # values of other types than were written
            is_whole, problems = False, [f"out: expected a readable {RUN_NAME}, got {str(folder / RUN_NAME)!r} damaged"]
        if is_whole and problems:
            raise SpecError(problems)
        if is_whole:
            return []
        borne_out = is_borne_out()
        if borne_out is False or (borne_out is None and problems):
            raise SpecError(problems or [f"out: expected frames as {RUN_NAME} has them in {folder}, got others"])
        return [f"{RUN_NAME}: expected a record with its checksum, got another; written again"]
    if is_borne_out():
        return [f"{RUN_NAME}: expected the record of the run, got none; written again"]
    strange = sorted(p.name for p in folder.iterdir() if not _is_left_by_a_start(p))
    if strange:  # people's own files are not to be mixed with, still less swept
        found = ", ".join(strange[:3]) + (", …" if len(strange) > 3 else "")
        raise SpecError([f"out: expected an empty folder or a data set with its {RUN_NAME}, got {found}"])
    return []


def write_run(folder: Path, plan: Plan) -> None:
    """Write `run.json`. Source: ours."""
    write_atomically(folder / RUN_NAME, encode_run(_run_record(plan)))


def read_run(folder: str | Path) -> dict[str, Any]:
    """Return what `run.json` of a data set holds.

    Raises:
        SpecError: it is missing.
        RecordError: it is damaged.

    Source: ours.
    """
    path = Path(folder) / RUN_NAME
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(record["spec"], dict):
            return record
    except FileNotFoundError:
        raise SpecError([f"folder: expected a data set with its {RUN_NAME}, got none in {str(folder)!r}"]) from None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        pass
    raise RecordError(f"out: expected a readable {RUN_NAME}, got {str(path)!r} damaged")


def read_whole_run(folder: str | Path) -> dict[str, Any]:
    """Return what `run.json` of a data set holds, compared with its checksum.

    Raises:
        SpecError: it is missing.
        RecordError: it is damaged.

    Source: ours.
    """
    record = read_run(folder)
    if record.get("record_sha256") != record_sum(record):
        place = str(Path(folder) / RUN_NAME)
        raise RecordError(f"{place}: expected a record with its checksum, got another; the next run mends it")
    return record


def encode_run(record: dict[str, Any]) -> bytes:
    """Return what `run.json` holds as its bytes. Source: ours."""
    return (json.dumps(record, indent=1, sort_keys=True) + "\n").encode()


def record_sum(record: dict[str, Any]) -> str:
    """Return the checksum of all that a record holds but `record_sha256`, which is this checksum. Source: ours."""
    fields = {name: value for name, value in record.items() if name != "record_sha256"}
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def sweep(places: Iterable[Path], names: Iterable[str] = ("*",)) -> None:
    """Remove temporary files that killed runs left in some folders.

    Args:
        places: folders of a data set.
        names: final names, as glob patterns, of what may be removed; by default all.

    Source: ours.
    """
    for holder in places:
        for name in names:
            for stale in holder.glob(f"{TEMPORARY_PREFIX}[0-9]*-[0-9]*-{name}"):
                stale.unlink(missing_ok=True)


def drop_empty(folder: Path, names: Iterable[str]) -> None:
    """Remove those of a data set's folders that are there and empty. Source: ours."""
    for name in names:
        if (folder / name).is_dir() and not any((folder / name).iterdir()):
            (folder / name).rmdir()


def _is_left_by_a_start(path: Path) -> bool:
    """Tell whether a run that was killed before its run.json was there can have left this."""
    if path.name in (*FOLDERS, SHARD_FOLDER):
        return path.is_dir() and not any(path.iterdir())
    return path.name == LOCK_NAME or path.name.startswith(f"{LOCK_NAME}-") or path.match(TEMPORARY_PATTERN)


def _run_record(plan: Plan) -> dict[str, Any]:
    """Return what run.json holds."""
    record = {
        "format": 1,
        "spec": plan.spec.model_dump(),
        "assets_sha256": plan.assets_sha256,
        "asset_names": list(plan.asset_names),
        "texture_names": list(plan.texture_names),
        "background_names": list(plan.background_names),
        "config_sha256": plan.config_sha256,
        "torchblur_version": tb.__version__,
    }
    return record | {"record_sha256": record_sum(record)}


def _differences(found: dict[str, Any], wanted: dict[str, Any], folder: Path) -> list[str]:
    """Return one line for each field in which a folder's data differ from what is asked for."""
    problems = []
    as_before = {"storage": "folder"} | ADDED_LATER
    was_spec, now_spec = as_before | found["spec"], wanted["spec"]
    fixed = set(was_spec) | set(now_spec)
    fixed -= set(NOT_IN_THE_BYTES)
    fixed |= {"storage"} | ({"frames_per_shard"} if now_spec["storage"] == was_spec["storage"] == "shards" else set())
    for name in sorted(fixed):
        was, now = was_spec.get(name), now_spec.get(name)
        if was != now:
            problems.append(f"{name}: expected {was!r} as in {folder}, got {now!r}")
    for name in ("textures", "backgrounds"):
        was, now = was_spec.get(name), now_spec[name]
        if (was is None) != (now is None):
            problems.append(f"{name}: expected {was!r} as in {folder}, got {now!r}")
    if was_spec.get("count", 0) > now_spec["count"]:
        had, asked = was_spec["count"], now_spec["count"]
        problems.append(f"count: expected at least the {had} frames of {folder}, got {asked}")
    for name in ("format", "assets_sha256", "torchblur_version"):
        if found.get(name) != wanted[name] and not (name == "assets_sha256" and problems):
            problems.append(f"{name}: expected {found.get(name)!r} as in {folder}, got {wanted[name]!r}")
    return problems
