import gc
import hashlib
import io
import json
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from test_datagen_runs import sums

import datagen.runs
from datagen import BlurDataset, SpecError, export_dataset, generate, parse_spec, read_status, verify_dataset
from datagen.__main__ import main
from datagen.entries import read_entries
from datagen.folders import SHARDS_FROM, Slice, locked_folder, parse_slice, settle_storage
from datagen.writer import TEMPORARY_PREFIX, decode_exr

TINY = {"width": 8, "height": 6, "rays_per_pixel": 1, "frames_per_clip": 2, "seed": 4, "count": 7}
SHARDED = TINY | {"storage": "shards", "frames_per_shard": 3}


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    out = tmp_path_factory.mktemp("sharded") / "data"
    assert generate(parse_spec(SHARDED), out).is_complete
    return out


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    out = tmp_path_factory.mktemp("plain") / "data"
    assert generate(parse_spec(TINY), out).is_complete
    return out


def tar_sums(folder):
    """The checksums of all tar files and markers, by name."""
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted((folder / "shards").iterdir())}


def refuse_to_render(monkeypatch):
    monkeypatch.setattr(datagen.runs, "make_sample", lambda *_: pytest.fail("made a frame again"))


def test_shards_hold_the_same_files_as_folders(reference, plain):
    assert sorted(tar_sums(reference)) == [f"{n:06d}.{s}" for n in range(3) for s in ("json", "tar")]
    assert not (reference / "manifest.jsonl").exists()
    members = {}
    for path in sorted((reference / "shards").glob("*.tar")):
        with tarfile.open(path) as tar:
            members |= {m.name: tar.extractfile(m).read() for m in tar.getmembers()}
    kinds = {".exr": "frames/{}.exr", ".sharp.png": "sharp/{}.png", ".blur.png": "blur/{}.png"}
    assert list(members) == [f"{i:08d}{suffix}" for i in range(7) for suffix in kinds]
    for name, data in members.items():
        key, suffix = name[:8], name[8:]
        assert data == (plain / kinds[suffix].format(key)).read_bytes()


def test_a_marker_says_where_each_file_is(reference):
    for place in sorted((reference / "shards").glob("*.json")):
        marker, data = json.loads(place.read_text()), place.with_suffix(".tar").read_bytes()
        assert (marker["bytes"], marker["sha256"]) == (len(data), hashlib.sha256(data).hexdigest())
        assert marker["config_sha256"] == json.loads((reference / "run.json").read_text())["config_sha256"]
        for file in (file for frame in marker["frames"] for file in frame["files"]):
            piece = data[file["offset"] : file["offset"] + file["bytes"]]
            assert hashlib.sha256(piece).hexdigest() == file["sha256"]


def test_the_dataset_reads_both_alike(reference, plain):
    ours, theirs = BlurDataset(reference), BlurDataset(plain)
    assert len(ours) == len(theirs) == 7
    for k in (6, 0, 3):
        mine, other = ours[k], theirs[k]
        assert set(mine) == set(other)
        for key, value in mine.items():
            same = (
                torch.equal(value.nan_to_num(), other[key].nan_to_num())
                if hasattr(value, "shape")
                else value == other[key]
            )
            assert same, key
        assert torch.equal(ours.coverage(k), theirs.coverage(k))


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_webdataset_reads_the_shards_unmodified(reference, plain):
    wds = pytest.importorskip("webdataset", reason="referee: webdataset")
    urls = [str(p) for p in sorted((reference / "shards").glob("*.tar"))]
    samples = list(wds.WebDataset(urls, shardshuffle=False, empty_check=False))
    assert [s["__key__"] for s in samples] == [f"{i:08d}" for i in range(7)]
    for sample in samples:
        name = sample["__key__"]
        assert set(sample) >= {"exr", "sharp.png", "blur.png"}
        with Image.open(plain / "blur" / f"{name}.png") as image, Image.open(io.BytesIO(sample["blur.png"])) as mine:
            assert np.array_equal(np.asarray(image), np.asarray(mine))
        assert decode_exr(sample["exr"], name)[1]["index"] == int(name)
    decoded = list(wds.WebDataset(urls, shardshuffle=False, empty_check=False).decode("torchrgb"))
    assert decoded[0]["sharp.png"].shape == (3, 6, 8)
    gc.collect()  # it leaves the files open; better told of here than in another test


