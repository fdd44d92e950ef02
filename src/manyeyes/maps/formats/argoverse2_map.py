# SPDX-License-Identifier: Apache-2.0
"""Read an Argoverse 2 vector map (``log_map_archive_*.json``) into a RoadNetwork, and the log's own poses.

Layout (Argoverse 2 map, version 2022): ``lane_segments`` with two boundaries as lists of x, y, z and the kind of their paint,
``pedestrian_crossings`` with two edges, ``drivable_areas`` with one ring each. World axes are the city frame of the log.
Drivable areas overlap each other; their union's rings become edges of the road, kind "curb". Paint between two lanes that
both name it stands in the network twice, as in the file: :mod:`manyeyes.maps.roads.ground_truth` merges it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import parse_json, read_file
from manyeyes.datatypes import ManyeyesError, MissingExtraError
from manyeyes.maps.roads.lane_links import build_junctions, complete_lane_links, connected_components, resample_borders
from manyeyes.maps.roads.road_network import Crossing, Lane, RoadMark, RoadNetwork

Array = NDArray[np.float64]

_KIND_OF_LANE = {"VEHICLE": "driving", "BUS": "bus", "BIKE": "biking"}
_SPEED_MPS = 13.9
_WIDTH_M = 0.12
_DASH_M, _GAP_M = 3.0, 6.0
# A ring of the drivable area that encloses less is a gap between two polygons, not an island.
_MIN_ISLAND_M2 = 1.0


class Argoverse2MapError(ManyeyesError):
    """A vector map or pose table that cannot be read; the text names the file and the field."""


def read_argoverse2_map(source: Path | str) -> RoadNetwork:
    """Return the roads of one log: a ``log_map_archive_*.json``, its ``map`` folder or the log's folder."""
    path = find_map_file(Path(source))
    try:
        root = parse_json(read_file(path))
    except (OSError, ValueError) as error:
        raise Argoverse2MapError(f"{path}: expected an Argoverse 2 vector map in JSON; {error}.") from error
    if not isinstance(root, dict) or not isinstance(root.get("lane_segments"), dict) or not root["lane_segments"]:
        raise Argoverse2MapError(f"{path}: expected an object with 'lane_segments'; download the map again.")
    reader = _Argoverse2Reader(path)
    lanes, marks = reader.lanes(list(root["lane_segments"].values()))
    crossings = tuple(reader.crossing(item) for item in root.get("pedestrian_crossings", {}).values())
    edges = reader.edges(list(root.get("drivable_areas", {}).values()))
    name = path.name.removeprefix("log_map_archive_").split("____")[0]
    return RoadNetwork(name, (), lanes, (*marks, *edges), crossings, (), build_junctions(lanes))


def read_argoverse2_poses(log: Path | str) -> tuple[NDArray[np.int64], Array]:
    """Return times (N,) in nanoseconds, ascending, and poses (N, 3) as x, y, yaw of the vehicle in the city frame."""
    path = Path(log)
    path = path / "city_SE3_egovehicle.feather" if path.is_dir() else path
    names = ["timestamp_ns", "tx_m", "ty_m", "qw", "qx", "qy", "qz"]
    try:
        from pyarrow import ArrowException, feather
    except ImportError:
        raise MissingExtraError("av2", "Reading Argoverse 2 poses") from None
    try:
        table = feather.read_table(path, columns=names, memory_map=False)
    except (ArrowException, OSError) as error:
        reason = " ".join(str(error).split())
        raise Argoverse2MapError(f"{path}: expected a feather table with {', '.join(names)}; {reason}.") from None
    time, x, y, qw, qx, qy, qz = (table[n].to_numpy() for n in names)
    yaw = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
    order = np.argsort(time, kind="stable")
    return time[order].astype(np.int64), np.stack((x, y, yaw), 1)[order]


