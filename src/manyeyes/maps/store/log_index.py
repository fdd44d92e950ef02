# SPDX-License-Identifier: Apache-2.0
"""SQLite index of an observation log (write-ahead log): file position and map position of each observation.

The files of the log are authoritative; the index contains nothing that cannot be rebuilt from them. Observations are found by
cells of 256 m, so that a program that walks over a city holds the rows of one place at a time.
"""

from __future__ import annotations

import contextlib
import errno
import math
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_VERSION = 4
CELL_M = 256.0
"""Side of the cells by which observations are found."""
_COUNTS = "id NOT IN (SELECT id FROM retracted) AND id NOT IN (SELECT id FROM failed)"
_COLUMNS = "id, segment, row_group, time_ns, x, y, reach_m"
_SCHEMA = {
    "entries": "(name TEXT PRIMARY KEY, rows INTEGER NOT NULL) WITHOUT ROWID",
    "observations": """(
        id BLOB PRIMARY KEY, segment TEXT NOT NULL, row_group INTEGER NOT NULL, time_ns INTEGER NOT NULL,
        agent TEXT NOT NULL, x REAL NOT NULL, y REAL NOT NULL, reach_m REAL NOT NULL, pass_id TEXT NOT NULL,
        cell_x INTEGER NOT NULL, cell_y INTEGER NOT NULL
    ) WITHOUT ROWID""",
    # Rows of segments that are outside the limits; each is in the quarantine too, with its reason.
    "refused": "(id BLOB PRIMARY KEY, agent TEXT NOT NULL, pass_id TEXT NOT NULL) WITHOUT ROWID",
    # Observations with which the fusion failed; each is in the quarantine too, with its reason.
    "failed": "(id BLOB PRIMARY KEY) WITHOUT ROWID",
    "retracted": "(id BLOB PRIMARY KEY, reason TEXT NOT NULL) WITHOUT ROWID",
    "quarantine": "(entry TEXT, file TEXT, row INTEGER, count INTEGER, reason TEXT)",
    # The limits that the segments were checked against when they were indexed.
    "checked": "(limits TEXT)",
}


@dataclass(frozen=True, eq=False)
class ActiveObservations:
    """Where O observations stand, ids ascending: (O,) columns; xy: (O, 2) metres; segment: number into ``segments``."""

    ids: tuple[str, ...]
    segments: tuple[str, ...]
    segment: Ints
    row_group: Ints
    time_ns: Ints
    xy: Floats
    radius_m: Floats

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class IndexRow:
    """One observation's row of the index."""

    id: str
    row_group: int
    time_ns: int
    agent: str
    x: float
    y: float
    radius_m: float
    pass_id: str


@dataclass(frozen=True)
class InvalidEntry:
    """One row of a segment that is outside the limits: its number in the segment, and why."""

    id: str
    agent: str
    pass_id: str
    row: int
    reason: str


