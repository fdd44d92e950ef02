# SPDX-License-Identifier: Apache-2.0
"""An append-only log of observations: Parquet segments that are never changed, and an index beside them.

An entry is one file: a segment of observations (docs/observation.md), a retraction, or what an ingest put aside; its name is
its number and a hash of its content. An entry is written under another name, flushed and renamed, then indexed: a writer that
is killed leaves the log without the entry or with it, and one that is there but not indexed is indexed when the log is opened
to be written.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ManyeyesError, MissingExtraError
from manyeyes.maps.catalogue import Catalogue, Indexed, Standing
from manyeyes.maps.observation import Frame, Observation
from manyeyes.maps.observation_file import Quarantined, observation_table, observations_of, read_observations
from manyeyes.maps.whole_file import remove_unfinished, replacing, write_whole

TILE_M = 256.0
# Observations of a tile stand together, so that reading a tile decodes little else.
_ROWS_A_GROUP = 128


class StoreError(ManyeyesError):
    """A store that is damaged, locked, or of another frame or version; the text names the file and the remedy."""


@dataclass(frozen=True)
class Ingested:
    """What one ingest did: observations added, those that were there already, and what was put aside."""

    added: int
    known: int
    quarantined: tuple[Quarantined, ...]


class ObservationLog:
    """The log in a folder; frame: of all its poses."""

    def __init__(self, folder: Path, frame: Frame) -> None:
        self.folder, self.frame = folder, frame
        self.catalogue = Catalogue(folder.parent / "catalogue.sqlite")

    def recover(self) -> None:
        """Index entries that a killed writer left without; the caller holds the lock."""
        self.folder.mkdir(parents=True, exist_ok=True)
        remove_unfinished(self.folder)
        indexed = self.catalogue.entries()
        for path in sorted(self.folder.iterdir()):
            if path.name not in indexed:
                self._index(path)

    def ingest(self, source: Path | str) -> Ingested:
        """Read a file or folder of observations, append the new ones, and keep a record of what was put aside."""
        reading = read_observations(source, self.frame)
        added, known = self.append(reading.observations)
        if reading.quarantined:
            rows = [[q.file, q.row, q.count, q.reason] for q in reading.quarantined]
            text = json.dumps({"quarantined": rows}, indent=1).encode()
            path = self.folder / self._name(hashlib.blake2b(text, digest_size=8).hexdigest(), "quarantine.json")
            write_whole(path, text)
            self._index(path)
        return Ingested(added, known, reading.quarantined)

    def append(self, observations: Sequence[Observation]) -> tuple[int, int]:
        """Append those that are not there yet as one segment: (added, known)."""
        once = {o.id: o for o in observations}
        known = self.catalogue.known(once)
        fresh = [o for name, o in once.items() if name not in known]
        if fresh:
            fresh = _by_place(fresh)
            digest = hashlib.blake2b("".join(o.id for o in fresh).encode(), digest_size=8).hexdigest()
            path = self.folder / self._name(digest, "parquet")
            self._write_segment(fresh, path)
            self.catalogue.add_segment(path.name, _indexed(fresh))
        return len(fresh), len(observations) - len(fresh)

    def retract(self, ids: Sequence[str], reason: str) -> None:
        """Append that these observations count no more, for privacy or because they were made up; unknown ids are an error."""
        missing = sorted(set(ids) - self.catalogue.known(ids))
        if missing:
            raise StoreError(
                f"{self.folder}: no observation {missing[0]} to retract; {len(missing)} of {len(ids)} are unknown."
            )
        text = json.dumps({"retracted": sorted(set(ids)), "reason": reason}, indent=1).encode()
        path = self.folder / self._name(hashlib.blake2b(text, digest_size=8).hexdigest(), "retract.json")
        write_whole(path, text)
        self._index(path)

    def standing(self) -> Standing:
        """Where every observation that counts stands."""
        return self.catalogue.standing()

    def _write_segment(self, observations: Sequence[Observation], path: Path) -> None:
        parquet = _parquet()
        table = observation_table(observations, self.frame)
        with replacing(path) as temporary:
            parquet.write_table(
                table, temporary, compression="zstd", row_group_size=_ROWS_A_GROUP, write_page_checksum=True
            )

    def _name(self, digest: str, kind: str) -> str:
        numbers = [int(path.name.split("-")[0]) for path in self.folder.iterdir() if path.name[0] != "."]
        return f"{max(numbers, default=0) + 1:08d}-{digest}.{kind}"

    def _index(self, path: Path) -> None:
        if path.name.endswith(".parquet"):
            found = [o for group in range(_groups(path)) for o in read_groups(path, [group])]
            self.catalogue.add_segment(path.name, _indexed(found))
            return
        content = json.loads(path.read_bytes())
        if path.name.endswith(".retract.json"):
            self.catalogue.add_retraction(path.name, content["retracted"], content["reason"])
        elif path.name.endswith(".quarantine.json"):
            self.catalogue.add_quarantine(path.name, [tuple(row) for row in content["quarantined"]])
        else:
            raise StoreError(f"{path}: no entry of a log of observations; move the file elsewhere.")


def read_groups(segment: Path, groups: Sequence[int]) -> list[Observation]:
    """The observations of some row groups of a segment, in their order."""
    parquet = _parquet()
    from pyarrow import ArrowException

    try:
        opened = parquet.ParquetFile(segment, page_checksum_verification=True)
        table = opened.read_row_groups(list(groups))
    except (ArrowException, OSError) as error:
        reason = " ".join(str(error).split())
        raise StoreError(f"{segment}: expected a whole segment of the log; {reason}. Restore it from a copy.") from None
    out: list[Observation] = []
    for row, item in observations_of(table):
        if isinstance(item, str):
            raise StoreError(f"{segment}: row {row} of groups {list(groups)[:3]}: {item} Restore the file from a copy.")
        out.append(item)
    return out


def read_standing(folder: Path, standing: Standing, rows: NDArray[np.int64]) -> list[Observation]:
    """The observations in these rows of the index, ids ascending."""
    wanted = {standing.ids[row] for row in rows.tolist()}
    out: dict[str, Observation] = {}
    for number in np.unique(standing.segment[rows]).tolist():
        groups = np.unique(standing.row_group[rows[standing.segment[rows] == number]]).tolist()
        for o in read_groups(folder / standing.segments[number], groups):
            if o.id in wanted:
                out[o.id] = o
    missing = wanted - set(out)
    if missing:
        raise StoreError(
            f"{folder}: observation {min(missing)} is indexed but not there; restore its segment from a copy."
        )
    return [out[name] for name in sorted(out)]


def tile_of(xy: NDArray[np.float64], size_m: float = TILE_M) -> NDArray[np.int64]:
    """(N, 2) column and row of the tile that each point (N, 2) lies in; tiles are half open and anchored at the origin."""
    return np.floor(np.asarray(xy, np.float64).reshape(-1, 2) / size_m).astype(np.int64)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a store's lock, which the system takes back from a program that is killed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StoreError(
                f"{path.parent}: another program is writing to this store; try again when it has ended."
            ) from None
        yield
    finally:
        os.close(handle)


def _by_place(observations: Sequence[Observation]) -> list[Observation]:
    """By tile, rows of tiles in turn, then by id."""
    tiles = tile_of(np.array([o.pose[:2] for o in observations]))
    keys: list[tuple[Any, ...]] = [(*tile, o.id) for tile, o in zip(tiles[:, ::-1].tolist(), observations)]
    return [observations[k] for k in sorted(range(len(keys)), key=keys.__getitem__)]


def _indexed(observations: Sequence[Observation]) -> list[Indexed]:
    return [
        Indexed(o.id, k // _ROWS_A_GROUP, o.time_ns, o.agent, float(o.pose[0]), float(o.pose[1]), reach_of(o))
        for k, o in enumerate(observations)
    ]


def reach_of(o: Observation) -> float:
    """Metres from the agent to the farthest point that it saw or could have seen."""
    points = np.concatenate((o.view, o.elements.points))
    return float(np.hypot(points[:, 0], points[:, 1]).max())


def _groups(path: Path) -> int:
    parquet = _parquet()
    from pyarrow import ArrowException

    try:
        return parquet.ParquetFile(path).num_row_groups
    except (ArrowException, OSError) as error:
        reason = " ".join(str(error).split())
        raise StoreError(f"{path}: expected a whole segment of the log; {reason}. Restore it from a copy.") from None


def _parquet() -> Any:
    try:
        from pyarrow import parquet
    except ImportError:
        raise MissingExtraError("map", "A log of observations") from None
    return parquet
