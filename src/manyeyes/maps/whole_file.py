# SPDX-License-Identifier: Apache-2.0
"""Files that are there whole or not at all, whatever ends the program that writes them, and whenever."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

#: Files with this in their names were being written when their writer ended; nobody reads them.
UNFINISHED = ".unfinished"


@contextmanager
def replacing(path: Path, keep_suffix: bool = False, durable: bool = True) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when the block ends well, and vanishes when it does not.

    keep_suffix is for libraries that go by a file's ending; else no pattern such as ``*.parquet`` meets the temporary file.
    Durable: the bytes are on the disk before the name is, so that after a loss of power, too, the file is the old one or the new.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{UNFINISHED}{path.suffix if keep_suffix else ''}")
    try:
        yield temporary
        if durable:
            _to_disk(temporary)
        temporary.replace(path)
        if durable:
            _to_disk(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(path: Path, data: bytes) -> None:
    """Write bytes so that a reader sees the old file, the new one, or none."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def rename_whole(draft: Path, path: Path) -> None:
    """Give a finished, flushed file its final name, and flush the name."""
    draft.replace(path)
    _to_disk(path.parent)


def remove_unfinished(folder: Path) -> list[Path]:
    """Delete what writers that were killed left in a folder and below it; the caller holds the folder's lock."""
    left = sorted(folder.rglob(f".*{UNFINISHED}*"))
    for path in left:
        path.unlink(missing_ok=True)
    return left


def _to_disk(path: Path) -> None:
    """Flush a file or folder; a system that cannot open folders (Windows) orders renames by itself."""
    with contextlib.suppress(PermissionError):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
