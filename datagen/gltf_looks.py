"""glTF looks: the colours of a primitive's faces, from its material, its vertices and its texture.

Before: gltf.py, colour.py.  After: gltf_rigs.py.
A texture counts at the centre of each face only. Symbols: V vertices, F faces.
Source: the glTF 2.0 specification, section 3.9.
"""

from __future__ import annotations

import io
import warnings
from typing import Any

import numpy as np
import torch
from PIL import Image

from datagen.colour import linear_from_srgb
from datagen.formats import short_reason
from datagen.gltf import GltfFile

MAX_TEXELS = 2**26  # of a picture, 8192 x 8192
PICTURE_KINDS = ("PNG", "JPEG")  # all that glTF 2.0 has; other decoders need not be trusted


def face_looks(file: GltfFile, primitive: dict[str, Any], faces: np.ndarray, n_vertices: int) -> np.ndarray | None:
    """Return (F, 4) linear colours and opacity, or None if the file says nothing of them.

    Args:
        file: the file.
        primitive: of it.
        faces: (F, 3), checked.
        n_vertices: of the primitive.

    Raises:
        MeshError: they are not as the format has them.

    Source: the glTF 2.0 specification, section 3.9.
    """
    attributes = primitive["attributes"]
    if "material" not in primitive and "COLOR_0" not in attributes:
        return None
    rgba = np.ones((len(faces), 4))
    is_clear = False
    if "material" in primitive:
        material = file.item("materials", primitive["material"])
        is_clear = material.get("alphaMode") == "BLEND"
        surface = file.mapping("pbrMetallicRoughness", material.get("pbrMetallicRoughness", {}))
        rgba *= file.numbers("baseColorFactor", surface.get("baseColorFactor", [1, 1, 1, 1]), 4)
        if "baseColorTexture" in surface:
            texture = file.mapping("baseColorTexture", surface["baseColorTexture"])
            rgba *= _texture_at(file, texture, attributes, (faces, n_vertices))
    if "COLOR_0" in attributes:
        colours = file.accessor(attributes["COLOR_0"], ("VEC3", "VEC4"))
        if len(colours) != n_vertices:
            raise file.fail(f"COLOR_0: expected {n_vertices} rows, got {len(colours)}")
        rgba[:, : colours.shape[1]] *= colours[faces].mean(1)
    if not is_clear:
        rgba[:, 3] = 1
    return rgba.clip(0, 1)


def _texture_at(
    file: GltfFile, texture: dict[str, Any], attributes: dict[str, Any], geometry: tuple[np.ndarray, int]
) -> np.ndarray:
    """Return (F, 4) linear texels at the faces' centres."""
    faces, n_vertices = geometry
    name = f"TEXCOORD_{file.whole('texCoord', texture.get('texCoord', 0), 99)}"
    source = file.item("textures", texture.get("index")).get("source")
    if name not in attributes or source is None:
        return np.ones((len(faces), 4))
    places = file.accessor(attributes[name], ("VEC2",))
    if len(places) != n_vertices:
        raise file.fail(f"{name}: expected {n_vertices} rows, got {len(places)}")
    picture = _picture(file, file.whole("textures.source", source, len(file.listed("images")) - 1))
    height, width = picture.shape[:2]
    centres = places[faces].mean(1) % 1.0  # repeated; v = 0 is the top row
    columns = np.minimum((centres[:, 0] * width).astype(np.int64), width - 1)
    rows = np.minimum((centres[:, 1] * height).astype(np.int64), height - 1)
    texels = torch.from_numpy(picture[rows, columns].astype(np.float64) / 255)
    rgb = linear_from_srgb(texels[:, :3].contiguous())
    return torch.cat([rgb, texels[:, 3:]], 1).numpy()


def _picture(file: GltfFile, index: int) -> np.ndarray:
    """Return (H, W, 4) uint8, sRGB and opacity; the last one is kept, as primitives share it."""
    if file.picture is not None and file.picture[0] == index:
        return file.picture[1]
    entry, name = file.item("images", index), f"images[{index}]"
    if isinstance(entry.get("uri"), str):
        data = file.companion(entry["uri"])
    else:
        data = file.view_bytes(entry.get("bufferView"))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the size is checked here
            picture = Image.open(io.BytesIO(data), formats=PICTURE_KINDS)
            if not 0 < picture.width * picture.height <= MAX_TEXELS:
                raise file.fail(f"{name}: expected at most {MAX_TEXELS} texels, got {picture.width} x {picture.height}")
            file.picture = index, np.asarray(picture.convert("RGBA"))
            return file.picture[1]
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError, OverflowError) as error:
        raise file.fail(f"{name}: expected a readable picture, got {short_reason(error)}") from None
