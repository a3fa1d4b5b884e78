"""Photos: people's picture files as linear light, read with distrust.

Before: pictures.py, colour.py, surveys.py.  After: wraps.py, scenes.py.
Files are taken as sRGB, whatever profile they carry, the way up that their EXIF note says, the first frame of several.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from datagen.assets import Roster, file_state
from datagen.colour import linear_from_srgb
from datagen.formats import MeshError, check_size, short_reason
from datagen.pictures import PHOTO_FORMATS, PhotoError, decode_photo, resample
from datagen.surveys import Kind, survey_folder

PHOTO_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp")
UNREAD_SUFFIXES = (".tif", ".tiff", ".exr", ".hdr", ".gif", ".heic", ".avif", ".svg", ".jp2", ".psd", ".raw", ".dng")
TEXTURE_PX = 512  # longer textures are made smaller: mip levels and their bends cost memory and time


class PictureError(MeshError):
    """A picture file that cannot be used, and why."""


PICTURES = Kind("picture", PHOTO_SUFFIXES, PHOTO_SUFFIXES, UNREAD_SUFFIXES, PictureError)


def survey_photos(folder: str | Path) -> Roster:
    """Read every picture file under `folder` once and return which can be used.

    Raises:
        PictureError: none can, or there is none.

    Source: ours.
    """
    return survey_folder(folder, PICTURES, _content)


def _content(path: Path) -> bytes:
    pixels = read_photo(path)
    return str(pixels.shape).encode() + pixels.tobytes()


def read_photo(path: Path) -> np.ndarray:
    """Return the (h, w, 3) uint8 sRGB pixels of a picture file.

    Raises:
        PictureError: missing, empty, too large, damaged, cut short, not opaque, or not of 8 bits a channel.

    Source: ours.
    """
    try:
        check_size(path)
        return decode_photo(path.read_bytes())
    except (MeshError, PhotoError) as error:
        reason = error.reason if isinstance(error, MeshError) else str(error)
        raise PictureError(path, reason) from None
    except OSError as error:
        raise PictureError(path, f"expected a readable {'/'.join(PHOTO_FORMATS)}, got {short_reason(error)}") from None


def load_texture(path: str) -> Tensor:
    """Return a picture file as an (h, w, 3) float32 linear texture, at most TEXTURE_PX long.

    Raises:
        PictureError: as `read_photo`.

    Source: ours.
    """
    return _texture(path, file_state(Path(path)))


def load_background(path: str, size: tuple[int, int], place: tuple[float, float], is_mirrored: bool) -> Tensor:
    """Return the part of a picture file that fills an image, as (H, W, 3) float32 linear.

    Args:
        path: of the file.
        size: width and height of the image [px].
        place: where the part lies in what is left over along x and y, each from 0 to 1.
        is_mirrored: left and right swapped.

    Raises:
        PictureError: as `read_photo`.

    Source: ours.
    """
    photo = _linear(path)
    height, width = photo.shape[:2]
    scale = min(width / size[0], height / size[1])  # picture pixels of an image pixel
    part = (size[0] * scale, size[1] * scale)
    left, top = (width - part[0]) * place[0], (height - part[1]) * place[1]
    image = resample(photo, size, (left, top, left + part[0], top + part[1]))
    return torch.from_numpy(image[:, ::-1].copy() if is_mirrored else image)


@functools.lru_cache(maxsize=16)  # clips of a worker draw from the same few files
def _texture(path: str, state: tuple[int, int]) -> Tensor:
    """Return the texture of a file in a certain state."""
    photo = _linear(path)
    height, width = photo.shape[:2]
    shrink = min(1.0, TEXTURE_PX / max(height, width))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    return torch.from_numpy(resample(photo, size, (0.0, 0.0, float(width), float(height))))


def _linear(path: str) -> np.ndarray:
    """Return the (h, w, 3) float32 linear light of a file."""
    pixels = read_photo(Path(path))
    table = linear_from_srgb((torch.arange(256, dtype=torch.float64) / 255).unsqueeze(1).expand(256, 3))[:, 0]
    return table.to(torch.float32).numpy()[pixels]
