import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from test_datagen_samples import PX, SIZE, square_clip

import datagen.runs
from datagen import BlurDataset, ExportError, FrameFileError, export_dataset, generate, parse_spec, read_flow
from datagen.layouts import LAYOUTS
from datagen.samples import render_sample
from datagen.scenes import plan_from_json

FPS = 24.0
RIGHT_PX, DOWN_PX = 1.5, 2.25  # a frame; both exact in steps of 1/64
NEEDS = {"lmdb": "lmdb", "spring": "h5py"}


def make_square(plan_json, index):
    """Return the sample of a square that moves right and down by a constant number of pixels a frame."""
    plan = plan_from_json(plan_json)
    velocity = (RIGHT_PX / PX * FPS, -DOWN_PX / PX * FPS, 0.0)  # world y is up
    return render_sample(square_clip(velocity), plan, index, plan.spec.clip_and_frame(index)[1])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Five frames: a clip of three, a clip of two."""
    out = tmp_path_factory.mktemp("set") / "data"
    fields = {"width": SIZE, "height": SIZE, "count": 5, "rays_per_pixel": 1, "frames_per_clip": 3, "fps": FPS}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datagen.runs, "make_sample", make_square)
        assert generate(parse_spec(fields), out).is_complete
    return out


def exported(folder, tmp_path, layout, **options):
    if layout in NEEDS and not options.get("flow_suffix"):
        pytest.importorskip(NEEDS[layout], reason=f"layout {layout} needs {NEEDS[layout]}")
    return export_dataset(folder, tmp_path / layout, layout, **options)


def tree(folder):
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def pixels(path):
    with Image.open(path) as image:
        assert (image.format, image.mode) == ("PNG", "RGB")
        return np.asarray(image)


def test_gopro_has_equal_names_and_light_to_the_power_of_1_over_2_2(folder, tmp_path):
    result = exported(folder, tmp_path, "gopro", split="test")
    names = {f"clip{c:06d}/{k}/{f:06d}.png" for c, n in ((0, 3), (1, 2)) for f in range(n)
             for k in ("sharp", "blur", "blur_gamma")}  # fmt: skip
    assert tree(tmp_path / "gopro") == {f"test/{name}" for name in names} | {"export.json"}
    assert (result.frames, result.files) == (5, 15)
    item = BlurDataset(folder)[4]
    for kind, key in (("sharp", "sharp"), ("blur_gamma", "blurred"), ("blur", "blurred")):
        found = pixels(tmp_path / f"gopro/test/clip000001/{kind}/000001.png") / 255
        linear = item[key].permute(1, 2, 0).double().clamp(0, 1).numpy()
        assert np.abs(found - linear ** (1 / 2.2)).max() <= 0.5 / 255 + 1e-9
        assert np.abs(found - linear).max() > 0.1


def test_reds_holds_the_pngs_of_the_data_set_and_basicsrs_list(folder, tmp_path):
    exported(folder, tmp_path, "reds")
    out = tmp_path / "reds"
    assert tree(out) == {
        *(
            f"train/train_{k}/{c:03d}/{f:08d}.png"
            for k in ("sharp", "blur")
            for c, n in ((0, 3), (1, 2))
            for f in range(n)
        ),
        "train/meta_info_REDS_GT.txt",
        "export.json",
    }
    for kind in ("sharp", "blur"):
        mine = (folder / kind / "00000003.png").read_bytes()
        assert (out / f"train/train_{kind}/001/00000000.png").read_bytes() == mine
    lines = (out / "train/meta_info_REDS_GT.txt").read_text().splitlines()
    assert lines == [f"000 3 ({SIZE},{SIZE},3)", f"001 2 ({SIZE},{SIZE},3)"]


def test_basicsr_has_equal_names_in_both_folders_and_the_list(folder, tmp_path):
    exported(folder, tmp_path, "basicsr")
    out = tmp_path / "basicsr/train"
    for line, index in zip((out / "meta_info.txt").read_text().splitlines(), range(5), strict=True):
        name, size, _ = line.split(" ")
        assert (name, size) == (f"{index:08d}.png", f"({SIZE},{SIZE},3)")
        for kind, stored in (("gt", "sharp"), ("lq", "blur")):
            assert (out / kind / name).read_bytes() == (folder / stored / name).read_bytes()


def test_lmdb_is_read_as_basicsr_reads_it(folder, tmp_path):
    lmdb = pytest.importorskip("lmdb", reason="layout lmdb needs lmdb")
    cv2 = pytest.importorskip("cv2", reason="referee: opencv-python-headless")
    exported(folder, tmp_path, "lmdb")
    exported(folder, tmp_path, "lmdb")  # once more: the same pictures take the place of the old
    for store, stored in (("gt", "sharp"), ("lq", "blur")):
        place = tmp_path / f"lmdb/train/{store}.lmdb"
        lines = (place / "meta_info.txt").read_text().splitlines()
        keys = [line.split(".")[0] for line in lines]
        assert keys == [f"{i:08d}" for i in range(5)]
        with lmdb.open(str(place), readonly=True, lock=False, readahead=False) as env, env.begin(write=False) as txn:
            assert txn.stat()["entries"] == 5
            for key in keys:
                image = cv2.imdecode(np.frombuffer(txn.get(key.encode("ascii")), np.uint8), cv2.IMREAD_COLOR)
                assert np.array_equal(image[..., ::-1], pixels(folder / stored / f"{key}.png"))


@pytest.mark.parametrize("suffix", [None, ".pfm", ".png", ".flo5"])
def test_sintel_has_flow_from_each_frame_to_the_next(folder, tmp_path, suffix):
    if suffix == ".flo5":
        pytest.importorskip("h5py", reason=".flo5 files need h5py")
    exported(folder, tmp_path, "sintel", flow_suffix=suffix)
    out, end = tmp_path / "sintel/training", suffix or ".flo"
    for clip, frames in ((0, 3), (1, 2)):
        for kind, count, ending in (("clean", frames, ".png"), ("final", frames, ".png"), ("flow", frames - 1, end)):
            found = sorted(p.name for p in (out / kind / f"clip_{clip:04d}").iterdir())
            assert found == [f"frame_{n:04d}{ending}" for n in range(1, count + 1)]
    flow = read_flow(out / f"flow/clip_0000/frame_0001{end}")
    moving = np.abs(flow).max(-1) > 0
    assert moving[SIZE // 2, SIZE // 2]
    assert np.abs(flow[moving] - (RIGHT_PX, DOWN_PX)).max() < (1 / 128 + 1e-4 if end == ".png" else 1e-4)
    during = read_flow(out / f"flow_exposure/clip_0000/frame_0001{end}")
    assert np.abs(during[moving] - (RIGHT_PX / 2, DOWN_PX / 2)).max() < (1 / 128 + 1e-4 if end == ".png" else 1e-4)


def test_the_flow_leads_from_a_picture_to_the_next(folder, tmp_path):
    """Sharp frame 2 looked up at p + flow(p) is sharp frame 1: two frames on, a whole number of pixels away."""
    exported(folder, tmp_path, "sintel")
    out = tmp_path / "sintel/training"
    flow = sum(read_flow(out / f"flow/clip_0000/frame_000{k}.flo")[SIZE // 2, SIZE // 2] for k in (1, 2))
    first, third = (pixels(out / f"clean/clip_0000/frame_000{k}.png").astype(int) for k in (1, 3))
    assert flow[0] == pytest.approx(3, abs=1e-3)
    rows, columns = np.meshgrid(np.arange(8, 14), np.arange(8, 14), indexing="ij")
    rise = flow[1] - 4.5
    assert abs(rise) < 1e-3  # half a pixel between rows 4 and 5: both neighbours bound the colour
    low = np.minimum(third[rows + 4, columns + 3], third[rows + 5, columns + 3])
    high = np.maximum(third[rows + 4, columns + 3], third[rows + 5, columns + 3])
    mine = first[rows, columns]
    assert ((low - 2 <= mine) & (mine <= high + 2)).all()
    assert mine.std(axis=(0, 1)).max() > 20


def test_opencv_reads_sintels_flow(folder, tmp_path):
    cv2 = pytest.importorskip("cv2", reason="referee: opencv-python-headless")
    exported(folder, tmp_path, "sintel")
    flow = cv2.readOpticalFlow(str(tmp_path / "sintel/training/flow/clip_0001/frame_0001.flo"))
    assert flow[SIZE // 2, SIZE // 2].tolist() == pytest.approx([RIGHT_PX, DOWN_PX], abs=1e-4)


def test_spring_flow_is_read_at_every_second_value(folder, tmp_path):
    h5py = pytest.importorskip("h5py", reason=".flo5 files need h5py")
    exported(folder, tmp_path, "spring")
    out = tmp_path / "spring/train/0001"
    assert tree(out) == {
        *(f"{k}/{k}_{n:04d}.png" for k in ("frame_left", "blur_left") for n in (1, 2, 3)),
        *(f"flow_FW_left/flow_FW_left_{n:04d}.flo5" for n in (1, 2)),
        *(f"flow_BW_left/flow_BW_left_{n:04d}.flo5" for n in (2, 3)),
        *(f"flow_exposure_left/flow_exposure_left_{n:04d}.flo5" for n in (1, 2, 3)),
    }
    with h5py.File(out / "flow_BW_left/flow_BW_left_0002.flo5") as file:
        flow = file["flow"][()]
    assert flow.shape == (2 * SIZE, 2 * SIZE, 2)
    item = BlurDataset(folder)[1]
    assert np.array_equal(flow[::2, ::2], item["motion_previous"].permute(1, 2, 0).numpy(), equal_nan=True)
    assert flow[SIZE, SIZE].tolist() == pytest.approx([-RIGHT_PX, -DOWN_PX], abs=1e-4)


def test_blur_is_not_shifted_against_sharp(folder, tmp_path):
    """Under constant motion the light's centroid of the blurred picture is that of the sharp one."""
    item = BlurDataset(folder)[0]
    behind = torch.tensor([0.1, 0.2, 0.3]).reshape(3, 1, 1)
    x = torch.arange(SIZE) + 0.5

    def centroid(image):
        light = (image - behind).abs().sum(0).double()
        return (light.sum(0) * x).sum() / light.sum(), (light.sum(1) * x).sum() / light.sum()

    for a, b in zip(centroid(item["sharp"]), centroid(item["blurred"]), strict=True):
        assert abs(float(a - b)) < 0.15


