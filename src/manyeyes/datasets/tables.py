# SPDX-License-Identifier: Apache-2.0
"""Tables of numbers in CSV files, by the names of their columns."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from manyeyes._io import MAX_TEXT_BYTES, read_file
from manyeyes.datatypes import RecordingError
from manyeyes.datatypes.errors import shorten


@dataclass(frozen=True)
class Table:
    """The rows of a CSV file below its first line, which names the columns."""

    path: Path
    names: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @classmethod
    def read(cls, path: Path) -> Table:
        """Read a file of comma-separated values; empty lines and spaces around values do not count."""
        try:
            text = read_file(path, MAX_TEXT_BYTES).decode("utf-8-sig")
            lines = [tuple(word.strip() for word in row) for row in csv.reader(text.splitlines()) if any(row)]
        except FileNotFoundError:
            raise RecordingError(f"{path}: no such file, expected a table; write one.") from None
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise RecordingError(
                f"{path}: cannot be read as a table ({reason}); write comma-separated values."
            ) from None
        if not lines:
            raise RecordingError(f"{path}: empty, expected a first line with the names of the columns; write it.")
        for number, row in enumerate(lines[1:], 2):
            if len(row) != len(lines[0]):
                raise RecordingError(
                    f"{path}: {len(row)} values in row {number}, expected {len(lines[0])} as in the first; correct the row."
                )
        return cls(path, lines[0], tuple(lines[1:]))

    def require(self, *names: str) -> None:
        """Refuse a table that lacks a column."""
        missing = [name for name in names if name not in self.names]
        if missing:
            raise RecordingError(
                f"{self.path}: expected the columns {', '.join(missing)}, found {shorten(', '.join(self.names))}; add them."
            )

    def texts(self, name: str) -> list[str]:
        """Return a column as it stands in the file."""
        at = self.names.index(name)
        return [row[at] for row in self.rows]

    def numbers(self, *names: str) -> np.ndarray:
        """Return columns (rows, columns) of finite numbers, float64."""
        self.require(*names)
        return np.stack([self._column(name, float) for name in names], 1).reshape(len(self.rows), len(names))

    def integers(self, name: str) -> np.ndarray:
        """Return a column (rows,) of whole numbers, int64; floating-point numbers would lose nanoseconds."""
        self.require(name)
        return self._column(name, int)

    def _column(self, name: str, kind: type[float] | type[int]) -> np.ndarray:
        values: list[float] = []
        for number, text in enumerate(self.texts(name), 2):
            try:
                value = kind(text)
                if not abs(value) < 2**63:
                    raise ValueError
            except (ValueError, OverflowError):
                what = "a finite number" if kind is float else "a whole number"
                raise RecordingError(
                    f"{self.path}: expected {what} at '{name}' in row {number}, found {shorten(text)}; correct it."
                ) from None
            values.append(value)
        return np.array(values, np.float64 if kind is float else np.int64)
