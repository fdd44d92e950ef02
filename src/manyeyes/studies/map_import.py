# SPDX-License-Identifier: Apache-2.0
"""Maps of other programs, by their files, as elements in one frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes._io import parse_json, read_file
from manyeyes.datatypes import ConfigError
from manyeyes.maps.store.map_place import MapPlace

if TYPE_CHECKING:
    from manyeyes.datatypes.map_element import MapElements
    from manyeyes.maps.elements.observation import MapFrame
    from manyeyes.maps.roads.road_network import RoadNetwork

_LAYER_ENDINGS = (".gpkg", ".geojson")


@dataclass(frozen=True, eq=False)
class SourceMap:
    """elements: metres in the frame. left_out: what the file holds and the map does not, and how often."""

    place: Path | str
    frame: MapFrame
    elements: MapElements
    left_out: Mapping[str, int] = field(default_factory=dict)


def is_map(place: Path | str) -> bool:
    """Return whether a place is a map, by ending, folder, URL or content; a result file of a map model is none."""
    if _is_own(place):
        return True
    path = Path(place)
    if path.is_dir() or path.suffix.lower() in (".osm", *_LAYER_ENDINGS):
        return True
    return path.suffix.lower() == ".json" and _is_argoverse2(path)


def read_source_map(place: Path | str, frame: MapFrame | None = None, crs: str | None = None) -> SourceMap:
    """Return the elements of an Argoverse 2 map or log, a Lanelet2 map, a GeoPackage, a GeoJSON file, an own map or a store.

    Args:
        place: the file or folder, or the URL of a store. frame: where the elements are wanted; by default about the middle of the
            map, or its own.
        crs: of a GeoPackage that states none; "local" coordinates of a file without a place on earth are those of ``frame``.

    Raises:
        ConfigError: the file is no map, or states no place on earth and there is no ``frame``.
    """
    if _is_own(place):
        return _read_own(place, frame)
    path = Path(place)
    if path.suffix.lower() in _LAYER_ENDINGS:
        return _read_layers(path, frame, crs)
    if path.suffix.lower() == ".osm":
        return _read_lanelet2(path, frame)
    return _read_argoverse2(path, frame)


def _is_own(place: Path | str) -> bool:
    """Return whether a place is the folder of a map, or a store."""
    folder = MapPlace.parse(place).folder
    return folder is None or any((folder / name).is_file() for name in ("store.json", "lines.parquet"))


def _is_argoverse2(path: Path) -> bool:
    try:
        root = parse_json(read_file(path))
    except (OSError, ValueError):
        return False
    return isinstance(root, dict) and "lane_segments" in root


def _read_own(place: Path | str, frame: MapFrame | None) -> SourceMap:
    from manyeyes.maps.formats.reframe import move_to_frame
    from manyeyes.studies.map_folder import read_vector_map

    own = read_vector_map(place)
    published = own.select_published()
    left_out = {"element that is not published": len(own) - len(published)} if len(own) > len(published) else {}
    moved = move_to_frame(published, frame or own.frame)
    return SourceMap(place, moved.frame, moved.elements, left_out)


def _read_layers(path: Path, frame: MapFrame | None, crs: str | None) -> SourceMap:
    from manyeyes.maps.formats.vector_layers import read_vector_layers
    from manyeyes.maps.roads.transverse_mercator import metres_from_degrees

    found = read_vector_layers(path, crs)
    longitude, latitude = found.elements.points.T
    frame = frame or _middle(latitude, longitude, path)
    xy = metres_from_degrees(latitude, longitude, (frame.latitude, frame.longitude))
    return SourceMap(path, frame, found.elements.with_points(xy), found.left_out)


def _read_lanelet2(path: Path, frame: MapFrame | None) -> SourceMap:
    from manyeyes.maps.elements.observation import MapFrame
    from manyeyes.maps.formats.lanelet2 import lanelet2_origin, read_lanelet2

    frame = frame or MapFrame(*lanelet2_origin(path))
    network = read_lanelet2(path, (frame.latitude, frame.longitude))
    return SourceMap(path, frame, _to_elements(network), {})


def _read_argoverse2(path: Path, frame: MapFrame | None) -> SourceMap:
    from manyeyes.maps.formats.argoverse2_city import CITIES, degrees_from_city, find_city
    from manyeyes.maps.formats.argoverse2_map import find_map_file, read_argoverse2_map
    from manyeyes.maps.roads.transverse_mercator import metres_from_degrees

    file = find_map_file(path)
    elements = _to_elements(read_argoverse2_map(file))
    city = find_city(file)
    if city is None:
        if frame is None:
            raise ConfigError(
                f"{file}: its name states no city ({', '.join(CITIES)}), so its place on earth is unknown: give "
                "--origin LATITUDE LONGITUDE of its x = y = 0."
            )
        return SourceMap(path, frame, elements)
    degrees = degrees_from_city(elements.points, city)
    frame = frame or _middle(degrees[:, 0], degrees[:, 1], file)
    xy = metres_from_degrees(degrees[:, 0], degrees[:, 1], (frame.latitude, frame.longitude))
    return SourceMap(path, frame, elements.with_points(xy))


def _to_elements(network: RoadNetwork) -> MapElements:
    from manyeyes.maps.roads.ground_truth import build_ground_truth_map

    return build_ground_truth_map(network)


def _middle(latitude, longitude, path: Path) -> MapFrame:
    from manyeyes.maps.elements.observation import MapFrame

    if not len(latitude):
        raise ConfigError(f"{path}: no feature has a kind: expected a field or layers named divider, boundary, ...")
    places = ((float(v.min()) + float(v.max())) / 2 for v in (latitude, longitude))
    return MapFrame(*(round(place, 4) for place in places))
