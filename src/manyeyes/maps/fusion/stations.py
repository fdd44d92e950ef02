# SPDX-License-Identifier: Apache-2.0
"""Build the stations of an area from aligned observations: the local part of the fusion, which a tile can do alone.

A station depends only on observations within a few tens of metres. So the stations of an area are the same for any tiling.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x2, I64x1, njit
from manyeyes.datatypes.map_element import STYLES, take_rows
from manyeyes.maps.elements.vector_map import PUBLISHED, RETIRED
from manyeyes.maps.fusion.coverage import clip_runs, find_observed_cells, merge_runs
from manyeyes.maps.fusion.crossings import CrossingConfig, FusedCrossings, fuse_crossings
from manyeyes.maps.fusion.existence import (
    POINT_VARIANCE_M2,
    EvidenceConfig,
    EvidenceTable,
    accumulate_evidence,
    compute_lateral_variance,
    find_covered_by_inliers,
)
from manyeyes.maps.fusion.mean_shift import RidgeConfig, choose_seeds, mean_shift_to_ridges, thin_ridges
from manyeyes.maps.fusion.observation_arrays import ObservationArrays, is_line
from manyeyes.maps.fusion.observation_weights import compute_observation_weights
from manyeyes.maps.fusion.point_grid import PointGrid, build_grid, find_cell_range
from manyeyes.maps.fusion.pose_optimization import limit_per_cell
from manyeyes.maps.fusion.pose_solution import REJECTED_WEIGHT, PoseSolution

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CONFLICT_CELL_M = 2.5

Area = tuple[float, float, float, float]


@dataclass(frozen=True)
class StationConfig:
    """Configuration of the stations.

    max_observations_per_cell: observations that shape a ridge per cell of 8 m, class and heading.
    halo_m: margin around an area within which ridges are found too.
    min_inlier_agents: points of rejected agents count only where fewer inlier agents cover the place.
    min_support: detections that a station needs if its summed visibility is at least min_support_coverage.
    conflict_radius_m, same_kind_conflict_radius_m: lateral distances within which stations of two kinds, or of one kind,
        exclude each other, unless the same observations detected both.
    conflict_support_ratio, conflict_log_odds: advantage of the station that remains, as a ratio of supports (two kinds) or a
        difference of log-odds (one kind).
    ridge, evidence, polygon: configurations of mean shift, existence and crossings.
    """

    max_observations_per_cell: int = 32
    halo_m: float = 24.0
    min_inlier_agents: int = 5
    min_support: int = 1
    min_support_coverage: float = 3.0
    conflict_radius_m: float = 0.6
    same_kind_conflict_radius_m: float = 2.0
    conflict_support_ratio: float = 1.5
    conflict_log_odds: float = 3.0
    ridge: RidgeConfig = field(default_factory=RidgeConfig)
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    polygon: CrossingConfig = field(default_factory=CrossingConfig)


@dataclass(frozen=True, eq=False)
class StationTable:
    """Stations of lines and whole crossings of an area, with their evidence.

    xy, tangent: (K, 2) metres and unit, map frame; line_evidence: (K,) their evidence.
    ring_offsets: (C + 1,), ring_xy: rings of the crossings; ring_evidence: (C,) their evidence.
    observed_cells: (R, 3) runs of observed ground (:mod:`manyeyes.maps.fusion.coverage`); empty: unknown.
    """

    xy: Floats
    tangent: Floats
    line_evidence: EvidenceTable
    ring_offsets: Ints
    ring_xy: Floats
    ring_evidence: EvidenceTable
    observed_cells: Ints

    def __len__(self) -> int:
        return len(self.xy)

    @classmethod
    def cat(cls, tables: Sequence[StationTable]) -> StationTable:
        """Merge the stations of disjoint areas into one table, in an order that does not depend on the areas."""
        xy = np.concatenate([t.xy for t in tables])
        tangent = np.concatenate([t.tangent for t in tables])
        line, ring = (
            EvidenceTable.cat([t.line_evidence for t in tables]),
            EvidenceTable.cat([t.ring_evidence for t in tables]),
        )
        points = np.concatenate([t.ring_xy for t in tables])
        sizes = np.concatenate([np.diff(t.ring_offsets) for t in tables])
        start = np.concatenate(([0], np.cumsum(sizes))).astype(np.int64)
        order = np.lexsort((xy[:, 1], xy[:, 0], line.kind))
        rings = np.lexsort((points[start[:-1], 1], points[start[:-1], 0])) if len(sizes) else np.zeros(0, np.int64)
        ring_offsets, places = take_rows(start, rings)
        observed_cells = merge_runs(np.concatenate([t.observed_cells for t in tables]))
        return cls(
            xy.take(order, 0),
            tangent.take(order, 0),
            line.take(order),
            ring_offsets,
            points[places],
            ring.take(rings),
            observed_cells,
        )

    def take_area(self, area: Area, halo_m: float) -> StationTable:
        """Return what stands in an area widened by a halo, in order; a crossing stands where its first point is."""
        rows = np.flatnonzero(_within(self.xy, area, halo_m))
        rings = np.flatnonzero(_within(self.ring_xy[self.ring_offsets[:-1]], area, halo_m))
        ring_offsets, places = take_rows(self.ring_offsets, rings)
        wide = (area[0] - halo_m, area[1] - halo_m, area[2] + halo_m, area[3] + halo_m)
        return StationTable(
            self.xy.take(rows, 0),
            self.tangent.take(rows, 0),
            self.line_evidence.take(rows),
            ring_offsets,
            self.ring_xy[places],
            self.ring_evidence.take(rings),
            clip_runs(self.observed_cells, wide),
        )


def build_stations(
    arrays: ObservationArrays, solution: PoseSolution, area: Area | None = None, config: StationConfig = StationConfig()
) -> StationTable:
    """Build the stations and crossings in area (x0, y0, x1, y1), lower sides included, upper excluded; None: everywhere.

    arrays: all observations that reach into the area widened by the halo. solution: contains all of their poses.
    """
    rows = solution.row_indices(arrays.ids)
    pose, covariance, common_covariance = (
        table[rows] for table in (solution.pose, solution.covariance, solution.common_covariance)
    )
    weight = compute_observation_weights(
        arrays, solution.initial_pose[rows], solution.scale[rows], solution.agent_weight[rows]
    )
    is_inlier = solution.agent_weight[rows] > REJECTED_WEIGHT
    lines = _build_line_stations(arrays, pose, (covariance, common_covariance), (weight, is_inlier), area, config)
    rank = np.argsort(np.argsort(np.array(arrays.ids)))
    crossings = fuse_crossings(arrays, pose, weight, rank, config.polygon, config.evidence)
    ring, ring_offsets, ring_xy = _rings_inside(crossings, area, config)
    observed_cells = find_observed_cells(arrays, pose, area)
    return StationTable.cat([StationTable(*lines, ring_offsets, ring_xy, ring, observed_cells)])


def _build_line_stations(
    arrays: ObservationArrays,
    pose: Floats,
    covariances: tuple[Floats, Floats],
    observation_weights: tuple[Floats, NDArray[np.bool_]],
    area: Area | None,
    config: StationConfig,
) -> tuple[Floats, Floats, EvidenceTable]:
    """Build positions, tangents and evidence of line stations in the area.

    covariances: of the poses (O, 3, 3), given all others and in common. observation_weights: weight (O,) and inlier flag (O,) of
    the observations.
    """
    covariance, common_covariance = covariances
    xy, tangent = arrays.to_world(pose)
    weight, is_inlier = observation_weights
    point_weight = _compute_point_weights(arrays, xy, tangent, pose, covariance) * weight[arrays.observation_of_point]
    point_weight[
        find_covered_by_inliers(arrays, pose, is_inlier, config.min_inlier_agents, config.evidence.view_margin_m)
    ] = 0.0
    counts = np.flatnonzero(
        limit_per_cell(arrays, pose, config.max_observations_per_cell)
        & is_line(arrays.kind_of_point)
        & (point_weight > 0.0)
    )
    points = xy.take(counts, 0), tangent.take(counts, 0), arrays.kind_of_point[counts]
    seeds = choose_seeds(*points, arrays.priority[counts], config.ridge)
    seeds = seeds[_within(points[0][seeds], area, config.halo_m)]
    places, turned, _ = mean_shift_to_ridges(seeds, *points, point_weight[counts], config.ridge)
    seeds = counts[seeds]
    kept = thin_ridges(places, turned, arrays.kind_of_point[seeds], arrays.priority[seeds], config.ridge)
    seeds, places, turned = seeds[kept], places.take(kept, 0), turned.take(kept, 0)
    kind = arrays.kind_of_point[seeds]
    shift, found = accumulate_evidence(
        places, turned, kind, arrays, pose, point_weight, is_inlier, common_covariance, config.evidence
    )
    normal = np.stack((-turned[:, 1], turned[:, 0]), 1)
    places = places + shift[:, None] * normal
    has_support = (found.support >= config.min_support) | (found.coverage < config.min_support_coverage)
    stays = np.flatnonzero((found.support > 0) & (has_support | (found.state == RETIRED)))
    thinned = thin_ridges(places[stays], turned[stays], kind[stays], arrays.priority[seeds[stays]], config.ridge)
    stays = stays[thinned]
    table = found.take(stays)
    places, turned = places.take(stays, 0), turned.take(stays, 0)
    loses = _find_conflicts(places, turned, table, config)
    chosen = np.flatnonzero(_within(places, area, 0.0) & ~loses & ((table.log_odds > 0.0) | (table.state != 0)))
    return places.take(chosen, 0), turned.take(chosen, 0), table.take(chosen)


def _compute_point_weights(
    arrays: ObservationArrays, xy: Floats, tangent: Floats, pose: Floats, covariance: Floats
) -> Floats:
    """Compute (P,) 1 / lateral variance by detection and pose, relative to POINT_VARIANCE_M2."""
    owner = arrays.observation_of_point
    spread = compute_lateral_variance(xy, tangent, pose[owner], covariance[owner])
    return POINT_VARIANCE_M2 / (arrays.sigma**2 + 0.1**2 + spread)


def _within(xy: Floats, area: Area | None, halo: float) -> NDArray[np.bool_]:
    if area is None:
        return np.ones(len(xy), bool)
    x, y = xy[:, 0], xy[:, 1]
    return (x >= area[0] - halo) & (x < area[2] + halo) & (y >= area[1] - halo) & (y < area[3] + halo)


def _find_conflicts(xy: Floats, tangent: Floats, table: EvidenceTable, config: StationConfig) -> NDArray[np.bool_]:
    """Find the stations (K,) that lose against another one that excludes them."""
    grid = build_grid(xy[:, 0], xy[:, 1], np.zeros(len(xy), np.int64), _CONFLICT_CELL_M)
    params = _ConflictLimits(
        config.conflict_radius_m,
        config.same_kind_conflict_radius_m,
        config.conflict_support_ratio,
        config.conflict_log_odds,
    )
    return _find_losers(xy, tangent, table, grid, params)


class _ConflictLimits(NamedTuple):
    """Lateral distances (m) within which stations of two kinds, and of one kind, exclude each other; minimum advantages of the
    one that remains: ratio of supports, difference of log-odds.
    """

    max_lateral_m: float
    max_lateral_same_kind_m: float
    min_support_ratio: float
    min_log_odds_difference: float


@njit(cache=True, nogil=True)
def _find_losers(
    xy: F64x2, tangent: F64x2, table: EvidenceTable, grid: PointGrid, params: _ConflictLimits
) -> Boolx1:  # pragma: no cover - compiled
    """Find the stations (K,), at xy (K, 2) with unit tangents (K, 2), that lose against another one."""
    kind, odds, support, state = table.kind, table.log_odds, table.support, table.state
    keys, start, order = grid.keys, grid.offsets, grid.order
    near, far, ratio, difference = params
    loses = np.zeros(len(xy), np.bool_)
    for k in range(len(xy)):
        u, v = tangent[k, 0], tangent[k, 1]
        ix, iy = int(np.floor(xy[k, 0] / _CONFLICT_CELL_M)), int(np.floor(xy[k, 1] / _CONFLICT_CELL_M))
        for dx in range(-1, 2):
            low, high = find_cell_range(keys, start, 0, ix + dx, iy - 1, iy + 1)
            for place in range(low, high):
                q = order[place]
                if q == k or state[q] == RETIRED or state[k] == RETIRED:
                    continue
                ex, ey = xy[q, 0] - xy[k, 0], xy[q, 1] - xy[k, 1]
                aside = abs(ey * u - ex * v)
                if abs(ex * u + ey * v) > 1.0 or aside > far or abs(u * tangent[q, 0] + v * tangent[q, 1]) < 0.93:
                    continue
                if kind[q] != kind[k]:
                    wins = aside < near and support[q] > ratio * support[k] and odds[q] >= odds[k]
                else:
                    wins = odds[q] > odds[k] + difference and support[q] >= 3
                # Two lines that the same observations detected are two lines; else they are two estimates of one.
                if wins and 4 * _count_shared(table.sources, table.source_offsets, k, q) < min(support[k], support[q]):
                    loses[k] = True
    return loses


@njit(cache=True, nogil=True)
def _count_shared(sources: I64x1, first: I64x1, k: int, q: int) -> int:  # pragma: no cover - compiled
    """Return how many observations saw both stations; each one's sources ascend."""
    both, i, j = 0, first[k], first[q]
    while i < first[k + 1] and j < first[q + 1]:
        if sources[i] == sources[j]:
            both += 1
            i += 1
            j += 1
        elif sources[i] < sources[j]:
            i += 1
        else:
            j += 1
    return both


