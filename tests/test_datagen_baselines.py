"""Filters' images in data sets: written beside the exact one, declared, read back, and refused when unknown."""

import json

import numpy as np
import pytest
import torch

import torchblur as tb
from datagen import BlurDataset, SpecError, generate, parse_spec, verify_dataset
from datagen.__main__ import main
from datagen.baselines.filters import FILTERS, apply_filter, filter_instant
from datagen.baselines.views import Paths, View
from datagen.manifest import MANIFEST_NAME, read_manifest
from datagen.spec import BASELINES
from datagen.writer import read_exr

TINY = {"width": 36, "height": 24, "count": 2, "rays_per_pixel": 1, "seed": 3, "exposure": 1.0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("set") / "data"
    assert main(["--out", str(out), *words("--baselines", "guertin2015,mcguire2012")]) == 0
    return out


def words(*more):
    pairs = [(f"--{name.replace('_', '-')}", str(value)) for name, value in TINY.items()]
    return [word for pair in pairs for word in pair] + list(more)


def test_names_are_those_of_the_filters():
    assert tuple(FILTERS) == BASELINES
    assert parse_spec({"baselines": "guertin2015,directional"}).baseline_names == ("directional", "guertin2015")
    assert parse_spec({}).baseline_names == ()


def test_a_filters_image_is_stored_declared_and_read_back(folder):
    assert verify_dataset(folder) == []
    assert [e["baselines"] for e in read_manifest(folder).values()] == [["mcguire2012", "guertin2015"]] * 2
    assert json.loads((folder / "run.json").read_text())["spec"]["baselines"] == "guertin2015,mcguire2012"
    dataset = BlurDataset(folder)
    item = dataset[1]
    for name in ("mcguire2012", "guertin2015"):
        image = item[f"baseline_{name}"]
        assert image.shape == item["blurred"].shape
        assert float((image - item["sharp"]).abs().max()) > 0
    assert "baseline_directional" not in item
    assert set(BlurDataset(folder, keys=["baseline_mcguire2012"])[0]) == {"baseline_mcguire2012", "index", "meta"}
    meta = dataset.metadata(1)
    assert meta["baselines"]["mcguire2012"]["samples"] == 15
    assert meta["baselines"]["guertin2015"] == {"curve": "bezier", "weighting": "published", "unknown_motion_pixels": 0}
    assert "baseline" in meta["units"]


def test_what_is_stored_is_the_filter_of_what_is_stored(folder):
    """Of half floats, hence only near to it: the filter of the sharp image that the file holds."""
    item = BlurDataset(folder)[0]
    view = View(item["sharp"][None], item["motion"][None], item["depth"][None])
    still = Paths(torch.zeros(1, 3, 2, 24, 36), item["depth"].expand(1, 3, -1, -1))
    again = apply_filter("mcguire2012", view, still)[0]
    torch.testing.assert_close(again, item["baseline_mcguire2012"], rtol=0, atol=2e-3)


def test_the_other_images_are_the_same_without_filters(folder, tmp_path):
    generate(parse_spec(TINY), tmp_path / "plain")
    for part in ("sharp", "blurred", "data"):
        mine, plain = (read_exr(f / "frames" / "00000001.exr")[0][part] for f in (folder, tmp_path / "plain"))
        assert all(np.array_equal(mine[c], plain[c], equal_nan=True) for c in plain)
    entry = read_manifest(tmp_path / "plain")[1]
    assert "baselines" not in entry
    assert BlurDataset(tmp_path / "plain").metadata(0)["baselines"] == {}
    with pytest.raises(ValueError, match="keys: expected some of"):
        BlurDataset(tmp_path / "plain", keys=["baseline_mcguire2012"])
    with pytest.raises(SpecError, match="baselines: expected ''"):
        generate(parse_spec(TINY | {"baselines": "directional"}), tmp_path / "plain")


def test_a_line_without_its_baselines_is_made_again(folder, tmp_path):
    spec = parse_spec(TINY | {"baselines": "directional"})
    generate(spec, tmp_path / "set")
    place = tmp_path / "set" / MANIFEST_NAME
    whole = place.read_bytes()
    entries = [json.loads(line) for line in whole.splitlines()]
    del entries[0]["baselines"]
    entries[1]["baselines"] = [3]
    place.write_text("".join(json.dumps(e) + "\n" for e in entries))
    result = generate(spec, tmp_path / "set")
    assert (result.made, result.kept) == (2, 0)
    assert place.read_bytes() == whole


def test_an_unknown_filter_is_refused_by_name(tmp_path, capsys):
    assert main(["--out", str(tmp_path / "data"), *words("--baselines", "mcguire2012,blur2030")]) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: baselines: expected different ones of directional, mcguire2012, ")
    assert told.rstrip().endswith("got 'mcguire2012,blur2030'")
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("name", BASELINES)
def test_each_filter_blurs_a_scene_and_leaves_a_still_one(name):
    corner = torch.tensor([[-0.8, -0.5, 0.0], [0.8, -0.5, 0.0], [0.0, 0.9, 0.0]], dtype=torch.float64)
    way = torch.tensor([0.6, 0.1, 0.0], dtype=torch.float64)
    camera = tb.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y_deg=50, width=24, height=20, near=0.1, far=10)
    for vertices, moves in ((torch.stack([corner - way / 2, corner + way / 2]), True), (corner, False)):
        scene = tb.Scene([tb.Mesh(vertices, torch.tensor([[0, 1, 2]]))], camera, (0.1, 0.2, 0.3))
        now = tb.render_instant(scene)
        images, notes = filter_instant(scene, now, (name,))
        assert list(images) == list(notes) == [name]
        assert images[name].shape == (20, 24, 3)
        sharp, exact = now.rgba[..., :3], tb.render(scene).rgba[..., :3]
        torch.testing.assert_close(images[name].isfinite().all(), torch.tensor(True))
        if moves:
            assert float((images[name] - sharp).abs().max()) > 0.1
        else:
            torch.testing.assert_close(images[name], sharp, rtol=0, atol=1e-12)
            torch.testing.assert_close(images[name], exact, rtol=0, atol=1e-12)


def test_only_filters_of_curves_refuse_orthographic_cameras():
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    camera = tb.Camera.orthographic((0, 0, 3), (0, 0, 0), height_world=4, width=48, height=48, near=0.1, far=9)
    scene = tb.Scene([tb.Mesh(torch.stack([corners, corners + 1.0]), [[0, 1, 2]])], camera)
    now = tb.render_instant(scene)
    for name in ("directional", "mcguire2012", "guertin2014"):
        image = filter_instant(scene, now, (name,))[0][name]
        assert float((image - now.rgba[..., :3]).abs().max()) > 0.05, name
    with pytest.raises(ValueError, match="scene: expected a perspective camera"):
        filter_instant(scene, now, ("directional", "guertin2015"))
