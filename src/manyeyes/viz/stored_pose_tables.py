# SPDX-License-Identifier: Apache-2.0
"""Tables of stored benchmarks of pose correction: lines of rates and means with their bounds, and rows of correctors."""

from __future__ import annotations

import math
import re
from typing import Any

from manyeyes.viz.table import NOT_RUN, Lines, StoredTable

_PERCENT = {"answered", "within_1m_1deg", "wrong", "null_answered"}


def is_pose_lines(result: dict[str, Any]) -> bool:
    """Return whether a result is lines of a benchmark (benchmarks/pose_real.py, Line)."""
    lines = result.get("lines")
    return bool(lines) and isinstance(lines, list) and {"what", "low", "high", "target"} <= lines[0].keys()


def is_pose_rows(result: dict[str, Any]) -> bool:
    """Return whether a result is rows of benchmarks/pose_global.py or pose_speed.py."""
    return str(result.get("benchmark", "")).startswith("pose_") and "rows" in result


def make_pose_lines(result: dict[str, Any]) -> list[StoredTable]:
    """Return a table for each first word of the lines, a row for each case and a column for each measure.

    A line is "CASE: MEASURE". A cell is the value, its bounds, and the target where it is not met.
    """
    groups: dict[str, dict[str, dict[str, dict[str, Any]]]] = {}
    for line in result["lines"]:
        case, _, measure = line["what"].rpartition(": ")
        word = re.search(r"[a-z]+", case)
        group = groups.setdefault(word.group() if word else "lines", {})
        group.setdefault(case, {})[measure] = line
    return [StoredTable(name, name.capitalize(), _cross(group)) for name, group in groups.items()]


def _cross(group: dict[str, dict[str, dict[str, Any]]]) -> Lines:
    measures = list(dict.fromkeys(measure for cells in group.values() for measure in cells))
    lines: Lines = [("case", *measures, "of")]
    for case, cells in group.items():
        count = max(line["count"] for line in cells.values())
        lines.append((case, *(_format_cell(cells.get(m)) for m in measures), f"{count:,}" if count else "-"))
    return lines


def _format_cell(line: dict[str, Any] | None) -> str:
    if line is None:
        return "-"
    if line["value"] is None or math.isnan(line["value"]):
        return NOT_RUN
    digits = 4 if 0 < line["high"] < 0.02 else 3
    text = f"{line['value']:.{digits}f}"
    if line["low"] != line["high"]:
        text += f" [{line['low']:.{digits}f}, {line['high']:.{digits}f}]"
    return f"{text} (not met: {line['target']})" if line["met"] is False else text


def make_pose_rows(result: dict[str, Any]) -> list[StoredTable]:
    """Return the table of rows, fractions in percent."""
    rows = result["rows"]
    names = list(rows[0])
    lines: Lines = [tuple(f"{n.replace('_', ' ')} [%]" if n in _PERCENT else n.replace("_", " ") for n in names)]
    lines += [tuple(_format_value(name, row[name]) for name in names) for row in rows]
    return [StoredTable("rows", result["benchmark"].replace("_", " ").capitalize(), lines)]


def _format_value(name: str, value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, float):
        return str(value)
    return f"{100 * value:.1f}" if name in _PERCENT else f"{value:.1f}" if name.endswith("ms") else f"{value:.2f}"
