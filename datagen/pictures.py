"""Pictures: 8-bit PNG, labels, and people's picture files (the only door to Pillow).

Before: nothing.  After: writer.py, report.py, pages.py, photos.py.
"""

from __future__ import annotations

import io
import warnings

import numpy as np
from PIL import Image, ImageDraw, ImageOps, UnidentifiedImageError

PHOTO_FORMATS = ("PNG", "JPEG", "WEBP", "BMP")
PHOTO_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr")  # of 8 bits a channel at most
PNG_DEPTH_AT = 24  # of the header, which comes first
MAX_PHOTO_PIXELS = 60_000_000  # as linear light 12 bytes each


class PhotoError(ValueError):
    """A picture file that cannot be used, and why."""


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


def decode_photo(data: bytes) -> np.ndarray:
    """Return the (h, w, 3) uint8 sRGB pixels of a picture file's bytes, the way up that its EXIF note says.

    Raises:
        PhotoError: damaged, cut short, of another format, too large, not opaque, or of more than 8 bits a channel.

    Source: ours.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the gate below decides, not the parser
            with Image.open(io.BytesIO(data), formats=PHOTO_FORMATS) as image:
                if image.width * image.height > MAX_PHOTO_PIXELS:
                    raise PhotoError(f"expected at most {MAX_PHOTO_PIXELS} pixels, got {image.width} x {image.height}")
                depth = data[PNG_DEPTH_AT] if image.format == "PNG" else 8  # Pillow makes 16 bits of colour 8 unasked
                if depth > 8:
                    raise PhotoError(f"expected 8 bits a channel, got {depth}")
                if image.mode not in PHOTO_MODES:
                    raise PhotoError(f"expected 8 bits a channel, got pixels of mode {image.mode}")
                image.load()
                upright = ImageOps.exif_transpose(image)
                if upright.mode in ("LA", "PA", "RGBA") or "transparency" in upright.info:
                    least = upright.convert("RGBA").getchannel("A").getextrema()[0]
                    if least < 255:
                        raise PhotoError(f"expected an opaque picture, got an opacity of {least} of 255")
                return np.asarray(upright.convert("RGB"))
    except PhotoError:
        raise
    except UnidentifiedImageError:  # its text tells the address of our buffer
        raise PhotoError(f"expected a readable {', '.join(PHOTO_FORMATS)}, got none of them") from None
    except Exception as error:  # the parsers raise OSError, ValueError, SyntaxError, struct.error and more
        why = " ".join(str(error).split())[:200]
        raise PhotoError(f"expected a readable {', '.join(PHOTO_FORMATS)}, got {type(error).__name__}: {why}") from None


def resample(image: np.ndarray, size: tuple[int, int], part: tuple[float, float, float, float]) -> np.ndarray:
    """Return a part of an (h, w, 3) float32 image at another size (width, height) [px], filtered as (H, W, 3) float32.

    Args:
        image: linear light.
        size: width and height of the result [px].
        part: left, top, right and bottom of the part [px].

    Source: a triangle as wide as the larger of both pixels, as Pillow has it.
    """
    planes = [Image.fromarray(np.ascontiguousarray(image[..., k])) for k in range(3)]
    return np.stack([np.asarray(p.resize(size, Image.Resampling.BILINEAR, box=part)) for p in planes], -1)
