# SPDX-License-Identifier: Apache-2.0
"""Comparisons of two results by a paired difference with its interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS, MethodResult
from manyeyes.evaluation.detection.average_precision import DetectionProtocol
from manyeyes.evaluation.statistics.bootstrap import Interval


@dataclass(frozen=True)
class Comparison:
    """A measured quantity with its interval, mostly one result minus another, paired over the same resamples.

    description: the two results, such as ``intermediate - none``. metric: what is measured, such as ``AP@0.5``. baseline_value:
    the value of a baseline beside a quantity that is no difference.
    """

    description: str
    metric: str
    interval: Interval
    baseline_value: float | None = None


def compare_methods(
    results: Sequence[MethodResult], protocol: DetectionProtocol, method: str = "intermediate"
) -> tuple[Comparison, ...]:
    """Compare one method with every other, at every IoU threshold; nothing where the method was not run."""
    by_name = {result.method: result for result in results}
    if method not in by_name:
        return ()
    return tuple(
        Comparison(
            f"{method} - {baseline.method}",
            f"AP@{iou:g}",
            by_name[method].paired_difference(baseline, column, protocol),
        )
        for baseline in results
        if baseline.method != method
        for column, iou in enumerate(IOU_THRESHOLDS)
    )
