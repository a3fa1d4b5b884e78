import json
import re
import time

import pytest

import datagen.runs
from datagen import generate, parse_spec, verify_dataset
from datagen.__main__ import main
from datagen.pages import RUNS_SHOWN, write_page
from datagen.run_log import LOG_NAME, RunNote, encode_line, logged_run, read_log

TINY = {"width": 8, "height": 6, "rays_per_pixel": 1, "seed": 4}


def rows_of(page):
    table = re.search(r"<h2>Throughput</h2>.*?<table>(.*?)</table>", page.read_text(), re.DOTALL)[1]
    return [re.findall(r"<td>(.*?)</td>", row) for row in table.split("</tr>")[1:-1]]


def test_each_run_that_made_something_leaves_a_line(tmp_path, monkeypatch):
    folder, start = tmp_path / "data", time.time()
    generate(parse_spec(TINY | {"count": 2}), folder)
    generate(parse_spec(TINY | {"count": 2}), folder)  # nothing left to do
    real = datagen.runs.make_sample

    def stopped(plan, index):
        if index == 3:
            raise ValueError("dark")
        if index == 4:
            raise KeyboardInterrupt
        return real(plan, index)

    monkeypatch.setattr(datagen.runs, "make_sample", stopped)
    with pytest.raises(KeyboardInterrupt):
        generate(parse_spec(TINY | {"count": 6}), folder)
    notes, unread = read_log(folder)
    assert [(n.made, n.failed, n.workers, n.part) for n in notes] == [(2, 0, 1, ""), (1, 1, 1, "")]
    assert unread == 0
    assert all(0 < n.seconds < time.time() - start + 1 for n in notes)
    assert all(start - 1 <= n.started_s <= time.time() for n in notes)
    assert verify_dataset(folder) == []
    page = write_page(folder, tmp_path / "report.html")
    rows = rows_of(page)
    assert [row[1:5] for row in rows] == [["all", "1", "2", "0"], ["all", "1", "1", "1"]]
    assert float(rows[0][6]) == pytest.approx(notes[0].made / notes[0].seconds, rel=0.01)


def test_slices_add_to_one_log(tmp_path):
    words = [word for k, v in TINY.items() for word in (f"--{k.replace('_', '-')}", str(v))]
    words += ["--count", "4", "--storage", "shards", "--frames-per-shard", "2", "--out", str(tmp_path / "data")]
    for part in ("2/2", "1/2"):
        assert main([*words, "--slice", part]) == 0
    notes, _ = read_log(tmp_path / "data")
    assert [(n.part, n.made) for n in notes] == [("2/2", 2), ("1/2", 2)]


def test_lines_that_cannot_be_read_are_counted_and_told(tmp_path):
    folder = tmp_path / "data"
    generate(parse_spec(TINY | {"count": 1}), folder)
    good = json.loads((folder / LOG_NAME).read_text())
    assert good.pop("line_sha256") in (folder / LOG_NAME).read_text()
    more = [{"seconds": -1}, {"x": 1}, {"part": "<b>", "seconds": float("nan")}]
    bad = [b"{", b"[]", b"\xff", json.dumps(good).encode(), *(encode_line(good | m).strip() for m in more)]
    with (folder / LOG_NAME).open("ab") as file:
        file.write(b"\n".join(bad) + b"\n" + encode_line(good | {"part": "<b>"}))
    notes, unread = read_log(folder)
    assert (len(notes), unread) == (2, len(bad))
    text = write_page(folder, tmp_path / "report.html").read_text()
    assert f"{len(bad)} lines of the log of runs cannot be read" in text
    assert "<td>&lt;b&gt;</td>" in text
    assert any(LOG_NAME in problem for problem in verify_dataset(folder))
    generate(parse_spec(TINY | {"count": 1}), folder)  # drops them
    assert verify_dataset(folder) == []
    assert (len(read_log(folder)[0]), read_log(folder)[1]) == (2, 0)
    (folder / LOG_NAME).unlink()
    assert "Throughput" not in write_page(folder, tmp_path / "report.html").read_text()


def test_the_page_shows_the_last_runs_and_the_sum_of_all(tmp_path):
    folder = tmp_path / "data"
    generate(parse_spec(TINY | {"count": 1}), folder)
    (folder / LOG_NAME).unlink()
    for k in range(RUNS_SHOWN + 3):
        with logged_run(folder, 2, "") as note:
            note.made = k + 1
    page = write_page(folder, tmp_path / "report.html")
    assert [int(row[3]) for row in rows_of(page)] == list(range(4, RUNS_SHOWN + 4))
    assert f"{sum(range(RUNS_SHOWN + 4))} pairs in" in page.read_text()


def test_a_log_that_cannot_be_written_does_not_fail_the_run(tmp_path, capsys):
    (tmp_path / LOG_NAME).mkdir()
    with logged_run(tmp_path, 1, "") as note:
        note.made = 1
    assert f"{LOG_NAME}: expected to add a line, got" in capsys.readouterr().err
    assert RunNote(0.0, 0.0, 5, 0, 1, "").pairs_per_s == 0
