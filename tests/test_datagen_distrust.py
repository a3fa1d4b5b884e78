"""What a command must not believe, overwrite or pass over: records, folders and files that are not as it left them."""

import json
import os
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from test_datagen_bombs import png
from test_datagen_runs import ROOT

import datagen.runs
from datagen import BlurDataset, SpecError, generate, parse_spec
from datagen.__main__ import main
from datagen.folders import Slice, encode_run, locked_folder, parse_slice, record_sum
from datagen.photos import survey_photos
from datagen.rosters import survey_meshes
from datagen.sequences import load_sequence
from datagen.shards import marker_path, read_marker

TINY = {"width": 8, "height": 6, "rays_per_pixel": 1, "count": 3, "seed": 2}
SHARDED = TINY | {"storage": "shards", "frames_per_shard": 3}
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def fail_at(index, monkeypatch):
    real = datagen.runs.make_sample
    monkeypatch.setattr(datagen.runs, "make_sample", lambda plan, i: 1 / 0 if i == index else real(plan, i))


def rewrite_run(folder, **changes):
    """Change run.json as a data set of another time would have it, checksum and all."""
    record = json.loads((folder / "run.json").read_text())
    record |= changes
    record["record_sha256"] = record_sum(record)
    (folder / "run.json").write_bytes(encode_run(record))


def test_a_file_of_options_and_the_command_line_make_one_configuration(tmp_path, capsys):
    config, pictures = tmp_path / "run.toml", tmp_path / "pictures"
    pictures.mkdir()
    Image.fromarray(np.full((4, 4, 3), 90, np.uint8)).save(pictures / "a.png")
    config.write_text('width = 8\nheight = 6\ncount = 1\nrays_per_pixel = 1\nsensor_gain = 2.0\ntextures = "/gone"\n')
    words = ["--out", str(tmp_path / "data"), "--config", str(config)]
    assert main([*words, "--sensor", "srgb"]) == 2
    assert "textures: expected a folder" in capsys.readouterr().err
    assert main([*words, "--textures", str(pictures)]) == 2
    assert "sensor: expected srgb or gamma" in capsys.readouterr().err
    assert main([*words, "--sensor=srgb", "--textures", str(pictures)]) == 0
    spec = json.loads((tmp_path / "data/run.json").read_text())["spec"]
    assert (spec["sensor"], spec["sensor_gain"], spec["width"]) == ("srgb", 2.0, 8)


def test_nothing_in_a_folder_that_is_refused_is_changed(tmp_path):
    (tmp_path / ".runs.log").write_bytes(b"not one of ours\n")
    (tmp_path / "thesis.tex").write_bytes(b"years of work")
    with pytest.raises(SpecError, match="expected an empty folder"):
        generate(parse_spec(TINY), tmp_path)
    assert (tmp_path / ".runs.log").read_bytes() == b"not one of ours\n"


def test_folders_that_cannot_be_read_are_refused_not_passed_over(tmp_path, monkeypatch):
    (tmp_path / "locked").mkdir()
    (tmp_path / "a.obj").write_text(TRIANGLE)
    real = os.scandir

    def scandir(place):
        if Path(place).name == "locked":
            raise PermissionError(13, "Permission denied", str(place))
        return real(place)

    monkeypatch.setattr(os, "scandir", scandir)
    roster = survey_meshes(tmp_path)
    assert roster.names == ("a.obj",)
    assert roster.refused == (("locked", "expected a readable folder, got Permission denied"),)


def test_a_data_set_from_before_an_option_is_retried_from_anywhere(tmp_path, monkeypatch, capsys):
    out, meshes = tmp_path / "data", tmp_path / "meshes"
    meshes.mkdir()
    (meshes / "a.obj").write_text(TRIANGLE)
    monkeypatch.chdir(tmp_path)
    fail_at(1, monkeypatch)
    spec = TINY | {"source": "meshes", "assets": "meshes", "backend": "torch"}
    assert len(generate(parse_spec(spec), out).failed) == 1
    monkeypatch.undo()
    fields = json.loads((out / "run.json").read_text())["spec"]
    rewrite_run(out, spec={name: value for name, value in fields.items() if name not in ("backend", "lighting")})
    monkeypatch.chdir(meshes)
    assert main(["retry", str(out)]) == 2
    assert "assets: expected a folder of mesh files, got 'meshes'" in capsys.readouterr().err
    assert main(["retry", str(out), "--assets", str(meshes)]) == 0
    assert main(["status", str(out)]) == 0


@pytest.mark.parametrize("spec", [{}, {"count": "many"}])
def test_a_record_without_its_checksum_is_told_as_damage(tmp_path, capsys, spec):
    out = tmp_path / "data"
    assert generate(parse_spec(TINY), out).is_complete
    (out / "run.json").write_text(json.dumps({"spec": spec}))
    for words in (["export", str(out), str(tmp_path / "gopro"), "gopro"], ["status", str(out)]):
        assert main(words) == 3, words
        assert "run.json: expected a record with its checksum" in capsys.readouterr().err
    assert not (tmp_path / "gopro").exists()


