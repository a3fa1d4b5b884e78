import hashlib
import json
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import children_of, outlivers

import datagen.runs
from datagen import ManifestError, SpecError, generate, parse_spec, verify_dataset
from datagen.entries import read_entries
from datagen.manifest import MANIFEST_NAME, read_manifest
from datagen.writer import FOLDERS, TEMPORARY_PREFIX

TINY = {"width": 8, "height": 6, "rays_per_pixel": 1, "frames_per_clip": 2, "seed": 4}
ROOT = Path(__file__).resolve().parent.parent


def spec(count=4, **fields):
    return parse_spec(TINY | {"count": count} | fields)


def sums(folder):
    """The checksum of everything a run leaves, by relative path."""
    files = [
        p
        for p in sorted(Path(folder).rglob("*"))
        if p.is_file() and p.suffix in (".exr", ".png", ".jsonl", ".json", ".tar")
    ]
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def run_script(code, *arguments, **options):
    return subprocess.Popen([sys.executable, "-c", code, *map(str, arguments)], cwd=ROOT, text=True, **options)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference") / "data"
    generate(spec(), folder)
    return folder


def test_two_workers_make_the_same_bytes_as_one(reference, tmp_path):
    result = generate(spec(), tmp_path / "two", workers=2)
    assert result.is_complete
    assert sums(tmp_path / "two") == sums(reference)
    assert list(read_manifest(tmp_path / "two")) == [0, 1, 2, 3]
    lines = (tmp_path / "two" / MANIFEST_NAME).read_text().splitlines()
    assert [json.loads(line)["index"] for line in lines] == [0, 1, 2, 3]
    generate(spec(seed=5), tmp_path / "other")
    mine, other = sums(reference), sums(tmp_path / "other")
    assert all(mine[name] != other[name] for name in mine if name.endswith(".exr"))


def test_a_finished_run_makes_nothing_again(reference, monkeypatch):
    before = sums(reference)
    monkeypatch.setattr(datagen.runs, "make_sample", lambda *_: pytest.fail("made a frame again"))
    result = generate(spec(), reference)
    assert (result.made, result.kept, result.is_complete) == (0, 4, True)
    assert sums(reference) == before


def test_frames_finished_before_an_interrupt_are_listed_and_kept(reference, tmp_path, monkeypatch):
    real = datagen.runs.make_sample

    def stopped(plan, index):
        if index == 2:
            raise KeyboardInterrupt
        return real(plan, index)

    monkeypatch.setattr(datagen.runs, "make_sample", stopped)
    with pytest.raises(KeyboardInterrupt):
        generate(spec(), tmp_path / "data")
    assert list(read_manifest(tmp_path / "data")) == [0, 1]
    monkeypatch.setattr(datagen.runs, "make_sample", real)
    result = generate(spec(), tmp_path / "data")
    assert (result.made, result.kept) == (2, 2)
    assert sums(tmp_path / "data") == sums(reference)


def test_a_longer_run_extends_a_shorter_one(reference, tmp_path):
    generate(spec(count=1), tmp_path / "data")
    result = generate(spec(count=4), tmp_path / "data")
    assert (result.made, result.kept) == (3, 1)
    assert sums(tmp_path / "data") == sums(reference)


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"seed": 5}, ["seed"]),
        ({"width": 9, "exposure": 0.25}, ["exposure", "width"]),
        ({"count": 2}, ["count"]),
        ({"frames_per_clip": 3, "fps": 30.0, "rays_per_pixel": 2}, ["fps", "frames_per_clip", "rays_per_pixel"]),
    ],
)
def test_another_configuration_is_refused_and_the_field_named(reference, fields, named):
    before = sums(reference)
    with pytest.raises(SpecError) as caught:
        generate(parse_spec(TINY | {"count": 4} | fields), reference)
    assert sorted(p.split(":")[0] for p in caught.value.problems) == named
    assert sums(reference) == before


