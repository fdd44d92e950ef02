# SPDX-License-Identifier: Apache-2.0
"""Tables of studies: numbers and intervals as text, for the terminal and for Markdown."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rich import box
from rich.table import Table

from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.viz.table import NOT_RUN, markdown_lines

_NARROW = 6


@dataclass(frozen=True)
class Sheet:
    """One table: a title, headings, and lines of text as wide as the headings."""

    title: str
    headings: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]


def terminal(sheet: Sheet) -> Table:
    """The sheet for a terminal; a wide one leaves the intervals to the document."""
    table = Table(
        title=sheet.title,
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        show_edge=False,
        padding=(0, 1, 0, 0),
    )
    for column, heading in enumerate(sheet.headings):
        table.add_column(heading, justify="left" if column < 2 else "right", no_wrap=column < 2)
    wide = len(sheet.headings) > _NARROW
    for line in sheet.lines:
        table.add_row(*(cell.partition(" [")[0] if wide else cell for cell in line))
    return table


def markdown(sheet: Sheet) -> str:
    """The sheet for a document."""
    return f"## {sheet.title}\n\n{markdown_lines([sheet.headings, *sheet.lines])}"


def value(of: Interval | None) -> str:
    """A number with its interval: ``0.912 [0.900, 0.923]``."""
    return _text(of, ".3f")


def change(of: Interval | None) -> str:
    """A difference with its interval, signs shown."""
    return _text(of, "+.3f")


def number(of: float | None, digits: int = 0) -> str:
    """A plain number; nothing for none."""
    return "" if of is None or math.isnan(of) else f"{of:,.{digits}f}"


def log2(of: float) -> str:
    """The papers' "AB" of so many bytes; nothing for silence."""
    return f"{math.log2(of):.2f}" if of > 0 else ""


def _text(of: Interval | None, form: str) -> str:
    if of is None:
        return ""
    if math.isnan(of.value):
        return NOT_RUN if of.scenarios == 0 else "no object"
    return f"{of.value:{form}}" + (f" [{of.low:{form}}, {of.high:{form}}]" if of.scenarios > 1 else "")
