"""glTF 2 files: their JSON, buffers and accessors, with every number checked before it is used.

Before: formats.py.  After: gltf_looks.py, gltf_takes.py, gltf_rigs.py.
An accessor is a table of numbers: `count` rows of a `type`, in a view of a buffer, with rows replaced by `sparse`.
Source: the glTF 2.0 specification, section 3.6.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from datagen.formats import MAX_FILE_BYTES, MeshError, check_size, read_checked, short_reason

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
MAX_VALUE = 1e6  # of a coordinate or anything else that is no integer, as for all meshes
MAX_NUMBERS = 24_000_000  # in all accessors that are read; a file of MAX_FILE_BYTES can name far more by sharing


class GltfFile:
    """A glTF or GLB file whose parts are read when asked for.

    Raises:
        MeshError: from the constructor and every method, what is not as the format has it.
    """

    def __init__(self, path: Path) -> None:
        data, _ = read_checked(path, has_limits=True)
        self.path = path
        self.tree, self._binary = _split(path, data)
        self.picture: tuple[int, np.ndarray] | None = None  # the last one that was decoded, and its number
        self._buffers: dict[int, bytes] = {}
        self._bytes_read = len(data)
        self.digest = hashlib.sha256(data)  # of all bytes that were read, those beside the file too
        self._numbers_read = 0

    def fail(self, text: str) -> MeshError:
        """Return an error about this file."""
        return MeshError(self.path, text)

    def listed(self, name: str, holder: dict[str, Any] | None = None) -> list[Any]:
        """Return a list of the file, or of one of its objects; an absent one is empty."""
        found = (self.tree if holder is None else holder).get(name, [])
        if not isinstance(found, list):
            raise self.fail(f"{name}: expected a list, got {type(found).__name__}")
        return found

    def item(self, name: str, index: Any) -> dict[str, Any]:
        """Return object number `index` of a top-level list."""
        items = self.listed(name)
        found = items[self.whole(f"index into {name}", index, len(items) - 1)]
        return self.mapping(f"{name}[{index}]", found)

    def mapping(self, name: str, value: Any) -> dict[str, Any]:
        """Return a value that must be an object."""
        if not isinstance(value, dict):
            raise self.fail(f"{name}: expected an object, got {type(value).__name__}")
        return value

    def whole(self, name: str, value: Any, most: int) -> int:
        """Return a value that must be an integer in [0, most]."""
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
            raise self.fail(f"{name}: expected an integer in [0, {most}], got {str(value)[:40]}")
        return value

    def numbers(self, name: str, value: Any, count: int) -> np.ndarray:
        """Return a value that must be a list of `count` numbers of at most MAX_VALUE, as float64."""
        if not isinstance(value, list) or len(value) != count:
            raise self.fail(f"{name}: expected {count} numbers, got {str(value)[:40]}")
        if not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= MAX_VALUE for v in value):
            raise self.fail(f"{name}: expected numbers of at most {MAX_VALUE:g}, got {str(value)[:40]}")
        return np.array(value, dtype=np.float64)

    def accessor(self, index: Any, kinds: tuple[str, ...], whole: bool = False) -> np.ndarray:
        """Return the rows (count, width) of an accessor: int64 if `whole`, else float64, normalised if it says so.

        Args:
            index: of the accessor.
            kinds: what its type may be, of WIDTHS.
            whole: integers are expected.
        """
        entry = self.item("accessors", index)
        name = f"accessors[{index}]"
        kind = entry.get("type")
        if kind not in kinds:
            raise self.fail(f"{name}.type: expected {' or '.join(kinds)}, got {str(kind)[:40]}")
        width = WIDTHS[kind]
        dtype = self._dtype(f"{name}.componentType", entry.get("componentType"))
        count = self.whole(f"{name}.count", entry.get("count"), MAX_NUMBERS)
        self.reserve(count * width)
        if "bufferView" in entry:
            rows = self._view(name, entry, dtype, (count, width)).copy()
        else:
            rows = np.zeros((count, width), dtype)
        if "sparse" in entry:
            self._replace(f"{name}.sparse", self.mapping(f"{name}.sparse", entry["sparse"]), rows)
        if whole:
            if dtype.kind not in "iu":
                raise self.fail(f"{name}.componentType: expected integers, got {entry['componentType']}")
            return rows.astype(np.int64)
        if entry.get("normalized") is True and dtype.kind in "iu":
            return np.maximum(rows.astype(np.float64) / np.iinfo(dtype).max, -1.0)
        is_bad = ~(np.abs(rows.astype(np.float64)) <= MAX_VALUE)  # NaN included
        if is_bad.any():
            raise self.fail(f"{name}: expected finite values of at most {MAX_VALUE:g}, got {rows[is_bad][0]}")
        return rows.astype(np.float64)

    def reserve(self, count: int) -> None:
        """Count numbers that are about to be held, before they are."""
        self._numbers_read += count
        if self._numbers_read > MAX_NUMBERS:
            raise self.fail(f"accessors: expected at most {MAX_NUMBERS} numbers in all, got more")

    def view_bytes(self, index: Any) -> bytes:
        """Return the bytes of a buffer view, such as those of a picture."""
        view, data = self._view_place(index)
        return data[view[0] : view[0] + view[1]]

    def companion(self, uri: str) -> bytes:
        """Return the bytes at an address: inside the address itself, or in a file under the folder of this one."""
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            if not head.endswith(";base64"):
                raise self.fail(f"uri: expected base64 data, got {head[:40]!r}")
            try:
                return base64.b64decode(body, validate=True)
            except (binascii.Error, ValueError) as error:
                raise self.fail(f"uri: expected base64 data, got {short_reason(error)}") from None
        folder = self.path.parent.resolve()
        try:
            place = (folder / unquote(uri)).resolve()
        except (OSError, ValueError, RuntimeError) as error:
            raise self.fail(f"uri: expected a file beside it, got {short_reason(error)}") from None
        if not place.is_relative_to(folder):
            raise self.fail(f"uri: expected a file under its own folder, got {uri[:80]!r}")
        check_size(place)
        self._bytes_read += place.stat().st_size
        if self._bytes_read > MAX_FILE_BYTES:
            raise self.fail(f"expected at most {MAX_FILE_BYTES} bytes with the files beside it, got more")
        data = place.read_bytes()
        self.digest.update(data)
        return data

    def _dtype(self, name: str, code: Any) -> np.dtype:
        """Return the numpy type of a component type."""
        if isinstance(code, bool) or not isinstance(code, int) or code not in COMPONENTS:
            raise self.fail(f"{name}: expected one of {', '.join(map(str, COMPONENTS))}, got {str(code)[:40]}")
        return np.dtype(COMPONENTS[code])

    def _view_place(self, index: Any) -> tuple[tuple[int, int, int], bytes]:
        """Return start, length and stride (0: packed) of a buffer view, and its buffer's bytes."""
        view, name = self.item("bufferViews", index), f"bufferViews[{index}]"
        data = self._buffer(view.get("buffer"))
        start = self.whole(f"{name}.byteOffset", view.get("byteOffset", 0), len(data))
        length = self.whole(f"{name}.byteLength", view.get("byteLength"), len(data) - start)
        stride = self.whole(f"{name}.byteStride", view.get("byteStride", 0), 252)
        return (start, length, stride), data

    def _view(self, name: str, entry: dict[str, Any], dtype: np.dtype, shape: tuple[int, int]) -> np.ndarray:
        """Return the rows that an accessor, or a part of a sparse one, has in its buffer view."""
        (start, length, stride), data = self._view_place(entry.get("bufferView"))
        row = shape[1] * dtype.itemsize
        stride = stride or row
        if stride < row:
            raise self.fail(f"{name}: expected a stride of at least {row} bytes, got {stride}")
        offset = self.whole(f"{name}.byteOffset", entry.get("byteOffset", 0), length)
        needed = (shape[0] - 1) * stride + row if shape[0] else 0
        if offset + needed > length:
            raise self.fail(f"{name}: expected {needed} bytes in its view, got {length - offset}")
        if shape[0] == 0:
            return np.zeros(shape, dtype)
        return np.ndarray(shape, dtype, data, start + offset, (stride, dtype.itemsize))

    def _replace(self, name: str, sparse: dict[str, Any], rows: np.ndarray) -> None:
        """Put the rows of a sparse accessor in their places."""
        count = self.whole(f"{name}.count", sparse.get("count"), len(rows))
        at, new = (self.mapping(f"{name}.{k}", sparse.get(k)) for k in ("indices", "values"))
        dtype = self._dtype(f"{name}.indices.componentType", at.get("componentType"))
        if dtype.kind != "u":
            raise self.fail(f"{name}.indices.componentType: expected unsigned integers, got {at['componentType']}")
        places = self._view(f"{name}.indices", at, dtype, (count, 1))[:, 0].astype(np.int64)
        if count and places.max() >= len(rows):
            raise self.fail(f"{name}.indices: expected indices in [0, {len(rows)}), got {places.max()}")
        rows[places] = self._view(f"{name}.values", new, rows.dtype, (count, rows.shape[1]))

    def _buffer(self, index: Any) -> bytes:
        """Return the bytes of a buffer."""
        entry = self.item("buffers", index)
        if index not in self._buffers:
            if "uri" in entry:
                if not isinstance(entry["uri"], str):
                    raise self.fail(f"buffers[{index}].uri: expected text, got {type(entry['uri']).__name__}")
                data = self.companion(entry["uri"])
            elif index == 0 and self._binary is not None:
                data = self._binary
            else:
                raise self.fail(f"buffers[{index}]: expected a uri or a binary chunk, got neither")
            length = self.whole(f"buffers[{index}].byteLength", entry.get("byteLength"), len(data))
            self._buffers[index] = data[:length]
        return self._buffers[index]


def _split(path: Path, data: bytes) -> tuple[dict[str, Any], bytes | None]:
    """Return the JSON of a file that `read_checked` let pass, and the binary chunk of a GLB."""
    binary = None
    if path.suffix.lower() == ".glb":
        if data[:4] != b"glTF" or int.from_bytes(data[4:8], "little") != 2:
            raise MeshError(path, f"expected binary glTF of version 2, got {data[:8]!r}")
        end = 20 + int.from_bytes(data[12:16], "little")
        size = int.from_bytes(data[end : end + 4], "little")
        if len(data) >= end + 8 and data[end + 4 : end + 8] == b"BIN\0":
            if len(data) < end + 8 + size:
                raise MeshError(path, f"expected {size} bytes in its binary chunk, got {len(data) - end - 8}")
            binary = data[end + 8 : end + 8 + size]
        data = data[20:end]
    return json.loads(data.decode("utf-8-sig")), binary