def _rings_inside(
    crossings: FusedCrossings, area: Area | None, config: StationConfig
) -> tuple[EvidenceTable, Ints, Floats]:
    """Evidence, offsets and rings of the crossings whose centre lies in the area."""
    table, count = crossings.evidence, len(crossings.evidence.kind)
    counts = np.diff(crossings.ring_offsets)
    owner = np.repeat(np.arange(count), counts)
    centre = np.stack([np.bincount(owner, crossings.xy[:, axis], count) / np.maximum(1, counts) for axis in (0, 1)], 1)
    has_support = (table.support >= config.min_support) | (table.coverage < config.min_support_coverage)
    alive = ((table.log_odds > 0.0) & has_support) | (table.state == PUBLISHED) | (table.state == RETIRED)
    chosen = np.flatnonzero(_within(centre, area, 0.0) & alive & (table.support > 0))
    start, places = take_rows(crossings.ring_offsets, chosen)
    return table.take(chosen), start, crossings.xy[places]


def normalize_style(table: EvidenceTable) -> EvidenceTable:
    """Return the same with style votes as probabilities (K, S); without votes all alike."""
    total = table.style.sum(1, keepdims=True)
    return table._replace(style=np.where(total > 0, table.style / np.maximum(total, 1e-12), 1.0 / len(STYLES)))
