import base64
import io
import json
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from gltf_makers import Maker

import datagen.assets
from datagen.assets import MeshError, load_mesh
from datagen.rosters import survey_meshes
from datagen.sequences import load_sequence, survey_sequence

TETRAHEDRON = "v 1 1 1\nv 1 -1 -1\nv -1 1 -1\nv -1 -1 1\n"
FACES = "f 1 2 3\nf 1 4 2\nf 1 3 4\nf 2 4 3\n"
GOOD = TETRAHEDRON + FACES


DATA_URI = "data:application/octet-stream;base64,"
REMOTE = [{"byteLength": 44, "uri": "http://localhost:9/x.bin"}]


def gltf(extra=None, indices=(0, 1, 2), positions=((0, 0, 0), (1, 0, 0), (0, 1, 0))):
    buffer = struct.pack(f"<{len(indices)}H", *indices) + b"\0" * (len(indices) * 2 % 4)
    start = len(buffer)
    buffer += struct.pack("<9f", *[c for p in positions for c in p])
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 1}, "indices": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5123, "count": len(indices), "type": "SCALAR"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": len(indices) * 2},
            {"buffer": 0, "byteOffset": start, "byteLength": 36},
        ],
        "buffers": [
            {
                "byteLength": len(buffer),
                "uri": "data:application/octet-stream;base64," + base64.b64encode(buffer).decode(),
            }
        ],
    }
    return json.dumps(tree | (extra or {}))


def ply(faces="3 0 1 2\n", n_faces=1):
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element face {n_faces}\nproperty list uchar int vertex_indices\nend_header\n"
    return head + "0 0 0\n1 0 0\n0 1 0\n" + faces


STL = b"made by hand".ljust(80) + struct.pack("<I", 2)
STL += struct.pack("<12fH", *[0, 0, 0, 0, 0, 0, 3, 0, 0, 0, 3, 0], 0) * 2
TEXT_STL = "solid x\n" + "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
TEXT_STL += "endsolid x\n"


BAD = {
    "empty.obj": ("", "expected 1 to"),
    "points.obj": (TETRAHEDRON, "triangles, got none"),
    "words.obj": ("this is no mesh\n", "triangles, got none"),
    "nan.obj": (GOOD.replace("v 1 1 1", "v nan 1 1"), "finite values, got nan"),
    "inf.obj": (GOOD.replace("v 1 1 1", "v inf 1 1"), "finite values, got inf"),
    "far.obj": (GOOD.replace("v 1 1 1", "v 1e9 1 1"), "at most 1e+06"),
    "dot.obj": ("v 2 2 2\nv 2 2 2\nv 2 2 2\nf 1 2 3\n", "some extent"),
    "index.obj": (TETRAHEDRON + "f 1 2 9\n", "expected"),
    "index.ply": (ply("3 0 1 7\n"), "expected"),
    "negative.ply": (ply("3 0 1 -2\n"), "expected"),
    "short.ply": (ply(n_faces=5), "expected"),
    "words.ply": ("ply\nnonsense", "expected a readable .ply"),
    "line.obj": ("v 0 0 0\nv 1 2 3\nv 2 4 6\nf 1 2 3\nf 1 1 2\n", "faces: expected a triangle with an area, got none"),
    "corner.obj": (GOOD[:-3], "at least 3 whole corners in the last face, got 'f 2 4'"),
    "corners.obj": (GOOD.replace("f 2 4 3\n", "f 2 \\\n4"), "at least 3 whole corners in the last face, got 'f 2 4'"),
    "letter.obj": (GOOD[:-6] + " # end\n\n", "at least 3 whole corners in the last face, got 'f'"),
    "slash.obj": (TETRAHEDRON + "f 1/1/1 2/1/1 3/1/1\nf 1/1/1 4/1/1 2/1/", "at least 3 whole corners"),
    "short.stl": (STL[:-30], "expected 184 bytes for the 2 triangles its header announces, got 154"),
    "long.stl": (STL + b"\xe9", "expected 184 bytes for the 2 triangles its header announces, got 185"),
    "solid.stl": (b"solid" + STL[5:-1], "expected 184 bytes for the 2 triangles its header announces, got 183"),
    "stub.stl": (STL[:50], "expected at least the 84 bytes of a header, got 50"),
    "nan.stl": (STL.replace(struct.pack("<f", 3), struct.pack("<f", float("nan"))), "finite values, got nan"),
    "text.stl": (TEXT_STL[:-20], "expected endsolid after the last facet, got a file cut short"),
    "huge.stl": (b"\0" * 80 + struct.pack("<I", 4_000_000_000), "for the 4000000000 triangles its header announces"),
    "none.off": ("OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n", "triangles, got none"),
    "huge.off": ("OFF\n99999999999 1 0\n0 0 0\n", "expected a readable .off"),
    "words.glb": (b"glTF not really", "expected"),
    "list.gltf": ("[]", "expected a glTF object"),
    "index.gltf": (gltf(indices=(0, 1, 9)), "indices in [0, 3), got 9"),
    "nan.gltf": (gltf(positions=((float("nan"), 0, 0), (1, 0, 0), (0, 1, 0))), "finite"),
    "draco.gltf": (gltf({"extensionsRequired": ["KHR_draco_mesh_compression"]}), "KHR_draco_mesh_compression"),
    "outside.gltf": (gltf({"buffers": [{"byteLength": 44, "uri": "../secret.bin"}]}), "expected a readable .gltf"),
    "remote.gltf": (gltf({"buffers": REMOTE}), "in files beside it, got 'http://localhost:9/x.bin'"),
    "picture.gltf": (gltf({"images": [{"uri": "HTTPS://localhost:9/x.png"}]}), "got 'HTTPS://localhost:9/x.png'"),
    "odd.gltf": (gltf({"images": 5, "extensionsUsed": 5, "buffers": 5}), "expected a readable .gltf"),
    "pack.zip": (b"PK\3\4", "expected one of .obj"),
    "scene.fbx": (b"x", "expected one of .obj"),
}  # fmt: skip