class LogIndex:
    """The index of one log; one writer at a time, any number of readers."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        with self._open() as db:
            _create_tables(db)

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        """A connection whose changes are kept together when the block ends well, and not at all when it does not.

        Raises:
            OSError: the index cannot be read or written, as on a full disk; the log is complete without it.
        """
        try:
            with contextlib.closing(sqlite3.connect(self.path, timeout=60.0)) as db:
                db.execute("PRAGMA journal_mode = WAL")
                db.execute("PRAGMA synchronous = FULL")
                with db:
                    yield db
        except sqlite3.OperationalError as error:
            raise OSError(
                errno.EIO, f"{error}; free space or mend permissions, then run again", str(self.path)
            ) from error
        except sqlite3.DatabaseError as error:
            raise OSError(
                errno.EIO, f"{error}; delete this file: it is rebuilt from the log", str(self.path)
            ) from error

    def is_current(self, limits: str) -> bool:
        """Tell whether the index has this version's tables and was made under these limits."""
        with self._open() as db:
            (version,) = db.execute("PRAGMA user_version").fetchone()
            return version == _VERSION and db.execute("SELECT limits FROM checked").fetchall() == [(limits,)]

    def clear(self, limits: str) -> None:
        """Empty the index, so that it is made again from the log under these limits."""
        with self._open() as db:
            db.execute("BEGIN IMMEDIATE")
            for name in _SCHEMA:
                db.execute(f"DROP TABLE IF EXISTS {name}")
            _create_tables(db)
            db.execute("CREATE INDEX by_cell ON observations (cell_x, cell_y)")
            db.execute("INSERT INTO checked VALUES (?)", (limits,))
            db.execute(f"PRAGMA user_version = {_VERSION}")

    def entries(self) -> set[str]:
        """Return names of the log's files that are indexed."""
        with self._open() as db:
            return {name for (name,) in db.execute("SELECT name FROM entries")}

    def filter_known(self, ids: Iterable[str]) -> set[str]:
        """Return which of these observations are indexed, retracted and refused ones too."""
        return self._filter_ids(
            ids, "SELECT 1 FROM observations WHERE id = ?1 UNION ALL SELECT 1 FROM refused WHERE id = ?1"
        )

    def filter_retracted(self, ids: Iterable[str]) -> set[str]:
        """Return which of these observations are retracted."""
        return self._filter_ids(ids, "SELECT 1 FROM retracted WHERE id = ?1")

    def _filter_ids(self, ids: Iterable[str], query: str) -> set[str]:
        with self._open() as db:
            return {name for name in ids if db.execute(query, (bytes.fromhex(name),)).fetchone()}

    def ids_between(self, low: str, high: str) -> list[str]:
        """Return ids of indexed and refused observations from low to high, ascending."""
        query = "SELECT id FROM observations WHERE id BETWEEN ?1 AND ?2 UNION SELECT id FROM refused WHERE id BETWEEN ?1 AND ?2"
        return self._ids(query, (bytes.fromhex(low), bytes.fromhex(high)))

    def ids_of_sender(self, agent: str | None, pass_id: str | None) -> list[str]:
        """Return ids of indexed and refused observations of an agent, of a pass or of both, ascending; None: of any."""
        chosen = "(?1 IS NULL OR agent = ?1) AND (?2 IS NULL OR pass_id = ?2)"
        query = f"SELECT id FROM observations WHERE {chosen} UNION SELECT id FROM refused WHERE {chosen}"
        return self._ids(query, (agent, pass_id))

    def distinct_values(self, column: str) -> list[str]:
        """Return all values of the column ``agent`` or ``pass_id``, ascending."""
        with self._open() as db:
            rows = db.execute(f"SELECT {column} FROM observations UNION SELECT {column} FROM refused ORDER BY 1")
            return [name for (name,) in rows]

    def _ids(self, query: str, values: tuple[object, ...]) -> list[str]:
        with self._open() as db:
            return sorted(name.hex() for (name,) in db.execute(query, values))

    def add_segment(self, name: str, rows: Iterable[IndexRow], invalid: Iterable[InvalidEntry] = ()) -> None:
        """Index a segment of observations, and its rows that are none; one in two segments keeps its first place."""
        values = [
            (
                bytes.fromhex(r.id),
                name,
                r.row_group,
                r.time_ns,
                r.agent,
                r.x,
                r.y,
                r.radius_m,
                r.pass_id,
                *_cell(r.x, r.y),
            )
            for r in rows
        ]
        outside = list(invalid)
        with self._open() as db:
            db.executemany("INSERT OR IGNORE INTO observations VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", values)
            db.executemany(
                "INSERT OR IGNORE INTO refused VALUES (?, ?, ?)",
                [(bytes.fromhex(r.id), r.agent, r.pass_id) for r in outside],
            )
            db.executemany(
                "INSERT INTO quarantine VALUES (?, ?, ?, 1, ?)", [(name, name, r.row, r.reason) for r in outside]
            )
            db.execute("INSERT OR REPLACE INTO entries VALUES (?, ?)", (name, len(values) + len(outside)))

    def add_retraction(self, name: str, ids: Iterable[str], reason: str) -> None:
        """Index a retraction: these observations count no more."""
        values = [(bytes.fromhex(one), reason) for one in ids]
        with self._open() as db:
            db.executemany("INSERT OR IGNORE INTO retracted VALUES (?, ?)", values)
            db.execute("INSERT OR REPLACE INTO entries VALUES (?, ?)", (name, len(values)))

    def add_rejected(
        self, name: str, rows: Iterable[tuple[str, int, int, str]], failed_ids: Iterable[str] = ()
    ) -> None:
        """Index what an ingest or a fusion rejected: file, row, count, reason; failed_ids: observations that count no more."""
        values = [(name, *row) for row in rows]
        with self._open() as db:
            db.executemany("INSERT OR IGNORE INTO failed VALUES (?)", [(bytes.fromhex(one),) for one in failed_ids])
            db.executemany("INSERT INTO quarantine VALUES (?, ?, ?, ?, ?)", values)
            db.execute("INSERT OR REPLACE INTO entries VALUES (?, ?)", (name, len(values)))

    def list_rejected(self) -> list[tuple[str, int, int, str]]:
        """Everything that was rejected, in the order of the log."""
        with self._open() as db:
            return list(db.execute("SELECT file, row, count, reason FROM quarantine ORDER BY entry, file, row"))

    def active_observations(self) -> ActiveObservations:
        """Return all observations that count."""
        with self._open() as db:
            return _to_active(db.execute(f"SELECT {_COLUMNS} FROM observations WHERE {_COUNTS} ORDER BY id").fetchall())

    def active_within(self, area: tuple[float, float, float, float]) -> ActiveObservations:
        """Return the observations that count and stand in an area (x0, y0, x1, y1; metres), and some around it."""
        (low_x, low_y), (high_x, high_y) = _cell(area[0], area[1]), _cell(area[2], area[3])
        query = f"SELECT {_COLUMNS} FROM observations WHERE cell_x = ? AND cell_y BETWEEN ? AND ? AND {_COUNTS}"
        with self._open() as db:
            rows = [row for x in range(low_x, high_x + 1) for row in db.execute(query, (x, low_y, high_y))]
        return _to_active(sorted(rows, key=lambda row: row[0]))

    def active_with_ids(self, ids: Iterable[str]) -> ActiveObservations:
        """Return those of these observations that count."""
        query = f"SELECT {_COLUMNS} FROM observations WHERE id = ? AND {_COUNTS}"
        with self._open() as db:
            rows = [row for name in sorted(set(ids)) for row in db.execute(query, (bytes.fromhex(name),))]
        return _to_active(rows)

    def active_cells(self) -> tuple[list[tuple[int, int]], float]:
        """Return the cells where observations stand that count, ascending, and the largest radius of one (m)."""
        query = f"SELECT cell_x, cell_y, max(reach_m) FROM observations WHERE {_COUNTS} GROUP BY cell_x, cell_y ORDER BY 1, 2"
        with self._open() as db:
            rows = db.execute(query).fetchall()
        return [(x, y) for x, y, _ in rows], max((radius for *_, radius in rows), default=0.0)

    def iterate_active(self) -> Iterator[tuple[str, int]]:
        """Iterate over id and time (ns) of all observations that count, ids ascending."""
        with self._open() as db:
            for name, time_ns in db.execute(f"SELECT id, time_ns FROM observations WHERE {_COUNTS} ORDER BY id"):
                yield name.hex(), time_ns


def _cell(x: float, y: float) -> tuple[int, int]:
    return math.floor(x / CELL_M), math.floor(y / CELL_M)


def _to_active(rows: list[tuple[Any, ...]]) -> ActiveObservations:
    """Return rows of _COLUMNS, ids ascending, as columns."""
    segments = tuple(sorted({row[1] for row in rows}))
    number = {name: k for k, name in enumerate(segments)}
    return ActiveObservations(
        ids=tuple(row[0].hex() for row in rows),
        segments=segments,
        segment=np.array([number[row[1]] for row in rows], np.int64),
        row_group=np.array([row[2] for row in rows], np.int64),
        time_ns=np.array([row[3] for row in rows], np.int64),
        xy=np.array([row[4:6] for row in rows], np.float64).reshape(-1, 2),
        radius_m=np.array([row[6] for row in rows], np.float64),
    )


def _create_tables(db: sqlite3.Connection) -> None:
    for name, columns in _SCHEMA.items():
        db.execute(f"CREATE TABLE IF NOT EXISTS {name} {columns}")
