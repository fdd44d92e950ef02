# SPDX-License-Identifier: Apache-2.0
"""What each further agent brings: the ego with the nearest so many others, one to five in all.

A row of n agents is evaluated on the scenarios that have as many, against the truth of everybody that is there; what it gains over
one agent fewer and over no fusion of its form, with or without memory, is evaluated on those same scenarios.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from manyeyes.agents.strategies.names import form_of
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.protocols import get_protocol
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.studies.engine.conditions import Condition, ResultGrid, ResultKey
from manyeyes.studies.engine.replay_study import ALONE, NO_FUSION, prepare_study
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import EvaluationOptions
from manyeyes.viz.curves import Curve, CurvePanel
from manyeyes.viz.study_table import StudyTable, format_difference, format_interval, format_number

MAX_AGENTS = 5


@dataclass(frozen=True)
class NumAgentsRow:
    """A method with so many agents, on as many scenarios as have them. mean_snapshot_bytes: of all senders together, mean."""

    num_agents: int
    method: str
    num_scenarios: int
    ap: tuple[Interval, Interval]
    gain_over_one_fewer: Interval | None
    gain_over_no_fusion: Interval | None
    bytes_per_message: float
    mean_snapshot_bytes: float


def run(options: EvaluationOptions, context: StudyContext) -> None:
    """Run the study of numbers of agents and write its report."""
    if get_protocol(options.protocol).min_points_in_gt:
        raise ConfigError(
            f"The study 'num-agents' cannot count points in true boxes, as protocol {options.protocol} does."
        )
    study = prepare_study(options, context)
    recording, methods = study.opener(), study.base.methods
    max_agents = min(MAX_AGENTS, max(len(recording.agents(name)) for name in recording.scenarios))
    collaborative = tuple(m for m in methods if m not in ALONE)
    conditions = [
        Condition(str(n), replace(study.base, num_agents=n, methods=methods if n == 1 else collaborative))
        for n in range(1, max_agents + 1)
        if n == 1 or collaborative
    ]
    result_rows = make_rows(study.run(conditions))
    study.write_report({"rows": result_rows}, [_make_results_table(result_rows)], make_panels(result_rows), conditions)


def make_rows(results: ResultGrid) -> tuple[NumAgentsRow, ...]:
    """Return the table, by number of agents."""
    return tuple(_make_row(results, int(name), method) for name, method in results.results)


def _make_row(results: ResultGrid, num_agents: int, method: str) -> NumAgentsRow:
    key, fewer_key = (str(num_agents), method), (str(num_agents - 1), method)
    no_fusion_key = ("1", NO_FUSION + form_of(method))
    result, scenarios = results.results[key], results.scenarios_of(key)

    def gain_over(other: ResultKey) -> Interval | None:
        return (
            results.paired_difference(key, other, 0, scenarios) if other in results.results and other != key else None
        )

    return NumAgentsRow(
        num_agents,
        method,
        len(scenarios),
        results.ap_pair(key),
        gain_over(fewer_key),
        gain_over(no_fusion_key),
        result.bytes_per_message,
        result.volume.mean_snapshot_bytes,
    )


def _make_results_table(result_rows: Sequence[NumAgentsRow]) -> StudyTable:
    headings = (
        "agents", "method", "scenarios", "AP@0.5", "AP@0.7", "gain over one fewer @0.5", "gain over no fusion @0.5",
        "bytes/message", "bytes/snapshot",
    )  # fmt: skip
    lines = tuple(
        (
            str(row.num_agents),
            row.method,
            str(row.num_scenarios),
            *map(format_interval, row.ap),
            format_difference(row.gain_over_one_fewer),
            format_difference(row.gain_over_no_fusion),
            format_number(row.bytes_per_message),
            format_number(row.mean_snapshot_bytes),
        )
        for row in result_rows
    )
    return StudyTable("Agents", headings, lines)


def make_panels(result_rows: Sequence[NumAgentsRow]) -> list[CurvePanel]:
    """Return AP by number of agents on all scenarios that have them, and what that is over no fusion on the same scenarios."""
    methods = [m for m in dict.fromkeys(row.method for row in result_rows) if m not in ALONE]
    ap_curves, gain_curves = [], []
    for method in methods:
        method_rows = [row for row in result_rows if row.method == method]
        ap_curves.append(
            Curve(method, tuple(r.ap[0] for r in method_rows), tuple(float(r.num_agents) for r in method_rows))
        )
        gains = [(r.gain_over_no_fusion, float(r.num_agents)) for r in method_rows if r.gain_over_no_fusion is not None]
        if gains:
            gain_curves.append(Curve(method, tuple(y for y, _ in gains), tuple(x for _, x in gains)))
    out = [CurvePanel("Scenarios that have them", "agents", "AP@0.5", tuple(ap_curves))] if ap_curves else []
    return out + (
        [CurvePanel("The same scenarios", "agents", "AP@0.5 over no fusion", tuple(gain_curves))] if gain_curves else []
    )