def test_the_record_says_what_it_is_and_a_second_call_repeats_it(folder, tmp_path):
    exported(folder, tmp_path, "sintel")
    out = tmp_path / "sintel"
    record = json.loads((out / "export.json").read_text())
    assert (record["layout"], record["split"], record["frames"], record["is_finished"]) == (
        "sintel",
        "training",
        5,
        True,
    )
    assert "x right, y down" in record["conventions"]["flow"]
    before = {name: (out / name).read_bytes() for name in tree(out)}
    (out / "training/flow/clip_0000/frame_0001.flo").unlink()
    exported(folder, tmp_path, "sintel")
    assert {name: (out / name).read_bytes() for name in tree(out)} == before
    with pytest.raises(ExportError, match=r"flow_suffix: expected '\.flo' as in .*, got '\.pfm'"):
        exported(folder, tmp_path, "sintel", flow_suffix=".pfm")


def test_an_export_cut_short_says_so_and_the_same_call_finishes_it(folder, tmp_path, monkeypatch):
    import datagen.export

    real, left = datagen.export.write_atomically, [6]

    def full(path, data):
        left[0] -= 1
        if left[0] == 0:
            raise OSError(28, "No space left on device")
        real(path, data)

    monkeypatch.setattr(datagen.export, "write_atomically", full)
    with pytest.raises(OSError, match="No space"):
        exported(folder, tmp_path, "reds")
    assert json.loads((tmp_path / "reds/export.json").read_text())["is_finished"] is False
    monkeypatch.setattr(datagen.export, "write_atomically", real)
    exported(folder, tmp_path, "reds")
    assert json.loads((tmp_path / "reds/export.json").read_text())["is_finished"] is True


