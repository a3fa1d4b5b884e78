import importlib.util
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from fuzz_assets import is_kept, mutate, seeds

ROOT = Path(__file__).resolve().parent.parent


def run(*words):
    return subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True, timeout=500)


def test_mutated_files_of_every_format_are_refused_or_sound():
    done = run("scripts/fuzz_assets.py", "--count", "25")
    assert done.returncode == 0, done.stdout + done.stderr
    told = {line.split(":")[0] for line in done.stdout.splitlines() if " files: " in line}
    assert told == set(seeds())
    if importlib.util.find_spec("pxr") is not None:
        assert {"usda", "usdc"} <= told


def test_a_reader_that_breaks_a_promise_is_found():
    code = (
        "import os, signal, sys\n"
        "sys.path[:0] = ['scripts']\n"
        "import fuzz_assets as f\n"
        "sound = f.read\n"
        "for fault in (lambda p: os.kill(os.getpid(), signal.SIGSEGV), lambda p: f.UNSOUND, lambda p: 1 / 0, sound):\n"
        "    if fault is sound: f.MAX_BYTES = 1\n"
        "    f.read = fault\n"
        "    tally, peak = f.fuzz('gltf', f.seeds()['gltf'], 1, 0)\n"
        "    print(*tally, f.is_kept('gltf', tally))\n"
    )
    done = run("-c", code)
    lines = [line for line in done.stdout.splitlines() if not line.startswith(("gltf:", "usda"))]
    assert lines == ["died False", "unsound False", "other error False", "large False"], done.stderr


def test_only_the_reader_that_is_not_ours_may_die():
    assert is_kept("usdc", Counter(died=1, refused=3))
    assert not is_kept("usdc", Counter(unsound=1))
    assert not is_kept("glb", Counter(died=1, usable=9))


@pytest.mark.parametrize("name", sorted(seeds()))
def test_mutations_differ_and_follow_the_seed(name):
    import random

    data = next(iter(seeds()[name].values()))
    made = [mutate(data, random.Random(k)) for k in range(20)]
    assert len(set(made)) > 12
    assert made == [mutate(data, random.Random(k)) for k in range(20)]
