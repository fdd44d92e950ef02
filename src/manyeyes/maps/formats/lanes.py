# SPDX-License-Identifier: Apache-2.0
"""Lanes between the lines of a map, for formats that are made of lanes: pairs of neighbours at a lane's distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import BOUNDARY, DIVIDER
from manyeyes.maps.elements.vector_map import VectorMap

Floats = NDArray[np.float64]

MIN_WIDTH_M, MAX_WIDTH_M = 2.5, 4.5
_SPACING_M = 2.0
# Of the shorter line, so much must lie beside the other.
_MIN_OVERLAP = 0.8


@dataclass(frozen=True, eq=False)
class LanePair:
    """Two rows of a map that bound one lane: ``left`` as it runs, ``right`` backwards if ``right_is_reversed``."""

    left: int
    right: int
    right_is_reversed: bool


def find_lane_pairs(vector_map: VectorMap) -> list[LanePair]:
    """Dividers and boundaries whose right neighbour runs 2.5 to 4.5 m beside at least 80 % of the shorter one's length.

    Neighbours are those of the map's topology, in either order: a line that goes on where several end bounds several lanes on
    a hand. Ascending by rows.
    """
    e = vector_map.elements
    lines = np.isin(e.kind, (DIVIDER, BOUNDARY))
    taken: set[frozenset[int]] = set()
    out: list[LanePair] = []
    candidates = {(left, right) for left, right in vector_map.topology.right.tolist()}
    candidates |= {(left, right) for right, left in vector_map.topology.left.tolist()}
    for left, right in sorted(candidates):
        both = frozenset((left, right))
        if both in taken or not (lines[left] and lines[right]):
            continue
        a, b = e.polyline(left), e.polyline(right)
        turned = float((a[-1] - a[0]) @ (b[-1] - b[0])) < 0
        if _is_lane(a, b[::-1] if turned else b):
            taken.add(both)
            out.append(LanePair(left, right, turned))
    return out


def _is_lane(a: Floats, b: Floats) -> bool:
    """Return whether b lies to the right of a, at a lane's distance nearly everywhere, along most of the shorter one."""
    shorter, other, side = (a, b, 1.0) if _length(a) <= _length(b) else (b, a, -1.0)
    offset = side * _offsets_to_left(_resample(shorter), other)
    beside = np.isfinite(offset)
    inside = (offset[beside] >= MIN_WIDTH_M) & (offset[beside] <= MAX_WIDTH_M)
    return bool(beside.mean() >= _MIN_OVERLAP and inside.mean() >= 0.9)


def _length(line: Floats) -> float:
    return float(np.hypot(*np.diff(line, axis=0).T).sum())


def _resample(line: Floats) -> Floats:
    """Return points on a line about 2 m apart, its ends among them."""
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    at = np.linspace(0.0, along[-1], max(int(along[-1] / _SPACING_M), 1) + 1)
    return np.stack([np.interp(at, along, line[:, k]) for k in (0, 1)], 1)


def _offsets_to_left(points: Floats, line: Floats) -> Floats:
    """Return (N,) distance of each point from the line, positive on its left; NaN beyond its ends."""
    start, step = line[:-1], np.diff(line, axis=0)
    square = np.maximum((step**2).sum(1), 1e-18)
    away = points[:, None] - start
    free = (away * step).sum(2) / square
    held = np.clip(free, 0.0, 1.0)
    gap = away - held[..., None] * step
    nearest = np.hypot(gap[..., 0], gap[..., 1]).argmin(1)
    row = np.arange(len(points))
    g, s, t = gap[row, nearest], step[nearest], free[row, nearest]
    left_of_line = s[:, 0] * g[:, 1] - s[:, 1] * g[:, 0]
    offset = np.sign(left_of_line) * np.hypot(g[:, 0], g[:, 1])
    slack = 0.5 / np.sqrt(square[nearest])
    beyond = ((nearest == 0) & (t < -slack)) | ((nearest == len(step) - 1) & (t > 1 + slack))
    return np.where(beyond, np.nan, offset)
