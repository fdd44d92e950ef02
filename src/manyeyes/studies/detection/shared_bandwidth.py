# SPDX-License-Identifier: Apache-2.0
"""The system as a whole: every agent evaluated as ego in turn, all senders within one budget of the channel (CoSTr, Eq. 2).

What is maximised is the AP of all egos together, their detections in one list. What one sender does not need of its part goes
to the others (comms/bandwidth.py). A broadcast is received by all agents and counted once. The largest budget is what 27 Mbit/s
carry in 100 ms. Ways of collaboration that know no budget stand beside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from manyeyes.agents.strategies.names import form_of
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.studies.engine.conditions import Condition, ResultGrid
from manyeyes.studies.engine.replay_study import NO_FUSION, prepare_study, resolve_token_selection, with_replay
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import SharedBandwidthOptions
from manyeyes.viz.curves import Curve, CurvePanel
from manyeyes.viz.study_table import StudyTable, format_difference, format_interval, format_number

BUDGETS = (8192, 16384, 65536, 337_500)
NO_BUDGET = "no budget"


@dataclass(frozen=True)
class SharedBandwidthRow:
    """A method with all agents as egos, their messages of an instant together within the budget.

    gain_over_no_fusion: of the same form, with or without memory. max_snapshot_bytes: of an instant.
    """

    budget_bytes: int | None
    method: str
    num_ego_frames: int
    ap: tuple[Interval, Interval]
    gain_over_no_fusion: Interval | None
    mean_snapshot_bytes: float
    max_snapshot_bytes: int


def run(options: SharedBandwidthOptions, context: StudyContext) -> None:
    """Run the study of shared bandwidth and write its report."""
    study, selected = prepare_study(options, context, all_egos=True), resolve_token_selection(options.token_selection)
    others = tuple(m for m in study.base.methods if m not in selected)
    conditions = [
        Condition(str(b), with_replay(replace(study.base, methods=selected), channel_budget_bytes=b))
        for b in sorted(options.budgets or BUDGETS)
    ]
    if others:
        conditions.append(Condition(NO_BUDGET, replace(study.base, methods=others)))
    result_rows = make_rows(study.run(conditions))
    study.write_report({"rows": result_rows}, [_make_results_table(result_rows)], make_panels(result_rows), conditions)


def make_rows(results: ResultGrid) -> tuple[SharedBandwidthRow, ...]:
    """Return the table, by budget."""
    out = []
    for key, result in results.results.items():
        name, method = key
        no_fusion_key = (NO_BUDGET, NO_FUSION + form_of(method))
        out.append(
            SharedBandwidthRow(
                None if name == NO_BUDGET else int(name),
                method,
                result.num_frames,
                results.ap_pair(key),
                results.paired_difference(key, no_fusion_key, 0)
                if no_fusion_key in results.results and key != no_fusion_key
                else None,
                result.volume.mean_snapshot_bytes,
                result.volume.max_snapshot_bytes,
            )
        )
    return tuple(out)


def _make_results_table(result_rows: Sequence[SharedBandwidthRow]) -> StudyTable:
    headings = (
        "budget [bytes/snapshot]", "method", "ego frames", "AP@0.5", "AP@0.7", "gain over no fusion @0.5", "bytes/snapshot",
        "max bytes",
    )  # fmt: skip
    lines = tuple(
        (
            NO_BUDGET if row.budget_bytes is None else f"{row.budget_bytes:,}",
            row.method,
            f"{row.num_ego_frames:,}",
            *map(format_interval, row.ap),
            format_difference(row.gain_over_no_fusion),
            format_number(row.mean_snapshot_bytes),
            format_number(row.max_snapshot_bytes),
        )
        for row in result_rows
    )
    return StudyTable("Every agent as ego", headings, lines)


def make_panels(result_rows: Sequence[SharedBandwidthRow]) -> list[CurvePanel]:
    """Return AP@0.5 of all egos against the mean bytes of an instant."""
    curves = []
    for method in dict.fromkeys(row.method for row in result_rows):
        method_rows = [row for row in result_rows if row.method == method]
        x = (
            tuple(row.mean_snapshot_bytes for row in method_rows)
            if all(row.mean_snapshot_bytes for row in method_rows)
            else ()
        )
        curves.append(Curve(method, tuple(row.ap[0] for row in method_rows), x))
    return [
        CurvePanel(
            "Every agent as ego", "bytes per snapshot, all senders, mean", "AP@0.5", tuple(curves), in_bytes=True
        )
    ]
