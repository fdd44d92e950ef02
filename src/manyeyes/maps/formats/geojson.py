# SPDX-License-Identifier: Apache-2.0
"""Maps as GeoJSON (RFC 7946): longitude, latitude on WGS 84, one feature a line; for small maps and web pages."""

from __future__ import annotations

import json
from pathlib import Path

from manyeyes._io import atomic_write
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.attributes import Attributes, to_degrees

# 1e-8 degrees are 1.1 mm on a meridian.
_DIGITS = 8


def write_geojson(vector_map: VectorMap, path: Path | str) -> None:
    """Write all elements as one FeatureCollection; crossings are polygons, all others lines."""
    features = ",\n".join(geojson_features(vector_map))
    text = f'{{"type":"FeatureCollection","features":[\n{features}\n]}}\n'
    atomic_write(Path(path), text.encode())


def geojson_features(vector_map: VectorMap) -> list[str]:
    """Return one JSON text a feature, row by row with the map's elements."""
    degrees = to_degrees(vector_map)
    columns = [(name, values.tolist()) for name, values in Attributes.of(vector_map).columns()]
    places = degrees.points.round(_DIGITS).tolist()
    closed, first = degrees.closed.tolist(), degrees.offsets.tolist()
    out = []
    for row in range(len(degrees)):
        line = places[first[row] : first[row + 1]]
        ring = closed[row]
        geometry = {
            "type": "Polygon" if ring else "LineString",
            "coordinates": [[*line, line[0]]] if ring else line,
        }
        properties = {name: values[row] for name, values in columns}
        feature = {"type": "Feature", "id": properties["id"], "geometry": geometry, "properties": properties}
        out.append(json.dumps(feature, separators=(",", ":"), allow_nan=False))
    return out
