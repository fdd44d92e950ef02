# SPDX-License-Identifier: Apache-2.0
"""Cells of map fusion studies: one method on one trial of a simulated fleet, evaluated."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial

from manyeyes.evaluation.maps.experiment import FleetTrial, run_trial
from manyeyes.evaluation.maps.metrics import MapMetrics, Thresholds, evaluate_map
from manyeyes.evaluation.maps.oracles import ORACLES
from manyeyes.evaluation.maps.registry import MethodSettings, fuse_experiment
from manyeyes.maps.registry import MAP_FUSION_METHODS
from manyeyes.studies.engine.cells import Cell, CellStore, third_party_source

MEAN_AP = "mean_ap"


@dataclass(frozen=True)
class FleetResult:
    """A method's metrics on a trial. seconds: of the method alone."""

    place: str
    size_m: float
    view_label: str
    num_observations: int
    seed: int
    pose_sigma_m: float
    method: str
    seconds: float
    metrics: MapMetrics

    def get_ap(self, kind: str = MEAN_AP, protocol: str = "exact", thresholds: Thresholds = "narrow") -> float:
        """Get the AP of a kind, or mAP of crossings and dividers."""
        if kind == MEAN_AP:
            return self.metrics.mean_ap(protocol, thresholds)
        return self.metrics.get_ap(kind, protocol, thresholds)


@dataclass(frozen=True)
class FleetJob:
    """One trial and all methods on it: what one process does at a time."""

    trial: FleetTrial
    methods: tuple[str, ...]
    settings: MethodSettings
    store: CellStore

    def __call__(self) -> list[FleetResult]:
        """Load or compute the cells of the trial."""
        return [
            self.store.load_or_compute(
                make_cell(self.trial, method, self.settings), partial(run_method, self.trial, method, self.settings)
            )
            for method in self.methods
        ]


def make_cell(trial: FleetTrial, method: str, settings: MethodSettings) -> Cell[FleetResult]:
    """Describe the cell of a method on a trial."""
    name = f"{trial.place}-{trial.view_label}-{trial.num_observations:04d}-{trial.seed}-{method}"
    key = trial, method, settings.config_of(method), method_source(method)
    return Cell(name, FleetResult, key, (__name__,))


def method_source(method: str) -> str:
    """Return the source of a third party's map fusion method; empty for one of the package."""
    return "" if method in ORACLES else third_party_source(MAP_FUSION_METHODS.get(method).fuse)


def run_method(trial: FleetTrial, method: str, settings: MethodSettings) -> FleetResult:
    """Run one method on a trial, and evaluate its map."""
    experiment = run_trial(trial)
    start = time.perf_counter()
    elements = fuse_experiment(method, experiment, settings)
    seconds = time.perf_counter() - start
    return FleetResult(
        place=trial.place,
        size_m=trial.size_m,
        view_label=trial.view_label,
        num_observations=trial.num_observations,
        seed=trial.seed,
        pose_sigma_m=trial.fleet_config.pose_sigma_m,
        method=method,
        seconds=seconds,
        metrics=evaluate_map(experiment.cut_policy(elements), experiment.truth),
    )