def test_every_wrong_argument_is_named_before_anything_is_written(folder, tmp_path):
    with pytest.raises(ExportError) as caught:
        export_dataset(folder, tmp_path / "out", "kitchen", split="../up", flow_suffix=".exr")
    assert [p.split(":")[0] for p in caught.value.problems] == ["layout", "split", "flow_suffix"]
    with pytest.raises(ExportError, match=r"flow_suffix: expected none for layout gopro; those with flow are sintel"):
        export_dataset(folder, tmp_path / "out", "gopro", flow_suffix=".flo")
    assert not (tmp_path / "out").exists()
    for inside in (folder, folder / "shards", folder / "a/../b"):
        with pytest.raises(ExportError, match="out: expected a folder outside of the data set"):
            export_dataset(folder, inside, "gopro")
        assert not (folder / "shards").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other/thesis.tex").write_text("x")
    with pytest.raises(ExportError, match=r"out: expected an empty folder .* got thesis\.tex"):
        export_dataset(folder, tmp_path / "other", "gopro")
    (tmp_path / "file").write_text("x")
    with pytest.raises(ExportError, match="out: expected a folder, got the file"):
        export_dataset(folder, tmp_path / "file", "gopro")
    with pytest.raises(ExportError, match="out: expected a folder that can be written, got '/proc/out'"):
        export_dataset(folder, "/proc/out", "gopro")


