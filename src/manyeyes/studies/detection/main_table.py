# SPDX-License-Identifier: Apache-2.0
"""The main table: every method in both forms, on a real channel and on the ideal one, with nothing wrong and with each disturbance.

The real channel is ITS-G5 at 6 Mb/s, shared by all agents; the ego waits 100 ms for messages there, and not at all on the ideal
channel. AP is given at the ego's sweep and at the time of its answer (``evaluation.detection.answer_time``). Disturbances come on
top of the channel's own latency and loss, at CoSTr's largest levels. No fusion receives nothing and is run once for each form;
methods are compared with ours within a form.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from manyeyes.agents.strategies.names import form_of
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.evaluation.statistics.operating_point import OperatingPoint
from manyeyes.studies.detection.perturbations import (
    CLEAN,
    COMBINED_SEVERE,
    DELAYS,
    HEADINGS,
    LOSSES,
    POSITIONS,
    Perturbation,
    select_perturbations,
)
from manyeyes.studies.engine.conditions import Condition, ResultGrid, ResultKey
from manyeyes.studies.engine.replay_study import ALONE, FORMS, OURS, prepare_study, with_replay
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import MainTableOptions
from manyeyes.studies.replay_options import FRAME_PERIOD_MS, IDEAL_LATENCY_BUDGET_MS
from manyeyes.viz.study_table import StudyTable, format_interval, format_number, make_comparison_table

DISTURBANCES = (CLEAN, DELAYS[-1], HEADINGS[-1], POSITIONS[-1], LOSSES[-1], COMBINED_SEVERE)
ANY_CHANNEL = "any channel"
"""Name of the condition of no fusion."""


@dataclass(frozen=True)
class MainTableRow:
    """A method on a channel under a disturbance. ap, answer_ap, legacy_ap: at both IoUs; point: at one score threshold."""

    channel: str
    perturbation: Perturbation
    method: str
    ap: tuple[Interval, Interval]
    answer_ap: tuple[Interval, Interval]
    legacy_ap: tuple[Interval, Interval]
    point: OperatingPoint
    bytes_per_message: float
    age_ms: float
    answer_ms: float


def run(options: MainTableOptions, context: StudyContext) -> None:
    """Run the study and write its report."""
    study = prepare_study(options, context)
    alone = tuple(m for m in study.base.methods if m in ALONE)
    base = replace(study.base, methods=tuple(m for m in study.base.methods if m not in ALONE))
    selected = select_perturbations(options.perturbations, DISTURBANCES)
    conditions = [
        Condition(condition_name(channel, d), apply_channel(base, channel, d, study.pose_noise))
        for channel in options.channels
        for d in selected
        if base.methods
    ]
    if alone:
        conditions.append(Condition(ANY_CHANNEL, CLEAN.apply_to(replace(study.base, methods=alone))))
    results = study.run(conditions)
    rows = make_rows(results, options.channels, selected)
    comparisons = tuple(make_comparisons(results, options.channels, selected))
    tables = [_make_table(name, rows) for name in dict.fromkeys(row.channel for row in rows)]
    tables.append(make_comparison_table(comparisons))
    payload: dict[str, object] = {"rows": rows, "comparisons": comparisons}
    study.write_report(payload, tables, (), conditions)


def condition_name(channel: str, perturbation: Perturbation) -> str:
    """Return the name of a condition."""
    return f"{channel}: {perturbation.name}"


def apply_channel(
    config: BenchmarkConfig, channel: str, perturbation: Perturbation, pose_noise: PoseNoise
) -> BenchmarkConfig:
    """Return the configuration on a channel, with its latency budget, under a disturbance."""
    budget_ms = IDEAL_LATENCY_BUDGET_MS if channel == "ideal" else FRAME_PERIOD_MS
    return perturbation.apply_to(with_replay(config, channel=channel, latency_budget_s=budget_ms / 1e3), pose_noise)


def make_rows(
    results: ResultGrid, channels: Sequence[str], perturbations: Sequence[Perturbation]
) -> tuple[MainTableRow, ...]:
    """Return the rows, by channel, disturbance and method; no fusion first."""
    alone = [(ANY_CHANNEL, CLEAN, key) for key in results.results if key[0] == ANY_CHANNEL]
    played = [
        (channel, d, key)
        for channel in channels
        for d in perturbations
        for key in results.results
        if key[0] == condition_name(channel, d)
    ]
    return tuple(_make_row(results, *where) for where in (*alone, *played))


def _make_row(results: ResultGrid, channel: str, perturbation: Perturbation, key: ResultKey) -> MainTableRow:
    result = results.results[key]
    return MainTableRow(
        channel,
        perturbation,
        key[1],
        results.ap_pair(key),
        results.answer_ap_pair(key),
        results.legacy_ap_pair(key),
        results.compute_operating_point(key),
        result.bytes_per_message,
        result.age_ms,
        result.answer_ms,
    )


def make_comparisons(
    results: ResultGrid, channels: Sequence[str], perturbations: Sequence[Perturbation]
) -> Iterator[Comparison]:
    """Compare our method with every other of its form at each condition, at the sweep and at the answer."""
    for channel in channels:
        for perturbation in perturbations:
            name = condition_name(channel, perturbation)
            methods = [method for condition, method in results.results if condition in (name, ANY_CHANNEL)]
            for ours in (OURS + form for form in FORMS if OURS + form in methods):
                for other in (m for m in methods if m != ours and form_of(m) == form_of(ours)):
                    baseline = (ANY_CHANNEL if other in ALONE else name, other)
                    for iou in (0, 1):
                        yield results.compare(f"{ours} - {other}, {name}", (name, ours), baseline, iou)
                        yield results.compare_answers(f"{ours} - {other}, {name}", (name, ours), baseline, iou)


def _make_table(channel: str, rows: Sequence[MainTableRow]) -> StudyTable:
    headings = (
        "perturbation", "method", "AP@0.5 at sweep", "AP@0.5 at answer", "AP@0.7 at sweep", "AP@0.7 at answer", "legacy AP@0.5",
        "precision", "recall", "bytes/message", "data age [ms]", "answer after [ms]",
    )  # fmt: skip
    lines = tuple(
        (
            row.perturbation.name,
            row.method,
            *(format_interval(interval) for pair in zip(row.ap, row.answer_ap) for interval in pair),
            format_interval(row.legacy_ap[0]),
            format_interval(row.point.precision),
            format_interval(row.point.recall),
            format_number(row.bytes_per_message),
            format_number(row.age_ms),
            format_number(row.answer_ms),
        )
        for row in rows
        if row.channel == channel
    )
    return StudyTable(f"Channel: {channel}", headings, lines)
