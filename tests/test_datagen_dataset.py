import json
import multiprocessing
import pickle

import numpy as np
import pytest
import torch
from PIL import Image
from torch.utils.data import DataLoader

from datagen import BlurDataset, generate, parse_spec
from datagen.report import motion_colours


def pixels_of(path):
    with Image.open(path) as image:
        assert (image.format, image.mode) == ("PNG", "RGB")
        return np.asarray(image)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("set") / "data"
    spec = parse_spec({"width": 14, "height": 10, "count": 5, "rays_per_pixel": 1, "frames_per_clip": 2, "seed": 1})
    result = generate(spec, out)
    assert (result.made, result.kept, result.is_complete) == (5, 0, True)
    return out


CHANNELS = {
    "sharp": 3, "blurred": 3, "motion": 2, "motion_next": 2, "motion_previous": 2, "depth": 1, "alpha": 1,
    "sharp_alpha": 1, "mesh_id": 1, "face_id": 1,
}  # fmt: skip


def test_items_are_tensors_of_channels_first(folder):
    dataset = BlurDataset(folder)
    assert len(dataset) == 5
    item = dataset[3]
    for key, channels in CHANNELS.items():
        assert item[key].shape == (channels, 10, 14)
        assert item[key].dtype == (torch.int64 if key.endswith("_id") else torch.float32)
    assert item["index"] == 3
    meta = json.loads(item["meta"])
    assert (meta["clip"], meta["frame"]) == (1, 1)
    assert dataset.metadata(3) == meta
    assert dataset.coverage(3).shape == (len(meta["meshes"]), 10, 14)
    assert int(item["mesh_id"].min()) >= -1
    assert bool((torch.isinf(item["depth"]) == (item["mesh_id"] < 0)).all())
    assert set(BlurDataset(folder, keys=["motion"])[0]) == {"motion", "index", "meta"}
    assert [int(d["index"]) for d in (dataset[i] for i in range(5))] == list(range(5))


def test_pictures_are_the_images_on_the_srgb_curve(folder):
    item = BlurDataset(folder)[0]
    for key, name in (("sharp", "sharp"), ("blurred", "blur")):
        picture = pixels_of(folder / name / "00000000.png")
        linear = item[key].permute(1, 2, 0).double().clamp(0, 1)
        curve = torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055) * 255
        assert np.abs(picture - curve.numpy()).max() < 1.0  # half a step of 8 bits, and half floats' 11 bits


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_a_data_loader_with_two_workers(folder, context):
    if context not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {context} on this system")
    loader = DataLoader(BlurDataset(folder), batch_size=2, num_workers=2, multiprocessing_context=context)
    batches = list(loader)
    assert [len(b["meta"]) for b in batches] == [2, 2, 1]
    assert batches[0]["blurred"].shape == (2, 3, 10, 14)
    assert torch.cat([b["index"] for b in batches]).tolist() == [0, 1, 2, 3, 4]
    assert torch.equal(batches[1]["motion"][1], BlurDataset(folder)[3]["motion"])


def test_it_can_be_pickled_and_opens_nothing_before_it_is_asked(folder):
    dataset = BlurDataset(folder)
    copy = pickle.loads(pickle.dumps(dataset))  # noqa: S301  our own object, as a DataLoader sends it
    assert torch.equal(copy[1]["sharp"], dataset[1]["sharp"])
    assert len(pickle.dumps(dataset)) < 4000


def test_what_is_missing_or_damaged_is_named(folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="folder: expected a data set"):
        BlurDataset(tmp_path)
    with pytest.raises(ValueError, match="keys: expected some of"):
        BlurDataset(folder, keys=["flow"])
    (tmp_path / "manifest.jsonl").write_bytes(b"")
    with pytest.raises(ValueError, match="at least one finished frame"):
        BlurDataset(tmp_path)
    with pytest.raises(IndexError):
        BlurDataset(folder)[5]


def test_the_contact_sheet_shows_every_frame(folder):
    sheet = pixels_of(folder / "contact_sheet.png")
    assert sheet.shape[1] >= 5 * 14
    assert sheet.shape[0] >= 5 * 10
    assert sheet.std() > 10


def test_motion_colours_tell_directions_apart_and_mark_rest_and_the_unknown():
    motion = torch.tensor([[[5.0, 0.0], [-5.0, 0.0], [0.0, 5.0], [0.0, 0.0], [float("nan"), 0.0]]])
    colours = [tuple(c) for c in motion_colours(motion)[0].tolist()]
    assert len(set(colours)) == 5
    assert colours[3] == (255, 255, 255)
    assert colours[4] == (0, 0, 0)
