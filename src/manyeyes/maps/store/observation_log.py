# SPDX-License-Identifier: Apache-2.0
"""An append-only log of observations: Parquet segments that are never changed, and an index beside them.

An entry is one object: a segment of observations (docs/reference/map-observations.md), a retraction, or what an ingest rejected;
its name is its number and a hash of its content. An entry is written whole, then indexed: a writer that is killed leaves the log
without the entry or with it, and one that is there but not indexed is indexed when the log is opened to be written.
"""

from __future__ import annotations

import difflib
import hashlib
import io
import json
from collections.abc import Sequence, Set
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.extras import import_extra
from manyeyes.maps.elements.observation import MapFrame, Observation, shorten
from manyeyes.maps.elements.observation_file import (
    InvalidRow,
    RejectedRows,
    iterate_rows,
    observation_table,
    read_observations,
)
from manyeyes.maps.elements.observation_limits import LIMITS
from manyeyes.maps.isolation import FailedObservation, reject_failed
from manyeyes.maps.store.log_index import CELL_M, ActiveObservations, IndexRow, InvalidEntry, LogIndex
from manyeyes.maps.store.object_store import ObjectStore, StoreError

_parquet = partial(import_extra, "pyarrow.parquet", "map", "A log of observations")

TILE_M = CELL_M
LOG = "log"
# Observations of a tile stand together, so that reading a tile decodes little else.
_ROW_GROUP_SIZE = 128
_ID_DIGITS = 32


@dataclass(frozen=True)
class IngestResult:
    """What one ingest did: observations added, those that were there already, and what was rejected."""

    num_added: int
    num_known: int
    rejected: tuple[RejectedRows, ...]


