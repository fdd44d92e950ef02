# SPDX-License-Identifier: Apache-2.0
"""Maps as GeoParquet 1.1: whole and lossless in the local metric frame (GeoArrow), or one WGS 84 file for other programs (WKB).

Lossless: two tables, as GeoArrow columns hold one type each, lines (``linestring``) and crossings (``polygon``); the coordinate
system is the frame's transverse Mercator as PROJJSON; ``bbox`` is the covering column; zstd; evidence per point as lists beside
the geometry, relations and sources as lists of ids. Source: GeoParquet specification 1.1.0 (geoparquet.org).
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import atomic_replace
from manyeyes.datatypes import ManyeyesError
from manyeyes.datatypes.extras import import_extra
from manyeyes.datatypes.map_element import CROSSING, KINDS, STYLES, MapElements, take_rows
from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.elements.vector_map import STATES, PointEvidence, Topology, VectorMap
from manyeyes.maps.formats.attributes import Attributes, to_degrees, to_hex_ids

if TYPE_CHECKING:
    import pyarrow as pa

_shapely = partial(import_extra, "shapely", "map", "Maps as WKB geometry")

_pyarrow = partial(import_extra, "pyarrow", "map", "Maps as GeoParquet")

FORMAT_VERSION = 1
_ROW_GROUP_SIZE = 8192
_FRAME_KEY, _GEO_KEY, _VERSION_KEY = b"manyeyes:frame", b"geo", b"manyeyes:version"


class MapFileError(ManyeyesError, ValueError):
    """A map file that is damaged, of a later version, or no map of this project; the text names the file."""


def write_geoparquet(vector_map: VectorMap, path: Path | str) -> None:
    """Write all elements to one WGS 84 GeoParquet file with WKB geometry (lines and polygons) and plain attributes."""
    pyarrow = _pyarrow()
    shapely = _shapely()
    degrees = to_degrees(vector_map)
    geometry = to_shapely(shapely, degrees)
    columns = [("geometry", pyarrow.array(shapely.to_wkb(geometry, flavor="iso"), pyarrow.binary()))]
    columns += [("bbox", _bbox(pyarrow, degrees.bounds()))]
    columns += [(name, pyarrow.array(values)) for name, values in Attributes.of(vector_map).columns()]
    table = pyarrow.table(dict(columns))
    geo = _geo("WKB", _types_of(degrees), degrees, None)
    _write(table.replace_schema_metadata({_GEO_KEY: json.dumps(geo).encode()}), Path(path))


def to_shapely(shapely: Any, elements: MapElements) -> NDArray[np.object_]:
    """Return (N,) shapely lines and polygons of elements."""
    out = np.empty(len(elements), object)
    for rows, make in ((~elements.closed, shapely.linestrings), (elements.closed, shapely.linearrings)):
        part = elements.take(rows)
        if len(part):
            made = make(part.points, indices=part.element_of_point)
            out[rows] = shapely.polygons(made) if make is shapely.linearrings else made
    return out


def map_to_tables(vector_map: VectorMap, rows: NDArray[np.int64] | None = None) -> tuple[pa.Table, pa.Table]:
    """Return the map, or these rows of it, as two Arrow tables, lines and crossings, with GeoParquet metadata; nothing is lost.

    Rows keep their relations to rows that are left out, by id: those may stand in another file.
    """
    rows = np.arange(len(vector_map)) if rows is None else rows
    closed = vector_map.elements.closed[rows]
    return _table(vector_map, rows[~closed], False), _table(vector_map, rows[closed], True)


def tables_to_map(tables: list[pa.Table], frame: MapFrame) -> VectorMap:
    """Return the map whose elements stand in the tables, in their order; relations to elements of other tables are left out."""
    parts = [_TableColumns(table) for table in tables if len(table)]
    if not parts:
        return VectorMap.empty(frame)
    return _assemble(parts, frame)


def write_map(vector_map: VectorMap, lines: Path, crossings: Path, rows: NDArray[np.int64] | None = None) -> None:
    """Write the lossless form of a map or of some rows: one file of lines, one of crossings (empty ones too)."""
    for table, path in zip(map_to_tables(vector_map, rows), (lines, crossings)):
        _write(table, path)


def read_map(*paths: Path | str) -> VectorMap:
    """Return the map of files in the lossless form, elements by ascending id; one map may stand in many files."""
    return _join_tables([read_table(Path(path)) for path in paths], [Path(path).name for path in paths])


def map_to_bytes(vector_map: VectorMap, rows: NDArray[np.int64] | None = None) -> tuple[bytes, bytes]:
    """Return the two files of :func:`write_map` as bytes."""
    files = [io.BytesIO(), io.BytesIO()]
    for table, file in zip(map_to_tables(vector_map, rows), files):
        _write_parquet(table, file)
    return files[0].getvalue(), files[1].getvalue()


def bytes_to_map(files: Iterable[tuple[str, bytes]]) -> VectorMap:
    """Return the map of (name, bytes) of files in the lossless form, elements by ascending id."""
    tables: list[pa.Table] = []
    names: list[str] = []
    for name, data in files:
        tables.append(_read_checked(io.BytesIO(data), name))
        names.append(name)
    return _join_tables(tables, names)


def _join_tables(tables: list[pa.Table], file_names: list[str]) -> VectorMap:
    frames = {read_frame(table) for table in tables}
    if len(frames) > 1:
        names = ", ".join(file_names[:4])
        raise MapFileError(
            f"{names}: expected files of one frame; got {len(frames)} origins: move them into one first."
        )
    whole = tables_to_map(tables, frames.pop() if frames else MapFrame())
    return whole.take(np.lexsort(whole.id.T[::-1]))


def read_table(path: Path) -> pa.Table:
    """Return one file of the lossless form, checked for version and columns."""
    return _read_checked(path, str(path))


def _read_checked(file: Path | io.BytesIO, path: str) -> pa.Table:
    """Return the table of a file, which ``path`` names."""
    pyarrow = _pyarrow()
    from pyarrow import parquet

    try:
        table = parquet.read_table(file, memory_map=False)
    except (pyarrow.ArrowException, OSError) as error:
        reason = " ".join(str(error).split())
        raise MapFileError(f"{path}: expected a Parquet file of a map; {reason}. Restore it from a copy.") from None
    meta = table.schema.metadata or {}
    if _VERSION_KEY not in meta or _FRAME_KEY not in meta:
        raise MapFileError(
            f"{path}: expected the metadata 'manyeyes:version' and 'manyeyes:frame'; this is another file."
        )
    version = int(meta[_VERSION_KEY])
    if version > FORMAT_VERSION:
        raise MapFileError(
            f"{path}: version {version}, but this program reads up to {FORMAT_VERSION}; update manyeyes."
        )
    missing = [name for name in _COLUMNS if name not in table.column_names]
    if missing:
        raise MapFileError(f"{path}: column '{missing[0]}' is missing; restore the file from a copy.")
    return table.combine_chunks()


def read_frame(table: pa.Table) -> MapFrame:
    """Return the frame that a table's metadata names."""
    frame = json.loads((table.schema.metadata or {})[_FRAME_KEY])
    return MapFrame(frame["latitude"], frame["longitude"])


