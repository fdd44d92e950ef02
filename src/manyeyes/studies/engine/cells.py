# SPDX-License-Identifier: Apache-2.0
"""Cells: results of a study, each stored in a file, so that a study that was stopped goes on where it was.

A file's name holds a digest of all that the result depends on: its key, and the import closure of the code that computes it. A
change of any of them computes the cell again, and so does a damaged file.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from inspect import getsource
from pathlib import Path
from typing import Any, Generic, TypeVar

from manyeyes._records import load_record, save_record
from manyeyes._source import source_digest
from manyeyes.datasets.base import Recording

T = TypeVar("T")


@dataclass(frozen=True)
class Cell(Generic[T]):
    """One result. name: begins the file's name. kind: the result's type. key: its ``repr`` holds every argument that the result
    depends on. modules: their import closure computes it.
    """

    name: str
    kind: Any
    key: object
    modules: tuple[str, ...]


@dataclass(frozen=True)
class CellStore:
    """A folder of cells."""

    folder: Path

    def path(self, cell: Cell[Any]) -> Path:
        """Return the file of a cell, whether it is there or not."""
        digest = hashlib.blake2b(repr((cell.key, source_digest(*cell.modules))).encode(), digest_size=8).hexdigest()
        return self.folder / f"{cell.name}-{digest}.cell"

    def load(self, cell: Cell[T]) -> T | None:
        """Load a stored result; None where there is none, or a damaged one."""
        return load_record(self.path(cell), cell.kind)

    def save(self, cell: Cell[T], result: T) -> None:
        """Store a result, whole or not at all; several processes may store into one folder."""
        save_record(self.path(cell), result, durable=True)

    def load_or_compute(self, cell: Cell[T], compute: Callable[[], T]) -> T:
        """Load a result, or compute and store it."""
        result = self.load(cell)
        if result is None:
            result = compute()
            self.save(cell, result)
        return result


def third_party_source(*items: object) -> str:
    """Join the sources of the modules of functions, classes or objects that are not of this package; the closure lacks them."""
    modules = dict.fromkeys(getattr(item, "__module__", "") for item in items)
    return "".join(getsource(sys.modules[name]) for name in modules if name and not name.startswith("manyeyes."))


def hash_recording(recording: Recording) -> str:
    """Hash the first evaluated snapshot of each scenario: agents, poses, clouds, truth."""
    digest = hashlib.blake2b(digest_size=8)
    for scenario in recording.scenarios:
        eval_indices = recording.eval_indices(scenario)
        digest.update(repr((scenario, recording.length(scenario), eval_indices, recording.agents(scenario))).encode())
        first = recording.snapshot(scenario, eval_indices.start)
        for frame in first.frames:
            digest.update(frame.points.xyz.numpy().tobytes())
            digest.update(frame.world_from_agent.matrix().numpy().tobytes())
        if first.truth is not None:
            digest.update(first.truth.boxes.center.numpy().tobytes())
    return digest.hexdigest()
