# SPDX-License-Identifier: Apache-2.0
"""Table and file of the summaries of live runs."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from manyeyes._io import atomic_write_text
from manyeyes.runtime.summary import Quantiles, RunSummary
from manyeyes.studies.provenance import to_plain


def save_summary(path: Path, summary: RunSummary) -> None:
    """Write a summary as JSON."""
    atomic_write_text(path, json.dumps(to_plain(summary), indent=2) + "\n")


def load_summary(path: Path) -> RunSummary:
    """Read a summary of :func:`save_summary`."""
    values = json.loads(path.read_text())
    for name in ("age", "latency", "share", "wait", "perceive"):
        numbers = values[name].values()
        values[name] = Quantiles(*(float("nan") if number is None else number for number in numbers))
    return RunSummary(**values)


def print_summaries(summaries: Sequence[RunSummary], console: Console) -> None:
    """Print one row for each agent, then its refused packets and its events. Ages and boxes: p50/p95, milliseconds."""
    table = Table(box=None, pad_edge=False)
    heads = ("agent", "frames", "skipped", "B/frame", "fused", "age [ms]", "boxes [ms]", "missed", "level")
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)
    for one in summaries:
        frames = max(one.frames, 1)
        levels = [level for level, count in enumerate(one.level_frames) if count] or [0]
        table.add_row(
            str(one.agent_id),
            str(one.frames),
            str(one.skipped),
            f"{one.sent_bytes / frames:.0f}",
            f"{one.fused / frames:.2f}",
            _format(one.age),
            _format(one.latency),
            f"{one.missed / frames:.0%}",
            "-".join(str(level) for level in dict.fromkeys((levels[0], levels[-1]))),
        )
    console.print(table)
    for one in summaries:
        rejected = ", ".join(f"{name} {count}" for name, count in one.dropped.items())
        for note in (*([f"rejected packets: {rejected}"] if rejected else []), *one.notes):
            console.print(f"agent {one.agent_id}: {note}", highlight=False, markup=False, soft_wrap=True)


def _format(quantiles: Quantiles) -> str:
    return "-" if math.isnan(quantiles.p50_ms) else f"{quantiles.p50_ms:.0f}/{quantiles.p95_ms:.0f}"
