"""Runs: from a specification to a finished folder, however often it is interrupted.

Before: scenes.py, samples.py, writer.py, manifest.py, executors.py, report.py.  After: __main__.py.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

from datagen.executors import run_processes, run_serial
from datagen.manifest import append_entry, begin_run, locked_folder, write_manifest
from datagen.progress import Progress
from datagen.report import effect_shares, write_contact_sheet
from datagen.samples import make_sample
from datagen.scenes import Plan, survey_assets
from datagen.spec import DatasetSpec, SpecError
from datagen.writer import write_atomically, write_frame

FAILURES_NAME = "failures.json"


@dataclass(frozen=True)
class RunResult:
    """What a run achieved."""

    folder: Path
    made: int  # frames made by this run
    kept: int  # frames found finished
    failed: tuple[tuple[int, str], ...]  # (frame, reason)
    refused: tuple[tuple[str, str], ...]  # (asset, reason)
    contact_sheet: Path | None  # none if no frame is finished
    repaired: tuple[str, ...] = ()  # what an earlier run had listed and was found damaged, a line each
    effects: dict[str, float] = field(default_factory=dict)  # share of all finished frames that called for each

    @property
    def is_complete(self) -> bool:
        """Whether every frame is there and every asset was used."""
        return not self.failed and not self.refused


def generate(spec: DatasetSpec, out: str | Path, workers: int = 1, is_quiet: bool = True) -> RunResult:
    """Make the data set, or what is missing of it, and return what was achieved.

    The bytes of the frames and of the final manifest depend on the specification and the assets only.

    Args:
        spec: what to make.
        out: folder; created if need be. Finished frames in it are kept if every byte is as the manifest lists it;
            the others are made again.
        workers: processes; 0 and 1 work in this one.
        is_quiet: show no progress on stderr.

    Raises:
        SpecError: the folder holds other data, is held by another run, or `workers` is negative.
        MeshError: none of the assets can be used; nothing has been written then.

    Source: ours.
    """
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 0:
        raise SpecError([f"workers: expected an integer of at least 0, got {workers!r}"])
    roster = survey_assets(spec)
    plan = Plan(spec, roster.names, roster.sha256)
    with locked_folder(out) as folder:
        holdings = begin_run(folder, plan)
        entries, kept = holdings.entries, len(holdings.entries)
        repaired = [f"{note}; made again if a frame was lost with it" for note in holdings.notes]
        todo = [i for i in range(spec.count) if i not in entries]
        failed = []
        with Progress(spec.count, kept, is_quiet) as progress:
            if roster.refused:
                progress.say(f"{len(roster.refused)} asset files refused, listed at the end")
            for line in repaired:
                progress.say(line)
            text = plan.to_json()
            if workers <= 1:
                outcomes = run_serial(make_frame, text, str(folder), todo)
            else:
                outcomes = run_processes(make_frame, text, str(folder), todo, min(workers, max(len(todo), 1)))
            for outcome in outcomes:
                if outcome.error:
                    failed.append((outcome.index, outcome.error))
                    progress.say(f"failed frame {outcome.index}: {outcome.error}")
                else:
                    entries[outcome.index] = json.loads(outcome.text)
                    append_entry(folder, entries[outcome.index])
                    if outcome.index in holdings.damaged:
                        repaired.append(f"frame {outcome.index}: {holdings.damaged[outcome.index]}; made again")
                        progress.say(repaired[-1])
                progress.step(not outcome.error)
        write_manifest(folder, entries)
        failed.sort()
        _write_failures(folder, failed, list(roster.refused))
        sheet = write_contact_sheet(folder) if entries else None
    made = len(entries) - kept
    shares = effect_shares(entries.values())
    return RunResult(folder, made, kept, tuple(failed), roster.refused, sheet, tuple(repaired), shares)


def make_frame(plan_json: str, folder: str, index: int) -> str:
    """Make and write one frame and return its manifest entry as JSON: the task that executors run. Source: ours."""
    return json.dumps(write_frame(folder, index, make_sample(plan_json, index)))


def _write_failures(folder: Path, failed: list[tuple[int, str]], refused: list[tuple[str, str]]) -> None:
    """Leave a list of what could not be used or made, or none if there is nothing to list."""
    place = folder / FAILURES_NAME
    if not failed and not refused:
        place.unlink(missing_ok=True)
        return
    lists = {
        "frames": [{"index": i, "reason": r} for i, r in failed],
        "assets": [{"path": p, "reason": r} for p, r in refused],
    }
    write_atomically(place, (json.dumps(lists, indent=1) + "\n").encode())
