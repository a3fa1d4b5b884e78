"""Pictures: 8-bit PNG and labels (the only door to Pillow).

Before: nothing.  After: writer.py, report.py, pages.py.
"""

from __future__ import annotations

import io

import numpy as np
from PIL import Image, ImageDraw


def encode_png(pixels: np.ndarray) -> bytes:
    """Return an (H, W, 3) uint8 picture as PNG bytes, the same for the same pixels.

    Raises:
        ValueError: another shape or dtype.

    Source: ours.
    """
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8:
        raise ValueError(f"pixels: expected (H, W, 3) uint8, got {pixels.shape} {pixels.dtype}")
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()


def decode_png(data: bytes) -> np.ndarray:
    """Return the (H, W, 3) uint8 pixels of what `encode_png` returned. Source: ours."""
    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        return np.asarray(image)


def write_labels(pixels: np.ndarray, labels: list[tuple[int, int, str]], shade: int = 40) -> np.ndarray:
    """Return the picture with short texts at (x, y) [px].

    Args:
        pixels: (H, W, 3) uint8.
        labels: left, top and text of each.
        shade: grey of the text, 0 to 255.

    Source: ours.
    """
    image = Image.fromarray(np.ascontiguousarray(pixels))
    draw = ImageDraw.Draw(image)
    for x, y, text in labels:
        draw.text((x, y), text, fill=(shade, shade, shade))
    return np.asarray(image)


def shrink(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the (H, W, 3) uint8 picture at a smaller size [px], averaged. Source: ours."""
    image = Image.fromarray(np.ascontiguousarray(pixels))
    return np.asarray(image.resize((width, height), Image.Resampling.BOX))
