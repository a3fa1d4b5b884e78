import hashlib
import io
import json
import os
import random
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

import datagen.pictures
from datagen import BlurDataset, MeshError, SpecError, generate, parse_spec, verify_dataset
from datagen.__main__ import main
from datagen.colour import linear_from_srgb
from datagen.photos import TEXTURE_PX, load_background, load_texture, read_photo, survey_photos
from datagen.scenes import Plan, build_clip, survey_plan
from datagen.shapes import box
from datagen.wraps import box_uv

TINY = {"width": 12, "height": 8, "rays_per_pixel": 1, "seed": 3, "count": 3}


def save(path, pixels, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(pixels, dtype=np.uint8)).save(path, **options)
    return path


def noise(height, width, channels=3, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def linear(pixels):
    return linear_from_srgb(torch.tensor(np.asarray(pixels) / 255.0).reshape(-1, 3)).reshape(*np.shape(pixels))


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """A folder of four pictures that can be used, in several formats."""
    folder = tmp_path_factory.mktemp("pictures")
    for k, name in enumerate(("a.png", "b.bmp", "deep/c.webp", "d.JPG")):
        save(folder / name, noise(20 + k, 30, seed=k))
    (folder / "notes.txt").write_text("not a picture")
    return folder


def sums(folder):
    names = (p for p in sorted(folder.rglob("*")) if p.suffix in (".exr", ".png", ".jsonl"))
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in names}


def test_pixels_are_those_of_the_file_the_right_way_up(tmp_path):
    pixels = noise(4, 6)
    assert np.array_equal(read_photo(save(tmp_path / "a.png", pixels)), pixels)
    assert np.array_equal(read_photo(save(tmp_path / "opaque.png", np.dstack([pixels, np.full((4, 6), 255)]))), pixels)
    grey = read_photo(save(tmp_path / "grey.png", pixels[..., 0]))
    assert np.array_equal(grey, np.repeat(pixels[..., :1], 3, 2))
    exif = Image.Exif()
    exif[0x0112] = 6  # turned by a quarter
    turned = read_photo(save(tmp_path / "turned.png", pixels, exif=exif))
    assert np.array_equal(turned, np.rot90(pixels, -1))