def test_parts_of_another_slicing_are_refused_while_one_is_made(tmp_path):
    spec = parse_spec(SHARDED)
    with locked_folder(tmp_path / "data", Slice(1, 3)):
        with pytest.raises(SpecError, match=r"slice: expected parts of one slicing at a time, got 1/2 while 1/3 is"):
            generate(spec, tmp_path / "data", part=Slice(1, 2))
        with locked_folder(tmp_path / "data", Slice(2, 3)):
            pass
    assert generate(spec, tmp_path / "data", part=Slice(1, 2)).is_complete


def test_a_reader_that_is_open_finds_its_frames_in_a_shard_made_again(tmp_path, monkeypatch):
    out = tmp_path / "data"
    fail_at(0, monkeypatch)
    assert len(generate(parse_spec(SHARDED), out).failed) == 1
    monkeypatch.undo()
    dataset = BlurDataset(out)
    before = [dataset[k] for k in range(2)]
    assert generate(parse_spec(SHARDED), out).is_complete
    for k in range(2):
        assert dataset[k]["index"] == before[k]["index"] == k + 1
        assert torch.equal(dataset[k]["blurred"], before[k]["blurred"])
    marker = (out / marker_path(0)).read_bytes()
    (out / marker_path(0)).unlink()
    (out / "shards/000000.tar").write_bytes(b"")
    monkeypatch.setattr("datagen.dataset.REMADE_WAIT_S", 0.001)
    with pytest.raises(ValueError, match=r"expected frame 1 in shards/000000\.tar, got a shard that no marker"):
        dataset[0]
    (out / marker_path(0)).write_bytes(marker)
    with pytest.raises(ValueError, match="differs from the marker"):
        dataset[0]


@pytest.mark.parametrize(
    ("name", "value"), [("offset", 2**70), ("offset", "text"), ("offset", -1), ("bytes", 2**62), ("bytes", None)]
)
def test_a_forged_marker_is_damage(tmp_path, capsys, name, value):
    out = tmp_path / "data"
    assert generate(parse_spec(SHARDED), out).is_complete
    marker = read_marker(out, 0)
    marker["frames"][0]["files"][0][name] = value
    marker["record_sha256"] = record_sum(marker)
    (out / marker_path(0)).write_bytes(json.dumps(marker, sort_keys=True).encode() + b"\n")
    assert main(["verify", str(out)]) == 3
    assert "expected a shard's marker, got one that is damaged" in capsys.readouterr().err
    assert generate(parse_spec(SHARDED), out).is_complete
    assert main(["verify", str(out)]) == 0


def test_a_length_beyond_the_file_is_damage_and_takes_no_memory(tmp_path, capsys):
    out = tmp_path / "data"
    assert generate(parse_spec(SHARDED), out).is_complete
    marker = read_marker(out, 0)
    marker["frames"][0]["files"][0]["bytes"] = 2**49
    marker["bytes"] += 1
    marker["record_sha256"] = record_sum(marker)
    (out / marker_path(0)).write_bytes(json.dumps(marker, sort_keys=True).encode() + b"\n")
    assert main(["verify", str(out)]) == 3
    assert "differs from the marker" in capsys.readouterr().err
    with tarfile.open(out / "shards/000000.tar") as tar:
        assert len(tar.getmembers()) == 9


@pytest.mark.parametrize("text", ["1/" + "9" * 5000, "9" * 5000 + "/1", "0/3", "4/3", "1//3", "-1/3", "1/3/5"])
def test_a_slice_that_is_none_is_refused(text):
    with pytest.raises(SpecError, match="slice: expected i/n"):
        parse_slice(text)


@pytest.mark.parametrize(
    "text", ["a = " + "[" * 100_000, "count = " + "9" * 5000, 'a = "\\uD800"', "count = 1\ncount = 2"]
)
def test_a_file_of_options_that_cannot_be_read_is_named(tmp_path, capsys, text):
    config = tmp_path / "run.toml"
    config.write_text(text)
    assert main(["--out", str(tmp_path / "data"), "--config", str(config)]) == 2
    assert "config: expected a readable TOML file" in capsys.readouterr().err


def test_pictures_of_16_bits_a_channel_are_refused(tmp_path):
    (tmp_path / "deep.png").write_bytes(png(2, 16, 2, (b"\0" + bytes(12)) * 2))
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "good.png")
    roster = survey_photos(tmp_path)
    assert roster.names == ("good.png",)
    assert roster.refused == (("deep.png", "expected 8 bits a channel, got 16"),)


def test_a_link_to_nothing_beside_the_frames_of_a_sequence_is_no_matter_but_as_a_frame_it_is(tmp_path):
    for k in range(2):
        (tmp_path / f"walk{k}.obj").write_text(TRIANGLE)
    (tmp_path / "latest").symlink_to(tmp_path / "nowhere")
    assert load_sequence(str(tmp_path)).positions.shape == (2, 3, 3)
    (tmp_path / "walk2.obj").symlink_to(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"walk2\.obj: expected a file"):
        load_sequence(str(tmp_path))


