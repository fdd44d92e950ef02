# SPDX-License-Identifier: Apache-2.0
"""One way out for a map: the format by its name or by the file's ending."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from manyeyes.datatypes import ConfigError
from manyeyes.maps.elements.simplify import simplify_map
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.argoverse2_writer import write_argoverse2
from manyeyes.maps.formats.element_graph import write_element_graph
from manyeyes.maps.formats.geojson import write_geojson
from manyeyes.maps.formats.geopackage import write_geopackage
from manyeyes.maps.formats.geoparquet import write_geoparquet
from manyeyes.maps.formats.lanelet2_writer import write_lanelet2
from manyeyes.maps.formats.nuscenes_writer import write_nuscenes
from manyeyes.maps.formats.pmtiles import write_pmtiles

Writer = Callable[[VectorMap, Path], None]

_WRITERS: dict[str, tuple[str, Writer]] = {
    "geojson": (".geojson", write_geojson),
    "geopackage": (".gpkg", write_geopackage),
    "geoparquet": (".parquet", write_geoparquet),
    "lanelet2": (".osm", write_lanelet2),
    "argoverse2": (".json", write_argoverse2),
    "nuscenes": (".json", write_nuscenes),
    "pmtiles": (".pmtiles", write_pmtiles),
    "graph": (".npz", write_element_graph),
}
#: Names of all formats, as the command line takes them.
FORMATS: tuple[str, ...] = tuple(_WRITERS)


def export_map(
    vector_map: VectorMap,
    path: Path | str,
    format: str | None = None,
    simplify_m: float = 0.0,
    crs: str | None = None,
) -> None:
    """Write a map to a file; without a format the file's ending decides. Lines leave theirs by at most simplify_m.

    crs: coordinate system of a GeoPackage, see :func:`manyeyes.maps.formats.geopackage.write_geopackage`.
    """
    path = Path(path)
    writer = _writer(path, format)
    if simplify_m > 0:
        vector_map = simplify_map(vector_map, simplify_m)
    if crs is None:
        writer(vector_map, path)
    elif writer is write_geopackage:
        write_geopackage(vector_map, path, crs)
    else:
        raise ConfigError(f"{path}: only a GeoPackage has a choice of coordinate systems; leave --crs out.")


def _writer(path: Path, format: str | None) -> Writer:
    if format is not None:
        if format not in _WRITERS:
            raise ConfigError(f"No format '{format}'; choose one of {', '.join(FORMATS)}.")
        return _WRITERS[format][1]
    by_ending = [writer for ending, writer in _WRITERS.values() if ending == path.suffix]
    if len(by_ending) != 1:
        raise ConfigError(
            f"{path}: the ending '{path.suffix}' does not name one format; choose one of {', '.join(FORMATS)}."
        )
    return by_ending[0]
