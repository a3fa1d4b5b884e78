"""Export: a finished data set in the layouts and formats that people's training code already reads.

Before: dataset.py, layouts.py, flow_files.py, picture_store.py.  After: commands.py.
`export.json` says what was exported and whether all of it is there; it is written first and, once more, last.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datagen.colour import gamma_bytes_from_linear
from datagen.dataset import BlurDataset
from datagen.entries import read_entries
from datagen.flow_files import FLOW_SUFFIXES, FlowFileError, encode_flow
from datagen.folders import read_whole_run, sweep
from datagen.layouts import CODED, FLOWS, LAYOUTS, PICTURES, Layout, place_of
from datagen.listed_files import read_listed_file
from datagen.picture_store import PAGE_BYTES, need_lmdb, write_store
from datagen.pictures import encode_png
from datagen.writer import frame_paths, write_atomically

RECORD_NAME = "export.json"
CONVENTIONS = {
    "flow": "pixels of the picture, x right, y down, p(later) = p + flow; 0 where only the background is",
    "flow_next, flow_previous": "from sharp instant to sharp instant of neighbour frames",
    "flow_exposure": "from the shutter's opening to its closing, of the point seen at the sharp instant",
    "sharp": "the instant in the middle of the exposure",
    "blur": "mean light of the exposure",
}
LIGHT_CONVENTIONS = {"sharp, blur": "sRGB curve", "sharp_gamma, blur_gamma": "power 1/2.2"}
CAMERA_CONVENTIONS = {"pictures": "as the camera of the data set's metadata took them"}


class ExportError(ValueError):
    """An export that cannot be made; `problems` has one line ``name: expected …, got …`` for each reason."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


@dataclass(frozen=True)
class ExportResult:
    """What was exported."""

    folder: Path
    frames: int
    files: int  # pictures, flow files and lists; a store counts as one


def export_dataset(
    folder: str | Path, out: str | Path, layout: str, split: str | None = None, flow_suffix: str | None = None
) -> ExportResult:
    """Write a finished data set once more, in another layout. The same call again finishes or repeats it.

    Args:
        folder: of the data set.
        out: folder to write to; created if need be, empty, or of the same export.
        layout: one of layouts.LAYOUTS.
        split: name of the part, such as `train` or `test`; the layout's own if not given.
        flow_suffix: one of FLOW_SUFFIXES; the layout's own if not given.

    Raises:
        ExportError: what does not fit, all of it, before anything is written.
        RecordError, SpecError, FileNotFoundError: `folder` holds no data set, or a damaged one.
        FrameFileError: a frame is damaged; it is named. What was written before stays.
        FlowFileError: motion that the flow format cannot hold; the frame is named.
        ModuleNotFoundError: the layout needs an optional package.

    Source: ours; layouts.py names the layouts'.
    """
    folder, out = Path(folder), Path(out)
    run = read_whole_run(folder)
    entries = read_entries(folder)
    problems = _request_problems(layout, split, flow_suffix) or _data_problems(run, entries, LAYOUTS[layout])
    if out.resolve().is_relative_to(folder.resolve()):
        problems.append(f"out: expected a folder outside of the data set {str(folder)!r}, got {str(out)!r}")
    if problems:
        raise ExportError(problems)
    form = LAYOUTS[layout]
    split, suffix = split or form.split, flow_suffix or form.flow_suffix
    if form.stores:
        need_lmdb()
    if suffix:
        encode_flow(np.zeros((1, 1, 2), np.float32), suffix)  # an optional package is missed now, not in the middle
    has_camera = run["spec"].get("sensor", "off") != "off"
    record = {
        "format": 1,
        "layout": layout,
        "split": split,
        "flow_suffix": suffix,
        "config_sha256": run["config_sha256"],
        "torchblur_version": run["torchblur_version"],
        "frames": len(entries),
        "conventions": CONVENTIONS | (CAMERA_CONVENTIONS if has_camera else LIGHT_CONVENTIONS),
    }
    _claim(out, record, len(entries))
    job = _Job(folder, out, form, split, suffix, entries, has_camera)
    files = _write_files(job) + _write_stores(job, run) + _write_list(job, run)
    _write_record(out, record | {"files": files, "is_finished": True})
    return ExportResult(out, len(entries), files)


