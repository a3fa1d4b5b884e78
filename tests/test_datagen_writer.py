import io
import json

import numpy as np
import pytest
import torch
from PIL import Image

from datagen.pictures import encode_png
from datagen.writer import FrameFileError, encode_exr, read_exr, write_atomically

H, W = 7, 12
BASE = np.random.default_rng(1).normal(size=(2 * H, 2 * W, 4)).astype(np.float32)
LAYOUTS = {
    "contiguous": np.ascontiguousarray(BASE[:H, :W, 0]),
    "channel of an image": BASE[:H, :W, 1],
    "every second": BASE[::2, ::2, 0],
    "flipped rows": BASE[:H, :W, 0][::-1],
    "flipped columns": BASE[:H, :W, 0][:, ::-1],
    "transposed": np.ascontiguousarray(BASE[:H, :W, 2].T).T,
    "fortran": np.asfortranarray(BASE[:H, :W, 3]),
    "permuted tensor": torch.from_numpy(BASE[:H, :W]).permute(2, 0, 1).contiguous().permute(1, 2, 0).numpy()[..., 1],
    "broadcast": np.broadcast_to(BASE[0, :W, 0], (H, W)),
}


def store(tmp_path, parts, meta=None):
    for name in ("sharp", "blurred", "data"):
        parts.setdefault(name, {"X": np.zeros((H, W), np.float32)})
    path = tmp_path / "frame.exr"
    path.write_bytes(encode_exr(parts, meta or {}))
    return read_exr(path)


def bits(a):
    return np.ascontiguousarray(a).view({2: np.uint16, 4: np.uint32}[a.dtype.itemsize])


@pytest.mark.parametrize("layout", sorted(LAYOUTS))
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.uint32])
def test_every_memory_layout_comes_back_bit_for_bit(tmp_path, layout, dtype):
    with np.errstate(invalid="ignore"):
        plane = LAYOUTS[layout].astype(dtype, order="K") if dtype != np.uint32 else LAYOUTS[layout].view(dtype)
    before = plane.copy()
    parts, _ = store(tmp_path, {"data": {"a.u": plane, "a.v": plane[:, ::-1]}})
    assert parts["data"]["a.u"].dtype == dtype
    assert np.array_equal(bits(parts["data"]["a.u"]), bits(before))
    assert np.array_equal(bits(parts["data"]["a.v"]), bits(before[:, ::-1]))
    assert np.array_equal(bits(plane), bits(before))


def test_nan_inf_and_denormals_come_back_bit_for_bit(tmp_path):
    odd = np.array([np.nan, np.inf, -np.inf, -0.0, 1e-45, -3e38, 1e-38, 7.0], np.float32)
    plane = np.resize(odd, (H, W))
    parts, _ = store(tmp_path, {"data": {"Z": plane}})
    assert np.array_equal(bits(parts["data"]["Z"]), bits(plane))


def test_metadata_comes_back_equal_and_large_numbers_whole(tmp_path):
    meta = {"seed": 2**62 + 1, "text": "größer <&> \"'", "list": [1.5, None, True], "nested": {"a": [[0.1, 2.0]]}}
    _, found = store(tmp_path, {}, meta)
    assert found == meta
    with pytest.raises(ValueError, match="JSON"):
        encode_exr({"data": {"Z": np.zeros((H, W), np.float32)}}, {"a": float("nan")})


@pytest.mark.parametrize(
    "plane",
    [np.zeros((H, W)), np.zeros((H, W), np.int32), np.zeros((H, W, 2), np.float32), np.zeros((H, W), ">f4")],
)
def test_other_types_are_refused(plane):
    with pytest.raises(ValueError, match=r"data\.Z: expected \(H, W\)"):
        encode_exr({"data": {"Z": plane}}, {})


def test_planes_of_different_sizes_are_refused():
    with pytest.raises(ValueError, match="one size"):
        encode_exr({"a": {"x": np.zeros((2, 3), np.float32)}, "b": {"x": np.zeros((3, 3), np.float32)}}, {})


def test_the_same_input_gives_the_same_bytes():
    parts = {"data": {"Z": LAYOUTS["every second"], "A": LAYOUTS["flipped rows"]}}
    assert encode_exr(parts, {"b": 1, "a": 2}) == encode_exr(parts, {"a": 2, "b": 1})


def test_a_damaged_or_missing_frame_is_named(tmp_path):
    path = tmp_path / "frame.exr"
    with pytest.raises(FrameFileError, match=r"frame\.exr: expected a frame, got FileNotFoundError"):
        read_exr(path)
    planes = {"X": np.arange(64 * 64, dtype=np.float32).reshape(64, 64)}
    data = encode_exr({"sharp": planes, "blurred": dict(planes), "data": dict(planes)}, {})
    broken = bytearray(data)
    broken[len(data) // 2] ^= 0x40
    for content in (data[: len(data) // 2], b"", b"not an image", data[:-3], bytes(broken), data[8:]):
        path.write_bytes(content)
        with pytest.raises(FrameFileError, match=r"frame\.exr: expected"):
            read_exr(path)
    path.write_bytes(encode_exr({"sharp": planes}, {}))
    with pytest.raises(FrameFileError, match="expected parts sharp, blurred and data"):
        read_exr(path)


def test_png_round_trip():
    pixels = np.random.default_rng(0).integers(0, 256, (5, 9, 3)).astype(np.uint8)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(encode_png(pixels[:, ::-1])))), pixels[:, ::-1])
    with pytest.raises(ValueError, match="pixels: expected"):
        encode_png(pixels.astype(np.float32))


def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "a.bin"
    write_atomically(path, b"old")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_atomically(path, b"new content")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


def test_metadata_is_plain_text_in_the_file():
    data = encode_exr({"data": {"Z": np.zeros((2, 2), np.float32)}}, {"seed": 41})
    assert json.dumps({"seed": 41}).encode() in data