def test_an_interrupt_while_torch_is_read_is_told_in_a_line(tmp_path):
    program = (
        "import sys\nfrom datagen.__main__ import main\n"
        "class Interrupt:\n"
        "    @staticmethod\n"
        "    def find_spec(name, path=None, target=None):\n"
        "        if name == 'torch':\n"
        "            raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Interrupt)\n"
        f"sys.exit(main({['verify', str(tmp_path)]!r}) - main({['--out', str(tmp_path / 'data')]!r}) or 130)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 130
    assert done.stderr == "interrupted; the same command finishes the rest\n" * 2


def test_a_lost_list_or_record_is_damage_and_no_folder_is_wrong_usage(tmp_path, capsys):
    out = tmp_path / "data"
    assert generate(parse_spec(TINY), out).is_complete
    manifest, run = (out / "manifest.jsonl").read_bytes(), (out / "run.json").read_bytes()
    commands = (["verify", str(out)], ["status", str(out)], ["report", str(out)], ["inspect", str(out), "--frame", "0"])
    (out / "manifest.jsonl").unlink()
    for words in commands:
        assert main(words) == 3, words
        assert "expected manifest.jsonl beside run.json, got none" in capsys.readouterr().err
    (out / "manifest.jsonl").write_bytes(manifest)
    (out / "run.json").write_bytes(run[:-20])
    for words in commands[:3]:
        assert main(words) == 3, words
        assert "run.json" in capsys.readouterr().err
    assert main(["retry", str(out)]) == 3
    (out / "run.json").unlink()
    for words in (["verify", str(tmp_path / "nowhere")], ["verify", str(out / "manifest.jsonl")], ["status", str(out)]):
        assert main(words) == 2, words


def test_a_report_is_not_written_where_there_is_no_folder(tmp_path, capsys):
    out = tmp_path / "data"
    assert generate(parse_spec(TINY), out).is_complete
    assert main(["report", str(out), "--out", str(tmp_path / "none/r.html")]) == 2
    assert "out: expected a file in a folder that is there" in capsys.readouterr().err


def test_a_reader_that_has_read_enough_is_no_error(tmp_path):
    out = tmp_path / "data"
    assert generate(parse_spec(TINY), out).is_complete
    program = "import sys, datagen.__main__ as m, time; time.sleep(0.5); sys.exit(m.main())"
    words = [sys.executable, "-c", program, "inspect", str(out), "--frame", "0"]
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        child.stdout.close()
        told = child.stderr.read()
        assert (child.wait(timeout=60), told) == (0, b"")


def test_an_empty_folder_of_shards_hides_no_frame(tmp_path):
    out = tmp_path / "data"
    assert generate(parse_spec(TINY), out).is_complete
    (out / "shards").mkdir()
    assert len(BlurDataset(out)) == 3
    (out / "frames/00000001.exr").write_bytes(b"x")
    assert main(["verify", str(out)]) == 3
    assert main(["retry", str(out)]) == 0
    assert not (out / "shards").exists()


@pytest.mark.parametrize("storages", [("shards", "folder"), ("folder", "shards"), ("shards", "auto")])
def test_a_start_that_was_killed_may_be_followed_by_one_with_the_other_storage(tmp_path, monkeypatch, storages):
    def die(*_):
        raise KeyboardInterrupt

    first, second = (parse_spec(TINY | {"storage": name}) for name in storages)
    monkeypatch.setattr("datagen.shards.write_run" if storages[0] == "shards" else "datagen.manifest.write_run", die)
    with pytest.raises(KeyboardInterrupt):
        generate(first, tmp_path / "data")
    monkeypatch.undo()
    assert generate(second, tmp_path / "data").is_complete
    assert generate(second, tmp_path / "other").is_complete
    trees = [sorted(p.relative_to(tmp_path / n) for p in (tmp_path / n).rglob("*")) for n in ("data", "other")]
    if storages[1] != "auto":
        assert [p for p in trees[0] if ".lock" not in p.name] == [p for p in trees[1] if ".lock" not in p.name]
    assert len(BlurDataset(tmp_path / "data")) == 3


def test_workers_are_told_whole_paths_as_they_may_start_elsewhere(tmp_path, monkeypatch):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/a.obj").write_text(TRIANGLE)
    monkeypatch.chdir(tmp_path)
    told, real = [], datagen.runs.run_serial

    def run(task, plan_json, folder, indices):
        told.append(json.loads(plan_json)["spec"]["assets"])
        monkeypatch.chdir("/")
        return real(task, plan_json, folder, indices)

    monkeypatch.setattr(datagen.runs, "run_serial", run)
    spec = parse_spec(TINY | {"count": 1, "source": "meshes", "assets": "meshes", "backend": "torch"})
    assert generate(spec, tmp_path / "data").is_complete
    assert told == [str(tmp_path / "meshes")]
    assert json.loads((tmp_path / "data/run.json").read_text())["spec"]["assets"] == "meshes"
