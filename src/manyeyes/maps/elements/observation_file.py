# SPDX-License-Identifier: Apache-2.0
"""Observations as Parquet, one row each (docs/reference/map-observations.md), and reading that rejects what cannot be used."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import atomic_replace
from manyeyes.datatypes import ShapeError
from manyeyes.datatypes.extras import import_extra
from manyeyes.datatypes.map_element import DEFAULT_SIGMA_M, KINDS, NO_STYLE, STYLES, MapElements, Polygons
from manyeyes.maps.elements.observation import (
    FORMAT_VERSION,
    MapFrame,
    Observation,
    ObservationContent,
    ObservationError,
    shorten,
)

if TYPE_CHECKING:
    import pyarrow as pa

_pyarrow = partial(import_extra, "pyarrow", "map", "Observations as Parquet")

METADATA_KEY = b"manyeyes"
CRS = "local transverse Mercator, WGS 84, scale 1"
ROW_GROUP_SIZE = 1024
# What a group of rows may hold once it is decoded; compressed, far more fits into a small file. A group of ROW_GROUP_SIZE
# observations of 25 elements of 20 points has half a million values in its longest column.
_MAX_GROUP_VALUES, _MAX_GROUP_BYTES, _MAX_TEXT_BYTES = 20_000_000, 2**30, 2**28
_TEXTS = ("agent", "pass_id", "model", "id")
# Origins closer than a tenth of a millimetre are one.
_SAME_DEGREES = 1e-9
_UPPER = np.triu_indices(3)
_MIRRORED = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])
_REQUIRED = ("agent", "pass_id", "time_ns", "x", "y", "yaw", "covariance", "view", "elements")


@dataclass(frozen=True)
class RejectedRows:
    """What was rejected: the file, its first row (-1: the file as a whole), how many rows, and why, on one line."""

    file: str
    row: int
    count: int
    reason: str


@dataclass(frozen=True)
class InvalidRow:
    """A row that is no observation, and why.

    id: of its content, "" where the content has none or the row states another; agent, pass_id: as the row states them.
    """

    reason: str
    id: str
    agent: str
    pass_id: str


@dataclass(frozen=True)
class LoadedObservations:
    """What a file or folder held: the frame of its poses, the observations in file and row order, and what was rejected.

    left_out: what is no element of a map here, such as a class of a model's results, and how often.
    """

    frame: MapFrame
    observations: tuple[Observation, ...]
    rejected: tuple[RejectedRows, ...]
    left_out: Mapping[str, int] = field(default_factory=dict)


def write_observations(path: Path | str, observations: Sequence[Observation], frame: MapFrame) -> None:
    """Write observations as one Parquet file: whole under that name, or not there."""
    pq = _parquet()
    path = Path(path)
    with atomic_replace(path) as temporary:
        pq.write_table(
            observation_table(observations, frame),
            temporary,
            compression="zstd",
            row_group_size=ROW_GROUP_SIZE,
            use_dictionary=["agent", "pass_id", "model", "elements.list.element.kind"],
            write_page_checksum=True,
        )


def find_observation_files(path: Path) -> Path:
    """Where observations lie: the folder of that name in a folder that has one, else the path itself."""
    return path / "observations" if (path / "observations").is_dir() else path


def read_observations(source: Path | str, frame: MapFrame | None = None) -> LoadedObservations:
    """Read a file, or every ``*.parquet`` of a folder by name.

    frame: of the poses; without it that of most files, of those of most rows if files are even. Files about another are rejected.
    """
    source = Path(source)
    files = sorted(source.glob("*.parquet")) if source.is_dir() else [source]
    if not files or not files[0].exists():
        raise ObservationError(f"{source}: expected a Parquet file of observations or a folder of them; found none.")
    kept: list[Observation] = []
    rejected: list[RejectedRows] = []
    frame = frame or _find_common_frame(files)
    for file in files:
        try:
            groups = _iterate_file_rows(_open(file, frame))
        except ObservationError as error:
            rejected.append(RejectedRows(str(file), -1, 1, str(error)))
            continue
        for row, item in groups:
            if isinstance(item, Observation):
                kept.append(item)
            else:
                rejected.append(RejectedRows(str(file), row, *item))
    if frame is None:
        raise ObservationError(f"{source}: no file could be read; the first: {rejected[0].reason}")
    return LoadedObservations(frame, tuple(kept), tuple(rejected))


def observation_table(observations: Sequence[Observation], frame: MapFrame) -> pa.Table:
    """Return observations as an Arrow table whose metadata name the format, its version and the frame."""
    pa = _pyarrow()
    elements = MapElements.cat([o.elements for o in observations])
    at_point = pa.StructArray.from_arrays(
        [*(pa.array(elements.points[:, k]) for k in range(2)), pa.array(elements.sigma)], ["x", "y", "sigma"]
    )
    styles = np.arange(len(elements) + 1, dtype=np.int32) * len(STYLES)
    element = pa.StructArray.from_arrays(
        [
            pa.DictionaryArray.from_arrays(pa.array(elements.kind.astype(np.int32)), pa.array(KINDS)).cast(pa.string()),
            pa.array(elements.score),
            _list(pa, styles, pa.array(elements.style.reshape(-1))),
            _list(pa, elements.offsets, at_point),
        ],
        ["kind", "score", "style", "points"],
    )
    rings = [o.occluders for o in observations]
    starts = np.cumsum([0, *(len(r.points) for r in rings)])
    ring_offsets = np.concatenate([r.offsets[:-1] + start for r, start in zip(rings, starts)] + [starts[-1:]])
    poses = np.array([o.pose for o in observations]).reshape(-1, 3)
    columns = {
        "agent": pa.array([o.agent for o in observations], pa.string()),
        "pass_id": pa.array([o.pass_id for o in observations], pa.string()),
        "time_ns": pa.array([o.time_ns for o in observations], pa.int64()),
        **{name: pa.array(poses[:, k]) for k, name in enumerate(("x", "y", "yaw"))},
        "covariance": _list(
            pa,
            np.arange(len(observations) + 1) * 6,
            pa.array(np.array([o.covariance[_UPPER] for o in observations]).reshape(-1)),
        ),
        "view": _list(pa, _offsets([len(o.view) for o in observations]), _xy(pa, [o.view for o in observations])),
        "elements": _list(pa, _offsets([len(o.elements) for o in observations]), element),
        "model": pa.array([o.model for o in observations], pa.string()),
        "trusted": pa.array([o.trusted for o in observations], pa.bool_()),
        "id": pa.array([o.id for o in observations], pa.string()),
        "occluders": _list(
            pa, _offsets([len(r) for r in rings]), _list(pa, ring_offsets, _xy(pa, [r.points for r in rings]))
        ),
    }
    return (
        pa.table(columns)
        .cast(_schema(pa))
        .replace_schema_metadata({METADATA_KEY: json.dumps(make_file_metadata(frame))})
    )


def make_file_metadata(frame: MapFrame) -> dict[str, Any]:
    """What the file's key-value metadata say under the key ``manyeyes``, as JSON."""
    origin = {"crs": "EPSG:4326", "latitude": frame.latitude, "longitude": frame.longitude}
    return {"format": "observation", "version": FORMAT_VERSION, "crs": CRS, "origin": origin}


