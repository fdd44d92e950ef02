# SPDX-License-Identifier: Apache-2.0
"""Maps as PMTiles: vector tiles of Web Mercator in one file, for web pages; layer ``elements``, written by GDAL."""

from __future__ import annotations

from pathlib import Path

from manyeyes._io import atomic_replace
from manyeyes.datatypes import ConfigError, MissingExtraError
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.attributes import Attributes, to_degrees
from manyeyes.maps.formats.geoparquet import to_shapely

# At zoom 16 a tile's 4096 steps are 15 cm each at the equator.
_MIN_ZOOM, _MAX_ZOOM = 12, 16


def write_pmtiles(
    vector_map: VectorMap, path: Path | str, min_zoom: int = _MIN_ZOOM, max_zoom: int = _MAX_ZOOM
) -> None:
    """Write all elements as vector tiles from zoom min_zoom to max_zoom."""
    if not 0 <= min_zoom <= max_zoom <= 22:
        raise ConfigError(f"Expected zooms 0 <= min_zoom <= max_zoom <= 22; got {min_zoom} and {max_zoom}.")
    if not len(vector_map):
        raise ConfigError(f"{path}: vector tiles of an empty map have no place on earth; fuse more observations first.")
    try:
        import pyogrio.raw
        import shapely
    except ImportError:
        raise MissingExtraError("map", "Maps as PMTiles") from None
    degrees = to_degrees(vector_map)
    columns = list(Attributes.of(vector_map).columns())
    with atomic_replace(Path(path), keep_suffix=True) as temporary:
        pyogrio.raw.write(
            temporary,
            shapely.to_wkb(to_shapely(shapely, degrees)),
            [values.astype(object) if values.dtype.kind == "U" else values for _, values in columns],
            [name for name, _ in columns],
            driver="PMTiles",
            layer="elements",
            geometry_type="Unknown",
            crs="EPSG:4326",
            dataset_options={"MINZOOM": min_zoom, "MAXZOOM": max_zoom, "NAME": "manyeyes"},
        )