_POINT_COLUMNS = ("sigma", *(f.name if f.name != "sigma" else "station_sigma" for f in fields(PointEvidence)))
_ROW_COLUMNS = ("log_odds", "supporters", "agents", "t_first", "t_last")
_PAIR_COLUMNS = ("successor", "left", "right")
# Names that stand both for an element and for its points are distinguished by a prefix.
_AT_POINT = "point_"
_COLUMNS = (
    "geometry",
    "bbox",
    "id",
    "kind",
    "state",
    "score",
    "style",
    *_ROW_COLUMNS,
    *(_AT_POINT + name for name in _POINT_COLUMNS),
    *_PAIR_COLUMNS,
    "branch",
    "sources",
)


def _table(m: VectorMap, rows: NDArray[np.int64], closed: bool) -> pa.Table:
    """Return the rows of a map that are lines, or rings."""
    pyarrow = _pyarrow()
    e = m.elements.take(rows)
    _, places = take_rows(m.elements.offsets, rows)
    stations = m.point_evidence.take(places)
    per_point = [e.sigma, *(getattr(stations, f.name) for f in fields(PointEvidence))]
    offsets, sources = take_rows(m.source_offsets, rows)
    columns: dict[str, pa.Array] = {
        "geometry": _geoarrow(pyarrow, e, closed),
        "bbox": _bbox(pyarrow, e.bounds()),
        "id": pyarrow.array(to_hex_ids(m.id[rows]), pyarrow.string()),
        "kind": pyarrow.array([KINDS[k] for k in e.kind.tolist()], pyarrow.string()),
        "state": pyarrow.array([STATES[k] for k in m.state[rows].tolist()], pyarrow.string()),
        "score": pyarrow.array(e.score),
        "style": pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(e.style.reshape(-1)), len(STYLES)),
    }
    columns |= {name: pyarrow.array(getattr(m, name)[rows]) for name in _ROW_COLUMNS}
    columns |= {_AT_POINT + n: _lists(pyarrow, e.offsets, v) for n, v in zip(_POINT_COLUMNS, per_point)}
    for name in _PAIR_COLUMNS:
        columns[name] = _collect_related_ids(pyarrow, getattr(m.topology, name), rows, m.id)
    columns["branch"] = _branches(pyarrow, m.topology, rows, len(m))
    named = pyarrow.array(to_hex_ids(m.observations[m.sources[sources]]), pyarrow.string())
    columns["sources"] = pyarrow.ListArray.from_arrays(pyarrow.array(offsets, pyarrow.int32()), named)
    geo = _geo("polygon" if closed else "linestring", ["Polygon" if closed else "LineString"], e, m.frame)
    metadata = {
        _GEO_KEY: json.dumps(geo).encode(),
        _FRAME_KEY: json.dumps({"latitude": m.frame.latitude, "longitude": m.frame.longitude}).encode(),
        _VERSION_KEY: str(FORMAT_VERSION).encode(),
    }
    return pyarrow.table(columns).replace_schema_metadata(metadata)


