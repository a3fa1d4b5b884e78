import json

import numpy as np
import pytest
import torch
from gltf_makers import SQUARE, Maker, bender, morpher, spinner, turn

from datagen import MeshError, generate, parse_spec
from datagen.animated import MAX_KINKS, PlayedAction, is_animated, load_animated
from datagen.clips import Actor, Clip, expose
from datagen.motions import CameraPath, Path, RigidMotion
from datagen.rosters import survey_meshes, survey_played
from datagen.samples import make_sample
from datagen.scenes import Plan, survey_assets

STILL = RigidMotion(Path((0.0, 0.0, 0.0)))


def pose_of(maker, tmp_path, name="a.gltf", take=0):
    """The positions (N, V, 3) of a file at times, in the file's own coordinates, as a function of a list of times."""
    action = load_animated(maker.save(tmp_path / name)).actions[take]
    return lambda times: action.pose.at(torch.tensor(times, dtype=torch.float64)).numpy()


def turned(points, degrees):
    a = np.radians(degrees)
    return np.asarray(points, float) @ np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]])


@pytest.mark.parametrize(("name", "beside"), [("a.gltf", False), ("a.gltf", True), ("a.glb", False)])
def test_a_turning_node_turns_evenly_about_its_own_place(tmp_path, name, beside):
    maker = spinner(degrees=120)
    action = load_animated(maker.save(tmp_path / name, beside)).actions[0]
    found = action.pose.at(torch.tensor([0, 0.25, 0.5, 1, 7], dtype=torch.float64)).numpy()
    for positions, degrees in zip(found, (0, 30, 60, 120, 120), strict=True):
        np.testing.assert_allclose(positions, np.add(turned(SQUARE, degrees), [2, 0, 0]), atol=1e-6)  # keys are float32


def test_the_shorter_way_round_is_taken(tmp_path):
    maker = Maker()
    node = maker.node(mesh=maker.mesh())
    far = [-c for c in turn((0, 0, 1), 40)]  # the same turn, written as its opposite quaternion
    maker.animation((node, "rotation", [0, 1], [turn((0, 0, 1), 0), far], "LINEAR"))
    np.testing.assert_allclose(pose_of(maker, tmp_path)([0.5])[0], turned(SQUARE, 20), atol=1e-6)


def test_a_step_holds_until_the_next_key(tmp_path):
    pose = pose_of(spinner("STEP", 90), tmp_path)
    np.testing.assert_allclose(pose([0.999])[0], np.add(SQUARE, [2, 0, 0]), atol=1e-6)
    np.testing.assert_allclose(pose([1])[0], np.add(turned(SQUARE, 90), [2, 0, 0]), atol=1e-6)


def test_a_cubic_spline_is_hermites(tmp_path):
    maker = Maker()
    node = maker.node(mesh=maker.mesh())
    p0, m0, p1, m1 = np.array([0.0, 0, 0]), np.array([3.0, 1, 0]), np.array([1.0, 2, 0]), np.array([0.0, -4, 2])
    rows = [np.full(3, 99.0), p0, m0, m1, p1, np.full(3, 99.0)]  # the outermost tangents are not used
    maker.animation((node, "translation", [1, 3], rows, "CUBICSPLINE"))
    pose = pose_of(maker, tmp_path)
    for time in (1.0, 1.3, 2.0, 2.9, 3.0):
        s, span = (time - 1) / 2, 2
        value = (2 * s**3 - 3 * s**2 + 1) * p0 + (s**3 - 2 * s**2 + s) * span * m0
        value = value + (3 * s**2 - 2 * s**3) * p1 + (s**3 - s**2) * span * m1
        np.testing.assert_allclose(pose([time])[0], SQUARE + value, atol=1e-5)


