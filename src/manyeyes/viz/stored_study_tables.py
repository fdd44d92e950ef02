# SPDX-License-Identifier: Apache-2.0
"""Tables of stored studies for documents: narrow ones of the main table and of robustness, and those that a study printed."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

from manyeyes.viz.table import Lines, StoredTable

_CLEAN = "clean"


def make_printed_tables(result: dict[str, Any]) -> list[StoredTable]:
    """Return the tables that a study printed; their names are their titles in lower case, with hyphens."""
    return [
        StoredTable(
            _make_name(table["title"]), table["title"], [tuple(line) for line in (table["headings"], *table["lines"])]
        )
        for table in result["tables"]
    ]


def make_main_tables(result: dict[str, Any]) -> list[StoredTable]:
    """Return a table of AP@0.5 and one of AP@0.7 for each channel and pose corrector, methods by disturbances, and one of costs.

    Names: ``ap50-CHANNEL-CORRECTOR``, ``ap70-CHANNEL-CORRECTOR``, ``operating-point``, ``cost``; then those that the study printed.
    """
    rows, out = result["rows"], list[StoredTable]()
    alone = [row for row in rows if row["channel"] == "any channel"]
    settings = dict.fromkeys((r["channel"], r["corrector"]) for r in rows if r["channel"] != "any channel")
    for channel, corrector in settings:
        played = [row for row in rows if (row["channel"], row["corrector"]) == (channel, corrector)]
        for iou, name in enumerate(("AP@0.5", "AP@0.7")):
            title = f"{name} at the answer, channel {channel}, pose corrector {corrector}"
            code = f"ap{'57'[iou]}0-{channel}-{corrector}"
            out.append(StoredTable(code, title, _cross(alone, played, iou)))
    clean = [row for row in rows if name_perturbation(row["perturbation"]) == _CLEAN and row["corrector"] == "off"]
    first = next((row["channel"] for row in clean if row["channel"] != "any channel"), "")
    chosen = [row for row in clean if row["channel"] in (first, "any channel")]
    out += [_make_operating_points(chosen, first), _make_costs(chosen, first)]
    return out + make_printed_tables(result)


def _cross(alone: Sequence[dict[str, Any]], played: Sequence[dict[str, Any]], iou: int) -> list[tuple[str, ...]]:
    names = list(dict.fromkeys(name_perturbation(row["perturbation"]) for row in played))
    cells = {(r["method"], name_perturbation(r["perturbation"])): r["answer_ap"][iou] for r in played}
    lines = [("method", *names)]
    # No fusion receives nothing, hence is the same under every disturbance.
    lines += [(r["method"], *(format_stored_interval(r["answer_ap"][iou]) for _ in names)) for r in alone]
    for method in dict.fromkeys(row["method"] for row in played):
        lines.append((method, *(format_stored_interval(cells.get((method, name))) for name in names)))
    return lines


def _make_operating_points(rows: Sequence[dict[str, Any]], channel: str) -> StoredTable:
    names = ("precision", "recall", "f_score", "false_alarms_per_frame", "duplicates_per_object")
    lines = [("method", "legacy AP@0.5", "precision", "recall", "F", "false alarms/frame", "duplicates/object")]
    lines += [
        (r["method"], *(format_stored_interval(v) for v in (r["legacy_ap"][0], *(r["point"][name] for name in names))))
        for r in rows
    ]
    return StoredTable("operating-point", f"At one score threshold, nothing wrong, channel {channel}", lines)


def _make_costs(rows: Sequence[dict[str, Any]], channel: str) -> StoredTable:
    lines: Lines = [
        (
            "method", "bytes/message", "bytes, paper's count", "data age [ms]", "answer after [ms]", "CPU time/step [ms]",
            "parameters of fusion", "parameters",
        )
    ]  # fmt: skip
    for row in rows:
        size = row["parameters"]
        numbers = [row[name] for name in ("bytes_per_message", "paper_bytes", "age_ms", "answer_ms", "compute_ms")]
        lines.append((row["method"], *map(_format_number, (*numbers, size["fusion"], size["whole"]))))
    return StoredTable("cost", f"Cost, nothing wrong, channel {channel}", lines)


def make_robustness_tables(result: dict[str, Any]) -> list[StoredTable]:
    """Return AP of perturbations by methods, without and with memory, named ``robustness`` and ``robustness-temporal`` at IoU 0.5,
    with ``-ap70`` at 0.7; then the tables that the study printed.
    """
    out = []
    for form, end in (("without memory", ""), ("with memory", "-temporal")):
        rows = [r for r in result["rows"] if r["method"].endswith("-temporal") == bool(end)]
        methods = list(dict.fromkeys(row["method"] for row in rows))
        for iou, name in enumerate(("AP@0.5", "AP@0.7")) if rows else ():
            cells = {(name_perturbation(r["perturbation"]), r["method"]): r["ap"][iou] for r in rows}
            lines = [("perturbation", *(method.removesuffix("-temporal") for method in methods))]
            lines += [
                (level, *(format_stored_interval(cells.get((level, method))) for method in methods))
                for level in dict.fromkeys(level for level, _ in cells)
            ]
            code = f"robustness{end}{'-ap70' * iou}"
            out.append(StoredTable(code, f"{name} under perturbations, {form}", lines))
    return out + (make_printed_tables(result) if "tables" in result else [])


def name_perturbation(perturbation: dict[str, Any]) -> str:
    """Return the name of a stored perturbation, as tables of studies have it."""
    parts = (
        (perturbation["delay_s"], f"{perturbation['delay_s']:g} s"),
        (perturbation["heading_sigma_deg"], f"{perturbation['heading_sigma_deg']:g}°"),
        (perturbation["position_sigma_m"], f"{perturbation['position_sigma_m']:g} m"),
        (perturbation["packet_loss"], f"{100 * perturbation['packet_loss']:g} % loss"),
    )
    return ", ".join(text for level, text in parts if level) or _CLEAN


def format_stored_interval(interval: dict[str, Any] | None, spec: str = ".3f") -> str:
    """Format a stored number with its interval; "-" where there is none."""
    if interval is None or interval["value"] is None or math.isnan(interval["value"]):
        return "-"
    text = f"{interval['value']:{spec}}"
    return f"{text} [{interval['low']:{spec}}, {interval['high']:{spec}}]" if interval["num_scenarios"] > 1 else text


def _format_number(number: float | None) -> str:
    return "-" if number is None else f"{number:,.0f}"


def _make_name(title: str) -> str:
    return "-".join(re.findall(r"[a-z0-9.]+", title.lower()))
