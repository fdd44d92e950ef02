# SPDX-License-Identifier: Apache-2.0
"""Metrics and changes of one map as tables for the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.table import Table

from manyeyes.evaluation.maps.change_summary import KindChange
from manyeyes.evaluation.maps.metrics import MapMetrics
from manyeyes.viz.table import make_table

PROTOCOLS = ("exact", "maptr", "streammapnet")


def make_kinds_table(metrics: MapMetrics, title: str) -> Table:
    """Tabulate one map: a row for each kind that is predicted or true."""
    headings = (
        "kind", "AP exact", "AP MapTR", "AP StreamMapNet", "F1@0.3 m", "F1@0.5 m", "F1@1 m", "duplication", "fragmentation",
        "lateral error [m]", "predicted/true",
    )  # fmt: skip
    table = make_table(title, headings, wraps=True)
    for k in metrics.kinds:
        if k.n_predicted or k.n_truth:
            table.add_row(
                k.kind,
                *(_format_number(metrics.get_ap(k.kind, protocol)) for protocol in PROTOCOLS),
                *(_format_number(score.f1) for score in k.length_scores),
                *(_format_number(value, 2) for value in (k.duplication, k.fragmentation, k.lateral_median_m)),
                f"{k.n_predicted}/{k.n_truth}",
            )
    table.add_row("mAP", *(_format_number(metrics.mean_ap(protocol)) for protocol in PROTOCOLS), *[""] * 7)
    return table


def make_change_table(changes: Sequence[KindChange], title: str) -> Table:
    """Tabulate changes: a row for each kind that has elements."""
    table = make_table(title, ("kind", "kept", "changed", "added", "removed", "added [m]", "removed [m]"), wraps=True)
    for c in changes:
        counts = (c.num_unchanged, c.num_changed, c.num_added, c.num_removed)
        if any(counts):
            table.add_row(c.kind, *map(str, counts), f"{c.added_length_m:.0f}", f"{c.removed_length_m:.0f}")
    return table


def _format_number(value: float, digits: int = 3) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