def test_lost_and_cut_files_are_made_again(reference, tmp_path):
    folder = tmp_path / "data"
    generate(spec(), folder)
    (folder / "frames/00000001.exr").unlink()
    path = folder / "sharp/00000002.png"
    path.write_bytes(path.read_bytes()[:-5])
    (folder / "blur" / f"{TEMPORARY_PREFIX}99-1-x.png").write_bytes(b"left behind")
    result = generate(spec(), folder)
    assert (result.made, result.kept) == (2, 2)
    assert sums(folder) == sums(reference)


def test_a_manifest_cut_anywhere_in_its_last_line_is_survived(reference, tmp_path, monkeypatch):
    folder = tmp_path / "data"
    generate(spec(), folder)
    whole = (folder / MANIFEST_NAME).read_bytes()
    last = whole.rstrip(b"\n").rfind(b"\n") + 1
    for length in (last + 1, last + 40, len(whole) - 2, len(whole) - 1, last):
        (folder / MANIFEST_NAME).write_bytes(whole[:length])
        assert list(read_manifest(folder)) == [0, 1, 2]
        assert generate(spec(), folder).made == 1
        assert sums(folder) == sums(reference)


def stamps(folder):
    """When each frame's files were written, by relative path; a rewrite changes the inode."""
    files = [p for name in FOLDERS for p in (folder / name).iterdir()]
    return {p.relative_to(folder).as_posix(): (p.stat().st_ino, p.stat().st_mtime_ns) for p in files}


