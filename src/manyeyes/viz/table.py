# SPDX-License-Identifier: Apache-2.0
"""A benchmark's rows, for the terminal, for Markdown and for JSON; what was not measured reads "not run"."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rich import box
from rich.table import Table

from manyeyes.evaluation.detection.accumulator import MethodResult
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import PairedDifference

NOT_RUN = "not run"


@dataclass(frozen=True)
class MethodRow:
    """One method on one set of drives.

    ap50, ap70: average precision at rotated bird's-eye IoU 0.5 and 0.7. bytes_per_message: the mean length of what an
    agent sent at one instant, packets and headers included. age_ms: the mean age of received data when it was used.
    share_ms, perceive_ms: mean compute of one call. None: not measured.
    """

    method: str
    ap50: Interval | None = None
    ap70: Interval | None = None
    bytes_per_message: float | None = None
    age_ms: float | None = None
    share_ms: float | None = None
    perceive_ms: float | None = None

    @property
    def log2_bytes(self) -> float | None:
        """The papers' "AB": the base-2 logarithm of the bytes a message."""
        return math.log2(self.bytes_per_message) if self.bytes_per_message else None


def make_row(result: MethodResult) -> MethodRow:
    """The row of a measured method; without messages it has sent 0 bytes."""
    return MethodRow(
        result.method,
        result.intervals[0],
        result.intervals[1],
        result.communication.bytes_per_message if result.communication.num_messages else 0.0,
        result.age_ms,
        result.share_ms,
        result.perceive_ms,
    )


HEADINGS = ("method", "AP@0.5", "AP@0.7", "bytes/message", "AB log2", "age ms", "share ms", "perceive ms")


def format_cells(row: MethodRow) -> tuple[str, ...]:
    """A row as text, in the order of HEADINGS."""
    return (
        row.method,
        _format_interval(row.ap50),
        _format_interval(row.ap70),
        _format_number(row.bytes_per_message, 0),
        "-" if row.bytes_per_message == 0 else _format_number(row.log2_bytes, 2),
        "-" if row.bytes_per_message == 0 else _format_number(row.age_ms, 0),
        "-" if row.bytes_per_message == 0 else _format_number(row.share_ms, 1),
        _format_number(row.perceive_ms, 1),
    )


def make_terminal_table(rows: Sequence[MethodRow], title: str = "") -> Table:
    """The table for a terminal of 80 columns: units and intervals stand on a second line."""
    table = Table(title=title or None, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.padding = (0, 1, 0, 0)
    for heading in HEADINGS:
        words = heading.replace("/", "/ ").split(" ")
        table.add_column("\n".join(words), justify="left" if heading == "method" else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(_two_lines(cell) for cell in format_cells(row)))
    return table


def format_markdown(rows: Sequence[MethodRow]) -> str:
    """The table for a document, aligned."""
    return format_markdown_lines([HEADINGS, *(format_cells(row) for row in rows)])


def missing_footer(count: int, listed_in: str = "results.json") -> str:
    """The footer of a table whose recording lacks files; empty where it lacks none."""
    if not count:
        return ""
    files = "1 file" if count == 1 else f"{count:,} files"
    return f"{files} missing or mismatched: the ground truth and all rows are affected; see {listed_in}."


def make_differences_table(differences: Sequence[PairedDifference]) -> Table:
    """Paired differences for a terminal."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for heading in DIFFERENCE_HEADINGS:
        table.add_column(heading, justify="left" if heading in ("paired difference", "verdict") else "right")
    for difference in differences:
        table.add_row(*format_difference_cells(difference))
    return table


DIFFERENCE_HEADINGS = ("paired difference", "AP at IoU", "value, 95 % interval", "bar", "verdict")


def format_difference_cells(difference: PairedDifference) -> tuple[str, ...]:
    """A paired difference as text, in the order of DIFFERENCE_HEADINGS."""
    value = difference.interval
    spread = f" [{value.low:+.3f}, {value.high:+.3f}]" if value.num_scenarios > 1 else ""
    return (
        f"{difference.method} - {difference.baseline}",
        f"{difference.iou:g}",
        f"{value.value:+.3f}{spread}",
        "" if difference.margin is None else f"{difference.margin:.2f}",
        difference.verdict or "",
    )


def format_markdown_lines(body: Sequence[Sequence[str]]) -> str:
    """A Markdown table, aligned; the first line is the heading, the first column stands to the left."""
    widths = [max(len(line[i]) for line in body) for i in range(len(body[0]))]
    text = [
        "| " + " | ".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths))) + " |"
        for line in body
    ]
    rule = "|" + "|".join("-" * (w + 2) if i == 0 else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    return "\n".join((text[0], rule, *text[1:])) + "\n"


def _two_lines(cell: str) -> str:
    value, bracket, interval = cell.partition(" [")
    return f"{value}\n{interval.rstrip(']').replace('0.', '.').replace(', ', '-')}" if bracket else cell


def _format_interval(value: Interval | None) -> str:
    if value is None:
        return NOT_RUN
    if math.isnan(value.value):
        return "no object"
    if value.num_scenarios < 2:
        return f"{value.value:.3f}"
    return f"{value.value:.3f} [{value.low:.3f}, {value.high:.3f}]"


def _format_number(value: float | None, digits: int) -> str:
    return NOT_RUN if value is None or math.isnan(value) else f"{value:,.{digits}f}"
