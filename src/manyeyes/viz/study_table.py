# SPDX-License-Identifier: Apache-2.0
"""Tables of studies: numbers and intervals as text, for the terminal and for Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import RenderableType

from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.viz.table import NOT_RUN, format_markdown_lines, make_table

_MAX_NARROW_COLUMNS = 6


@dataclass(frozen=True)
class StudyTable:
    """One table: a title, headings, and lines of text as wide as the headings."""

    title: str
    headings: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]


def make_terminal_table(study_table: StudyTable) -> RenderableType:
    """Create the table for a terminal; a wide one leaves the intervals to the document."""
    wide = len(study_table.headings) > _MAX_NARROW_COLUMNS
    lines = [[cell.partition(" [")[0] if wide else cell for cell in line] for line in study_table.lines]
    return make_table(study_table.title, study_table.headings, lines, num_left=2)


def make_comparison_table(comparisons: Sequence[Comparison], resampled_unit: str = "scenarios") -> StudyTable:
    """Tabulate comparisons; resampled_unit: what is drawn with replacement."""
    lines = tuple((c.description, c.metric, format_difference(c.interval)) for c in comparisons)
    title = f"Differences, paired over {resampled_unit}"
    return StudyTable(title, ("difference", "metric", "value [95 % CI]"), lines)


def format_markdown(study_table: StudyTable) -> str:
    """Format a table as Markdown."""
    return f"## {study_table.title}\n\n{format_markdown_lines([study_table.headings, *study_table.lines])}"


def format_interval(interval: Interval | None) -> str:
    """Format a number with its interval: ``0.912 [0.900, 0.923]``."""
    return _format_text(interval, ".3f")


def format_difference(interval: Interval | None) -> str:
    """Format a difference with its interval and signs."""
    return _format_text(interval, "+.3f")


def format_number(number: float | None, digits: int = 0) -> str:
    """Format a number; nothing for none."""
    return "" if number is None or math.isnan(number) else f"{number:,.{digits}f}"


def format_log2(num_bytes: float) -> str:
    """Format the base-2 logarithm of a number of bytes; nothing for 0."""
    return f"{math.log2(num_bytes):.2f}" if num_bytes > 0 else ""


def _format_text(interval: Interval | None, format_spec: str) -> str:
    if interval is None:
        return ""
    if math.isnan(interval.value):
        return NOT_RUN if interval.num_scenarios == 0 else "no object"
    return f"{interval.value:{format_spec}}" + (
        f" [{interval.low:{format_spec}}, {interval.high:{format_spec}}]" if interval.num_scenarios > 1 else ""
    )
