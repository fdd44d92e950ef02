# SPDX-License-Identifier: Apache-2.0
"""How well an object's points of now meet those of an earlier sweep, for each of the places where it may have been.

Correlative matching along one line (Olson, Real-Time Correlative Scan Matching, ICRA 2009): an object moves along its length, so
that one distance is sought, and all candidates are tried.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from manyeyes._jit import F32x2, F64x1, F64x2, I32x1, I64x1, njit
from manyeyes.datatypes import Boxes

MAX_DISTANCE_M = 0.4
"""A point whose nearest partner is farther has none."""
MIN_POINTS, MAX_POINTS = 5, 32
"""Minimum number of points of an object; of more than the maximum, so many are taken evenly."""
BOX_MARGIN_M = (0.3, 0.25, 0.4)
"""Metres that a box is taken longer and wider at each end and higher at the top, since it is an estimate."""
ROAD_CLEARANCE_M = 0.25
"""Points nearer to the bottom of a box are the road's."""
HEIGHT_SCALE = 0.5
"""Height counts so much: rings of a LiDAR meet a body at other heights as it drives away."""
_CELL_M = 2.0
_CELLS = 128
"""Number of cells on each axis of the index of points, which is centred at the origin; border cells hold all points beyond."""


def compute_alignment_costs(
    now: Tensor, then: Tensor, boxes: Boxes, back: Tensor, slack: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Return (N, steps), how badly points now and then meet, from 0 to 1, and (N,), the number of points that were asked.

    now: (P, 3), then: (Q, 3), float32 metres, in the frame of boxes (N). Candidate k has it that an object was ``back`` (N, 2) and
    d_k along its length behind where it is, d evenly from -slack to slack (N,). The cost is the mean over its points now of
    min(1, (distance / REACH_M)^2) to the nearest one then, moved by that much. 0, of no points, where either sweep has too few.
    """
    cost, count = np.zeros((len(boxes), steps)), np.zeros(len(boxes), np.int64)
    place = torch.cat((boxes.center, boxes.yaw.cos()[:, None], boxes.yaw.sin()[:, None], boxes.size / 2), 1)
    here, before = (cloud.to(torch.float32).contiguous().numpy() for cloud in (now, then))
    middles, moved, away = (rows.double().contiguous().numpy() for rows in (place, back, slack))
    _match(here, before, middles, moved, away, cost, count)
    return torch.from_numpy(cost).to(back.dtype), torch.from_numpy(count)


class _Box(NamedTuple):
    """A box in metres: its centre, cosine and sine of its yaw, and half its sizes."""

    x: float
    y: float
    z: float
    cos_yaw: float
    sin_yaw: float
    half_length: float
    half_width: float
    half_height: float


class _PointCells(NamedTuple):
    """Points (P, 3) by cells of the ground: rows start[c] to start[c + 1] of order are those of cell c, ascending."""

    points: F32x2
    start: I32x1
    order: I32x1


@njit(cache=True, nogil=True)
def _cell_at(metres: float) -> int:  # pragma: no cover
    """Return the row or column of a coordinate; NaN is in the first."""
    at = np.floor(metres / _CELL_M) + _CELLS // 2
    return int(min(at, _CELLS - 1.0)) if at > 0.0 else 0


@njit(cache=True, nogil=True)
def _index_points(points: F32x2) -> _PointCells:  # pragma: no cover
    """Sort points (P, 3) by cells (counting sort)."""
    cell, start = np.empty(len(points), np.int32), np.zeros(_CELLS * _CELLS + 1, np.int32)
    for p in range(len(points)):
        cell[p] = _cell_at(points[p, 1]) * _CELLS + _cell_at(points[p, 0])
        start[cell[p] + 1] += 1
    for c in range(_CELLS * _CELLS):
        start[c + 1] += start[c]
    order, filled = np.empty(len(points), np.int32), start[:-1].copy()
    for p in range(len(points)):
        order[filled[cell[p]]] = p
        filled[cell[p]] += 1
    return _PointCells(points, start, order)


@njit(cache=True, nogil=True)
def _inside(
    cells: _PointCells, place: _Box, away_x: float, away_y: float, longitudinal_margin: float
) -> F64x2:  # pragma: no cover
    """Return (K, 3): points in a box moved by away and made longer at each end, from its middle, in its axes, heights scaled.

    They are in the order of the cloud.
    """
    points, start, order = cells
    x0, y0 = place.x + away_x, place.y + away_y
    length, width, height = (
        place.half_length + longitudinal_margin,
        place.half_width + BOX_MARGIN_M[1],
        place.half_height,
    )
    reach_x = length * abs(place.cos_yaw) + width * abs(place.sin_yaw)
    reach_y = length * abs(place.sin_yaw) + width * abs(place.cos_yaw)
    first, last = _cell_at(x0 - reach_x), _cell_at(x0 + reach_x)
    rows = np.empty(len(points), np.int32)
    count = 0
    for row in range(_cell_at(y0 - reach_y), _cell_at(y0 + reach_y) + 1):
        for k in range(start[row * _CELLS + first], start[row * _CELLS + last + 1]):
            p = order[k]
            x, y, z = points[p, 0] - x0, points[p, 1] - y0, points[p, 2] - place.z
            u, v = x * place.cos_yaw + y * place.sin_yaw, y * place.cos_yaw - x * place.sin_yaw
            if abs(u) < length and abs(v) < width and ROAD_CLEARANCE_M - height < z < height + BOX_MARGIN_M[2]:
                rows[count] = p
                count += 1
    found, kept = np.empty((count, 3)), np.sort(rows[:count])
    for k in range(count):
        x, y, z = points[kept[k], 0] - x0, points[kept[k], 1] - y0, points[kept[k], 2] - place.z
        found[k, 0], found[k, 1] = x * place.cos_yaw + y * place.sin_yaw, y * place.cos_yaw - x * place.sin_yaw
        found[k, 2] = HEIGHT_SCALE * z
    return found


@njit(cache=True, nogil=True)
def _match(
    now: F32x2, then: F32x2, places: F64x2, back: F64x2, slack: F64x1, cost: F64x2, count: I64x1
) -> None:  # pragma: no cover
    """Fills cost (N, S) and count (N,); places (N, 8): the fields of a :class:`_Box`."""
    steps, limit = cost.shape[1], MAX_DISTANCE_M * MAX_DISTANCE_M
    x, best = np.empty(steps), np.empty(steps)
    cells_now, cells_then = _index_points(now), _index_points(then)
    for n in range(len(places)):
        p = places[n]
        box = _Box(p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7])
        mine = _inside(cells_now, box, 0.0, 0.0, BOX_MARGIN_M[0])
        theirs = _inside(cells_then, box, -back[n, 0], -back[n, 1], BOX_MARGIN_M[0] + slack[n])
        if len(mine) < MIN_POINTS or len(theirs) < MIN_POINTS:
            continue
        asked = min(len(mine), MAX_POINTS)
        count[n] = asked
        apart = 2.0 * slack[n] / (steps - 1)
        for a in range(asked):
            point = mine[a * len(mine) // asked]
            for s in range(steps):
                x[s], best[s] = point[0] - slack[n] * (2.0 * s / (steps - 1) - 1.0), limit
            for b in range(len(theirs)):
                dy, dz = theirs[b, 1] - point[1], theirs[b, 2] - point[2]
                dy, dz = dy * dy, dz * dz
                if dy + dz >= limit:
                    continue
                # The candidates at which it may be within reach: one more on each side, for rounding.
                gap, first, last = theirs[b, 0] - point[0] - slack[n], 0, steps - 1
                if apart > 0.0:
                    first = max(first, int((-MAX_DISTANCE_M - gap) / apart) - 1)
                    last = min(last, int((MAX_DISTANCE_M - gap) / apart) + 1)
                for s in range(first, last + 1):
                    dx = theirs[b, 0] - x[s]
                    best[s] = min(best[s], dx * dx + dy + dz)
            for s in range(steps):
                cost[n, s] += best[s] / limit / asked
