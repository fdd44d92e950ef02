# SPDX-License-Identifier: Apache-2.0
"""Claims of a study: a paired difference between two of its cells, held against a bar where one is set."""

from __future__ import annotations

from dataclasses import dataclass

from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS
from manyeyes.evaluation.statistics.bootstrap import Interval, MarginVerdict, compare_to_margin
from manyeyes.evaluation.study import ResultGrid, ResultKey


@dataclass(frozen=True)
class MarginTest:
    """AP of one cell minus that of another; the verdict says whether the whole interval is at or above the bar."""

    description: str
    iou: float
    difference: Interval
    margin: float
    verdict: MarginVerdict


def check_margin(
    description: str, results: ResultGrid, key: ResultKey, baseline_key: ResultKey, iou: int, margin: float
) -> MarginTest:
    """The claim that a cell's AP minus another's is at least the bar. iou counts the thresholds of IOUS."""
    difference = results.paired_difference(key, baseline_key, iou)
    has_several_scenarios = difference.num_scenarios > 1
    verdict = compare_to_margin(margin, difference.low, difference.high) if has_several_scenarios else "inconclusive"
    return MarginTest(description, IOU_THRESHOLDS[iou], difference, margin, verdict)
