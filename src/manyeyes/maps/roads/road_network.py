# SPDX-License-Identifier: Apache-2.0
"""Roads as typed geometry: lanes with borders, paint, crossings and junctions, in one right-handed world frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from manyeyes.maps.roads.surface import RoadSurface

Array = NDArray[np.float64]

DRIVABLE = ("driving", "bidirectional", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "bus", "taxi", "HOV")
PAVED = (*DRIVABLE, "parking", "stop", "biking", "restricted", "roadWorks")
WALKABLE = ("sidewalk", "walking", "shoulder", "curb")


@dataclass(frozen=True, eq=False)
class Lane:
    """One lane of one lane section, oriented along its direction of travel.

    left, right, center: (M, 3) metres, float64, row i of each at the same station; left is on the left hand of who
    drives. id: its place in RoadNetwork.lanes. lane_id: OpenDRIVE's, negative right of the reference line. kind: OpenDRIVE's
    lane type. predecessors, successors: ids of lanes whose ends touch, by travel. left_neighbor, right_neighbor: ids, -1 at
    the road's edge; same_direction of a neighbour is ``lane_id * lane_id_of_other > 0``.
    """

    id: int
    road_id: str
    section: int
    lane_id: int
    kind: str
    junction_id: str | None
    speed_limit_mps: float
    left: Array
    right: Array
    center: Array
    predecessors: tuple[int, ...] = ()
    successors: tuple[int, ...] = ()
    left_neighbor: int = -1
    right_neighbor: int = -1

    @property
    def is_drivable(self) -> bool:
        """Whether motor traffic moves on it."""
        return self.kind in DRIVABLE

    @property
    def length_m(self) -> float:
        """Length of the centreline."""
        return float(np.linalg.norm(np.diff(self.center, axis=0), axis=1).sum())

    @property
    def width_m(self) -> Array:
        """(M,) width at each row."""
        return np.linalg.norm(self.left - self.right, axis=1)


@dataclass(frozen=True, eq=False)
class RoadMark:
    """One physical line on the road: a double line is two marks.

    line: (M, 3) metres. kind: solid, broken, curb (an edge, not paint) or stop (a stop line). dash_m, gap_m: the pattern of a
    broken line, which begins with a dash at the first point; 0 otherwise. road_id, section, lane_id: the border it lies on
    (lane_id 0 is the centre; "" and 0 where it is an object of its own), so that the two lines of a double line can be joined.
    """

    line: Array
    kind: str
    color: str
    width_m: float
    dash_m: float = 0.0
    gap_m: float = 0.0
    road_id: str = ""
    section: int = 0
    lane_id: int = 0

    @property
    def is_paint(self) -> bool:
        """Whether it is painted on the surface."""
        return self.kind != "curb"


@dataclass(frozen=True, eq=False)
class Crossing:
    """A pedestrian crossing: polygon (M, 3), not closed; style is the file's name for it (Ladder…, Continental…, Simple…)."""

    polygon: Array
    road_id: str
    style: str


@dataclass(frozen=True, eq=False)
class ParkingSpace:
    """A marked place for one car: polygon (4, 3)."""

    polygon: Array
    road_id: str


@dataclass(frozen=True, eq=False)
class Junction:
    """Where roads meet: center (3,), radius_m reaches the farthest corner of its lanes; lanes and incoming are lane ids."""

    id: str
    center: Array
    radius_m: float
    lanes: tuple[int, ...]
    incoming: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Road:
    """A reference line (M, 3) with stations (M,), its file's length, and the ids of its lanes."""

    id: str
    length_m: float
    junction_id: str | None
    reference: Array
    station: Array
    lanes: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class RoadNetwork:
    """All roads of one place. World axes are OpenDRIVE's own: right-handed, z up, metres (CARLA's y is the negative).

    xodr: the file's bytes, unpacked; who drives traffic on these roads converts them with SUMO.
    """

    name: str
    roads: tuple[Road, ...]
    lanes: tuple[Lane, ...]
    marks: tuple[RoadMark, ...]
    crossings: tuple[Crossing, ...]
    parking: tuple[ParkingSpace, ...]
    junctions: tuple[Junction, ...]
    xodr: bytes = field(default=b"", repr=False)

    @cached_property
    def surface(self) -> RoadSurface:
        """Every lane's surface, the heights of which :meth:`height` reads."""
        return RoadSurface.of_strips([lane.left for lane in self.lanes], [lane.right for lane in self.lanes])

    @cached_property
    def drivable_surface(self) -> RoadSurface:
        """The surface of the drivable lanes; triangle owners index ``[lane for lane in lanes if lane.is_drivable]``."""
        drivable = [lane for lane in self.lanes if lane.is_drivable]
        return RoadSurface.of_strips([lane.left for lane in drivable], [lane.right for lane in drivable])

    def height(self, xy: Array, near_z: Array | float | None = None) -> Array:
        """Return (N,) road height under points (N, 2); off the road, that of the nearest lane.

        Where roads cross on two levels: the one nearest to near_z, the highest when near_z is None.
        """
        return self.surface.height(xy, near_z)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max of the lanes."""
        points = np.concatenate([np.concatenate((lane.left, lane.right)) for lane in self.lanes])
        low, high = points.min(0), points.max(0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])
