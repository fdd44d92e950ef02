# SPDX-License-Identifier: Apache-2.0
"""Tables of methods for the terminal, Markdown and JSON, and the words of columns; unmeasured values read "not run"."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from manyeyes.datatypes import VEHICLES
from manyeyes.evaluation.detection.accumulator import MethodResult
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Comparison

NOT_RUN, TERMINAL_WIDTH = "not run", 80
# Words of columns that several tables have.
LOG2_BYTES, DATA_AGE, AP_DIFFERENCE = "log2(bytes)", "data age [ms]", "ΔAP [95 % CI]"
AP_CROSSING, AP_DIVIDER, AP_BOUNDARY = "AP crossing", "AP divider", "AP boundary"

Lines = list[tuple[str, ...]]


@dataclass(frozen=True)
class StoredTable:
    """A table of a document. name: by which a marker selects it; lines: headings first."""

    name: str
    title: str
    lines: Lines


@dataclass(frozen=True)
class MethodRow:
    """Metrics of one method on one set of drives.

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
    class_name: str = VEHICLES[0]

    @property
    def log2_bytes(self) -> float | None:
        """Compute the base-2 logarithm of the bytes per message."""
        return math.log2(self.bytes_per_message) if self.bytes_per_message else None


def make_row(result: MethodResult) -> MethodRow:
    """Make the row of a measured method; without messages it has 0 bytes."""
    return MethodRow(
        result.method,
        result.intervals[0],
        result.intervals[1],
        result.communication.bytes_per_message if result.communication.num_messages else 0.0,
        result.age_ms,
        result.share_ms,
        result.perceive_ms,
        result.class_name,
    )


HEADINGS = (
    "method", "AP@0.5", "AP@0.7", "bytes/message", LOG2_BYTES, DATA_AGE, "share [ms]", "perceive [ms]",
)  # fmt: skip
DIFFERENCE_HEADINGS = ("paired difference", "metric", AP_DIFFERENCE)


def format_cells(row: MethodRow) -> tuple[str, ...]:
    """Format a row in the order of HEADINGS."""
    return (
        row.method,
        format_interval(row.ap50),
        format_interval(row.ap70),
        _format_number(row.bytes_per_message, 0),
        "-" if row.bytes_per_message == 0 else _format_number(row.log2_bytes, 2),
        "-" if row.bytes_per_message == 0 else _format_number(row.age_ms, 0),
        "-" if row.bytes_per_message == 0 else _format_number(row.share_ms, 1),
        _format_number(row.perceive_ms, 1),
    )


def format_lines(rows: Sequence[MethodRow]) -> list[tuple[str, ...]]:
    """Format the headings and the rows of methods; a column of classes where there are several."""
    return add_class_column([HEADINGS, *map(format_cells, rows)], [row.class_name for row in rows])


def add_class_column(lines: Sequence[tuple[str, ...]], class_names: Sequence[str]) -> list[tuple[str, ...]]:
    """Return lines, the first of them headings, with the class of each further one behind its first cell; unchanged where there is
    one class.
    """
    if len(set(class_names)) < 2:
        return list(lines)
    return [(line[0], name, *line[1:]) for line, name in zip(lines, ("class", *class_names), strict=True)]


def make_table(
    title: str, headings: Sequence[str], lines: Sequence[Sequence[str]], num_left: int = 1
) -> RenderableType:
    """Create a table for the terminal: headings are folded where space is short, numbers never; a table that is wider than 80
    columns continues below, with its columns of text again.

    Args:
        title: above the table; empty for none.
        headings: of the columns.
        lines: cells as text.
        num_left: number of columns of text, aligned left, whose cells wrap at spaces.
    """
    widths = _find_widths(headings, lines, num_left)
    blocks = [list(range(num_left))]
    for column in range(num_left, len(widths)):
        if sum(widths[c] + 1 for c in blocks[-1]) + widths[column] > TERMINAL_WIDTH:
            blocks.append(list(range(num_left)))
        blocks[-1].append(column)
    parts: list[RenderableType] = []
    for block in blocks:
        heading = title if title and not parts else None
        table = Table(
            title=heading, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=0
        )
        for column in block:
            justify = "left" if column < num_left else "right"
            table.add_column(Text(headings[column]), justify=justify, overflow="fold", width=widths[column])
        for line in lines:
            table.add_row(*(Text(line[column]) for column in block))
        parts += ["", table] if parts else [table]
    return Group(*parts)