def put(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("name", sorted(BAD))
def test_a_bad_file_is_refused_by_name_and_the_others_are_kept(tmp_path, name):
    content, reason = BAD[name]
    put(tmp_path, name, content)
    put(tmp_path, "good.obj", GOOD)
    (tmp_path.parent / "secret.bin").write_bytes(b"\0" * 44)
    roster = survey_meshes(tmp_path)
    assert roster.names == ("good.obj",)
    assert [n for n, _ in roster.refused] == [name]
    assert reason in roster.refused[0][1]


def test_companion_files_are_passed_over_and_folders_searched(tmp_path):
    (tmp_path / "deep").mkdir()
    put(tmp_path / "deep", "b.obj", GOOD)
    put(tmp_path, "a.ply", ply())
    for name in ("readme.txt", "wood.png", "b.mtl", "x.bin"):
        put(tmp_path, name, "x")
    roster = survey_meshes(tmp_path)
    assert roster.names == ("a.ply", "deep/b.obj")
    assert roster.refused == ()


def test_a_folder_without_a_usable_file_is_an_error_that_names_them(tmp_path):
    with pytest.raises(MeshError, match="no mesh file at all"):
        survey_meshes(tmp_path)
    put(tmp_path, "empty.obj", "")
    with pytest.raises(MeshError, match=r"empty\.obj: expected 1 to"):
        survey_meshes(tmp_path)


def test_the_hash_is_of_what_was_read(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    for folder in (one, two):
        folder.mkdir()
        put(folder, "a.obj", GOOD)
    assert survey_meshes(one).sha256 == survey_meshes(two).sha256
    put(two, "b.obj", GOOD)
    assert survey_meshes(one).sha256 != survey_meshes(two).sha256


def test_vertices_keep_their_order_and_doubles_and_are_normalised(tmp_path):
    text = "v 5 0 0\nv 9 0 0\nv 5 2 0\nv 5 0 0\nv 7 2 4\nf 1 2 3\nf 4 3 5\nf 1 1 2\n"
    asset = load_mesh(str(put(tmp_path, "a.obj", text)))
    assert asset.faces.tolist() == [[0, 1, 2], [3, 2, 4], [0, 0, 1]]  # doubles and a degenerate face are kept
    assert float(asset.vertices.norm(dim=-1).max()) == pytest.approx(1)
    scale = 4 / float(asset.vertices[1, 0] - asset.vertices[0, 0])
    back = asset.vertices * scale + torch.tensor([7.0, 1.0, 2.0])
    expected = torch.tensor([[5.0, 0, 0], [9, 0, 0], [5, 2, 0], [5, 0, 0], [7, 2, 4]], dtype=torch.float64)
    torch.testing.assert_close(back, expected)
    assert asset.color is None


def test_colours_of_vertices_become_linear_face_colours(tmp_path):
    text = "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nf 1 2 3\n"
    asset = load_mesh(str(put(tmp_path, "red.obj", text)))
    torch.testing.assert_close(asset.color, torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64))
    half = text.replace("1 0 0\nf", "1 0 0\nf").replace(" 1 0 0\n", " 0.5 0.5 0.5\n")
    grey = load_mesh(str(put(tmp_path, "grey.obj", half)))
    assert 0.2 < float(grey.color[0, 1]) < 0.23  # sRGB 0.5 is 0.214 in linear light


def test_a_part_without_a_colour_is_grey_and_opaque_beside_one_that_has_one(tmp_path):
    maker = Maker()
    maker.tree["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}}]
    for mesh in (maker.mesh(material=0), maker.mesh()):
        maker.node(mesh=mesh)
    maker.tree["scenes"] = [{"nodes": [0, 1]}]
    asset = load_mesh(maker.save(tmp_path / "two.gltf"))
    torch.testing.assert_close(asset.color[:2], torch.tensor([[1.0, 0, 0]] * 2, dtype=torch.float64))
    assert 0.4 < float(asset.color[2:].min()) <= float(asset.color[2:].max()) < 0.5
    assert asset.opacity is None


def test_an_animation_that_is_not_read_is_said(tmp_path):
    asset = load_mesh(str(put(tmp_path, "walk.gltf", gltf({"animations": [{"channels": [], "samplers": []}]}))))
    assert "animations in the file are not read" in asset.notes[0]


def save_npz(path, **arrays):
    np.savez(path, **arrays)
    return str(path)


def test_sequences_from_npz(tmp_path):
    vertices = np.random.default_rng(0).normal(size=(4, 5, 3)).astype(np.float32)
    faces = np.array([[0, 1, 2], [2, 3, 4]], np.int32)
    path = save_npz(tmp_path / "a.npz", vertices=vertices, faces=faces)
    asset = load_sequence(path)
    assert asset.positions.shape == (4, 5, 3)
    assert float(asset.positions.norm(dim=-1).max()) == pytest.approx(1)
    assert asset.faces.tolist() == faces.tolist()
    ratio = (asset.positions[3] - asset.positions[1]) / torch.from_numpy(vertices[3] - vertices[1])
    torch.testing.assert_close(ratio, ratio[:1, :1].expand_as(ratio), rtol=1e-4, atol=1e-6)
    assert len(survey_sequence(path).sha256) == 64


@pytest.mark.parametrize(
    ("arrays", "reason"),
    [
        ({"faces": np.zeros((1, 3), int)}, "vertices: expected an array"),
        ({"vertices": np.zeros((2, 3, 3))}, "faces: expected an array"),
        ({"vertices": np.zeros((3, 3)), "faces": np.zeros((1, 3), int)}, r"\(frames, V, 3\) float, got \(3, 3\)"),
        ({"vertices": np.zeros((2, 3, 3), int), "faces": np.zeros((1, 3), int)}, "float"),
        ({"vertices": np.ones((2, 3, 3)), "faces": np.zeros((1, 3))}, "integers"),
        ({"vertices": np.ones((2, 3, 3)), "faces": np.full((1, 3), 3)}, r"indices in \[0, 3\), got 3"),
        ({"vertices": np.full((2, 3, 3), np.nan), "faces": np.zeros((1, 3), int)}, "finite"),
        ({"vertices": np.zeros((0, 3, 3)), "faces": np.zeros((1, 3), int)}, "at least one frame"),
        ({"vertices": np.ones((2, 3, 3)), "faces": np.zeros((1, 3), int)}, "some extent"),
        ({"vertices": np.array([{}], dtype=object), "faces": np.zeros((1, 3), int)}, "without pickles"),
    ],
)
def test_bad_sequences_are_refused(tmp_path, arrays, reason):
    with pytest.raises(MeshError, match=reason):
        load_sequence(save_npz(tmp_path / "a.npz", **arrays))


def test_broken_archives_are_refused(tmp_path):
    path = save_npz(tmp_path / "a.npz", vertices=np.ones((9, 9, 3)), faces=np.zeros((1, 3), int))
    data = Path(path).read_bytes()
    for name, content in {"cut.npz": data[: len(data) // 2], "noise.npz": b"noise" * 9, "none.npz": b""}.items():
        with pytest.raises(MeshError, match=name):
            load_sequence(str(put(tmp_path, name, content)))


def test_a_folder_of_frames_is_a_sequence_in_the_order_of_its_numbers(tmp_path):
    for k in (10, 2, 1):
        put(tmp_path, f"frame{k}.obj", GOOD.replace("v 1 1 1", f"v 1 1 {k}"))
    asset = load_sequence(str(tmp_path))
    z = asset.positions[:, 0, 2]
    assert len(z) == 3
    assert z[0] < z[1] < z[2]
    put(tmp_path, "frame3.obj", TETRAHEDRON + "f 1 2 3\n")
    with pytest.raises(MeshError, match=r"frame3\.obj: expected the vertices and faces of"):
        load_sequence(str(tmp_path))


def test_one_mesh_file_as_a_sequence_says_that_it_stands_still(tmp_path):
    asset = load_sequence(str(put(tmp_path, "a.obj", GOOD)))
    assert len(asset.positions) == 1
    assert any("stands still" in note for note in asset.notes)


def test_nothing_is_fetched_from_a_network_by_a_mesh(tmp_path):
    path = put(tmp_path, "remote.gltf", gltf({"buffers": REMOTE}))
    code = (
        "import socket, sys\n"
        "def never(*a, **k): print('NETWORK'); sys.exit(3)\n"
        "socket.socket.connect = never\n"
        "from datagen.assets import MeshError, load_mesh\n"
        "try: load_mesh(sys.argv[1])\n"
        "except MeshError: sys.exit(0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "")


def test_what_one_byte_more_would_make_whole_is_read(tmp_path):
    """The twins of the refused files, so that no check refuses what is sound."""
    twins = {"a.stl": STL, "b.stl": TEXT_STL, "c.stl": b"solid" + STL[5:], "d.obj": GOOD.rstrip()}
    twins["e.obj"] = TETRAHEDRON + "f 1/1/1 2/1/1 3/1/1\nf 1//1 4//1 \\\n2//1\n# cut here\n"
    twins["f.obj"] = GOOD + "v 7 7 7\nl 1 2\n"
    twins["g.obj"] = "v 0 0 0\nv 1 2 3\nv 2 4 6\nv 0 1 0\nf 1 2 3\nf 1 2 4\n"  # one triangle of two has an area
    for name, content in twins.items():
        put(tmp_path, name, content)
    assert survey_meshes(tmp_path).refused == ()


def test_text_that_is_not_utf8_is_read_as_latin1(tmp_path):
    colours = "# Möbel\nnewmtl Grün\nKd 0 1 0\n"
    whole = "# größer\nmtllib Stühle.mtl\nusemtl Grün\n" + GOOD
    for name in ("utf-8", "latin-1"):
        folder = tmp_path / name
        folder.mkdir()
        put(folder, "Stühle.mtl", colours.encode(name))
        asset = load_mesh(str(put(folder, "a.obj", whole.encode(name))))
        assert asset.faces.shape == (4, 3)
        torch.testing.assert_close(asset.color, torch.tensor([[0.0, 1, 0]], dtype=torch.float64).expand(4, 3))
        put(folder, "b.ply", ply().replace("ascii 1.0", "ascii 1.0\ncomment größer").encode(name))
        put(folder, "c.stl", TEXT_STL.replace("solid x", "solid größer").encode(name))
        put(folder, "d.off", "OFF\n# größer\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n".encode(name))
        assert survey_meshes(folder).refused == ()
    assert survey_meshes(tmp_path / "utf-8").sha256 == survey_meshes(tmp_path / "latin-1").sha256


def test_a_sequence_needs_a_triangle_with_an_area_in_one_frame(tmp_path):
    flat = np.zeros((3, 3, 3))
    flat[:, 1, 0], flat[:, 2, 0] = 1, 2
    faces = np.array([[0, 1, 2]])
    with pytest.raises(MeshError, match="faces: expected a triangle with an area, got none"):
        load_sequence(save_npz(tmp_path / "flat.npz", vertices=flat, faces=faces))
    flat[2, 2, 1] = 1  # it opens in the last frame
    assert len(load_sequence(save_npz(tmp_path / "opens.npz", vertices=flat, faces=faces)).positions) == 3
    (tmp_path / "frames").mkdir()
    for k, frame in enumerate(flat):
        text = "".join(f"v {x} {y} {z}\n" for x, y, z in frame) + "f 1 2 3\n"
        put(tmp_path / "frames", f"{k}.obj", text)
    assert len(load_sequence(str(tmp_path / "frames")).positions) == 3


def test_the_parser_is_given_bytes_and_no_way_to_a_network(tmp_path, monkeypatch):
    real, calls = datagen.assets.trimesh.load_scene, []

    def watched(*args, **kwargs):
        calls.append((args, kwargs))
        return real(*args, **kwargs)

    monkeypatch.setattr(datagen.assets.trimesh, "load_scene", watched)
    contents = {"a.obj": GOOD, "b.ply": ply(), "c.stl": STL, "d.gltf": gltf()}
    for name, content in contents.items():
        load_mesh(str(put(tmp_path, name, content)))
    assert len(calls) == len(contents)
    (tmp_path / "deep").mkdir()
    put(tmp_path / "deep", "x.bin", "inside")
    put(tmp_path.parent, "above.bin", "outside")
    for args, kwargs in calls:
        assert len(args) == 1
        assert isinstance(args[0], io.BytesIO)  # a text could be taken for an address
        assert set(kwargs) == {"file_type", "resolver", "process", "allow_remote"}
        assert kwargs["allow_remote"] is False
        assert kwargs["process"] is False
        files = kwargs["resolver"]
        assert isinstance(files, datagen.assets.trimesh.resolvers.FilePathResolver)
        assert files.get("deep/x.bin") == b"inside"
        for name in ("../above.bin", str(tmp_path.parent / "above.bin"), "http://localhost:9/y.bin"):
            with pytest.raises((OSError, ValueError)):
                files.get(name)
