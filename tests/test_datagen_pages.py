import base64
import hashlib
import html
import itertools
import re
import shutil
import subprocess

import numpy as np
import pytest
import torch

import datagen.runs
from datagen import BlurDataset, FrameFileError, generate, parse_spec
from datagen.__main__ import main
from datagen.pages import BLUR_EDGES_PX, look_at_frame, write_page

TINY = {"width": 16, "height": 12, "rays_per_pixel": 1, "frames_per_clip": 2, "seed": 4, "count": 6}
NASTY = "<script>alert('1')</script> & \"quoted\""
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("page") / "<b>data"
    real = datagen.runs.make_sample

    def faulty(plan, index):
        if index == 3:
            raise ValueError(NASTY)
        return real(plan, index)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datagen.runs, "make_sample", faulty)
        generate(parse_spec(TINY | {"storage": "shards", "frames_per_shard": 2}), out)
    return out


@pytest.fixture(scope="module")
def page(folder, tmp_path_factory):
    return write_page(folder, tmp_path_factory.mktemp("out") / "report.html")


def test_counts_and_failures_are_told_and_every_text_is_escaped(page):
    text = page.read_text(encoding="utf-8")
    assert "5 of 6" in text
    assert html.escape(f"ValueError: {NASTY}") in text
    assert "alert('1')" not in text
    assert "<b>data" not in text
    assert "&lt;b&gt;data" in text


def test_it_loads_nothing_and_its_policy_names_its_own_style_and_script(page):
    text = page.read_text(encoding="utf-8")
    assert {m[:22] for m in re.findall(r'(?:src|href)="([^"]*)', text)} == {"data:image/png;base64,"}
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert "unsafe" not in policy
    assert " style=" not in text
    assert " onclick=" not in text
    for tag, rule in (("style", "style-src"), ("script", "script-src")):
        own = re.search(f"<{tag}>(.*?)</{tag}>", text, flags=re.DOTALL)[1]
        assert rules[rule] == f"'sha256-{base64.b64encode(hashlib.sha256(own.encode()).digest()).decode()}'"


def test_the_distributions_count_every_pixel(folder):
    dataset = BlurDataset(folder)
    for item in range(len(dataset)):
        look, frame = look_at_frame(dataset, item), dataset[item]
        length = torch.linalg.vector_norm(frame["motion"].double(), dim=0)
        length = length[~length.isnan()].numpy()
        counts = [int(((length >= a) & (length < b)).sum()) for a, b in itertools.pairwise(BLUR_EDGES_PX)]
        assert look.blur_counts.tolist() == counts
        depth = frame["depth"][frame["depth"].isfinite()].numpy()
        assert sum(look.depth_counts.values()) == depth.size
        for octave, count in look.depth_counts.items():
            assert count == int(((depth >= 2.0**octave) & (depth < 2.0 ** (octave + 1))).sum())
        assert "motion" in look.effects
        assert look.blur_px <= np.nanmax(length)


def test_the_worst_are_the_longest(folder, page):
    looks = [look_at_frame(BlurDataset(folder), item) for item in range(5)]
    longest = max(looks, key=lambda look: look.blur_px)
    shown = re.findall(r"<figcaption>frame (\d+): blur up to ([\d.]+) px", page.read_text(encoding="utf-8"))
    assert len(shown) == 5 + 4
    assert [int(index) for index, _ in shown[:5]] == [0, 1, 2, 4, 5]
    assert shown[5] == (str(longest.index), f"{longest.blur_px:.1f}")


def test_a_browser_runs_it_without_a_complaint(page):
    if CHROMIUM is None:
        pytest.skip("no chromium on this machine")
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom"]
    done = subprocess.run([CHROMIUM, *flags, page.as_uri()], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0
    assert 'data-ready="9"' in done.stdout
    assert done.stdout.count("clip-path: inset(0px 0px 0px 50%)") == 9
    assert "CONSOLE" not in done.stderr
    assert "Refused" not in done.stderr


def test_the_browser_would_have_complained(page, tmp_path):
    if CHROMIUM is None:
        pytest.skip("no chromium on this machine")
    text = page.read_text(encoding="utf-8").replace("</body>", "<script>document.title = 1</script></body>")
    (tmp_path / "changed.html").write_text(text, encoding="utf-8")
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom"]
    place = (tmp_path / "changed.html").as_uri()
    done = subprocess.run([CHROMIUM, *flags, place], capture_output=True, text=True, timeout=120)
    assert "CONSOLE" in done.stderr


def test_the_command_writes_it_beside_the_data(folder, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    assert main(["report", str(copy)]) == 0
    assert (copy / "report.html").is_file()
    assert main(["report", str(tmp_path / "none")]) == 2
    path = copy / "shards/000000.tar"
    path.write_bytes(path.read_bytes()[:700])
    assert main(["report", str(copy)]) == 3
    with pytest.raises(FrameFileError, match="differs from the marker"):
        write_page(copy, tmp_path / "damaged.html")
    assert not (tmp_path / "damaged.html").exists()
