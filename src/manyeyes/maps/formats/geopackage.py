# SPDX-License-Identifier: Apache-2.0
"""Maps as an OGC GeoPackage on WGS 84 (EPSG:4326), for editing in QGIS: layers ``lines`` and ``crossings``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from manyeyes._io import atomic_replace
from manyeyes.datatypes import MissingExtraError
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.attributes import Attributes, to_degrees
from manyeyes.maps.formats.geoparquet import to_shapely

# GeoPackages hold the time of their last change; a fixed one makes equal maps equal files.
_NO_DATE = "1970-01-01T00:00:00.000Z"


def write_geopackage(vector_map: VectorMap, path: Path | str) -> None:
    """Write all elements to one file with two layers; a layer without elements is left out, one of an empty map is not."""
    try:
        import pyogrio.raw
        import shapely
    except ImportError:
        raise MissingExtraError("map", "Maps as GeoPackage") from None
    degrees = to_degrees(vector_map)
    geometry = shapely.to_wkb(to_shapely(shapely, degrees))
    columns = list(Attributes.of(vector_map).columns())
    fields = [name for name, _ in columns]
    with atomic_replace(Path(path), keep_suffix=True) as temporary:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _NO_DATE})
        try:
            for layer, kind, rows in (
                ("lines", "LineString", np.flatnonzero(~degrees.closed)),
                ("crossings", "Polygon", np.flatnonzero(degrees.closed)),
            ):
                if len(rows) or (layer == "lines" and not len(degrees)):
                    values = [v[rows].astype(object) if v.dtype.kind == "U" else v[rows] for _, v in columns]
                    pyogrio.raw.write(
                        temporary, geometry[rows], values, fields, layer=layer, driver="GPKG", geometry_type=kind,
                        crs="EPSG:4326", append=temporary.exists(),
                    )  # fmt: skip
        finally:
            pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
