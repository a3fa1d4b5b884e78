import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

from datagen.__main__ import NOT_IN_THE_SPEC, Arguments
from datagen.seeds import open_stream
from datagen.spec import DatasetSpec, SpecError, parse_spec, read_spec_fields


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("width", 0),
        ("width", "64"),
        ("height", 2.5),
        ("count", -1),
        ("count", True),
        ("seed", -3),
        ("source", "video"),
        ("frames_per_clip", 0),
        ("fps", 0.0),
        ("fps", float("nan")),
        ("exposure", 0.0),
        ("exposure", 1.5),
        ("rays_per_pixel", 0),
        ("sequence_fps", float("inf")),
        ("baselines", "mcguire2012,blur2030"),
        ("baselines", "mcguire2012,mcguire2012"),
        ("baselines", "mcguire2012, guertin2015"),
        ("baselines", ["mcguire2012"]),
        ("lighting", "sun"),
        ("workers", 2),  # how it is made is no part of what is made
        ("assets", "somewhere"),  # the built-in shapes have none
    ],
)
def test_a_wrong_field_is_refused_by_name(field, value):
    with pytest.raises(SpecError) as caught:
        parse_spec({field: value})
    assert len(caught.value.problems) == 1
    assert caught.value.problems[0].startswith(f"{field}: expected ")
    assert ", got " in caught.value.problems[0]


def test_all_wrong_fields_are_reported_at_once():
    with pytest.raises(SpecError) as caught:
        parse_spec({"width": -1, "exposure": 7.0, "colour": "red", "source": "meshes"})
    named = sorted(p.split(":")[0] for p in caught.value.problems)
    assert named == ["assets", "colour", "exposure", "width"]


def test_assets_must_exist_and_fit_the_source(tmp_path):
    file = tmp_path / "clip.npz"
    file.write_bytes(b"x")
    other = tmp_path / "clip.txt"
    other.write_bytes(b"x")
    assert parse_spec({"source": "sequence", "assets": str(file)}).assets == str(file)
    assert parse_spec({"source": "meshes", "assets": str(tmp_path)}).assets == str(tmp_path)
    for source, assets in [("meshes", str(file)), ("sequence", str(other)), ("sequence", str(tmp_path / "none.npz"))]:
        with pytest.raises(SpecError, match="assets: expected"):
            parse_spec({"source": source, "assets": assets})


def test_a_toml_file_gives_the_fields(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(f'width = 31\nexposure = 0.25\nseed = {2**62}\nassets = "größer"\n', encoding="utf-8")
    assert read_spec_fields(path) == {"width": 31, "exposure": 0.25, "seed": 2**62, "assets": "größer"}
    path.write_text("width = [", encoding="utf-8")
    with pytest.raises(SpecError, match="config: expected"):
        read_spec_fields(path)


def test_every_field_can_be_set_on_the_command_line():
    flags = {field.name: field.default for field in dataclasses.fields(Arguments)}
    assert set(flags) - set(NOT_IN_THE_SPEC) == set(DatasetSpec.model_fields)
    assert all(flags[name] == field.default for name, field in DatasetSpec.model_fields.items())


def test_a_specification_cannot_be_changed():
    spec = parse_spec({})
    with pytest.raises(Exception, match="frozen"):
        spec.width = 3


def test_the_hash_leaves_out_count_storage_and_the_place_of_assets_only(tmp_path):
    base = parse_spec({})
    changed = {"width": 8, "height": 8, "seed": 1, "frames_per_clip": 2, "fps": 25.0, "exposure": 1.0,
               "rays_per_pixel": 1, "sequence_fps": 12.0, "baselines": "guertin2015", "lighting": "mixed",
               "backend": "torch"}  # fmt: skip
    cameras = [{"sensor": "gamma"}, {"sensor": "gamma", "sensor_gain": 2.0}]
    assert len({parse_spec(c).config_sha256() for c in (*cameras, {})}) == 3
    hashes = {parse_spec({k: v}).config_sha256() for k, v in changed.items()} | {base.config_sha256()}
    assert len(hashes) == len(changed) + 1
    fields = {name for name in DatasetSpec.model_fields if not name.startswith("sensor")}
    assert set(changed) == fields - {
        "source",
        "count",
        "assets",
        "textures",
        "backgrounds",
        "storage",
        "frames_per_shard",
    }
    for field in ({"count": 99}, {"storage": "shards"}, {"frames_per_shard": 7}):
        assert parse_spec(field).config_sha256() == base.config_sha256()
    assert base.config_sha256("a") != base.config_sha256("b")


def test_frames_belong_to_clips_in_order():
    spec = parse_spec({"frames_per_clip": 3})
    assert [spec.clip_and_frame(i) for i in (0, 2, 3, 7)] == [(0, 0), (0, 2), (1, 0), (2, 1)]


def test_streams_are_stateless_and_all_different():
    draw = [open_stream(7, s, c).random() for s in ("cast", "motion") for c in range(50)]
    assert len(set(draw)) == 100
    assert open_stream(7, "motion", 31).random() == draw[50 + 31]
    child = np.random.SeedSequence(7, spawn_key=(2, 31))
    assert open_stream(7, "cast", 31).random() == np.random.Generator(np.random.Philox(child)).random()
    with pytest.raises(ValueError, match="stream: expected"):
        open_stream(7, "sound", 0)


def test_help_does_not_wait_for_torch():
    code = (
        "import sys; from datagen.__main__ import main; rc = main(['--help']);"
        "import json; print(json.dumps([rc, 'torch' in sys.modules]), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert json.loads(done.stderr) == [0, False]
    assert "--frames-per-clip" in done.stdout
