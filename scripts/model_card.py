# SPDX-License-Identifier: Apache-2.0
"""Write the tables of a model card from stored results, between two markers in its Markdown file.

python scripts/model_card.py src/manyeyes/models/weights/costr-small.md benchmarks/results/costr-small [--check]

Reads every .json of 'manyeyes evaluate', 'manyeyes study sensors', 'manyeyes study strata' and 'benchmarks/unseen_scenes.py' in the
folder, in the order of names; under each table stands the command that made it. With --check nothing is written, and the exit code
is 1 where the file differs from its results.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from manyeyes._io import atomic_write_text
from manyeyes.viz.table import format_markdown_lines

BEGIN, END = "<!-- results: scripts/model_card.py -->", "<!-- end of results -->"
Lines = list[tuple[str, ...]]


def format_interval(interval: dict[str, Any] | None, spec: str = ".3f") -> str:
    """Format a stored number with its interval; "-" where there is none."""
    if interval is None or interval["value"] is None or math.isnan(interval["value"]):
        return "-"
    text = f"{interval['value']:{spec}}"
    return f"{text} [{interval['low']:{spec}}, {interval['high']:{spec}}]" if interval["num_scenarios"] > 1 else text


def format_bytes(number: float | None) -> str:
    """Format bytes per message; "-" where nothing is sent."""
    return f"{number:,.0f}" if number else "-"


def make_evaluation(result: dict[str, Any]) -> list[tuple[str, Lines]]:
    """Tabulate methods of an evaluation, and their differences."""
    rows: Lines = [("method", "AP@0.5", "AP@0.7", "bytes/message")]
    for row in result["rows"]:
        ap = (format_interval(row["ap50"]), format_interval(row["ap70"]))
        rows.append((row["method"], *ap, format_bytes(row["bytes_per_message"])))
    return [("Methods", rows)]


def make_strata(result: dict[str, Any]) -> list[tuple[str, Lines]]:
    """Tabulate methods of each stratum."""
    rows: Lines = [("stratum", "method", "scenarios", "AP@0.5", "AP@0.7", "bytes/message")]
    for row in result["rows"]:
        ap = tuple(map(format_interval, row["ap"]))
        rows.append(
            (row["stratum"], row["method"], str(row["num_scenarios"]), *ap, format_bytes(row["bytes_per_message"]))
        )
    return [("Strata", rows)]


def make_sensors(result: dict[str, Any]) -> list[tuple[str, Lines]]:
    """Tabulate AP@0.5 of each method: laws down, sensors and numbers of sweeps across."""
    tables = []
    for method in dict.fromkeys(row["method"] for row in result["rows"]):
        mine = [row for row in result["rows"] if row["method"] == method]
        cells = {(row["law"], _name_column(row)): row["ap"][0] for row in mine}
        laws, columns = (list(dict.fromkeys(names)) for names in zip(*cells))
        lines: Lines = [("intensity", *columns)]
        lines += [(law, *(format_interval(cells.get((law, column))) for column in columns)) for law in laws]
        tables.append((f"AP@0.5 by sensor, {method}", lines))
    return tables


def _name_column(row: dict[str, Any]) -> str:
    tilt = f", tilt {row['tilt_deg']:g}°" if row["tilt_deg"] else ""
    return f"{row['recording']}, {row['sweeps']} sweep{'s' if row['sweeps'] > 1 else ''}{tilt}"


def make_cases(result: dict[str, Any]) -> list[tuple[str, Lines]]:
    """Tabulate counts of recordings of other makers and of hard scenes."""
    lines: Lines = [
        ("recording", "frames", "vehicles", "matched at IoU 0.5", "false boxes above the limit", "under crowns")
    ]
    for case in result["cases"]:
        crowns = f"{case['matched_under_crowns']} of {case['under_crowns']}" if case["under_crowns"] else "-"
        numbers = (case["frames"], case["vehicles"], case["matched"], case["false_boxes"])
        lines.append((case["case"], *(f"{n:,}" for n in numbers), crowns))
    return [("Real recordings and hard scenes, each agent alone", lines)]


def make_tables(stored: dict[str, Any], name: str) -> list[tuple[str, Lines]]:
    """Make the tables of one file by what it holds.

    Raises:
        ValueError: it is of none of the known commands.
    """
    result = stored["result"]
    if result.get("study") == "sensors":
        return make_sensors(result)
    if result.get("study") == "strata":
        return make_strata(result)
    if "cases" in result:
        return make_cases(result)
    if "stats" in result and "rows" in result:
        return make_evaluation(result)
    raise ValueError(
        f"{name}: no result of evaluate, study sensors, study strata or unseen_scenes.py; move it elsewhere."
    )


def make_section(files: Sequence[Path]) -> str:
    """Make the text between the markers."""
    parts = []
    for path in files:
        stored = json.loads(path.read_text(encoding="utf-8"))
        origin = stored["provenance"]
        command = stored["result"].get("command", origin["command"])
        for title, lines in make_tables(stored, path.name):
            parts.append(f"**{title}**\n\n{format_markdown_lines(lines)}")
        parts.append(f"`{command}`, commit {(origin['git_commit'] or 'unknown')[:12]}.\n")
    return "\n".join(parts)


def insert_section(card: str, section: str) -> str:
    """Return the card with the section between its markers; at its end where it has none."""
    block = f"{BEGIN}\n\n{section}\n{END}\n"
    before, begin, rest = card.partition(BEGIN)
    if not begin:
        return f"{card.rstrip()}\n\n{block}"
    _, end, after = rest.partition(END)
    if not end:
        raise ValueError(f"The card has the marker {BEGIN} without {END}; add the second one.")
    return f"{before}{block}{after.lstrip(chr(10)) and chr(10) + after.lstrip(chr(10))}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write or check a card; the exit code is 1 after an error or where it differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("card", type=Path, help="the Markdown file beside the weights")
    parser.add_argument("results", type=Path, help="the folder of .json files")
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    options = parser.parse_args(arguments)
    files = sorted(options.results.glob("*.json"))
    if not files:
        parser.error(f"{options.results}: no .json file of results")
    try:
        card = options.card.read_text(encoding="utf-8")
        written = insert_section(card, make_section(files))
    except (ValueError, KeyError, OSError) as error:
        sys.stderr.write(f"model_card: {error}\n")
        return 1
    if options.check:
        if written != card:
            sys.stderr.write(f"model_card: {options.card} differs from {options.results}; run without --check.\n")
        return int(written != card)
    atomic_write_text(options.card, written)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