def bad_files(folder):
    """Each file that cannot be used, and a part of the reason."""
    pixels = noise(40, 40)
    whole = {}
    for suffix in (".png", ".jpg", ".bmp", ".webp"):
        whole[suffix] = save(folder / f"whole{suffix}", pixels).read_bytes()
        (folder / f"whole{suffix}").unlink()
    found = {}
    for suffix, data in whole.items():
        (folder / f"cut{suffix}").write_bytes(data[: len(data) // 2])
        found[f"cut{suffix}"] = "expected a readable"
    (folder / "empty.png").write_bytes(b"")
    (folder / "text.png").write_text("hello")
    save(folder / "clear.png", np.dstack([pixels, np.full((40, 40), 90)]))
    Image.fromarray(noise(4, 4)[..., 0].astype(np.uint16) * 200).save(folder / "deep.png")
    save(folder / "photo.tif", pixels)
    Image.fromarray(pixels).quantize(8).save(folder / "hole.png", transparency=3)
    return found | {
        "empty.png": "expected 1 to",
        "text.png": "got none of them",
        "clear.png": "expected an opaque picture, got an opacity of 90 of 255",
        "deep.png": "expected 8 bits a channel",
        "photo.tif": "got a .tif file",
        "hole.png": "expected an opaque picture, got an opacity of 0",
    }


def test_bad_pictures_are_refused_by_name_and_the_others_used(tmp_path, pictures, capsys):
    folder = tmp_path / "mixed"
    folder.mkdir()
    wanted = bad_files(folder)
    with pytest.raises(MeshError, match="expected at least one usable picture file, got"):
        survey_photos(folder)
    for field in ("textures", "backgrounds"):  # before anything is written
        assert main(["--out", str(tmp_path / "none"), f"--{field}", str(folder)]) == 2
        assert not (tmp_path / "none").exists()
    save(folder / "good.png", noise(9, 9))
    roster = survey_photos(folder)
    assert roster.names == ("good.png",)
    assert {name for name, _ in roster.refused} == set(wanted)
    for name, reason in roster.refused:
        assert wanted[name] in reason, name
    capsys.readouterr()
    words = [word for k, v in TINY.items() for word in (f"--{k.replace('_', '-')}", str(v))]
    assert main([*words, "--out", str(tmp_path / "data"), "--backgrounds", str(folder)]) == 1
    told = capsys.readouterr().err
    assert all(f"refused backgrounds/{name}: " in told for name in wanted)
    assert len(BlurDataset(tmp_path / "data")) == 3


def test_a_name_that_is_no_text_is_refused_and_told_as_text(tmp_path):
    save(tmp_path / "good.png", noise(4, 4))
    try:
        shutil.copy(tmp_path / "good.png", tmp_path / os.fsdecode(b"bad\xff.png"))
    except OSError:
        pytest.skip("NOT TESTED: this file system takes only names that are text")
    roster = survey_photos(tmp_path)
    assert roster.names == ("good.png",)
    assert roster.refused == (("bad\\xff.png", "expected a file name in UTF-8"),)


def test_too_many_pixels_are_refused_before_they_are_unpacked(tmp_path, monkeypatch):
    path = save(tmp_path / "a.png", noise(30, 30))
    monkeypatch.setattr(datagen.pictures, "MAX_PHOTO_PIXELS", 899)
    with pytest.raises(MeshError, match="expected at most 899 pixels, got 30 x 30"):
        read_photo(path)


def outcome_of(path):
    try:
        return f"pixels {read_photo(path).shape}"
    except MeshError as error:
        return error.reason


def test_mutated_files_are_read_or_refused_and_nothing_else(tmp_path):
    rng, seen = random.Random(5), set()
    for suffix in (".png", ".jpg", ".bmp", ".webp"):
        data = save(tmp_path / f"whole{suffix}", noise(16, 16)).read_bytes()
        for _ in range(60):
            changed = bytearray(data)
            for _ in range(rng.randint(1, 6)):
                changed[rng.randrange(len(data))] = rng.randrange(256)
            path = tmp_path / f"changed{suffix}"
            path.write_bytes(changed[: rng.choice((len(data), rng.randrange(1, len(data))))])
            outcome = outcome_of(path)
            assert outcome.startswith(("pixels", "expected ")), outcome
            seen.add(outcome.split()[0])
    assert seen == {"pixels", "expected"}


def test_a_background_is_a_part_of_the_picture_that_fills_the_image(tmp_path):
    pixels = noise(20, 30)
    path = str(save(tmp_path / "a.png", pixels))
    light = linear(pixels).float()
    same = load_background(path, (30, 20), (0.3, 0.8), False)
    torch.testing.assert_close(same, light, atol=1e-6, rtol=0)
    left, right = (load_background(path, (20, 20), (x, 0.5), False) for x in (0.0, 1.0))
    torch.testing.assert_close(left, light[:, :20], atol=1e-6, rtol=0)
    torch.testing.assert_close(right, light[:, 10:], atol=1e-6, rtol=0)
    torch.testing.assert_close(load_background(path, (20, 20), (0.0, 0.5), True), left.flip(1), atol=0, rtol=0)
    flat = str(save(tmp_path / "flat.png", np.full((10, 10, 3), 188)))
    for size in ((40, 30), (3, 5)):  # light is averaged, not its code
        image = load_background(flat, size, (0.5, 0.5), False)
        assert image.shape == (size[1], size[0], 3)
        torch.testing.assert_close(image, linear(np.full((size[1], size[0], 3), 188)).float(), atol=1e-6, rtol=0)
    dots = np.zeros((32, 32, 3))
    dots[::2] = 255
    half = load_background(str(save(tmp_path / "dots.png", dots)), (4, 4), (0.5, 0.5), False)
    assert float(half.mean()) == pytest.approx(0.5, abs=0.02)


def test_long_textures_are_made_smaller_and_short_ones_kept(tmp_path):
    pixels = noise(5, 7)
    texture = load_texture(str(save(tmp_path / "a.png", pixels)))
    torch.testing.assert_close(texture, linear(pixels).float(), atol=1e-6, rtol=0)
    path = save(tmp_path / "b.png", np.full((8, 2 * TEXTURE_PX, 3), 100))
    assert load_texture(str(path)).shape == (4, TEXTURE_PX, 3)
    save(path, np.full((8, 8, 3), 200))  # a file that has changed is read again
    assert load_texture(str(path)).shape == (8, 8, 3)


def test_texels_are_square_and_upright_on_every_side_of_a_box():
    shape = box(2, (1.0, 2.0, 3.0))
    uv, corners, normals = box_uv(shape), shape.vertices[shape.faces], shape.normals()
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=1).norm(dim=1)
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    torch.testing.assert_close((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).abs(), area)
    upright = normals[:, 1].abs() < 0.5
    torch.testing.assert_close(uv[upright][..., 1], corners[upright][..., 1])


@pytest.mark.parametrize("lighting", ["painted", "lamps"])
def test_pictures_are_worn_and_shown_and_told_of(pictures, lighting):
    spec = parse_spec(TINY | {"lighting": lighting, "textures": str(pictures), "backgrounds": str(pictures)})
    here, refused = survey_plan(spec)
    assert refused == ()
    names = {"a.png", "b.bmp", "d.JPG", "deep/c.webp"}
    assert set(here.texture_names) == set(here.background_names) == names
    worn, behind, wrapped, plain = set(), set(), 0, 0
    for number in range(16):
        clip = build_clip(here, number)
        assert clip.background.shape == (8, 12, 3)
        behind.add(clip.notes["background"])
        worn |= set(clip.notes["textures"].values())
        for actor in clip.actors:
            has_texture = actor.texture is not None
            assert has_texture == (actor.name in clip.notes["textures"])
            wrapped, plain = wrapped + has_texture, plain + (not has_texture)
            assert not has_texture or actor.uv.shape == (len(actor.faces), 3, 2)
            assert actor.is_lit == (lighting == "lamps") or actor.name.startswith("lamp-")
        assert clip.notes["backdrop"] == ("picture" if lighting == "painted" else "floor")
        assert ("floor" in clip.notes["textures"]) == (lighting == "lamps")
        json.dumps(clip.notes)
    assert worn == behind == names
    assert wrapped > 10
    assert plain > 10


def test_pictures_move_nothing_else(pictures):
    base = TINY | {"lighting": "lamps"}
    without = build_clip(Plan(parse_spec(base), (), ""), 1)
    textured = build_clip(survey_plan(parse_spec(base | {"textures": str(pictures)}))[0], 1)
    assert [a.name for a in textured.actors] == [a.name for a in without.actors]
    times = torch.tensor([0.0, 0.4], dtype=torch.float64)
    for a, b in zip(textured.actors, without.actors, strict=True):
        assert torch.equal(a.motion.at(times), b.motion.at(times))
        assert a.texture is not None or torch.equal(a.color, b.color)
    for a, b in zip(textured.lamps, without.lamps, strict=True):  # as bright as pictures need, and all else as it was
        assert replace(a, power=b.power) == b


def test_the_bytes_depend_on_the_contents_of_the_pictures_not_on_their_place(pictures, tmp_path):
    fields = TINY | {"textures": str(pictures), "backgrounds": str(pictures)}
    generate(parse_spec(fields), tmp_path / "one")
    copies = []
    for k in range(2):
        copies.append(tmp_path / f"copy{k}")
        for path in pictures.rglob("*.*"):
            (copies[k] / path.relative_to(pictures)).parent.mkdir(parents=True, exist_ok=True)
            (copies[k] / path.relative_to(pictures)).write_bytes(path.read_bytes())
    moved = TINY | {"textures": str(copies[0]), "backgrounds": str(copies[1])}
    generate(parse_spec(moved), tmp_path / "two", workers=2)
    assert sums(tmp_path / "two") == sums(tmp_path / "one")
    assert verify_dataset(tmp_path / "two") == []
    again = generate(parse_spec(moved), tmp_path / "one")
    assert (again.made, again.kept) == (0, 3)
    save(copies[1] / "b.bmp", noise(21, 30, seed=77))
    with pytest.raises(SpecError, match="assets_sha256: expected"):
        generate(parse_spec(moved), tmp_path / "one")
    with pytest.raises(SpecError, match=r"^textures: expected '.*' as in .*, got None"):
        generate(parse_spec(TINY | {"backgrounds": str(pictures)}), tmp_path / "one")


@pytest.mark.parametrize("field", ["textures", "backgrounds"])
def test_a_folder_that_is_none_is_refused_by_the_fields_name(field, tmp_path, pictures):
    for place in (tmp_path / "nowhere", pictures / "a.png"):
        with pytest.raises(SpecError) as caught:
            parse_spec({field: str(place)})
        assert caught.value.problems == [
            f"{field}: expected a folder of pictures, got {str(place)!r}, which is no folder"
        ]


def test_meshes_wear_pictures_too(pictures, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets/box.ply").write_bytes(trimesh.creation.box().export(file_type="ply"))
    fields = {"source": "meshes", "assets": str(tmp_path / "assets"), "textures": str(pictures)}
    here, _ = survey_plan(parse_spec(TINY | fields))
    worn = [build_clip(here, number).notes["textures"] for number in range(12)]
    assert any(name.startswith("box.ply") for names in worn for name in names)
    result = generate(parse_spec(TINY | fields), tmp_path / "data")
    assert result.is_complete


@pytest.mark.parametrize("storage", ["folder", "shards"])
def test_a_data_set_needs_its_assets_and_pictures_only_to_be_made(tmp_path, pictures, storage, capsys):
    for name in ("assets", "worn", "behind"):
        (tmp_path / name).mkdir()
        shutil.copy(pictures / "a.png", tmp_path / name)
    square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n"
    (tmp_path / "assets/a.obj").write_text(square)
    fields = {"source": "meshes", "assets": str(tmp_path / "assets"), "storage": storage}
    fields |= {"textures": str(tmp_path / "worn"), "backgrounds": str(tmp_path / "behind")}
    folder = tmp_path / "data"
    assert generate(parse_spec(TINY | fields), folder).is_complete
    for name in ("assets", "worn", "behind"):
        shutil.rmtree(tmp_path / name)
    assert verify_dataset(folder) == []
    for words in (
        ["status"],
        ["verify"],
        ["report"],
        ["inspect", "--frame", "1"],
        ["export", str(tmp_path / "out"), "gopro"],
    ):
        assert main([words[0], str(folder), *words[1:]]) == 0
    assert len(BlurDataset(folder)) == 3
    capsys.readouterr()
    assert main(["retry", str(folder)]) == 2  # to make frames, they are needed
    told = capsys.readouterr().err
    assert all(f"{name}: expected" in told for name in ("textures", "backgrounds", "assets"))


def test_the_decoder_takes_bytes_only_of_its_formats():
    buffer = io.BytesIO()
    Image.fromarray(noise(4, 4)).save(buffer, format="GIF")
    with pytest.raises(datagen.pictures.PhotoError, match="expected a readable PNG, JPEG, WEBP, BMP"):
        datagen.pictures.decode_photo(buffer.getvalue())
