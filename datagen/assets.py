"""Assets: people's mesh files, read with distrust (the only door to trimesh).

Before: colour.py, formats.py.  After: sequences.py, animated.py, rosters.py, scenes.py.
Symbols: V vertices, F faces. Nothing is merged, renumbered or repaired: order is kept.
"""

from __future__ import annotations

import functools
import hashlib
import io
import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from datagen.colour import linear_from_srgb
from datagen.formats import (
    MeshError,
    announced_faces,
    check_size,
    join_looks,
    printable,
    read_checked,
    short_reason,
    utf8_text,
)

MESH_SUFFIXES = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf")
MAX_FACES = 50_000_000
MAX_VERTICES = 25_000_000
MAX_COORDINATE = 1e6  # beyond it float32 positions are coarser than a thousandth
MAX_TEXELS = 80 * 2**20  # of a file's textures, unpacked 320 MiB
SMALLEST_EXTENT = 1e-12  # of what is scaled to a radius of 1: below it there is rounding only
FACES_AT_ONCE = 1_000_000
NO_SRGB_LOOK = np.array([[0.7, 0.7, 0.7, 1.0]])  # of parts without a colour beside parts that have one
DEFAULT_GREYS = ((102, 102, 102), (128, 128, 128))  # trimesh's own colour where a file has none


@dataclass(frozen=True, eq=False)
class MeshAsset:
    """A mesh as its file has it, moved to the origin and scaled to a bounding radius of 1."""

    name: str
    vertices: Tensor  # (V, 3) float64
    faces: Tensor  # (F, 3) int64
    color: Tensor | None  # (F, 3) float64 linear, or none in the file
    opacity: Tensor | None  # (F,) float64, or none in the file
    notes: tuple[str, ...]  # what in the file is not used


class CompanionFiles(trimesh.resolvers.FilePathResolver):
    """The files beside a mesh file that it may name: nothing above its folder, nothing from a network."""

    def get(self, name: str) -> bytes:
        """Return the bytes of a companion file, the text of a material library made UTF-8. Source: ours."""
        for place in (name.strip(), name.strip().lstrip("/"), Path(name).name):  # where the base class looks
            try:
                found = self.absolute(place)
            except ValueError:  # outside of the folder
                continue
            if found.exists():
                check_size(found)  # a pipe would be waited for
        data = super().get(name)
        return utf8_text(data) if Path(name.strip()).suffix.lower() == ".mtl" else data


@dataclass(frozen=True)
class Roster:
    """The usable files of a folder, and the others with the reason."""

    names: tuple[str, ...]  # relative paths, sorted
    refused: tuple[tuple[str, str], ...]  # (relative path, reason)
    sha256: str  # of the names and contents of the usable ones


def load_mesh(path: str) -> MeshAsset:
    """Return a mesh file, checked and normalised; one that has not changed since is not read again.

    Raises:
        MeshError: not readable, no triangles, NaN, out-of-range indices or values, too large, no extent.

    Source: ours.
    """
    return _load_mesh(path, file_state(Path(path)))


@functools.lru_cache(maxsize=16)  # clips of a worker draw from the same few files
def _load_mesh(path: str, state: tuple[int, int]) -> MeshAsset:
    """Return the mesh of a file in a certain state."""
    vertices, faces, color, opacity, notes = parse_mesh(Path(path))
    vertices = normalise(path, vertices[None], faces)[0]
    return MeshAsset(Path(path).name, vertices, faces, color, opacity, notes)


def file_state(path: Path) -> tuple[int, int]:
    """Return time of change [ns] and size [bytes] of a file or folder, or raise MeshError. Source: ours."""
    try:
        found = path.stat()
    except OSError as error:
        raise MeshError(path, f"expected a file, got {short_reason(error)}") from None
    return found.st_mtime_ns, found.st_size


def files_under(folder: str | Path) -> tuple[list[str], list[tuple[str, str]]]:
    """Return the relative paths of all files under a folder, sorted; links to folders are not followed.

    Also the folders in it that cannot be read, with the reason.

    Source: ours.
    """
    found, unread = [], []

    def note(error: OSError) -> None:
        place = Path(error.filename).relative_to(folder).as_posix()
        unread.append((printable(place), f"expected a readable folder, got {error.strerror}"))

    for root, _, files in os.walk(folder, onerror=note, followlinks=False):
        found += [(Path(root) / f).relative_to(folder).as_posix() for f in files if not f.startswith(".")]
    return sorted(found), sorted(unread)


