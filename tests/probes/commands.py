# SPDX-License-Identifier: Apache-2.0
"""Commands in forked processes, which share the imports of this one, and are killed at a time or at a file operation."""

from __future__ import annotations

import os
import signal
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from manyeyes.cli import main as cli

FILE_OPERATIONS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate")
"""Audit events that are counted where their first argument is a path below the folder of a run."""
CRASHED = 70
"""Exit code of an exception that no command designs."""


@dataclass(frozen=True)
class Outcome:
    """End of a command. code: its exit code, negative for a signal. text: its output."""

    pid: int
    code: int
    text: str
    seconds: float


@dataclass(frozen=True)
class Process:
    """A command that runs."""

    pid: int
    log: Path
    start: float

    def kill_after(self, seconds: float) -> None:
        """Kill the process after a time since its start, unless it has ended."""
        time.sleep(max(0.0, self.start + seconds - time.monotonic()))
        os.kill(self.pid, signal.SIGKILL)

    def wait(self) -> Outcome:
        """Wait for the end."""
        _, status = os.waitpid(self.pid, 0)
        seconds = time.monotonic() - self.start
        return Outcome(self.pid, os.waitstatus_to_exitcode(status), self.log.read_text(), seconds)


def start(words: Sequence[object], folder: Path, log: Path, last_operation: int | None = None) -> Process:
    """Start a command that writes to a folder; it kills itself before this file operation in the folder."""
    began, pid = time.monotonic(), os.fork()
    if pid:
        return Process(pid, log, began)
    code = CRASHED
    try:
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        _count_operations(folder, last_operation)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        sys.argv = ["manyeyes", *map(str, words)]
        code = cli.main(sys.argv[1:])
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def run(words: Sequence[object], folder: Path, log: Path) -> Outcome:
    """Run a command to its end, which is success."""
    outcome = start(words, folder, log).wait()
    assert outcome.code == 0, outcome.text
    return outcome


def run_here(words: Sequence[object], folder: Path) -> int:
    """Run a command in this process, whose imports and compiled loops later processes share; the number of file operations."""
    count = _count_operations(folder, None)
    assert cli.main([str(word) for word in words]) == 0
    return count[0]


def _count_operations(folder: Path, last: int | None) -> list[int]:
    """Count file operations in a folder from now on, in a list of one number; kill this process before the last one."""
    count, place = [0], f"{folder}{os.sep}"

    def note(event: str, arguments: tuple[object, ...]) -> None:
        if event in FILE_OPERATIONS and f"{arguments[0]}{os.sep}".startswith(place):
            count[0] += 1
            if count[0] == last:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(note)
    return count
