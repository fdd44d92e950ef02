# SPDX-License-Identifier: Apache-2.0
"""Drivable lanes in arrays, and paths along them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from manyeyes.maps.roads.road_network import RoadNetwork

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Routes:
    """L lanes: centre lines ``points[offsets[i]:offsets[i + 1]]`` (metres, in driving direction) and the successors of each.

    Lane i is followed by ``successor[successor_offsets[i]:successor_offsets[i + 1]]``.
    """

    points: Array
    offsets: Indices
    successor: Indices
    successor_offsets: Indices

    @classmethod
    def of(cls, lanes: Sequence[Array], successors: Sequence[tuple[int, int]]) -> Routes:
        """Centre lines (M, 2) and pairs (lane, a lane that follows it)."""
        pairs = np.array(sorted(set(successors)), np.int64).reshape(-1, 2)
        offsets = np.concatenate(([0], np.cumsum([len(lane) for lane in lanes]))).astype(np.int64)
        count = np.bincount(pairs[:, 0], minlength=len(lanes))
        successor_offsets = np.concatenate(([0], np.cumsum(count))).astype(np.int64)
        points = np.concatenate(lanes) if lanes else np.zeros((0, 2))
        return cls(points, offsets, pairs[:, 1].copy(), successor_offsets)

    @classmethod
    def of_network(cls, network: RoadNetwork, origin: Array) -> Routes:
        """Return the drivable lanes of a road network, moved so that origin (2,) is zero."""
        own = [lane for lane in network.lanes if lane.is_drivable and lane.length_m > 0.5]
        place = {lane.id: k for k, lane in enumerate(own)}
        pairs = [(place[lane.id], place[k]) for lane in own for k in lane.successors if k in place]
        return cls.of([lane.center[:, :2] - origin for lane in own], pairs)

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def lane(self, i: int) -> Array:
        """Return (M, 2) centre line."""
        return self.points[self.offsets[i] : self.offsets[i + 1]]

    @cached_property
    def lengths(self) -> Array:
        """(L,) lengths of the lanes, metres."""
        return np.array([np.linalg.norm(np.diff(self.lane(i), axis=0), axis=1).sum() for i in range(len(self))])

    def within(self, low: Array, high: Array) -> Routes:
        """Return the lanes that have a point inside a rectangle, with the links among them."""
        inside = np.asarray(np.logical_and(self.points >= low, self.points <= high).all(axis=1))
        kept = [i for i in range(len(self)) if inside[self.offsets[i] : self.offsets[i + 1]].any()]
        place = {old: new for new, old in enumerate(kept)}
        pairs = [
            (place[i], place[int(k)])
            for i in kept
            for k in self.successor[self.successor_offsets[i] : self.successor_offsets[i + 1]]
            if int(k) in place
        ]
        return Routes.of([self.lane(i) for i in kept], pairs)

    def walk(self, lane: int, start_m: float, length_m: float, choose: Callable[[int, int], int]) -> Array:
        """Return a path (M, 2) of at most length_m from start_m along a lane; choose(step, count) picks among count followers."""
        parts, left, step = [], length_m, 0
        line = _from(self.lane(lane), start_m)
        while True:
            size = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
            parts.append(line if not parts else line[1:])
            left -= size
            after = self.successor[self.successor_offsets[lane] : self.successor_offsets[lane + 1]]
            if left <= 0 or not len(after) or step > 1000:
                return np.concatenate(parts)
            lane = int(after[choose(step, len(after))])
            line, step = self.lane(lane), step + 1


def sample_poses(path: Array, station_m: Array) -> Array:
    """Return poses (K, 3) as x, y, yaw at distances (K,) from the start of a path (M, 2)."""
    length = np.linalg.norm(np.diff(path, axis=0), axis=1)
    station = np.concatenate(([0.0], np.cumsum(length)))
    x, y = (np.interp(station_m, station, path[:, axis]) for axis in (0, 1))
    # Over two metres, so that corners between lanes turn the vehicle gradually.
    ahead = [np.interp(station_m + 1.0, station, path[:, axis]) for axis in (0, 1)]
    behind = [np.interp(station_m - 1.0, station, path[:, axis]) for axis in (0, 1)]
    return np.stack((x, y, np.arctan2(ahead[1] - behind[1], ahead[0] - behind[0])), 1)


def _from(line: Array, start_m: float) -> Array:
    """Return the part of a line after a distance from its start."""
    station = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))))
    start_m = min(max(start_m, 0.0), station[-1] - 0.1)
    at = np.array([[np.interp(start_m, station, line[:, axis]) for axis in (0, 1)]])
    return np.concatenate((at, line[station > start_m + 1e-6]))