@dataclass(frozen=True)
class _Job:
    """One export: from where to where, and how."""

    folder: Path
    out: Path
    form: Layout
    split: str
    suffix: str
    entries: dict[int, dict[str, Any]]
    has_camera: bool  # a camera took the pictures: there is no other picture of the frame then


def _request_problems(layout: str, split: str | None, flow_suffix: str | None) -> list[str]:
    """Return what is wrong with the arguments, a line each."""
    problems = []
    if layout not in LAYOUTS:
        problems.append(f"layout: expected one of {', '.join(LAYOUTS)}, got {layout!r}")
    if split is not None and not (split.isascii() and split.replace("_", "").replace("-", "").isalnum()):
        problems.append(f"split: expected letters, digits, - and _, got {split!r}")
    if flow_suffix is not None and flow_suffix not in FLOW_SUFFIXES:
        problems.append(f"flow_suffix: expected one of {', '.join(FLOW_SUFFIXES)}, got {flow_suffix!r}")
    elif flow_suffix is not None and layout in LAYOUTS and not LAYOUTS[layout].has_flow:
        with_flow = ", ".join(name for name, form in LAYOUTS.items() if form.has_flow)
        problems.append(f"flow_suffix: expected none for layout {layout}; those with flow are {with_flow}")
    return problems


def _data_problems(run: dict[str, Any], entries: dict[int, dict[str, Any]], form: Layout) -> list[str]:
    """Return what is wrong with the data set for this layout, a line each."""
    problems, spec = [], run["spec"]
    if len(entries) != spec["count"]:
        problems.append(f"folder: expected a finished data set of {spec['count']} frames, got {len(entries)} of them")
    if form.has_flow and spec["frames_per_clip"] < 2:
        problems.append("frames_per_clip: expected at least 2 for a layout with flow between frames, got 1")
    return problems


def _claim(out: Path, record: dict[str, Any], frames: int) -> None:
    """Create the folder and write its record, or raise if it holds something else."""
    place = out / RECORD_NAME
    try:
        held = sorted(p.name for p in out.iterdir()) if out.exists() else []
    except NotADirectoryError:
        raise ExportError([f"out: expected a folder, got the file {str(out)!r}"]) from None
    if place.exists():
        try:
            found = json.loads(place.read_text(encoding="utf-8"))
            problems = [
                f"{name}: expected {found.get(name)!r} as in {out}, got {value!r}"
                for name, value in record.items()
                if name not in ("conventions", "frames") and found.get(name) != value
            ]
            if found.get("frames", 0) > frames:
                problems.append(f"folder: expected at least the {found['frames']} frames of {out}, got {frames}")
        except (OSError, ValueError, AttributeError, TypeError):
            problems = [f"out: expected a readable {RECORD_NAME}, got {str(place)!r} damaged"]
        if problems:
            raise ExportError(problems)
    elif held:
        found_names = ", ".join(held[:3]) + (", …" if len(held) > 3 else "")
        raise ExportError([f"out: expected an empty folder or one of the same export, got {found_names}"])
    try:
        out.mkdir(parents=True, exist_ok=True)
        _write_record(out, record | {"is_finished": False})
    except OSError as error:
        raise ExportError([f"out: expected a folder that can be written, got {str(out)!r}: {error.strerror}"]) from None
    sweep(place for place in (out, *out.rglob("*/")) if place.is_dir())  # what a killed export left


