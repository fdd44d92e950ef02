# SPDX-License-Identifier: Apache-2.0
"""City frames of Argoverse 2 in degrees: UTM on WGS 84, shifted so that a city's origin is x = y = 0.

Source: the data set's documentation of its city coordinate systems (origins and UTM zones of the six cities).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manyeyes.maps.roads.transverse_mercator import degrees_from_metres, metres_from_degrees

Floats = NDArray[np.float64]

_UTM_SCALE = 0.9996
# Latitude, longitude (degrees) of the origin, and UTM zone.
_CITIES = {
    "ATX": (30.27464237939507, -97.7404457407424, 14),
    "DTW": (42.29993066912924, -83.17555750783717, 17),
    "MIA": (25.77452579915163, -80.19656914449405, 17),
    "PAO": (37.416065, -122.13571963362166, 10),
    "PIT": (40.44177902989321, -80.01294377242584, 17),
    "WDC": (38.889377, -77.0355047439081, 18),
}
CITIES: tuple[str, ...] = tuple(_CITIES)


def find_city(map_file: Path) -> str | None:
    """Return the city that a file's name states (``log_map_archive_LOG____PIT_city_47896.json``); None without one."""
    found = re.search(r"____([A-Z]{3})_city_", map_file.name)
    return found.group(1) if found and found.group(1) in _CITIES else None


def degrees_from_city(xy: Floats, city: str) -> Floats:
    """Return latitude and longitude (N, 2), degrees, of points (N, 2) in metres of a city's frame."""
    latitude, longitude, zone = _CITIES[city]
    central = (0.0, 6.0 * zone - 183.0)
    origin = metres_from_degrees(np.array([latitude]), np.array([longitude]), central)
    return degrees_from_metres(np.asarray(xy, np.float64) / _UTM_SCALE + origin, central)