def _geoarrow(pyarrow: Any, e: MapElements, closed: bool) -> pa.Array:
    """Native GeoArrow geometry: lists of struct<x, y>; a ring gets its first point again at its end."""
    points, first = e.points, e.offsets
    if closed:
        first = e.offsets + np.arange(len(e) + 1)
        points = np.insert(e.points, e.offsets[1:], e.points[e.offsets[:-1]], axis=0) if len(e) else e.points
    x, y = (pyarrow.array(np.ascontiguousarray(points[:, k])) for k in (0, 1))
    vertex = pyarrow.StructArray.from_arrays(
        [x, y], fields=[_make_required_field(pyarrow, n, pyarrow.float64()) for n in "xy"]
    )
    out = pyarrow.ListArray.from_arrays(
        pyarrow.array(first, pyarrow.int32()),
        vertex,
        pyarrow.list_(_make_required_field(pyarrow, "vertices", vertex.type)),
    )
    if not closed:
        return out
    one_each = pyarrow.array(np.arange(len(e) + 1), pyarrow.int32())
    return pyarrow.ListArray.from_arrays(one_each, out, pyarrow.list_(_make_required_field(pyarrow, "rings", out.type)))


def _make_required_field(pyarrow: Any, name: str, kind: Any) -> Any:
    return pyarrow.field(name, kind, nullable=False)


def _bbox(pyarrow: Any, bounds: NDArray[np.float64]) -> pa.Array:
    names = ["xmin", "ymin", "xmax", "ymax"]
    return pyarrow.StructArray.from_arrays(
        [pyarrow.array(np.ascontiguousarray(bounds[:, k])) for k in range(4)], names=names
    )


def _lists(pyarrow: Any, offsets: NDArray[np.int64], values: NDArray) -> pa.Array:
    return pyarrow.ListArray.from_arrays(pyarrow.array(offsets, pyarrow.int32()), pyarrow.array(values))


def _collect_related_ids(
    pyarrow: Any, pairs: NDArray[np.int64], rows: NDArray[np.int64], ids: NDArray[np.uint8]
) -> pa.Array:
    """Return per row the ids of its partners, in the order of the pairs."""
    order = np.argsort(pairs[:, 0], kind="stable")
    first = np.searchsorted(pairs[order, 0], np.arange(len(ids) + 1))
    chosen, places = take_rows(first, rows)
    values = pyarrow.array(to_hex_ids(ids[pairs[order[places], 1]]), pyarrow.string())
    return pyarrow.ListArray.from_arrays(pyarrow.array(chosen, pyarrow.int32()), values)


