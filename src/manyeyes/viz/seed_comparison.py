# SPDX-License-Identifier: Apache-2.0
"""Main tables of several training seeds side by side: means, the spread over seeds, and which differences are claimed.

A difference of our row to another one is claimed where it is at least CLAIM_FACTOR times the standard deviation over seeds, pooled
over methods, and where its interval over scenarios excludes zero, on the same side, with every seed.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.statistics.training_seeds import CLAIM_FACTOR
from manyeyes.viz.stored_study_tables import name_perturbation
from manyeyes.viz.table import Lines, StoredTable

_OURS = "intermediate"
_METRICS = ("AP@0.5", "AP@0.7")


def make_seed_comparison(results: Mapping[str, Mapping[str, Any]]) -> StoredTable:
    """Return a table of the disturbances and methods that all main tables have, at the answer.

    results: of studies ``main-table`` by training seed, two at least, on one channel without pose corrector.

    Raises:
        ConfigError: fewer than two seeds; a table of another study; nothing in common.
    """
    if len(results) < 2:
        raise ConfigError(f"A comparison of seeds needs main tables of two seeds or more; got {len(results)}.")
    for seed, result in results.items():
        if result.get("study") != "main-table":
            raise ConfigError(f"seed {seed}: expected a result of 'manyeyes study main-table'.")
    cells = [_find_cells(result) for result in results.values()]
    common = [key for key in cells[0] if all(key in other for other in cells[1:])]
    levels = dict.fromkeys(level for level, method in common if method == _OURS)
    if not levels:
        raise ConfigError(f"The main tables of seeds {', '.join(results)} have no row {_OURS} in common.")
    differences = [_find_differences(result) for result in results.values()]
    heads = (
        "disturbance",
        "metric",
        "method",
        *(f"seed {seed}" for seed in results),
        "mean",
        "sd",
        "ours - method",
        "claimed",
    )
    lines: Lines = [heads]
    for level in levels:
        methods = [method for at, method in common if at == level]
        for iou in range(len(_METRICS)):
            lines += _make_lines(methods, level, iou, cells, differences)
    return StoredTable("training-seeds", f"AP at the answer of trainings from {len(results)} seeds", lines)


def _find_cells(result: Mapping[str, Any]) -> dict[tuple[str, str], Sequence[Any]]:
    """Return AP at the answer, at both IoUs, by disturbance and method. No fusion is no training of a fusion, and is left out."""
    rows = [row for row in result["rows"] if row["channel"] != "any channel" and row["corrector"] == "off"]
    return {(name_perturbation(row["perturbation"]), row["method"]): row["answer_ap"] for row in rows}


def _find_differences(result: Mapping[str, Any]) -> dict[tuple[str, str], Mapping[str, float]]:
    """Return intervals of paired differences by their description and metric."""
    return {(one["description"], one["metric"]): one["interval"] for one in result["comparisons"]}


def _make_lines(
    methods: Sequence[str],
    level: str,
    iou: int,
    cells: Sequence[Mapping[tuple[str, str], Sequence[Any]]],
    differences: Sequence[Mapping[tuple[str, str], Mapping[str, float]]],
) -> Lines:
    """Make the lines of the methods under one disturbance, then one of the pooled standard deviation."""
    values = {method: [one[level, method][iou]["value"] for one in cells] for method in methods}
    pooled = math.sqrt(statistics.fmean(statistics.variance(column) for column in values.values()))
    lines, metric = list[tuple[str, ...]](), _METRICS[iou]
    for method, column in values.items():
        mean = statistics.fmean(column)
        line = (level, metric, method, *(f"{v:.3f}" for v in (*column, mean, statistics.stdev(column))))
        gain = statistics.fmean(values[_OURS]) - mean
        intervals = [_find_interval(one, method, level, metric) for one in differences]
        if method == _OURS or None in intervals:
            lines.append((*line, "-", "-"))
            continue
        sides = {(i["low"] > 0) - (i["high"] < 0) for i in intervals if i is not None}
        is_claimed = abs(gain) >= CLAIM_FACTOR * pooled and sides in ({1}, {-1})
        lines.append((*line, f"{gain:+.3f}", "yes" if is_claimed else "no"))
    return [*lines, (level, metric, "pooled", *("-" for _ in cells), "-", f"{pooled:.3f}", "-", "-")]


def _find_interval(
    differences: Mapping[tuple[str, str], Mapping[str, float]], method: str, level: str, metric: str
) -> Mapping[str, float] | None:
    """Return the interval of our row minus another one under a disturbance, on whichever channel."""
    for (description, name), interval in differences.items():
        pair, _, place = description.partition(", ")
        if name == f"{metric} at the answer" and pair == f"{_OURS} - {method}" and place.partition(": ")[2] == level:
            return interval
    return None