def test_auto_means_shards_from_a_thousand_frames_on_and_keeps_what_a_folder_has(plain, tmp_path):
    for count, storage in ((SHARDS_FROM - 1, "folder"), (SHARDS_FROM, "shards")):
        assert settle_storage(parse_spec({"count": count}), tmp_path).storage == storage
    assert settle_storage(parse_spec({"count": SHARDS_FROM}), plain).storage == "folder"


@pytest.mark.parametrize("workers", [2, 3])
def test_workers_make_the_same_shards(reference, tmp_path, workers):
    generate(parse_spec(SHARDED), tmp_path / "data", workers=workers)
    assert tar_sums(tmp_path / "data") == tar_sums(reference)
    assert sums(tmp_path / "data") == sums(reference)


@pytest.mark.parametrize("of", [1, 2, 3, 5])
def test_slices_in_any_order_make_the_same_shards(reference, tmp_path, of):
    for number in reversed(range(1, of + 1)):
        result = generate(parse_spec(SHARDED), tmp_path / "data", part=Slice(number, of))
        assert result.is_complete
        assert result.contact_sheet is None
        assert verify_dataset(tmp_path / "data") == []
    assert tar_sums(tmp_path / "data") == tar_sums(reference)
    assert generate(parse_spec(SHARDED), tmp_path / "data").made == 0
    assert sums(tmp_path / "data") == sums(reference)


def test_slices_run_side_by_side_but_not_twice_nor_beside_a_whole_run(tmp_path):
    pytest.importorskip("fcntl", reason="needs the system's file locks")
    out = tmp_path / "data"
    with locked_folder(out, Slice(1, 2)):
        assert generate(parse_spec(SHARDED), out, part=Slice(2, 2)).is_complete
        for part in (None, Slice(1, 2)):
            with pytest.raises(SpecError, match="no other run"):
                generate(parse_spec(SHARDED), out, part=part)


def test_a_slice_leaves_the_temporary_files_of_the_others_alone(tmp_path):
    out = tmp_path / "data"
    generate(parse_spec(SHARDED), out, part=Slice(1, 2))
    mine, other = (out / "shards" / f"{TEMPORARY_PREFIX}7-1-00000{n}.tar" for n in (0, 1))
    for place in (mine, other):
        place.write_bytes(b"left behind")
    generate(parse_spec(SHARDED), out, part=Slice(1, 2))
    assert (mine.exists(), other.exists()) == (False, True)
    generate(parse_spec(SHARDED), out)
    assert not other.exists()


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "/", "a/b", "1/0", "-1/2", "1/2/3", "²/3"])
def test_a_wrong_slice_is_refused(text, tmp_path, capsys):
    with pytest.raises(SpecError, match="slice: expected i/n with i from 1 to n"):
        parse_slice(text)
    assert main(["--out", str(tmp_path / "data"), f"--slice={text}"]) == 2
    assert not (tmp_path / "data").exists()


def test_a_slice_of_a_plain_folder_is_refused(tmp_path, capsys):
    assert main(["--out", str(tmp_path / "data"), "--count", "2", "--slice", "1/2"]) == 2
    assert "storage: expected shards for a slice, got folder" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


def test_a_longer_run_extends_a_shorter_one_and_renders_nothing_twice(reference, tmp_path, monkeypatch):
    out, real, made = tmp_path / "data", datagen.runs.make_sample, []
    generate(parse_spec(SHARDED | {"count": 4}), out)
    monkeypatch.setattr(datagen.runs, "make_sample", lambda plan, i: made.append(i) or real(plan, i))
    result = generate(parse_spec(SHARDED), out)
    assert made == [4, 5, 6]
    assert result.is_complete
    assert sums(out) == sums(reference)
    assert tar_sums(out) == tar_sums(reference)


def test_a_failed_frame_is_left_out_and_made_by_the_next_run(reference, tmp_path, monkeypatch):
    out, real, made = tmp_path / "data", datagen.runs.make_sample, []
    monkeypatch.setattr(datagen.runs, "make_sample", lambda plan, i: 1 / 0 if i in (1, 6) else real(plan, i))
    result = generate(parse_spec(SHARDED), out)
    assert result.failed == ((1, "ZeroDivisionError: division by zero"), (6, "ZeroDivisionError: division by zero"))
    assert list(read_entries(out)) == [0, 2, 3, 4, 5]
    assert [int(item["index"]) for item in BlurDataset(out)] == [0, 2, 3, 4, 5]
    monkeypatch.setattr(datagen.runs, "make_sample", lambda plan, i: made.append(i) or real(plan, i))
    assert generate(parse_spec(SHARDED), out).is_complete
    assert made == [1, 6]
    assert tar_sums(out) == tar_sums(reference)


