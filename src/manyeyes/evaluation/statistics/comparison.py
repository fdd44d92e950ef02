# SPDX-License-Identifier: Apache-2.0
"""Comparisons of two results by a paired difference with its interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS, MethodResult
from manyeyes.evaluation.detection.protocols import DetectionProtocol
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
    """Compare one method with every other, at every IoU threshold and of every class; nothing where the method was not run."""
    classes = list(dict.fromkeys(result.class_name for result in results))
    ours = {result.class_name: result for result in results if result.method == method}
    return tuple(
        Comparison(
            f"{method} - {baseline.method}{f', {name}' if len(classes) > 1 else ''}",
            f"AP@{iou:g}",
            ours[name].paired_difference(baseline, column, protocol),
        )
        for name in classes
        if name in ours
        for baseline in results
        if baseline.class_name == name and baseline.method != method
        for column, iou in enumerate(IOU_THRESHOLDS)
    )