def test_a_smaller_set_is_not_mixed_into_the_export_of_a_larger_one(folder, tmp_path):
    generate(parse_spec({"width": 4, "height": 4, "count": 3, "rays_per_pixel": 1}), tmp_path / "large")
    generate(parse_spec({"width": 4, "height": 4, "count": 2, "rays_per_pixel": 1}), tmp_path / "small")
    for name in ("small", "large", "large"):  # it may grow
        export_dataset(tmp_path / name, tmp_path / "out", "basicsr")
    with pytest.raises(ExportError, match=r"folder: expected at least the 3 frames of .*, got 2"):
        export_dataset(tmp_path / "small", tmp_path / "out", "basicsr")


def test_what_a_killed_export_left_is_gone_after_the_next(folder, tmp_path):
    exported(folder, tmp_path, "gopro")
    before = tree(tmp_path / "gopro")
    left = tmp_path / "gopro/train/clip000000/sharp/.tmp-4317-4-000001.png"
    left.write_bytes(b"half a picture")
    (tmp_path / "gopro/.tmp-4317-0-export.json").write_bytes(b"{")
    exported(folder, tmp_path, "gopro")
    assert tree(tmp_path / "gopro") == before


def test_unfinished_sets_and_single_frames_are_refused(folder, tmp_path):
    part = tmp_path / "part"
    shutil.copytree(folder, part)
    lines = (part / "manifest.jsonl").read_bytes().splitlines(keepends=True)
    (part / "manifest.jsonl").write_bytes(b"".join(lines[:3]))
    with pytest.raises(ExportError, match="folder: expected a finished data set of 5 frames, got 3 of them"):
        export_dataset(part, tmp_path / "out", "reds")
    generate(parse_spec({"width": 4, "height": 4, "count": 1, "rays_per_pixel": 1}), tmp_path / "single")
    with pytest.raises(ExportError, match="frames_per_clip: expected at least 2"):
        export_dataset(tmp_path / "single", tmp_path / "out", "sintel")
    assert not (tmp_path / "out").exists()


def test_a_damaged_frame_is_named(folder, tmp_path):
    part = tmp_path / "part"
    shutil.copytree(folder, part)
    for name, layout in (("sharp/00000002.png", "reds"), ("frames/00000002.exr", "gopro")):
        data = (part / name).read_bytes()
        (part / name).write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        with pytest.raises(FrameFileError, match=name.split("/")[1]):
            export_dataset(part, tmp_path / layout, layout)
        (part / name).write_bytes(data)


def test_a_missing_optional_package_is_told_before_anything_is_written(folder, tmp_path, monkeypatch):
    for package, layout in (("lmdb", "lmdb"), ("h5py", "spring")):
        monkeypatch.setitem(__import__("sys").modules, package, None)
        with pytest.raises(ModuleNotFoundError, match=rf"{package}: .*install torchblur\[export\]"):
            export_dataset(folder, tmp_path / "out", layout)
    assert not (tmp_path / "out").exists()


def test_every_layout_is_tested_above():
    assert set(LAYOUTS) == {"gopro", "reds", "sintel", "spring", "basicsr", "lmdb"}
