# SPDX-License-Identifier: Apache-2.0
"""Ridges by subspace-constrained mean shift: points of many noisy lines move laterally to the mode and are thinned.

Mean shift is confined to the normal (Ozertem and Erdogmus, "Locally defined principal curves and surfaces", JMLR 2011). Offsets
are measured along the mean normal of the two lines, so that a bend of constant radius does not shrink. Lines closer than the
bandwidth become one ridge; lines a lane apart stay separate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x1, F64x2, I64x1, njit, set_row
from manyeyes.maps.fusion.point_grid import PointGrid, build_grid, find_cell_range

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_SHIFT_CELL_M = 2.0
# No shorter than what a point reaches along its line.
_THIN_CELL_M = 2.0
# Points are gathered again where mean shift has moved a point so far.
_SLACK_M = 0.5


@dataclass(frozen=True)
class RidgeConfig:
    """Configuration of mean shift and thinning.

    longitudinal_extent_m, lateral_extent_m: half extents of the kernel.
    longitudinal_sigma_m, lateral_sigma_m: its Gaussian scales. max_heading_rad: heading gate.
    seed_spacing_m, seed_separation_m: longitudinal and lateral distance below which only one of two points is moved.
    num_iterations: of mean shift. spacing_m: distance of the points that remain.
    min_separation_m: lateral distance below which points belong to one ridge.
    """

    longitudinal_extent_m: float = 2.5
    lateral_extent_m: float = 0.9
    longitudinal_sigma_m: float = 1.2
    lateral_sigma_m: float = 0.45
    max_heading_rad: float = 0.35
    seed_spacing_m: float = 0.35
    seed_separation_m: float = 0.25
    num_iterations: int = 4
    spacing_m: float = 0.7
    min_separation_m: float = 0.5


def mean_shift_to_ridges(
    seeds: Ints, xy: Floats, tangent: Floats, kind: Ints, weight: Floats, config: RidgeConfig = RidgeConfig()
) -> tuple[Floats, Floats, Floats]:
    """Move points ``seeds`` (S,) of all points (P,) to their ridges.

    Returns positions (S, 2), unit tangents (S, 2) and density (S,).
    """
    grid = build_grid(xy[:, 0], xy[:, 1], kind, _SHIFT_CELL_M)
    order = grid.order
    cosine = float(np.cos(config.max_heading_rad))
    return _shift(
        xy.take(seeds, 0),
        tangent.take(seeds, 0),
        kind[seeds],
        _WeightedPoints(grid.keys, grid.offsets, xy.take(order, 0), tangent.take(order, 0), weight[order]),
        _Kernel(
            config.longitudinal_extent_m,
            config.lateral_extent_m,
            config.longitudinal_sigma_m,
            config.lateral_sigma_m,
            cosine,
        ),
        config.num_iterations,
    )


class _WeightedPoints(NamedTuple):
    """Points in the order of their grid of _SHIFT_CELL_M: its keys and starts, places, unit tangents and weights."""

    keys: I64x1
    start: I64x1
    xy: F64x2
    tangent: F64x2
    weight: F64x1


class _Kernel(NamedTuple):
    """The kernel of the mean shift: half extents and Gaussian scales (m), least cosine between two tangents."""

    half_length_m: float
    half_width_m: float
    longitudinal_sigma_m: float
    lateral_sigma_m: float
    min_cosine: float


@njit(cache=True, nogil=True)
def _shift(
    xy: F64x2, tangent: F64x2, kind: I64x1, points: _WeightedPoints, params: _Kernel, rounds: int
) -> tuple[F64x2, F64x2, F64x1]:  # pragma: no cover - compiled
    """Run mean shift along normals: positions (S, 2), unit tangents (S, 2) and density (S,) of the points."""
    place, turned, density = xy.copy(), tangent.copy(), np.zeros(len(xy))
    radius = np.hypot(params.half_length_m, params.half_width_m) + _SLACK_M
    near = np.empty((7, 256))
    for p in range(len(xy)):
        x, y, u, v = xy[p, 0], xy[p, 1], tangent[p, 0], tangent[p, 1]
        near, count = _gather_near(x, y, int(kind[p]), radius, points, near)
        from_x, from_y = x, y
        for _ in range(rounds):
            if np.hypot(x - from_x, y - from_y) > _SLACK_M:
                near, count = _gather_near(x, y, int(kind[p]), radius, points, near)
                from_x, from_y = x, y
            _weigh_near(count, x, y, u, v, params, near)
            total, pull, cc, ss = _sum_near(count, near)
            if total <= 0.0:
                break
            density[p] = total
            x, y = x - v * pull / total, y + u * pull / total
            angle = 0.5 * np.arctan2(ss, cc)
            u, v = np.cos(angle), np.sin(angle)
        place[p, 0], place[p, 1], turned[p, 0], turned[p, 1] = x, y, u, v
    return place, turned, density


@njit(cache=True, nogil=True, error_model="numpy")
def _gather_near(
    x: float, y: float, kind: int, radius: float, points: _WeightedPoints, near: F64x2
) -> tuple[F64x2, int]:  # pragma: no cover - compiled
    """Gather the points of a kind within a radius: x, y, tangent and weight in the first columns of near (7, N), and N."""
    low_y, high_y = int(np.floor((y - radius) / _SHIFT_CELL_M)), int(np.floor((y + radius) / _SHIFT_CELL_M))
    n = 0
    for ix in range(int(np.floor((x - radius) / _SHIFT_CELL_M)), int(np.floor((x + radius) / _SHIFT_CELL_M)) + 1):
        low, high = find_cell_range(points.keys, points.start, kind, ix, low_y, high_y)
        if n + high - low > near.shape[1]:
            bigger = np.empty((7, 2 * (n + high - low)))
            for column in range(5):
                set_row(bigger[column, :n], near[column, :n])
            near = bigger
        for q in range(low, high):
            ex, ey = points.xy[q, 0] - x, points.xy[q, 1] - y
            near[0, n], near[1, n] = points.xy[q, 0], points.xy[q, 1]
            near[2, n], near[3, n], near[4, n] = points.tangent[q, 0], points.tangent[q, 1], points.weight[q]
            # A point that is too far is overwritten by the next one, which is faster than a branch.
            n += 1 if ex * ex + ey * ey <= radius * radius else 0
    return near, n


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh_near(
    n: int, x: float, y: float, u: float, v: float, params: _Kernel, near: F64x2
) -> None:  # pragma: no cover - compiled
    """Set lateral offset and kernel weight, the last two columns of near, of its n points around a place with tangent (u, v).

    Residuals are those of :func:`~manyeyes.maps.fusion.point_grid.line_residual`, without branches, so that the loop is vectorised.
    """
    other_x, other_y, tangent_x, tangent_y, weight = near[0], near[1], near[2], near[3], near[4]
    offsets, weights = near[5], near[6]
    reach, across, cosine = params.half_length_m, params.half_width_m, params.min_cosine
    along_scale, aside_scale = 0.0625 / params.longitudinal_sigma_m**2, 0.0625 / params.lateral_sigma_m**2
    for k in range(n):
        dx, dy = other_x[k] - x, other_y[k] - y
        dot = u * tangent_x[k] + v * tangent_y[k]
        sign = 1.0 if dot > 0.0 else -1.0
        norm = np.sqrt(2.0 + 2.0 * abs(dot))
        mx, my = (u + sign * tangent_x[k]) / norm, (v + sign * tangent_y[k]) / norm
        along, aside = dx * mx + dy * my, dy * mx - dx * my
        # exp(-8 t) as the eighth power of the series of exp(-t), right to 1e-7 within the kernel.
        t = along * along * along_scale + aside * aside * aside_scale
        e = 1.0 - t * (1.0 / 8.0)
        e = 1.0 - t * (1.0 / 7.0) * e
        e = 1.0 - t * (1.0 / 6.0) * e
        e = 1.0 - t * (1.0 / 5.0) * e
        e = 1.0 - t * (1.0 / 4.0) * e
        e = 1.0 - t * (1.0 / 3.0) * e
        e = 1.0 - t * (1.0 / 2.0) * e
        e = 1.0 - t * e
        e *= e
        e *= e
        w = weight[k] * e * e
        weights[k] = w if (abs(dot) >= cosine) & (abs(along) <= reach) & (abs(aside) <= across) else 0.0
        offsets[k] = aside


@njit(cache=True, nogil=True)
def _sum_near(n: int, near: F64x2) -> tuple[float, float, float, float]:  # pragma: no cover - compiled
    """Sum weights, lateral offsets and doubled tangents of n weighted points: a line read backwards is the same line."""
    total, pull, cc, ss = 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        u, w = near[2, k], near[6, k]
        total += w
        pull += w * near[5, k]
        cc += w * (2.0 * u * u - 1.0)
        ss += w * 2.0 * u * near[3, k]
    return total, pull, cc, ss


def choose_seeds(
    xy: Floats, tangent: Floats, kind: Ints, priority: NDArray[np.uint64], config: RidgeConfig = RidgeConfig()
) -> Ints:
    """Select the points (S,) that mean shift moves, in order of priority: all but those that nearly coincide with a selected one.

    Points that nearly coincide reach one ridge. As in :func:`thin_ridges`, the result depends on no tile border.
    """
    gates = _ThinningGates(config.seed_spacing_m, config.seed_separation_m, float(np.cos(config.max_heading_rad)))
    return _thin_in_order(xy, tangent, kind, priority, gates)


def thin_ridges(
    xy: Floats, tangent: Floats, kind: Ints, priority: NDArray[np.uint64], config: RidgeConfig = RidgeConfig()
) -> Ints:
    """Select ridge points (S,) in order of priority: a point is kept unless a kept one is within both distances.

    Priorities are pseudo-random, so the result for a point depends on few neighbours and on no tile border.
    """
    gates = _ThinningGates(config.spacing_m, config.min_separation_m, float(np.cos(config.max_heading_rad * 1.5)))
    return _thin_in_order(xy, tangent, kind, priority, gates)


def _thin_in_order(
    xy: Floats, tangent: Floats, kind: Ints, priority: NDArray[np.uint64], gates: _ThinningGates
) -> Ints:
    grid = build_grid(xy[:, 0], xy[:, 1], kind, _THIN_CELL_M)
    place = np.empty(len(xy), np.int64)
    place[grid.order] = np.arange(len(xy))
    walk = place[np.lexsort((xy[:, 1], xy[:, 0], priority))]
    kept = _thin(walk, grid, xy.take(grid.order, 0), tangent.take(grid.order, 0), kind[grid.order], gates)
    return np.sort(grid.order[kept])


class _ThinningGates(NamedTuple):
    """When a point is one with a point that stays: distance along and across (m) below these, cosine at least that."""

    longitudinal_m: float
    lateral_m: float
    min_cosine: float


@njit(cache=True, nogil=True)
def _thin(
    walk: I64x1, grid: PointGrid, xy: F64x2, tangent: F64x2, kind: I64x1, params: _ThinningGates
) -> I64x1:  # pragma: no cover - compiled
    """Return which points stay, ascending; all arrays are in the order of the grid, and walk names places in it."""
    keys, start = grid.keys, grid.offsets
    spacing, min_separation, cosine = params
    kept = np.zeros(len(xy), np.bool_)
    for step in range(len(walk)):
        p = walk[step]
        x, y, u, v = xy[p, 0], xy[p, 1], tangent[p, 0], tangent[p, 1]
        ix, iy = int(np.floor(x / _THIN_CELL_M)), int(np.floor(y / _THIN_CELL_M))
        free = True
        for dx in range(-1, 2):
            low, high = find_cell_range(keys, start, int(kind[p]), ix + dx, iy - 1, iy + 1)
            for q in range(low, high):
                if kept[q]:
                    ex, ey = xy[q, 0] - x, xy[q, 1] - y
                    dot = u * tangent[q, 0] + v * tangent[q, 1]
                    if abs(dot) < cosine:
                        continue
                    if abs(ex * u + ey * v) < spacing and abs(ey * u - ex * v) < min_separation:
                        free = False
                        break
            if not free:
                break
        kept[p] = free
    return np.flatnonzero(kept)