def test_a_cubic_spline_of_turns_is_brought_back_to_length_1(tmp_path):
    maker = Maker()
    node = maker.node(mesh=maker.mesh())
    a, b, rest = turn((0, 0, 1), 0), turn((0, 0, 1), 90), [0, 0, 0, 0]
    maker.animation((node, "rotation", [0, 1], [rest, a, rest, rest, b, rest], "CUBICSPLINE"))
    found = pose_of(maker, tmp_path)([0.5])[0]
    np.testing.assert_allclose(found, turned(SQUARE, 45), atol=1e-6)  # by symmetry, and no longer than at the ends


def test_two_bones_bend_a_strip_as_by_hand(tmp_path):
    pose = pose_of(bender(), tmp_path)
    for time in (0.0, 0.5, 1.0):
        degrees = 90 * time
        expected = []
        for x in (0.0, 0.5, 1.0, 1.5, 2.0):
            for y in (-0.1, 0.1):
                share = min(max(x - 0.5, 0), 1)
                moved = np.add(turned([x - 1, y, 0], degrees), [1, 0, 0])  # about the second bone's own place
                expected.append((1 - share) * np.array([x, y, 0]) + share * moved)
        np.testing.assert_allclose(pose([time])[0], expected, atol=1e-6)


def test_morph_targets_are_added_by_weight(tmp_path):
    pose = pose_of(morpher(), tmp_path)
    up, aside = np.array([0, 0, 1]), np.array([(0, 0, 0), (2, 0, 0), (0, 0, 0), (0, 0, 0)])
    for time, first, second in ((0, 0, 0), (0.5, 0.5, 0), (1, 1, 0), (1.5, 0.75, 0.5), (2, 0.5, 1)):
        np.testing.assert_allclose(pose([time])[0], SQUARE + first * up + second * aside, atol=1e-6)


def test_a_morph_under_a_skin_comes_first(tmp_path):
    maker = bender()
    bump = np.tile([0, 0, 0.5], (10, 1))
    maker.tree["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": maker.table(bump)}]
    maker.tree["meshes"][0]["weights"] = [1.0]
    plain, both = pose_of(bender(), tmp_path, "b.gltf"), pose_of(maker, tmp_path)
    np.testing.assert_allclose(both([0.7])[0], plain([0.7])[0] + [0, 0, 0.5], atol=1e-6)


def test_children_follow_their_parents_scaled_and_by_matrix(tmp_path):
    maker = Maker()
    maker.node(children=[1], scale=[2, 1, 1])
    maker.node(matrix=[0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 3, 0, 0, 1], children=[2])  # a quarter turn, by columns
    maker.node(mesh=maker.mesh())
    maker.animation((0, "translation", [0, 2], [(0, 0, 0), (0, 0, 4)], "LINEAR"))
    found = pose_of(maker, tmp_path)([1])[0]
    expected = np.add(np.add(turned(SQUARE, 90), [3, 0, 0]) * [2, 1, 1], [0, 0, 2])
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_sparse_strided_normalised_and_absent_tables(tmp_path):
    maker = Maker()
    node = maker.node(mesh=maker.mesh())
    rows = np.zeros((4, 4), "<f4")
    rows[:, :3] = SQUARE
    view = maker.view(rows.tobytes())
    maker.tree["bufferViews"][view]["byteStride"] = 16
    maker.tree["accessors"][0] = {"bufferView": view, "componentType": 5126, "count": 4, "type": "VEC3"}
    places, values = maker.view(np.array([2], "<u2").tobytes()), maker.view(np.array([5, 6, 7], "<f4").tobytes())
    maker.tree["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": places, "componentType": 5123},
        "values": {"bufferView": values},
    }
    quarter = np.round(np.array([turn((0, 0, 1), 0), turn((0, 0, 1), 90)]) * 32767)
    output = maker.table(quarter, "<i2", normalized=True)
    maker.animation((node, "rotation", [0, 1], np.zeros((2, 4)), "LINEAR"))
    maker.tree["animations"][0]["samplers"][0]["output"] = output
    corners = np.array(SQUARE, float)
    corners[2] = 5, 6, 7
    np.testing.assert_allclose(pose_of(maker, tmp_path)([1])[0], turned(corners, 90), atol=1e-3)
    maker.tree["accessors"][0] = {"componentType": 5126, "count": 4, "type": "VEC3"}  # without a view: zeros
    with pytest.raises(MeshError, match="some extent"):
        load_animated(maker.save(tmp_path / "b.gltf"))


