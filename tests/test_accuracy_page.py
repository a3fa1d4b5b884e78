"""The script that draws error against time: complete, resumable, and a page that opens offline."""

import json
import re
import shutil
import subprocess

import accuracy_page
import accuracy_vs_time
import pytest
import torch

import torchblur as tb
from torchblur.backends import choose_backend


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setattr(accuracy_vs_time, "QUICK_SCENES", ("swapping quads", "pills"))
    monkeypatch.setattr(accuracy_vs_time, "QUICK_COUNTS", (1, 32))
    monkeypatch.setattr(accuracy_vs_time, "QUICK_CHECK_TIMES", 64)


@pytest.fixture
def page(tiny, tmp_path):
    accuracy_vs_time.main(["--out", str(tmp_path), "--quick", "--size", "20"])
    return tmp_path / "index.html"


def test_every_method_is_measured_on_every_scene(page):
    results = json.loads((page.parent / "results.json").read_text())
    assert list(results["scenes"]) == ["swapping quads", "pills"]
    for record in results["scenes"].values():
        rows = record["methods"]
        assert set(rows) == set(accuracy_vs_time.methods((1, 32)))
        assert {row["family"] for row in rows.values()} == set(accuracy_page.STYLES)
        assert rows["exact"]["rmse"] == 0
        assert rows["mean of 32"]["rmse"] < rows["mean of 1"]["rmse"]
        assert rows["stochastic 32"]["rmse"] < rows["stochastic 1"]["rmse"]
        assert all(row["time_s"] >= 0 for row in rows.values())
        assert 0 < record["check"]["rmse"] < 0.02
    assert rows["mcguire2012 15"]["psnr_db"] < rows["mean of 32"]["psnr_db"]  # pills, behind glass


def test_the_verdict_is_that_of_the_times():
    rows = {"exact": {"time_s": 1.0}, "mean of 32": {"time_s": 4.0}}
    record = {"methods": rows, "looks_per_pixel": 40.0, "intervals_per_pixel": 5.0}
    assert accuracy_page.verdict(record) == (0.25, "faster than 32 sharp images")
    rows["mean of 32"]["time_s"] = 0.5
    ratio, text = accuracy_page.verdict(record)
    assert ratio == 2.0
    assert text.startswith("slower: 5.0 intervals a pixel to solve and to order, and 40.0 looks at surfaces,")


def test_scenes_are_measured_where_they_have_a_compiled_path():
    for name, make in accuracy_vs_time.SCENES.items():
        scene = accuracy_vs_time.single(make(16))
        assert choose_backend(scene, "auto") == "cpu", name
        assert len(scene.meshes) == len(make(16).meshes)


def test_errors_are_those_of_the_metrics():
    image, other = torch.rand(2, 16, 16, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = accuracy_vs_time.errors(image, other)
    assert found["rmse"] == pytest.approx(float((image - other).square().mean().sqrt()))
    assert found["psnr_db"] == pytest.approx(float(tb.psnr(image, other)))
    assert "psnr_db" not in accuracy_vs_time.errors(image, image)


def test_an_interrupted_run_goes_on_with_the_next_scene(tiny, tmp_path, monkeypatch, capsys):
    words = ["--out", str(tmp_path), "--quick", "--size", "20"]
    real = accuracy_vs_time.measure

    def stopped(scene, settings):
        if len(scene.meshes) > 2:
            raise KeyboardInterrupt
        return real(scene, settings)

    monkeypatch.setattr(accuracy_vs_time, "measure", stopped)
    with pytest.raises(KeyboardInterrupt):
        accuracy_vs_time.main(words)
    stored = json.loads((tmp_path / "results.json").read_text())["scenes"]
    assert list(stored) == ["swapping quads"]
    monkeypatch.setattr(accuracy_vs_time, "measure", real)
    accuracy_vs_time.main(words)
    assert "swapping quads: kept" in capsys.readouterr().err
    whole = json.loads((tmp_path / "results.json").read_text())["scenes"]
    assert whole["swapping quads"] == stored["swapping quads"]
    assert list(whole) == ["swapping quads", "pills"]
    with pytest.raises(SystemExit, match="out: expected a folder for"):
        accuracy_vs_time.main(["--out", str(tmp_path), "--quick", "--size", "24"])


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", '{"scenes": {"rotor": {}}}', '{"settings": {}, "scenes": {"rotor": {}}}', "\xff"]
)
def test_damaged_results_are_told_and_kept(tiny, tmp_path, text):
    (tmp_path / "results.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(SystemExit, match=r"out: expected the results of an earlier run, got .*results\.json damaged"):
        accuracy_vs_time.main(["--out", str(tmp_path), "--quick", "--size", "20"])
    assert (tmp_path / "results.json").read_bytes() == text.encode("latin-1")


def test_a_damaged_sheet_is_made_once_more(page, capsys):
    sheet = page.parent / "pills.png"
    whole = sheet.read_bytes()
    for cut in (0, len(whole) // 2):
        sheet.write_bytes(whole[:cut])
        accuracy_vs_time.main(["--out", str(page.parent), "--quick", "--size", "20"])
        told = capsys.readouterr().err
        assert "swapping quads: kept" in told
        assert "pills: kept" not in told
        assert accuracy_vs_time.is_picture(sheet)


@pytest.mark.parametrize("words", [["--size", "0"], ["--size", "10"], ["--size", "-5"], ["--repeats", "0"]])
def test_wrong_arguments_are_named_before_any_work(tmp_path, capsys, words):
    with pytest.raises(SystemExit) as stop:
        accuracy_vs_time.main(["--out", str(tmp_path / "out"), *words])
    assert stop.value.code == 2
    assert f"{words[0]}: expected at least" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").write_text("x")
    with pytest.raises(SystemExit):
        accuracy_vs_time.main(["--out", str(tmp_path / "file")])
    assert "--out: expected a folder, got the file" in capsys.readouterr().err


def test_the_page_holds_all_that_it_shows(page):
    text = page.read_text()
    assert text.count("<img ") == 1 + 2 * 2
    assert len(re.findall(r"src='data:image/(?:svg\+xml|png);base64,", text)) == 5
    assert "http" not in re.sub(r"base64,[\w+/=]+", "", text)
    assert text.count("<table>") == 2 + 1
    assert text.count("32 sharp images</td>") + text.count("<td>slower: ") == 2


def test_the_page_opens_in_a_browser_without_complaint(page):
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium on this machine to open the page in")
    probe = (
        "<script>addEventListener('load', () => document.body.dataset.shown = "
        "[...document.images].filter(i => i.complete && i.naturalWidth > 0).length)</script>"
    )
    opened = page.with_name("probed.html")
    opened.write_text(page.read_text().replace("</body>", probe + "</body>"))
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
               f"--user-data-dir={page.parent / 'profile'}", "--virtual-time-budget=5000", "--dump-dom",
               opened.as_uri()]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert 'data-shown="5"' in done.stdout
    assert "CONSOLE" not in done.stderr
