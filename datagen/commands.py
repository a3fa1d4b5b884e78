"""Commands: what the command line does beside its parsing, each a dataclass of its options with `run() -> exit code`.

Before: spec.py; the others are imported when a command runs, so that help need not wait for torch.
After: __main__.py.
Exit codes: 0 all done; 1 frames failed, are missing, or assets were refused, which are listed; 2 wrong usage or
configuration; 3 verification failed; 130 interrupted.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from datagen.spec import ADDED_LATER, DatasetSpec, SpecError, parse_spec

EXIT_DONE, EXIT_FAILURES, EXIT_USAGE, EXIT_DAMAGED, EXIT_INTERRUPTED = 0, 1, 2, 3, 130


@dataclass(frozen=True)
class Init:
    """Write a configuration file with every field, its default and what it may be."""

    out: str | None = None
    """File to write, which must not exist; standard output if not given."""

    def run(self) -> int:
        """Write the file. Source: ours."""
        text = spec_toml()
        if self.out is None:
            print(text, end="")
            return EXIT_DONE
        try:
            with Path(self.out).open("x", encoding="utf-8") as file:
                file.write(text)
        except OSError as error:
            return tell_usage([f"out: expected a new file that can be written, got {self.out!r}: {error.strerror}"])
        return EXIT_DONE


@dataclass(frozen=True)
class Status:
    """Tell how far a data set is: exit code 0 if it is complete."""

    folder: str
    """Of the data set."""

    def run(self) -> int:
        """Print the counts. Source: ours."""
        from datagen.checks import read_status

        status = read_status(self.folder)
        print(f"{status.finished} of {status.spec.count} frames finished, {len(status.failed)} failed in {self.folder}")
        tell_failures(status.failed, status.refused)
        return EXIT_DONE if status.is_complete and not status.refused else EXIT_FAILURES


@dataclass(frozen=True)
class Verify:
    """Compare every byte of a data set with its checksums: exit code 0 if all is as written, 3 if not."""

    folder: str
    """Of the data set."""

    def run(self) -> int:
        """Print what is damaged. Source: ours."""
        from datagen.checks import verify_dataset

        problems = verify_dataset(self.folder)
        for problem in problems:
            print(f"damaged: {problem}", file=sys.stderr)
        print(f"{len(problems)} problems in {self.folder}")
        return EXIT_DAMAGED if problems else EXIT_DONE


@dataclass(frozen=True)
class Retry:
    """Make what is missing, failed or damaged in a data set, as its run.json asks for."""

    folder: str
    """Of the data set."""
    workers: int = 1
    """Processes that make frames; 0 and 1 work in this one."""
    executor: Literal["local", "ray"] = "local"
    """Processes of this machine, or Ray's workers."""
    assets: str | None = None
    """Where the assets are now, if not where run.json has them."""
    textures: str | None = None
    """Where the pictures for textures are now."""
    backgrounds: str | None = None
    """Where the pictures for backgrounds are now."""

    def run(self) -> int:
        """Make the frames. Source: ours."""
        from datagen.folders import read_run

        places = {"assets": self.assets, "textures": self.textures, "backgrounds": self.backgrounds}
        moved = {name: place for name, place in places.items() if place is not None}
        spec = parse_spec(ADDED_LATER | read_run(self.folder)["spec"] | moved)
        return make_dataset(spec, self.folder, self.workers, executor=self.executor)


@dataclass(frozen=True)
class Export:
    """Write a finished data set once more, in a layout that training code reads."""

    folder: str
    """Of the data set."""
    out: str
    """Folder to write to; new, empty, or of the same export."""
    layout: str
    """gopro, reds, sintel, spring, basicsr or lmdb."""
    split: str | None = None
    """Name of the part, such as train or test; the layout's own if not given."""
    flow_suffix: str | None = None
    """.flo, .pfm, .png (KITTI) or .flo5; the layout's own if not given."""

    def run(self) -> int:
        """Write the layout. Source: ours."""
        from datagen.export import ExportError, export_dataset
        from datagen.flow_files import FlowFileError

        try:
            result = export_dataset(self.folder, self.out, self.layout, self.split, self.flow_suffix)
        except (ExportError, ModuleNotFoundError) as error:
            return tell_usage(str(error).splitlines())
        except FlowFileError as error:
            print(f"error: {error}", file=sys.stderr)
            return EXIT_FAILURES
        print(f"{result.frames} frames, {result.files} files in {result.folder}")
        return EXIT_DONE


@dataclass(frozen=True)
class Report:
    """Write one HTML page about a data set: counts, failures, distributions, samples."""

    folder: str
    """Of the data set."""
    out: str | None = None
    """File to write; `report.html` in the folder if not given."""

    def run(self) -> int:
        """Write the page. Source: ours."""
        from datagen.checks import read_status
        from datagen.pages import write_page

        if not read_status(self.folder).finished:
            return tell_usage([f"folder: expected at least one finished frame, got none in {self.folder!r}"])
        place = Path(self.folder) / "report.html" if self.out is None else Path(self.out)
        if not place.parent.is_dir() or place.is_dir():
            return tell_usage([f"out: expected a file in a folder that is there, got {self.out!r}"])
        print(write_page(self.folder, place))
        return EXIT_DONE


