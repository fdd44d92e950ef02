# SPDX-License-Identifier: Apache-2.0
"""Files are the old or the new ones, on the disk before their names are, and errors name the final file."""

import errno
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from torch import nn

from manyeyes import _io
from manyeyes._io import atomic_rename, atomic_write, atomic_write_text, flush_files
from manyeyes.models import checkpoint
from manyeyes.simulator.record import write_json as write_manifest
from manyeyes.studies import provenance
from manyeyes.studies.engine.cells import Cell, CellStore


@dataclass(frozen=True)
class _LineConfig:
    width: int = 3


class _Line(nn.Linear):
    def __init__(self) -> None:
        super().__init__(3, 1)
        self.config = _LineConfig()


@contextmanager
def file_size_limit(num_bytes: int) -> Iterator[None]:
    """Let no file grow beyond so many bytes: writes fail half-way, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def events(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Flushes and renames in their order: ("flush" or "name", name of the file or folder)."""
    seen: list[tuple[str, str]] = []
    to_disk, replace = _io._to_disk, Path.replace

    def flush(path: Path) -> None:
        seen.append(("flush", path.name.lstrip(".").split(".unfinished")[0].removesuffix(f".{os.getpid()}")))
        to_disk(path)

    def name(path: Path, target: Path) -> Path:
        seen.append(("name", target.name))
        return replace(path, target)

    monkeypatch.setattr(_io, "_to_disk", flush)
    monkeypatch.setattr(Path, "replace", name)
    return seen


def save_weights(folder: Path) -> str:
    checkpoint.save(_Line(), folder / "weights.safetensors", {})
    return "weights.safetensors"


def save_result(folder: Path) -> str:
    provenance.write_json(folder / "results.json", {}, {}, 0)
    return "results.json"


def save_manifest(folder: Path) -> str:
    write_manifest(folder / "manifest.json", {})
    return "manifest.json"


def save_cell(folder: Path) -> str:
    cell, store = Cell("cell", _LineConfig, 0, ()), CellStore(folder)
    store.save(cell, _LineConfig())
    return store.path(cell).name


def save_text(folder: Path) -> str:
    atomic_write_text(folder / "results.md", "text")
    return "results.md"


@pytest.mark.parametrize("save", [save_weights, save_result, save_manifest, save_cell, save_text])
def test_a_save_flushes_the_file_before_its_name_and_the_folder_after_it(save, tmp_path: Path, events) -> None:
    name = save(tmp_path)
    assert events == [("flush", name), ("name", name), ("flush", tmp_path.name)]


def test_many_files_are_flushed_once_and_each_folder_once(tmp_path: Path, events) -> None:
    for name in ("one", "two"):
        atomic_write_text(tmp_path / "draft" / name, name, durable=False)
    events.clear()
    flush_files(sorted((tmp_path / "draft").iterdir()))
    atomic_rename(tmp_path / "draft", tmp_path / "whole")
    flushes = [("flush", name) for name in ("one", "two", "draft")]
    assert events == [*flushes, ("name", "whole"), ("flush", tmp_path.name)]


@pytest.mark.parametrize("save", [save_weights, save_result, save_manifest, save_cell, save_text])
def test_a_full_disk_is_an_error_with_the_name_of_the_file_and_leaves_the_old_one(save, tmp_path: Path) -> None:
    name = save(tmp_path)
    before = (tmp_path / name).read_bytes()
    with file_size_limit(2), pytest.raises(OSError) as error:
        save(tmp_path)
    assert error.value.filename == str(tmp_path / name)
    assert "free some space and run again: what was finished is kept" in str(error.value)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {name: before}


def test_an_error_of_another_file_keeps_its_name(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as error, _io.atomic_replace(tmp_path / "out"):
        (tmp_path / "in").read_bytes()
    assert error.value.filename == str(tmp_path / "in")


def test_a_flush_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    atomic_write(tmp_path / "file", b"old")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="file"):
        atomic_write(tmp_path / "file", b"new")
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]
