# SPDX-License-Identifier: Apache-2.0
"""Results of a comparison of methods: rows, paired differences, and both as plain values for JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console

from manyeyes.datasets.missing import NONE_MISSING, MissingFiles
from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS, MethodResult
from manyeyes.evaluation.detection.communication import Communication
from manyeyes.evaluation.detection.protocols import DetectionProtocol
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Comparison, compare_methods
from manyeyes.evaluation.statistics.operating_point import OperatingPoint
from manyeyes.viz.answer_table import NOTE, AnswerRow, format_answer_markdown, make_answer_rows, make_answer_table
from manyeyes.viz.operating_table import (
    OperatingRow,
    format_operating_markdown,
    format_operating_note,
    make_operating_rows,
    make_operating_table,
)
from manyeyes.viz.table import (
    DIFFERENCE_HEADINGS,
    MethodRow,
    format_difference_cells,
    format_markdown,
    format_markdown_lines,
    make_differences_table,
    make_row,
    make_terminal_table,
    missing_footer,
)


@dataclass(frozen=True)
class ApSummary:
    """AP at one IoU threshold. ap: by the protocol; ap_legacy: over concatenated frames; recall, precision: at its score
    threshold.
    """

    iou: float
    ap: Interval
    ap_global: float
    ap_legacy: Interval
    recall: float
    precision: float
    n_gt: int
    n_detections: int


@dataclass(frozen=True)
class MethodStats:
    """Metrics of one method and class, without its frames. best_threshold: the score of greatest F on these data, for others.
    resamples: AP on each resample of the scenarios, rounded, for each IoU threshold.
    """

    method: str
    class_name: str
    ap_summaries: tuple[ApSummary, ...]
    communication: Communication
    age_ms: float
    share_ms: float
    perceive_ms: float
    operating_point: OperatingPoint | None
    best_threshold: float | None
    resamples: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class MethodComparison:
    """Comparison of methods. protocol: rules and range of AP. missing: missing files of the recording. operating_rows: methods at
    their score thresholds. answer_rows: methods at the time of their answer. scenarios: in the order that resamples draw them.
    training_seed: of the weights, where they state it.
    """

    protocol: DetectionProtocol
    stats: tuple[MethodStats, ...]
    rows: tuple[MethodRow, ...]
    differences: tuple[Comparison, ...]
    missing: MissingFiles = NONE_MISSING
    operating_rows: tuple[OperatingRow, ...] = ()
    answer_rows: tuple[AnswerRow, ...] = ()
    scenarios: tuple[str, ...] = ()
    training_seed: int | None = None

    @property
    def footer(self) -> str:
        """Format the note on missing files; empty where there are none."""
        return missing_footer(self.missing.count)

    @property
    def has_several_scenarios(self) -> bool:
        """Whether there is more than one scenario to compare over."""
        return any(number.ap_summaries[0].ap.num_scenarios > 1 for number in self.stats)


def summarize_comparison(
    results: Sequence[MethodResult],
    protocol: DetectionProtocol,
    missing: MissingFiles = NONE_MISSING,
    training_seed: int | None = None,
) -> MethodComparison:
    """Summarize measured methods: rows, metrics and paired differences."""
    frames = results[0].ap[0].frames if results else ()
    scenarios = tuple(dict.fromkeys(frame.scenario for frame in frames))
    stats = tuple(map(_summarize_method, results))
    rows = tuple(make_row(result) for result in results)
    differences = compare_methods(results, protocol)
    operating_rows, answer_rows = make_operating_rows(results), make_answer_rows(results)
    return MethodComparison(
        protocol, stats, rows, differences, missing, operating_rows, answer_rows, scenarios, training_seed
    )


def _summarize_method(result: MethodResult) -> MethodStats:
    columns = zip(IOU_THRESHOLDS, result.intervals, result.legacy_intervals, result.ap)
    ap_summaries = tuple(
        ApSummary(iou, interval, ap.ap_global, legacy, ap.recall, ap.precision, ap.n_gt, ap.n_detections)
        for iou, interval, legacy, ap in columns
    )
    return MethodStats(
        result.method,
        result.class_name,
        ap_summaries,
        result.communication,
        result.age_ms,
        result.share_ms,
        result.perceive_ms,
        result.operating_point,
        result.best_threshold,
        tuple(tuple(round(value, 5) for value in row) for row in result.resamples),
    )


def print_comparison(console: Console, comparison: MethodComparison, title: str) -> None:
    """Print the table of methods and the paired differences."""
    console.print(make_terminal_table(comparison.rows, title))
    if comparison.operating_rows:
        console.print()
        console.print(make_operating_table(comparison.operating_rows))
        note = format_operating_note(comparison.operating_rows, comparison.protocol.score_threshold)
        console.print(note, highlight=False, soft_wrap=True)
    if comparison.answer_rows:
        console.print()
        console.print(make_answer_table(comparison.answer_rows))
        console.print(NOTE, highlight=False, soft_wrap=True)
    if comparison.footer:
        console.print(comparison.footer, highlight=False, soft_wrap=True)
    if comparison.has_several_scenarios and comparison.differences:
        console.print()
        console.print(make_differences_table(comparison.differences))


def format_comparison_markdown(comparison: MethodComparison) -> str:
    """Format the tables of methods, of their operating points and of paired differences."""
    parts = [format_markdown(comparison.rows)]
    if comparison.operating_rows:
        parts.append(format_operating_markdown(comparison.operating_rows, comparison.protocol.score_threshold))
    if comparison.answer_rows:
        parts.append(format_answer_markdown(comparison.answer_rows))
    if comparison.differences:
        parts.append(
            format_markdown_lines([DIFFERENCE_HEADINGS, *map(format_difference_cells, comparison.differences)])
        )
    if comparison.footer:
        parts.append(f"{comparison.footer}\n")
    return "\n".join(parts)
