# SPDX-License-Identifier: Apache-2.0
"""ROC of detecting malicious mapping agents, by attack, fraction of agents, and offset (evaluation.maps.malicious_agents)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from manyeyes.evaluation.maps.adversarial import make_attacks
from manyeyes.evaluation.maps.experiment import FleetTrial
from manyeyes.evaluation.maps.malicious_agents import (
    MAX_FALSE_POSITIVE,
    AgentDetection,
    AgentErrors,
    measure_agent_errors,
    summarize_agents,
)
from manyeyes.evaluation.maps.registry import MethodSettings, make_tuned_settings
from manyeyes.evaluation.statistics.bootstrap import exact_interval
from manyeyes.evaluation.statistics.proportion import Proportion
from manyeyes.maps.registry import OURS
from manyeyes.simulator.fleet.place import check_place
from manyeyes.studies.engine.cells import Cell, CellStore
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.maps.fusion import TEST_PLACES
from manyeyes.studies.options import MaliciousAgentsOptions
from manyeyes.viz.curves import Curve, CurvePanel, save_curves
from manyeyes.viz.study_table import StudyTable, format_number

COMPUTED_BY = ("manyeyes.evaluation.maps.malicious_agents",)
HEADINGS = (
    "attack", "malicious agents", "offset [m]", "honest", "malicious", "ROC area",
    f"found at {MAX_FALSE_POSITIVE:.0%} false", "honest observations of weight below .1",
)  # fmt: skip


@dataclass(frozen=True)
class AgentErrorsJob:
    """The agents of one trial, loaded or computed."""

    trial: FleetTrial
    settings: MethodSettings
    store: CellStore

    def __call__(self) -> AgentErrors:
        """Load or compute the cell."""
        trial, config = self.trial, self.trial.fleet_config
        attack = f"{config.attack_mode}-{config.malicious_fraction:g}-{config.malicious_offset_m[0]:g}"
        name = f"{trial.place}-{trial.seed}-{attack}-agents"
        cell = Cell[AgentErrors](name, AgentErrors, (trial, self.settings.config_of(OURS)), COMPUTED_BY)
        return self.store.load_or_compute(cell, partial(measure_agent_errors, trial, self.settings))


def run(options: MaliciousAgentsOptions, context: StudyContext) -> None:
    """Solve all trials and write the report."""
    settings = make_tuned_settings()
    for place in options.places:
        check_place(place)
    places, seeds = options.places or TEST_PLACES, range(options.seeds)
    trials = [
        trial for fraction in options.fractions for trial in make_attacks(places, seeds, options.offsets_m, fraction)
    ]
    jobs = [AgentErrorsJob(trial, settings, context.store) for trial in trials]
    rows = summarize_agents(context.run_jobs(jobs, options.workers, "Trials"))
    title = f"Detection of malicious agents among 200 observations: {', '.join(places)}, {options.seeds} seeds"
    context.write_report(
        title,
        {"rows": rows},
        [_make_table(rows)],
        partial(save_curves, _make_panels(rows)) if rows else None,
        config={"settings": settings},
    )


def _make_table(rows: Sequence[AgentDetection]) -> StudyTable:
    lines = tuple(
        (
            row.attack,
            f"{row.fraction:.0%}",
            f"{row.offset_m:g}",
            str(row.roc.num_negative),
            str(row.roc.num_positive),
            format_number(row.roc.area, 3),
            _format_proportion(row.found),
            _format_proportion(row.low_weight),
        )
        for row in rows
    )
    return StudyTable("Malicious agents", HEADINGS, lines)


def _format_proportion(value: Proportion) -> str:
    return f"{value.value:.3f} [{value.low:.3f}, {value.high:.3f}]"


def _make_panels(rows: Sequence[AgentDetection]) -> list[CurvePanel]:
    """Make a panel of ROC curves for each attack and fraction."""
    return [
        CurvePanel(
            f"{attack}, {fraction:.0%} of agents",
            "honest agents, fraction",
            "malicious agents, fraction",
            tuple(
                Curve(f"{row.offset_m:g} m", tuple(map(exact_interval, row.roc.true_positive)), row.roc.false_positive)
                for row in rows
                if (row.attack, row.fraction) == (attack, fraction)
            ),
        )
        for attack, fraction in dict.fromkeys((row.attack, row.fraction) for row in rows)
    ]