def parse_mesh(path: Path) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None, tuple[str, ...]]:
    """Return vertices, faces, colour, opacity and notes of a mesh file, checked, as the file has them.

    Raises:
        MeshError: it cannot be used.

    Source: ours.
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise MeshError(path, f"expected one of {', '.join(MESH_SUFFIXES)}, got {suffix or 'no suffix'}")
    data, notes = read_checked(path)
    options = {"process": False, "allow_remote": False, "resolver": CompanionFiles(str(path))}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the gate below decides, not the parser
            scene = trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], **options)
            _check_pictures(path, scene)
            parts = _parts(path, scene)
    except MeshError:
        raise
    except ModuleNotFoundError as error:
        why = f"a need for {error.name}"
        raise MeshError(path, f"expected a file readable without further packages, got {why}") from None
    except Exception as error:  # the parsers raise ValueError, IndexError, KeyError, UnboundLocalError and more
        raise MeshError(path, f"expected a readable {suffix} file, got {short_reason(error)}") from None
    if not parts:
        raise MeshError(path, "expected triangles, got none")
    announced, found = announced_faces(suffix, data), sum(len(p[1]) for p in parts)
    if found < announced:  # the parser takes a text file that was cut short for a smaller mesh
        raise MeshError(path, f"expected {announced} faces as its header says, got {found}")
    checked = [check_geometry(path, p[0], p[1], len(p[0])) for p in parts]
    starts = np.cumsum([0, *[len(v) for v, _ in checked]])
    faces = torch.cat([f + int(start) for (_, f), start in zip(checked, starts, strict=False)])
    color, opacity = split_looks(join_looks([p[1] for p in parts], [p[2] for p in parts], NO_SRGB_LOOK))
    color = None if color is None else linear_from_srgb(color)
    return torch.cat([v for v, _ in checked]), faces, color, opacity, notes


def split_looks(looks: np.ndarray | None) -> tuple[Tensor | None, Tensor | None]:
    """Return the (F, 3) colours and the (F,) opacity of (F, 4) looks; none if there are none, or all are opaque.

    Source: ours.
    """
    if looks is None:
        return None, None
    rgba = torch.from_numpy(looks)
    return rgba[:, :3].contiguous(), rgba[:, 3].contiguous() if bool((rgba[:, 3] < 1).any()) else None


def _check_pictures(path: Path, scene: Any) -> None:
    """Refuse textures that are larger in all than it is safe to unpack: a few bytes may announce any number."""
    pictures = {id(p): p for g in scene.geometry.values() if (p := _picture(g)) is not None}
    texels = sum(p.width * p.height for p in pictures.values())
    if texels > MAX_TEXELS:
        raise MeshError(path, f"textures: expected at most {MAX_TEXELS} texels in all, got {texels}")


def _picture(geometry: Any) -> Any:
    """Return the picture that a mesh wears, or none."""
    material = getattr(geometry.visual, "material", None) if hasattr(geometry, "visual") else None
    return getattr(material, "image", None) or getattr(material, "baseColorTexture", None)


def _parts(path: Path, scene: Any) -> list[tuple[np.ndarray, np.ndarray, np.ndarray | None]]:
    """Return the parts that have triangles, as `_part` does, or raise MeshError as soon as they are too many."""
    parts, n_vertices, n_faces = [], 0, 0
    worlds: dict[str, np.ndarray] = {}
    for node in sorted(scene.graph.nodes_geometry, key=str):
        part = _part(scene, node, _world(scene.graph, node, worlds))
        if part is None:
            continue
        n_vertices, n_faces = n_vertices + len(part[0]), n_faces + len(part[1])
        if n_faces > MAX_FACES or n_vertices > MAX_VERTICES:
            raise MeshError(path, f"expected at most {MAX_FACES} faces and {MAX_VERTICES} vertices, got more")
        parts.append(part)
    return parts


def _world(graph: Any, node: str, worlds: dict[str, np.ndarray]) -> np.ndarray:
    """Return a node's (4, 4) transform to world space; `worlds` keeps those known, as the parser multiplies anew."""
    parents, chain = graph.transforms.parents, []
    while node not in worlds and node in parents:
        chain.append(node)
        node = parents[node]
    matrix = worlds.get(node, np.eye(4))
    for below in reversed(chain):
        matrix = worlds[below] = matrix @ graph.get(frame_to=below, frame_from=parents[below])[0]
    return matrix


