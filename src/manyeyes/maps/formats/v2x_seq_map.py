# SPDX-License-Identifier: Apache-2.0
"""Read a vector map of V2X-Seq (one JSON an intersection) into a RoadNetwork.

Layout: ``LANE`` (``left_boundary`` and ``right_boundary``, ``lane_type``; in the forecasting part ``is_intersection``,
``predecessors``, ``successors`` too), ``JUNCTION`` and ``CROSSWALK`` (``polygon``), ``STOPLINE`` (``centerline``), each by id.
Points are texts "(x, y)", metres. There is no layer of dividers, so they are derived: of lanes outside
junctions, a border that another such lane has as well is paint between them; one that no other has is the road's edge.
:mod:`manyeyes.maps.roads.ground_truth` then makes one line of what is stored twice, and chains what continues.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import parse_json, read_file
from manyeyes.datatypes import ManyeyesError
from manyeyes.datatypes.extras import import_extra
from manyeyes.maps.roads.lane_links import build_junctions, complete_lane_links, resample_borders
from manyeyes.maps.roads.road_network import PAVED, Crossing, Lane, RoadMark, RoadNetwork

_shapely = partial(import_extra, "shapely", "map", "Reading V2X-Seq maps")

Array = NDArray[np.float64]

_KIND_OF_LANE = {
    "CITY_DRIVING": "driving",
    "LEFT_TURN_WAITING_ZONE": "driving",
    "ROUNDABOUT": "driving",
    "EMERGENCY_LANE": "restricted",
    "BIKING": "biking",
}
_SPEED_MPS = 13.9
_WIDTH_M = 0.12
# Two lanes' borders are one physical line where so much of one lies so near the other.
_SAME_M, _SHARED = 0.3, 0.5
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


class V2xSeqMapError(ManyeyesError):
    """A vector map that cannot be read; the text names the file and the field."""


def read_v2x_seq_map(path: Path | str, offset_xy: tuple[float, float] = (0.0, 0.0)) -> RoadNetwork:
    """Return the roads of one intersection. offset_xy: metres that are added to the file's points, to come to a recording's
    world.
    """
    path = Path(path)
    try:
        root = parse_json(read_file(path))
    except (OSError, ValueError) as error:
        raise V2xSeqMapError(f"{path}: expected a V2X-Seq vector map in JSON; {error}.") from error
    if not isinstance(root, dict) or not isinstance(root.get("LANE"), dict) or not root["LANE"]:
        raise V2xSeqMapError(f"{path}: expected an object with 'LANE'; download the map again.")
    reader = _V2xSeqReader(path, np.array([*offset_xy, 0.0]))
    lanes = reader.lanes(root["LANE"], reader.layer(root, "JUNCTION"))
    crossings = tuple(
        Crossing(reader.points("CROSSWALK", name, item, "polygon", 3), "", "polygon")
        for name, item in sorted(reader.layer(root, "CROSSWALK").items())
    )
    stops = tuple(
        RoadMark(reader.points("STOPLINE", name, item, "centerline", 2), "stop", "", 0.3)
        for name, item in sorted(reader.layer(root, "STOPLINE").items())
    )
    return RoadNetwork(path.stem, (), lanes, (*_borders(lanes), *stops), crossings, (), build_junctions(lanes))


class _V2xSeqReader:
    """One file on its way to a RoadNetwork; holds its name for error texts."""

    def __init__(self, path: Path, offset: Array) -> None:
        self.path, self.offset = path, offset

    def layer(self, root: Mapping[str, Any], name: str) -> Mapping[str, Any]:
        """Return the elements of a layer by id; none where the file lacks it."""
        found = root.get(name) or {}
        if not isinstance(found, dict):
            raise V2xSeqMapError(
                f"{self.path}: expected '{name}' to be an object of elements by id; download it again."
            )
        return found

    def points(self, layer: str, name: str, item: Any, field: str, min_points: int) -> Array:
        """Return points (M, 3), height 0; an error that names file, element and field otherwise."""
        context = f"{self.path}: {layer} {name} field '{field}'"
        try:
            rows = [_point(one) for one in item[field]]
            points = np.array(rows, np.float64).reshape(-1, 2)
        except (KeyError, TypeError, ValueError):
            raise V2xSeqMapError(f'{context}: expected a list of points "(x, y)"; download the map again.') from None
        if len(points) < min_points or not np.isfinite(points).all():
            raise V2xSeqMapError(f"{context}: expected {min_points} or more finite points; got {len(points)}.")
        return np.pad(points, ((0, 0), (0, 1))) + self.offset

    def lanes(self, items: Mapping[str, Any], junctions: Mapping[str, Any]) -> tuple[Lane, ...]:
        """Return lanes in the order of their ids, linked; those for which the file gives no borders are left out."""
        names = sorted(n for n in items if items[n].get("left_boundary") and items[n].get("right_boundary"))
        place = {name: k for k, name in enumerate(names)}
        inside = self._junctions(junctions)
        lanes = []
        for k, name in enumerate(names):
            item = items[name]
            left, right = resample_borders(
                self.points("LANE", name, item, "left_boundary", 2),
                self.points("LANE", name, item, "right_boundary", 2),
            )
            before, after = (
                tuple(sorted(place[str(p)] for p in item.get(field) or () if str(p) in place))
                for field in ("predecessors", "successors")
            )
            center = (left + right) / 2
            junction = inside(center)
            if junction is None and str(item.get("is_intersection", "")).lower() == "true":
                junction = f"lane {name}"
            kind = _KIND_OF_LANE.get(str(item.get("lane_type")), "none")
            lanes.append(Lane(k, name, 0, -1, kind, junction, _SPEED_MPS, left, right, center, before, after))
        return complete_lane_links(lanes)

    def _junctions(self, items: Mapping[str, Any]) -> Any:
        """From a lane's centreline (M, 3) to the name of the junction that holds most of it, None of the open road."""
        shapely = _shapely()
        names = sorted(items)
        rings = [shapely.Polygon(self.points("JUNCTION", n, items[n], "polygon", 3)[:, :2]).buffer(0.0) for n in names]

        def held(center: Array) -> str | None:
            line = shapely.LineString(center[:, :2])
            share = [line.intersection(ring).length for ring in rings]
            best = int(np.argmax(share)) if share else -1
            return names[best] if share and share[best] > 0.5 * line.length else None

        return held


