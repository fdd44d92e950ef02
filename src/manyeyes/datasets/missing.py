# SPDX-License-Identifier: Apache-2.0
"""Files of a recording that are missing or mismatched: the record of one, and the count of all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

MAX_LISTED = 100


@dataclass(frozen=True)
class FileProblem:
    """One file that is absent, or whose content does not belong to its frame.

    path: of the file, or of the folder where no single file can be named. scenario: whose numbers it changes; empty where
    that is not known. reason: how it was noticed.
    """

    path: Path
    kind: Literal["missing", "mismatched"]
    scenario: str
    reason: str

    def __str__(self) -> str:
        return f"{self.path}: {self.kind} ({self.reason})"


@dataclass(frozen=True)
class MissingFiles:
    """The number of files that are missing or mismatched, and the first MAX_LISTED of them in the order of paths."""

    count: int = 0
    files: tuple[FileProblem, ...] = ()

    @classmethod
    def of(cls, problems: Iterable[FileProblem]) -> MissingFiles:
        """Count every path once; of several problems of one path the first is kept."""
        by_path: dict[Path, FileProblem] = {}
        for problem in problems:
            by_path.setdefault(problem.path, problem)
        return cls(len(by_path), tuple(by_path[path] for path in sorted(by_path))[:MAX_LISTED])


NONE_MISSING = MissingFiles()