def _part(scene: Any, node: str, transform: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None] | None:
    """Return world vertices, faces and (F, 4) sRGB colours in [0, 1] of one node, or None if it has no triangles."""
    geometry = scene.geometry[scene.graph.transforms.node_data[node]["geometry"]]
    faces = np.asarray(getattr(geometry, "faces", np.zeros((0, 3), np.int64)))
    vertices = np.asarray(geometry.vertices, dtype=np.float64)
    if len(faces) == 0:
        return None
    if np.max(faces, initial=0) >= len(vertices) or np.min(faces, initial=0) < 0:
        return vertices, faces, None  # refused by the gate; its colours cannot be looked up
    placed = vertices @ transform[:3, :3].T + transform[:3, 3]
    return placed, faces, _part_rgba(geometry, faces)


def _part_rgba(geometry: Any, faces: np.ndarray) -> np.ndarray | None:
    """Return (F, 4) sRGB colours in [0, 1]: of faces, of vertices (their mean), of a texture at the face's centre."""
    visual = geometry.visual
    if visual.kind in ("face", "vertex"):
        colours = np.asarray(visual.face_colors)
    elif visual.kind == "texture":
        uv, material = visual.uv, visual.material
        image = _picture(geometry)
        if uv is not None and len(uv) == len(geometry.vertices) and image is not None and np.isfinite(uv).all():
            colours = np.asarray(material.to_color(np.asarray(uv)[faces].mean(1)))
        else:
            main = np.asarray(material.main_color)
            if tuple(int(c) for c in main[:3]) in DEFAULT_GREYS:
                return None
            colours = np.broadcast_to(main, (len(faces), len(main)))
        if getattr(material, "alphaMode", None) != "BLEND":
            colours = np.concatenate([colours[:, :3], np.full((len(faces), 1), 255, colours.dtype)], 1)
    else:
        return None
    if colours.shape != (len(faces), 4) or colours.dtype != np.uint8:
        return None
    return colours.astype(np.float64) / 255


def check_geometry(path: str | Path, vertices: np.ndarray, faces: np.ndarray, n_vertices: int) -> tuple[Tensor, Tensor]:
    """Return vertices (N, 3) float64 and faces (F, 3) int64: the gate that every mesh passes.

    Args:
        path: for the message.
        vertices: (N, 3) floats.
        faces: (F, 3) integers.
        n_vertices: what the faces may index; less than N if frames follow each other.

    Raises:
        MeshError: wrong shape or dtype, no triangle, out-of-range index, NaN, inf or too large.

    Source: ours.
    """
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise MeshError(path, f"faces: expected (F, 3) integers, got {faces.shape} {faces.dtype}")
    if len(faces) == 0:
        raise MeshError(path, "faces: expected at least one triangle, got none")
    outside = (faces < 0) | (faces >= n_vertices)
    if outside.any():
        raise MeshError(path, f"faces: expected indices in [0, {n_vertices}), got {int(faces[outside][0])}")
    vertices = np.asarray(vertices, dtype=np.float64)
    if not np.isfinite(vertices).all():
        raise MeshError(path, f"vertices: expected finite values, got {vertices[~np.isfinite(vertices)][0]}")
    if np.abs(vertices).max(initial=0) > MAX_COORDINATE:
        raise MeshError(path, f"vertices: expected at most {MAX_COORDINATE:g}, got {np.abs(vertices).max():g}")
    return torch.from_numpy(np.ascontiguousarray(vertices)), torch.from_numpy(faces.astype(np.int64))


def normalise(path: str | Path, positions: Tensor, faces: Tensor) -> Tensor:
    """Return (P, V, 3) positions centred and scaled to a bounding radius of 1.

    Raises:
        MeshError: all are one point, or no triangle of `faces` (F, 3) ever has an area: there is nothing to be seen.

    Source: ours.
    """
    points = positions.reshape(-1, 3)
    scaled = positions - (points.amin(0) + points.amax(0)) / 2
    radius = float(scaled.norm(dim=-1).max())
    if not radius > SMALLEST_EXTENT:
        raise MeshError(path, f"vertices: expected some extent, got a radius of {radius:g}")
    scaled /= radius
    if not any(has_area(frame[part]) for frame in scaled for part in faces.split(FACES_AT_ONCE)):
        raise MeshError(path, "faces: expected a triangle with an area, got none")
    return scaled


def has_area(corners: Tensor) -> bool:
    """Tell whether any of the (F, 3, 3) triangles, of a mesh of radius 1, is more than a line. Source: ours."""
    a, b, c = corners.unbind(1)
    return float(torch.linalg.cross(b - a, c - a).norm(dim=-1).max()) > SMALLEST_EXTENT


def tensors_sha256(*tensors: Tensor | None) -> bytes:
    """Return a hash of shapes and values: of what was read, so that textures and buffers beside a file count too.

    Source: ours.
    """
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(b"none" if tensor is None else str(tuple(tensor.shape)).encode() + tensor.numpy().tobytes())
    return digest.digest()
