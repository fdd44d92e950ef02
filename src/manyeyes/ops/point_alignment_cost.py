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

from manyeyes._jit import F32x1, F32x2, F64x1, F64x2, I32x1, I64x1, njit
from manyeyes.datatypes import Boxes
from manyeyes.ops._sort_kernels import argsort

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
_LANES = 16
"""Candidates are tried in whole vectors of so many."""
_CELL_M = 2.0
_CELLS = 128
"""Number of cells on each axis of the index of points, which is centred at the origin; border cells hold all points beyond."""


class PointCells(NamedTuple):
    """Points (P, 3) by cells of the ground: rows start[c] to start[c + 1] of order are those of cell c, ascending."""

    points: F32x2
    start: I32x1
    order: I32x1


def compute_alignment_costs(
    now: Tensor | PointCells, then: Tensor, boxes: Boxes, back: Tensor, slack: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Return (N, steps), how badly points now and then meet, from 0 to 1, and (N,), the number of points that were asked.

    now: (P, 3), or its index (``index_points``), then: (Q, 3), float32 metres, in the frame of boxes (N). Candidate k has it that
    an object was ``back`` (N, 2) and d_k along its length behind where it is, d evenly from -slack to slack (N,). The cost is the
    mean over its points now of min(1, (distance / MAX_DISTANCE_M)^2) to the nearest one then, moved by that much. 0, of no
    points, where either sweep has too few.
    """
    cost, count = np.zeros((len(boxes), steps)), np.zeros(len(boxes), np.int64)
    place = torch.cat((boxes.center, boxes.yaw.cos()[:, None], boxes.yaw.sin()[:, None], boxes.size / 2), 1)
    here = now if isinstance(now, PointCells) else index_points(now)
    before = then.to(torch.float32).contiguous().numpy()
    middles, moved, away = (rows.double().contiguous().numpy() for rows in (place, back, slack))
    _match(here, before, middles, moved, away, cost, count)
    return torch.from_numpy(cost).to(back.dtype), torch.from_numpy(count)


def index_points(points: Tensor) -> PointCells:
    """Index points (P, 3) of a sweep that is compared with several."""
    return _index_points(points.to(torch.float32).contiguous().numpy())


class _Region(NamedTuple):
    """An oriented box that points are taken from, metres: its centre, cosine and sine of its yaw, half its length and width, and
    the heights above its centre.
    """

    x: float
    y: float
    z: float
    cos_yaw: float
    sin_yaw: float
    half_length: float
    half_width: float
    bottom: float
    top: float


class _Found(NamedTuple):
    """Points in a region: rows of the cloud, and from the centre in the region's axes, heights scaled, (3, P); P: room for all."""

    rows: I32x1
    xyz: F32x2


@njit(cache=True, nogil=True)
def _cell_at(metres: float) -> int:  # pragma: no cover
    """Return the row or column of a coordinate; NaN is in the first."""
    at = np.floor(metres / _CELL_M) + _CELLS // 2
    return int(min(at, _CELLS - 1.0)) if at > 0.0 else 0


@njit(cache=True, nogil=True)
def _index_points(points: F32x2) -> PointCells:  # pragma: no cover
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
    return PointCells(points, start, order)


@njit(cache=True, nogil=True)
def _find_inside(cells: PointCells, region: _Region, out: _Found) -> int:  # pragma: no cover
    """Write the points in a region to out, by cells; how many."""
    points, start, order = cells
    x0, y0, z0, c, s, length, width, bottom, top = region
    reach_x, reach_y = length * abs(c) + width * abs(s), length * abs(s) + width * abs(c)
    first, last, count = _cell_at(x0 - reach_x), _cell_at(x0 + reach_x), 0
    for row in range(_cell_at(y0 - reach_y), _cell_at(y0 + reach_y) + 1):
        for k in range(start[row * _CELLS + first], start[row * _CELLS + last + 1]):
            p = order[k]
            x, y, z = points[p, 0] - x0, points[p, 1] - y0, points[p, 2] - z0
            u, v = x * c + y * s, y * c - x * s
            if abs(u) < length and abs(v) < width and bottom < z < top:
                out.rows[count] = p
                out.xyz[0, count], out.xyz[1, count], out.xyz[2, count] = u, v, HEIGHT_SCALE * z
                count += 1
    return count


@njit(cache=True, nogil=True)
def _match(
    cells_now: PointCells, then: F32x2, places: F64x2, back: F64x2, slack: F64x1, cost: F64x2, count: I64x1
) -> None:  # pragma: no cover
    """Fills cost (N, S) and count (N,); places (N, 8): centre, cosine and sine of the yaw, half sizes."""
    steps, limit = cost.shape[1], np.float32(MAX_DISTANCE_M * MAX_DISTANCE_M)
    # Whole vectors of candidates; those beyond the last are not read.
    offset = np.empty((steps + _LANES - 1) // _LANES * _LANES, np.float32)
    best = np.empty_like(offset)
    cells_then, num_now = _index_points(then), len(cells_now.points)
    mine = _Found(np.empty(num_now, np.int32), np.empty((3, num_now), np.float32))
    theirs = _Found(np.empty(len(then), np.int32), np.empty((3, len(then)), np.float32))
    for n in range(len(places)):
        x, y, z, c, s, length, width, height = places[n]
        length, width = length + BOX_MARGIN_M[0], width + BOX_MARGIN_M[1]
        bottom, top = ROAD_CLEARANCE_M - height, height + BOX_MARGIN_M[2]
        found = _find_inside(cells_now, _Region(x, y, z, c, s, length, width, bottom, top), mine)
        if found < MIN_POINTS:
            continue
        moved = _Region(x - back[n, 0], y - back[n, 1], z, c, s, length + slack[n], width, bottom, top)
        partners = _find_inside(cells_then, moved, theirs)
        if partners < MIN_POINTS:
            continue
        count[n] = min(found, MAX_POINTS)
        by_row = argsort(mine.rows[:found])
        for k in range(len(offset)):
            offset[k] = slack[n] * (2.0 * k / (steps - 1) - 1.0)
        for a in range(count[n]):
            k = by_row[a * found // count[n]]
            best[:] = limit
            _find_nearest(theirs.xyz, partners, mine.xyz[0, k], mine.xyz[1, k], mine.xyz[2, k], offset, best)
            for k in range(steps):
                cost[n, k] += best[k] / limit / count[n]


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz", "contract"})
def _find_nearest(
    xyz: F32x2, count: int, x: np.float32, y: np.float32, z: np.float32, offset: F32x1, best: F32x1
) -> None:  # pragma: no cover
    """Lower best (S,) to the squared distance of the nearest of the first points (3, P) to one that is moved by -offset (S,)."""
    limit = np.float32(MAX_DISTANCE_M * MAX_DISTANCE_M)
    for b in range(count):
        dy, dz = xyz[1, b] - y, xyz[2, b] - z
        aside = dy * dy + dz * dz
        if aside < limit:
            ahead = xyz[0, b] - x
            for k in range(offset.shape[0]):
                dx = ahead + offset[k]
                best[k] = min(best[k], dx * dx + aside)
