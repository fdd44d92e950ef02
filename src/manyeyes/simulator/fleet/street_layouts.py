# SPDX-License-Identifier: Apache-2.0
"""Streets of varied layout with traffic, for landmark scenes without end (landmarks.py with ``LandmarkSpec.layout``).

The crossing of landmark_traffic.py is always the same one. Here widths and numbers of lanes, headways, rows of bays and the angle
of the crossing vary, and a road may bend or be missing, so that nothing that is trained on such scenes fits one crossing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.simulator.fleet.landmark_traffic import Traffic

Floats = NDArray[np.float64]
_HALF_ROAD_M = 140.0
_MIN_DISTANCE_M = 4.0


@dataclass(frozen=True)
class StreetLayout:
    """Roads that cross at the origin, each with traffic in both directions.

    num_roads: one or two. lanes: of each direction. lane_m: their width. crossing_rad: angle between the roads. curvature_per_m: of
    the first road. min_headway_m, mean_gap_m: of vehicles in a lane. bay_m: distance of parked vehicles. row_prob: chance that an
    arm has a row of them. bay_filled_prob: chance that a bay is taken. is_angled: vehicles park across instead of along the road.
    """

    num_roads: int = 2
    lanes: int = 3
    lane_m: float = 3.5
    crossing_rad: float = math.pi / 2
    curvature_per_m: float = 0.0
    min_headway_m: float = 7.0
    mean_gap_m: float = 11.0
    bay_m: float = 6.5
    row_prob: float = 0.6
    bay_filled_prob: float = 0.7
    is_angled: bool = False

    def __post_init__(self) -> None:
        if self.num_roads not in (1, 2) or self.lanes < 1 or min(self.lane_m, self.bay_m, self.min_headway_m) <= 0:
            raise ConfigError("StreetLayout needs one or two roads, lanes of at least 1, and distances above 0.")


def draw_layout(rng: np.random.Generator) -> StreetLayout:
    """Draw a layout of streets."""
    return StreetLayout(
        num_roads=1 if rng.random() < 0.2 else 2,
        lanes=int(rng.integers(1, 4)),
        lane_m=rng.uniform(2.9, 3.8),
        crossing_rad=math.pi / 2 + (rng.uniform(-0.7, 0.7) if rng.random() < 0.4 else 0.0),
        curvature_per_m=rng.uniform(-0.006, 0.006) if rng.random() < 0.3 else 0.0,
        min_headway_m=rng.uniform(6.0, 8.0),
        mean_gap_m=rng.uniform(5.0, 20.0),
        bay_m=rng.uniform(5.6, 7.2),
        row_prob=rng.uniform(0.2, 1.0),
        bay_filled_prob=rng.uniform(0.4, 0.95),
        is_angled=bool(rng.random() < 0.15),
    )


def place_on_road(layout: StreetLayout, road: int, longitudinal: Floats, lateral: Floats) -> Floats:
    """Return poses (N, 3) in the direction of a road, at distances along its middle and to the left of it (m)."""
    k = layout.curvature_per_m if road == 0 else 0.0
    angle = k * longitudinal
    x, y = (longitudinal, 0 * angle) if k == 0 else (np.sin(angle) / k, (1 - np.cos(angle)) / k)
    x, y = x - np.sin(angle) * lateral, y + np.cos(angle) * lateral
    turn = road * layout.crossing_rad
    c, s = math.cos(turn), math.sin(turn)
    return np.stack((c * x - s * y, s * x + c * y, angle + turn), 1)


def make_street_traffic(layout: StreetLayout, rng: np.random.Generator) -> Traffic:
    """Return everything that stands or drives in the streets of a layout; nothing overlaps at time 0."""
    poses, speeds = [], []
    for road in range(layout.num_roads):
        for side in (0, 1):
            for lane in range(layout.lanes):
                gaps = layout.min_headway_m + rng.exponential(layout.mean_gap_m, 50)
                longitudinal = np.cumsum(gaps) - _HALF_ROAD_M
                longitudinal = longitudinal[longitudinal < _HALF_ROAD_M]
                lateral = -(lane + 0.5) * layout.lane_m + 0.3 * rng.standard_normal(len(longitudinal))
                poses.append(_direct(layout, road, side, longitudinal, lateral, 0.026, rng))
                speeds.append(np.full(len(longitudinal), rng.uniform(4.0, 13.0)))
            for leg in (-1, 1):
                bays = leg * np.arange(18.0, 85.0, layout.bay_m / (2.2 if layout.is_angled else 1.0))
                bays = bays[rng.random(len(bays)) < layout.bay_filled_prob * (rng.random() < layout.row_prob)]
                longitudinal = bays + (0.15 if layout.is_angled else 0.5) * rng.standard_normal(len(bays))
                edge = layout.lanes * layout.lane_m + (3.0 if layout.is_angled else 1.1)
                lateral = 0.15 * rng.standard_normal(len(bays)) - edge
                parked = _direct(layout, road, side, longitudinal, lateral, 0.035, rng)
                parked[:, 2] += math.pi * (rng.random(len(bays)) < 0.1) + (math.pi / 2 if layout.is_angled else 0.0)
                poses.append(parked)
                speeds.append(np.zeros(len(bays)))
    pose, speed = np.concatenate(poses), np.concatenate(speeds)
    large = rng.random(len(pose)) < 0.1
    length = np.where(large, rng.uniform(5.5, 11.0, len(pose)), 4.5 + 0.3 * rng.standard_normal(len(pose)))
    width = np.where(large, rng.uniform(2.1, 2.6, len(pose)), 1.85 + 0.08 * rng.standard_normal(len(pose)))
    dx, dy = (pose[:, None, k] - pose[None, :, k] for k in (0, 1))
    is_near = np.tril(dx * dx + dy * dy < (2.0 if layout.is_angled else _MIN_DISTANCE_M) ** 2, -1)
    keep = ~is_near.any(1)
    return Traffic(pose[keep], speed[keep], np.stack((length, width), 1)[keep])


def _direct(
    layout: StreetLayout,
    road: int,
    side: int,
    longitudinal: Floats,
    lateral: Floats,
    sigma_rad: float,
    rng: np.random.Generator,
) -> Floats:
    """Return poses (N, 3) of vehicles in one direction of a road, with headings scattered by sigma_rad."""
    sign = 1 - 2 * side
    pose = place_on_road(layout, road, sign * longitudinal, sign * lateral)
    pose[:, 2] += math.pi * side + sigma_rad * rng.standard_normal(len(pose))
    return pose


def place_in_lane(layout: StreetLayout, rng: np.random.Generator) -> tuple[Floats, float]:
    """Return a vehicle's pose and speed, in a lane within 50 m of the crossing."""
    road, side = int(rng.integers(layout.num_roads)), int(rng.integers(2))
    lateral = -(rng.integers(layout.lanes) + 0.5) * layout.lane_m
    pose = _direct(layout, road, side, rng.uniform(-50, 50, 1), np.array([lateral]), 0.0, rng)[0]
    return pose, rng.uniform(0, 12)


def place_beside_road(layout: StreetLayout, rng: np.random.Generator) -> Floats:
    """Return a pole's pose at the edge of the first road, near the crossing, with a uniform heading."""
    edge = layout.lanes * layout.lane_m + rng.uniform(2.5, 7.5)
    where = rng.choice([-1.0, 1.0], 2) * np.array([rng.uniform(13, 18), edge])
    pose = place_on_road(layout, 0, where[:1], where[1:])[0]
    return np.array([pose[0], pose[1], rng.uniform(-math.pi, math.pi)])