def test_strips_and_fans(tmp_path):
    for mode, expected in ((5, [(0, 1, 2), (1, 3, 2)]), (6, [(0, 1, 2), (0, 2, 3)])):
        maker = Maker()
        maker.node(mesh=maker.mesh(faces=[0, 1, 2, 3], mode=mode))
        assert load_animated(maker.save(tmp_path / f"{mode}.gltf")).faces.tolist() == [list(f) for f in expected]


def test_colours_of_material_vertices_and_texture(tmp_path):
    from PIL import Image

    Image.fromarray(np.array([[[255, 0, 0], [0, 128, 0]]], np.uint8)).save(tmp_path / "two.png")
    maker = Maker()
    uv = maker.table([(0.1, 0), (0.6, 0), (0.9, 1), (0.7, 1)])  # the faces' centres lie in the second texel
    node = maker.node(mesh=maker.mesh(attributes={"TEXCOORD_0": uv}, material=0))
    maker.animation((node, "translation", [0, 1], [(0, 0, 0), (1, 0, 0)], "LINEAR"))
    factor = [1, 0.5, 1, 0.25]
    maker.tree["materials"] = [
        {"pbrMetallicRoughness": {"baseColorFactor": factor, "baseColorTexture": {"index": 0}}, "alphaMode": "BLEND"}
    ]
    maker.tree |= {"textures": [{"source": 0}], "images": [{"uri": "two.png"}]}
    asset = load_animated(maker.save(tmp_path / "a.gltf"))
    green = 0.5 * ((128 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(asset.color.numpy(), [[0, green, 0]] * 2, atol=1e-6)
    np.testing.assert_allclose(asset.opacity.numpy(), [0.25, 0.25])
    before = asset.sha256
    Image.fromarray(np.array([[[255, 0, 0], [0, 0, 99]]], np.uint8)).save(tmp_path / "two.png")
    maker.tree["asset"]["generator"] = "again"  # a file that has not changed is not read again
    assert load_animated(maker.save(tmp_path / "b.gltf")).sha256 != before


def played(maker, path, start_s=0.0):
    return PlayedAction(load_animated(maker.save(path)).actions[0], start_s, 1.0, STILL)


def test_what_ends_as_it_starts_goes_round_and_the_rest_back_and_forth(tmp_path):
    there = played(spinner(), tmp_path / "there.gltf")
    times = torch.tensor([0.3, 1.7, 2.3, -0.3], dtype=torch.float64)
    for k in range(1, 4):
        torch.testing.assert_close(there.at(times)[k], there.at(times)[0])
    maker = Maker()
    node = maker.node(mesh=maker.mesh())
    keys = [turn((0, 0, 1), a) for a in (0, 120, 240, 360)]
    maker.animation((node, "rotation", [0, 1, 2, 3], keys, "LINEAR"))
    round_ = played(maker, tmp_path / "round.gltf")
    assert round_.action.is_round
    at = round_.at(torch.tensor([0.3, 3.3, 6.3], dtype=torch.float64))
    torch.testing.assert_close(at[1], at[0])
    torch.testing.assert_close(at[2], at[0])
    assert round_.kinks_s(0.5, 3.5) == [1, 2, 3]
    assert there.kinks_s(0.5, 3.5) == [1, 2, 3]  # the turns
    assert len(there.kinks_s(0.0, 1e6)) <= MAX_KINKS


def test_knots_follow_a_turn_and_not_its_chord(tmp_path):
    player = played(spinner(degrees=170), tmp_path / "a.gltf")
    camera = CameraPath(Path((0.0, 0.0, 5.0)), Path((0.0, 0.0, 0.0)), 40.0, 0.1, 100.0)
    actor = Actor("a", load_animated(str(tmp_path / "a.gltf")).faces, torch.ones(3), player)
    made = expose(Clip((actor,), camera, torch.zeros(3)), 256, 256, 0.0, 1.0)
    knots = made.mesh_knots[0]
    assert knots.segments >= 16
    assert knots.error_px <= 0.1
    assert not knots.limit_reached
    vertices = made.scene.meshes[0].vertices.double()  # the scene's knots lie on the exact motion
    times = torch.linspace(0, 1, knots.segments + 1, dtype=torch.float64)
    torch.testing.assert_close(vertices, player.at(times), atol=1e-6, rtol=0)


def test_a_step_within_an_exposure_is_told_as_beyond_the_limit(tmp_path):
    player = played(spinner("STEP", 90), tmp_path / "a.gltf", start_s=0.5)
    camera = CameraPath(Path((0.0, 0.0, 5.0)), Path((0.0, 0.0, 0.0)), 40.0, 0.1, 100.0)
    actor = Actor("a", load_animated(str(tmp_path / "a.gltf")).faces, torch.ones(3), player)
    knots = expose(Clip((actor,), camera, torch.zeros(3)), 64, 64, 0.0, 1.0).mesh_knots[0]
    assert knots.limit_reached
    assert knots.segments == 64


def data_spec(tmp_path, **fields):
    base = {"width": 32, "height": 24, "rays_per_pixel": 1, "frames_per_clip": 2, "count": 4, "assets": str(tmp_path)}
    return parse_spec(base | {"source": "meshes"} | fields)


def test_a_folder_with_animated_files_is_a_source_of_meshes(tmp_path):
    assets = tmp_path / "assets"
    assets.mkdir()
    bender().save(assets / "bend.glb")
    spinner().save(assets / "spin.gltf", beside=True)
    frames = np.stack([np.array(SQUARE, float) * k for k in (1.0, 1.5, 2.0)])
    np.savez(assets / "grow.npz", vertices=frames, faces=np.array([[0, 1, 2], [0, 2, 3]]))
    spec = data_spec(assets, seed=4)
    roster = survey_assets(spec)
    assert roster.names == ("bend.glb", "grow.npz", "spin.gltf")
    plan = Plan(spec, roster.names, roster.sha256).to_json()
    told = make_sample(plan, 0).meta["scene"]["animations"] | make_sample(plan, 2).meta["scene"]["animations"]
    assert {name.rsplit("-", 1)[0] for name in told} == set(roster.names)
    for name, take in told.items():
        assert take["name"] == ("frames" if "npz" in name else "take")
        assert take["length_s"] == (2 / 24 if "npz" in name else 1)
        assert 0 <= take["start_s"] <= 2 * take["length_s"]
        assert take["played"] == "back and forth"
    assert make_sample(plan, 0).meta["meshes"][-1]["segments"] >= 1
    one, two = (generate(spec, tmp_path / f"out{n}", workers=n) for n in (1, 2))
    assert one.is_complete
    for file in sorted(one.folder.rglob("*.exr")):
        assert file.read_bytes() == (two.folder / file.relative_to(one.folder)).read_bytes()


def test_an_animated_file_is_a_sequence_at_its_own_rate(tmp_path):
    path = bender().save(tmp_path / "bend.gltf")
    spec = data_spec(path, source="sequence", count=1, fps=2.0)
    plan = Plan(spec, survey_assets(spec).names, survey_assets(spec).sha256).to_json()
    sample = make_sample(plan, 0)
    assert sample.meta["scene"]["animations"]["bend.gltf"]["length_s"] == 1
    assert sample.meta["meshes"][-1]["segments"] >= 2  # 22 degrees in a quarter of a second, no chord


def test_the_hash_covers_the_buffer_beside_a_file(tmp_path):
    path = spinner(degrees=120).save(tmp_path / "a.gltf", beside=True)
    first = survey_played(path).sha256
    (tmp_path / "b").mkdir()
    other = spinner(degrees=121).save(tmp_path / "b" / "a.gltf", beside=True)
    assert (tmp_path / "a.gltf").read_text() == (tmp_path / "b" / "a.gltf").read_text()
    assert survey_played(other).sha256 != first


def broken(change):
    """A bender whose tree has been changed."""
    maker = bender()
    change(maker.tree)
    return maker


def put(*keys, to):
    """A change of one place in a tree."""

    def change(tree):
        for key in keys[:-1]:
            tree = tree[key]
        tree[keys[-1]] = to

    return change


SAMPLER = ("animations", 0, "samplers", 0)
PRIMITIVE = ("meshes", 0, "primitives", 0)
BAD = {
    "circle": (put("nodes", 2, "children", to=[1]), "expected a tree, got a circle among 2 nodes"),
    "parents": (put("nodes", 0, "children", to=[2]), "expected one parent, got 0 and 1"),
    "child": (put("nodes", 1, "children", to=[9]), r"children: expected an integer in \[0, 2\], got 9"),
    "joint": (put("skins", 0, "joints", to=[1, 7]), r"joints: expected an integer in \[0, 2\], got 7"),
    "joints": (put("skins", 0, "joints", to=[1]), r"JOINTS_0: expected indices in \[0, 1\), got 1"),
    "no joints": (put("skins", 0, "joints", to=[]), "expected 1 to 4096, got 0"),
    "skin": (put("nodes", 0, "skin", to=[0]), "skin: expected an integer"),
    "count": (put("accessors", 0, "count", to=10**12), r"count: expected an integer in \[0, 24000000\]"),
    "many": (put("accessors", 0, "count", to=23_000_000), "accessors: expected at most 24000000 numbers"),
    "short": (put("accessors", 0, "count", to=99), "expected 396 bytes in its view, got 40"),
    "float": (put("accessors", 0, "count", to=1.5), "count: expected an integer"),
    "true": (put("accessors", 0, "count", to=True), "count: expected an integer"),
    "type": (put("accessors", 2, "type", to=["VEC3"]), "type: expected VEC3, got"),
    "component": (put("accessors", 2, "componentType", to=[]), "componentType: expected one of 5120"),
    "stride": (put("bufferViews", 2, "byteStride", to=4), "expected a stride of at least 12 bytes, got 4"),
    "view": (put("bufferViews", 2, "byteOffset", to=10**9), "byteOffset: expected an integer in"),
    "buffer": (put("bufferViews", 2, "buffer", to=1), "index into buffers: expected an integer"),
    "kind": (put(*SAMPLER, "interpolation", to="CUBIC"), "interpolation: expected one of LINEAR, STEP, CUBICSPLINE"),
    "spline": (put(*SAMPLER, "interpolation", to="CUBICSPLINE"), "expected 6 rows for 2 keys, got 2"),
    "sampler": (put("animations", 0, "channels", 0, "sampler", to=3), "sampler: expected an integer"),
    "target": (put("animations", 0, "channels", 0, "target", to="x"), "target: expected an object"),
    "weights": (put("animations", 0, "channels", 0, "target", "path", to="weights"), "a mesh with morph targets"),
    "matrix": (put("nodes", 2, "matrix", to=np.eye(4).ravel().tolist()), "expected a node without a matrix"),
    "nan": (put("nodes", 2, "translation", to=[float("nan"), 0, 0]), "translation: expected numbers of at most"),
    "list": (put("nodes", 2, "translation", to=[1, 2]), "translation: expected 3 numbers"),
    "turn": (put("nodes", 2, "rotation", to=[0, 0, 0, 0]), "rotation: expected quaternions with a direction"),
    "nodes": (put("nodes", to=[{}] * 5000), "nodes: expected 1 to 4096, got 5000"),
    "indices": (put(*PRIMITIVE, "indices", to=2), "expected SCALAR, got VEC3"),
    "targets": (put(*PRIMITIVE, "targets", to=[{}] * 10**6), "accessors: expected at most 24000000 numbers"),
    "mesh": (put("nodes", 0, "mesh", to="0"), "index into meshes: expected an integer"),
    "points": (put(*PRIMITIVE, "mode", to=0), "expected triangles, got none"),
}


@pytest.mark.parametrize("name", sorted(BAD))
def test_what_is_not_as_the_format_has_it_is_refused(tmp_path, name):
    change, reason = BAD[name]
    with pytest.raises(MeshError, match=reason):
        load_animated(broken(change).save(tmp_path / "bad.gltf"))


def test_times_that_do_not_grow_and_values_that_are_not_finite_are_refused(tmp_path):
    for times, values, reason in (
        ([1, 0], [(0, 0, 0)] * 2, "input: expected times that grow"),
        ([0, 0], [(0, 0, 0)] * 2, "input: expected times that grow"),
        ([0, np.inf], [(0, 0, 0)] * 2, "finite values"),
        ([0, 1], [(0, 0, 0), (np.nan, 0, 0)], "finite values"),
        ([0, 1], [(0, 0, 0), (1e9, 0, 0)], "at most 1e"),
        ([0, 1, 2], [(0, 0, 0)] * 2, "expected 3 rows for 3 keys, got 2"),
    ):
        maker = Maker()
        maker.animation((maker.node(mesh=maker.mesh()), "translation", times, values, "LINEAR"))
        with pytest.raises(MeshError, match=reason):
            load_animated(maker.save(tmp_path / "a.gltf"))


def test_scales_that_multiply_beyond_bounds_are_refused(tmp_path):
    maker = Maker()
    for k in range(5):
        maker.node(children=[k + 1], scale=[1e6, 1e6, 1e6])
    maker.node(mesh=maker.mesh())
    maker.tree["skins"] = [{"joints": [0]}]
    with pytest.raises(MeshError, match="at most 1e"):
        load_animated(maker.save(tmp_path / "a.gltf"))


def test_files_whose_animations_would_take_minutes_are_refused(tmp_path):
    maker = bender()
    maker.tree["nodes"] += [{}] * 4000
    maker.tree["animations"] = maker.tree["animations"] * 200
    with pytest.raises(MeshError, match="in bounds, got 4003 nodes, 10 vertices and 200 animations"):
        load_animated(maker.save(tmp_path / "a.gltf"))


def test_nothing_outside_the_folder_is_read(tmp_path):
    (tmp_path / "above.bin").write_bytes(b"\0" * 4096)
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "link.bin").symlink_to(tmp_path / "above.bin")
    for uri in ("../above.bin", "%2e%2e/above.bin", str(tmp_path / "above.bin"), "link.bin"):
        maker = spinner()
        text = json.dumps(maker.tree | {"buffers": [{"byteLength": len(maker.data), "uri": uri}]})
        (tmp_path / "in" / "a.gltf").write_text(text)
        with pytest.raises(MeshError, match="expected a file under its own folder"):
            load_animated(str(tmp_path / "in" / "a.gltf"))


def test_a_broken_animated_file_is_listed_and_the_others_go_on(tmp_path):
    broken(BAD["circle"][0]).save(tmp_path / "bad.gltf")
    spinner().save(tmp_path / "good.glb")
    roster = survey_meshes(tmp_path)
    assert roster.names == ("good.glb",)
    assert [name for name, _ in roster.refused] == ["bad.gltf"]


def test_a_skin_without_an_animation_stands_in_its_pose(tmp_path):
    maker = bender()
    del maker.tree["animations"]
    maker.tree["nodes"][2]["rotation"] = turn((0, 0, 1), 90)
    path = maker.save(tmp_path / "a.gltf")
    assert is_animated(path)
    still = load_animated(path).actions[0]
    assert PlayedAction(still, 0.0, 1.0, STILL).is_static
    np.testing.assert_allclose(still.pose.at(torch.zeros(1))[0, -1], [0.9, 1, 0], atol=1e-6)
