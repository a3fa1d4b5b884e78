import hashlib
import json
import math
import re

import numpy as np
import pytest
import torch
from gltf_makers import spinner
from PIL import Image
from torch.utils.data import DataLoader

import torchblur as tb
from datagen import BlurDataset, SpecError, generate, parse_spec, verify_dataset
from datagen.__main__ import main
from datagen.clips import Actor, Clip, expose
from datagen.entries import read_entries
from datagen.lamps import PROBES, Lamp, choose_lamp_segments
from datagen.lit_stages import HIGHEST, LOWEST, PLACES, is_clip_lit
from datagen.motions import CameraPath, Path, RigidBody, RigidMotion, Sway
from datagen.report import write_contact_sheet
from datagen.samples import make_sample, render_sample
from datagen.scenes import Plan, build_clip, survey_plan
from datagen.shapes import sheet
from datagen.writer import read_exr, sample_parts

SIZE = 24
CAMERA = CameraPath(
    Path((0.0, 0.0, 5.0)), Path((0.0, 0.0, 0.0)), fov_y_deg=2 * math.degrees(math.atan(0.4)), near=0.3, far=50.0
)
PX = SIZE / 4.0  # pixels of a scene unit at the origin
SIDE = Lamp("directional", Path((-3.0, 0.0, 3.0)), Path((0.0, 0.0, 0.0)), (2.0, 2.0, 2.0))  # shadows go right by depth
EARLIER = (  # clip 5 of seed 3 before there were lamps: backdrop, camera, actors, and a sum over each
    "ground",
    "still",
    7,
    [
        -1467.1588788032532,
        -396.49095216663954,
        -372.47908119595274,
        166.01417562401934,
        204.20193412551174,
        937.3600227337369,
        424.75050956754626,
    ],
)
TINY = {"width": 10, "height": 8, "rays_per_pixel": 1, "seed": 3, "count": 4}


def plan(**fields):
    return Plan(parse_spec({"width": SIZE, "height": SIZE, "rays_per_pixel": 1, "frames_per_clip": 4} | fields), (), "")


def square(name, half, place, velocity=(0.0, 0.0, 0.0), opacity=1.0, is_lit=True):
    shape = sheet(2).scaled((half, half, 1.0))
    body = RigidBody(shape.vertices, RigidMotion(Path(place, velocity)))
    return Actor(name, shape.faces, torch.tensor([0.6, 0.5, 0.4]), body, opacity, is_lit=is_lit)


def wall_clip(velocity, lamps=(SIDE,), opacity=1.0):
    """A wall at z = 0, and a square of half side 0.4 at (-1.2, 0, 1), whose shadow begins at (-0.2, 0)."""
    actors = (square("wall", 9.0, (0.0, 0.0, 0.0)), square("square", 0.4, (-1.2, 0.0, 1.0), velocity, opacity))
    return Clip(actors, CAMERA, torch.zeros(3), lamps=lamps, ambient=(0.1, 0.1, 0.1))


def folder_sums(folder):
    names = (p for p in sorted(folder.rglob("*")) if p.suffix in (".exr", ".png", ".jsonl", ".tar", ".json"))
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in names}


def wanted_shadow(speed, open_s, close_s, opacity=1.0):
    """The share of the lamp's light on the wall at the pixels' x in a row through the square's middle."""
    x = (torch.arange(SIZE, dtype=torch.float64) + 0.5) / PX - 2.0
    middle = -0.2 + speed * torch.linspace(open_s, close_s, 100_001, dtype=torch.float64)
    return torch.stack([1 - opacity * ((c - middle).abs() < 0.4).double().mean() for c in x])


