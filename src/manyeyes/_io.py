# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole or not at all, whatever ends the program that writes them; and inputs read within bounds.

Inputs that are too large, or unpack to too much, are an OSError whose text names the bound.
"""

from __future__ import annotations

import contextlib
import errno
import gzip
import io
import json
import os
import stat
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

UNFINISHED = ".unfinished"
"""Files with this in their names were being written when their writer ended; they are never read."""
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

MAX_FILE_BYTES = 1 << 30
"""Maximum size of a file that is read as a whole, where a reader has no bound of its own."""
MAX_TEXT_BYTES = 1 << 27
"""Maximum size of a text that becomes a tree of objects (XML, yaml), unpacked: a tree takes about ten times as much."""


def read_file(path: Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Read a regular file of at most max_bytes.

    Raises:
        OSError: it cannot be read, is larger, or is a pipe or device, which may have no end.
    """
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    if status.st_size > max_bytes:
        raise _too_large(f"{status.st_size:,} bytes", max_bytes, path)
    return path.read_bytes()


def unpack_gzip(data: bytes, max_bytes: int, path: Path | str = "") -> bytes:
    """Unpack gzip data to at most max_bytes; OSError where it is damaged or unpacks to more."""
    try:
        with gzip.open(io.BytesIO(data)) as file:
            return _read_bounded(file, max_bytes, path)
    except (EOFError, zlib.error) as error:
        raise OSError(errno.EIO, f"damaged gzip data ({error})", str(path)) from error


def unpack_zip_member(archive: zipfile.ZipFile, name: str, max_bytes: int, path: Path | str = "") -> bytes:
    """Unpack one member of a zip file to at most max_bytes; OSError where it is damaged or unpacks to more."""
    try:
        with archive.open(name) as file:
            return _read_bounded(file, max_bytes, path)
    except (EOFError, zlib.error, RuntimeError, NotImplementedError) as error:
        raise OSError(errno.EIO, f"damaged zip member {name} ({error})", str(path)) from error


def parse_json(text: str | bytes, make_object: Callable[[list[tuple[str, Any]]], Any] | None = None) -> Any:
    """Parse JSON; ValueError where it is none, deeply nested JSON included. make_object: as ``object_pairs_hook`` of ``json``."""
    try:
        return json.loads(text, object_pairs_hook=make_object)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _read_bounded(file: gzip.GzipFile | IO[bytes], max_bytes: int, path: Path | str) -> bytes:
    data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise _too_large("it unpacks to more", max_bytes, path)
    return data


def _too_large(size: str, max_bytes: int, path: Path | str) -> OSError:
    return OSError(errno.EFBIG, f"{size}; the maximum is {max_bytes:,} bytes", str(path))


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
