# SPDX-License-Identifier: Apache-2.0
"""Margin tests of a study: a paired difference between two of its results, compared with a margin."""

from __future__ import annotations

from dataclasses import dataclass

from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS
from manyeyes.evaluation.statistics.bootstrap import Interval, MarginVerdict, compare_to_margin
from manyeyes.evaluation.study import ResultGrid, ResultKey


@dataclass(frozen=True)
class MarginTest:
    """AP of one result minus that of another, and the verdict on the margin."""

    description: str
    iou: float
    difference: Interval
    margin: float
    verdict: MarginVerdict


def check_margin(
    description: str, results: ResultGrid, key: ResultKey, baseline_key: ResultKey, iou: int, margin: float
) -> MarginTest:
    """Test that a result's AP minus the baseline's is at least the margin. iou: row of IOU_THRESHOLDS."""
    difference = results.paired_difference(key, baseline_key, iou)
    has_several_scenarios = difference.num_scenarios > 1
    verdict = compare_to_margin(margin, difference.low, difference.high) if has_several_scenarios else "inconclusive"
    return MarginTest(description, IOU_THRESHOLDS[iou], difference, margin, verdict)
