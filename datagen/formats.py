"""Formats: what the bytes of a mesh file tell before they are parsed, where the parser would be silent or mislead.

Before: nothing.  After: assets.py, sequences.py, gltf.py, usd_files.py.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

MAX_FILE_BYTES = 256 * 2**20  # parsing takes several times as much memory
MAX_NUMBERS = 48 * 2**20  # that a file may hold or announce, as float64 384 MiB
MAX_PLAYED_VERTICES = 500_000  # of a mesh that moves by itself: it is held at some 100 instants at once
MAX_PLAYED_FACES = 1_000_000
NO_LOOK = np.array([[0.45, 0.45, 0.45, 1.0]])  # linear; of parts without a colour beside parts that have one
READABLE_EXTENSIONS = re.compile(r"KHR_(materials_\w+|texture_transform|lights_punctual)")
COMPRESSIONS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
GLTF_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
MAX_NODE_DEPTH = 256
STL_HEADER_BYTES, STL_TRIANGLE_BYTES = 84, 50
TAIL_BYTES = 65536


class MeshError(ValueError):
    """A file that cannot be used, and why."""

    def __init__(self, path: str | Path, reason: str) -> None:
        self.path, self.reason = str(path), printable(reason)
        super().__init__(printable(f"{path}: {reason}"))


@dataclass(frozen=True, eq=False)
class Surface:
    """What of a mesh that moves by itself is the same at all times: F faces of all parts, one after the other."""

    faces: np.ndarray  # (F, 3) int64
    rgba: np.ndarray | None  # (F, 4) float64 linear, or none in the file
    notes: tuple[str, ...]  # what in the file is not used


def join_parts(faces: Sequence[np.ndarray], looks: Sequence[np.ndarray | None], notes: Sequence[str]) -> Surface:
    """Return the surface of parts.

    Args:
        faces: (F, 3) of each part, at least one.
        looks: (F, 4) linear colour and opacity of each part, or none.
        notes: may repeat themselves.

    Source: ours.
    """
    return Surface(np.concatenate(faces), join_looks(faces, looks, NO_LOOK), tuple(dict.fromkeys(notes)))


def join_looks(
    faces: Sequence[np.ndarray], looks: Sequence[np.ndarray | None], no_look: np.ndarray
) -> np.ndarray | None:
    """Return the (F, 4) looks of all parts, `no_look` (1, 4) for one without; none if no part has any. Source: ours."""
    if all(look is None for look in looks):
        return None
    return np.concatenate([no_look.repeat(len(f), 0) if k is None else k for k, f in zip(looks, faces, strict=True)])


def printable(text: str) -> str:
    """Return text with what would steer a terminal, or begin a line, told as in Python's strings. Source: ours."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def short_reason(error: BaseException) -> str:
    """Return an exception as one short line. Source: ours."""
    text = " ".join(str(error).split())[:200]
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def check_size(path: Path) -> None:
    """Raise MeshError for a file that is missing, empty or too large to be parsed safely. Source: ours."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise MeshError(path, f"expected a file, got {short_reason(error)}") from None
    if not path.is_file():
        raise MeshError(path, "expected a file, got something else")
    if not 0 < size <= MAX_FILE_BYTES:
        raise MeshError(path, f"expected 1 to {MAX_FILE_BYTES} bytes, got {size}")


def read_checked(path: Path, has_limits: bool = False) -> tuple[bytes, tuple[str, ...]]:
    """Return the bytes of a mesh file, its text made UTF-8, and notes on what in it is not read.

    Args:
        path: of the file.
        has_limits: what reads the bytes next bounds by itself how much it holds, and how deep it goes.

    Raises:
        MeshError: its size, a file cut short or damaged in a way that shows, or a need for what is not read.

    Source: ours.
    """
    check_size(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MeshError(path, f"expected a readable file, got {short_reason(error)}") from None
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return data, _gltf_notes(path, data, has_limits)
    if suffix == ".obj":
        _check_last_face(path, data)
        if re.search(rb"^[ \t]*f[ \t](?:[^\n]*[ \t])?0+(?:[/\s]|$)", data, re.M):
            raise MeshError(path, "faces: expected indices from 1, or below 0 for those from the end, got 0")
    if suffix == ".ply":  # a header of text before what may be binary
        header, end, body = data.partition(b"end_header")
        return utf8_text(header) + end + body, ()
    if suffix == ".stl" and not _is_text_stl(path, data):
        return data, ()
    return utf8_text(data), ()


def utf8_text(data: bytes) -> bytes:
    """Return text as UTF-8: as it is if it is that already, else read as Latin-1, which cannot fail. Source: ours."""
    try:
        data.decode()
    except UnicodeDecodeError:
        return data.decode("latin-1").encode()
    return data


def announced_faces(suffix: str, data: bytes) -> int:
    """Return how many faces the header of a PLY file promises; 0 for other files. Source: ours."""
    match = re.search(rb"element\s+face\s+(\d+)", data[:TAIL_BYTES].split(b"end_header")[0])
    return int(match[1]) if match and suffix == ".ply" else 0


def _check_last_face(path: Path, data: bytes) -> None:
    """Refuse an OBJ file that ends inside a face: the parser would take it for a smaller mesh."""
    tail = re.sub(rb"\\\r?\n", b" ", data[-TAIL_BYTES:]).splitlines()
    records = [words for words in (line.split(b"#")[0].split() for line in tail) if words]
    if not records or records[-1][0] != b"f":
        return
    corners = records[-1][1:]
    forms = {tuple(bool(number) for number in corner.split(b"/")) for corner in corners}  # 3/3 or 3// after 1/1/1
    if len(corners) < 3 or len(forms) > 1:
        found = b" ".join(records[-1])[-60:].decode("latin-1")
        raise MeshError(
            path, f"faces: expected at least 3 whole corners in the last face, got {found!r}: a file cut short"
        )


def _is_text_stl(path: Path, data: bytes) -> bool:
    """Tell text from binary STL, or raise MeshError if it is neither as a whole."""
    count = int.from_bytes(data[STL_HEADER_BYTES - 4 : STL_HEADER_BYTES], "little")
    expected = STL_HEADER_BYTES + STL_TRIANGLE_BYTES * count
    if len(data) == expected:
        return False
    words = data.lower()
    if b"solid" in words and b"\0" not in data:
        if words.rfind(b"facet") > words.rfind(b"endsolid"):
            raise MeshError(path, "expected endsolid after the last facet, got a file cut short")
        return True
    if len(data) < STL_HEADER_BYTES:
        raise MeshError(path, f"expected at least the {STL_HEADER_BYTES} bytes of a header, got {len(data)}")
    raise MeshError(path, f"expected {expected} bytes for the {count} triangles its header announces, got {len(data)}")


def _gltf_notes(path: Path, data: bytes, has_limits: bool) -> tuple[str, ...]:
    """Refuse glTF files that need an extension or a place that is not read; return notes on animations."""
    try:
        if path.suffix.lower() == ".glb" and len(data) >= 20:
            data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
        tree = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise MeshError(path, f"expected glTF with JSON inside, got {short_reason(error)}") from None
    if not isinstance(tree, dict):
        raise MeshError(path, f"expected a glTF object, got a JSON {type(tree).__name__}")
    # Without its decoder the parser fills a compressed mesh with zeros and says nothing.
    needed = [str(e) for e in _list_in(tree, "extensionsRequired") if not READABLE_EXTENSIONS.fullmatch(str(e))]
    needed += [e for e in COMPRESSIONS if e in _list_in(tree, "extensionsUsed")]
    if needed:
        raise MeshError(path, f"expected no required extension, got {', '.join(sorted(set(needed)))}")
    parts = [p for name in ("buffers", "images") for p in _list_in(tree, name) if isinstance(p, dict)]
    places = [p["uri"] for p in parts if isinstance(p.get("uri"), str)]
    remote = [u for u in places if re.match(r"\s*([a-z][a-z0-9+.-]*:|//)", u, re.I) and not u.startswith("data:")]
    if remote:
        raise MeshError(path, f"expected buffers and images in files beside it, got {remote[0][:80]!r}")
    if not has_limits:
        _check_numbers(path, tree)
        _check_nodes(path, tree)
    still = [k for k in ("animations", "skins") if tree.get(k)]
    return (f"{' and '.join(still)} in the file are not read: the mesh keeps its rest pose",) if still else ()


def _check_numbers(path: Path, tree: dict[str, Any]) -> None:
    """Refuse a glTF file that announces more numbers than it is safe to hold: many parts may share few bytes."""
    sizes = []
    for entry in _list_in(tree, "accessors"):
        count, kind = (entry.get("count"), entry.get("type")) if isinstance(entry, dict) else (0, "")
        sizes.append(max(0, count) * GLTF_WIDTHS.get(str(kind), 16) if isinstance(count, int) else 0)
    used = 0
    for mesh in _list_in(tree, "meshes"):
        for part in _list_in(mesh, "primitives") if isinstance(mesh, dict) else ():
            named = [part.get("indices"), *part["attributes"].values()] if _has_attributes(part) else []
            used += sum(sizes[k] for k in named if type(k) is int and 0 <= k < len(sizes))
    found = max(sum(sizes), used)
    if found > MAX_NUMBERS:
        raise MeshError(path, f"accessors: expected at most {MAX_NUMBERS} numbers in all, got {found}")


def _check_nodes(path: Path, tree: dict[str, Any]) -> None:
    """Refuse a glTF file whose nodes are no trees, or hang so deep that the parser takes hours."""
    parents: dict[int, int] = {}
    for k, node in enumerate(_list_in(tree, "nodes")):
        for child in _list_in(node, "children") if isinstance(node, dict) else ():
            if type(child) is int and parents.setdefault(child, k) != k:
                raise MeshError(path, f"nodes: expected at most one parent of each, got two of node {child}")
    depths: dict[int, int] = {}
    for k in parents:
        chain, place = [], k
        while place in parents and place not in depths and len(chain) <= MAX_NODE_DEPTH:
            chain.append(place)
            place = parents[place]
        deepest = depths.get(place, 0) + len(chain)
        if deepest > MAX_NODE_DEPTH:  # a ring as well
            raise MeshError(path, f"nodes: expected at most {MAX_NODE_DEPTH} below each other, got more")
        depths |= {node: deepest - n for n, node in enumerate(chain)}


def _has_attributes(part: Any) -> bool:
    """Tell whether a part of a glTF mesh has attributes."""
    return isinstance(part, dict) and isinstance(part.get("attributes"), dict)


def _list_in(tree: dict[str, Any], name: str) -> list[Any]:
    """Return a list in a JSON object, empty if there is none of that name."""
    found = tree.get(name)
    return found if isinstance(found, list) else []
