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
from manyeyes.evaluation.statistics.comparison import PairedDifference, compare_methods
from manyeyes.viz.table import MethodRow, make_differences_table, make_row, make_terminal_table, missing_footer

MAX_MESSAGE_BYTES = 1 << 17
NO_FUSION_AP_RANGE = (0.50, 0.85)


@dataclass(frozen=True)
class ApSummary:
    """AP at one IoU threshold. ap is the protocol's own; recall and precision stand at its score threshold."""

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
    """All numbers of one method, without the frames behind them."""

    method: str
    ap_summaries: tuple[ApSummary, ...]
    communication: Communication
    age_ms: float
    share_ms: float
    perceive_ms: float


@dataclass(frozen=True)
class MethodComparison:
    """A comparison, ready to be shown. protocol: whose rules AP follows, over which range. missing: files of the recording."""

    protocol: DetectionProtocol
    stats: tuple[MethodStats, ...]
    rows: tuple[MethodRow, ...]
    differences: tuple[PairedDifference, ...]
    checks: tuple[str, ...]
    missing: MissingFiles = NONE_MISSING

    @property
    def footer(self) -> str:
        """What a reader of the table must know of missing files; empty where there are none."""
        return missing_footer(self.missing.count)

    @property
    def has_several_scenarios(self) -> bool:
        """Whether there are scenarios enough to compare over; one drive resolves nothing."""
        return any(number.ap_summaries[0].ap.num_scenarios > 1 for number in self.stats)


def summarize_comparison(
    results: Sequence[MethodResult], protocol: DetectionProtocol, missing: MissingFiles = NONE_MISSING
) -> MethodComparison:
    """The outcome of measured methods."""
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
    return MethodComparison(
        protocol, tuple(stats), rows, compare_methods(results, protocol), _check_targets(rows), missing
    )


def print_comparison(console: Console, comparison: MethodComparison, title: str) -> None:
    """Table, differences and checks in the terminal."""
    console.print(make_terminal_table(comparison.rows, title))
    if comparison.footer:
        console.print(comparison.footer, highlight=False, soft_wrap=True)
    if not comparison.has_several_scenarios:
        return
    if comparison.differences:
        console.print()
        console.print(make_differences_table(comparison.differences))
    for check in comparison.checks:
        console.print(check, highlight=False, soft_wrap=True)


def _check_targets(rows: Sequence[MethodRow]) -> tuple[str, ...]:
    """Whether messages are small enough, and whether the drives are neither too easy nor too hard to tell methods apart."""
    by_name = {row.method: row for row in rows}
    out = []
    fused, no_fusion = by_name.get("intermediate"), by_name.get("none")
    if fused and fused.bytes_per_message is not None:
        verdict = "met" if fused.bytes_per_message <= MAX_MESSAGE_BYTES else "not met"
        out.append(
            f"intermediate: {fused.bytes_per_message:,.0f} bytes a message, at most {MAX_MESSAGE_BYTES:,}: {verdict}"
        )
    if no_fusion and no_fusion.ap50 is not None:
        low, high = NO_FUSION_AP_RANGE
        verdict = "met" if low <= no_fusion.ap50.value <= high else "not met"
        out.append(f"none: AP@0.5 {no_fusion.ap50.value:.3f} between {low:.2f} and {high:.2f}: {verdict}")
    return tuple(out)
