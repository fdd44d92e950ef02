# SPDX-License-Identifier: Apache-2.0
"""Table of methods at one score threshold, with the legacy AP, whose value depends on the score threshold of the protocol."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import RenderableType

from manyeyes.evaluation.detection.accumulator import MethodResult
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.operating_point import OperatingPoint
from manyeyes.viz.table import add_class_column, format_interval, format_markdown_lines, make_table, split_intervals

SOURCES = {
    "weights": "of the card of the weights, chosen on validation data",
    "validation": "of greatest F on validation data (--thresholds)",
    "default": "default of weights without calibration, chosen for no method",
}
"""Text of a table for each source of thresholds."""
HEADINGS = (
    "method", "threshold", "precision", "recall", "F", "false alarms/frame", "duplicates/object", "legacy AP@0.5", "legacy AP@0.7",
)  # fmt: skip
_NARROW_HEADINGS = {
    "threshold": "thresh-\nold",
    "precision": "preci-\nsion",
    "false alarms/frame": "false\nalarms\n/frame",
    "duplicates/object": "dupli-\ncates\n/object",
    "legacy AP@0.5": "legacy\nAP@0.5",
    "legacy AP@0.7": "legacy\nAP@0.7",
}
"""Broken where they may be, so that methods and values without intervals fit 80 columns."""
TITLE = "At one score threshold, IoU 0.5"


@dataclass(frozen=True)
class OperatingRow:
    """A method and class at its threshold. legacy_ap: at both IoU thresholds, over all detections of the protocol."""

    method: str
    class_name: str
    point: OperatingPoint
    legacy_ap: tuple[Interval, ...]


def make_operating_rows(results: Sequence[MethodResult]) -> tuple[OperatingRow, ...]:
    """Make the rows of measured methods."""
    return tuple(
        OperatingRow(result.method, result.class_name, result.operating_point, result.legacy_intervals)
        for result in results
        if result.operating_point is not None
    )


def format_operating_lines(rows: Sequence[OperatingRow]) -> list[tuple[str, ...]]:
    """Format headings and rows; a column of classes where there are several."""
    lines = [HEADINGS, *map(_format_cells, rows)]
    return add_class_column(lines, [row.class_name for row in rows])


def format_operating_note(rows: Sequence[OperatingRow], score_threshold: float) -> str:
    """Format where the thresholds come from, and that of the legacy AP."""
    sources = dict.fromkeys(row.point.threshold.source for row in rows)
    parts = [f"Thresholds: {'; '.join(SOURCES[source] for source in sources)}."] if sources else []
    legacy = f"Legacy AP (frames not sorted, OpenCOOD): of detections with score above {score_threshold:g}."
    return " ".join((*parts, legacy))


def make_operating_table(rows: Sequence[OperatingRow]) -> RenderableType:
    """Create the table for the terminal."""
    headings, *lines = format_operating_lines(rows)
    has_classes = len(headings) > len(HEADINGS)
    body = [[split_intervals(cell) for cell in line] for line in lines]
    return make_table(
        TITLE,
        [_NARROW_HEADINGS.get(heading, heading) for heading in headings],
        body,
        num_left=2 if has_classes else 1,
    )


def format_operating_markdown(rows: Sequence[OperatingRow], score_threshold: float) -> str:
    """Format the table and its note as Markdown."""
    return f"{format_markdown_lines(format_operating_lines(rows))}\n{format_operating_note(rows, score_threshold)}\n"


def _format_cells(row: OperatingRow) -> tuple[str, ...]:
    point = row.point
    values = (
        point.precision, point.recall, point.f_score, point.false_alarms_per_frame, point.duplicates_per_object, *row.legacy_ap,
    )  # fmt: skip
    return row.method, f"{point.threshold.score:.3f}", *(format_interval(value) for value in values)
