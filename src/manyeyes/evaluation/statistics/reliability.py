# SPDX-License-Identifier: Apache-2.0
"""Reliability of scores: of boxes with scores in an interval, the fraction that is correct, beside their mean score.

The expected calibration error is the mean of the difference between the two, weighted by boxes: Naeini, Cooper and Hauskrecht,
"Obtaining well calibrated probabilities using Bayesian binning", 2015.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.evaluation.statistics.bootstrap import Interval

NUM_BINS = 10
CONFIDENCE_LEVEL = 0.95
_Z = 1.959963984540054
"""Quantile of the standard normal distribution for CONFIDENCE_LEVEL."""


@dataclass(frozen=True)
class ReliabilityBin:
    """Boxes with scores in [low, high), the last bin in [low, high].

    count: number of boxes. mean_score: of them. correct: fraction of them that is correct, with Wilson's interval.
    """

    low: float
    high: float
    count: int
    mean_score: float
    correct: Interval


@dataclass(frozen=True)
class Reliability:
    """Bins with at least one box, in ascending order, and the expected calibration error; NaN without boxes."""

    bins: tuple[ReliabilityBin, ...]
    expected_error: float


def compute_reliability(
    score: NDArray[np.float64], is_correct: NDArray[np.bool_], num_bins: int = NUM_BINS
) -> Reliability:
    """Compute the reliability of scores (N,) in [0, 1]; is_correct: (N,)."""
    row = np.minimum((score * num_bins).astype(np.int64), num_bins - 1)
    bins: list[ReliabilityBin] = []
    for k in range(num_bins):
        mine = row == k
        count = int(mine.sum())
        if count:
            correct = _wilson(float(is_correct[mine].mean()), count)
            bins.append(ReliabilityBin(k / num_bins, (k + 1) / num_bins, count, float(score[mine].mean()), correct))
    error = sum(b.count * abs(b.mean_score - b.correct.value) for b in bins) / len(score) if len(score) else math.nan
    return Reliability(tuple(bins), error)


def _wilson(fraction: float, count: int) -> Interval:
    """Return Wilson's interval of a fraction of count draws (1927)."""
    center = (fraction + _Z**2 / (2 * count)) / (1 + _Z**2 / count)
    half = _Z * math.sqrt(fraction * (1 - fraction) / count + _Z**2 / (4 * count**2)) / (1 + _Z**2 / count)
    return Interval(fraction, max(0.0, center - half), min(1.0, center + half), CONFIDENCE_LEVEL, count)
