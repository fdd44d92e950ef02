# SPDX-License-Identifier: Apache-2.0
"""Metrics and changes of one map as tables for the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import RenderableType

from manyeyes.evaluation.maps.change_summary import KindChange
from manyeyes.evaluation.maps.metrics import MapMetrics
from manyeyes.viz.table import make_table

PROTOCOLS = {"exact": "Chamfer-exact", "maptr": "MapTR", "streammapnet": "StreamMapNet"}


def make_kinds_table(metrics: MapMetrics, title: str) -> RenderableType:
    """Tabulate one map: a column for each kind that is predicted or true, and one for the mean of crossings and dividers."""
    kinds = [k for k in metrics.kinds if k.n_predicted or k.n_truth]
    lines = [
        (f"AP {name}", *(_format_number(metrics.get_ap(k.kind, protocol)) for k in kinds), _format_number(mean))
        for protocol, name in PROTOCOLS.items()
        for mean in (metrics.mean_ap(protocol),)
    ]
    for heading, values in (
        *((f"F1@{limit} m", [k.length_scores[n].f1 for k in kinds]) for n, limit in enumerate(("0.3", "0.5", "1"))),
        ("duplication", [k.duplication for k in kinds]),
        ("fragmentation", [k.fragmentation for k in kinds]),
        ("lateral error [m]", [k.lateral_median_m for k in kinds]),
    ):
        lines.append((heading, *(_format_number(value, 3 if heading.startswith("F1") else 2) for value in values), ""))
    lines.append(("predicted/true elements", *(f"{k.n_predicted}/{k.n_truth}" for k in kinds), ""))
    return make_table(title, ("metric", *(k.kind for k in kinds), "mean of crossing and divider"), lines)


def make_change_table(changes: Sequence[KindChange], title: str) -> RenderableType:
    """Tabulate changes: a row for each kind that has elements."""
    counts = [(c.num_unchanged, c.num_changed, c.num_added, c.num_removed) for c in changes]
    outside = [(c.num_outside_old, c.num_outside_new) for c in changes]
    lengths = [(c.added_length_m, c.removed_length_m, c.outside_old_length_m, c.outside_new_length_m) for c in changes]
    lines = [
        (c.kind, *map(str, counts[k]), *(f"{length:.0f}" for length in lengths[k]))
        for k, c in enumerate(changes)
        if any((*counts[k], *outside[k]))
    ]
    names = ("kind", "kept", "changed", "added", "removed", "added [m]", "removed [m]")
    return make_table(title, (*names, "outside old [m]", "outside new [m]"), lines)


def _format_number(value: float, digits: int = 3) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
