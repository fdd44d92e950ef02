# SPDX-License-Identifier: Apache-2.0
"""AP against bytes for every method: CoSTr, Fig. 3.

Each method is played within byte budgets of a message, and without one: token methods keep the tokens of highest score, late fusion
the boxes of highest score, early fusion evenly chosen points. No fusion sends nothing and is a level. --checkpoints adds baselines
with weights of their own. Bytes are the mean of what was sent, on the bus. Differences are to ours, in a form, at equal budgets.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.agents.strategies.names import TEMPORAL, form_of
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.studies.command_line import format_command
from manyeyes.studies.engine.conditions import ResultGrid
from manyeyes.studies.engine.contenders import Contender, list_contenders, make_conditions, select_contenders
from manyeyes.studies.engine.replay_study import ALONE, FORMS, OURS_BY_FORM, ReplayStudy, prepare_study, with_replay
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import ByteCurvesOptions
from manyeyes.studies.replay_options import display_name
from manyeyes.viz.curves import Curve, CurvePanel
from manyeyes.viz.study_table import StudyTable, format_interval, format_log2, format_number, make_comparison_table
from manyeyes.viz.table import LOG2_BYTES

TOKEN_BUDGETS = (512, 1024, 1398, 2048, 4096, 8192, 16_384)
BOX_BUDGETS = (256, 512, 1024)
POINT_BUDGETS = (4096, 16_384, 65_536)
NO_BUDGET = "all"
FORM_TITLES = dict(zip(FORMS, ("without memory", "with memory")))


@dataclass(frozen=True)
class ByteCurveRow:
    """A method within a budget; None: none. ap: at both IoUs. bytes: of messages on the bus. command: makes this row alone."""

    method: str
    strategy: str
    weights: str
    budget_bytes: int | None
    ap: tuple[Interval, Interval]
    bytes_per_message: float
    max_message_bytes: int
    command: str


def run(options: ByteCurvesOptions, context: StudyContext) -> None:
    """Run the study and write its report."""
    for word in options.budgets:
        _parse_budget(word)
    study = prepare_study(options, context)
    every = list_contenders(study.base.methods, options.checkpoints, context.name)
    contenders = select_contenders(every, options.rows, context.name)
    base = with_replay(study.base, limits_contents=True)

    def list_settings(contender: Contender) -> list[tuple[str, BenchmarkConfig]]:
        own = contender.corrector
        corrected = base if own is None else with_replay(base, pose_correction=PoseCorrection(own))
        budgets = list_budgets(contender, options)
        return [(_name_budget(budget), with_replay(corrected, budget_bytes=budget)) for budget in budgets]

    # Contenders of one kind of contents have the same budgets.
    kinds = dict.fromkeys(list_budgets(contender, options) for contender in contenders)
    groups = [[c for c in contenders if list_budgets(c, options) == kind] for kind in kinds]
    conditions = [condition for group in groups for condition in make_conditions(group, list_settings)]
    results = study.run(conditions)
    rows = tuple(_make_row(results, c, budget, study) for c in contenders for budget in list_budgets(c, options))
    comparisons = tuple(make_comparisons(results, contenders, options))
    tables = [_make_table(title, part) for form, title in FORM_TITLES.items() if (part := _of_form(rows, form))]
    tables += [make_comparison_table(comparisons)] if comparisons else []
    payload: dict[str, object] = {"rows": rows, "comparisons": comparisons}
    study.write_report(payload, tables, make_panels(rows), conditions)


def list_budgets(contender: Contender, options: ByteCurvesOptions) -> tuple[int | None, ...]:
    """Return the budgets of a contender, the smallest first and none last; no fusion has none alone."""
    if contender.method in ALONE:
        return (None,)
    strategy = get_strategy(contender.method)
    budgets = TOKEN_BUDGETS if strategy.needs_tokens else POINT_BUDGETS if strategy.uses_points else BOX_BUDGETS
    words = options.budgets or (*map(str, budgets), NO_BUDGET)
    return tuple(sorted({_parse_budget(word) for word in words}, key=lambda b: math.inf if b is None else b))


def _parse_budget(word: str) -> int | None:
    if word == NO_BUDGET:
        return None
    if not (word.isdigit() and int(word)):
        raise ConfigError(f"--budgets takes numbers of bytes, one or more, and {NO_BUDGET}; got {word!r}.")
    return int(word)


def _name_budget(budget: int | None) -> str:
    return NO_BUDGET if budget is None else f"{budget:,} B"


def _make_row(results: ResultGrid, contender: Contender, budget: int | None, study: ReplayStudy) -> ByteCurveRow:
    key, options = contender.key(_name_budget(budget)), study.context.options
    assert isinstance(options, ByteCurvesOptions)
    result = results.results[key]
    only = replace(options, rows=(contender.name,), budgets=(NO_BUDGET if budget is None else str(budget),))
    return ByteCurveRow(
        contender.name,
        contender.method,
        display_name(contender.weights or str(study.base.weights)),
        budget,
        results.ap_pair(key),
        result.bytes_per_message,
        result.volume.max_message_bytes,
        format_command(f"study {study.context.name}", only),
    )


def make_comparisons(
    results: ResultGrid, contenders: Sequence[Contender], options: ByteCurvesOptions
) -> Iterator[Comparison]:
    """Compare ours with every other token method of its form at equal budgets."""
    ours = [c for c in contenders if c.weights is None and c.method in OURS_BY_FORM]
    for own in ours:
        for other in (c for c in contenders if c != own and c.form == own.form):
            for budget in list_budgets(own, options):
                keys = own.key(_name_budget(budget)), other.key(_name_budget(budget))
                if get_strategy(other.method).needs_tokens and keys[1] in results.results:
                    yield results.compare(f"{own.name} - {other.name}, {_name_budget(budget)}", *keys)


def _of_form(rows: Sequence[ByteCurveRow], form: str) -> tuple[ByteCurveRow, ...]:
    return tuple(row for row in rows if form_of(row.strategy) == form)


def _make_table(title: str, rows: Sequence[ByteCurveRow]) -> StudyTable:
    headings = ("method", "budget", "AP@0.5", "AP@0.7", "bytes/message", LOG2_BYTES, "max bytes")
    lines = tuple(
        (
            row.method,
            _name_budget(row.budget_bytes),
            *map(format_interval, row.ap),
            format_number(row.bytes_per_message),
            format_log2(row.bytes_per_message),
            format_number(row.max_message_bytes),
        )
        for row in rows
    )
    return StudyTable(f"AP against bytes, {title}", headings, lines)


def make_panels(rows: Sequence[ByteCurveRow]) -> list[CurvePanel]:
    """Return AP against the mean bytes of a message, a panel for each form and IoU."""
    return [
        CurvePanel(
            FORM_TITLES[form],
            "bytes per message, mean",
            f"AP@{IOU_THRESHOLDS[iou]:g}",
            tuple(_make_curve(m, of_form, iou) for m in dict.fromkeys(row.method for row in of_form)),
            in_bytes=True,
        )
        for form in FORMS
        if (of_form := _of_form(rows, form))
        for iou in (0, 1)
    ]


def _make_curve(method: str, rows: Sequence[ByteCurveRow], iou: int) -> Curve:
    """Return a line through the budgets of a method that sent anything; a level where it never did."""
    own = [row for row in rows if row.method == method]
    sent = [row for row in own if row.bytes_per_message > 0]
    label = method.removesuffix(TEMPORAL)
    if not sent:
        return Curve(label, (own[-1].ap[iou],))
    return Curve(label, tuple(row.ap[iou] for row in sent), tuple(row.bytes_per_message for row in sent))
