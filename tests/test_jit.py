"""What is compiled stays on disk; processes that compile at the same time do not take each other's work for theirs."""

import copy
from pathlib import Path

import pytest

from torchblur.cpu import jit


@jit.jit
def twice(x):
    return 2 * x


@pytest.fixture
def stored(tmp_path):
    file = copy.copy(twice._cache._cache_file)
    file._cache_path, file._index_path = str(tmp_path), str(tmp_path / file._index_name)
    return file


def test_what_two_processes_compile_at_once_is_never_taken_for_each_other(stored):
    seen = stored._load_index()
    assert seen == {}
    stored._load_index = lambda: dict(seen)  # both have looked before either wrote
    jit._save(stored, ("float32",), "for float32")
    first = copy.copy(stored)
    jit._save(stored, ("float64",), "for float64")
    del stored._load_index
    assert stored.load(("float64",)) == "for float64"
    assert stored.load(("float32",)) in ("for float32", None)  # at worst compiled again
    first._save_index({("float32",): next(iter(first_names(stored, "float32")))})  # the other list came last
    assert stored.load(("float32",)) == "for float32"


def first_names(stored, which):
    """The names of data files that hold what was compiled for `which`."""
    names = [p.name for p in Path(stored._cache_path).glob("*.nbc")]
    return [name for name in names if stored._load_data(name) == f"for {which}"]


def test_a_disk_that_is_full_does_not_fail_what_was_compiled(stored, monkeypatch):
    def full(name, data):
        raise OSError(28, "No space left on device")

    stored._save_data = full
    jit._save(stored, ("float32",), "for float32")
    assert stored.load(("float32",)) is None


def test_kernels_store_by_signature():
    assert twice._cache._cache_file.save.func is jit._save
    assert twice(2.0) == 4.0