@pytest.mark.parametrize("opacity", [1.0, 0.25])
def test_shadow_is_the_share_of_the_exposure_in_which_nothing_is_between(opacity):
    speed = 0.96 * 48  # the shadow moves by 0.96 in an exposure of 1/48 s
    sample = render_sample(wall_clip((speed, 0.0, 0.0), opacity=opacity), plan(exposure=0.5), 0, 0)
    row, wanted = sample.shadow[SIZE // 2], wanted_shadow(speed, -1 / 96, 1 / 96, opacity)
    on_wall = sample.coverage[SIZE // 2, :, 1] == 0
    assert int((on_wall & (wanted < 1)).sum()) >= 4
    torch.testing.assert_close(row[on_wall].double(), wanted[on_wall], atol=2e-5, rtol=0)
    assert bool((sample.shadow[0] == 1).all())  # y = 1.9: nothing is between the lamp and there
    assert bool((sample.shadow <= 1).all())
    # what arrives is what is seen: ambient + cosine * irradiance / pi * shadow
    grey = 0.1 + math.cos(math.pi / 4) * 2.0 / math.pi * row[on_wall]
    torch.testing.assert_close(sample.blurred[SIZE // 2, on_wall, 0], 0.6 * grey, atol=1e-5, rtol=0)


def test_shadows_of_a_clips_frames_are_those_of_their_own_exposures():
    clip, here = wall_clip((4.0, 0.0, 0.0)), plan(exposure=1.0)
    rows = []
    for frame in (0, 3):
        sample = render_sample(clip, here, frame, frame)
        on_wall = sample.coverage[SIZE // 2, :, 1] == 0
        wanted = wanted_shadow(4.0, (frame - 0.5) / 24, (frame + 0.5) / 24)
        rows.append(sample.shadow[SIZE // 2].double())
        torch.testing.assert_close(rows[-1][on_wall], wanted[on_wall], atol=2e-5, rtol=0)
    assert float((rows[0] - rows[1]).abs().max()) > 0.9


def test_only_clips_with_lamps_have_a_shadow_and_tell_of_lamps():
    lit = render_sample(wall_clip((9.0, 0.0, 0.0)), plan(), 0, 0)
    dark = render_sample(wall_clip((9.0, 0.0, 0.0), lamps=()), plan(), 0, 0)
    assert dark.shadow is None
    assert "shadow" not in sample_parts(dark)["data"]
    assert sample_parts(lit)["data"]["shadow"].dtype == np.float32
    json.dumps(lit.meta, allow_nan=False)
    assert lit.meta["lamps"][0]["kind"] == "directional"
    assert lit.meta["ambient"] == [0.1, 0.1, 0.1]
    assert {"shadow", "lamps"} <= set(lit.meta["units"])
    assert not {"lamps", "ambient"} & set(dark.meta)
    assert not {"shadow", "lamps"} & set(dark.meta["units"])


def test_a_moving_lamp_is_cut_until_its_shadows_stay_within_a_tenth_of_a_pixel():
    sway = Sway((0.5, 0.0, 0.2), 40.0, 0.3)
    moving = Lamp("spot", Path((1.0, 4.0, 2.0), sways=(sway,)), Path((0.0, 0.0, 0.0)), (9.0, 9.0, 9.0), 20.0, 30.0)
    knots = choose_lamp_segments(moving, 0.0, 1 / 24, 60.0)
    assert knots.segments > 1
    assert knots.segments & (knots.segments - 1) == 0
    assert knots.error_px <= 0.1
    assert not knots.limit_reached
    ends = torch.linspace(0, 1 / 24, knots.segments + 1, dtype=torch.float64)
    light = moving.light(ends)
    assert isinstance(light, tb.SpotLight)
    assert light.position.shape == (knots.segments + 1, 3)
    fine = torch.linspace(0, 1 / 24, knots.segments * 97 + 1, dtype=torch.float64)
    share = torch.arange(97, dtype=torch.float64)[:, None] / 97
    chord = torch.cat([a * (1 - share) + b * share for a, b in zip(light.position, light.position[1:], strict=False)])
    gap = float((moving.position.at(fine)[:-1] - chord).norm(dim=1).max()) * 60.0
    assert gap == pytest.approx(knots.error_px, rel=2 / PROBES)
    resting = Lamp("point", Path((1.0, 4.0, 2.0)), Path((0.0, 0.0, 0.0), sways=(sway,)), (9.0, 9.0, 9.0))
    assert choose_lamp_segments(resting, 0.0, 1 / 24, 60.0).segments == 0  # where a point light aims is nowhere
    assert resting.light(torch.zeros(1, dtype=torch.float64)).position.shape == (3,)


def test_lamps_go_on_where_the_last_exposure_ended():
    number = next(
        c for c in range(40) if not all(lamp.is_static for lamp in build_clip(plan(lighting="lamps"), c).lamps)
    )
    clip = build_clip(plan(lighting="lamps"), number)
    first, second = (expose(clip, SIZE, SIZE, k / 24, (k + 1) / 24).scene.lights for k in (0, 1))
    for a, b in zip(first, second, strict=True):
        for name, value in a.tensors().items():
            end, start = (t if t.ndim == 1 else t[k] for t, k in ((value, -1), (b.tensors()[name], 0)))
            torch.testing.assert_close(end, start, atol=1e-9, rtol=0)


def test_lit_scenes_are_valid_and_varied_and_stand_on_their_floor():
    here = plan(lighting="lamps", seed=2)
    places, kinds, counts, moving = set(), set(), set(), 0
    for number in range(40):
        clip = build_clip(here, number)
        places.add(clip.notes["backdrop"])
        kinds |= {lamp.kind for lamp in clip.lamps}
        counts.add(len(clip.lamps))
        moving += not all(lamp.is_static for lamp in clip.lamps)
        assert clip.notes["lamps"] == " ".join(lamp.kind for lamp in clip.lamps)
        assert all(a.is_lit or a.name.startswith("lamp-") for a in clip.actors)
        assert min(clip.ambient) > 0
        floor = next((a.motion.at(torch.zeros(1))[0, :, 1] for a in clip.actors if a.name == "floor"), None)
        if floor is not None:
            height = float(floor.max())
            assert float(floor.min()) == height
            assert LOWEST <= height <= HIGHEST
            times = torch.linspace(0, 1, 25, dtype=torch.float64)
            low = min(float(a.motion.at(times)[..., 1].min()) for a in clip.actors if a.name not in ("floor", "wall"))
            assert height < low or height == LOWEST
    assert places == set(PLACES)
    assert kinds == {"spot", "point", "directional"}
    assert counts == {1, 2}
    assert 10 < moving < 36


def test_lit_pictures_are_neither_black_nor_burnt_out_and_most_have_shadows():
    shadowed = 0
    for index in range(10):
        sample = make_sample(plan(width=20, height=16, lighting="lamps", seed=5, frames_per_clip=1).to_json(), index)
        rgb = sample.blurred[..., :3]
        assert 0.05 < float(rgb.mean()) < 0.7
        assert float((rgb.amax(-1) > 1).double().mean()) < 0.3
        assert float((rgb.amax(-1) < 0.01).double().mean()) < 0.2
        assert float(sample.shadow.min()) >= 0
        shadowed += float((sample.shadow < 0.9).double().mean()) > 0.05
        assert {"lighting", "shadows"} <= {n for n, e in sample.meta["plan"]["effects"].items() if e["needed"]}
    assert shadowed >= 8


def test_painted_data_sets_are_what_they_were_before_there_were_lamps():
    # measured before the field existed: a data set that was begun then can be finished now
    before = {"backend": "torch"}  # as all were made
    assert parse_spec(before).config_sha256() == "94523107d4c2d25d7e6cd49fd7d75e2473cb693fe4629e8911efeb23f1a9f56c"
    other = parse_spec(before | {"sensor": "srgb", "seed": 4}).config_sha256("ab")
    assert other == "0578906625ff1b49cfc6770b07881c8f5be452a5e80c589fa61053ccc878fa48"
    assert len({parse_spec({"lighting": k}).config_sha256() for k in ("painted", "lamps", "mixed")}) == 3
    clip = build_clip(plan(seed=3), 5)
    assert not any(a.is_lit for a in clip.actors)
    assert not clip.lamps
    assert (clip.notes["backdrop"], clip.notes["camera"], len(clip.actors)) == EARLIER[:3]
    sums = [float(a.color.double().sum() + a.motion.at(torch.ones(1)).sum()) for a in clip.actors]
    assert sums == pytest.approx(EARLIER[3], rel=1e-6)


def test_a_mixed_data_set_has_clips_of_both_kinds_each_as_in_a_set_of_its_kind():
    is_lit = [is_clip_lit("mixed", 1, c) for c in range(200)]
    assert 60 < sum(is_lit) < 140
    assert all(is_clip_lit("lamps", 1, c) for c in range(5))
    assert not any(is_clip_lit("painted", 1, c) for c in range(5))
    chosen = is_lit.index(True), is_lit.index(False)
    size = {"width": 10, "height": 8, "seed": 1, "frames_per_clip": 1}
    for clip, kind in zip(chosen, ("lamps", "painted"), strict=True):
        mixed, own = (make_sample(plan(lighting=k, **size).to_json(), clip) for k in ("mixed", kind))
        assert torch.equal(mixed.blurred, own.blurred)
        assert (mixed.shadow is None) == (kind == "painted")
        assert mixed.shadow is None or torch.equal(mixed.shadow, own.shadow)


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mixed") / "data"
    spec = parse_spec(TINY | {"lighting": "mixed", "storage": "folder"})
    assert len({is_clip_lit("mixed", spec.seed, c) for c in range(spec.count)}) == 2  # of both kinds
    result = generate(spec, folder)
    assert result.effects["shadows"] == result.effects["lighting"] == pytest.approx(_lit_share(spec))
    return folder


def _lit_share(spec):
    return sum(is_clip_lit(spec.lighting, spec.seed, c) for c in range(spec.count)) / spec.count


@pytest.mark.parametrize("workers", [0, 2])
def test_workers_make_the_same_lit_frames(mixed, tmp_path, workers):
    generate(parse_spec(TINY | {"lighting": "mixed"}), tmp_path / "data", workers=workers)
    assert folder_sums(tmp_path / "data") == folder_sums(mixed)


def test_slices_and_shards_hold_the_same_lit_frames(mixed, tmp_path):
    fields = TINY | {"lighting": "mixed", "storage": "shards", "frames_per_shard": 2}
    generate(parse_spec(fields), tmp_path / "whole")
    for part in ("2/2", "1/2"):
        assert main(["--out", str(tmp_path / "sliced"), *_words(fields), "--slice", part]) == 0
    whole = folder_sums(tmp_path / "whole")
    del whole["contact_sheet.png"]  # which slices leave to a whole run
    assert folder_sums(tmp_path / "sliced") == whole
    assert verify_dataset(tmp_path / "whole") == []
    tarred, plain = BlurDataset(tmp_path / "whole"), BlurDataset(mixed)
    for item in range(4):
        for key, value in plain[item].items():
            again = tarred[item][key]
            assert torch.equal(again, value) if isinstance(value, torch.Tensor) else again == value, key


def test_batches_mix_frames_with_and_without_lamps(mixed):
    dataset = BlurDataset(mixed)
    is_lit = [is_clip_lit("mixed", 3, c) for c in range(4)]
    (batch,) = DataLoader(dataset, batch_size=4)
    assert batch["shadow"].shape == (4, 1, 8, 10)
    assert batch["shadow"].dtype == torch.float32
    for lit, plane, entry in zip(is_lit, batch["shadow"], read_entries(mixed).values(), strict=True):
        assert ("shadows" in entry["effects"]) == lit
        parts, meta = read_exr(mixed / entry["files"][0]["path"])
        assert ("shadow" in parts["data"]) == lit == ("lamps" in meta)
        assert torch.equal(plane[0], torch.from_numpy(parts["data"]["shadow"]) if lit else torch.ones(8, 10))
    assert set(BlurDataset(mixed, keys=["shadow"])[0]) == {"shadow", "index", "meta"}


def test_sheet_page_and_inspect_show_shadows(mixed, tmp_path, capsys):
    lit = [is_clip_lit("mixed", 3, c) for c in range(4)]
    plain = tmp_path / "plain"
    generate(parse_spec(TINY), plain)
    widths = [picture_width(write_contact_sheet(folder)) for folder in (mixed, plain)]
    assert widths[0] == widths[1] + 10 + 6  # a column more: its cells and a gap
    assert main(["report", str(mixed)]) == 0
    page = (mixed / "report.html").read_text()
    shown = {int(n) for n in re.findall(r'alt="frame (\d+), shadow"', page)}
    assert shown == {k for k in range(4) if lit[k]}
    assert "shadows" in page
    (mixed / "report.html").unlink()
    for frame in range(4):
        capsys.readouterr()
        assert main(["inspect", str(mixed), "--frame", str(frame)]) == 0
        out = capsys.readouterr().out
        assert bool(re.search(r"^data +shadow +float32", out, re.MULTILINE)) == lit[frame]
        assert ('"ambient"' in out) == lit[frame]


def picture_width(path):
    with Image.open(path) as image:
        return image.width


@pytest.mark.parametrize("source", ["meshes", "sequence"])
def test_lamps_light_peoples_meshes_and_sequences_too(tmp_path, source):
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(1)
    if source == "meshes":
        assets = tmp_path / "assets"
        assets.mkdir()
        ball.export(assets / "ball.ply")
    else:
        assets = tmp_path / "grow.npz"
        np.savez(assets, vertices=np.stack([ball.vertices * s for s in (0.6, 0.8, 1.0)]), faces=ball.faces)
    fields = TINY | {"count": 2, "lighting": "lamps", "source": source, "assets": str(assets)}
    assert generate(parse_spec(fields), tmp_path / "data").is_complete
    for item in (0, 1):
        frame = BlurDataset(tmp_path / "data")[item]
        assert json.loads(frame["meta"])["lamps"]
        assert float(frame["shadow"].min()) < 0.9


def test_lighting_is_refused_by_name_and_is_part_of_the_configuration(tmp_path, capsys):
    assert main(["--out", str(tmp_path / "none"), "--lighting", "sun"]) == 2
    assert "lighting" in capsys.readouterr().err
    generate(parse_spec(TINY | {"count": 1, "backend": "torch"}), tmp_path / "data")
    assert main(["--out", str(tmp_path / "data"), "--lighting", "lamps", *_words(TINY | {"count": 1})]) == 2
    assert "lighting: expected 'painted'" in capsys.readouterr().err
    run = json.loads((tmp_path / "data/run.json").read_text())
    for name in ("lighting", "backend"):  # as it was before the fields existed
        del run["spec"][name]
    (tmp_path / "data/run.json").write_text(json.dumps(run))
    with pytest.raises(SpecError, match="backend: expected 'torch'"):
        generate(parse_spec(TINY | {"count": 1}), tmp_path / "data")
    result = generate(parse_spec(TINY | {"count": 1, "backend": "torch"}), tmp_path / "data")
    assert (result.made, result.kept) == (0, 1)


def _words(fields):
    return [word for k, v in fields.items() for word in (f"--{k.replace('_', '-')}", str(v))]


@pytest.mark.parametrize("source", ["meshes", "sequence"])
def test_lamps_light_animated_files_and_they_wear_pictures(tmp_path, source):
    (tmp_path / "assets").mkdir()
    (tmp_path / "pictures").mkdir()
    spinner(degrees=120).save(tmp_path / "assets/a.glb")
    Image.new("RGB", (4, 4), (200, 90, 30)).save(tmp_path / "pictures/a.png")
    assets = tmp_path / "assets" if source == "meshes" else tmp_path / "assets/a.glb"
    fields = {"lighting": "lamps", "source": source, "assets": str(assets), "textures": str(tmp_path / "pictures")}
    here, refused = survey_plan(parse_spec(TINY | fields))
    assert refused == ()
    clips = [build_clip(here, number) for number in range(8)]
    assert all(actor.is_lit for clip in clips for actor in clip.actors)
    assert any(actor.texture is not None and actor.name.startswith("a.glb") for c in clips for actor in c.actors)
    frame = make_sample(here.to_json(), 1)
    assert frame.meta["lamps"]
    assert bool(torch.isfinite(frame.blurred).all())
