# SPDX-License-Identifier: Apache-2.0
"""Exclusive locks on the folders that commands write to."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shlex
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from manyeyes._io import name_errors
from manyeyes.datatypes.errors import ManyeyesError

LOCK = ".lock"
"""Name of the lock file in a folder; it names the process that holds the lock, and is deleted with the lock."""


# A process that begins to share holds the folder alone for the time of cleaning.
_TRIES, _WAIT_S = 40, 0.05


class FolderInUseError(ManyeyesError):
    """Another process writes to a folder; the text names it."""


@contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, which is made; what was made and is still empty at the end is removed.

    The lock is the operating system's (``flock``), which releases it when the process ends in whatever way; a lock file that a
    killed process left behind locks nothing. Readers take no lock. A process cannot lock a folder twice.

    Raises:
        FolderInUseError: another process holds the lock; the text names its id, host, start time and command.
    """
    with _remove_empty(folder):
        path = folder / LOCK
        handle = _acquire(path)
        try:
            yield
        finally:
            _release(handle, path)


@contextmanager
def share_folder(folder: Path, clean: Callable[[], object]) -> Iterator[None]:
    """Hold a folder together with other processes that share it, against those that hold it alone (:func:`hold_folder`).

    clean: called when no other process holds the folder, to remove what killed ones left.

    Raises:
        FolderInUseError: another process holds the folder alone.
    """
    with _remove_empty(folder):
        path = folder / LOCK
        handle = _acquire_shared(path, clean)
        try:
            yield
        finally:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(handle)
            else:
                _release(handle, path)


@contextmanager
def _remove_empty(folder: Path) -> Iterator[None]:
    """Remove at the end the folders that were made for this one and are empty."""
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # not empty
            for made_folder in made:
                made_folder.rmdir()


def _release(handle: int, path: Path) -> None:
    if _is_file_of(handle, path):
        path.unlink()
    os.close(handle)


def _acquire_shared(path: Path, clean: Callable[[], object]) -> int:
    """Clean up where no other process holds the lock, then lock the file for sharing."""
    with contextlib.suppress(FolderInUseError):
        handle = _acquire(path)
        try:
            clean()
        finally:
            _release(handle, path)
    for _ in range(_TRIES):
        with contextlib.suppress(FolderInUseError):
            return _acquire(path, fcntl.LOCK_SH)
        time.sleep(_WAIT_S)
    return _acquire(path, fcntl.LOCK_SH)


def _acquire(path: Path, mode: int = fcntl.LOCK_EX) -> int:
    """Open and lock the file, alone or (LOCK_SH) with others, and write the name of this process to it."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except FileNotFoundError:  # its last holder removed the folder
            continue
        try:
            with name_errors(path):
                fcntl.flock(handle, mode | fcntl.LOCK_NB)
                if _is_file_of(handle, path):  # else its last holder deleted it after it was opened here
                    os.ftruncate(handle, 0)
                    os.pwrite(handle, _describe_process().encode(), 0)
                    return handle
        except BlockingIOError:
            holder = os.pread(handle, 4096, 0).decode(errors="replace").strip() or "another process"
            os.close(handle)
            raise FolderInUseError(
                f"{path.parent}: {holder} writes to this folder; wait until it has ended, or choose another --out."
            ) from None
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _is_file_of(handle: int, path: Path) -> bool:
    """Whether the open file is still the one with this name."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False


def _describe_process() -> str:
    """Id, host, time and command; the command's path is left out."""
    started = datetime.now(UTC).isoformat(timespec="seconds")
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return f"process {os.getpid()} on {socket.gethostname()} (since {started}: {command})\n"
