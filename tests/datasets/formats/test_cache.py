# SPDX-License-Identifier: Apache-2.0
"""Whole files or none, and a cache that can only cost speed."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from manyeyes._io import atomic_write
from manyeyes.datasets.formats.cache import ArrayCache, default_cache_folder


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    atomic_write(path, b"old")
    with pytest.raises(TypeError):
        atomic_write(path, b"new", "not bytes")  # type: ignore[arg-type]
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_an_entry_holds_for_one_path_size_time_and_kind(tmp_path: Path) -> None:
    source, other, cache = tmp_path / "a", tmp_path / "b", ArrayCache(tmp_path / "cache")
    source.write_bytes(b"1234")
    other.write_bytes(b"1234")
    cache.store(source, "x", np.arange(3))
    found = cache.load(source, "x")
    assert found is not None and found.tolist() == [0, 1, 2]
    assert cache.load(other, "x") is None and cache.load(source, "y") is None
    stat = source.stat()
    os.utime(source, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))
    assert cache.load(source, "x") is None
    source.write_bytes(b"12345")
    os.utime(source, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert cache.load(source, "x") is None


def test_a_folder_that_cannot_be_written_costs_speed_only(tmp_path: Path) -> None:
    (tmp_path / "source").write_bytes(b"1")
    (tmp_path / "cache").write_bytes(b"a file, not a folder")
    cache = ArrayCache(tmp_path / "cache")
    cache.store(tmp_path / "source", "x", np.arange(3))
    assert cache.load(tmp_path / "source", "x") is None


def test_where_the_cache_lies(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("MANYEYES_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_folder() == tmp_path / "manyeyes"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert default_cache_folder() == Path.home() / ".cache" / "manyeyes"
    monkeypatch.setenv("MANYEYES_CACHE", str(tmp_path / "own"))
    assert default_cache_folder() == tmp_path / "own"