def iterate_observations(table: pa.Table) -> Iterator[tuple[int, Observation | str]]:
    """Yield each row of a table as an observation, or as the reason why it cannot be one."""
    for row, item in enumerate(iterate_rows(table)):
        yield row, item.reason if isinstance(item, InvalidRow) else item


def iterate_rows(table: pa.Table, checked_ids: Set[str] = frozenset()) -> Iterator[Observation | InvalidRow]:
    """Yield each row of a table as an observation, or as one that is refused.

    checked_ids: of observations that were checked before. A row whose content has such an id is not checked again.
    """
    columns = _ObservationColumns(table)
    for row in range(table.num_rows):
        try:
            yield columns.make_observation(row, checked_ids)
        except (ObservationError, ShapeError) as error:
            yield columns.make_invalid_row(row, str(error))


def _find_common_frame(files: Sequence[Path]) -> MapFrame | None:
    """Return the frame that most files state; None where no file can be used."""
    votes: dict[MapFrame, tuple[int, int]] = {}
    for file in files:
        with contextlib.suppress(ObservationError):
            opened = _open(file, None)
            stated = _read_frame(file, opened.schema_arrow.metadata or {})
            frame = next((known for known in votes if _is_same(known, stated)), stated)
            num_files, num_rows = votes.get(frame, (0, 0))
            votes[frame] = num_files + 1, num_rows + opened.metadata.num_rows
    return max(votes, key=votes.__getitem__, default=None)