def test_damaged_shards_are_made_again_and_named(reference, tmp_path, monkeypatch):
    out, real, made = tmp_path / "data", datagen.runs.make_sample, []
    shutil.copytree(reference, out)
    place = out / "shards/000001.tar"
    data = bytearray(place.read_bytes())
    data[read_entries(out)[4]["files"][0]["offset"] + 9] ^= 4
    place.write_bytes(bytes(data))
    (out / "shards/000002.json").write_bytes(b"{}\n")
    first = bytearray((out / "shards/000000.tar").read_bytes())
    first[-1] ^= 1  # the end of a tar is padding
    (out / "shards/000000.tar").write_bytes(bytes(first))
    monkeypatch.setattr(datagen.runs, "make_sample", lambda plan, i: made.append(i) or real(plan, i))
    result = generate(parse_spec(SHARDED), out)
    assert made == [4, 6]
    again = "made again if a frame was lost with it"
    told = [
        f"shards/000000.tar differs from its marker between its files; {again}",
        f"shards/000002.json: expected a shard's marker, got one that is damaged; {again}",
        "frame 4: frames/00000004.exr in shards/000001.tar differs from the marker; made again",
    ]
    assert list(result.repaired) == told
    assert tar_sums(out) == tar_sums(reference)


def test_a_finished_run_makes_nothing_again(reference, monkeypatch):
    before = tar_sums(reference)
    refuse_to_render(monkeypatch)
    result = generate(parse_spec(SHARDED), reference)
    assert (result.made, result.kept, result.is_complete) == (0, 7, True)
    assert tar_sums(reference) == before


@pytest.mark.parametrize(
    ("fields", "named"),
    [({"frames_per_shard": 2}, "frames_per_shard"), ({"storage": "folder"}, "storage"), ({"seed": 5}, "seed")],
)
def test_another_configuration_is_refused_and_the_field_named(reference, fields, named):
    before = sums(reference)
    with pytest.raises(SpecError, match=f"^{named}: expected"):
        generate(parse_spec(SHARDED | fields), reference)
    assert sums(reference) == before
    assert generate(parse_spec(SHARDED | {"storage": "auto"}), reference).made == 0


def test_it_is_read_while_it_is_being_written(tmp_path, monkeypatch):
    out, real, seen = tmp_path / "data", datagen.runs.make_sample, {}

    def look(plan, index):
        if index:
            try:
                dataset = BlurDataset(out)
                seen[index] = [int(dataset[k]["index"]) for k in range(len(dataset))]
            except ValueError:
                seen[index] = []
        return real(plan, index)

    monkeypatch.setattr(datagen.runs, "make_sample", look)
    generate(parse_spec(SHARDED), out)
    assert seen == {1: [], 2: [], 3: [0, 1, 2], 4: [0, 1, 2], 5: [0, 1, 2], 6: [0, 1, 2, 3, 4, 5]}


def test_an_export_is_the_same_from_both(reference, plain, tmp_path):
    for kind, source in (("a", reference), ("b", plain)):
        export_dataset(source, tmp_path / kind, "gopro")
    assert sums(tmp_path / "a") == sums(tmp_path / "b")


def test_failures_of_slices_are_told_until_a_run_has_mended_them(tmp_path, monkeypatch):
    out, real = tmp_path / "data", datagen.runs.make_sample
    monkeypatch.setattr(datagen.runs, "make_sample", lambda plan, i: 1 / 0 if i in (1, 4) else real(plan, i))
    for number in (1, 2):
        assert not generate(parse_spec(SHARDED), out, part=Slice(number, 2)).is_complete
    assert [index for index, _ in read_status(out).failed] == [1, 4]
    monkeypatch.setattr(datagen.runs, "make_sample", real)
    assert generate(parse_spec(SHARDED), out).is_complete
    assert read_status(out).failed == ()
    assert not list(Path(out).glob("failures*"))
