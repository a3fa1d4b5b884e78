import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import outlivers, state_and_parent
from test_datagen_runs import spec, sums

from datagen import SpecError, generate
from datagen.__main__ import main

ROOT = Path(__file__).resolve().parent.parent
needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed (extra `ray`)")


def run_ray(out, *more, **options):
    """A run of its own process, so that nothing of Ray stays in this one."""
    words = [sys.executable, "-m", "datagen", "--out", str(out), "--executor", "ray", "--workers", "2"]
    fields = {"count": 4, "width": 8, "height": 6, "rays-per-pixel": 1, "frames-per-clip": 2, "seed": 4}
    words += [word for name, value in fields.items() for word in (f"--{name}", str(value))]
    return subprocess.Popen([*words, *more], cwd=ROOT, text=True, **options)


@needs_ray
def test_ray_makes_the_same_bytes_as_one_process(tmp_path):
    generate(spec(), tmp_path / "one")
    run = run_ray(tmp_path / "ray", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    out, err = run.communicate(timeout=300)
    assert run.returncode == 0, out + err
    assert sums(tmp_path / "ray") == sums(tmp_path / "one")


def ray_processes(driver, name):
    """The living processes of that name below a driver, by number."""
    found, parents = [], {driver}
    for _ in range(3):  # driver, raylet, workers
        for place in Path("/proc").glob("[0-9]*"):
            try:
                title = (place / "cmdline").read_text()
            except OSError:
                continue
            if state_and_parent(int(place.name))[1] in parents:
                parents.add(int(place.name))
                if title.startswith(name):
                    found.append(int(place.name))
    return sorted(set(found)), parents


def wait_for(condition, seconds=120):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.02)
    raise AssertionError("waited in vain")


def listeners(pids):
    """The addresses on which processes listen, as the kernel writes them."""
    inodes = set()
    for pid in pids:
        for file in Path(f"/proc/{pid}/fd").iterdir():
            try:
                inodes.add(str(file.readlink()))
            except OSError:
                continue
    rows = [row.split() for name in ("tcp", "tcp6") for row in Path(f"/proc/net/{name}").read_text().splitlines()[1:]]
    return {row[1].split(":")[0] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in inodes}


@needs_ray
@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="reads /proc")
def test_killed_workers_and_drivers_lose_nothing_and_nothing_listens_to_others(tmp_path):
    generate(spec(), tmp_path / "one")
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    run = run_ray(tmp_path / "ray", "--count", "16", **quiet)
    try:
        workers = wait_for(lambda: ray_processes(run.pid, "ray::_attempt_alone")[0])
        family = ray_processes(run.pid, "ray::")[1]
        own = {"0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000"}  # 127.0.0.1, ::1
        assert listeners(family)
        assert listeners(family) <= own
        os.kill(workers[0], signal.SIGKILL)
        wait_for(lambda: len(list((tmp_path / "ray").glob("frames/*.exr"))) >= 2)
        family = ray_processes(run.pid, "ray::")[1]
    finally:
        run.kill()
        run.wait()
    assert outlivers(family) == []
    shorter = run_ray(tmp_path / "ray", "--count", "16", **quiet)
    assert shorter.wait(timeout=300) == 0
    mine, whole = sums(tmp_path / "ray"), sums(tmp_path / "one")
    frames = [name for name in whole if name.startswith("frames/")]
    assert len(frames) == 4
    assert all(mine[name] == whole[name] for name in frames)


@needs_ray
def test_a_frame_that_kills_its_process_is_given_up_and_the_others_are_made(tmp_path):
    code = (
        "import os, signal, sys\n"
        "from datagen.ray_executor import run_ray\n"
        "def task(plan, folder, index):\n"
        "    if index == 1: os.kill(os.getpid(), signal.SIGKILL)\n"
        "    if index == 2: raise ValueError('no such frame')\n"
        "    return plan + str(index)\n"
        "for o in sorted(run_ray(task, 'p', '.', range(5), 2), key=lambda o: o.index): print(o.text or o.error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300)
    lines = [line for line in done.stdout.splitlines() if "raylet" not in line]
    assert lines == ["p0", "its process died 3 times", "ValueError: no such frame", "p3", "p4"], done.stderr


def test_without_ray_the_executor_is_refused_before_anything_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("datagen.ray_executor.importlib.util.find_spec", lambda name: None)
    with pytest.raises(SpecError, match=r"executor: expected local, or ray with its package"):
        generate(spec(), tmp_path / "out", executor="ray")
    assert main(["--out", str(tmp_path / "out"), "--executor", "ray"]) == 2
    assert "pip install 'torchblur[ray]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    with pytest.raises(SpecError, match="executor: expected one of local, ray, got 'dask'"):
        generate(spec(), tmp_path / "out", executor="dask")