def _write_record(out: Path, record: dict[str, Any]) -> None:
    """Write `export.json`."""
    write_atomically(out / RECORD_NAME, (json.dumps(record, indent=1, sort_keys=True) + "\n").encode())


def _write_files(job: _Job) -> int:
    """Write the pictures and flow files of all frames and return how many."""
    wanted = {content for content, _ in job.form.files}
    planes = [FLOWS[c] for c in FLOWS if c in wanted]
    planes += [{"sharp_gamma": "sharp", "blur_gamma": "blurred"}[c] for c in CODED if c in wanted]
    dataset = BlurDataset(job.folder, keys=planes) if planes else None
    count = 0
    for item, (index, entry) in enumerate(job.entries.items() if job.form.files else ()):
        frame = dataset[item] if dataset is not None else {}
        made: dict[str, bytes] = {}
        for content, path in job.form.files:
            if content in ("flow_next", "flow_previous") and not _has_neighbour(job, index, content):
                continue
            if content not in made:
                made[content] = _content(job, entry, content, frame)
            place = job.out / place_of(path, job.split, entry, job.suffix)
            place.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(place, made[content])
            count += 1
    return count


def _content(job: _Job, entry: dict[str, Any], content: str, frame: dict[str, Any]) -> bytes:
    """Return one content of one frame as the bytes of a file."""
    stored = content.removesuffix("_gamma") if job.has_camera else content
    if stored in PICTURES:
        return read_listed_file(job.folder, entry, frame_paths(entry["index"])[stored])
    if content in CODED:
        linear = frame["sharp" if content == "sharp_gamma" else "blurred"]
        return encode_png(gamma_bytes_from_linear(linear.permute(1, 2, 0)).numpy())
    flow_px = frame[FLOWS[content]].permute(1, 2, 0).numpy()
    scale = job.form.flow_scale
    try:
        return encode_flow(flow_px.repeat(scale, axis=0).repeat(scale, axis=1), job.suffix)
    except FlowFileError as error:
        raise FlowFileError(f"frame {entry['index']}: {error}") from None


def _has_neighbour(job: _Job, index: int, content: str) -> bool:
    """Tell whether the clip has the frame that a flow leads to."""
    other = job.entries.get(index + (1 if content == "flow_next" else -1))
    return other is not None and other["clip"] == job.entries[index]["clip"]


def _write_stores(job: _Job, run: dict[str, Any]) -> int:
    """Write the stores of the layout and return how many."""
    shape = (run["spec"]["height"], run["spec"]["width"], 3)
    for content, path in job.form.stores:
        sizes = [f["bytes"] for i, e in job.entries.items() for f in e["files"] if f["path"] == frame_paths(i)[content]]
        room = 2 * (sum(sizes) + 2 * PAGE_BYTES * len(sizes))  # replaced pages are free only after a commit
        write_store(job.out / path.format(split=job.split), _stored(job, content), shape, room)
    return len(job.form.stores)


def _stored(job: _Job, content: str) -> Iterator[tuple[str, bytes]]:
    """Yield name and bytes of each frame's picture."""
    for index, entry in job.entries.items():
        yield f"{index:08d}", read_listed_file(job.folder, entry, frame_paths(index)[content])


def _write_list(job: _Job, run: dict[str, Any]) -> int:
    """Write BasicSR's meta info, if the layout has one, and return how many files that were."""
    if not job.form.list_path:
        return 0
    size = f"({run['spec']['height']},{run['spec']['width']},3)"
    if job.form.list_of == "clip":
        clips: dict[int, int] = {}
        for entry in job.entries.values():
            clips[entry["clip"]] = clips.get(entry["clip"], 0) + 1
        lines = [f"{clip:03d} {frames} {size}" for clip, frames in clips.items()]
    else:
        lines = [f"{index:08d}.png {size} 1" for index in job.entries]
    write_atomically(job.out / job.form.list_path.format(split=job.split), ("\n".join(lines) + "\n").encode())
    return 1