class _Argoverse2Reader:
    """One file on its way to a RoadNetwork; holds its name for error texts."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def points(self, item: dict, field: str, min_points: int = 2) -> Array:
        """Return a list of x, y, z as (M, 3); an error that names file, element and field otherwise."""
        context = f"{self.path}: element {item.get('id')} field '{field}'"
        try:
            points = np.array([[p["x"], p["y"], p.get("z", 0.0)] for p in item[field]], np.float64).reshape(-1, 3)
        except (KeyError, TypeError, ValueError, AttributeError):
            raise Argoverse2MapError(f"{context}: expected a list of points x, y, z; download the map again.") from None
        if len(points) < min_points or not np.isfinite(points).all():
            raise Argoverse2MapError(f"{context}: expected {min_points} or more finite points; got {len(points)}.")
        return points

    def lanes(self, items: Sequence[dict]) -> tuple[tuple[Lane, ...], tuple[RoadMark, ...]]:
        """Return lanes in the order of their ids, linked, and their paint."""
        items = sorted(items, key=lambda item: int(item.get("id", -1)))
        place = {int(item.get("id", -1)): k for k, item in enumerate(items)}
        lefts = [self.points(item, "left_lane_boundary") for item in items]
        rights = [self.points(item, "right_lane_boundary") for item in items]
        inside = [bool(item.get("is_intersection", False)) for item in items]
        junction = _group_junctions(inside, lefts, rights)
        lanes, marks = [], []
        for k, item in enumerate(items):
            left, right = resample_borders(lefts[k], rights[k])
            near = [item.get(side) for side in ("left_neighbor_id", "right_neighbor_id")]
            lanes.append(
                Lane(
                    id=k,
                    road_id=str(item.get("id")),
                    section=0,
                    lane_id=-1,
                    kind=_KIND_OF_LANE.get(str(item.get("lane_type")), "none"),
                    junction_id=junction[k],
                    speed_limit_mps=_SPEED_MPS,
                    left=left,
                    right=right,
                    center=(left + right) / 2,
                    predecessors=tuple(sorted(place[p] for p in item.get("predecessors") or () if p in place)),
                    successors=tuple(sorted(place[p] for p in item.get("successors") or () if p in place)),
                    left_neighbor=place.get(near[0], -1) if near[0] is not None else -1,
                    right_neighbor=place.get(near[1], -1) if near[1] is not None else -1,
                )
            )
            for side, line in (("left", lefts[k]), ("right", rights[k])):
                marks += _make_marks(line, str(item.get(f"{side}_lane_mark_type", "NONE")), str(item.get("id")), side)
        return complete_lane_links(lanes), tuple(marks)

    def crossing(self, item: dict) -> Crossing:
        """Return a crossing between two edges, turned so that the ring does not cross itself."""
        one, two = self.points(item, "edge1"), self.points(item, "edge2")
        straight = np.linalg.norm(one[-1] - two[-1]) + np.linalg.norm(one[0] - two[0])
        crossed = np.linalg.norm(one[-1] - two[0]) + np.linalg.norm(one[0] - two[-1])
        return Crossing(np.concatenate((one, two[::-1] if straight <= crossed else two)), "", "edges")

    def edges(self, areas: Sequence[dict]) -> tuple[RoadMark, ...]:
        """Return the rings of the union of all drivable areas, closed: first point repeated."""
        if not areas:
            return ()
        try:
            from shapely import Polygon, make_valid, unary_union
            from shapely.ops import orient
        except ImportError:
            raise MissingExtraError("map", "Reading Argoverse 2 maps") from None
        rings = [self.points(item, "area_boundary", min_points=3)[:, :2] for item in areas]
        # Neighbouring areas touch along edges that are equal to a centimetre only.
        merged = unary_union([make_valid(Polygon(ring)).buffer(0.05, join_style="mitre") for ring in rings])
        merged = merged.buffer(-0.05, join_style="mitre")
        found = []
        for polygon in getattr(merged, "geoms", [merged]):
            turned = orient(polygon)
            islands = [ring for ring in turned.interiors if Polygon(ring).area >= _MIN_ISLAND_M2]
            found += [np.asarray(ring.coords)[:, :2] for ring in (turned.exterior, *islands)]
        found.sort(key=lambda ring: (-len(ring), *ring.min(0).tolist()))
        return tuple(RoadMark(np.pad(ring, ((0, 0), (0, 1))), "curb", "", 0.0) for ring in found)


def find_map_file(path: Path) -> Path:
    """Return the one vector map at, or below, a path."""
    if path.is_file():
        return path
    found = sorted(path.glob("log_map_archive_*.json")) or sorted(path.glob("map/log_map_archive_*.json"))
    if len(found) != 1:
        raise Argoverse2MapError(
            f"{path}: expected one log_map_archive_*.json in it or in its 'map' folder; found {len(found)}."
        )
    return found[0]


def _group_junctions(inside: Sequence[bool], lefts: Sequence[Array], rights: Sequence[Array]) -> list[str | None]:
    """Return names of junctions: lanes marked as inside an intersection, joined where their surfaces overlap."""
    try:
        import shapely
    except ImportError:
        raise MissingExtraError("map", "Reading Argoverse 2 maps") from None
    own = [k for k, flag in enumerate(inside) if flag]
    rings = [shapely.Polygon(np.concatenate((lefts[k], rights[k][::-1]))[:, :2]).buffer(0.1) for k in own]
    pairs = shapely.STRtree(rings).query(rings, predicate="intersects") if rings else np.zeros((2, 0), np.int64)
    names: list[str | None] = [None] * len(inside)
    for k, label in zip(own, connected_components(len(own), pairs.T)):
        names[k] = str(label)
    return names


def _make_marks(line: Array, kind: str, lane: str, side: str) -> list[RoadMark]:
    """Return one mark, or two 0.24 m apart for a double line, of a boundary whose paint Argoverse names e.g.
    DOUBLE_SOLID_YELLOW.
    """
    words = kind.split("_")
    color = words[-1].lower()
    strokes = [word for word in words[:-1] if word in ("SOLID", "DASHED")]
    if "DOUBLE" in words and len(strokes) == 1:
        strokes *= 2
    if not strokes:
        return []
    spread = [0.0] if len(strokes) == 1 else [_WIDTH_M, -_WIDTH_M]
    step = np.gradient(line[:, :2], axis=0)
    normal = np.stack((-step[:, 1], step[:, 0]), 1) / np.maximum(np.linalg.norm(step, axis=1), 1e-9)[:, None]
    marks = []
    for stroke, offset in zip(strokes, spread):
        moved = line.copy()
        moved[:, :2] += offset * normal
        broken = stroke == "DASHED"
        dash, gap = (_DASH_M, _GAP_M) if broken else (0.0, 0.0)
        name = "broken" if broken else "solid"
        marks.append(RoadMark(moved, name, color, _WIDTH_M, dash, gap, lane, 0, 1 if side == "left" else -1))
    return marks


__all__ = ["Argoverse2MapError", "find_map_file", "read_argoverse2_map", "read_argoverse2_poses"]
