# SPDX-License-Identifier: Apache-2.0
"""Methods side by side, compared by paired differences and margins.

A margin is tested on the paired difference over scenarios: "met" when the whole 95 % interval is at or above it, "not met" when
it is below, else "inconclusive". One scenario alone is always inconclusive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS, MethodResult
from manyeyes.evaluation.detection.average_precision import DetectionProtocol
from manyeyes.evaluation.statistics.bootstrap import Interval, MarginVerdict, compare_to_margin


@dataclass(frozen=True)
class Margin:
    """The margin by which a method is to be better than a baseline, in AP at an IoU threshold."""

    method: str
    baseline: str
    min_difference: float
    iou: float = 0.5


MARGINS = (
    Margin("intermediate", "none", 0.12),
    Margin("intermediate", "late", 0.02),
    Margin("intermediate", "late-temporal", 0.02),
)


@dataclass(frozen=True)
class PairedDifference:
    """AP of a method less that of a baseline, on the same resampled scenarios; margin and verdict are None where none is set."""

    method: str
    baseline: str
    iou: float
    interval: Interval
    margin: float | None
    verdict: MarginVerdict | None


def compare_methods(
    results: Sequence[MethodResult],
    protocol: DetectionProtocol,
    method: str = "intermediate",
    margins: Sequence[Margin] = MARGINS,
) -> tuple[PairedDifference, ...]:
    """One method against every other, at every IoU threshold; nothing where the method was not run."""
    min_differences = {(margin.method, margin.baseline, margin.iou): margin.min_difference for margin in margins}
    by_name = {result.method: result for result in results}
    if method not in by_name:
        return ()
    out = []
    for baseline in (r for r in results if r.method != method):
        for column, iou in enumerate(IOU_THRESHOLDS):
            interval = by_name[method].paired_difference(baseline, column, protocol)
            margin = min_differences.get((method, baseline.method, iou))
            out.append(
                PairedDifference(method, baseline.method, iou, interval, margin, _check_margin(margin, interval))
            )
    return tuple(out)


def _check_margin(margin: float | None, interval: Interval) -> MarginVerdict | None:
    if margin is None:
        return None
    return compare_to_margin(margin, interval.low, interval.high) if interval.num_scenarios > 1 else "inconclusive"