def _open(file: Path, expected: MapFrame | None) -> Any:
    """Open a Parquet file; raises ObservationError where the file as a whole cannot be used, as with another frame."""
    pa, pq = _pyarrow(), _parquet()
    try:
        opened = pq.ParquetFile(file, page_checksum_verification=True)
    except (pa.ArrowException, OSError) as error:
        raise ObservationError(f"{file}: expected a whole Parquet file; got {_line(error)}. Fetch it again.") from error
    frame = _read_frame(file, opened.schema_arrow.metadata or {})
    if expected is not None and not _is_same(frame, expected):
        raise ObservationError(
            f"{file}: origin: expected latitude {expected.latitude}, longitude {expected.longitude} as asked or as in most "
            f"files; got {frame.latitude}, {frame.longitude}. Reproject the poses."
        )
    names = opened.schema_arrow.names
    missing = [name for name in _REQUIRED if name not in names]
    twice = [wanted.name for wanted in _schema(pa) if names.count(wanted.name) > 1]
    if missing or twice:
        wrong = f"{', '.join(missing)} missing" if missing else f"{', '.join(twice)} more than once"
        raise ObservationError(
            f"{file}: expected the columns of docs/reference/map-observations.md; {wrong}. Write the file again."
        )
    paths = [opened.metadata.schema.column(k).path for k in range(opened.metadata.num_columns)]
    texts = [path for path in paths if path in _TEXTS or (path.startswith("elements.") and path.endswith(".kind"))]
    return pq.ParquetFile(file, metadata=opened.metadata, read_dictionary=texts, page_checksum_verification=True)


def _is_same(one: MapFrame, other: MapFrame) -> bool:
    """Return whether two frames have one origin."""
    return max(abs(one.latitude - other.latitude), abs(one.longitude - other.longitude)) <= _SAME_DEGREES


def _iterate_file_rows(opened: Any) -> Iterator[tuple[int, Observation | tuple[int, str]]]:
    """Yield row by row; a group of rows that cannot be decoded is rejected as one."""
    pa = _pyarrow()
    start = 0
    for group in range(opened.num_row_groups):
        count = opened.metadata.row_group(group).num_rows
        try:
            _check_size(opened.metadata.row_group(group))
            table = opened.read_row_group(group)
            _check_texts(table)
            for row, item in iterate_observations(table):
                yield start + row, (1, item) if isinstance(item, str) else item
        except (pa.ArrowException, OSError, ObservationError, UnicodeDecodeError) as error:
            yield start, (count, f"rows {start} to {start + count - 1} cannot be decoded: {_line(error)}")
        start += count


def _check_size(group: Any) -> None:
    """Raise ObservationError for a group of rows that takes too much memory when it is decoded."""
    values = max((group.column(k).num_values for k in range(group.num_columns)), default=0)
    if values > _MAX_GROUP_VALUES or group.total_byte_size > _MAX_GROUP_BYTES:
        raise ObservationError(
            f"expected at most {_MAX_GROUP_VALUES} values a column and {_MAX_GROUP_BYTES} bytes; got {values} and "
            f"{group.total_byte_size}. Write smaller groups of rows."
        )


def _check_texts(table: pa.Table) -> None:
    """Raise ObservationError for texts that are stored once and take too much memory when each row has its own."""
    pa = _pyarrow()
    columns = [(name, chunk) for name in _TEXTS if name in table.column_names for chunk in table.column(name).chunks]
    elements = [chunk.flatten() for chunk in table.column("elements").chunks if pa.types.is_list(chunk.type)]
    columns += [("kind", one.field("kind")) for one in elements if pa.types.is_struct(one.type) and "kind" in one.type]
    for name, column in columns:
        if not pa.types.is_dictionary(column.type) or not pa.types.is_string(column.type.value_type):
            continue
        texts = column.dictionary
        if not len(texts):
            continue
        lengths = np.diff(np.frombuffer(texts.buffers()[1], np.int32, len(texts) + 1, 4 * texts.offset))
        counts = np.bincount(column.indices.drop_null().to_numpy(zero_copy_only=False), minlength=len(lengths))
        if (size := int(counts @ lengths)) > _MAX_TEXT_BYTES:
            raise ObservationError(
                f"column {name}: expected at most {_MAX_TEXT_BYTES} bytes of text; got {size}. Shorten the texts."
            )


