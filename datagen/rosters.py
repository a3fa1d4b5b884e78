"""Rosters: which of people's files can be used, and the hash of all that they hold.

Before: surveys.py, assets.py, sequences.py, animated.py.  After: scenes.py.
Source: ours.
"""

from __future__ import annotations

from pathlib import Path

from datagen.animated import ANIMATED_SUFFIXES, AnimatedAsset, is_animated, load_animated
from datagen.assets import MESH_SUFFIXES, Roster, load_mesh, tensors_sha256
from datagen.formats import MeshError
from datagen.sequences import CACHE_SUFFIX, survey_sequence
from datagen.surveys import Kind, survey_folder
from datagen.usd_files import USD_SUFFIXES, vet_usd

UNREAD_SUFFIXES = (
    ".dae", ".fbx", ".3ds", ".blend", ".x", ".abc", ".usdz", ".3mf", ".lwo", ".ac", ".ase",
    ".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar",
)  # fmt: skip
MESHES = Kind(
    "mesh",
    (*MESH_SUFFIXES, *USD_SUFFIXES, CACHE_SUFFIX),
    (*MESH_SUFFIXES, *ANIMATED_SUFFIXES, CACHE_SUFFIX),
    UNREAD_SUFFIXES,
    MeshError,
)


def survey_meshes(folder: str | Path) -> Roster:
    """Read every mesh file under `folder` once and return which can be used.

    Raises:
        MeshError: none can, or there is none.

    Source: ours.
    """
    return survey_folder(folder, MESHES, _content)


def survey_played(path: str | Path) -> Roster:
    """Read what is played through time, an animated file or a sequence, once and return its hash.

    Raises:
        MeshError: it cannot be used.

    Source: ours.
    """
    if is_animated(path):
        asset = _vetted(Path(path))
        return Roster((asset.name,), (), asset.sha256)
    return survey_sequence(path)


def _vetted(path: Path) -> AnimatedAsset:
    """Return an animated file, if need be after another process has read it first."""
    if path.suffix.lower() in USD_SUFFIXES:
        vet_usd(path)
    return load_animated(str(path))


def _content(path: Path) -> bytes:
    """Return the hash of what a mesh file holds, animated or not."""
    if is_animated(path):
        return bytes.fromhex(_vetted(path).sha256)
    if path.suffix.lower() == CACHE_SUFFIX:
        return bytes.fromhex(survey_sequence(path).sha256)
    asset = load_mesh(str(path))
    return tensors_sha256(asset.vertices, asset.faces, asset.color, asset.opacity)
