import importlib.util
import os
import signal
import sys

import numpy as np
import pytest
import torch
from gltf_makers import SQUARE

from datagen import MeshError, generate, parse_spec
from datagen.animated import PlayedAction, load_animated
from datagen.motions import Path as Way
from datagen.motions import RigidMotion
from datagen.rosters import survey_meshes, survey_played
from datagen.usd_files import vet_usd

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pxr") is None, reason="usd-core is not installed (extra `usd`)"
)

HEAD = '#usda 1.0\n( timeCodesPerSecond = 24\n upAxis = "Y"\n )\n'
QUAD = "int[] faceVertexCounts = [4]\nint[] faceVertexIndices = [0, 1, 2, 3]\n"
POINTS = "point3f[] points = [(0,0,0), (1,0,0), (1,1,0), (0,1,0)]\n"
GREEN = 'color3f[] primvars:displayColor = [(0, 0.5, 0)] ( interpolation = "constant" )\n'


def mesh(body=QUAD + POINTS, name="m"):
    return f'def Mesh "{name}" {{\n{body}}}\n'


TURNING = (
    'def Xform "x" {\ndouble3 xformOp:translate = (2, 0, 0)\n'
    "float xformOp:rotateZ.timeSamples = { 0: 0, 24: 120 }\n"
    'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]\n' + mesh(QUAD + POINTS + GREEN) + "}\n"
)
GROWING = mesh(
    QUAD + "point3f[] points.timeSamples = { 0: [(0,0,0), (1,0,0), (1,1,0), (0,1,0)],"
    " 24: [(0,0,0), (2,0,0), (2,2,0), (0,2,0)], 36: [(0,0,0), (2,0,0), (2,2,5), (0,2,0)] }\n"
)


def write(folder, text, name="a.usda", head=HEAD):
    path = folder / name
    path.write_text(head + text)
    return str(path)


def at(path, *times):
    return load_animated(path).actions[0].pose.at(torch.tensor(times, dtype=torch.float64)).numpy()


def turned(points, degrees):
    a = np.radians(degrees)
    return np.asarray(points, float) @ np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]])


def test_a_rotation_between_samples_is_a_rotation(tmp_path):
    path = write(tmp_path, TURNING)
    for time, degrees in ((0, 0), (0.25, 30), (0.5, 60), (1, 120), (9, 120)):
        np.testing.assert_allclose(at(path, time)[0], np.add(turned(SQUARE, degrees), [2, 0, 0]), atol=1e-6)
    np.testing.assert_allclose(load_animated(path).color, [[0, 0.5, 0]] * 2)


def test_points_are_linear_between_their_samples(tmp_path):
    path = write(tmp_path, GROWING)
    np.testing.assert_allclose(at(path, 0.5)[0], np.multiply(SQUARE, 1.5), atol=1e-6)
    np.testing.assert_allclose(at(path, 1.25)[0][2], [2, 2, 2.5], atol=1e-6)
    still = RigidMotion(Way((0.0, 0.0, 0.0)))
    assert PlayedAction(load_animated(path).actions[0], 0.0, 1.0, still).kinks_s(0.1, 1.4) == [1.0]


def test_z_up_is_turned_to_y_up_and_polygons_become_fans(tmp_path):
    head = HEAD.replace('"Y"', '"Z"')
    path = write(tmp_path, mesh(), head=head)
    np.testing.assert_allclose(at(path, 0)[0], [(0, 0, 0), (1, 0, 0), (1, 0, -1), (0, 0, -1)], atol=1e-6)
    assert load_animated(path).faces.tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize(
    ("kind", "values", "expected"),
    [
        ("uniform", "(1,0,0), (0,0,1)", [(1, 0, 0), (0, 0, 1)]),
        ("vertex", "(1,0,0), (1,0,0), (1,0,0), (0,1,0)", [(1, 0, 0), (2 / 3, 1 / 3, 0)]),
        ("faceVarying", "(1,0,0), (1,0,0), (1,0,0), (0,0,1), (0,0,1), (0,0,1)", [(1, 0, 0), (0, 0, 1)]),
    ],
)
def test_display_colours_of_every_kind(tmp_path, kind, values, expected):
    two = "int[] faceVertexCounts = [3, 3]\nint[] faceVertexIndices = [0, 1, 2, 0, 2, 3]\n"
    colour = f'color3f[] primvars:displayColor = [{values}] ( interpolation = "{kind}" )\n'
    path = write(tmp_path, mesh(two + POINTS + colour))
    np.testing.assert_allclose(load_animated(path).color, expected, atol=1e-6)
    short = write(tmp_path, mesh(two + POINTS + colour.replace(values, "(1,0,0)")), "b.usda")
    with pytest.raises(MeshError, match=f"expected at least . {kind} values, got 1"):
        load_animated(short)


