import struct
import zlib

import numpy as np
import pytest

from datagen.flow_files import FLOW_SUFFIXES, FlowFileError, encode_flow, read_flow

H, W = 5, 7
NEEDS = {".flo5": "h5py"}


def square_that_moves(x, y):
    """Return (H, W, 2): a square in the upper left moves by (x, y), the rest is still, one corner unknown."""
    flow = np.zeros((H, W, 2), np.float32)
    flow[1:3, 1:4] = (x, y)
    flow[4, 6] = np.nan
    return flow


def stored(tmp_path, flow, suffix):
    for package in [NEEDS[suffix]] if suffix in NEEDS else []:
        pytest.importorskip(package, reason=f"{suffix} files need {package}")
    path = tmp_path / f"flow{suffix}"
    path.write_bytes(encode_flow(flow, suffix))
    return path


def same(a, b):
    return np.array_equal(a, b, equal_nan=True)


@pytest.mark.parametrize("suffix", FLOW_SUFFIXES)
@pytest.mark.parametrize("motion", [(3.25, 0.0), (0.0, 3.25), (-2.5, 7.75)])
def test_round_trip(tmp_path, suffix, motion):
    flow = square_that_moves(*motion)
    found = read_flow(stored(tmp_path, flow, suffix))
    assert found.dtype == np.float32
    assert same(found, flow)
    strided = np.asfortranarray(np.repeat(flow, 2, axis=1))[:, ::2][::-1]
    assert same(read_flow(stored(tmp_path, strided, suffix)), flow[::-1])


@pytest.mark.parametrize("suffix", [".flo", ".pfm", ".flo5"])
def test_float_formats_are_exact(tmp_path, suffix):
    flow = (np.random.default_rng(0).normal(size=(9, 4, 2)) * 1e3).astype(np.float32)
    assert same(read_flow(stored(tmp_path, flow, suffix)), flow)


def test_kitti_is_within_half_a_step(tmp_path):
    flow = np.random.default_rng(0).uniform(-511, 511, (9, 4, 2)).astype(np.float32)
    assert np.abs(read_flow(stored(tmp_path, flow, ".png")) - flow).max() <= 1 / 128


