"""The page that shows what accuracy costs in time: plots, tables and images in one HTML file that opens offline.

Used by accuracy_vs_time.py.
"""

from __future__ import annotations

import base64
import html
import io
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from torch import Tensor

from datagen.colour import bytes_from_linear
from datagen.pictures import encode_png, write_labels

mpl.use("agg")
from matplotlib import pyplot

ERROR_SCALE = 4  # of the error maps: white is a difference of a quarter in linear light, on every page
FLOOR = 1e-7  # least error that is drawn
STYLES = {
    "exact": ("*", "#d62728"),
    "linear": ("P", "#ff7f0e"),
    "adaptive": ("o", "#ff7f0e"),
    "mean of N": ("s", "#1f77b4"),
    "Halton N": ("v", "#17becf"),
    "stochastic N": ("^", "#9467bd"),
    "directional": ("x", "#7f7f7f"),
    "mcguire2012": ("D", "#2ca02c"),
    "guertin2014": ("D", "#8c564b"),
    "guertin2015": ("D", "#e377c2"),
    "guertin2015, arcs by time": ("D", "#bcbd22"),
}
STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem;color:#222}
img{max-width:100%}table{border-collapse:collapse;font-size:13px}td,th{padding:.15rem .6rem;text-align:right}
td:first-child,th:first-child{text-align:left}tr:nth-child(even){background:#f3f3f3}figure{margin:1rem 0}"""


def file_name(scene: str) -> str:
    """Return a scene's name as that of a file."""
    return scene.replace(" ", "_")


def encode_sheet(images: dict[str, Tensor]) -> bytes:
    """Return a PNG: a scene's images side by side, and below each the error against the first, on a fixed scale."""
    exact = next(iter(images.values()))
    columns = []
    for name, image in images.items():
        title = np.full((16, image.shape[1], 3), 255, dtype=np.uint8)
        off = (255 * (ERROR_SCALE * (image - exact).abs()).clamp(0, 1)).round().to(torch.uint8).numpy()
        cell = [write_labels(title, [(3, 2, name)]), bytes_from_linear(image).numpy(), off]
        columns.append(np.concatenate(cell))
    return encode_png(np.concatenate(columns, axis=1))


def plot(points: dict[str, list[tuple[float, float]]], title: str, joined: tuple[str, ...] = ()) -> bytes:
    """Return an SVG of error against time, both on log scales.

    Args:
        points: {family: [(time relative to the exact frame, RMSE), ...]}.
        title: of the plot.
        joined: families whose points are joined by lines.
    """
    figure, axes = pyplot.subplots(figsize=(8, 5))
    for family, pairs in points.items():
        marker, colour = STYLES[family]
        time_ratio, rmse = zip(*sorted(pairs), strict=True)
        line = "-" if family in joined else "none"
        drawn = [max(e, FLOOR) for e in rmse]
        axes.plot(time_ratio, drawn, linestyle=line, marker=marker, color=colour, label=family, markersize=6)
    axes.set(
        xscale="log", yscale="log", title=title, xlabel="CPU time, of the exact frame's", ylabel="RMSE, linear RGB"
    )
    axes.grid(visible=True, which="major", alpha=0.3)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", bbox_inches="tight", metadata={"Date": None})
    pyplot.close(figure)
    return buffer.getvalue()


def points_of(record: dict[str, Any]) -> dict[str, list[tuple[float, float]]]:
    """Return what `plot` draws of a scene; the exact frame stands at its distance to the check."""
    rows = record["methods"]
    exact_s = rows["exact"]["time_s"]
    points: dict[str, list[tuple[float, float]]] = {}
    for row in rows.values():
        rmse = record["check"]["rmse"] if row["family"] == "exact" else row["rmse"]
        points.setdefault(row["family"], []).append((row["time_s"] / exact_s, rmse))
    return points


def write_page(folder: Path, results: dict[str, Any]) -> Path:
    """Write the plots and index.html beside results.json and return the page's path."""
    everything: dict[str, list[tuple[float, float]]] = {}
    parts = []
    for name, record in results["scenes"].items():
        points = points_of(record)
        for family, pairs in points.items():
            everything.setdefault(family, []).extend(pairs)
        svg = plot(points, name, tuple(f for f in points if len(points[f]) > 1))
        (folder / f"{file_name(name)}.svg").write_bytes(svg)
        sheet = (folder / f"{file_name(name)}.png").read_bytes()
        parts.append(
            f"<h2>{html.escape(name)}</h2>{_figure(svg, 'svg+xml', f'error against time: {name}')}"
            f"{_figure(sheet, 'png', f'images of {name}, and {ERROR_SCALE} times their errors')}{_table(record)}"
        )
    svg = plot(everything, "all scenes")
    (folder / "all.svg").write_bytes(svg)
    settings = html.escape(", ".join(f"{k} {v}" for k, v in results["settings"].items()))
    page = (
        "<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'><title>What accuracy costs in time</title>"
        f"<style>{STYLE}</style></head><body><h1>What accuracy costs in time</h1><p>CPU time of one thread, relative "
        "to the exact frame of the same scene; errors against it. The exact frame itself is drawn at its distance to "
        "the mean of many sharp images, which is mostly that mean's own error. The exact frame, means, random samples "
        "and the sharp image that filters start from are compiled; the linear and adaptive ways and the filters "
        f"themselves are plain torch. {settings}.</p>"
        f"{_figure(svg, 'svg+xml', 'error against time: all scenes')}{_verdicts(results['scenes'])}"
        f"{''.join(parts)}</body></html>"
    )
    place = folder / "index.html"
    place.write_text(page, encoding="utf-8")
    return place


def verdict(record: dict[str, Any]) -> tuple[float, str]:
    """Return the time of the exact frame over that of the mean of 32, and whether it is the faster one, or why not."""
    rows, looks, intervals = record["methods"], record["looks_per_pixel"], record["intervals_per_pixel"]
    ratio = rows["exact"]["time_s"] / rows["mean of 32"]["time_s"]
    if ratio < 1:
        return ratio, "faster than 32 sharp images"
    work = f"{intervals:.1f} intervals a pixel to solve and to order, and {looks:.1f} looks at surfaces"
    return ratio, f"slower: {work}, against 32 looks"


def _verdicts(scenes: dict[str, Any]) -> str:
    """Return, scene by scene, whether the exact frame costs less than 32 sharp images, as HTML."""
    heads = "<th>scene</th><th>exact / mean of 32</th><th>difference to the check</th><th></th>"
    lines = [f"<h2>The exact frame beside 32 sharp images</h2><table><tr>{heads}</tr>"]
    for name, record in scenes.items():
        ratio, text = verdict(record)
        off = f"{record['check']['rmse']:.1e}, by the mean of {record['check_times']}"
        cells = (name, f"{ratio:.2f}x", off, text)
        lines.append(f"<tr>{''.join(f'<td>{html.escape(c)}</td>' for c in cells)}</tr>")
    return "".join([*lines, "</table>"])


def _figure(data: bytes, kind: str, caption: str) -> str:
    """Return an image as HTML that holds its bytes."""
    text = base64.b64encode(data).decode()
    caption = html.escape(caption)
    image = f"<img alt='{caption}' src='data:image/{kind};base64,{text}'>"
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _table(record: dict[str, Any]) -> str:
    """Return a scene's numbers as an HTML table."""
    exact_s = record["methods"]["exact"]["time_s"]
    lines = ["<table><tr><th>method</th><th>time</th><th>RMSE</th><th>PSNR</th><th>SSIM</th><th>FLIP</th></tr>"]
    for name, row in record["methods"].items():
        psnr = f"{row['psnr_db']:.1f} dB" if "psnr_db" in row else ""
        cells = (
            f"{row['time_s'] / exact_s:.2f}x",
            f"{row['rmse']:.1e}",
            psnr,
            f"{row['ssim']:.4f}",
            f"{row['flip']:.4f}",
        )
        lines.append(f"<tr><td>{html.escape(name)}</td>{''.join(f'<td>{c}</td>' for c in cells)}</tr>")
    check = record["check"]
    name = f"exact, against the mean of {record['check_times']}"
    cells = ("", f"{check['rmse']:.1e}", f"{check['psnr_db']:.1f} dB", f"{check['ssim']:.4f}", f"{check['flip']:.4f}")
    lines.append(f"<tr><td>{name}</td>{''.join(f'<td>{c}</td>' for c in cells)}</tr>")
    return "".join([*lines, "</table>"])
