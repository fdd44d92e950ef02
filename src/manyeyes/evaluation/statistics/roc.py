# SPDX-License-Identifier: Apache-2.0
"""The receiver operating characteristic of a score: true against false positives at falling thresholds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.evaluation.statistics.proportion import Proportion

NUM_ROC_POINTS = 101


@dataclass(frozen=True)
class RocCurve:
    """false_positive and true_positive rates at falling thresholds, from 0 to 1; area under it, and the numbers of both classes."""

    false_positive: tuple[float, ...]
    true_positive: tuple[float, ...]
    area: float
    num_positive: int
    num_negative: int


def compute_roc(score: NDArray[np.float64], is_positive: NDArray[np.bool_]) -> RocCurve | None:
    """Compute the ROC of scores (N,), high where positive (N,); equal scores are one step. None where one class is empty."""
    num_positive, num_negative = int(is_positive.sum()), int((~is_positive).sum())
    if not num_positive or not num_negative:
        return None
    order = np.argsort(-score, kind="stable")
    ends = np.append(np.flatnonzero(np.diff(score[order])), len(score) - 1)
    true_positive = np.append(0, np.cumsum(is_positive[order])[ends] / num_positive)
    false_positive = np.append(0, np.cumsum(~is_positive[order])[ends] / num_negative)
    area = float(np.sum(np.diff(false_positive) * (true_positive[1:] + true_positive[:-1]) / 2))
    x = np.linspace(0, 1, NUM_ROC_POINTS)
    last = np.searchsorted(false_positive, x, side="right") - 1
    return RocCurve(tuple(x.tolist()), tuple(true_positive[last].tolist()), area, num_positive, num_negative)


def count_found(score: NDArray[np.float64], is_positive: NDArray[np.bool_], max_false_positive: float) -> Proportion:
    """Count the positives above the lowest threshold that at most this fraction of the negatives exceeds."""
    negative = np.sort(score[~is_positive])[::-1]
    allowed = int(max_false_positive * len(negative))
    threshold = negative[allowed] if allowed < len(negative) else -np.inf
    return Proportion.of(int((score[is_positive] > threshold).sum()), int(is_positive.sum()))
