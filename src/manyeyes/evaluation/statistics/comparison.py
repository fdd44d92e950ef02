# SPDX-License-Identifier: Apache-2.0
"""Comparisons of two results by a paired difference with its interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from manyeyes.agents.strategies.names import TEMPORAL, has_memory
from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS, MethodResult
from manyeyes.evaluation.detection.protocols import DetectionProtocol
from manyeyes.evaluation.statistics.bootstrap import Interval


@dataclass(frozen=True)
class Comparison:
    """A measured quantity with its interval, mostly one result minus another, paired over the same resamples.

    description: the two results, such as ``intermediate - no-fusion``. metric: what is measured, such as ``AP@0.5``.
    baseline_value: the value of a baseline beside a quantity that is no difference.
    """

    description: str
    metric: str
    interval: Interval
    baseline_value: float | None = None


def compare_methods(
    results: Sequence[MethodResult], protocol: DetectionProtocol, method: str = "intermediate"
) -> tuple[Comparison, ...]:
    """Compare one method with every other of the same form, without or with memory, at every IoU threshold and of every class.

    method: its name without memory; nothing where it was not run.
    """
    classes = list(dict.fromkeys(result.class_name for result in results))
    by_name = {(result.method, result.class_name): result for result in results}
    return tuple(
        Comparison(
            f"{ours} - {baseline.method}{f', {name}' if len(classes) > 1 else ''}",
            f"AP@{iou:g}",
            by_name[ours, name].paired_difference(baseline, column, protocol),
        )
        for ours in (method, method + TEMPORAL)
        for name in classes
        if (ours, name) in by_name
        for baseline in results
        if baseline.class_name == name and baseline.method != ours
        if has_memory(baseline.method) == has_memory(ours)
        for column, iou in enumerate(IOU_THRESHOLDS)
    )
