# SPDX-License-Identifier: Apache-2.0
"""Table of AP at the ego's sweep beside AP at the time of its answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import RenderableType

from manyeyes.evaluation.detection.accumulator import MethodResult
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.viz.table import add_class_column, format_interval, format_markdown_lines, make_table, split_intervals

HEADINGS = (
    "method", "answer after [ms]", "AP@0.5 at sweep", "AP@0.5 at answer", "AP@0.7 at sweep", "AP@0.7 at answer",
)  # fmt: skip
TITLE = "At the time of the answer"
NOTE = (
    "Answer: sweep + wait for messages + compute time, a constant of each method; boxes are moved by their velocity, and the truth "
    "is that of the answer."
)


@dataclass(frozen=True)
class AnswerRow:
    """A method and class: AP at both IoU thresholds at the sweep and at the answer, which comes answer_ms later."""

    method: str
    class_name: str
    answer_ms: float
    sweep_ap: tuple[Interval, ...]
    answer_ap: tuple[Interval, ...]


def make_answer_rows(results: Sequence[MethodResult]) -> tuple[AnswerRow, ...]:
    """Make the rows of methods whose answers were judged."""
    return tuple(
        AnswerRow(result.method, result.class_name, result.answer_ms, result.intervals, result.answer_intervals)
        for result in results
        if result.answer_intervals
    )


def format_answer_lines(rows: Sequence[AnswerRow]) -> list[tuple[str, ...]]:
    """Format headings and rows; a column of classes where there are several."""
    lines = [HEADINGS, *map(_format_cells, rows)]
    return add_class_column(lines, [row.class_name for row in rows])


def make_answer_table(rows: Sequence[AnswerRow]) -> RenderableType:
    """Create the table for the terminal."""
    headings, *lines = format_answer_lines(rows)
    body = [[split_intervals(cell) for cell in line] for line in lines]
    return make_table(TITLE, headings, body, num_left=1 + len(headings) - len(HEADINGS))


def format_answer_markdown(rows: Sequence[AnswerRow]) -> str:
    """Format the table and its note as Markdown."""
    return f"{format_markdown_lines(format_answer_lines(rows))}\n{NOTE}\n"


def _format_cells(row: AnswerRow) -> tuple[str, ...]:
    pairs = (interval for pair in zip(row.sweep_ap, row.answer_ap) for interval in pair)
    return row.method, f"{row.answer_ms:.0f}", *map(format_interval, pairs)
