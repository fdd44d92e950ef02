# SPDX-License-Identifier: Apache-2.0
"""Maps as an OGC GeoPackage, for editing in QGIS: layers ``lines`` and ``crossings``, with their styles.

On WGS 84 (EPSG:4326) by default, in the map's own metric frame (``local``), or in any coordinate system that PROJ knows.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from manyeyes._io import atomic_replace
from manyeyes.datatypes import ConfigError, MissingExtraError
from manyeyes.datatypes.extras import import_extra
from manyeyes.datatypes.map_element import MapElements
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.attributes import Attributes, orient_counter_clockwise, to_degrees
from manyeyes.maps.formats.geopackage_styles import write_styles
from manyeyes.maps.formats.geoparquet import to_shapely

# GeoPackages hold the time of their last change; a fixed one makes equal maps equal files.
_NO_DATE = "1970-01-01T00:00:00.000Z"


def write_geopackage(vector_map: VectorMap, path: Path | str, crs: str = "EPSG:4326") -> None:
    """Write all elements to one file with two layers; a layer without elements is left out, one of an empty map is not.

    Args:
        crs: coordinate system of the file, such as "EPSG:25832", or "local", the transverse Mercator about the map's origin.

    Raises:
        ConfigError: PROJ does not know the coordinate system, or it does not cover the map.
    """
    try:
        import pyogrio.raw
        import shapely
    except ImportError:
        raise MissingExtraError("map", "Maps as GeoPackage") from None
    placed = _place(vector_map, crs)
    stated = f"{vector_map.frame.proj} +title=manyeyes_local" if crs == "local" else crs
    geometry = shapely.to_wkb(to_shapely(shapely, placed))
    columns = list(Attributes.of(vector_map).columns())
    fields = [name for name, _ in columns]
    layers: list[str] = []
    with atomic_replace(Path(path), keep_suffix=True) as temporary:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _NO_DATE})
        try:
            for layer, kind, rows in (
                ("lines", "LineString", np.flatnonzero(~placed.closed)),
                ("crossings", "Polygon", np.flatnonzero(placed.closed)),
            ):
                if len(rows) or (layer == "lines" and not len(placed)):
                    layers.append(layer)
                    values = [v[rows].astype(object) if v.dtype.kind == "U" else v[rows] for _, v in columns]
                    pyogrio.raw.write(
                        temporary, geometry[rows], values, fields, layer=layer, driver="GPKG", geometry_type=kind,
                        crs=stated, append=temporary.exists(),
                    )  # fmt: skip
        finally:
            pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
        write_styles(temporary, layers, _NO_DATE)


def _place(vector_map: VectorMap, crs: str) -> MapElements:
    """Return the elements with points in a coordinate system, x or longitude first; rings run counter-clockwise."""
    if crs == "local":
        return orient_counter_clockwise(vector_map.elements)
    degrees = to_degrees(vector_map)
    if crs.upper() == "EPSG:4326":
        return degrees
    pyproj = import_extra("pyproj", "map", "Coordinate systems of maps")
    try:
        transformer = pyproj.Transformer.from_crs("EPSG:4326", pyproj.CRS.from_user_input(crs), always_xy=True)
    except pyproj.exceptions.ProjError as error:
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"The coordinate system {crs[:80]!r}: {reason}; give 'local', or one such as EPSG:25832."
        ) from None
    points = np.stack(transformer.transform(degrees.points[:, 0], degrees.points[:, 1]), 1)
    if not np.isfinite(points).all():
        raise ConfigError(f"The coordinate system {crs[:80]!r} does not cover the map; choose one of its region.")
    return degrees.with_points(points)
