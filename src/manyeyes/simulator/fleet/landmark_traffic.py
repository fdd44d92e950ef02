# SPDX-License-Identifier: Apache-2.0
"""Traffic at a crossing, and where agents stand: the world of the landmark scenes (landmarks.py).

Two six-lane roads cross. Vehicles drive in lanes and stand parked in rows of bays, so that chance agreement is as frequent as in
traffic.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_LANES_M = (1.75, 5.25, 8.75)
_PARKED_M = 11.6
_HALF_ROAD_M = 140.0
_MIN_DISTANCE_M = 4.0


@dataclass(frozen=True)
class Traffic:
    """pose: (N, 3) at time 0 in the world; speed: (N,) m/s; size: (N, 2)."""

    pose: Floats
    speed: Floats
    size: Floats

    def at(self, time_s: float) -> Floats:
        """Return poses (N, 3) at a time."""
        step = time_s * self.speed
        turn = self.pose[:, 2]
        return self.pose + np.stack((step * np.cos(turn), step * np.sin(turn), 0 * step), 1)


def relative_pose(a: Floats, b: Floats) -> Floats:
    """a_from_b of two poses (3,) in one frame."""
    return to_frame(b[None], a)[0]


def to_frame(poses: Floats, frame: Floats) -> Floats:
    """Return poses (N, 3) as seen from a frame (3,)."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    dx, dy = poses[:, 0] - frame[0], poses[:, 1] - frame[1]
    yaw = np.remainder(poses[:, 2] - frame[2] + np.pi, 2 * np.pi) - np.pi
    return np.stack((c * dx + s * dy, c * dy - s * dx, yaw), 1)


def make_traffic(rng: np.random.Generator) -> Traffic:
    """Everything that stands or drives near one crossing; nothing overlaps at time 0."""
    rows = []
    for road in range(2):
        for side in (0, 1):
            for lane in _LANES_M:
                pace = rng.uniform(4.0, 13.0)
                longitudinal = -_HALF_ROAD_M + rng.uniform(0, 15)
                while longitudinal < _HALF_ROAD_M:
                    lateral, turn = -lane + 0.3 * rng.standard_normal(), math.radians(1.5) * rng.standard_normal()
                    rows.append((road, side, longitudinal, lateral, turn, pace))
                    longitudinal += 7.0 + rng.exponential(11.0)
            for leg in (-1, 1):
                if rng.random() < 0.4:
                    continue
                for place in np.arange(18.0, 85.0, 6.5):
                    if rng.random() < 0.7:
                        turn = math.radians(2.0) * rng.standard_normal() + math.pi * (rng.random() < 0.1)
                        row = leg * (place + 0.5 * rng.standard_normal())
                        rows.append((road, side, row, -_PARKED_M + 0.15 * rng.standard_normal(), turn, 0.0))
    road, side, longitudinal, lateral, turn, speed = np.array(rows).T
    direction = road * np.pi / 2 + side * np.pi
    c, s = np.cos(direction), np.sin(direction)
    pose = np.stack((c * longitudinal - s * lateral, s * longitudinal + c * lateral, direction + turn), 1)
    large = rng.random(len(pose)) < 0.1
    length = np.where(large, rng.uniform(5.5, 11.0, len(pose)), 4.5 + 0.3 * rng.standard_normal(len(pose)))
    width = np.where(large, rng.uniform(2.1, 2.6, len(pose)), 1.85 + 0.08 * rng.standard_normal(len(pose)))
    near = np.hypot(*(pose[:, None, :2] - pose[None, :, :2]).transpose(2, 0, 1)) < _MIN_DISTANCE_M
    keep = ~np.tril(near, -1).any(1)
    return Traffic(pose[keep], speed[keep], np.stack((length, width), 1)[keep])


def place_vehicle(rng: np.random.Generator) -> tuple[Floats, float]:
    """Return a vehicle's pose and speed, in a lane within 50 m of the crossing."""
    direction = rng.integers(4) * np.pi / 2
    longitudinal, lateral = rng.uniform(-50, 50), -_LANES_M[rng.integers(3)]
    c, s = np.cos(direction), np.sin(direction)
    return np.array([c * longitudinal - s * lateral, s * longitudinal + c * lateral, direction]), rng.uniform(0, 12)


def place_roadside_unit(rng: np.random.Generator) -> Floats:
    """Return a pole's pose at a corner of the crossing, with a uniform heading."""
    corner = np.array([rng.choice([-1.0, 1.0]), rng.choice([-1.0, 1.0])]) * rng.uniform(13, 18, 2)
    return np.array([*corner, rng.uniform(-np.pi, np.pi)])


def make_later_traffic(
    earlier: Traffic,
    rng: np.random.Generator,
    parked_fraction: float,
    make: Callable[[np.random.Generator], Traffic] = make_traffic,
) -> Traffic:
    """Return the traffic at the same crossing minutes later: other vehicles in the same lanes and bays.

    parked_fraction: of the parked vehicles that are still there. make: draws traffic in these streets.
    """
    stays = (earlier.speed == 0) & (rng.random(len(earlier.pose)) < parked_fraction)
    new = make(rng)
    apart = np.hypot(*(new.pose[:, None, :2] - earlier.pose[None, stays, :2]).transpose(2, 0, 1))
    is_free = (apart > _MIN_DISTANCE_M).all(1)
    parts = ((earlier, stays), (new, is_free))
    return Traffic(
        *(np.concatenate([getattr(t, name)[rows] for t, rows in parts]) for name in ("pose", "speed", "size"))
    )


def place_vehicle_near(vehicle: Floats, where: str, rng: np.random.Generator) -> Floats:
    """Return the pose of a second vehicle: beside the first (2 to 3.5 m), ahead of it (6.3 m), or near it (10 to 40 m)."""
    turn = 0.0
    if where == "beside":
        step = np.array([rng.uniform(-1.0, 1.0), rng.choice([-1.0, 1.0]) * rng.uniform(2.0, 3.5)])
    elif where == "ahead":
        step = np.array([6.3, 0.2 * rng.standard_normal()])
    else:
        angle, radius = rng.uniform(-np.pi, np.pi), rng.uniform(10.0, 40.0)
        step, turn = radius * np.array([np.cos(angle), np.sin(angle)]), rng.integers(4) * np.pi / 2
    c, s = np.cos(vehicle[2]), np.sin(vehicle[2])
    turn += math.radians(1.5) * rng.standard_normal()
    return np.array([vehicle[0] + c * step[0] - s * step[1], vehicle[1] + s * step[0] + c * step[1], vehicle[2] + turn])
