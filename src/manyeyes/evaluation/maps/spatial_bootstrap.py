# SPDX-License-Identifier: Apache-2.0
"""How sure the numbers of one map are: a bootstrap over ground.

The ground is divided into squares of 64 m, anchored at the frame's origin. True and predicted elements belong to the square of
their middle (of the truth that it hit, for a true positive, so that a hit is never without its truth), pieces of length to the
square where they lie. Squares are drawn with replacement, 1,000 times; AP is recomputed on each draw from the ranking of the whole
map. Source: Efron and Tibshirani 1993, ch. 13; blocks, since neighbours share observations and hence errors. It says how much
the number depends on the ground that was mapped, not on which observations came: for that, a study repeats with other seeds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.metrics import LATERAL_WITHIN_M, Thresholds, lines_of_kind, pieces_of
from manyeyes.evaluation.maps.pooled_ap import Judged, pooled_ap, squares
from manyeyes.evaluation.statistics.bootstrap import Interval, resamples
from manyeyes.ops.nearest_line import nearest_line

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
BLOCK_M = 64.0


@dataclass(frozen=True)
class Sureness:
    """The intervals of one kind: of its AP (exact, narrow) and of its F at 0.5 m."""

    kind: str
    ap: Interval
    f: Interval


def ap_interval(
    predicted: MapElements,
    truth: MapElements,
    kind: str,
    way: str = "exact",
    thresholds: Thresholds = "narrow",
    n: int = 1000,
    seed: int = 0,
    level: float = 0.95,
) -> Interval:
    """The AP of one kind, mean over the thresholds, with its interval."""
    judged = Judged(predicted, truth, squares("", BLOCK_M))
    return pooled_ap([judged], kind, way, thresholds, n=n, seed=seed, level=level).interval()


def f_interval(
    predicted: MapElements,
    truth: MapElements,
    kind: str,
    within_m: float = 0.5,
    n: int = 1000,
    seed: int = 0,
    level: float = 0.95,
) -> Interval:
    """F by length of one kind with its interval."""
    mine, theirs = lines_of_kind(predicted, kind), lines_of_kind(truth, kind)
    there, back = pieces_of(mine), pieces_of(theirs)
    reach = max(within_m, LATERAL_WITHIN_M)
    near = nearest_line(there.middle, theirs.points, theirs.first, reach).distance <= within_m
    seen = nearest_line(back.middle, mine.points, mine.first, reach).distance <= within_m
    known, block = _blocks(np.vstack((there.middle, back.middle)))
    sums = [
        np.bincount(where, length, known)
        for where, length in (
            (block[: len(near)], there.length * near),
            (block[: len(near)], there.length),
            (block[len(near) :], back.length * seen),
            (block[len(near) :], back.length),
        )
    ]
    weights = np.vstack((np.ones((1, known), dtype=np.int64), resamples(known, n, seed)))
    hit, said, held, true = (weights @ s for s in sums)
    with np.errstate(invalid="ignore", divide="ignore"):
        precision, recall = np.where(said > 0, hit / said, 0.0), np.where(true > 0, held / true, np.nan)
        f = np.where(precision + recall > 0, 2 * precision * recall / (precision + recall), recall * 0.0)
    return _interval(f, level, known)


def _blocks(places: Floats) -> tuple[int, Ints]:
    """How many squares hold any of the places (N, 2), and which of them each is in (N,)."""
    cells = np.floor(places / BLOCK_M).astype(np.int64)
    known, block = np.unique(cells, axis=0, return_inverse=True)
    return len(known), block.reshape(-1)


def _interval(values: Floats, level: float, blocks: int) -> Interval:
    """The first value, and quantiles of the others that are numbers."""
    draws = values[1:][~np.isnan(values[1:])]
    if not len(draws) or math.isnan(values[0]):
        return Interval(float(values[0]), math.nan, math.nan, level, blocks)
    low, high = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(values[0]), float(low), float(high), level, blocks)
