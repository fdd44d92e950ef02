# SPDX-License-Identifier: Apache-2.0
"""Read map elements from the layers of a GeoPackage or a GeoJSON file, in any coordinate system that the file states.

The kind of a feature is its field ``kind``, else that of its layer's name; ``score``, ``style``, ``sigma_m`` and ``state`` are
read where they are there, and of states only ``published`` (or none) is read. Parts of a multi-geometry are elements of their
own. A polygon is a crossing's ring, without its holes; of another kind its outline is a line. Whatever has no kind is left out
and counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ManyeyesError
from manyeyes.datatypes.extras import import_extra
from manyeyes.datatypes.map_element import (
    BOUNDARY,
    CROSSING,
    DEFAULT_SIGMA_M,
    DIVIDER,
    KINDS,
    NO_STYLE,
    STOP_LINE,
    STYLES,
    MapElements,
)

Floats = NDArray[np.float64]

_shapely = partial(import_extra, "shapely", "map", "Reading maps as GeoPackage")
_pyogrio = partial(import_extra, "pyogrio", "map", "Reading maps as GeoPackage")
_pyproj = partial(import_extra, "pyproj", "map", "Coordinate systems of maps")

KIND_OF_NAME = {
    "divider": DIVIDER,
    "lane_divider": DIVIDER,
    "road_divider": DIVIDER,
    "lane_marking": DIVIDER,
    "boundary": BOUNDARY,
    "road_boundary": BOUNDARY,
    "road_border": BOUNDARY,
    "curb": BOUNDARY,
    "crossing": CROSSING,
    "ped_crossing": CROSSING,
    "pedestrian_crossing": CROSSING,
    "crosswalk": CROSSING,
    "stop_line": STOP_LINE,
}
"""Kinds by the name of a layer or by the value of a field ``kind``, in lower case; a plural s is passed over."""


class VectorLayerError(ManyeyesError, ValueError):
    """A file of layers that cannot be read; the text names the file and what is missing."""


@dataclass(frozen=True, eq=False)
class LayerElements:
    """Elements with points as longitude and latitude (degrees, WGS 84); left_out: what was not read, and how often."""

    elements: MapElements
    left_out: Mapping[str, int] = field(default_factory=dict)


def find_kind(name: object) -> int | None:
    """Return the kind that a name stands for; None for a name of no kind."""
    text = str(name).strip().lower().replace(" ", "_").replace("-", "_")
    return KIND_OF_NAME.get(text, KIND_OF_NAME.get(text.removesuffix("s")))


def read_vector_layers(source: Path | str, crs: str | None = None) -> LayerElements:
    """Return the elements of all layers of a file.

    Args:
        source: a GeoPackage or GeoJSON file. crs: of layers that state none, such as "EPSG:25832" or a PROJ string.

    Raises:
        VectorLayerError: no such file, a layer without a coordinate system, or one that has no place on earth.
    """
    path, pyogrio = Path(source), _pyogrio()
    try:
        layers = [str(name) for name, _ in pyogrio.list_layers(path)]
        parts = [_read_layer(path, layer, crs) for layer in layers if layer != "layer_styles"]
    except pyogrio.errors.DataSourceError as error:
        reason = " ".join(str(error).split())
        raise VectorLayerError(f"{path}: expected a GeoPackage or GeoJSON file; {reason}.") from None
    left_out: Counter[str] = Counter()
    for part in parts:
        left_out.update(part.left_out)
    return LayerElements(MapElements.cat([part.elements for part in parts]), dict(left_out))


def _read_layer(path: Path, layer: str, crs: str | None) -> LayerElements:
    meta, _, geometry, values = _pyogrio().raw.read(path, layer=layer, force_2d=True)
    if geometry is None or not len(geometry):
        return LayerElements(MapElements.empty())
    columns = dict(zip(meta["fields"].tolist(), values))
    stated = meta["crs"] or crs
    if not stated:
        raise VectorLayerError(f"{path}: layer '{layer}' states no coordinate system; give --crs, such as EPSG:25832.")
    collector = _Collector(layer, columns)
    shapely = _shapely()
    for row, shape in enumerate(shapely.from_wkb(geometry)):
        if shape is not None:
            collector.add(shapely, row, shape)
    elements = collector.elements()
    return LayerElements(elements.with_points(_to_degrees(path, layer, elements.points, stated)), collector.left_out)


class _Collector:
    """Features of one layer on their way to elements."""

    def __init__(self, layer: str, columns: Mapping[str, Any]) -> None:
        self.layer_name, self.layer_kind, self.columns = layer, find_kind(layer), columns
        self.lines: list[Floats] = []
        self.kinds: list[int] = []
        self.rows: list[int] = []
        self.left_out: Counter[str] = Counter()

    def add(self, shapely: Any, row: int, shape: Any) -> None:
        """Add the parts of one feature."""
        named = self.columns["kind"][row] if "kind" in self.columns else None
        kind = self.layer_kind if named in (None, "") else find_kind(named)
        state = self.columns["state"][row] if "state" in self.columns else None
        if kind is None:
            self.left_out[f"kind {named}" if named else f"layer {self.layer_name} without a kind"] += 1
        elif state not in (None, "", "published"):
            self.left_out[f"state {state}"] += 1
        else:
            for part in shapely.get_parts(shape):
                ring = part.exterior if part.geom_type == "Polygon" else part
                points = shapely.get_coordinates(ring)
                closed = len(points) > 3 and bool((points[0] == points[-1]).all())
                if kind == CROSSING and closed:
                    points = points[:-1]
                fits = part.geom_type in ("Polygon", "LineString") and (kind != CROSSING or closed)
                if not fits or len(points) < 2:
                    self.left_out[f"{part.geom_type} of kind {KINDS[kind]}"] += 1
                    continue
                self.lines.append(points)
                self.kinds.append(kind)
                self.rows.append(row)

    def elements(self) -> MapElements:
        """Return what was added, in the layer's own coordinates."""
        rows = np.array(self.rows, np.int64)
        sigma = np.repeat(self._numbers("sigma_m", rows, DEFAULT_SIGMA_M), [len(line) for line in self.lines])
        style = [STYLES.index(name) if name in STYLES else NO_STYLE for name in self._column("style", rows)]
        return MapElements.of(
            self.lines,
            np.array(self.kinds, np.int64),
            self._numbers("score", rows, 1.0).clip(0.0, 1.0),
            sigma.clip(0.0),
            np.array(style, np.int64),
        )

    def _column(self, name: str, rows: NDArray[np.int64]) -> list[Any]:
        return [None] * len(rows) if name not in self.columns else self.columns[name][rows].tolist()

    def _numbers(self, name: str, rows: NDArray[np.int64], default: float) -> Floats:
        numbers = [float(v) if isinstance(v, int | float) else default for v in self._column(name, rows)]
        out = np.array(numbers, np.float64)
        return np.where(np.isfinite(out), out, default)


def _to_degrees(path: Path, layer: str, points: Floats, crs: str) -> Floats:
    """Return (P, 2) longitude and latitude of points in a coordinate system."""
    pyproj = _pyproj()
    try:
        transformer = pyproj.Transformer.from_crs(pyproj.CRS.from_user_input(crs), "EPSG:4326", always_xy=True)
        degrees = np.stack(transformer.transform(points[:, 0], points[:, 1]), 1)
    except pyproj.exceptions.ProjError as error:
        reason = " ".join(str(error).split())
        raise VectorLayerError(f"{path}: layer '{layer}': the coordinate system {crs[:80]}: {reason}.") from None
    if not np.isfinite(degrees).all():
        raise VectorLayerError(
            f"{path}: layer '{layer}': {crs[:80]} has no place on earth for some points; state the coordinate system."
        )
    return degrees
