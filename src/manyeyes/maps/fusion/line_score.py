# SPDX-License-Identifier: Apache-2.0
"""Score of a fused line: the probability that it is a line of its kind, whole and in its place.

Existence alone does not rank lines: a line of two certain observations may lie a metre aside, and a false line that accompanies a
true one half a lane beside it is detected where the true one is. The score is a logistic regression on mean log-odds, length,
lateral standard deviation, and the fraction that has a competitor: a parallel line nearer than any lane is wide that more
observations confirm. The coefficients are fitted to dividers and boundaries alike, of the places that tuning uses (20 and 60
observations, at true poses and with pose errors; right: Chamfer distance of at most a metre to some true line).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I64x1, njit
from manyeyes.maps.fusion.point_grid import PointGrid, build_grid, find_cell_range

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CELL_M = 2.5
_MAX_SIGMA_M = 1.0  # a line that may lie anywhere within a lane is no better known than this


@dataclass(frozen=True)
class LineScoreConfig:
    """Coefficients of the regression, and what a competitor is.

    intercept, per_log_odds, per_log_length, per_sigma_m, per_competitor: of the log-odds of the score; natural logarithm of the
        length in metres; per_competitor of the fraction that has one.
    min_competitor_m, max_competitor_m: lateral distance of a competitor. min_advantage: its mean log-odds less the line's.
    """

    intercept: float = -0.27
    per_log_odds: float = 0.24
    per_log_length: float = 0.37
    per_sigma_m: float = -1.57
    per_competitor: float = -1.7
    min_competitor_m: float = 0.9
    max_competitor_m: float = 2.3
    min_advantage: float = 1.0


class LineFeatures(NamedTuple):
    """What the score of L lines depends on, (L,) each: mean log-odds, length (m), lateral standard deviation (m, of each point at
    most 1), and the fraction of their points that have a competitor.
    """

    log_odds: Floats
    length_m: Floats
    sigma_m: Floats
    competitor: Floats


class ChainPoints(NamedTuple):
    """Points of L lines in order: places (M, 2) in metres, offsets (L + 1,), and of each point (M,) log-odds and lateral
    standard deviation (m).
    """

    xy: F64x2
    offsets: I64x1
    log_odds: F64x1
    sigma_m: F64x1


def describe_lines(points: ChainPoints, length_m: Floats, config: LineScoreConfig = LineScoreConfig()) -> LineFeatures:
    """Compute the features of lines of length_m (L,)."""
    log_odds = _mean(points.log_odds, points.offsets)
    grid = build_grid(points.xy[:, 0], points.xy[:, 1], np.zeros(len(points.xy), np.int64), _CELL_M)
    gates = (config.min_competitor_m, config.max_competitor_m, config.min_advantage)
    competes = _find_competitors(points.xy, points.offsets, _directions(points), log_odds, grid, gates)
    sigma = _mean(np.minimum(points.sigma_m, _MAX_SIGMA_M), points.offsets)
    return LineFeatures(log_odds, length_m, sigma, _mean(competes.astype(np.float64), points.offsets))


def compute_line_score(features: LineFeatures, config: LineScoreConfig = LineScoreConfig()) -> Floats:
    """Compute the score (L,) in (0, 1)."""
    evidence = (
        config.intercept
        + config.per_log_odds * features.log_odds
        + config.per_log_length * np.log(np.maximum(features.length_m, 0.1))
        + config.per_sigma_m * features.sigma_m
        + config.per_competitor * features.competitor
    )
    return 1.0 / (1.0 + np.exp(-evidence))


def _mean(values: Floats, offsets: Ints) -> Floats:
    return np.add.reduceat(values, offsets[:-1]) / np.diff(offsets) if len(values) else np.zeros(0)


def _directions(points: ChainPoints) -> Floats:
    """Return (M, 2) unit chord of each line at its points, from the point before to the point after."""
    at, sizes = np.arange(len(points.xy)), np.diff(points.offsets)
    low, high = np.repeat(points.offsets[:-1], sizes), np.repeat(points.offsets[1:] - 1, sizes)
    step = points.xy[np.minimum(at + 1, high)] - points.xy[np.maximum(at - 1, low)]
    return step / np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)[:, None]


@njit(cache=True, nogil=True)
def _find_competitors(
    xy: F64x2, offsets: I64x1, direction: F64x2, log_odds: F64x1, grid: PointGrid, gates: tuple[float, float, float]
) -> Boolx1:  # pragma: no cover - compiled
    """Return (M,) whether a better confirmed line runs beside each point; direction: (M, 2) unit; log_odds: (L,) of lines."""
    keys, start, order = grid.keys, grid.offsets, grid.order
    near, far, advantage = gates
    line = np.empty(len(xy), np.int64)
    for c in range(len(offsets) - 1):
        line[offsets[c] : offsets[c + 1]] = c
    out = np.zeros(len(xy), np.bool_)
    for p in range(len(xy)):
        x, y, u, v = xy[p, 0], xy[p, 1], direction[p, 0], direction[p, 1]
        ix, iy = int(np.floor(x / _CELL_M)), int(np.floor(y / _CELL_M))
        for dx in range(-1, 2):
            low, high = find_cell_range(keys, start, 0, ix + dx, iy - 1, iy + 1)
            for k in range(low, high):
                q = order[k]
                if line[q] == line[p] or log_odds[line[q]] <= log_odds[line[p]] + advantage:
                    continue
                ex, ey = xy[q, 0] - x, xy[q, 1] - y
                aside = abs(ey * u - ex * v)
                is_beside = abs(ex * u + ey * v) < 1.0 and near < aside < far
                if is_beside and abs(u * direction[q, 0] + v * direction[q, 1]) > 0.97:
                    out[p] = True
    return out