def test_damaged_files_of_the_right_size_are_made_again_and_named(reference, tmp_path, capsys):
    folder = tmp_path / "data"
    shutil.copytree(reference, folder)
    for name in ("blur/00000003.png", "frames/00000001.exr"):
        data = bytearray((folder / name).read_bytes())
        data[len(data) // 2] ^= 1
        (folder / name).write_bytes(data)
    (folder / "sharp/00000003.png").unlink()
    before = stamps(folder)
    result = generate(spec(), folder, is_quiet=False)
    assert result.repaired == (
        "frame 1: frames/00000001.exr differs from the manifest; made again",
        "frame 3: sharp/00000003.png is missing, blur/00000003.png differs from the manifest; made again",
    )
    told = capsys.readouterr().err
    assert all(line in told for line in result.repaired)
    assert (result.made, result.kept, result.is_complete) == (2, 2, True)
    assert sums(folder) == sums(reference)
    after = stamps(folder)
    intact = [name for name in after if Path(name).stem in ("00000000", "00000002")]
    assert {name: after[name] for name in intact} == {name: before[name] for name in intact}
    assert generate(spec(), folder).repaired == ()


def test_a_file_that_cannot_be_read_is_named(reference, tmp_path):
    folder = tmp_path / "data"
    shutil.copytree(reference, folder)
    (folder / "blur/00000002.png").unlink()
    (folder / "blur/00000002.png").mkdir()
    result = generate(spec(), folder)
    assert [index for index, _ in result.failed] == [2]
    assert (result.kept, result.repaired) == (3, ())  # it is in the way, so nothing has been made again
    (folder / "blur/00000002.png").rmdir()
    assert generate(spec(), folder).is_complete
    assert sums(folder) == sums(reference)


def test_a_damaged_line_of_the_manifest_costs_its_own_frame_only(reference, tmp_path, capsys):
    whole = (reference / MANIFEST_NAME).read_bytes()
    lines = whole.splitlines(keepends=True)
    sum_of_2 = json.loads(lines[2])["files"][0]["sha256"]
    cases = {  # damage: frames to be made again, what is told of it
        b"{" + whole: ([0], "line 1"),
        whole[5:]: ([0], "line 1"),
        b"".join([lines[0], b"junk\n", *lines[2:]]): ([1], "line 2, got 'junk'"),
        b"".join([*lines[:2], b"\xff\0" * 900 + b"\n", lines[3]]): ([2], "line 3"),
        b"".join([*lines[:2], b"[" * 100_000 + b"\n", lines[3]]): ([2], "line 3"),
        whole + b"[]\n": ([], "line 5, got '[]'"),
        whole.replace(sum_of_2.encode(), b"0" * 64): ([2], "frame 2: frames/00000002.exr differs"),
        whole.replace(sum_of_2.encode(), b"x" * 64): ([2], "line 3"),
        whole.replace(b'"frame": 1, "index": 1', b'"frame": 0, "index": 1'): (
            [1],
            "frame 1: its line in manifest.jsonl",
        ),
        whole.replace(b'"index": 1', b'"index": 7'): ([1], "line 2"),
    }
    for number, (damaged, (lost, told)) in enumerate(cases.items()):
        folder = tmp_path / str(number)
        shutil.copytree(reference, folder)
        (folder / MANIFEST_NAME).write_bytes(damaged)
        before = stamps(folder)
        if told.startswith("line"):
            with pytest.raises(ManifestError, match=told.split(",")[0]):
                read_manifest(folder)
        result = generate(spec(), folder, is_quiet=False)
        after = stamps(folder)
        assert sorted({int(Path(name).stem) for name in after if after[name] != before[name]}) == lost, told
        assert (result.made, result.kept, result.is_complete) == (len(lost), 4 - len(lost), True)
        assert len(result.repaired) == 1
        assert told in result.repaired[0]
        assert result.repaired[0] in capsys.readouterr().err
        assert sums(folder) == sums(reference), told


def test_of_two_lines_for_one_frame_the_one_that_fits_its_files_counts(reference, tmp_path):
    folder = tmp_path / "data"
    shutil.copytree(reference, folder)
    whole = (folder / MANIFEST_NAME).read_bytes()
    other = whole.replace(b'"bytes": ', b'"bytes": 1')
    for both in (whole + other, other + whole):
        (folder / MANIFEST_NAME).write_bytes(both)
        with pytest.raises(ManifestError, match="one entry of frame 0, got two that differ"):
            read_manifest(folder)
        result = generate(spec(), folder)
        assert (result.made, result.kept) == (0, 4)
        assert [note.split(";")[0] for note in result.repaired] == [
            f"manifest.jsonl: expected one entry of frame {index}, got two that differ" for index in range(4)
        ]
        assert sums(folder) == sums(reference)


def test_a_manifest_of_another_configuration_is_refused_and_left_alone(reference, tmp_path):
    folder = tmp_path / "data"
    shutil.copytree(reference, folder)
    place = folder / MANIFEST_NAME
    mine = json.loads(place.read_bytes().splitlines()[0])["config_sha256"].encode()
    place.write_bytes(place.read_bytes().replace(mine, b"5" * 64))
    before = sums(folder)
    with pytest.raises(SpecError, match=f"out: expected frames of configuration {mine.decode()} .*, got 5555"):
        generate(spec(), folder)
    assert sums(folder) == before


DRIVE = """
import sys
from datagen.__main__ import main
sys.exit(main(sys.argv[1:]))
"""


def command(folder, count=6, workers=2):
    flags = {"out": folder, "count": count, "width": 8, "height": 6, "rays-per-pixel": 1, "frames-per-clip": 2}
    words = [w for name, value in (flags | {"seed": 4, "workers": workers}).items() for w in (f"--{name}", str(value))]
    return words


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize("storage", ["folder", "shards"])
def test_a_killed_driver_leaves_no_process_and_a_rerun_finishes(tmp_path, storage):
    fields = {"count": 6, "storage": storage, "frames_per_shard": 2}
    generate(spec(**fields), tmp_path / "whole")
    folder, rng = tmp_path / "data", random.Random(3)
    words = [*command(folder), "--storage", storage, "--frames-per-shard", "2"]
    driver = run_script(DRIVE, *words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 300
    while (
        not [p for p in folder.rglob("0*.*") if p.suffix in (".exr", ".tar")]
        and time.monotonic() < deadline
        and driver.poll() is None
    ):
        time.sleep(0.01)
    time.sleep(rng.uniform(0, 0.3))
    workers = children_of(driver.pid)
    driver.send_signal(signal.SIGKILL)
    driver.wait(timeout=30)
    assert workers
    assert not outlivers(workers)
    listed = read_entries(folder)
    assert verify_dataset(folder) == []
    result = generate(spec(**fields), folder)
    assert result.kept == len(listed)
    assert sums(folder) == sums(tmp_path / "whole")


def test_an_interrupt_ends_with_130_and_a_rerun_finishes(tmp_path):
    folder = tmp_path / "data"
    driver = run_script(
        DRIVE, *command(folder, count=400, workers=1), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    deadline = time.monotonic() + 300  # the first frame may wait for the compiler
    while not list((folder / "frames").glob("*.exr")) and time.monotonic() < deadline:
        time.sleep(0.01)
    driver.send_signal(signal.SIGINT)
    _, told = driver.communicate(timeout=60)
    assert driver.returncode == 130
    assert "the same command finishes the rest" in told
    assert verify_dataset(folder) == []


def test_two_runs_in_one_folder_are_not_let_in(tmp_path):
    pytest.importorskip("fcntl", reason="needs the system's file locks")
    from datagen.folders import locked_folder

    with locked_folder(tmp_path / "data"), pytest.raises(SpecError, match="no other run"):
        generate(spec(), tmp_path / "data")
    assert generate(spec(count=1), tmp_path / "data").made == 1


def test_a_folder_with_other_files_is_refused_and_left_alone(tmp_path):
    (tmp_path / "frames").mkdir()
    for name in ("letter.txt", ".tmp-1-1-mine", "frames/own.exr"):
        (tmp_path / name).write_text("mine")
    with pytest.raises(SpecError, match=r"out: expected an empty folder .* got frames, letter\.txt"):
        generate(spec(), tmp_path)
    assert {p.name for p in tmp_path.rglob("*.*")} == {"letter.txt", ".tmp-1-1-mine", "own.exr", ".lock"}


def test_a_path_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(SpecError, match="out: expected a folder"):
        generate(spec(), tmp_path / "file")


@pytest.mark.parametrize("storage", ["folder", "shards"])
def test_a_damaged_or_missing_record_of_the_run_is_written_again_where_the_frames_bear_it_out(tmp_path, storage):
    fields = {"storage": storage, "frames_per_shard": 2}
    folder = tmp_path / "data"
    generate(spec(**fields), folder)
    whole = sums(folder)
    record = (folder / "run.json").read_bytes()
    damages = (
        None,
        b"",
        record[:-9],
        record.replace(b'"seed": 4', b'"seed": 5'),
        record.replace(b'"count": 4', b'"count": ""'),
    )
    for damaged in damages:
        assert damaged != record
        damage(folder / "run.json", damaged)
        assert verify_dataset(folder) != []
        for other in ({"seed": 5}, {"count": 2}):
            with pytest.raises(SpecError):
                generate(spec(**fields | other), folder)
            assert damaged == ((folder / "run.json").read_bytes() if (folder / "run.json").exists() else None)
        result = generate(spec(**fields | {"storage": "auto"}), folder)
        assert (result.made, result.kept) == (0, 4)
        assert "run.json" in result.repaired[0]
        assert sums(folder) == whole
        assert verify_dataset(folder) == []
    for place in (*folder.glob("manifest.jsonl"), *folder.glob("shards/*.json")):
        place.unlink()
    for damaged in (None, b""):
        damage(folder / "run.json", damaged)
        with pytest.raises(SpecError, match=r"run\.json"):  # nothing bears it out
            generate(spec(**fields), folder)


def damage(place, data):
    """Give a file other bytes, or take it away."""
    place.unlink() if data is None else place.write_bytes(data)