def _find_widths(headings: Sequence[str], lines: Sequence[Sequence[str]], num_left: int) -> list[int]:
    """Find the widths of columns: words of cells and all numbers fit; as far as 80 columns allow words of headings, cells of text
    and headings fit, too.
    """
    columns = [[line[column] for line in lines] for column in range(len(headings))]
    widths = [_max_length(cells, None if column < num_left else "\n") for column, cells in enumerate(columns)]
    words = [_max_length([heading], None) for heading in headings]
    if sum(widths) + len(widths) > TERMINAL_WIDTH:
        return list(map(max, widths, words))
    for wanted in (
        words,
        [_max_length(cells, "\n") for cells in columns],
        [_max_length([heading], "\n") for heading in headings],
    ):
        while sum(widths) + len(widths) < TERMINAL_WIDTH and any(want > width for want, width in zip(wanted, widths)):
            widths[max(range(len(widths)), key=lambda column: wanted[column] - widths[column])] += 1
    return widths


def _max_length(texts: Sequence[str], separator: str | None) -> int:
    """Return the length of the longest part of texts; separator None: any white space."""
    return max((len(part) for text in texts for part in text.split(separator)), default=1)


def make_terminal_table(rows: Sequence[MethodRow], title: str = "") -> RenderableType:
    """Create the table of methods for 80 columns: units and intervals are on a second line."""
    names, *lines = format_lines(rows)
    headings = [heading.replace("/", "/\n").replace("(", "\n(").replace(" [", "\n[") for heading in names]
    num_left = 1 + len(names) - len(HEADINGS)
    return make_table(title, headings, [[split_intervals(cell) for cell in line] for line in lines], num_left)


def format_markdown(rows: Sequence[MethodRow]) -> str:
    """Format the table of methods as aligned Markdown."""
    return format_markdown_lines(format_lines(rows))


def missing_footer(count: int, listed_in: str = "results.json") -> str:
    """Format the footer of a table whose recording lacks files; empty where it lacks none."""
    if not count:
        return ""
    files = "1 file" if count == 1 else f"{count:,} files"
    return f"{files} missing or mismatched: the ground truth and all rows are affected; see {listed_in}."


def make_differences_table(differences: Sequence[Comparison]) -> RenderableType:
    """Create the table of paired differences for the terminal."""
    return make_table("", DIFFERENCE_HEADINGS, [format_difference_cells(difference) for difference in differences])


def format_difference_cells(difference: Comparison) -> tuple[str, ...]:
    """Format a paired difference in the order of DIFFERENCE_HEADINGS."""
    value = difference.interval
    spread = f" [{value.low:+.3f}, {value.high:+.3f}]" if value.num_scenarios > 1 else ""
    return difference.description, difference.metric, f"{value.value:+.3f}{spread}"


def format_markdown_lines(body: Sequence[Sequence[str]]) -> str:
    """Format aligned Markdown; the first line is the heading, the first column is aligned left."""
    widths = [max(len(line[i]) for line in body) for i in range(len(body[0]))]
    text = [
        "| " + " | ".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths))) + " |"
        for line in body
    ]
    rule = "|" + "|".join("-" * (w + 2) if i == 0 else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    return "\n".join((text[0], rule, *text[1:])) + "\n"


def split_intervals(cell: str) -> str:
    """Return a cell with its interval on a second line."""
    value, bracket, interval = cell.partition(" [")
    return f"{value}\n{interval.rstrip(']').replace(', ', '-')}" if bracket else cell


def format_interval(value: Interval | None) -> str:
    """Format a number with its interval."""
    if value is None:
        return NOT_RUN
    if math.isnan(value.value):
        return "no object"
    if value.num_scenarios < 2:
        return f"{value.value:.3f}"
    return f"{value.value:.3f} [{value.low:.3f}, {value.high:.3f}]"


def _format_number(value: float | None, digits: int) -> str:
    return NOT_RUN if value is None or math.isnan(value) else f"{value:,.{digits}f}"
