# SPDX-License-Identifier: Apache-2.0
"""Exclusive locks on the folders that commands write to."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shlex
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from manyeyes._io import name_errors
from manyeyes.datatypes.errors import ManyeyesError

LOCK = ".lock"
"""Name of the lock file in a folder; it names the process that holds the lock, and is deleted with the lock."""


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
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    path = folder / LOCK
    handle = _acquire(path)
    try:
        yield
    finally:
        if _is_file_of(handle, path):
            path.unlink()
        os.close(handle)
        with contextlib.suppress(OSError):  # not empty
            for made_folder in made:
                made_folder.rmdir()


def _acquire(path: Path) -> int:
    """Open and lock the file, and write the name of this process to it."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except FileNotFoundError:  # its last holder removed the folder
            continue
        try:
            with name_errors(path):
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
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
    time = datetime.now(UTC).isoformat(timespec="seconds")
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return f"process {os.getpid()} on {socket.gethostname()} (since {time}: {command})\n"
