# SPDX-License-Identifier: Apache-2.0
"""Rows of a stored table made again by the commands that stand in them, in processes of their own."""

from __future__ import annotations

import json
import os
import random
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manyeyes.datatypes import ConfigError

COMMAND = "command"
"""Field of a row."""


@dataclass(frozen=True)
class ResultFile:
    """A study's JSON. commit: of the sources that made it; empty where it is not stated."""

    path: Path
    study: str
    commit: str


@dataclass(frozen=True)
class StoredRow:
    """A row with the command that makes it alone."""

    fields: dict[str, Any]

    def command_on(self, data: Path | None) -> str:
        """Return the command, on another recording if one is given."""
        words = shlex.split(self.fields[COMMAND])
        if data is not None and "--data" in words:
            words[words.index("--data") + 1] = str(data)
        return shlex.join(words)

    def compare(self, again: dict[str, Any], tolerance: float = 0.0) -> tuple[str, ...]:
        """Return what differs in a row that was made again, one text for each value; its command may name other data."""
        stored, made = ({key: value for key, value in row.items() if key != COMMAND} for row in (self.fields, again))
        return tuple(_find_differences("", stored, made, tolerance))


def draw_rows(path: Path, count: int, seed: int) -> tuple[ResultFile, tuple[StoredRow, ...]]:
    """Read a stored table and draw rows of it, without replacement; all where there are fewer.

    Raises:
        ConfigError: the file is no stored table whose rows name their commands.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        origin, result = stored["provenance"], stored["result"]
        study, rows = str(result["study"]), [StoredRow(row) for row in result["rows"] if row[COMMAND]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{path}: no stored table whose rows name their commands ({error!r}); give the JSON of 'study main-table'."
        ) from error
    if not rows:
        raise ConfigError(f"{path}: the table has no row.")
    drawn = random.Random(seed).sample(rows, min(count, len(rows)))
    return ResultFile(path, study, str(origin.get("git_commit") or "")), tuple(drawn)


def clone_sources(commit: str, folder: Path) -> Path:
    """Clone the repository of these sources at a commit, and return the folder of the package in it.

    Raises:
        ConfigError: there is no such commit, or the sources had changes that no commit holds.
    """
    repository = Path(__file__).resolve().parents[3]
    if not commit or "+" in commit:
        raise ConfigError(
            f"The table names the commit {commit!r}, which a clone cannot have; make it from committed sources."
        )
    clone = ["git", "clone", "--quiet", "--no-checkout", str(repository), str(folder)]
    for command in (clone, ["git", "-C", str(folder), "checkout", "--quiet", commit]):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ConfigError(f"{shlex.join(command)} failed: {done.stderr.strip()}")
    return folder / "src"


def make_again(command: str, study: str, out: Path, sources: Path | None = None) -> dict[str, Any]:
    """Run the command of a row in a process of its own, and return the one row that it makes. sources: of the package; None: these.

    Raises:
        ConfigError: it fails, or makes another number of rows.
    """
    words = [sys.executable, "-m", "manyeyes.cli.main", *shlex.split(command)[1:], "--out", str(out)]
    package = sources or Path(__file__).resolve().parents[2]
    path = os.pathsep.join((str(package), *filter(None, [os.environ.get("PYTHONPATH")])))
    done = subprocess.run(words, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": path})
    if done.returncode:
        raise ConfigError(f"{command} failed: {done.stderr.strip()}")
    rows = json.loads((out / f"{study}.json").read_text(encoding="utf-8"))["result"]["rows"]
    if len(rows) != 1:
        raise ConfigError(f"{command} makes {len(rows)} rows instead of one; it is of another version.")
    return rows[0]


def _find_differences(name: str, stored: Any, again: Any, tolerance: float) -> Iterator[str]:
    if isinstance(stored, dict) and isinstance(again, dict):
        for key in dict.fromkeys((*stored, *again)):
            yield from _find_differences(f"{name}.{key}".lstrip("."), stored.get(key), again.get(key), tolerance)
    elif isinstance(stored, list) and isinstance(again, list) and len(stored) == len(again):
        for at, pair in enumerate(zip(stored, again)):
            yield from _find_differences(f"{name}[{at}]", pair[0], pair[1], tolerance)
    elif isinstance(stored, (int, float)) and isinstance(again, (int, float)):
        if abs(stored - again) > tolerance:
            yield f"{name}: {stored} in the table, {again} made again"
    elif stored != again:
        yield f"{name}: {stored} in the table, {again} made again"