def _branches(pyarrow: Any, topology: Topology, rows: NDArray[np.int64], total: int) -> pa.Array:
    """Return per row the points of the branch nodes where it ends."""
    order = np.argsort(topology.branch[:, 1], kind="stable")
    first = np.searchsorted(topology.branch[order, 1], np.arange(total + 1))
    chosen, places = take_rows(first, rows)
    nodes = topology.branch_xy[topology.branch[order[places], 0]]
    x, y = (pyarrow.array(np.ascontiguousarray(nodes[:, k])) for k in (0, 1))
    return pyarrow.ListArray.from_arrays(
        pyarrow.array(chosen, pyarrow.int32()), pyarrow.StructArray.from_arrays([x, y], names=["x", "y"])
    )


class _TableColumns:
    """The columns of one table as arrays, relations still by id."""

    def __init__(self, table: pa.Table) -> None:
        closed = json.loads(table.schema.metadata[_GEO_KEY])["columns"]["geometry"]["encoding"] == "polygon"
        geometry = _column(table, "geometry")
        lines = geometry.flatten() if closed else geometry
        vertex = lines.flatten()
        points = np.stack([vertex.field(k).to_numpy() for k in (0, 1)], 1)
        first = np.concatenate(([0], np.cumsum(lines.value_lengths().to_numpy()))).astype(np.int64)
        if closed:
            points = np.delete(points, first[1:] - 1, axis=0)
            first = first - np.arange(len(first))
        at = {n: _column(table, _AT_POINT + n).flatten().to_numpy() for n in _POINT_COLUMNS}
        kind = np.array([KINDS.index(k) for k in _column(table, "kind").to_pylist()], np.int64)
        style = _column(table, "style").flatten().to_numpy().reshape(-1, len(STYLES))
        self.elements = MapElements(kind, first, points, _column(table, "score").to_numpy(), at["sigma"], style)
        self.stations = PointEvidence(
            **{f.name: at["station_sigma" if f.name == "sigma" else f.name] for f in fields(PointEvidence)}
        )
        self.state = np.array([STATES.index(k) for k in _column(table, "state").to_pylist()], np.int64)
        self.rows = {name: _column(table, name).to_numpy() for name in _ROW_COLUMNS}
        self.id = _digests(_column(table, "id"))
        self.pairs = {name: _read_ragged(table, name) for name in _PAIR_COLUMNS}
        self.sources = _read_ragged(table, "sources")
        branch = _column(table, "branch")
        self.branch_count = branch.value_lengths().to_numpy()
        self.branch_xy = np.stack([branch.flatten().field(k).to_numpy() for k in (0, 1)], 1)


def _column(table: pa.Table, name: str) -> Any:
    column = table.column(name)
    return column.combine_chunks() if column.num_chunks != 1 else column.chunk(0)


def _digests(texts: Any) -> NDArray[np.uint8]:
    """Return (N, 16) bytes of an Arrow array of hexadecimal texts."""
    return np.frombuffer(bytes.fromhex("".join(texts.to_pylist())), np.uint8).reshape(-1, 16)


def _read_ragged(table: pa.Table, name: str) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return counts (N,) and all digests of a column of lists of ids."""
    column = _column(table, name)
    return column.value_lengths().to_numpy().astype(np.int64), _digests(column.flatten())


def _assemble(parts: list[_TableColumns], frame: MapFrame) -> VectorMap:
    """Return one map of the parts' elements, in order."""
    ids = np.concatenate([p.id for p in parts])
    n = len(ids)
    row_of = {key.tobytes(): row for row, key in enumerate(ids)}

    def pairs(name: str) -> NDArray[np.int64]:
        counts = np.concatenate([p.pairs[name][0] for p in parts])
        partners = np.concatenate([p.pairs[name][1] for p in parts])
        second = np.array([row_of.get(key.tobytes(), -1) for key in partners], np.int64)
        both = np.stack((np.repeat(np.arange(n), counts), second), 1)
        return both[second >= 0]

    ends = np.repeat(np.arange(n), np.concatenate([p.branch_count for p in parts]))
    xy, node = np.unique(np.concatenate([p.branch_xy for p in parts]), axis=0, return_inverse=True)
    branch = np.stack((node.reshape(-1), ends), 1)
    branch = branch[np.lexsort((branch[:, 1], branch[:, 0]))]
    counts = np.concatenate([p.sources[0] for p in parts])
    observations, sources = np.unique(np.concatenate([p.sources[1] for p in parts]), axis=0, return_inverse=True)
    return VectorMap(
        frame=frame,
        elements=MapElements.cat([p.elements for p in parts]),
        id=ids,
        state=np.concatenate([p.state for p in parts]),
        point_evidence=PointEvidence(
            *(np.concatenate([getattr(p.stations, f.name) for p in parts]) for f in fields(PointEvidence))
        ),
        topology=Topology(pairs("successor"), pairs("left"), pairs("right"), branch, xy),
        observations=observations.reshape(-1, 16),
        source_offsets=np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
        sources=sources.reshape(-1).astype(np.int64),
        **{name: np.concatenate([p.rows[name] for p in parts]) for name in _ROW_COLUMNS},
    )