def _point(text: Any) -> tuple[float, float]:
    """From "(x, y)" or [x, y]."""
    values = _NUMBER.findall(text) if isinstance(text, str) else list(text)
    if len(values) < 2:
        raise ValueError(text)
    return float(values[0]), float(values[1])


def _borders(lanes: Sequence[Lane]) -> list[RoadMark]:
    """Of lanes outside junctions, left and right: paint where another such lane has the same line, else an edge."""
    shapely = _shapely()
    own = [lane for lane in lanes if lane.junction_id is None and lane.kind in PAVED]
    sides = [(lane, side, line) for lane in own for side, line in ((1, lane.left), (-1, lane.right))]
    near = [shapely.LineString(line[:, :2]).buffer(_SAME_M, cap_style="flat") for _, _, line in sides]
    tree = shapely.STRtree(near)
    marks = []
    for lane, side, line in sides:
        drawn = shapely.LineString(line[:, :2])
        others = [near[k] for k in tree.query(drawn) if sides[k][0].id != lane.id]
        shared = drawn.intersection(shapely.union_all(others)).length if others else 0.0
        if shared >= _SHARED * drawn.length:
            marks.append(RoadMark(line, "solid", "", _WIDTH_M, road_id=lane.road_id, lane_id=side))
        else:
            marks.append(RoadMark(line, "curb", "", 0.0))
    return marks


__all__ = ["V2xSeqMapError", "read_v2x_seq_map"]
