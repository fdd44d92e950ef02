# SPDX-License-Identifier: Apache-2.0
"""Displacement of fused maps by malicious agents, over places, seeds, attack modes and offsets (evaluation.maps.adversarial)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from manyeyes.evaluation.maps.adversarial import AdversarialResult, make_attacks, run_attack
from manyeyes.evaluation.maps.experiment import FleetTrial
from manyeyes.evaluation.maps.registry import MethodSettings, make_tuned_settings
from manyeyes.maps.registry import OURS
from manyeyes.simulator.fleet.place import check_place
from manyeyes.studies.engine.cells import Cell, CellStore
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.maps.fusion import TEST_PLACES
from manyeyes.studies.options import AdversarialOptions
from manyeyes.viz.study_table import StudyTable, format_number

COMPUTED_BY = ("manyeyes.evaluation.maps.adversarial",)
HEADINGS = (
    "place", "seed", "malicious", "attack", "offset [m]", "stations", "displaced > 0.1 m", "lost", "displaced without attack",
    "p99 [m]", "max [m]",
)  # fmt: skip

SUMMARY_HEADINGS = (
    "attack", "offset [m]", "stations", "displaced > 0.1 m", "displaced without attack", "lost", "displaced in one trial at most",
)  # fmt: skip


@dataclass(frozen=True)
class AdversarialJob:
    """One trial of an attack, loaded or computed."""

    trial: FleetTrial
    settings: MethodSettings
    store: CellStore

    def __call__(self) -> AdversarialResult:
        """Load or compute the cell."""
        trial = self.trial
        name = f"{trial.place}-{trial.view_label}-{trial.seed}-malicious"
        cell = Cell[AdversarialResult](name, AdversarialResult, (trial, self.settings.config_of(OURS)), COMPUTED_BY)
        return self.store.load_or_compute(cell, partial(run_attack, trial, self.settings))


def run(options: AdversarialOptions, context: StudyContext) -> None:
    """Run all attacks and write the report."""
    settings = make_tuned_settings()
    for place in options.places:
        check_place(place)
    trials = make_attacks(options.places or TEST_PLACES, range(options.seeds))
    jobs = [AdversarialJob(trial, settings, context.store) for trial in trials]
    results = context.run_jobs(jobs, options.workers, "Trials")
    title = "Displacement by malicious agents of stations that five or more agents observed"
    tables = [make_summary_table(results), _make_table(results)]
    context.write_report(title, {"trials": results}, tables, config={"settings": settings})


def make_summary_table(results: Sequence[AdversarialResult]) -> StudyTable:
    """Add up the stations over places and seeds, beside those that as many honest agents displace; the most of one trial apart."""
    groups: dict[tuple[str, float], list[AdversarialResult]] = {}
    for result in results:
        groups.setdefault((result.attack, result.offset_m), []).append(result)
    lines = []
    for (attack, offset_m), part in groups.items():
        sums = [
            sum(getattr(r, name) for r in part)
            for name in ("num_stations", "num_displaced", "num_displaced_without_attack", "num_lost")
        ]
        most = max(r.num_displaced for r in part)
        lines.append((attack, f"{offset_m:g}", *(f"{n:,}" for n in (*sums, most))))
    return StudyTable("Displaced stations by attack", SUMMARY_HEADINGS, tuple(lines))


def _make_table(results: Sequence[AdversarialResult]) -> StudyTable:
    lines = tuple(
        (
            r.place,
            str(r.seed),
            f"{r.num_malicious} of {r.num_observations}",
            r.attack,
            f"{r.offset_m:g}",
            *(str(n) for n in (r.num_stations, r.num_displaced, r.num_lost, r.num_displaced_without_attack)),
            format_number(r.p99_m, 3),
            format_number(r.max_m, 3),
        )
        for r in results
    )
    return StudyTable("Displaced stations", HEADINGS, lines)