def test_references_inside_the_file_are_followed(tmp_path):
    proto = 'def Xform "proto" {\n' + mesh() + "}\n"
    copy = 'def Xform "copy" ( references = </proto> ) {\ndouble3 xformOp:translate = (2, 0, 0)\n'
    path = write(tmp_path, proto + copy + 'uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n')
    points = load_animated(path).actions[0].pose.at(torch.zeros(1, dtype=torch.float64))
    assert points.shape[-2] == 8
    assert survey_meshes(tmp_path).names == ("a.usda",)


def test_layers_under_the_folder_count_and_others_are_refused(tmp_path):
    (tmp_path / "in").mkdir()
    write(tmp_path / "in", 'def Xform "part" {\n' + mesh() + "}\n", "part.usda")
    write(tmp_path, 'def Xform "part" {\n' + mesh() + "}\n", "above.usda")
    reference = 'def "a" ( references = @{}@</part> ) {{}}\n'
    path = write(tmp_path / "in", reference.format("./part.usda"))
    before = survey_played(path).sha256
    assert load_animated(path).faces.shape == (2, 3)
    write(tmp_path / "in", 'def Xform "part" {\n' + mesh(QUAD + POINTS.replace("1", "3")) + "}\n", "part.usda")
    os.utime(path, ns=(1, 1))  # what a file is composed of counts with it when it is read again
    assert survey_played(path).sha256 != before
    assert float(at(path, 0).max()) == 3
    for name in ("../above.usda", str(tmp_path / "above.usda"), "http://localhost:9/a.usda", "a.usdz[b.usda]"):
        bad = write(tmp_path / "in", reference.format(name), "bad.usda")
        with pytest.raises(MeshError, match="under its own folder"):
            vet_usd(tmp_path / "in" / "bad.usda")
        with pytest.raises(MeshError, match="under its own folder"):
            load_animated(bad)


BAD = {
    "nothing": ("", "expected triangles, got none"),
    "noise": ("def Mesh {{{", "expected a readable"),
    "index": (mesh(QUAD.replace("3]", "9]") + POINTS), r"expected indices in \[0, 4\), got 9"),
    "sizes": (mesh(QUAD.replace("[4]", "[5]") + POINTS), "expected face sizes that sum to 4, got 5"),
    "negative": (mesh(QUAD.replace("[4]", "[-1, 5]") + POINTS), "expected face sizes"),
    "infinite": (mesh(QUAD + POINTS.replace("1,1,0", "inf,1,0")), "finite values of at most .*, got inf"),
    "far": (mesh(QUAD + POINTS.replace("1,1,0", "1e9,1,0")), "at most 1e"),
    "lengths": (GROWING.replace("24: [(0,0,0), ", "24: ["), r"expected as many at all times, got \[3, 4\]"),
    "faces": (
        mesh(QUAD.replace("Counts = [4]", "Counts.timeSamples = { 0: [4], 1: [3] }") + POINTS),
        "faces that stay",
    ),
}


@pytest.mark.parametrize("name", sorted(BAD))
def test_what_cannot_be_used_is_refused(tmp_path, name):
    text, reason = BAD[name]
    write(tmp_path, text, "bad.usda")
    write(tmp_path, TURNING, "good.usda")
    roster = survey_meshes(tmp_path)
    assert roster.names == ("good.usda",)
    ((refused, why),) = roster.refused
    assert refused == "bad.usda"
    with pytest.raises(MeshError, match=reason):
        raise MeshError(refused, why)


def test_a_reader_that_dies_is_a_refusal(tmp_path, monkeypatch):
    dying = tmp_path / "dying.sh"
    dying.write_text("#!/bin/sh\nkill -SEGV $$\n")
    dying.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(dying))
    write(tmp_path, TURNING)
    with pytest.raises(MeshError, match=f"a reader that ended with -{int(signal.SIGSEGV)}"):
        vet_usd(tmp_path / "a.usda")


def test_without_the_package_the_file_is_refused(tmp_path, monkeypatch):
    path = write(tmp_path, TURNING, "alone.usda")
    monkeypatch.setattr("datagen.usd_files.importlib.util.find_spec", lambda name: None)
    with pytest.raises(MeshError, match=r"expected the package usd-core \(pip install 'torchblur\[usd\]'\), got none"):
        load_animated(path)


def test_usd_files_are_a_source_of_meshes(tmp_path):
    assets = tmp_path / "assets"
    assets.mkdir()
    write(assets, TURNING)
    write(assets, GROWING, "b.usda")
    fields = {"width": 24, "height": 16, "rays_per_pixel": 1, "frames_per_clip": 2, "count": 4}
    spec = parse_spec(fields | {"source": "meshes", "assets": str(assets)})
    one, two = (generate(spec, tmp_path / f"out{n}", workers=n) for n in (1, 2))
    assert one.is_complete
    for file in sorted(one.folder.rglob("*.exr")):
        assert file.read_bytes() == (two.folder / file.relative_to(one.folder)).read_bytes()
