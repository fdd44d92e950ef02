# SPDX-License-Identifier: Apache-2.0
"""Files that are there whole or not at all, whatever ends the program that writes them, and whenever."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

UNFINISHED = ".unfinished"
"""Files with this in their names were being written when their writer ended; they are never read."""
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def atomic_replace(path: Path, keep_suffix: bool = False, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that takes its place when the block ends well, and is deleted when it does not.

    Args:
        path: the final file; its folder is made.
        keep_suffix: for libraries that go by a file's ending; else no pattern such as ``*.parquet`` matches the temporary file.
        durable: bytes are on the disk before the name is: after a loss of power, too, the file is the old or the new one. Not for
            caches, pictures, and files that :func:`flush_files` flushes together.

    Raises:
        OSError: with the name of the final file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{UNFINISHED}{path.suffix if keep_suffix else ''}")
    try:
        with name_errors(path, temporary):
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


def atomic_write_text(path: Path, text: str, durable: bool = True) -> None:
    """Write text in UTF-8 so that a reader sees the old file, the new one, or none."""
    atomic_write(path, text.encode(), durable=durable)


@contextmanager
def name_errors(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Name the file in an OSError that names none, or its temporary one; add the remedy where there is no space left."""
    try:
        yield
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(temporary)):
            raise
        reason = os.strerror(error.errno)
        if error.errno in _NO_SPACE:
            reason += "; free some space and run again: what was finished is kept"
        raise OSError(error.errno, reason, str(path)) from error


def atomic_rename(draft: Path, path: Path) -> None:
    """Give a finished, flushed file or folder its final name, and flush the name."""
    draft.replace(path)
    _to_disk(path.parent)


def flush_files(files: Iterable[Path]) -> None:
    """Flush files that were written without ``durable``, then their folders: many files cost one flush of each folder."""
    folders: dict[Path, None] = {}
    for path in files:
        with name_errors(path):
            _to_disk(path)
        folders[path.parent] = None
    for folder in folders:
        _to_disk(folder)


def remove_unfinished(folder: Path, below: bool = True) -> list[Path]:
    """Delete what writers that were killed left in a folder, and below it; the caller holds the folder's lock."""
    pattern = f".*{UNFINISHED}*"
    left = sorted(folder.rglob(pattern) if below else folder.glob(pattern))
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