def _types_of(e: MapElements) -> list[str]:
    return sorted({"Polygon" if kind == CROSSING else "LineString" for kind in np.unique(e.kind).tolist()})


def _geo(encoding: str, types: list[str], e: MapElements, frame: MapFrame | None) -> dict[str, Any]:
    """Return the ``geo`` metadata of GeoParquet 1.1.0; without a frame the coordinates are OGC:CRS84, the default."""
    column: dict[str, Any] = {"encoding": encoding, "geometry_types": types}
    if frame is not None:
        column["crs"] = projjson(frame)
    if len(e.points):
        column["bbox"] = [*e.points.min(0).tolist(), *e.points.max(0).tolist()]
    column["covering"] = {"bbox": {side: ["bbox", side] for side in ("xmin", "ymin", "xmax", "ymax")}}
    return {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}


def projjson(frame: MapFrame) -> dict[str, Any]:
    """Return the frame's coordinate reference system as PROJJSON 0.7."""

    def axis(name: str, short: str, direction: str, unit: str) -> dict[str, str]:
        return {"name": name, "abbreviation": short, "direction": direction, "unit": unit}

    def parameter(name: str, value: float, unit: str, code: int) -> dict[str, Any]:
        return {"name": name, "value": value, "unit": unit, "id": {"authority": "EPSG", "code": code}}

    return {
        "$schema": "https://proj.org/schemas/v0.7/projjson.schema.json",
        "type": "ProjectedCRS",
        "name": f"WGS 84 / local transverse Mercator at {frame.latitude:.6f}, {frame.longitude:.6f}",
        "base_crs": {
            "name": "WGS 84",
            "datum": {
                "type": "GeodeticReferenceFrame",
                "name": "World Geodetic System 1984",
                "ellipsoid": {"name": "WGS 84", "semi_major_axis": 6378137, "inverse_flattening": 298.257223563},
            },
            "coordinate_system": {
                "subtype": "ellipsoidal",
                "axis": [
                    axis("Geodetic latitude", "Lat", "north", "degree"),
                    axis("Geodetic longitude", "Lon", "east", "degree"),
                ],
            },
            "id": {"authority": "EPSG", "code": 4326},
        },
        "conversion": {
            "name": "Local transverse Mercator, scale 1",
            "method": {"name": "Transverse Mercator", "id": {"authority": "EPSG", "code": 9807}},
            "parameters": [
                parameter("Latitude of natural origin", frame.latitude, "degree", 8801),
                parameter("Longitude of natural origin", frame.longitude, "degree", 8802),
                parameter("Scale factor at natural origin", 1, "unity", 8805),
                parameter("False easting", 0, "metre", 8806),
                parameter("False northing", 0, "metre", 8807),
            ],
        },
        "coordinate_system": {
            "subtype": "Cartesian",
            "axis": [axis("Easting", "E", "east", "metre"), axis("Northing", "N", "north", "metre")],
        },
    }


def _write(table: pa.Table, path: Path) -> None:
    with atomic_replace(path) as temporary:
        _write_parquet(table, temporary)


def _write_parquet(table: pa.Table, file: Path | io.BytesIO) -> None:
    from pyarrow import parquet

    parquet.write_table(table, file, compression="zstd", row_group_size=_ROW_GROUP_SIZE, store_schema=True)
