"""Page: a data set's report as one HTML file that needs nothing else and loads nothing.

Before: checks.py, dataset.py, report.py, pictures.py, run_log.py.  After: commands.py.
Its content policy lets only this file's own style and script run, by their checksums; every text is escaped.
Large data sets are told of by LOOKED_AT frames, evenly chosen, which the page says.
"""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from datagen.checks import Status, read_status
from datagen.dataset import BlurDataset
from datagen.entries import read_entries
from datagen.listed_files import read_listed_file
from datagen.pictures import decode_png, encode_png, shrink
from datagen.report import grey_picture, motion_colours
from datagen.run_log import read_log
from datagen.writer import frame_paths, write_atomically

LOOKED_AT, SHOWN, WORST, LISTED, RUNS_SHOWN = 200, 8, 4, 100, 12
PICTURE_PX = 360
BLUR_EDGES_PX = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, math.inf)
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; background: #f6f6f4; max-width: 1180px; margin: 2em auto; }
h1 { font-size: 1.5em } h2 { font-size: 1.15em; margin-top: 2em }
table { border-collapse: collapse } td, th { text-align: left; padding: .15em 1em .15em 0; vertical-align: top }
figure { display: inline-block; margin: 0 1em 1.5em 0 } figcaption { color: #555; font-size: .9em }
.pair { position: relative; display: inline-block; line-height: 0 } .pair .over { position: absolute; left: 0; top: 0 }
input { display: block; width: 100%; margin: .3em 0 } svg { background: #fff; vertical-align: top; margin: 0 1em 1em 0 }
rect { fill: #47708f } text { font: 11px system-ui, sans-serif; fill: #333 } .bad { color: #a11 }
"""
SCRIPT = """
const pairs = document.querySelectorAll('.pair');
for (const pair of pairs) {
  const over = pair.querySelector('.over'), range = pair.querySelector('input');
  const cut = () => { over.style.clipPath = 'inset(0 0 0 ' + range.value + '%)'; };
  range.addEventListener('input', cut);
  cut();
}
document.body.dataset.ready = pairs.length;
"""


@dataclass(frozen=True)
class Look:
    """What is told of one frame that was looked at."""

    item: int  # of the BlurDataset
    index: int
    blur_px: float  # length that a hundredth of the moving pixels exceed
    blur_counts: np.ndarray  # pixels between the BLUR_EDGES_PX
    depth_counts: Counter[int]  # pixels by the whole part of log2 of their depth
    effects: tuple[str, ...]
    is_coarse: bool  # a motion was given fewer pieces than its tolerance asks for


def write_page(folder: str | Path, out: str | Path) -> Path:
    """Write the report of a data set's finished frames and return its path.

    Args:
        folder: of the data set.
        out: file to write.

    Raises:
        FrameFileError: a frame that is shown is damaged.
        ManifestError, SpecError, FileNotFoundError: there is no data set, or its lists are damaged.
        ValueError: no frame is finished.

    Source: ours.
    """
    status = read_status(folder)
    entries = read_entries(folder)
    dataset = BlurDataset(folder, keys=("motion", "depth", "shadow"))
    looks = [look_at_frame(dataset, item) for item in _evenly(len(dataset), LOOKED_AT)]
    worst = sorted(looks, key=lambda look: (-look.blur_px, look.index))[:WORST]
    parts = [
        f"<h1>{escape(str(Path(folder).resolve().name))}</h1>",
        _counts(status),
        _throughput(folder),
        _failures(status),
        f"<h2>Distributions</h2><p>Of {len(looks)} frames, evenly chosen from {len(dataset)}.</p>",
        _charts(looks),
        "<h2>Samples</h2><p>Left of the slider sharp, right of it blurred; beside it the motion over "
        "the exposure, and where there are lamps, the share of their light that no shadow takes away.</p>",
        *(_figure(dataset, looks[k], entries[looks[k].index]) for k in _evenly(len(looks), SHOWN)),
        "<h2>Longest blur</h2>",
        *(_figure(dataset, look, entries[look.index]) for look in worst),
        _coarse(looks),
        f"<h2>Configuration</h2><pre>{escape(json.dumps(status.spec.model_dump(), indent=1))}</pre>",
    ]
    out = Path(out)
    write_atomically(out, _document(parts).encode())
    return out


def look_at_frame(dataset: BlurDataset, item: int) -> Look:
    """Return what is told of one frame. Source: ours."""
    frame = dataset[item]
    meta = json.loads(frame["meta"])
    length = np.hypot(*frame["motion"].double().numpy())
    length = length[np.isfinite(length)]
    moving = length[length > 0]
    depth = frame["depth"].double().numpy()
    depth = depth[np.isfinite(depth) & (depth > 0)]
    effects = tuple(name for name, e in meta.get("plan", {}).get("effects", {}).items() if e["simulated"])
    knots = [*meta["meshes"], meta["camera"], *meta.get("lamps", ())]
    return Look(
        item=item,
        index=int(frame["index"]),
        blur_px=float(np.quantile(moving, 0.99)) if moving.size else 0.0,
        blur_counts=np.histogram(length, bins=BLUR_EDGES_PX)[0],
        depth_counts=Counter(np.floor(np.log2(depth)).astype(int).tolist()),
        effects=effects,
        is_coarse=any(part["limit_reached"] for part in knots),
    )


def _evenly(n: int, most: int) -> list[int]:
    """Return up to `most` of the numbers below n, evenly chosen."""
    count = min(n, most)
    return sorted({round(k * (n - 1) / max(count - 1, 1)) for k in range(count)})


def _counts(status: Status) -> str:
    """Return how far the data set is."""
    rows = {
        "frames finished": f"{status.finished} of {status.spec.count}",
        "frames failed": str(len(status.failed)),
        "assets refused": str(len(status.refused)),
        "size": f"{status.spec.width} x {status.spec.height} px",
        "storage": status.spec.storage,
    }
    return (
        "<table>" + "".join(f"<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in rows.items()) + "</table>"
    )


def _throughput(folder: str | Path) -> str:
    """Return how fast the runs made frames, the last RUNS_SHOWN of them as a table, or nothing if none is known."""
    notes, unread = read_log(folder)
    lines = []
    for note in notes[-RUNS_SHOWN:]:
        when = datetime.fromtimestamp(note.started_s, timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
        cells = (when, note.part or "all", note.workers, note.made, note.failed, f"{note.seconds:.1f}")
        cells = (*cells, f"{note.pairs_per_s:.3g}")
        lines.append("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in cells) + "</tr>")
    heads = ("started", "slice", "workers", "pairs made", "failed", "seconds", "pairs per second")
    table = f"<table><tr>{''.join(f'<th>{head}</th>' for head in heads)}</tr>{''.join(lines)}</table>"
    made, seconds = sum(note.made for note in notes), sum(note.seconds for note in notes)
    told = f"{made} pairs in {seconds:.1f} s of {len(notes)} runs; runs that were killed are not in it."
    bad = f"<p class='bad'>{unread} lines of the log of runs cannot be read.</p>" if unread else ""
    return (f"<h2>Throughput</h2><p>{told}</p>{table}" if notes else "") + bad


def _failures(status: Status) -> str:
    """Return the failures as a table, or nothing."""
    rows = [(f"frame {index}", reason) for index, reason in status.failed] + list(status.refused)
    if not rows:
        return ""
    lines = "".join(f"<tr><td>{escape(a)}</td><td class='bad'>{escape(b)}</td></tr>" for a, b in rows[:LISTED])
    more = f"<p>and {len(rows) - LISTED} more</p>" if len(rows) > LISTED else ""
    return f"<h2>Failures</h2><table>{lines}</table>{more}"


def _charts(looks: Sequence[Look]) -> str:
    """Return the histograms."""
    blur = np.sum([look.blur_counts for look in looks], axis=0)
    ends = [f"{low:g} to {high:g}" for low, high in itertools.pairwise(BLUR_EDGES_PX)]
    depth = sum((look.depth_counts for look in looks), Counter())
    effects = Counter(name for look in looks for name in look.effects)
    depth_rows = [(f"{2.0**k:g} to {2.0 ** (k + 1):g}", depth[k]) for k in sorted(depth)]
    return (
        _chart("Length of the blur [px], pixels", list(zip(ends, blur.tolist(), strict=True)))
        + _chart("Depth [scene units], pixels", depth_rows)
        + _chart("Effects simulated, frames", effects.most_common())
    )


def _chart(title: str, rows: Sequence[tuple[str, int]]) -> str:
    """Return a bar chart as SVG."""
    most = max((value for _, value in rows), default=1) or 1
    lines = []
    for k, (name, value) in enumerate(rows):
        y = 30 + 18 * k
        lines.append(f'<text x="96" y="{y + 11}" text-anchor="end">{escape(name)}</text>')
        lines.append(f'<rect x="102" y="{y}" width="{170 * value / most:.1f}" height="14"/>')
        lines.append(f'<text x="{106 + 170 * value / most:.1f}" y="{y + 11}">{value:,}</text>')
    size = f'width="350" height="{40 + 18 * len(rows)}"'
    return f'<svg {size} role="img"><text x="8" y="18">{escape(title)}</text>{"".join(lines)}</svg>'


def _figure(dataset: BlurDataset, look: Look, entry: dict[str, Any]) -> str:
    """Return one frame: sharp and blurred under a slider, its motion, and the shadows that fall if any."""
    files = [read_listed_file(dataset.folder, entry, frame_paths(look.index)[kind]) for kind in ("sharp", "blur")]
    sharp, blur = (_small(decode_png(data)) for data in files)
    planes = dataset[look.item]
    motion = _small(motion_colours(planes["motion"].permute(1, 2, 0)))
    shadow = _small(grey_picture(planes["shadow"][0].clamp(0, 1))) if "shadows" in look.effects else None
    name, effects = f"frame {look.index}", escape(", ".join(look.effects))
    return (
        f'<figure><span class="pair">{_image(sharp, f"{name}, sharp")}{_image(blur, f"{name}, blurred", "over")}'
        f'<input type="range" min="0" max="100" value="50" aria-label="{name}"></span> '
        + _image(motion, f"{name}, motion")
        + (_image(shadow, f"{name}, shadow") if shadow is not None else "")
        + f"<figcaption>{name}: blur up to {look.blur_px:.1f} px; {effects}</figcaption></figure>"
    )


def _coarse(looks: Sequence[Look]) -> str:
    """Return which frames have a motion that is coarser than its tolerance, or nothing."""
    numbers = [str(look.index) for look in looks if look.is_coarse]
    return f"<p class='bad'>Motion coarser than its tolerance: frames {', '.join(numbers)}.</p>" if numbers else ""


def _small(pixels: np.ndarray) -> np.ndarray:
    """Return a picture that is at most PICTURE_PX wide and high."""
    height, width = pixels.shape[:2]
    scale = PICTURE_PX / max(width, height)
    return pixels if scale >= 1 else shrink(pixels, max(1, round(width * scale)), max(1, round(height * scale)))


def _image(pixels: np.ndarray, name: str, kind: str = "under") -> str:
    """Return a picture as an element."""
    data = base64.b64encode(encode_png(pixels)).decode()
    height, width = pixels.shape[:2]
    size = f'width="{width}" height="{height}"'
    return f'<img class="{kind}" {size} alt="{escape(name)}" src="data:image/png;base64,{data}">'


def _document(parts: Sequence[str]) -> str:
    """Return the whole page."""
    style, script = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (STYLE, SCRIPT))
    policy = (
        f"default-src 'none'; img-src data:; style-src 'sha256-{style}'; script-src 'sha256-{script}'; "
        "base-uri 'none'; form-action 'none'"
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        f"<title>Data set</title><style>{STYLE}</style></head><body>\n"
        + "\n".join(part for part in parts if part)
        + f"\n<script>{SCRIPT}</script></body></html>\n"
    )
