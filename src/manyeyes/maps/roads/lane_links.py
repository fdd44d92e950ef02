# SPDX-License-Identifier: Apache-2.0
"""What readers of lane maps share: equal stations on two borders, components of a graph, junctions out of lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.maps.roads.road_network import Junction, Lane

Array = NDArray[np.float64]

_STEP_M = 1.0


def resample_borders(left: Array, right: Array, step_m: float = _STEP_M) -> tuple[Array, Array]:
    """Return two borders (A, 3) and (B, 3) as (M, 3) each, row i of both at the same share of their lengths."""
    longest = max(_lengths(left)[-1], _lengths(right)[-1])
    share = np.linspace(0.0, 1.0, max(2, int(np.ceil(longest / step_m)) + 1))
    return _interpolate_at(left, share), _interpolate_at(right, share)


def _lengths(line: Array) -> Array:
    return np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1))))


def _interpolate_at(line: Array, fractions: Array) -> Array:
    along = _lengths(line)
    return np.stack([np.interp(fractions * along[-1], along, line[:, axis]) for axis in range(3)], 1)


def connected_components(count: int, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return (count,) the smallest member of each node's component; pairs: (E, 2) edges."""
    label = np.arange(count)

    def root(node: int) -> int:
        while label[node] != node:
            label[node] = label[label[node]]
            node = label[node]
        return node

    for one, two in pairs.tolist():
        a, b = root(one), root(two)
        label[max(a, b)] = min(a, b)
    return np.array([root(k) for k in range(count)], np.int64)


def complete_lane_links(lanes: Sequence[Lane]) -> tuple[Lane, ...]:
    """Return the lanes with predecessors completed by others' successors, and the reverse: files name some links on one side
    only.
    """
    before = [set(lane.predecessors) for lane in lanes]
    after = [set(lane.successors) for lane in lanes]
    for lane in lanes:
        for k in lane.successors:
            before[k].add(lane.id)
        for k in lane.predecessors:
            after[k].add(lane.id)
    return tuple(
        replace(lane, predecessors=tuple(sorted(before[lane.id])), successors=tuple(sorted(after[lane.id])))
        for lane in lanes
    )


def build_junctions(lanes: Sequence[Lane]) -> tuple[Junction, ...]:
    """Return junctions from the lanes' junction ids, with the extent of their drivable lanes."""
    members: dict[str, list[Lane]] = {}
    for lane in lanes:
        if lane.junction_id is not None and lane.is_drivable:
            members.setdefault(lane.junction_id, []).append(lane)
    found = []
    for name in sorted(members):
        inside = members[name]
        points = np.concatenate([np.concatenate((lane.left, lane.right)) for lane in inside])
        center = (points.min(0) + points.max(0)) / 2
        radius = float(np.linalg.norm(points[:, :2] - center[:2], axis=1).max())
        own = {lane.id for lane in inside}
        incoming = sorted({p for lane in inside for p in lane.predecessors if p not in own and lanes[p].is_drivable})
        found.append(Junction(name, center, radius, tuple(sorted(own)), tuple(incoming)))
    return tuple(found)
