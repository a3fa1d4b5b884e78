"""Small files that ask for much memory or time, or for a wait without end: refused by what they announce."""

import contextlib
import os
import signal
import struct
import zlib

import numpy as np
import pytest
import torch
from gltf_makers import SQUARE, Maker, turn

from datagen import MeshError
from datagen.assets import load_mesh, parse_mesh
from datagen.rosters import survey_meshes
from datagen.sequences import load_sequence


@contextlib.contextmanager
def within(seconds):
    """Fail rather than wait for longer."""

    def give_up(*_):
        raise TimeoutError(f"took longer than {seconds} s")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n"


def saved(maker, tmp_path):
    return tmp_path / "a.glb" if maker.save(tmp_path / "a.glb") else None


def test_numbers_that_no_bytes_stand_for_are_refused(tmp_path):
    maker = Maker()
    maker.node(mesh=maker.mesh())
    maker.tree["accessors"].append({"componentType": 5126, "count": 60_000_000, "type": "VEC3"})
    with pytest.raises(MeshError, match="accessors: expected at most 50331648 numbers in all, got 180000018"):
        parse_mesh(saved(maker, tmp_path))


def test_many_parts_that_share_their_numbers_are_refused(tmp_path):
    maker = Maker()
    maker.node(mesh=maker.mesh(np.tile(SQUARE, (5000, 1))))
    maker.tree["meshes"][0]["primitives"] *= 1000
    with pytest.raises(MeshError, match="accessors: expected at most 50331648 numbers in all, got 60006000"):
        parse_mesh(saved(maker, tmp_path))


def chain(links):
    """Squares, each below the one before it, moved, turned and scaled."""
    maker = Maker()
    mesh = maker.mesh()
    for k in range(links):
        below = {"children": [k + 1]} if k + 1 < links else {}
        move = {"translation": [1, 0.5, 0], "rotation": turn((0, 0, 1), 90), "scale": [0.5, 0.5, 0.5]}
        maker.node(mesh=mesh, **move, **below)
    return maker


def test_a_chain_of_nodes_places_each_in_the_frame_of_the_one_above(tmp_path):
    vertices = parse_mesh(saved(chain(3), tmp_path))[0].reshape(3, 4, 3)
    link = torch.tensor([[0, -0.5, 0, 1], [0.5, 0, 0, 0.5], [0, 0, 0.5, 0], [0, 0, 0, 1]], dtype=torch.float64)
    square = torch.cat([torch.tensor(SQUARE, dtype=torch.float64), torch.ones(4, 1, dtype=torch.float64)], 1)
    expected = {
        tuple((torch.linalg.matrix_power(link, k) @ square[2])[:3].round(decimals=6).tolist()) for k in (1, 2, 3)
    }
    assert {tuple(part[2].round(decimals=6).tolist()) for part in vertices} == expected


def test_a_long_chain_of_nodes_takes_no_time_and_a_longer_one_or_a_ring_is_refused(tmp_path):
    with within(30):
        assert len(parse_mesh(saved(chain(257), tmp_path))[1]) == 2 * 257
    for maker in (chain(258), chain(5000)):
        with within(30), pytest.raises(MeshError, match="nodes: expected at most 256 below each other, got more"):
            parse_mesh(saved(maker, tmp_path))
    ring = chain(4)
    ring.tree["nodes"][3]["children"] = [1]
    with pytest.raises(MeshError, match="nodes: expected at most one parent of each, got two of node 1"):
        parse_mesh(saved(ring, tmp_path))
    ring.tree["nodes"][0].pop("children")
    with pytest.raises(MeshError, match="nodes: expected at most 256 below each other, got more"):
        parse_mesh(saved(ring, tmp_path))


def png(side, bits, kind, rows):
    """The bytes of a square PNG of so many bits a channel; kind 0 is grey, 2 RGB; rows as they are stored."""

    def chunk(name, body):
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = struct.pack(">IIBBBBB", side, side, bits, kind, 0, 0, 0)
    parts = chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(rows, 9)), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def textured(side, count):
    maker = Maker()
    picture, uv = maker.view(png(side, 1, 0, (b"\0" + b"\xff" * -(-side // 8)) * side)), maker.table(np.zeros((4, 2)))
    maker.tree |= {
        "images": [{"bufferView": picture, "mimeType": "image/png"}] * count,
        "textures": [{"source": k} for k in range(count)],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} for k in range(count)],
    }
    for k in range(count):
        maker.node(mesh=maker.mesh(attributes={"TEXCOORD_0": uv}, material=k))
    maker.tree["scenes"] = [{"nodes": list(range(count))}]
    return maker


def test_textures_that_are_huge_in_all_are_refused(tmp_path):
    color = parse_mesh(saved(textured(500, 3), tmp_path))[2]
    assert torch.equal(color, torch.ones(6, 3, dtype=torch.float64))
    with pytest.raises(MeshError, match="textures: expected at most 83886080 texels in all, got 108000000"):
        parse_mesh(saved(textured(6000, 3), tmp_path))


def test_an_archive_that_unpacks_to_much_is_refused(tmp_path):
    place = tmp_path / "a.npz"
    np.savez_compressed(place, vertices=np.zeros((2, 12_000_000, 3), np.float32), faces=np.array([[0, 1, 2]]))
    with pytest.raises(MeshError, match="expected at most 268435456 bytes when unpacked, got 288"):
        load_sequence(str(place))
    np.savez_compressed(place, vertices=np.zeros((2, 9_000_000, 3), np.float16), faces=np.array([[0, 1, 2]]))
    with pytest.raises(MeshError, match="vertices: expected at most 50331648 numbers in all, got 54000000"):
        load_sequence(str(place))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_pipes_beside_a_file_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.mtl")
    (tmp_path / "a.obj").write_text("mtllib pipe.mtl\nusemtl a\n" + TRIANGLE)
    with within(30):
        assert len(load_mesh(str(tmp_path / "a.obj")).faces) == 1  # as without its material library
    maker = Maker()
    maker.node(mesh=maker.mesh())
    maker.save(tmp_path / "b.gltf", beside=True)
    (tmp_path / "b.bin").unlink()
    os.mkfifo(tmp_path / "b.bin")
    with within(30), pytest.raises(MeshError, match="expected a file, got something else"):
        load_mesh(str(tmp_path / "b.gltf"))


@pytest.mark.parametrize("face", ["f 0 1 2", "f 1/1 2/2 0/1", "  f 1 00 2", "f 1//1 2//1 0//1 3//1"])
def test_faces_of_obj_files_count_from_1(tmp_path, face):
    (tmp_path / "a.obj").write_text(TRIANGLE + face + "\nf 1 2 4\n")
    with pytest.raises(MeshError, match="faces: expected indices from 1, or below 0 for those from the end, got 0"):
        load_mesh(str(tmp_path / "a.obj"))
    (tmp_path / "a.obj").write_text(TRIANGLE + "# f 0 1 2\n" + "v 1 0 1\n" * 6 + "f 10 2 3\n")
    assert len(load_mesh(str(tmp_path / "a.obj")).faces) == 2


def test_names_and_reasons_cannot_steer_a_terminal(tmp_path):
    (tmp_path / "a.obj").write_text(TRIANGLE)
    (tmp_path / "\x1b[2Jclear\nfailed frame 1.ply").write_bytes(b"ply\n\x1b[2J")
    ((name, reason),) = survey_meshes(tmp_path).refused
    assert name == "\\x1b[2Jclear\\nfailed frame 1.ply"
    assert reason.isprintable()
    assert str(MeshError("\x1b[2J", "é \x07")) == "\\x1b[2J: é \\x07"