@dataclass(frozen=True)
class Inspect:
    """Print what a frame holds: parts, channels, ranges, metadata."""

    path: str
    """An .exr file of a data set, or the data set's folder."""
    frame: int | None = None
    """Number of the frame, for a folder."""

    def run(self) -> int:
        """Print the frame. Source: ours."""
        import numpy as np

        from datagen.writer import decode_exr, read_exr

        if Path(self.path).is_dir() != (self.frame is not None):
            return tell_usage([f"path: expected an .exr file, or a folder and --frame, got {self.path!r}"])
        if self.frame is None:
            parts, meta = read_exr(self.path)
        else:
            from datagen.entries import read_entries
            from datagen.listed_files import read_listed_file
            from datagen.writer import frame_paths

            entry = read_entries(self.path).get(self.frame)
            if entry is None:
                return tell_usage([f"frame: expected one that is finished in {self.path}, got {self.frame}"])
            exr = frame_paths(self.frame)["exr"]
            parts, meta = decode_exr(read_listed_file(self.path, entry, exr), exr)
        height, width = parts["data"]["A"].shape
        print(f"{self.path}: frame {meta.get('index')}, {width} x {height} px")
        print(f"{'part':10} {'channel':12} {'type':8} {'least':>12} {'greatest':>12} {'not finite':>11}")
        for part, channels in parts.items():
            for name, plane in channels.items():
                finite = plane[np.isfinite(plane)]
                ends = (f"{finite.min():g}", f"{finite.max():g}") if finite.size else ("-", "-")
                lost = plane.size - finite.size
                print(f"{part:10} {name:12} {plane.dtype!s:8} {ends[0]:>12} {ends[1]:>12} {lost:>11}")
        print(json.dumps(meta, indent=1, sort_keys=True))
        return EXIT_DONE


COMMANDS = {
    "init": Init,
    "status": Status,
    "verify": Verify,
    "retry": Retry,
    "export": Export,
    "inspect": Inspect,
    "report": Report,
}


def run_command(command: Any) -> int:
    """Run one of COMMANDS, parsed, and return the exit code; what is wrong is told without a traceback.

    Source: ours.
    """
    from datagen.folders import RecordError
    from datagen.writer import FrameFileError

    try:
        return command.run()
    except SpecError as error:
        return tell_usage(error.problems)
    except (FileNotFoundError, NotADirectoryError) as error:
        return tell_usage([f"expected a data set, got none: {error.filename or error}"])
    except BrokenPipeError:
        raise
    except (RecordError, FrameFileError) as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_DAMAGED
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_FAILURES


def make_dataset(
    spec: DatasetSpec, out: str, workers: int, slice_text: str | None = None, executor: str = "local"
) -> int:
    """Generate, tell how it went, and return the exit code.

    Args:
        spec: what to make.
        out: folder of the data set.
        workers: processes.
        slice_text: as `3/100`; all if not given.
        executor: `local` or `ray`.

    Source: ours.
    """
    from datagen.folders import parse_slice
    from datagen.formats import MeshError
    from datagen.runs import generate
    from datagen.writer import FrameFileError

    try:
        part = None if slice_text is None else parse_slice(slice_text)
        result = generate(spec, out, workers, is_quiet=False, part=part, executor=executor)
    except (SpecError, MeshError) as error:
        return tell_usage(str(error).splitlines())
    except (OSError, FrameFileError) as error:  # frames that are listed stay whole; the rest can be made again
        print(f"error: {error}", file=sys.stderr)
        return EXIT_FAILURES
    print(f"{result.made} frames made, {result.kept} kept, {len(result.failed)} failed in {result.folder}")
    if result.effects:
        print("effects, in share of the frames: " + ", ".join(f"{n} {s:.0%}" for n, s in result.effects.items()))
    if result.contact_sheet is not None:
        print(f"contact sheet: {result.contact_sheet}")
    tell_failures(result.failed, result.refused)
    return EXIT_DONE if result.is_complete else EXIT_FAILURES


def tell_failures(failed: Sequence[tuple[int, str]], refused: Sequence[tuple[str, str]]) -> None:
    """Print a line for each frame that failed and each asset that was refused. Source: ours."""
    for index, reason in failed:
        print(f"failed frame {index}: {reason}", file=sys.stderr)
    for name, reason in refused:
        print(f"refused {name}: {reason}", file=sys.stderr)


def tell_usage(problems: Sequence[str]) -> int:
    """Print what is wrong, a line each, and return the exit code. Source: ours."""
    for problem in problems:
        print(f"error: {problem}", file=sys.stderr)
    return EXIT_USAGE


def spec_toml() -> str:
    """Return a configuration file with every field of a specification, its default and what it may be. Source: ours."""
    lines = []
    for name, schema in DatasetSpec.model_json_schema()["properties"].items():
        default = DatasetSpec.model_fields[name].default
        value = f'# {name} = ""' if default is None else f"{name} = {json.dumps(default)}"
        lines.append(f"{value}  # {_allowed(schema)}")
    return "\n".join(lines) + "\n"


def _allowed(schema: dict[str, Any]) -> str:
    """Return what a field may be, from its JSON schema."""
    if "enum" in schema:
        return " or ".join(schema["enum"])
    if "anyOf" in schema:
        return "text, or none"
    bounds = [
        f"{words} {schema[key]}"
        for key, words in (
            ("minimum", "at least"),
            ("exclusiveMinimum", "above"),
            ("maximum", "at most"),
            ("exclusiveMaximum", "below"),
        )
        if key in schema
    ]
    return f"{schema['type']}, {', '.join(bounds)}"
