# SPDX-License-Identifier: Apache-2.0
"""The main table: every method in both forms, on a real channel and on the ideal one, with nothing wrong and with each disturbance.

The real channel is ITS-G5 at 6 Mb/s, shared by all agents; the ego waits 100 ms for messages there, and not at all on the ideal
channel. AP is given at the ego's sweep and at the time of its answer (``evaluation.detection.answer_time``). Disturbances come on
top of the channel's own latency and loss, at CoSTr's largest levels, with the pose corrector off and on. No fusion receives
nothing and is run once for each form; methods are compared with ours within a form. --checkpoints adds baselines with weights of
their own. Every row names the command that makes it alone, which 'manyeyes report check-cells' runs again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.evaluation.detection.compute_times import compute_time_s
from manyeyes.evaluation.detection.model_size import ModelSize, count_parameters, describe_lattice
from manyeyes.evaluation.detection.paper_bytes import PaperRule, count_paper_bytes, find_paper_rule
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.evaluation.statistics.operating_point import OperatingPoint
from manyeyes.studies.command_line import format_command
from manyeyes.studies.detection.perturbations import (
    CLEAN,
    COMBINED_SEVERE,
    DELAYS,
    HEADINGS,
    LOSSES,
    POSITIONS,
    Perturbation,
)
from manyeyes.studies.engine.conditions import ResultGrid, ResultKey
from manyeyes.studies.engine.contenders import Contender, list_contenders, make_conditions, select_contenders
from manyeyes.studies.engine.replay_study import ALONE, OURS_BY_FORM, ReplayStudy, prepare_study, with_replay
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import MainTableOptions, StudyOptions
from manyeyes.studies.replay_options import FRAME_PERIOD_MS, IDEAL_LATENCY_BUDGET_MS, display_name
from manyeyes.viz.study_table import StudyTable, format_interval, format_number, make_comparison_table

DISTURBANCES = (CLEAN, DELAYS[-1], HEADINGS[-1], POSITIONS[-1], LOSSES[-1], COMBINED_SEVERE)
ANY_CHANNEL = "any channel"
"""Name of the condition of no fusion."""
OFF = "off"
"""Name of no pose corrector."""


@dataclass(frozen=True)
class TableCell:
    """A channel, disturbance and pose corrector."""

    channel: str
    perturbation: Perturbation
    corrector: str = OFF

    @property
    def name(self) -> str:
        """Name of its condition."""
        correction = "" if self.corrector == OFF else f", corrector {self.corrector}"
        return f"{self.channel}: {self.perturbation.name}{correction}"

    def apply_to(self, config: BenchmarkConfig, pose_noise: PoseNoise) -> BenchmarkConfig:
        """Return the configuration on the channel, with its latency budget and the corrector, under the disturbance."""
        budget_ms = IDEAL_LATENCY_BUDGET_MS if self.channel == "ideal" else FRAME_PERIOD_MS
        correction = None if self.corrector == OFF else PoseCorrection(self.corrector)
        changed = with_replay(
            config, channel=self.channel, latency_budget_s=budget_ms / 1e3, pose_correction=correction
        )
        return self.perturbation.apply_to(changed, pose_noise)


@dataclass(frozen=True)
class MainTableRow:
    """A method on a channel under a disturbance.

    ap, answer_ap, legacy_ap: at both IoUs; point: at one score threshold. corrector: of poses, by name. bytes_per_message: on the
    bus. paper_bytes: as its paper counts, by paper_rule. compute_ms: a constant of the strategy, for a step of one agent.
    command: makes this row alone.
    """

    channel: str
    perturbation: Perturbation
    corrector: str
    method: str
    strategy: str
    weights: str
    ap: tuple[Interval, Interval]
    answer_ap: tuple[Interval, Interval]
    legacy_ap: tuple[Interval, Interval]
    point: OperatingPoint
    bytes_per_message: float
    paper_bytes: float
    paper_rule: PaperRule
    age_ms: float
    answer_ms: float
    compute_ms: float
    parameters: ModelSize
    command: str


def run(options: MainTableOptions, context: StudyContext) -> None:
    """Run the study and write its report."""
    study = prepare_study(options, context)
    every = list_contenders(study.base.methods, options.checkpoints, context.name)
    contenders = select_contenders(every, options.rows, context.name)
    disturbances = _select_disturbances(options.perturbations)

    def list_settings(contender: Contender) -> list[tuple[str, BenchmarkConfig]]:
        cells = list_cells(contender, options, disturbances)
        if contender.method in ALONE:
            return [(cell.name, CLEAN.apply_to(study.base)) for cell in cells]
        return [(cell.name, cell.apply_to(study.base, study.pose_noise)) for cell in cells]

    apart = [[c for c in contenders if (c.method in ALONE) == is_alone] for is_alone in (True, False)]
    conditions = [condition for group in apart for condition in make_conditions(group, list_settings)]
    results = study.run(conditions)
    keys = {(cell, c): c.key(cell.name) for c in contenders for cell in list_cells(c, options, disturbances)}
    rows = tuple(_make_row(results, cell, c, study) for cell, c in sorted(keys, key=lambda k: _order(k, options)))
    comparisons = tuple(make_comparisons(results, keys))
    tables = [_make_table(name, rows) for name in dict.fromkeys(row.channel for row in rows)]
    tables += [make_comparison_table(comparisons)] if comparisons else []
    payload: dict[str, object] = {"rows": rows, "comparisons": comparisons}
    study.write_report(payload, tables, (), conditions)


def _select_disturbances(names: Sequence[str]) -> tuple[Perturbation, ...]:
    """Return the disturbances of these names; all of them without names."""
    if unknown := sorted(set(names) - {d.name for d in DISTURBANCES}):
        raise ConfigError(f"No perturbation {unknown[0]!r}; choose from {', '.join(d.name for d in DISTURBANCES)}.")
    return tuple(d for d in DISTURBANCES if not names or d.name in names)


def list_cells(
    contender: Contender, options: MainTableOptions, disturbances: Sequence[Perturbation]
) -> tuple[TableCell, ...]:
    """Return the cells of a contender: one of no fusion; with its own corrector, if it has one, instead of those of the options."""
    if contender.method in ALONE:
        return (TableCell(ANY_CHANNEL, CLEAN),)
    correctors = options.correctors if contender.corrector is None else (contender.corrector,)
    return tuple(TableCell(*setting) for setting in product(options.channels, disturbances, correctors))


def _order(key: tuple[TableCell, Contender], options: MainTableOptions) -> tuple[int, int, int]:
    """Sort rows by channel, disturbance and corrector, no fusion first; contenders stay in their order."""
    cell, channels = key[0], (ANY_CHANNEL, *options.channels)
    correctors = options.correctors
    place = correctors.index(cell.corrector) if cell.corrector in correctors else len(correctors)
    return channels.index(cell.channel), DISTURBANCES.index(cell.perturbation), place


def _make_row(results: ResultGrid, cell: TableCell, contender: Contender, study: ReplayStudy) -> MainTableRow:
    key, detector = contender.key(cell.name), contender.load_detector(study.base)
    result, options = results.results[key], study.context.options
    volume = result.communication
    rule = find_paper_rule(contender.method.removesuffix(contender.form), _name_fusion(detector))
    contents = (volume.tokens_per_message, volume.objects_per_message, volume.points_per_message)
    return MainTableRow(
        cell.channel,
        cell.perturbation,
        cell.corrector,
        contender.name,
        contender.method,
        display_name(contender.weights or str(study.base.weights)),
        results.ap_pair(key),
        results.answer_ap_pair(key),
        results.legacy_ap_pair(key),
        results.compute_operating_point(key),
        result.bytes_per_message,
        count_paper_bytes(rule, *contents, describe_lattice(detector)),
        rule,
        result.age_ms,
        result.answer_ms,
        1e3 * compute_time_s(contender.method),
        count_parameters(detector, contender.method),
        format_command(f"study {study.context.name}", _only(options, cell, contender)),
    )


def _name_fusion(detector: object) -> str:
    return str(getattr(getattr(detector, "config", None), "fusion", ""))


def _only(options: StudyOptions, cell: TableCell, contender: Contender) -> StudyOptions:
    """Return the options that make one row alone."""
    assert isinstance(options, MainTableOptions)
    if contender.method in ALONE:
        return replace(options, rows=(contender.name,), perturbations=(), channels=("ideal",), correctors=(OFF,))
    return replace(
        options,
        rows=(contender.name,),
        perturbations=(cell.perturbation.name,),
        channels=(cell.channel,),
        correctors=(cell.corrector,) if contender.corrector is None else (OFF,),
    )


def make_comparisons(results: ResultGrid, keys: dict[tuple[TableCell, Contender], ResultKey]) -> Iterator[Comparison]:
    """Compare our method with every other of its form under each condition, at the sweep and at the answer; ours with and without
    each corrector; and ours under each disturbance with itself where nothing is wrong.
    """
    alone = {c: key for (_, c), key in keys.items() if c.method in ALONE}
    for (cell, ours), key in keys.items():
        if ours.weights is not None or ours.method not in OURS_BY_FORM:
            continue
        others = {**alone, **{c: k for (at, c), k in keys.items() if c != ours and _is_beside(at, cell, c)}}
        for other, baseline in others.items():
            if other.form == ours.form:
                text = f"{ours.name} - {other.name}, {cell.name}"
                for iou in (0, 1):
                    yield results.compare(text, key, baseline, iou)
                    yield results.compare_answers(text, key, baseline, iou)
        without = keys.get((replace(cell, corrector=OFF), ours))
        if cell.corrector != OFF and without is not None:
            text = f"{ours.name}, {cell.name} - {OFF}"
            yield from (results.compare(text, key, without, iou) for iou in (0, 1))
        undisturbed = keys.get((replace(cell, perturbation=CLEAN), ours))
        if cell.perturbation != CLEAN and undisturbed is not None:
            text = f"{ours.name}, {cell.name} - {CLEAN.name}"
            yield from (results.compare(text, key, undisturbed, iou) for iou in (0, 1))


def _is_beside(at: TableCell, cell: TableCell, contender: Contender) -> bool:
    """Return whether a contender's cell is compared with ours: of the same corrector, or of its own."""
    return at == cell or (contender.corrector is not None and replace(at, corrector=cell.corrector) == cell)


