# SPDX-License-Identifier: Apache-2.0
"""How sure the numbers of one map are: a bootstrap over ground.

The ground is divided into squares of 64 m, anchored at the frame's origin. True and predicted elements belong to the square of
their middle (of the truth that it hit, for a true positive, so that a hit is never without its truth), pieces of length to the
square where they lie. Squares are drawn with replacement, 1,000 times; AP is recomputed on each draw from the ranking of the whole
map. Source: Efron and Tibshirani 1993, ch. 13; blocks, since neighbours share observations and hence errors. The interval
covers the choice of the mapped ground, not that of the observations: for that, a study repeats with other seeds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.metrics import MAX_LATERAL_M, Thresholds, select_lines, split_into_pieces
from manyeyes.evaluation.maps.pooled_ap import MapPair, assign_to_squares, bootstrap_pooled_ap
from manyeyes.evaluation.statistics.bootstrap import Interval, draw_resamples, make_interval
from manyeyes.ops.nearest_line import find_nearest_line

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
BLOCK_SIZE_M = 64.0


@dataclass(frozen=True)
class MetricIntervals:
    """The intervals of one kind: of its AP (exact, narrow) and of its F at 0.5 m."""

    kind: str
    ap: Interval
    f1: Interval


def bootstrap_ap_interval(
    predicted: MapElements,
    truth: MapElements,
    kind: str,
    protocol: str = "exact",
    thresholds: Thresholds = "narrow",
    num_resamples: int = 1000,
    seed: int = 0,
    confidence_level: float = 0.95,
) -> Interval:
    """Return the AP of one kind, mean over the thresholds, with its interval."""
    pair = MapPair(predicted, truth, assign_to_squares("", BLOCK_SIZE_M))
    return bootstrap_pooled_ap(
        [pair], kind, protocol, thresholds, num_resamples=num_resamples, seed=seed, confidence_level=confidence_level
    ).interval()


def bootstrap_f1_interval(
    predicted: MapElements,
    truth: MapElements,
    kind: str,
    max_distance_m: float = 0.5,
    num_resamples: int = 1000,
    seed: int = 0,
    confidence_level: float = 0.95,
) -> Interval:
    """F by length of one kind with its interval."""
    predicted_lines, truth_lines = select_lines(predicted, kind), select_lines(truth, kind)
    predicted_pieces, truth_pieces = split_into_pieces(predicted_lines), split_into_pieces(truth_lines)
    max_search_m = max(max_distance_m, MAX_LATERAL_M)
    is_matched = (
        find_nearest_line(predicted_pieces.center, truth_lines.points, truth_lines.offsets, max_search_m).distance
        <= max_distance_m
    )
    is_recalled = (
        find_nearest_line(truth_pieces.center, predicted_lines.points, predicted_lines.offsets, max_search_m).distance
        <= max_distance_m
    )
    num_blocks, block = _assign_blocks(np.vstack((predicted_pieces.center, truth_pieces.center)))
    sums = [
        np.bincount(rows, length, num_blocks)
        for rows, length in (
            (block[: len(is_matched)], predicted_pieces.length * is_matched),
            (block[: len(is_matched)], predicted_pieces.length),
            (block[len(is_matched) :], truth_pieces.length * is_recalled),
            (block[len(is_matched) :], truth_pieces.length),
        )
    ]
    weights = np.vstack((np.ones((1, num_blocks), dtype=np.int64), draw_resamples(num_blocks, num_resamples, seed)))
    matched_m, predicted_m, recalled_m, truth_m = (weights @ s for s in sums)
    with np.errstate(invalid="ignore", divide="ignore"):
        precision, recall = (
            np.where(predicted_m > 0, matched_m / predicted_m, 0.0),
            np.where(truth_m > 0, recalled_m / truth_m, np.nan),
        )
        f1 = np.where(precision + recall > 0, 2 * precision * recall / (precision + recall), recall * 0.0)
    return make_interval(float(f1[0]), f1[1:], confidence_level, num_blocks)


def _assign_blocks(points: Floats) -> tuple[int, Ints]:
    """Return how many squares hold any of the places (N, 2), and which of them each is in (N,)."""
    cells = np.floor(points / BLOCK_SIZE_M).astype(np.int64)
    blocks, block = np.unique(cells, axis=0, return_inverse=True)
    return len(blocks), block.reshape(-1)
