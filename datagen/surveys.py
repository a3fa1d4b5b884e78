"""Surveys of folders: which of people's files of one kind can be used, and the hash of all that they hold.

Before: assets.py.  After: photos.py, rosters.py.
Source: ours.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from datagen.assets import Roster, files_under
from datagen.formats import MeshError, printable


@dataclass(frozen=True)
class Kind:
    """Files of one kind, by their suffixes."""

    name: str
    told: tuple[str, ...]  # suffixes that people are told to use
    read: tuple[str, ...]  # suffixes of what is read
    unread: tuple[str, ...]  # of what is named as refused; any other suffix is taken for a companion and passed over
    error: type[MeshError]


def survey_folder(folder: str | Path, kind: Kind, content: Callable[[Path], bytes]) -> Roster:
    """Read every file of a kind under `folder` once and return which can be used.

    Args:
        folder: where to look, and in its folders.
        kind: of files.
        content: returns what a file holds, or a hash of it; raises `kind.error` where it cannot be used.

    Raises:
        kind.error: none can, or there is none.

    Source: ours.
    """
    names, digest = [], hashlib.sha256()
    found, refused = files_under(folder)
    for name in found:
        suffix = Path(name).suffix.lower()
        told = name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
        if suffix in kind.read + kind.unread and told != name:  # neither a page nor a record could hold it
            refused.append((told, "expected a file name in UTF-8"))
            continue
        if suffix in kind.unread:
            refused.append((printable(name), f"expected one of {', '.join(kind.told)}, got a {suffix} file"))
        if suffix not in kind.read:
            continue
        try:
            held = content(Path(folder) / name)
        except kind.error as error:
            refused.append((printable(name), error.reason))
            continue
        names.append(name)
        digest.update(name.encode() + b"\0" + held)
    if not names:
        reasons = "; ".join(f"{n}: {r}" for n, r in refused) or f"no {kind.name} file at all"
        raise kind.error(folder, f"expected at least one usable {kind.name} file, got {reasons}")
    return Roster(tuple(names), tuple(refused), digest.hexdigest())