def _read_frame(file: Path, stored: dict[bytes, bytes]) -> MapFrame:
    """Return the frame in a file's metadata, once format, version and CRS are known to be ours."""
    try:
        metadata = json.loads(stored[METADATA_KEY])
        kind, version, crs, origin = (metadata[key] for key in ("format", "version", "crs", "origin"))
        frame = MapFrame(float(origin["latitude"]), float(origin["longitude"]))
        geographic = origin["crs"]
    except (KeyError, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise ObservationError(
            f"{file}: expected metadata 'manyeyes' with format, version, crs and origin as in docs/reference/map-observations.md; "
            f"{type(error).__name__} {shorten(error)}."
        ) from error
    if kind != "observation" or not isinstance(version, int) or not 1 <= version <= FORMAT_VERSION:
        raise ObservationError(
            f"{file}: expected format 'observation' of version 1 to {FORMAT_VERSION}; got {shorten(repr(kind))} of version "
            f"{shorten(repr(version))}. "
            "Read a newer version with a newer manyeyes."
        )
    if crs != CRS or geographic != "EPSG:4326":
        raise ObservationError(
            f"{file}: crs: expected '{CRS}' about an origin in EPSG:4326; got {shorten(repr(crs))} about "
            f"{shorten(repr(geographic))}. Reproject the poses."
        )
    return frame


class _ObservationColumns:
    """A table's nested columns, taken apart once; rows are cut out of them as views."""

    def __init__(self, table: pa.Table) -> None:
        pa = _pyarrow()
        schema = _schema(pa)
        self.columns: dict[str, Any] = {}
        for wanted in schema:
            if wanted.name not in table.column_names:
                self.columns[wanted.name] = pa.nulls(table.num_rows, wanted.type)
                continue
            try:
                column = table.column(wanted.name).cast(wanted.type).combine_chunks()
            except pa.ArrowException as error:
                raise ObservationError(f"column {wanted.name}: expected {wanted.type}; {_line(error)}") from error
            self.columns[wanted.name] = column.chunk(0) if isinstance(column, pa.ChunkedArray) else column
        self.text = {name: self.columns[name].fill_null("").to_pylist() for name in ("agent", "pass_id", "model", "id")}
        self.trusted = self.columns["trusted"].fill_null(False).to_pylist()
        self.time = self.columns["time_ns"].fill_null(-1).to_pylist()
        self.pose = np.stack([_to_floats(self.columns[name]) for name in ("x", "y", "yaw")], 1)
        self.covariance_offsets, covariance = _split_list(self.columns["covariance"])
        self.covariance = _to_floats(covariance)
        self.view_offsets, view = _split_list(self.columns["view"])
        self.view = np.stack([_to_floats(axis) for axis in view.flatten()], 1)
        self.ring_offsets, rings = _split_list(self.columns["occluders"])
        self.ring_point_offsets, corners = _split_list(rings)
        self.corners = np.stack([_to_floats(axis) for axis in corners.flatten()], 1)
        self.element_offsets, elements = _split_list(self.columns["elements"])
        kind, score, style, points = elements.flatten()
        self.kind = _to_kind_indices(kind)
        self.kind_text, self.score = kind, _to_floats(score)
        self.style = _styles(style)
        self.point_offsets, at_point = _split_list(points)
        x, y, sigma = at_point.flatten()
        self.points = np.stack((_to_floats(x), _to_floats(y)), 1)
        self.sigma = _to_floats(sigma.fill_null(DEFAULT_SIGMA_M))

    def make_observation(self, row: int, checked_ids: Set[str]) -> Observation:
        """Return the observation of one row; raises ObservationError or ShapeError where it is none."""
        content, stated = self.make_content(row), self.text["id"][row]
        if stated in checked_ids and stated == content.id:
            return Observation.of_checked(content)
        made = Observation(**{f.name: getattr(content, f.name) for f in fields(ObservationContent)})
        if stated and stated != made.id:
            raise ObservationError(
                f"Observation.id: expected {made.id}, the hash of its content; got {shorten(stated)}. Fetch it again."
            )
        return made

    def make_invalid_row(self, row: int, reason: str) -> InvalidRow:
        """Return the record of a row that is no observation."""
        try:
            content_id = self.make_content(row).id
        except (ObservationError, ShapeError):
            content_id = ""
        stated = self.text["id"][row]
        return InvalidRow(
            reason,
            "" if stated and stated != content_id else content_id,
            self.text["agent"][row],
            self.text["pass_id"][row],
        )

    def make_content(self, row: int) -> ObservationContent:
        """Return the fields of one row, unchecked; raises ObservationError or ShapeError where they have no such form."""
        a, b = self.element_offsets[row], self.element_offsets[row + 1]
        p, q = self.point_offsets[a], self.point_offsets[b]
        kind = self.kind[a:b]
        if (kind < 0).any():
            wrong = shorten(self.kind_text[int(a + np.argmin(kind))])
            raise ObservationError(f"Observation.kind: expected one of {', '.join(KINDS)}; got {wrong}.")
        elements = MapElements(
            kind,
            self.point_offsets[a : b + 1] - p,
            self.points[p:q],
            self.score[a:b],
            self.sigma[p:q],
            self.style[a:b],
        )
        r, s = self.ring_offsets[row], self.ring_offsets[row + 1]
        u, v = self.ring_point_offsets[r], self.ring_point_offsets[s]
        return ObservationContent(
            agent=self.text["agent"][row],
            pass_id=self.text["pass_id"][row],
            time_ns=self.time[row],
            pose=self.pose[row],
            covariance=_square(self.covariance[self.covariance_offsets[row] : self.covariance_offsets[row + 1]]),
            view=self.view[self.view_offsets[row] : self.view_offsets[row + 1]],
            elements=elements,
            model=self.text["model"][row],
            trusted=self.trusted[row],
            occluders=Polygons(self.corners[u:v], self.ring_point_offsets[r : s + 1] - u),
        )


def _square(upper: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (3, 3) from xx, xy, x yaw, yy, y yaw, yaw yaw."""
    if len(upper) != 6:
        raise ObservationError(
            f"Observation.covariance: expected 6 numbers, the upper triangle by rows; got {len(upper)}."
        )
    return upper[_MIRRORED].reshape(3, 3)


def _styles(style: Any) -> NDArray[np.float64]:
    """Return (N, S) style probabilities; where none are stated: no style for certain; a wrong number of them: NaN."""
    offsets, values = _split_list(style)
    counts = np.diff(offsets)
    out = np.full((len(counts), len(STYLES)), np.nan)
    out[counts == 0] = np.eye(len(STYLES))[NO_STYLE]
    whole = counts == len(STYLES)
    places = offsets[:-1][whole][:, None] + np.arange(len(STYLES))
    out[whole] = _to_floats(values)[places]
    return out


def _split_list(column: Any) -> tuple[NDArray[np.int64], Any]:
    """Return offsets and contents of a list column; a null list is an empty one."""
    return column.offsets.to_numpy().astype(np.int64), column.values


def _to_floats(column: Any) -> NDArray[np.float64]:
    """Return a column of numbers as float64, null as NaN."""
    return column.to_numpy(zero_copy_only=False).astype(np.float64, copy=False)


def _to_kind_indices(kind: Any) -> NDArray[np.int64]:
    """Return the place of each name in KINDS; -1 for a null or another name."""
    coded = kind.dictionary_encode()
    known = [KINDS.index(name) if name in KINDS else -1 for name in coded.dictionary.to_pylist()]
    places = coded.indices.fill_null(len(known)).to_numpy(zero_copy_only=False)
    return np.array([*known, -1], np.int64)[places]


def _offsets(counts: Sequence[int]) -> NDArray[np.int64]:
    return np.concatenate(([0], np.cumsum(np.asarray(counts, np.int64)))).astype(np.int64)


def _list(pa: Any, offsets: NDArray, values: Any) -> Any:
    return pa.ListArray.from_arrays(pa.array(np.asarray(offsets, np.int32)), values)


def _xy(pa: Any, rings: Sequence[NDArray[np.float64]]) -> Any:
    """Return points of many rings as a struct column x, y."""
    points = np.concatenate([*rings, np.zeros((0, 2))])
    return pa.StructArray.from_arrays([pa.array(points[:, k]) for k in range(2)], ["x", "y"])


def _schema(pa: Any) -> Any:
    """Return the columns of docs/reference/map-observations.md."""
    number, text = pa.float64(), pa.string()
    xy = pa.struct([("x", number), ("y", number)])
    point = pa.struct([("x", number), ("y", number), ("sigma", number)])
    element = pa.struct([("kind", text), ("score", number), ("style", pa.list_(number)), ("points", pa.list_(point))])
    return pa.schema(
        [
            ("agent", text),
            ("pass_id", text),
            ("time_ns", pa.int64()),
            ("x", number),
            ("y", number),
            ("yaw", number),
            ("covariance", pa.list_(number)),
            ("view", pa.list_(xy)),
            ("elements", pa.list_(element)),
            ("model", text),
            ("trusted", pa.bool_()),
            ("id", text),
            ("occluders", pa.list_(pa.list_(xy))),
        ]
    )


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())


def _parquet() -> Any:
    _pyarrow()
    import pyarrow.parquet

    return pyarrow.parquet
