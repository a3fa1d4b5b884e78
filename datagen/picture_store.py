"""Picture store: PNGs in an LMDB as BasicSR and the code built on it read them (the only door to lmdb).

Before: writer.py.  After: export.py.
A store is a folder with `data.mdb`, key = name without suffix, value = the PNG's bytes, and `meta_info.txt`, a line
`name.png (h,w,c) compression` each, which is written last.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

from datagen.writer import write_atomically

PAGE_BYTES, SPARE_BYTES = 4096, 2**24
COMMIT_EVERY = 100  # pictures
COMPRESSION = 6  # of our PNGs; readers ignore it


def write_store(folder: Path, pictures: Iterable[tuple[str, bytes]], shape: tuple[int, int, int], room: int) -> int:
    """Write pictures into a store and return how many they are. Pictures of the same names are replaced.

    Args:
        folder: of the store, named `….lmdb`; created if need be.
        pictures: (name without suffix, PNG bytes), names rising.
        shape: (h, w, c) of all pictures.
        room: bytes of all pictures together, or more.

    Raises:
        ModuleNotFoundError: the optional package lmdb is not installed.
        OSError: the disk is full or not writable. What was committed stays; the list is not written.

    Source: BasicSR, DatasetPreparation.
    """
    lmdb = _lmdb()
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    try:
        with lmdb.open(str(folder), map_size=room + SPARE_BYTES, subdir=True, lock=True) as store:
            transaction = store.begin(write=True)
            try:
                for name, data in pictures:
                    transaction.put(name.encode("ascii"), data)
                    names.append(name)
                    if len(names) % COMMIT_EVERY == 0:
                        transaction.commit()
                        transaction = store.begin(write=True)
                transaction.commit()
            except BaseException:
                transaction.abort()
                raise
    except lmdb.Error as error:
        raise OSError(f"{folder}: expected a store that can be written, got {error}") from None
    size = "({},{},{})".format(*shape)
    lines = "".join(f"{name}.png {size} {COMPRESSION}\n" for name in names)
    write_atomically(folder / "meta_info.txt", lines.encode())
    return len(names)


def need_lmdb() -> None:
    """Raise ModuleNotFoundError unless the optional package lmdb is installed. Source: ours."""
    _lmdb()


def _lmdb() -> ModuleType:
    """Return the module lmdb, an optional package."""
    try:
        import lmdb
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "lmdb: expected the package for layout lmdb, got none; install torchblur[export]"
        ) from None
    return lmdb