def _make_table(channel: str, rows: Sequence[MainTableRow]) -> StudyTable:
    headings = (
        "perturbation", "method", "pose corrector", "AP@0.5 at sweep", "AP@0.5 at answer", "AP@0.7 at sweep", "AP@0.7 at answer",
        "legacy AP@0.5", "legacy AP@0.7", "precision", "recall", "F", "false alarms/frame", "duplicates/object", "bytes/message",
        "bytes, paper's count", "data age [ms]", "answer after [ms]", "CPU time/step [ms]", "parameters of fusion", "parameters",
    )  # fmt: skip
    lines = tuple(
        (
            row.perturbation.name,
            row.method,
            row.corrector,
            *(format_interval(interval) for pair in zip(row.ap, row.answer_ap) for interval in pair),
            *map(format_interval, row.legacy_ap),
            *map(format_interval, (row.point.precision, row.point.recall, row.point.f_score)),
            *map(format_interval, (row.point.false_alarms_per_frame, row.point.duplicates_per_object)),
            *map(format_number, (row.bytes_per_message, row.paper_bytes, row.age_ms, row.answer_ms, row.compute_ms)),
            *map(format_number, (row.parameters.fusion, row.parameters.whole)),
        )
        for row in rows
        if row.channel == channel
    )
    return StudyTable(f"Channel: {channel}", headings, lines)
