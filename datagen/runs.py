"""Runs: from a specification to a finished folder, however often it is interrupted.

Before: ahead.py, samples.py, sensor.py, manifest.py, shards.py, executors.py, ray_executor.py, report.py, run_log.py.
After: commands.py.
A task is a frame, or a shard's frames; both return {`entries`, `failed`} as JSON.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from datagen.ahead import compile_ahead
from datagen.executors import Outcome, Task, run_processes, run_serial
from datagen.folders import Slice, encode_run, locked_folder, record_sum, settle_storage
from datagen.manifest import Holdings, append_entry, begin_run, sweep_frames, write_manifest
from datagen.progress import Progress
from datagen.ray_executor import check_ray, run_ray
from datagen.report import effect_shares, write_contact_sheet
from datagen.run_log import drop_damaged_lines, logged_run
from datagen.samples import Sample, make_sample
from datagen.scenes import Plan, plan_from_json, survey_plan
from datagen.sensor import photograph
from datagen.shards import begin_shards, run_shards, shard_frames, sweep_shards, write_shard
from datagen.spec import DatasetSpec, SpecError
from datagen.writer import write_atomically, write_frame

FAILURES_NAME = "failures.json"
EXECUTORS = ("local", "ray")


@dataclass(frozen=True)
class RunResult:
    """What a run achieved."""

    folder: Path
    made: int  # frames made by this run, and those put once more into a shard that had to be completed
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


def generate(
    spec: DatasetSpec,
    out: str | Path,
    workers: int = 1,
    is_quiet: bool = True,
    part: Slice | None = None,
    executor: str = "local",
) -> RunResult:
    """Make the data set, or what is missing of it, and return what was achieved.

    The bytes of the frames and of the final lists depend on the specification and the assets only.

    Args:
        spec: what to make.
        out: folder; created if need be. Finished frames in it are kept if every byte is as listed; the others are
            made again.
        workers: processes; 0 and 1 work in this one.
        is_quiet: show no progress on stderr.
        part: make these shards only; other slices may be made at the same time. Needs storage `shards`.
        executor: one of EXECUTORS: `local` (processes of this machine) or `ray` (Ray's workers, `workers` at a time).

    Raises:
        SpecError: the folder holds other data, is held by another run, or `workers` is negative, or a slice of what
            is not stored in shards is asked for, or the executor is not there.
        MeshError: none of the assets can be used; nothing has been written then.

    Source: ours.
    """
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 0:
        raise SpecError([f"workers: expected an integer of at least 0, got {workers!r}"])
    if executor not in EXECUTORS:
        raise SpecError([f"executor: expected one of {', '.join(EXECUTORS)}, got {executor!r}"])
    if executor == "ray":
        check_ray()
    spec = settle_storage(spec, Path(out))
    if part is not None and spec.storage != "shards":
        raise SpecError([f"storage: expected shards for a slice, got {spec.storage}"])
    plan, refused = survey_plan(spec)
    part_text = f"{part.number}/{part.of}" if part else ""
    with locked_folder(out, part) as folder, logged_run(folder, max(workers, 1), part_text) as note:
        run = _begin(folder, plan, part)
        if part is None:
            drop_damaged_lines(folder)
        entries, kept = run.holdings.entries, len(run.holdings.entries)
        repaired = [f"{note}; made again if a frame was lost with it" for note in run.holdings.notes]
        failed = []
        with Progress(run.total, kept, is_quiet) as progress:
            if refused:
                progress.say(f"{len(refused)} asset files refused, listed at the end")
            for line in repaired:
                progress.say(line)
            text = _placed(plan).to_json()
            processes = min(max(workers, 1), max(len(run.todo), 1))
            if processes > 1 and spec.backend == "auto":
                compile_ahead()
            if executor == "ray":
                outcomes = run_ray(run.task, text, str(folder), run.todo, processes)
            elif workers <= 1:
                outcomes = run_serial(run.task, text, str(folder), run.todo)
            else:
                outcomes = run_processes(run.task, text, str(folder), run.todo, processes)
            for outcome in outcomes:
                made, lost = _frames_of(outcome, run)
                failed += lost
                note.made, note.failed = note.made + len(made), note.failed + len(lost)
                for index, reason in lost:
                    progress.say(f"failed frame {index}: {reason}")
                    progress.step(is_done=False)
                for entry in made:
                    index = entry["index"]
                    entries[index] = entry
                    if run.task is make_frame:
                        append_entry(folder, entry)
                    if index in run.holdings.damaged:
                        repaired.append(f"frame {index}: {run.holdings.damaged[index]}; made again")
                        progress.say(repaired[-1])
                    progress.step(is_done=True)
        if run.task is make_frame:
            write_manifest(folder, entries)
            sweep_frames(folder)
        else:
            sweep_shards(folder, spec, part)
        failed.sort()
        _write_failures(folder, failed, list(refused), part)
        sheet = write_contact_sheet(folder) if entries and part is None else None
    made_count, shares = len(entries) - kept, effect_shares(entries.values())
    return RunResult(folder, made_count, kept, tuple(failed), refused, sheet, tuple(repaired), shares)


def make_frame(plan_json: str, folder: str, index: int) -> str:
    """Make and write one frame: the task that executors run for storage `folder`. Source: ours."""
    return json.dumps({"entries": [write_frame(folder, index, _take(plan_json, index))], "failed": []})


def make_shard(plan_json: str, folder: str, number: int) -> str:
    """Make and write one shard: the task that executors run for storage `shards`. Source: ours."""
    made, failed = write_shard(folder, number, plan_from_json(plan_json), lambda index: _take(plan_json, index))
    return json.dumps({"entries": made, "failed": failed})


def _take(plan_json: str, index: int) -> Sample:
    """Return a frame's sample with its pictures."""
    return photograph(make_sample(plan_json, index), plan_from_json(plan_json).spec, index)


def _placed(plan: Plan) -> Plan:
    """Return the plan with whole paths, for workers that may have started in another folder."""
    places = {name: getattr(plan.spec, name) for name in ("assets", "textures", "backgrounds")}
    whole = {name: str(Path(place).absolute()) for name, place in places.items() if place is not None}
    return replace(plan, spec=plan.spec.model_copy(update=whole))


@dataclass(frozen=True)
class _Run:
    """What there is to do."""

    task: Task
    todo: list[int]  # numbers of frames or of shards
    holdings: Holdings
    total: int  # frames of this run, those that are there included
    plan: Plan


def _begin(folder: Path, plan: Plan, part: Slice | None) -> _Run:
    """Prepare a locked folder and return what is missing."""
    spec = plan.spec
    if spec.storage == "folder":
        holdings = begin_run(folder, plan)
        todo = [i for i in range(spec.count) if i not in holdings.entries]
        return _Run(make_frame, todo, holdings, spec.count, plan)
    mine = run_shards(spec, part)
    holdings = begin_shards(folder, plan, part)
    todo = [number for number in mine if shard_frames(spec, number)[0] not in holdings.entries]
    return _Run(make_shard, todo, holdings, sum(len(shard_frames(spec, number)) for number in mine), plan)


def _frames_of(outcome: Outcome, run: _Run) -> tuple[list[dict[str, Any]], list[tuple[int, str]]]:
    """Return the entries and failures, as (frame, reason), of a task."""
    if not outcome.error:
        result = json.loads(outcome.text)
        return result["entries"], [(index, reason) for index, reason in result["failed"]]
    frames = [outcome.index] if run.task is make_frame else shard_frames(run.plan.spec, outcome.index)
    return [], [(index, outcome.error) for index in frames]


def _write_failures(
    folder: Path, failed: list[tuple[int, str]], refused: list[tuple[str, str]], part: Slice | None
) -> None:
    """Leave a list of what could not be used or made, or none if there is nothing to list. A slice has its own."""
    place = folder / (f"failures-{part.number}-of-{part.of}.json" if part else FAILURES_NAME)
    if part is None:  # this run has tried what any slice could not make
        for old in folder.glob("failures-*-of-*.json"):
            old.unlink(missing_ok=True)
    if not failed and not refused:
        place.unlink(missing_ok=True)
        return
    lists = {
        "frames": [{"index": i, "reason": r} for i, r in failed],
        "assets": [{"path": p, "reason": r} for p, r in refused],
    }
    write_atomically(place, encode_run(lists | {"record_sha256": record_sum(lists)}))
