# SPDX-License-Identifier: Apache-2.0
"""Files that are there whole or not at all, whatever ends the program that writes them, and whenever."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

UNFINISHED = ".unfinished"
"""Files with this in their names were being written when their writer ended; they are never read."""


@contextmanager
def atomic_replace(path: Path, keep_suffix: bool = False, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that takes its place when the block ends well, and is deleted when it does not.

    Args:
        path: the final file; its folder is made.
        keep_suffix: for libraries that go by a file's ending; else no pattern such as ``*.parquet`` matches the temporary file.
        durable: bytes are on the disk before the name is: after a loss of power, too, the file is the old or the new one.
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


def atomic_write(path: Path, *chunks: bytes | memoryview, durable: bool = True) -> None:
    """Write bytes so that a reader sees the old file, the new one, or none."""
    with atomic_replace(path, durable=durable) as temporary, temporary.open("wb") as file:
        for chunk in chunks:
            file.write(chunk)


def atomic_write_text(path: Path, text: str) -> None:
    """Write text in UTF-8 so that a reader sees the old file, the new one, or none."""
    atomic_write(path, text.encode(), durable=False)


def atomic_rename(draft: Path, path: Path) -> None:
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
