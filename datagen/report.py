"""Report: a contact sheet of a data set, to be looked at, and what its frames called for.

Before: dataset.py, colour.py, pictures.py.  After: runs.py.
Symbols: H, W size of a cell. One row a frame: sharp, blurred, what filters make of it if any, motion, depth, alpha, and
shadow if any frame has one.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datagen.colour import bytes_from_linear
from datagen.dataset import BlurDataset
from datagen.entries import read_entries
from datagen.pictures import encode_png, shrink, write_labels
from datagen.writer import write_atomically

SHEET_NAME = "contact_sheet.png"
BASELINE = "baseline_"
COLUMNS = ("sharp", "blurred", "motion", "depth", "alpha")
MAX_ROWS = 12
MAX_CELL_PX = 256
GAP_PX = 6
TITLE_PX = 18
LETTER_PX = 6  # width of a letter of the labels, about
PAPER = 245  # grey of the sheet


def write_contact_sheet(folder: str | Path) -> Path:
    """Write `contact_sheet.png`: up to MAX_ROWS frames, evenly chosen, each motion picture on its own scale.

    Raises:
        FrameFileError: a frame cannot be read.

    Source: ours.
    """
    baselines = [key for key in BlurDataset(folder, keys=()).planes if key.startswith(BASELINE)]
    shadow = ("shadow",) if any("shadows" in entry["effects"] for entry in read_entries(folder).values()) else ()
    columns = (*COLUMNS[:2], *baselines, *COLUMNS[2:], *shadow)
    dataset = BlurDataset(folder, keys=columns)
    n_rows = min(MAX_ROWS, len(dataset))
    chosen = sorted({round(k * (len(dataset) - 1) / max(n_rows - 1, 1)) for k in range(n_rows)})
    rows, labels, top = [], [], TITLE_PX
    for item in chosen:
        frame = dataset[item]
        pictures = frame_pictures(frame)
        height, width = pictures["sharp"].shape[:2]
        scale = min(1.0, MAX_CELL_PX / max(width, height))
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        cells = [pictures[c] if scale == 1 else shrink(pictures[c], *size) for c in columns]
        rows.append(_beside(cells))
        meta = json.loads(frame["meta"])
        fastest = float(frame["motion"].nan_to_num().norm(dim=0).max())
        kinds = " ".join(str(v) for k, v in sorted(meta["scene"].items()) if isinstance(v, str))
        texts = {"sharp": f"{frame['index']}", "blurred": kinds, "motion": f"up to {fastest:.1f} px"}
        texts |= {"depth": "near is bright", "alpha": "white is opaque"}
        texts |= {"shadow": "white: no shadow"} if shadow else {}
        places = {name: GAP_PX + k * (size[0] + GAP_PX) for k, name in enumerate(columns)}
        fits = size[0] // LETTER_PX  # a longer text would run into the next one
        labels += [(places[name], top + size[1] + 2, text[:fits]) for name, text in texts.items()]
        top += size[1] + TITLE_PX
    labels += [(x, 3, name.removeprefix(BASELINE)) for name, x in places.items()]
    sheet = np.full((top + 2, rows[0].shape[1], 3), PAPER, np.uint8)
    y = TITLE_PX
    for row in rows:
        sheet[y : y + row.shape[0]] = row
        y += row.shape[0] + TITLE_PX
    path = Path(folder) / SHEET_NAME
    write_atomically(path, encode_png(write_labels(sheet, labels)))
    return path


def effect_shares(entries: Iterable[dict[str, Any]]) -> dict[str, float]:
    """Return the share of frames that called for each effect, by its name, the most frequent first.

    Args:
        entries: of the manifest.

    Source: ours.
    """
    counts: Counter[str] = Counter()
    n_frames = 0
    for entry in entries:
        counts.update(entry["effects"])
        n_frames += 1
    return {name: n / n_frames for name, n in sorted(counts.items(), key=lambda item: (-item[1], item[0]))}


def frame_pictures(frame: dict[str, Tensor]) -> dict[str, np.ndarray]:
    """Return each column's (H, W, 3) uint8 picture of one item of a BlurDataset. Source: ours."""
    depth = frame["depth"][0]
    seen = torch.isfinite(depth)
    shade = torch.zeros_like(depth)
    if seen.any():
        inverse = torch.where(seen, 1 / depth.clamp(min=1e-6), torch.zeros_like(depth))
        low, high = inverse[seen].min(), inverse[seen].max()
        shade = torch.where(seen, 0.12 + 0.88 * (inverse - low) / (high - low).clamp(min=1e-9), shade)
    images = [key for key in frame if key in ("sharp", "blurred") or key.startswith(BASELINE)]
    return {key: bytes_from_linear(frame[key].permute(1, 2, 0)).numpy() for key in images} | {
        "motion": motion_colours(frame["motion"].permute(1, 2, 0)),
        "depth": grey_picture(shade),
        **{name: grey_picture(frame[name][0].clamp(0, 1)) for name in ("alpha", "shadow") if name in frame},
    }


def motion_colours(motion_px: Tensor) -> np.ndarray:
    """Return (H, W, 3) uint8: the direction of motion (H, W, 2) as hue, its length as strength, white where still.

    The fastest hundredth of the moving pixels saturates the scale; NaN is black. Source: ours.
    """
    unknown = motion_px.isnan().any(-1)
    x, y = motion_px.nan_to_num().unbind(-1)
    length = torch.hypot(x, y)
    moving = length[length > 1e-3]
    full = float(torch.quantile(moving[:: max(1, len(moving) // 100_000)], 0.99)) if len(moving) else 1.0
    strength = (length / max(full, 1e-6)).clamp(0, 1).unsqueeze(-1)
    angle = torch.atan2(y, x)
    turns = torch.tensor([0.0, 2 * torch.pi / 3, 4 * torch.pi / 3])
    wheel = 0.5 + 0.5 * torch.cos(angle.unsqueeze(-1) - turns)
    rgb = (1 - strength) + strength * wheel
    rgb[unknown] = 0
    return (rgb * 255).round().to(torch.uint8).numpy()


def grey_picture(plane: Tensor) -> np.ndarray:
    """Return a (H, W) plane in [0, 1] as a grey (H, W, 3) uint8 picture. Source: ours."""
    return (plane * 255).round().to(torch.uint8).unsqueeze(-1).expand(-1, -1, 3).numpy()


def _beside(cells: list[np.ndarray]) -> np.ndarray:
    """Return pictures of one height side by side with gaps."""
    gap = np.full((cells[0].shape[0], GAP_PX, 3), PAPER, np.uint8)
    return np.concatenate([piece for cell in cells for piece in (gap, cell)] + [gap], axis=1)
