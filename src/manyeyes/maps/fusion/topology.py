# SPDX-License-Identifier: Apache-2.0
"""How the lines of a map lie to each other: what continues what, what lies left and right, and where lines branch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import CROSSING, MapElements
from manyeyes.maps.elements.vector_map import Topology
from manyeyes.maps.fusion.point_grid import build_grid, cell_key
from manyeyes.maps.roads.lane_links import connected_components

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CHUNK = 20000


@dataclass(frozen=True)
class TopologyConfig:
    """max_gap_m, max_turn_rad: largest gap and turn from the end of a line to the line that continues it. branch_radius_m:
    how close ends of three lines or more make a branch. neighbour_radius_m, max_neighbour_turn_rad: how far to a side and how
    turned a neighbour may lie.
    """

    max_gap_m: float = 12.0
    max_turn_rad: float = 0.35
    branch_radius_m: float = 2.0
    neighbour_radius_m: float = 6.0
    max_neighbour_turn_rad: float = 0.35


def build_topology(elements: MapElements, config: TopologyConfig = TopologyConfig()) -> Topology:
    """Relations among the lines of a map; crossings have none.

    successor: from the last point of one line to the nearest line of its kind that starts or ends ahead. left, right:
    the line nearest to a side, by the median of what lies beside its quarter points, seen along its own direction.
    """
    lines = np.flatnonzero((elements.kind != CROSSING) & (elements.counts >= 2))
    if not len(lines):
        return Topology.empty()
    first, last = elements.offsets[lines], elements.offsets[lines + 1] - 1
    xy = np.concatenate((elements.points[last], elements.points[first]))
    outward = np.concatenate((_chord(elements, last, first, -1), _chord(elements, first, last, 1)))
    owner = np.concatenate((lines, lines))
    left, right = (_find_neighbours(elements, lines, side, config) for side in (1.0, -1.0))
    branch, places = _find_branches(xy, owner, config.branch_radius_m)
    return Topology(_find_successors(elements, xy, outward, owner, config), left, right, branch, places)


def _chord(elements: MapElements, end: Ints, other: Ints, step: int) -> Floats:
    """Unit direction (L, 2) out of lines at their points ``end``, over up to five points."""
    inner = np.where(step < 0, np.maximum(end - 5, other), np.minimum(end + 5, other))
    out = elements.points[end] - elements.points[inner]
    return out / np.maximum(np.hypot(out[:, 0], out[:, 1]), 1e-12)[:, None]


def _find_successors(elements: MapElements, xy: Floats, outward: Floats, owner: Ints, config: TopologyConfig) -> Ints:
    count = len(owner) // 2
    a, b = _find_pairs(xy[:count], xy, config.max_gap_m)
    step = xy[b] - xy[a]
    gap = np.hypot(step[:, 0], step[:, 1])
    ahead = np.einsum("ij,ij->i", step, outward[a])
    straight = -np.einsum("ij,ij->i", outward[a], outward[b])
    fits = (owner[a] != owner[b]) & (elements.kind[owner[a]] == elements.kind[owner[b]])
    fits &= (straight > np.cos(config.max_turn_rad)) & (ahead >= 0.9 * gap - 0.5)
    a, b, gap = a[fits], b[fits], gap[fits]
    order = np.lexsort((owner[b], gap, a))
    best = order[np.concatenate(([True], np.diff(a[order]) > 0))] if len(order) else order
    return np.stack((owner[a[best]], owner[b[best]]), 1)


def _find_neighbours(elements: MapElements, lines: Ints, side: float, config: TopologyConfig) -> Ints:
    """Return (K, 2) each line and its nearest neighbour on a side (1: left, -1: right)."""
    kinds = np.flatnonzero(elements.kind[elements.element_of_point] != CROSSING)
    points, owner = elements.points[kinds], elements.element_of_point[kinds]
    counts = elements.counts[lines]
    at = np.concatenate(
        [
            elements.offsets[lines] + (counts * share).astype(np.int64).clip(max=counts - 1)
            for share in (0.25, 0.5, 0.75)
        ]
    )
    ahead = _direction(elements, at)
    whole = _direction(elements, kinds)
    found: list[Ints] = []
    for begin in range(0, len(at), _CHUNK):
        chosen = at[begin : begin + _CHUNK]
        a, b = _find_pairs(elements.points[chosen], points, config.neighbour_radius_m)
        step = points[b] - elements.points[chosen[a]]
        u = ahead[begin + a]
        along = np.abs(np.einsum("ij,ij->i", step, u))
        aside = side * (u[:, 0] * step[:, 1] - u[:, 1] * step[:, 0])
        turn = np.abs(np.einsum("ij,ij->i", u, whole[b]))
        fits = (
            (owner[b] != elements.element_of_point[chosen[a]])
            & (along <= 1.0)
            & (aside > 0.3)
            & (turn > np.cos(config.max_neighbour_turn_rad))
        )
        a, b, aside = a[fits], b[fits], aside[fits]
        order = np.lexsort((owner[b], aside, a))
        best = order[np.concatenate(([True], np.diff(a[order]) > 0))] if len(order) else order
        found.append(np.stack((elements.element_of_point[chosen[a[best]]], owner[b[best]]), 1))
    pairs = np.concatenate(found) if found else np.zeros((0, 2), np.int64)
    unique, votes = np.unique(pairs, axis=0, return_counts=True)
    order = np.lexsort((unique[:, 1], -votes, unique[:, 0]))
    keep = order[np.concatenate(([True], np.diff(unique[order, 0]) > 0))] if len(order) else order
    return unique[keep].reshape(-1, 2)


def _direction(elements: MapElements, at: Ints) -> Floats:
    """Unit tangents (Q, 2) at points ``at``."""
    owner = elements.element_of_point[at]
    step = elements.points[np.minimum(at + 1, elements.offsets[owner + 1] - 1)]
    step = step - elements.points[np.maximum(at - 1, elements.offsets[owner])]
    return step / np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-12)[:, None]


def _find_branches(xy: Floats, owner: Ints, radius: float) -> tuple[Ints, Floats]:
    """Nodes where three ends or more meet: (B, 2) node and element, (M, 2) place."""
    a, b = _find_pairs(xy, xy, radius)
    label = connected_components(len(xy), np.stack((a, b), 1))
    _, node, counts = np.unique(label, return_inverse=True, return_counts=True)
    chosen = counts[node] >= 3
    _, number = np.unique(node[chosen], return_inverse=True)
    size = np.bincount(number)
    places = np.stack([np.bincount(number, xy[chosen, k]) / np.maximum(1, size) for k in (0, 1)], 1)
    pairs = np.unique(np.stack((number, owner[chosen]), 1).astype(np.int64), axis=0)
    return pairs.reshape(-1, 2), places.reshape(-1, 2)


def _find_pairs(queries: Floats, points: Floats, radius: float) -> tuple[Ints, Ints]:
    """Return all pairs (query, point) at most radius apart, by query; a grid of that size, three cells a row."""
    grid = build_grid(points[:, 0], points[:, 1], np.zeros(len(points), np.int64), radius)
    key = cell_key(np.zeros(len(queries), np.int64), queries[:, 0], queries[:, 1], radius)
    pairs: list[tuple[Ints, Ints]] = []
    for column in (-1, 0, 1):
        middle = key + (column << 30)
        low = grid.offsets[np.searchsorted(grid.keys, middle - 1)]
        high = grid.offsets[np.searchsorted(grid.keys, middle + 1, side="right")]
        count = high - low
        a = np.repeat(np.arange(len(queries)), count)
        place = np.arange(int(count.sum())) + np.repeat(low - np.concatenate(([0], np.cumsum(count)[:-1])), count)
        b = grid.order[place]
        close = np.hypot(*(points[b] - queries[a]).T) <= radius
        pairs.append((a[close], b[close]))
    a, b = np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])
    order = np.lexsort((b, a))
    return a[order], b[order]