def unpacked_png(data):
    """Return the samples of a 16-bit RGB PNG, by the standard alone."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    place, packed = 8, b""
    while place < len(data):
        length, kind = struct.unpack(">I4s", data[place : place + 8])
        body = data[place + 8 : place + 8 + length]
        if kind == b"IHDR":
            width, height, depth, colour, _, _, interlace = struct.unpack(">IIBBBBB", body)
            assert (depth, colour, interlace) == (16, 2, 0)
        packed += body if kind == b"IDAT" else b""
        place += 12 + length
    raw, rows, above = zlib.decompress(packed), [], bytes(6 * width)
    for y in range(height):
        kind, line = raw[y * (6 * width + 1)], bytearray(raw[y * (6 * width + 1) + 1 : (y + 1) * (6 * width + 1)])
        for k in range(len(line)):
            a, b = line[k - 6] if k >= 6 else 0, above[k]
            c = above[k - 6] if k >= 6 else 0
            paeth = min((a, b, c), key=lambda v: abs(a + b - c - v))
            line[k] = (line[k] + (0, a, b, (a + b) // 2, paeth)[kind]) & 255
        above = bytes(line)
        rows.append(np.frombuffer(above, ">u2").reshape(width, 3))
    return np.stack(rows)


def test_bytes_are_those_of_the_formats_descriptions(tmp_path):
    flow = square_that_moves(3.25, -2.0)
    flo = encode_flow(flow, ".flo")
    assert struct.unpack("<fii", flo[:12]) == (202021.25, W, H)
    first = 12 + 8 * (1 * W + 1)  # row 1, column 1
    assert struct.unpack("<ff", flo[first : first + 8]) == (3.25, -2.0)
    assert struct.unpack("<ff", flo[-8:]) == (1e10, 1e10)
    pfm = encode_flow(flow, ".pfm")
    header = f"PF\n{W} {H}\n-1.0\n".encode()
    assert pfm[: len(header)] == header
    first = len(header) + 12 * ((H - 1 - 1) * W + 1)  # the bottom row comes first
    assert struct.unpack("<fff", pfm[first : first + 12]) == (3.25, -2.0, 0.0)
    kitti = unpacked_png(encode_flow(flow, ".png"))
    assert kitti[1, 1].tolist() == [32768 + 208, 32768 - 128, 1]
    assert kitti[0, 0].tolist() == [32768, 32768, 1]
    assert kitti[4, 6].tolist() == [0, 0, 0]


def test_opencv_reads_flo_pfm_and_kitti(tmp_path):
    cv2 = pytest.importorskip("cv2", reason="referee: opencv-python-headless")
    flow = square_that_moves(3.25, 1.5)
    known = ~np.isnan(flow).any(-1)
    assert np.array_equal(cv2.readOpticalFlow(str(stored(tmp_path, flow, ".flo")))[known], flow[known])
    pfm = cv2.imread(str(stored(tmp_path, flow, ".pfm")), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert same(pfm[..., :2], flow)
    kitti = cv2.imread(str(stored(tmp_path, flow, ".png")), cv2.IMREAD_UNCHANGED)[..., ::-1].astype(np.float32)
    assert np.array_equal(kitti[..., 2] > 0, known)
    assert np.array_equal(((kitti[..., :2] - 2**15) / 64)[known], flow[known])


def test_what_others_write_is_read(tmp_path):
    cv2 = pytest.importorskip("cv2", reason="referee: opencv-python-headless")
    flow = square_that_moves(-4.0, 2.5)
    flow[4, 6] = 0
    cv2.writeOpticalFlow(str(tmp_path / "other.flo"), flow)
    assert same(read_flow(tmp_path / "other.flo"), flow)
    big_endian = b"PF\n7 5\n1.0\n" + np.dstack([flow, flow[..., :1] * 0])[::-1].astype(">f4").tobytes()
    (tmp_path / "other.pfm").write_bytes(big_endian)
    assert same(read_flow(tmp_path / "other.pfm"), flow)


def test_h5py_reads_flo5(tmp_path):
    h5py = pytest.importorskip("h5py", reason=".flo5 files need h5py")
    flow = square_that_moves(1.0, 2.0)
    with h5py.File(stored(tmp_path, flow, ".flo5"), "r") as file:
        assert same(file["flow"][:], flow)
        assert (file["flow"].compression, file["flow"].compression_opts) == ("gzip", 5)


def test_motion_that_a_format_cannot_hold_is_refused():
    flow = square_that_moves(512.0, 0.0)
    with pytest.raises(FlowFileError, match=r"expected motion from -512 to 511\.98 px for a \.png, got 512"):
        encode_flow(flow, ".png")
    encode_flow(square_that_moves(-512.0, 0.0), ".png")
    for suffix in FLOW_SUFFIXES:
        with pytest.raises(FlowFileError, match="flow_px: expected motion below"):
            encode_flow(square_that_moves(np.inf, 0.0), suffix)


@pytest.mark.parametrize("flow", [np.zeros((3, 4, 2)), np.zeros((3, 4), np.float32), np.zeros((2, 3, 4), np.float32)])
def test_other_arrays_are_refused(flow):
    with pytest.raises(ValueError, match=r"flow_px: expected \(H, W, 2\) float32"):
        encode_flow(flow, ".flo")


def test_other_suffixes_are_refused(tmp_path):
    with pytest.raises(ValueError, match="suffix: expected one of"):
        encode_flow(square_that_moves(1, 1), ".exr")
    with pytest.raises(ValueError, match="path: expected a suffix of"):
        read_flow(tmp_path / "flow.exr")


@pytest.mark.parametrize("suffix", FLOW_SUFFIXES)
def test_damaged_and_missing_files_are_named(tmp_path, suffix):
    path = stored(tmp_path, square_that_moves(1, 2), suffix)
    data = path.read_bytes()
    for content in (b"", b"nothing", data[: len(data) // 2], data[1:]):
        path.write_bytes(content)
        with pytest.raises(FlowFileError, match=rf"flow\{suffix}: expected a \{suffix} flow file"):
            read_flow(path)
    path.unlink()
    with pytest.raises(FlowFileError, match="FileNotFoundError"):
        read_flow(path)
