# SPDX-License-Identifier: Apache-2.0
"""AP by sensor: intensity law, number of sweeps and tilt, on recordings of the same scenes with different LiDARs.

A *column* is a recording with a number of sweeps and a tilt; its laws are compared with each other. Differences are paired over
scenarios, also between recordings of the same scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

from manyeyes.agents.strategies.names import form_of
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.evaluation.detection.sensor_change import SensorChange
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.studies.engine.conditions import Condition, ResultGrid, ResultKey
from manyeyes.studies.engine.replay_study import NO_FUSION, OURS_BY_FORM
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.engine.several_recordings import join_name, prepare_recordings
from manyeyes.studies.options import SensorsOptions
from manyeyes.viz.curves import Curve, CurvePanel, save_curves
from manyeyes.viz.study_table import (
    StudyTable,
    format_difference,
    format_interval,
    format_number,
    make_comparison_table,
)

RECORDED = "as recorded"


@dataclass(frozen=True)
class SensorsRow:
    """A method with a sensor. ap: at both IoU thresholds; below_best: AP@0.5 less than with the best law of its column."""

    recording: str
    law: str
    sweeps: int
    tilt_deg: float
    method: str
    ap: tuple[Interval, Interval]
    below_best: Interval
    bytes_per_message: float


def run(options: SensorsOptions, context: StudyContext) -> None:
    """Run the study of sensors and write its report."""
    folders = (options.data, *options.other_data)
    sources = {folder.name: (folder, options.split) for folder in folders}
    if len(sources) < len(folders):
        raise ConfigError(
            f"The study 'sensors' names recordings by folder, each once; got {' '.join(map(str, folders))}."
        )
    changes = make_changes(options)
    study = prepare_recordings(options, context, sources)
    results = study.run(partial(_make_conditions, changes))
    rows = make_rows(results, list(sources), changes)
    comparisons = make_comparisons(results, rows)
    tables = [_make_results_table(method, rows) for method in dict.fromkeys(row.method for row in rows)]
    payload: dict[str, object] = {"rows": rows, "comparisons": comparisons}
    study.context.write_report(
        study.title,
        payload,
        [*tables, make_comparison_table(comparisons)],
        partial(save_curves, make_panels(rows)),
        config={"changes": changes},
    )


def make_changes(options: SensorsOptions) -> tuple[SensorChange, ...]:
    """Return all combinations of the options."""
    laws = options.laws or (None,)
    combined = product(options.sweeps, options.tilts_deg, laws)
    return tuple(SensorChange(law, sweeps, tilt, options.seed) for sweeps, tilt, law in combined)


def name_change(change: SensorChange) -> str:
    """Return the name of a condition."""
    tilt = f", tilt {change.tilt_deg:g}°" if change.tilt_deg else ""
    return f"{change.law or RECORDED}, {change.sweeps} sweep{'s' if change.sweeps > 1 else ''}{tilt}"


def _make_conditions(changes: Sequence[SensorChange], base: BenchmarkConfig) -> list[Condition]:
    return [Condition(name_change(change), replace(base, sensors=change)) for change in changes]


def make_rows(
    results: ResultGrid, recordings: Sequence[str], changes: Sequence[SensorChange]
) -> tuple[SensorsRow, ...]:
    """Return the table, by recording, change and method."""
    methods = list(dict.fromkeys(method for _, method in results.results))
    out = []
    for recording, change, method in product(recordings, changes, methods):
        key = (join_name(recording, name_change(change)), method)
        column = [
            (join_name(recording, name_change(replace(change, law=other.law))), method)
            for other in changes
            if (other.sweeps, other.tilt_deg) == (change.sweeps, change.tilt_deg)
        ]
        best = max(column, key=lambda k: results.bootstrap_ap(k, 0).value)
        out.append(
            SensorsRow(
                recording,
                change.law or RECORDED,
                change.sweeps,
                change.tilt_deg,
                method,
                results.ap_pair(key),
                results.paired_difference(key, best, 0),
                results.results[key].bytes_per_message,
            )
        )
    return tuple(out)


def make_comparisons(results: ResultGrid, rows: Sequence[SensorsRow]) -> tuple[Comparison, ...]:
    """Compare our method, without and with memory, with no fusion of its form in every row, and with the first change of its
    recording.
    """
    out: list[Comparison] = []
    for row in (row for row in rows if row.method in OURS_BY_FORM):
        key, alone = _key_of(row), NO_FUSION + form_of(row.method)
        if (key[0], alone) in results.results:
            out.append(results.compare(f"{row.method} - {alone}, {key[0]}", key, (key[0], alone)))
        first = _key_of(next(r for r in rows if r.method == row.method and r.recording == row.recording))
        if first != key:
            out.append(results.compare(f"{row.method}, {key[0]} - {first[0].partition(': ')[2]}", key, first))
    return tuple(out)


def _key_of(row: SensorsRow) -> ResultKey:
    law = None if row.law == RECORDED else row.law
    change = SensorChange(law, 1 if row.sweeps == 1 else 2, row.tilt_deg)
    return join_name(row.recording, name_change(change)), row.method


def _make_results_table(method: str, rows: Sequence[SensorsRow]) -> StudyTable:
    headings = ("recording", "law", "sweeps", "tilt", "AP@0.5", "AP@0.7", "ΔAP@0.5 vs. best law", "bytes/message")
    lines = tuple(
        (
            row.recording,
            row.law,
            str(row.sweeps),
            f"{row.tilt_deg:g}°",
            *map(format_interval, row.ap),
            format_difference(row.below_best),
            format_number(row.bytes_per_message),
        )
        for row in rows
        if row.method == method
    )
    return StudyTable(f"Sensors, {method}", headings, lines)


def make_panels(rows: Sequence[SensorsRow]) -> list[CurvePanel]:
    """Return AP@0.5 of each method over the laws, one curve for each recording, number of sweeps and tilt."""
    laws = list(dict.fromkeys(row.law for row in rows))
    panels = []
    for method in dict.fromkeys(row.method for row in rows):
        columns: dict[str, list[SensorsRow]] = {}
        for row in (row for row in rows if row.method == method):
            tilt = f", {row.tilt_deg:g}°" if row.tilt_deg else ""
            columns.setdefault(f"{row.recording}, {row.sweeps} sweeps{tilt}", []).append(row)
        curves = tuple(
            Curve(name, tuple(r.ap[0] for r in column), tuple(float(laws.index(r.law)) for r in column))
            for name, column in columns.items()
        )
        panels.append(CurvePanel(method, "", "AP@0.5", curves, ticks=tuple(laws)))
    return panels
