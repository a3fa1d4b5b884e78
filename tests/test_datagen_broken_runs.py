"""Runs that are killed, or find the disk full, at each of their steps (scripts/fault_points.py tries them)."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")

FOLDER, SHARDS = "--count 2 --storage folder", "--count 3 --storage shards"
PLANTED = "import sys, datagen.executors, datagen.runs, datagen.shards, datagen.writer, fault_points\n{fault}\n"


def try_points(options, fault=None):
    """What the script prints, its sum of points and of problems."""
    program = PLANTED.format(fault=fault) + "sys.exit(fault_points.main())"
    words = ["scripts/fault_points.py"] if fault is None else ["-c", program]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "scripts")}
    done = subprocess.run(
        [sys.executable, *words, *options.split()],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=500,
        env=environment,
        check=False,
    )
    counts = re.findall(r": (\d+) points, (\d+) problems$", done.stdout, re.M)
    assert counts, done.stdout + done.stderr
    points, problems = (sum(map(int, column)) for column in zip(*counts, strict=True))
    assert done.returncode == min(problems, 1)
    return done.stdout, points, problems


@pytest.mark.parametrize(
    ("options", "fewest"),
    [
        # three files of six steps and a line, a frame
        (f"{FOLDER} --way kill-before", 2 * 20),
        # two files of six steps, a shard
        (f"{SHARDS} --way kill-before", 2 * 12),
        # its marker goes before the tar is replaced
        (f"{SHARDS} --begun 1 --way kill-before", 2 * 12),
        # while two workers are at work
        (f"{FOLDER} --workers 2 --victim driver --way kill-before", 10),
        (f"{SHARDS} --workers 2 --victim driver --way kill-before", 10),
    ],
)
def test_a_run_killed_at_any_step_is_finished_by_a_rerun_and_leaves_no_process(options, fewest):
    told, points, problems = try_points(options)
    assert problems == 0, told
    assert points >= fewest


@pytest.mark.parametrize("storage", [FOLDER, SHARDS])
@pytest.mark.parametrize(("times", "stride"), [(1, 1), (5, 3)], ids=["once", "until it is given up"])
def test_a_worker_killed_at_any_step_loses_and_doubles_nothing(storage, times, stride):
    """Killed once, the run itself ends whole; given up after three times, a rerun makes it so."""
    options = f"--workers 2 --victim worker --way kill-after --times {times} --stride {stride}"
    told, points, problems = try_points(f"{storage} {options}")
    assert problems == 0, told
    assert points >= 2 * 12 / stride


@pytest.mark.parametrize("storage", [FOLDER, SHARDS])
def test_a_full_disk_at_any_step_is_told_and_a_rerun_finishes(storage):
    told, points, problems = try_points(f"{storage} --way full full-once")
    assert problems == 0, told
    assert points >= 2 * 40


@pytest.mark.parametrize("storage", [FOLDER, SHARDS])
def test_a_disk_that_is_full_for_two_workers_is_told_and_a_rerun_finishes(storage):
    told, points, problems = try_points(f"{storage} --workers 2 --way full full-once --stride 7")
    assert problems == 0, told
    assert points >= 10


@pytest.mark.parametrize(
    ("fault", "options", "told"),
    [
        ("datagen.runs.sweep_frames = lambda folder: None", "--workers 2 --victim worker", "although the run went on"),
        ("datagen.executors._end_with_parent = lambda: None", "--workers 2 --victim driver", "processes alive"),
        ("datagen.executors.MAX_TRIES = 1", "--workers 2 --victim worker", "ended with 1, not (0,)"),
        ("datagen.runs.append_entry = lambda folder, entry: None", "--workers 1", "2 finished but not listed"),
    ],
)
def test_a_broken_promise_is_found(fault, options, told):
    out, _, problems = try_points(f"{FOLDER} --way kill-before --stride 9 {options}", fault)
    assert problems, out
    assert told in out
