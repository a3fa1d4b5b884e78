import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import children_of, outlivers
from test_datagen_runs import ROOT, command

import datagen.runs
from datagen import BlurDataset, DatasetSpec, MeshError, generate, parse_spec
from datagen.__main__ import main
from datagen.executors import MAX_TRIES, run_processes, run_serial
from datagen.manifest import read_manifest
from datagen.report import effect_shares
from datagen.spec import read_spec_fields


def task_that_fails_at_2(plan, folder, index):
    if index == 2:
        raise ValueError("two is\nnot possible")
    return f"{plan}{folder}{index}"


def task_that_dies_at_1(plan, folder, index):
    if index == 1:
        (Path(folder) / f"try-{os.getpid()}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return str(index)


def test_a_frame_that_fails_is_listed_and_the_others_are_made(tmp_path):
    for outcomes in (
        list(run_serial(task_that_fails_at_2, "p", "f", range(5))),
        list(run_processes(task_that_fails_at_2, "p", "f", range(5), 2)),
    ):
        outcomes.sort(key=lambda o: o.index)
        assert [o.index for o in outcomes] == [0, 1, 2, 3, 4]
        assert [o.error for o in outcomes] == ["", "", "ValueError: two is not possible", "", ""]
        assert outcomes[3].text == "pf3"


def test_a_frame_that_kills_its_process_is_given_up_and_the_others_are_made(tmp_path):
    outcomes = sorted(run_processes(task_that_dies_at_1, "", str(tmp_path), range(4), 2), key=lambda o: o.index)
    assert [(o.index, o.text) for o in outcomes] == [(0, "0"), (1, ""), (2, "2"), (3, "3")]
    assert outcomes[1].error == f"its process died {MAX_TRIES} times"
    assert len(list(tmp_path.iterdir())) == MAX_TRIES
    with pytest.raises(ValueError, match="workers: expected"):
        list(run_processes(task_that_dies_at_1, "", "", range(1), 0))


def task_that_tells_who(plan_json, folder, index):
    return str(os.getpid())


@pytest.mark.parametrize("workers", [1, 2])
def test_a_process_that_dies_between_frames_costs_none(workers):
    outcomes, killed = [], 0
    for outcome in run_processes(task_that_tells_who, "", "", range(6), workers):
        outcomes.append(outcome)
        if outcome.index in (1, 3):
            with contextlib.suppress(ProcessLookupError):  # ended with the one that was killed before
                os.kill(int(outcome.text), signal.SIGKILL)  # it is idle now: the next frame is handed out after this
                killed += 1
            time.sleep(1.0)  # until the pool knows
    assert sorted(o.index for o in outcomes) == list(range(6))
    assert [o.error for o in outcomes] == [""] * 6
    assert killed
    assert len({o.text for o in outcomes}) > workers


def task_that_holds_the_interpreter(plan_json, folder, index):
    (Path(folder) / f"{index}").touch()
    return str(sum(range(10**12)))  # hours in one call, in which no other thread runs


@pytest.mark.skipif(not hasattr(os, "O_ASYNC"), reason="needs signals of pipes")
def test_a_worker_ends_with_its_driver_even_in_compiled_code(tmp_path):
    program = (
        "import sys, test_datagen_commands as t\n"
        "list(t.run_processes(t.task_that_holds_the_interpreter, '', sys.argv[1], range(2), 2))"
    )
    places = os.pathsep.join(map(str, (ROOT, ROOT / "tests", ROOT / "scripts")))
    driver = subprocess.Popen([sys.executable, "-c", program, tmp_path], env=os.environ | {"PYTHONPATH": places})
    deadline = time.monotonic() + 120
    while len(list(tmp_path.iterdir())) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    workers = children_of(driver.pid)
    assert len(workers) >= 2
    driver.kill()
    driver.wait()
    left = outlivers(workers)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert not left


def test_a_worker_watches_over_its_driver_before_it_imports_torch():
    program = "import sys, datagen.executors, datagen.__main__; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_a_failing_frame_gives_exit_code_1_and_is_made_by_a_rerun(tmp_path, monkeypatch, capsys):
    real = datagen.runs.make_sample

    def faulty(plan, index):
        if index == 1:
            raise OSError(28, "No space left on device")
        return real(plan, index)

    monkeypatch.setattr(datagen.runs, "make_sample", faulty)
    words = command(tmp_path / "data", count=3, workers=1)
    assert main(words) == 1
    assert "failed frame 1: OSError: [Errno 28] No space left on device" in capsys.readouterr().err
    failures = json.loads((tmp_path / "data/failures.json").read_text())
    assert [f["index"] for f in failures["frames"]] == [1]
    assert list(read_manifest(tmp_path / "data")) == [0, 2]
    monkeypatch.setattr(datagen.runs, "make_sample", real)
    assert main(words) == 0
    assert not (tmp_path / "data/failures.json").exists()
    assert list(read_manifest(tmp_path / "data")) == [0, 1, 2]


def test_the_summary_tells_what_share_of_the_frames_called_for_what(tmp_path, capsys):
    """Also of those that an earlier run made."""
    out = tmp_path / "data"
    assert main(command(out, count=2, workers=1)) == 0
    assert main(command(out, count=5, workers=1)) == 0
    needed = [
        {name for name, effect in BlurDataset(out).metadata(k)["plan"]["effects"].items() if effect["needed"]}
        for k in range(5)
    ]
    assert any(needed)
    line = next(line for line in capsys.readouterr().out.splitlines()[::-1] if line.startswith("effects"))
    told = dict(part.rsplit(" ", 1) for part in line.split(": ")[1].split(", "))
    assert told == {name: f"{20 * sum(name in each for each in needed)}%" for name in set().union(*needed)}
    shares = effect_shares([{"effects": ["motion"]}, {"effects": ["texture", "motion"]}, {"effects": []}])
    assert list(shares.items()) == [("motion", 2 / 3), ("texture", 1 / 3)]
    assert effect_shares([]) == {}


def test_bad_assets_give_exit_code_1_and_are_listed(tmp_path, capsys):
    assets = tmp_path / "meshes"
    assets.mkdir()
    (assets / "good.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    (assets / "bad.ply").write_text("ply\nnothing")
    words = [*command(tmp_path / "data", count=2, workers=1), "--source", "meshes", "--assets", str(assets)]
    assert main(words) == 1
    told = capsys.readouterr()
    assert "refused bad.ply: expected a readable .ply file" in told.err
    assert "2 frames made" in told.out
    assert [f["path"] for f in json.loads((tmp_path / "data/failures.json").read_text())["assets"]] == ["bad.ply"]
    (assets / "bad.ply").unlink()
    assert main(words) == 0
    (assets / "good.obj").write_text("v 0 0 0\nv 2 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    assert main(words) == 2
    assert "assets_sha256: expected" in capsys.readouterr().err


def test_nothing_is_written_when_no_asset_can_be_used(tmp_path, capsys):
    assets = tmp_path / "meshes"
    assets.mkdir()
    (assets / "bad.obj").write_text("v 0 0 0\n")
    words = ["--out", str(tmp_path / "data"), "--source", "meshes", "--assets", str(assets)]
    assert main(words) == 2
    assert "bad.obj: expected triangles, got none" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()
    with pytest.raises(MeshError):
        generate(parse_spec({"source": "meshes", "assets": str(assets)}), tmp_path / "data")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--width", "0"], "width: expected"),
        (["--exposure", "2"], "exposure: expected"),
        (["--source", "meshes"], "assets: expected"),
        (["--config", "nowhere.toml"], "config: expected"),
        (["--workers", "-1"], "workers: expected"),
        (["--colour", "red"], "colour"),
        (["--count", "many"], "count"),
        (["--source", "video"], "source"),
    ],
)
def test_wrong_usage_gives_exit_code_2_and_writes_nothing(tmp_path, capsys, words, named):
    assert main(["--out", str(tmp_path / "data"), *words]) == 2
    told = capsys.readouterr()
    assert named in told.err + told.out
    assert not (tmp_path / "data").exists()


def test_options_win_over_the_configuration_file(tmp_path, capsys):
    config = tmp_path / "run.toml"
    config.write_text(
        'fps = 30\nwidth = 8\nheight = 6\ncount = 1\nrays_per_pixel = 1\nseed = 9\nsource = "primitives"\n'
    )
    assert main(["--out", str(tmp_path / "data"), "--config", str(config), "--seed", "3"]) == 0
    record = json.loads((tmp_path / "data/run.json").read_text())["spec"]
    assert (record["width"], record["seed"], record["count"]) == (8, 3, 1)
    config.write_text("width = 8\nheigth = 6\nexposure = 3.0\n")
    assert main(["--out", str(tmp_path / "other"), f"--config={config}"]) == 2
    told = capsys.readouterr().err
    assert "heigth: expected one of the fields" in told
    assert "exposure: expected" in told


def test_a_sequence_is_played(tmp_path):
    import numpy as np

    rng = np.random.default_rng(0)
    start = rng.normal(size=(1, 12, 3))
    vertices = start + np.cumsum(rng.normal(size=(6, 12, 3)) * 0.1, 0)
    np.savez(tmp_path / "walk.npz", vertices=vertices, faces=rng.integers(0, 12, (9, 3)))
    out = tmp_path / "data"
    words = [*command(out, count=2, workers=1), "--source", "sequence", "--assets", str(tmp_path / "walk.npz")]
    assert main(words) == 0
    meta = BlurDataset(out).metadata(1)
    assert meta["scene"]["sequence"]["frames"] == 6
    assert meta["meshes"][-1]["segments"] >= 1


def test_every_command_has_help_that_does_not_wait_for_torch():
    program = (
        "import sys, contextlib, io; from datagen.__main__ import main; from datagen.commands import COMMANDS\n"
        "for words in ([], ['generate'], *([name] for name in COMMANDS)):\n"
        "    with contextlib.redirect_stdout(io.StringIO()) as told:\n"
        "        assert main([*words, '--help']) == 0\n"
        "    assert 'usage' in told.getvalue().lower()\n"
        "print([m for m in ('torch', 'numpy', 'trimesh', 'OpenEXR', 'kornia') if m in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_wrong_command_is_refused_and_the_right_ones_are_named(tmp_path, capsys):
    assert main(["verfy", str(tmp_path)]) == 2
    assert (
        "command: expected one of generate, init, status, verify, retry, export, inspect, report"
        in capsys.readouterr().err
    )
    assert main(["verify"]) == 2
    for name in ("status", "verify", "retry"):
        assert main([name, str(tmp_path / "nothing")]) == 2, name


def test_init_writes_a_configuration_that_generate_reads(tmp_path, capsys):
    assert main(["init"]) == 0
    text = capsys.readouterr().out
    place = tmp_path / "run.toml"
    assert main(["init", "--out", str(place)]) == 0
    assert place.read_text() == text
    assert main(["init", "--out", str(place)]) == 2
    assert place.read_text() == text
    assert parse_spec(read_spec_fields(place)) == parse_spec({})
    assert {line.removeprefix("# ").split(" = ")[0] for line in text.splitlines()} == set(DatasetSpec.model_fields)
    words = command(tmp_path / "data", count=1, workers=1)
    assert main(["generate", *words, "--config", str(place)]) == 0


@pytest.mark.parametrize("storage", ["folder", "shards"])
def test_a_data_set_from_its_failure_to_its_export(tmp_path, monkeypatch, capsys, storage):
    real, out = datagen.runs.make_sample, tmp_path / "data"
    monkeypatch.setattr(datagen.runs, "make_sample", lambda plan, i: 1 / 0 if i == 1 else real(plan, i))
    assert main([*command(out, count=3, workers=1), "--storage", storage, "--frames-per-shard", "2"]) == 1
    capsys.readouterr()
    assert main(["status", str(out)]) == 1
    told = capsys.readouterr()
    assert told.out.startswith("2 of 3 frames finished, 1 failed")
    assert told.err == "failed frame 1: ZeroDivisionError: division by zero\n"
    assert main(["verify", str(out)]) == 0
    assert main(["export", str(out), str(tmp_path / "gopro"), "gopro"]) == 2
    assert "expected a finished data set of 3 frames, got 2 of them" in capsys.readouterr().err
    monkeypatch.setattr(datagen.runs, "make_sample", real)
    assert main(["retry", str(out)]) == 0
    assert main(["status", str(out)]) == 0
    capsys.readouterr()
    assert main(["inspect", str(out), "--frame", "2"]) == 0
    told = capsys.readouterr().out
    assert f"{out}: frame 2, 8 x 6 px" in told
    assert '"rays_per_pixel": 1' in told
    assert main(["inspect", str(out)]) == 2
    assert main(["inspect", str(out), "--frame", "3"]) == 2
    assert main(["export", str(out), str(tmp_path / "gopro"), "gopro", "--split", "test"]) == 0
    assert (tmp_path / "gopro/test/clip000001/blur/000000.png").is_file()
    assert main(["export", str(out), str(tmp_path / "other"), "gropo"]) == 2
    listed = {"folder": "frames/00000002.exr", "shards": "shards/000001.tar"}[storage]
    data = bytearray((out / listed).read_bytes())
    data[len(data) // 2] ^= 1
    (out / listed).write_bytes(bytes(data))
    capsys.readouterr()
    assert main(["verify", str(out)]) == 3
    assert listed in capsys.readouterr().err
    assert main(["export", str(out), str(tmp_path / "lossy"), "gopro"]) == 3
    assert main(["retry", str(out)]) == 0
    assert main(["verify", str(out)]) == 0


def test_inspect_tells_the_range_of_every_channel_of_a_file(tmp_path, capsys):
    assert main(command(tmp_path / "data", count=1, workers=1)) == 0
    capsys.readouterr()
    assert main(["inspect", str(tmp_path / "data/frames/00000000.exr")]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = {tuple(line.split()[:2]): line.split()[2:] for line in lines[2:] if line.split()[0] in ("data", "sharp")}
    item = BlurDataset(tmp_path / "data")[0]
    alpha = item["alpha"]
    assert rows["data", "A"] == ["float32", f"{alpha.min():g}", f"{alpha.max():g}", "0"]
    assert int(rows["data", "Z"][-1]) == int((~item["depth"].isfinite()).sum())
    (tmp_path / "x.exr").write_bytes(b"junk")
    assert main(["inspect", str(tmp_path / "x.exr")]) == 3
    assert main(["inspect", str(tmp_path / "y.exr")]) == 3