class ObservationLog:
    """The log in a store; frame: of all its poses.

    index_is_cache: the index may be of another time: one that names more than the log has is made again.

    rejected: observations of segments that were found to be outside the limits, or with which a fusion failed, since this object
        was made; the index lists all.
    """

    def __init__(self, objects: ObjectStore, frame: MapFrame, index: Path, index_is_cache: bool = False) -> None:
        self.objects, self.frame, self.index_is_cache = objects, frame, index_is_cache
        self.index = LogIndex(index)
        self.place = f"{objects.location}/{LOG}"
        self.rejected: tuple[RejectedRows, ...] = ()

    def recover(self) -> None:
        """Index entries that a killed writer left without, or all under new limits; the caller holds the lock."""
        names = self._names()
        stale = self.index_is_cache and not self.index.entries() <= set(names)
        if stale or not self.index.is_current(repr(LIMITS)):
            self.index.clear(repr(LIMITS))
        indexed = self.index.entries()
        for name in names:
            if name not in indexed:
                self._index(name)

    def _names(self) -> list[str]:
        return [key.removeprefix(f"{LOG}/") for key in self.objects.list(LOG)]

    def ingest(self, source: Path | str) -> IngestResult:
        """Read a file or folder of observations, append the new ones, and keep a record of what was rejected."""
        reading = read_observations(source, self.frame)
        added, known = self.append(reading.observations)
        if reading.rejected:
            self._append_quarantine(reading.rejected)
        return IngestResult(added, known, reading.rejected)

    def quarantine(self, failures: Sequence[FailedObservation]) -> tuple[RejectedRows, ...]:
        """Append that the fusion fails with these observations, which count no more; returns a record of each."""
        active = self.index.active_with_ids(one.id for one in failures)
        stored = {o.id: o for o in read_active(self.objects, active, np.arange(len(active)))}
        rows = [active.ids.index(one.id) for one in failures]
        rejected = tuple(
            reject_failed(f"{self.place}/{active.segments[active.segment[row]]}", stored[one.id], one.reason)
            for row, one in zip(rows, failures)
        )
        self._append_quarantine(rejected, [one.id for one in failures])
        self.rejected += rejected
        return rejected

    def _append_quarantine(self, rejected: Sequence[RejectedRows], failed_ids: Sequence[str] = ()) -> None:
        rows = [[q.file, q.row, q.count, q.reason] for q in rejected]
        text = json.dumps({"quarantined": rows, "failed": list(failed_ids)}, indent=1).encode()
        self._add(text, "quarantine.json")

    def append(self, observations: Sequence[Observation]) -> tuple[int, int]:
        """Append those that are not there yet as one segment: (added, known)."""
        unique = {o.id: o for o in observations}
        known = self.index.filter_known(unique)
        new = [o for name, o in unique.items() if name not in known]
        if new:
            new = _sort_by_tile(new)
            digest = hashlib.blake2b("".join(o.id for o in new).encode(), digest_size=8).hexdigest()
            name = self._name(digest, "parquet")
            self.objects.put(f"{LOG}/{name}", self._segment_bytes(new))
            self.index.add_segment(name, [_to_index_row(o, k // _ROW_GROUP_SIZE) for k, o in enumerate(new)])
        return len(new), len(observations) - len(new)

    def find(self, ids: Sequence[str] = (), agent: str | None = None, pass_id: str | None = None) -> tuple[str, ...]:
        """Find observations by id or the start of one, or by agent and pass; retracted and refused ones too.

        Returns:
            Full ids, each once.

        Raises:
            StoreError: an id is not hexadecimal, is unknown or is the start of several; no such agent or pass.
        """
        found = {name for one in ids for name in self._ids_starting_with(one)}
        if agent is not None or pass_id is not None:
            sent = self.index.ids_of_sender(agent, pass_id)
            if not sent:
                raise StoreError(f"{self.place}: no observation of {self._describe_unknown(agent, pass_id)}")
            found.update(sent)
        return tuple(sorted(found))

    def _ids_starting_with(self, start: str) -> list[str]:
        digits = start.lower()
        if not 0 < len(digits) <= _ID_DIGITS or set(digits) - set("0123456789abcdef"):
            raise StoreError(f"An id is 32 hexadecimal digits, or the first of them; got '{shorten(start)}'.")
        found = self.index.ids_between(digits.ljust(_ID_DIGITS, "0"), digits.ljust(_ID_DIGITS, "f"))
        if len(found) != 1:
            count = f"{len(found)} observations have" if found else "no observation has"
            remedy = "give more digits." if found else "ids are those that a map or a quarantine names."
            raise StoreError(f"{self.place}: {count} an id that starts with {digits}; {remedy}")
        return found

    def _describe_unknown(self, agent: str | None, pass_id: str | None) -> str:
        """Name what is not there, with the nearest name that is."""
        for column, word, name in (("agent", "agent", agent), ("pass_id", "pass", pass_id)):
            if name is not None and name not in (known := self.index.distinct_values(column)):
                close = difflib.get_close_matches(name, known, 1)
                hint = f"did you mean '{close[0]}'?" if close else f"there are {len(known)} others."
                return f"{word} '{shorten(name)}'; {hint}"
        return f"agent '{agent}' in pass '{pass_id}', though both are known."

    def retract(self, ids: Sequence[str], reason: str) -> int:
        """Append that these observations count no more, for privacy or because they were made up; unknown ids are an error.

        Returns:
            How many counted until now; where none did, nothing is appended.
        """
        missing = sorted(set(ids) - self.index.filter_known(ids))
        if missing:
            raise StoreError(
                f"{self.place}: no observation {missing[0]} to retract; {len(missing)} of {len(ids)} are unknown."
            )
        fresh = sorted(set(ids) - self.index.filter_retracted(ids))
        if fresh:
            text = json.dumps({"retracted": fresh, "reason": reason}, indent=1).encode()
            self._add(text, "retract.json")
        return len(fresh)

    def active_observations(self) -> ActiveObservations:
        """Where every observation that counts stands."""
        return self.index.active_observations()

    def _segment_bytes(self, observations: Sequence[Observation]) -> bytes:
        parquet, file = _parquet(), io.BytesIO()
        table = observation_table(observations, self.frame)
        parquet.write_table(table, file, compression="zstd", row_group_size=_ROW_GROUP_SIZE, write_page_checksum=True)
        return file.getvalue()

    def _name(self, digest: str, kind: str) -> str:
        numbers = [int(name.split("-")[0]) for name in self._names()]
        return f"{max(numbers, default=0) + 1:08d}-{digest}.{kind}"

    def _add(self, text: bytes, kind: str) -> None:
        """Append an entry of text and index it."""
        name = self._name(hashlib.blake2b(text, digest_size=8).hexdigest(), kind)
        self.objects.put(f"{LOG}/{name}", text)
        self._index(name)

    def _index(self, name: str) -> None:
        if name.endswith(".parquet"):
            self._index_segment(name)
            return
        if name.endswith(".retract.json"):
            content = json.loads(self.objects.get(f"{LOG}/{name}"))
            self.index.add_retraction(name, content["retracted"], content["reason"])
        elif name.endswith(".quarantine.json"):
            content = json.loads(self.objects.get(f"{LOG}/{name}"))
            rows = [tuple(row) for row in content["quarantined"]]
            self.index.add_rejected(name, rows, content.get("failed", ()))
        else:
            raise StoreError(f"{self.place}/{name}: no entry of a log of observations; move the file elsewhere.")

    def _index_segment(self, name: str) -> None:
        """Index the observations of a segment; rows outside the limits are rejected."""
        rows: list[IndexRow] = []
        invalid: list[InvalidEntry] = []
        for group in range(_count_groups(self.objects, name)):
            for item in _read_rows(self.objects, name, [group]):
                if isinstance(item, Observation):
                    rows.append(_to_index_row(item, group))
                else:
                    number = len(rows) + len(invalid)
                    reason = f"{item.reason} Its id is {item.id}."
                    invalid.append(InvalidEntry(item.id, item.agent, item.pass_id, number, reason))
        self.index.add_segment(name, rows, invalid)
        self.rejected += tuple(RejectedRows(f"{self.place}/{name}", r.row, 1, r.reason) for r in invalid)


def _read_rows(
    objects: ObjectStore, segment: str, groups: Sequence[int], ids: Set[str] | None = None
) -> list[Observation | InvalidRow]:
    """Read the rows of some row groups, or those of some indexed ids alone; a row that is no observation has the id of its content.

    Such a row is what an older version, with wider limits, wrote. Any other wrong row is damage, hence a StoreError.
    """
    parquet, place = _parquet(), f"{objects.location}/{LOG}/{segment}"
    from pyarrow import ArrowException

    try:
        with objects.open(f"{LOG}/{segment}") as file:
            table = parquet.ParquetFile(file, page_checksum_verification=True).read_row_groups(list(groups))
        if ids is not None:
            table = table.filter(np.array([name in ids for name in table["id"].to_pylist()], bool))
    except (ArrowException, OSError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise StoreError(f"{place}: expected a whole segment of the log; {reason}. Restore it from a copy.") from None
    out = list(iterate_rows(table, ids or frozenset()))
    for row, item in enumerate(out):
        if isinstance(item, InvalidRow) and not item.id:
            stated = shorten(table["id"][row].as_py()) if "id" in table.column_names else "none"
            raise StoreError(
                f"{place}: groups {list(groups)[:3]}, observation with id {stated}: {item.reason} Restore the file from a copy."
            )
    return out


def read_active(objects: ObjectStore, active: ActiveObservations, row_indices: NDArray[np.int64]) -> list[Observation]:
    """Return the observations in these rows of the index, ids ascending."""
    wanted_ids = {active.ids[row] for row in row_indices.tolist()}
    out: dict[str, Observation] = {}
    for number in np.unique(active.segment[row_indices]).tolist():
        groups = np.unique(active.row_group[row_indices[active.segment[row_indices] == number]]).tolist()
        for o in _read_rows(objects, active.segments[number], groups, wanted_ids):
            # Rows outside the limits are left out.
            if isinstance(o, Observation):
                out[o.id] = o
    missing = wanted_ids - set(out)
    if missing:
        raise StoreError(
            f"{objects.location}/{LOG}: observation {min(missing)} is indexed but not there; restore its segment from a copy."
        )
    return [out[name] for name in sorted(out)]


def tile_indices(xy: NDArray[np.float64], tile_size_m: float = TILE_M) -> NDArray[np.int64]:
    """Return (N, 2) column and row of the tile that each point (N, 2) lies in; tiles are half open and anchored at the origin."""
    return np.floor(np.asarray(xy, np.float64).reshape(-1, 2) / tile_size_m).astype(np.int64)


def _sort_by_tile(observations: Sequence[Observation]) -> list[Observation]:
    """By tile, rows of tiles in turn, then by id."""
    tiles = tile_indices(np.array([o.pose[:2] for o in observations]))
    keys: list[tuple[Any, ...]] = [(*tile, o.id) for tile, o in zip(tiles[:, ::-1].tolist(), observations)]
    return [observations[k] for k in sorted(range(len(keys)), key=keys.__getitem__)]


def _to_index_row(o: Observation, group: int) -> IndexRow:
    x, y = float(o.pose[0]), float(o.pose[1])
    return IndexRow(o.id, group, o.time_ns, o.agent, x, y, compute_radius(o), o.pass_id)


def compute_radius(o: Observation) -> float:
    """Return metres from the agent to the farthest point that it saw or could have seen."""
    points = np.concatenate((o.view, o.elements.points))
    return float(np.hypot(points[:, 0], points[:, 1]).max())


def _count_groups(objects: ObjectStore, segment: str) -> int:
    parquet = _parquet()
    from pyarrow import ArrowException

    try:
        with objects.open(f"{LOG}/{segment}") as file:
            return parquet.ParquetFile(file).num_row_groups
    except (ArrowException, OSError) as error:
        reason = " ".join(str(error).split())
        place = f"{objects.location}/{LOG}/{segment}"
        raise StoreError(f"{place}: expected a whole segment of the log; {reason}. Restore it from a copy.") from None
