# SPDX-License-Identifier: Apache-2.0
"""AP of each stratum of a data set, which are its splits: they are reported apart and never pooled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from manyeyes.agents.strategies.names import form_of
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.studies.engine.conditions import Condition, ResultGrid
from manyeyes.studies.engine.replay_study import ALONE, OURS_BY_FORM
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.engine.several_recordings import join_name, prepare_recordings
from manyeyes.studies.options import StrataOptions
from manyeyes.viz.study_table import StudyTable, format_interval, format_number, make_comparison_table

_CONDITION = "all"


@dataclass(frozen=True)
class StrataRow:
    """A method in a stratum. ap: at both IoU thresholds."""

    stratum: str
    method: str
    num_scenarios: int
    ap: tuple[Interval, Interval]
    bytes_per_message: float


def run(options: StrataOptions, context: StudyContext) -> None:
    """Run the study of strata and write its report."""
    if options.split is not None:
        raise ConfigError(f"The study 'strata' takes --strata instead of --split; give --strata {options.split}.")
    strata = options.strata or find_strata(options.data)
    study = prepare_recordings(options, context, {name: (options.data, name) for name in strata})
    results = study.run(_make_conditions)
    rows, comparisons = make_rows(results, strata), make_comparisons(results, strata)
    payload: dict[str, object] = {"rows": rows, "comparisons": comparisons}
    tables = [_make_results_table(rows), make_comparison_table(comparisons)]
    study.context.write_report(study.title, payload, tables, config={"strata": strata})


def find_strata(data: Path) -> tuple[str, ...]:
    """Return the names of the folders of a data set, in order.

    Raises:
        ConfigError: there are none.
    """
    found = tuple(sorted(path.name for path in data.iterdir() if path.is_dir() and not path.name.startswith(".")))
    if not found:
        raise ConfigError(f"{data}: no folder of a split; give the root of a data set, or name its splits by --strata.")
    return found


def _make_conditions(base: BenchmarkConfig) -> list[Condition]:
    return [Condition(_CONDITION, base)]


def make_rows(results: ResultGrid, strata: Sequence[str]) -> tuple[StrataRow, ...]:
    """Return the table, by stratum and method."""
    methods = list(dict.fromkeys(method for _, method in results.results))
    keys = [(stratum, (join_name(stratum, _CONDITION), method)) for stratum in strata for method in methods]
    return tuple(
        StrataRow(
            stratum,
            key[1],
            len(results.scenarios_of(key)),
            results.ap_pair(key),
            results.results[key].bytes_per_message,
        )
        for stratum, key in keys
    )


def make_comparisons(results: ResultGrid, strata: Sequence[str]) -> tuple[Comparison, ...]:
    """Compare our method with every other within each stratum, at both IoU thresholds."""
    out: list[Comparison] = []
    for stratum in strata:
        condition = join_name(stratum, _CONDITION)
        methods = [method for name, method in results.results if name == condition]
        for ours in (name for name in OURS_BY_FORM if name in methods):
            others = [method for method in methods if method != ours and form_of(method) == form_of(ours)]
            out += [
                results.compare(f"{ours} - {other}, {stratum}", (condition, ours), (condition, other), iou)
                for other in sorted(others, key=lambda name: name not in ALONE)
                for iou in (0, 1)
            ]
    return tuple(out)


def _make_results_table(rows: Sequence[StrataRow]) -> StudyTable:
    headings = ("stratum", "method", "scenarios", "AP@0.5", "AP@0.7", "bytes/message")
    lines = tuple(
        (
            row.stratum,
            row.method,
            str(row.num_scenarios),
            *map(format_interval, row.ap),
            format_number(row.bytes_per_message),
        )
        for row in rows
    )
    return StudyTable("Strata", headings, lines)
