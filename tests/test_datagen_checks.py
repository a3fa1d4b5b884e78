import json
import shutil

import numpy as np
import pytest

import datagen.runs
from datagen import BlurDataset, FrameFileError, SpecError, generate, parse_spec, read_status, verify_dataset
from datagen.manifest import MANIFEST_NAME
from datagen.run_log import LOG_NAME

TINY = {"width": 8, "height": 6, "rays_per_pixel": 1, "frames_per_clip": 2, "seed": 4, "count": 5}
FLIPS = 100


@pytest.fixture(scope="module", params=["folder", "shards"])
def folder(request, tmp_path_factory):
    out = tmp_path_factory.mktemp(request.param) / "data"
    fields, real = TINY | {"storage": request.param, "frames_per_shard": 3}, datagen.runs.make_sample
    assert generate(parse_spec(fields), out).is_complete
    with pytest.MonkeyPatch.context() as patch:  # one more frame fails, so that there is a list of failures too
        patch.setattr(datagen.runs, "make_sample", lambda plan, i: 1 / 0 if i == 5 else real(plan, i))
        assert generate(parse_spec(fields | {"count": 6}), out).failed == ((5, "ZeroDivisionError: division by zero"),)
    return out


def covered_files(folder):
    """What verify answers for: all that a run writes; the locks are empty."""
    return sorted(p for p in folder.rglob("*") if p.is_file() and p.stat().st_size)


def test_every_flipped_bit_is_found_and_its_file_named(folder):
    assert verify_dataset(folder) == []
    files = covered_files(folder)
    rng = np.random.default_rng(0)
    small = [p for p in files if p.name in ("contact_sheet.png", LOG_NAME) or p.suffix in (".json", ".jsonl")]
    assert {LOG_NAME, "run.json", "failures.json", "contact_sheet.png"} < {p.name for p in small}
    for number in range(FLIPS):
        path = small[number // 2 % len(small)] if number % 2 else files[int(rng.integers(len(files)))]
        data = path.read_bytes()
        broken = bytearray(data)
        broken[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(broken))
        problems = verify_dataset(folder)
        assert problems, path
        if path.name != MANIFEST_NAME:  # a changed checksum there looks like a changed file
            assert any(path.name in problem for problem in problems), problems
        path.write_bytes(data)
    assert verify_dataset(folder) == []


def test_the_last_line_end_of_a_manifest_counts(folder):
    place = folder / MANIFEST_NAME
    if not place.exists():
        pytest.skip("stored in shards")
    data = place.read_bytes()
    for bit in range(8):
        place.write_bytes(data[:-1] + bytes([data[-1] ^ 1 << bit]))
        assert "expected a line end after line 5" in verify_dataset(folder)[0]
    place.write_bytes(data)


def test_a_damaged_frame_is_not_read_and_the_others_are(folder, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    dataset = BlurDataset(copy)
    file = dataset._files[3].tolist()
    path = copy / (file[2].decode() or "frames/00000003.exr")
    data = bytearray(path.read_bytes())
    data[file[3] + file[1] // 2] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(FrameFileError, match=r"frames/00000003.exr( in shards/000001.tar)? differs"):
        dataset[3]
    assert [int(dataset[k]["index"]) for k in (0, 1, 2, 4)] == [0, 1, 2, 4]
    assert len(verify_dataset(copy)) == 1
    path.unlink()
    with pytest.raises(FrameFileError, match="is missing"):
        dataset[3]
    assert any("is missing" in problem for problem in verify_dataset(copy))


def test_status_counts_what_is_listed_and_names_what_failed(tmp_path, monkeypatch):
    real = datagen.runs.make_sample
    monkeypatch.setattr(datagen.runs, "make_sample", lambda plan, i: 1 / 0 if i in (1, 2) else real(plan, i))
    for storage in ("folder", "shards"):
        out = tmp_path / storage
        generate(parse_spec(TINY | {"storage": storage, "frames_per_shard": 2}), out)
        status = read_status(out)
        assert (status.spec.count, status.finished, status.is_complete) == (5, 3, False)
        assert [index for index, _ in status.failed] == [1, 2]
        assert verify_dataset(out) == []
    monkeypatch.setattr(datagen.runs, "make_sample", real)
    generate(parse_spec(TINY | {"storage": "shards", "frames_per_shard": 2}), out)
    assert read_status(out).is_complete
    assert read_status(out).failed == ()


def test_what_is_no_data_set_is_said_to_be_none(tmp_path):
    with pytest.raises(FileNotFoundError):
        verify_dataset(tmp_path)
    with pytest.raises(SpecError, match=r"folder: expected a data set with its run\.json"):
        read_status(tmp_path)


def test_a_frame_of_another_configuration_is_found(folder, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    record = json.loads((copy / "run.json").read_text())
    record["spec"]["frames_per_clip"] = 3
    from datagen.folders import encode_run, record_sum

    (copy / "run.json").write_bytes(encode_run(record | {"record_sha256": record_sum(record)}))
    assert any("expected frame 2 of this configuration" in problem for problem in verify_dataset(copy))
