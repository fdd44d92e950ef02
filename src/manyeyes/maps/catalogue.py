# SPDX-License-Identifier: Apache-2.0
"""An index of an observation log in SQLite (write-ahead log): where each observation stands, and where on the ground.

The files of the log are the truth; the index can be made again from them and says nothing that they do not.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_VERSION = 1
_SCHEMA = """
CREATE TABLE IF NOT EXISTS entries (name TEXT PRIMARY KEY, rows INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS observations (
    id BLOB PRIMARY KEY, segment TEXT NOT NULL, row_group INTEGER NOT NULL, time_ns INTEGER NOT NULL,
    agent TEXT NOT NULL, x REAL NOT NULL, y REAL NOT NULL, reach_m REAL NOT NULL
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS retracted (id BLOB PRIMARY KEY, reason TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS quarantine (entry TEXT, file TEXT, row INTEGER, count INTEGER, reason TEXT);
"""


@dataclass(frozen=True, eq=False)
class Standing:
    """Where O observations stand, ids ascending: (O,) columns; xy: (O, 2) metres; segment: number into ``segments``."""

    ids: tuple[str, ...]
    segments: tuple[str, ...]
    segment: Ints
    row_group: Ints
    time_ns: Ints
    xy: Floats
    reach_m: Floats

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class Indexed:
    """One observation's row of the index."""

    id: str
    row_group: int
    time_ns: int
    agent: str
    x: float
    y: float
    reach_m: float


class Catalogue:
    """The index of one log; one writer at a time, any number of readers."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        with self._open() as db:
            db.executescript(_SCHEMA)
            db.execute(f"PRAGMA user_version = {_VERSION}")

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        """A connection whose changes are kept together when the block ends well, and not at all when it does not."""
        with contextlib.closing(sqlite3.connect(self.path, timeout=60.0)) as db:
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = FULL")
            with db:
                yield db

    def entries(self) -> set[str]:
        """Names of the log's files that are indexed."""
        with self._open() as db:
            return {name for (name,) in db.execute("SELECT name FROM entries")}

    def known(self, ids: Iterable[str]) -> set[str]:
        """Which of these observations are indexed, retracted ones too."""
        with self._open() as db:
            found = set()
            for name in ids:
                if db.execute("SELECT 1 FROM observations WHERE id = ?", (bytes.fromhex(name),)).fetchone():
                    found.add(name)
            return found

    def add_segment(self, name: str, rows: Iterable[Indexed]) -> None:
        """Index a segment of observations; one that stands in two segments keeps its first place."""
        values = [(bytes.fromhex(r.id), name, r.row_group, r.time_ns, r.agent, r.x, r.y, r.reach_m) for r in rows]
        with self._open() as db:
            db.executemany("INSERT OR IGNORE INTO observations VALUES (?, ?, ?, ?, ?, ?, ?, ?)", values)
            db.execute("INSERT OR REPLACE INTO entries VALUES (?, ?)", (name, len(values)))

    def add_retraction(self, name: str, ids: Iterable[str], reason: str) -> None:
        """Index a retraction: these observations count no more."""
        values = [(bytes.fromhex(one), reason) for one in ids]
        with self._open() as db:
            db.executemany("INSERT OR IGNORE INTO retracted VALUES (?, ?)", values)
            db.execute("INSERT OR REPLACE INTO entries VALUES (?, ?)", (name, len(values)))

    def add_quarantine(self, name: str, rows: Iterable[tuple[str, int, int, str]]) -> None:
        """Index what an ingest put aside: file, row, count, reason."""
        values = [(name, *row) for row in rows]
        with self._open() as db:
            db.executemany("INSERT INTO quarantine VALUES (?, ?, ?, ?, ?)", values)
            db.execute("INSERT OR REPLACE INTO entries VALUES (?, ?)", (name, len(values)))

    def quarantined(self) -> list[tuple[str, int, int, str]]:
        """Everything that was put aside, in the order of the log."""
        with self._open() as db:
            return list(db.execute("SELECT file, row, count, reason FROM quarantine ORDER BY entry, file, row"))

    def standing(self) -> Standing:
        """All observations that count."""
        with self._open() as db:
            rows = db.execute(
                "SELECT id, segment, row_group, time_ns, x, y, reach_m FROM observations "
                "WHERE id NOT IN (SELECT id FROM retracted) ORDER BY id"
            ).fetchall()
        segments = tuple(sorted({row[1] for row in rows}))
        number = {name: k for k, name in enumerate(segments)}
        return Standing(
            ids=tuple(row[0].hex() for row in rows),
            segments=segments,
            segment=np.array([number[row[1]] for row in rows], np.int64),
            row_group=np.array([row[2] for row in rows], np.int64),
            time_ns=np.array([row[3] for row in rows], np.int64),
            xy=np.array([row[4:6] for row in rows], np.float64).reshape(-1, 2),
            reach_m=np.array([row[6] for row in rows], np.float64),
        )
