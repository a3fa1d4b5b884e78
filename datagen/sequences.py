"""Sequences: one mesh whose vertices move from frame to frame, from a `.npz`, a folder of files or one mesh file.

Before: formats.py, assets.py.  After: rosters.py, scenes.py.
Symbols: V vertices, F faces, P frames.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from datagen.assets import (
    MESH_SUFFIXES,
    Roster,
    check_geometry,
    file_state,
    normalise,
    parse_mesh,
    tensors_sha256,
)
from datagen.formats import MAX_FILE_BYTES, MAX_NUMBERS, MeshError, check_size, short_reason

CACHE_SUFFIX = ".npz"


@dataclass(frozen=True, eq=False)
class SequenceAsset:
    """Frames of one mesh, moved to the origin and scaled so that all of them fit a radius of 1."""

    name: str
    positions: Tensor  # (P, V, 3) float64
    faces: Tensor  # (F, 3) int64
    color: Tensor | None  # (F, 3) float64 linear, or none
    notes: tuple[str, ...]


def survey_sequence(path: str | Path) -> Roster:
    """Read a sequence once and return its hash.

    Raises:
        MeshError: it cannot be used.

    Source: ours.
    """
    asset = load_sequence(str(path))
    digest = tensors_sha256(asset.positions, asset.faces, asset.color).hex()
    return Roster((asset.name,), (), digest)


def load_sequence(path: str) -> SequenceAsset:
    """Return a sequence: a `.npz` with `vertices` (P, V, 3) and `faces` (F, 3), a folder of mesh files with equal
    faces (one per frame, in the order of the numbers in their names), or one mesh file, which stands still.

    Raises:
        MeshError: it cannot be used.

    Source: ours.
    """
    place = Path(path)
    files = [place]
    if place.is_dir():  # what frames may name beside them counts too, but need not be there
        frames = _frame_names(place)
        files = [file for file in sorted(place.iterdir()) if file.name in frames or file.exists()]
    return _load_sequence(path, tuple(file_state(file) for file in files))


@functools.lru_cache(maxsize=2)  # every clip plays the same one
def _load_sequence(path: str, states: tuple[tuple[int, int], ...]) -> SequenceAsset:
    """Return the sequence of files in certain states."""
    place = Path(path)
    if place.is_dir():
        return _load_frames(place)
    if place.suffix.lower() != CACHE_SUFFIX:
        vertices, faces, color, _, notes = parse_mesh(place)
        note = "one mesh file: a single frame, so the mesh itself stands still"
        return SequenceAsset(place.name, normalise(path, vertices[None], faces), faces, color, (*notes, note))
    check_size(place)
    try:
        with place.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            if (size := sum(part.file_size for part in archive.zip.infolist())) > MAX_FILE_BYTES:
                raise MeshError(path, f"expected at most {MAX_FILE_BYTES} bytes when unpacked, got {size}")
            arrays = {name: archive[name] for name in ("vertices", "faces") if name in archive.files}
    except MeshError:
        raise
    except (OSError, ValueError, KeyError, EOFError, NotImplementedError, SyntaxError) as error:
        raise MeshError(path, f"expected a readable .npz file without pickles, got {short_reason(error)}") from None
    except Exception as error:  # zipfile and zlib raise their own kinds on broken archives
        raise MeshError(path, f"expected a readable .npz file, got {short_reason(error)}") from None
    for name in ("vertices", "faces"):
        if name not in arrays:
            raise MeshError(path, f"{name}: expected an array of that name, got none")
    positions, faces = arrays["vertices"], arrays["faces"]
    if positions.ndim != 3 or positions.shape[-1] != 3 or positions.dtype.kind != "f":
        raise MeshError(path, f"vertices: expected (frames, V, 3) float, got {positions.shape} {positions.dtype}")
    if positions.size > MAX_NUMBERS:
        raise MeshError(path, f"vertices: expected at most {MAX_NUMBERS} numbers in all, got {positions.size}")
    if len(positions) < 1:
        raise MeshError(path, "vertices: expected at least one frame, got none")
    flat, indices = check_geometry(path, positions.reshape(-1, 3), faces, positions.shape[1])
    return SequenceAsset(place.name, normalise(path, flat.reshape(positions.shape), indices), indices, None, ())


def _load_frames(folder: Path) -> SequenceAsset:
    """Return the mesh files of a folder as the frames of one mesh."""
    names = _frame_names(folder)
    if not names:
        raise MeshError(folder, f"expected frames as {', '.join(MESH_SUFFIXES)} files, got none")
    frames, first = [], None
    for name in names:
        vertices, faces, color, _, notes = parse_mesh(folder / name)
        first = first or (faces, color, notes)
        if not torch.equal(faces, first[0]) or (frames and vertices.shape != frames[0].shape):
            raise MeshError(folder / name, f"expected the vertices and faces of {names[0]}, got others")
        frames.append(vertices)
    return SequenceAsset(folder.name, normalise(folder, torch.stack(frames), first[0]), *first)


def _frame_names(folder: Path) -> list[str]:
    """Return the mesh files directly in a folder, ordered by the numbers in their names."""
    names = [p.name for p in folder.iterdir() if p.suffix.lower() in MESH_SUFFIXES and not p.is_dir()]
    return sorted(names, key=lambda n: ([int(d) for d in re.findall(r"\d+", n)], n))
