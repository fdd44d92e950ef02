# SPDX-License-Identifier: Apache-2.0
"""Results of a comparison of methods: rows, paired differences, and both as plain values for JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console

from manyeyes.datasets.missing import NONE_MISSING, MissingFiles
from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS, MethodResult
from manyeyes.evaluation.detection.average_precision import DetectionProtocol
from manyeyes.evaluation.detection.communication import Communication
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Comparison, compare_methods
from manyeyes.viz.table import MethodRow, make_differences_table, make_row, make_terminal_table, missing_footer


@dataclass(frozen=True)
class ApSummary:
    """AP at one IoU threshold. ap: by the protocol; recall, precision: at its score threshold."""

    iou: float
    ap: Interval
    ap_global: float
    ap_legacy: float
    recall: float
    precision: float
    n_gt: int
    n_detections: int


@dataclass(frozen=True)
class MethodStats:
    """Metrics of one method, without its frames."""

    method: str
    ap_summaries: tuple[ApSummary, ...]
    communication: Communication
    age_ms: float
    share_ms: float
    perceive_ms: float


@dataclass(frozen=True)
class MethodComparison:
    """Comparison of methods. protocol: rules and range of AP. missing: missing files of the recording."""

    protocol: DetectionProtocol
    stats: tuple[MethodStats, ...]
    rows: tuple[MethodRow, ...]
    differences: tuple[Comparison, ...]
    missing: MissingFiles = NONE_MISSING

    @property
    def footer(self) -> str:
        """Format the note on missing files; empty where there are none."""
        return missing_footer(self.missing.count)

    @property
    def has_several_scenarios(self) -> bool:
        """Whether there is more than one scenario to compare over."""
        return any(number.ap_summaries[0].ap.num_scenarios > 1 for number in self.stats)


def summarize_comparison(
    results: Sequence[MethodResult], protocol: DetectionProtocol, missing: MissingFiles = NONE_MISSING
) -> MethodComparison:
    """Summarize measured methods: rows, metrics and paired differences."""
    stats = []
    for result in results:
        columns = zip(IOU_THRESHOLDS, result.intervals, result.ap)
        ap_summaries = tuple(
            ApSummary(iou, interval, ap.ap_global, ap.ap_legacy, ap.recall, ap.precision, ap.n_gt, ap.n_detections)
            for iou, interval, ap in columns
        )
        sent = result.communication
        stats.append(MethodStats(result.method, ap_summaries, sent, result.age_ms, result.share_ms, result.perceive_ms))
    rows = tuple(make_row(result) for result in results)
    return MethodComparison(protocol, tuple(stats), rows, compare_methods(results, protocol), missing)


def print_comparison(console: Console, comparison: MethodComparison, title: str) -> None:
    """Print the table of methods and the paired differences."""
    console.print(make_terminal_table(comparison.rows, title))
    if comparison.footer:
        console.print(comparison.footer, highlight=False, soft_wrap=True)
    if comparison.has_several_scenarios and comparison.differences:
        console.print()
        console.print(make_differences_table(comparison.differences))
