import dataclasses
import json

import numpy as np
import pytest
import torch
from test_datagen_dataset import pixels_of

from datagen import BlurDataset, SpecError, export_dataset, generate, parse_spec
from datagen.__main__ import main
from datagen.colour import MOSAICS, bytes_from_linear, gamma_bytes_from_linear
from datagen.sensor import BLUE_GAINS, RED_GAINS, Sensor, choose_sensor, picture_bytes, record_light

PLAIN = Sensor("srgb", 2.2, 0.0, 1.0, 0.0, 0.0, (2.0, 1.0, 1.6), "")
TINY = {"width": 9, "height": 7, "rays_per_pixel": 1, "frames_per_clip": 2, "seed": 4, "count": 4}
FULL = {"sensor": "gamma", "sensor_shoulder": 0.4, "sensor_gain": 1.5, "sensor_gain_stops": 1.0, "sensor_mosaic": True,
        "sensor_photons": 900.0, "sensor_read_noise": 0.01, "sensor_noise_stops": 1.0}  # fmt: skip


def changed(**fields):
    return dataclasses.replace(PLAIN, **fields)


def patch(value, size=(256, 256)):
    return torch.tensor(value, dtype=torch.float64).expand(*size, 3)


def test_a_camera_without_faults_gives_the_pictures_that_there_are_without_one(rng):
    light = torch.from_numpy(rng.uniform(-0.1, 1.6, (11, 13, 3)))
    assert torch.equal(picture_bytes(record_light(light, PLAIN, rng), PLAIN), bytes_from_linear(light))
    gamma = changed(response="gamma")
    assert torch.equal(picture_bytes(record_light(light, gamma, rng), gamma), gamma_bytes_from_linear(light))


@pytest.mark.parametrize("shoulder", [-2.0, -0.5, 0.0, 0.7, 5.0])
def test_the_curve_is_as_written_and_rises(shoulder):
    curve = changed(response="gamma", gamma=2.1, shoulder=shoulder)
    x = torch.linspace(0, 1, 4097, dtype=torch.float64)[:, None, None].expand(-1, 1, 3)
    found = picture_bytes(x, curve)[:, 0, 0].numpy().astype(int)
    at = np.linspace(0, 1, 4097)
    assert np.array_equal(found, np.rint(at ** (1 / (2.1 + shoulder * at)) * 255))
    assert (np.diff(found) >= 0).all()
    assert (found[0], found[-1]) == (0, 255)


def test_what_is_brighter_than_the_sensor_holds_is_clipped_after_the_mean_over_the_exposure(rng):
    lamp, share = 40.0, 0.1  # a lamp that passes a pixel in a tenth of the exposure leaves a white streak
    streak = record_light(patch([lamp * share] * 3, (2, 2)), PLAIN, rng)
    assert bool((streak == 1).all())
    darker = record_light(patch([lamp * share] * 3, (2, 2)), changed(gain=0.125), rng)
    assert torch.allclose(darker, torch.tensor(0.5, dtype=torch.float64))


@pytest.mark.parametrize(("photons", "read_noise"), [(400.0, 0.0), (0.0, 0.02), (1000.0, 0.01)])
def test_the_noise_has_the_mean_and_the_variance_of_its_laws(rng, photons, read_noise):
    levels = [0.5, 0.3, 0.4]
    found = record_light(patch(levels), changed(photons=photons, read_noise=read_noise), rng).numpy()
    for k, (level, balance) in enumerate(zip(levels, PLAIN.white_balance, strict=True)):
        shot = level / balance / photons if photons else 0.0
        variance = (shot + read_noise**2) * balance**2
        assert abs(found[..., k].mean() - level) < 5 * (variance / 256**2) ** 0.5
        assert found[..., k].var() == pytest.approx(variance, rel=0.03)
        flat = found[..., k] - level
        assert abs((flat[:, 1:] * flat[:, :-1]).mean()) < 5 * variance / 256  # neighbours know nothing of each other


def test_clipped_pixels_have_no_noise(rng):
    for pattern in ("", "RGGB"):
        sensor = changed(photons=50.0, read_noise=0.05, mosaic=pattern)
        assert bool((record_light(patch([3.0] * 3, (32, 32)), sensor, rng) == 1).all())


@pytest.mark.parametrize("pattern", MOSAICS)
@pytest.mark.parametrize("size", [(12, 14), (7, 9), (1, 1), (2, 3)])
def test_a_mosaic_keeps_the_colour_that_a_pixel_sees_and_flat_colours_everywhere(rng, pattern, size):
    light = torch.from_numpy(rng.uniform(0.1, 0.9, (*size, 3)))
    found = record_light(light, changed(mosaic=pattern), rng)
    assert found.shape == light.shape
    for y in range(size[0]):
        for x in range(size[1]):
            seen = "RGB".index(pattern[2 * (y % 2) + x % 2])
            assert float(found[y, x, seen]) == pytest.approx(float(light[y, x, seen]), abs=1e-7)
    flat = patch([0.2, 0.5, 0.7], size)
    assert torch.allclose(record_light(flat, changed(mosaic=pattern), rng), flat, atol=1e-7)


def test_a_mosaic_takes_the_mean_of_the_nearest_pixels_of_a_colour(rng):
    light = torch.from_numpy(rng.uniform(0.1, 0.9, (8, 8, 3)))
    found = record_light(light, changed(mosaic="RGGB"), rng).numpy()
    red, green, blue = light.numpy().transpose(2, 0, 1)
    assert found[4, 4, 1] == pytest.approx((green[3, 4] + green[5, 4] + green[4, 3] + green[4, 5]) / 4, abs=1e-6)
    assert found[4, 4, 2] == pytest.approx(blue[3:6:2, 3:6:2].mean(), abs=1e-6)
    assert found[4, 5, 0] == pytest.approx((red[4, 4] + red[4, 6]) / 2, abs=1e-6)


