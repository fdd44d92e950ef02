# SPDX-License-Identifier: Apache-2.0
"""Maps as PMTiles: vector tiles of Web Mercator in one file, for web pages; layer ``elements``, written by GDAL."""

from __future__ import annotations

from pathlib import Path

from manyeyes._io import atomic_replace
from manyeyes.datatypes import ConfigError, MissingExtraError
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.attributes import Attributes, in_degrees
from manyeyes.maps.formats.geoparquet import geometries

# At zoom 16 a tile's 4096 steps are 15 cm each at the equator.
_LEAST_ZOOM, _MOST_ZOOM = 12, 16


def write_pmtiles(
    vector_map: VectorMap, path: Path | str, least_zoom: int = _LEAST_ZOOM, most_zoom: int = _MOST_ZOOM
) -> None:
    """Write all elements as vector tiles from zoom least_zoom to most_zoom."""
    if not 0 <= least_zoom <= most_zoom <= 22:
        raise ConfigError(f"Expected zooms 0 <= least <= most <= 22; got {least_zoom} and {most_zoom}.")
    if not len(vector_map):
        raise ConfigError(f"{path}: vector tiles of an empty map have no place on earth; fuse more observations first.")
    try:
        import pyogrio.raw
        import shapely
    except ImportError:
        raise MissingExtraError("map", "Maps as PMTiles") from None
    degrees = in_degrees(vector_map)
    columns = list(Attributes.of(vector_map).columns())
    with atomic_replace(Path(path), keep_suffix=True) as temporary:
        pyogrio.raw.write(
            temporary,
            shapely.to_wkb(geometries(shapely, degrees)),
            [values.astype(object) if values.dtype.kind == "U" else values for _, values in columns],
            [name for name, _ in columns],
            driver="PMTiles",
            layer="elements",
            geometry_type="Unknown",
            crs="EPSG:4326",
            dataset_options={"MINZOOM": least_zoom, "MAXZOOM": most_zoom, "NAME": "manyeyes"},
        )