def test_a_clip_has_one_camera_from_the_ranges_and_another_clip_another():
    spec = parse_spec(FULL | {"seed": 3})
    cameras = [choose_sensor(spec, clip) for clip in range(200)]
    assert cameras[7] == choose_sensor(spec, 7)
    assert len({c.gain for c in cameras}) == 200
    assert {c.mosaic for c in cameras} == set(MOSAICS)
    for camera in cameras:
        assert 0.75 <= camera.gain <= 3.0
        noise = camera.read_noise / 0.01
        assert 0.5 <= noise <= 2.0
        assert camera.photons == pytest.approx(900 / noise)
        assert RED_GAINS[0] <= camera.white_balance[0] <= RED_GAINS[1]
        assert BLUE_GAINS[0] <= camera.white_balance[2] <= BLUE_GAINS[1]


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    out = tmp_path_factory.mktemp("taken")
    generate(parse_spec(TINY), out / "plain")
    generate(parse_spec(TINY | FULL), out / "camera")
    return out


def test_the_linear_images_stay_and_the_camera_is_told_of(taken):
    plain, camera = BlurDataset(taken / "plain"), BlurDataset(taken / "camera")
    for k in range(4):
        for key in ("sharp", "blurred", "motion", "depth"):
            assert torch.equal(plain[k][key].nan_to_num(), camera[k][key].nan_to_num())
    metas = [camera.metadata(k) for k in range(4)]
    assert "sensor" not in plain.metadata(0)
    assert metas[0]["sensor"] == metas[1]["sensor"] != metas[2]["sensor"]
    told = {**metas[2]["sensor"]}
    assert told.pop("sharp_noise") is False
    chosen = choose_sensor(parse_spec(TINY | FULL), 1)
    assert told == json.loads(json.dumps(dataclasses.asdict(chosen)))


def test_both_pictures_go_through_the_camera_and_only_the_blurred_has_noise(taken, tmp_path):
    spec, dataset = parse_spec(TINY | FULL), BlurDataset(taken / "camera")
    generate(parse_spec(TINY | FULL | {"sensor_sharp_noise": True}), tmp_path / "noisy")
    for k in range(4):
        sensor = choose_sensor(spec, k // 2)
        quiet = dataclasses.replace(sensor, photons=0.0, read_noise=0.0)
        clean = {}
        for kind, key in (("sharp", "sharp"), ("blur", "blurred")):
            light = record_light(dataset[k][key].permute(1, 2, 0), quiet, np.random.default_rng(0))
            clean[kind] = picture_bytes(light, quiet).numpy().astype(int)
        found = {kind: pixels_of(taken / f"camera/{kind}/{k:08d}.png").astype(int) for kind in clean}
        assert np.abs(found["sharp"] - clean["sharp"]).max() <= 1  # half floats
        assert np.abs(found["blur"] - clean["blur"]).max() > 1
        blurs = [(folder / f"blur/{k:08d}.png").read_bytes() for folder in (taken / "camera", tmp_path / "noisy")]
        assert blurs[0] == blurs[1]
        assert np.abs(pixels_of(tmp_path / f"noisy/sharp/{k:08d}.png") - clean["sharp"]).max() > 1


def test_the_noise_is_the_same_however_the_frames_are_made(taken, tmp_path):
    fields = TINY | FULL | {"storage": "shards", "frames_per_shard": 1}
    generate(parse_spec(fields), tmp_path / "two", workers=2)
    for k in range(4):
        mine = (tmp_path / f"two/shards/{k:06d}.tar").read_bytes()
        assert (taken / f"camera/blur/{k:08d}.png").read_bytes() in mine
    names = [taken / f"camera/blur/{k:08d}.png" for k in range(4)]
    assert len({name.read_bytes() for name in names}) == 4


def test_an_export_holds_what_the_camera_took(taken, tmp_path):
    export_dataset(taken / "camera", tmp_path / "gopro", "gopro")
    for kind, stored in (("sharp", "sharp"), ("blur", "blur"), ("blur_gamma", "blur")):
        mine = (tmp_path / f"gopro/train/clip000001/{kind}/000000.png").read_bytes()
        assert mine == (taken / f"camera/{stored}/00000002.png").read_bytes()
    told = json.loads((tmp_path / "gopro/export.json").read_text())["conventions"]
    assert told["pictures"] == "as the camera of the data set's metadata took them"


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"sensor_gain": 2.0, "sensor_mosaic": True}, "sensor: expected srgb or gamma for sensor_gain, sensor_mosaic"),
        ({"sensor": "srgb", "sensor_shoulder": 0.5}, "sensor: expected gamma for sensor_shoulder, got 'srgb'"),
        ({"sensor": "gamma", "sensor_shoulder": -3.0}, "sensor_shoulder: expected sensor_gamma"),
        ({"sensor": "gamma", "sensor_photons": -1.0}, "sensor_photons: expected"),
    ],
)
def test_fields_that_nobody_would_read_or_that_are_wrong_are_refused(fields, named):
    with pytest.raises(SpecError) as caught:
        parse_spec(fields)
    assert any(problem.startswith(named) for problem in caught.value.problems)


def test_the_command_line_has_the_camera(tmp_path):
    words = ["--count", "1", "--width", "8", "--height", "6", "--rays-per-pixel", "1"]
    words += ["--sensor", "srgb", "--sensor-mosaic", "True", "--sensor-photons", "500"]
    assert main(["--out", str(tmp_path / "data"), *words]) == 0
    assert BlurDataset(tmp_path / "data").metadata(0)["sensor"]["photons"] == 500.0
