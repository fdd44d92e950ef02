# SPDX-License-Identifier: Apache-2.0
"""Displacement of a fused map by malicious agents, against the map of the honest agents alone.

A fleet of 200 observations with a fraction of malicious agents (their elements are moved by 1 to 4 m, independently or all alike)
is fused three times: without the malicious agents' observations, with them, and with the same observations without the
attack. Evaluated are the stations of published lines of the honest map that five or more agents saw: how far across the nearest
published line of its kind in the other map each lies (along a line there is no place to be moved from). Where no such line is
within 2 m the station is lost, which counts as moved. More observations move a map even when they are true, since it lies where
claims that scatter have their mode: ``num_displaced_without_attack`` counts that, and is the reference of ``num_displaced``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from manyeyes._io import atomic_write
from manyeyes.datatypes.map_element import KINDS
from manyeyes.evaluation.maps.experiment import FleetTrial, run_trial
from manyeyes.evaluation.maps.map_cells import MapStudyJob, map_result_path, restore_row, to_plain
from manyeyes.evaluation.maps.metrics import select_lines
from manyeyes.evaluation.maps.registry import MethodSettings, fuse_observations
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.registry import OURS
from manyeyes.maps.store.executors import Executor, map_blocks
from manyeyes.ops.nearest_line import find_nearest_line
from manyeyes.simulator.fleet.config import CROWDS
from manyeyes.simulator.fleet.simulate import MALICIOUS

NUM_OBSERVATIONS, MALICIOUS_FRACTION, MIN_AGENTS, MIN_DISPLACEMENT_M, MAX_DISPLACEMENT_M = 200, 0.2, 5, 0.1, 2.0
OFFSETS_M = (1.0, 2.0, 3.0, 4.0)
ATTACKS = ("independent", "colluding")


@dataclass(frozen=True)
class AdversarialResult:
    """One trial with malicious agents. num_stations: evaluated; num_lost: without a line nearby; num_displaced: beyond the
    threshold, lost ones included.

    num_displaced_without_attack: as num_displaced, for the same observations without the attack.
    """

    place: str
    seed: int
    attack: str
    offset_m: float
    num_observations: int
    num_malicious: int
    num_stations: int
    num_displaced: int
    num_lost: int
    num_displaced_without_attack: int
    p99_m: float
    max_m: float


@dataclass(frozen=True)
class AdversarialJob:
    """What one process does at a time. results_folder: where trials that are done are kept."""

    trial: FleetTrial
    settings: MethodSettings
    results_folder: Path


def make_adversarial_jobs(
    places: Sequence[str],
    seeds: Sequence[int],
    settings: MethodSettings,
    results_folder: Path,
    offsets_m: Sequence[float] = OFFSETS_M,
) -> list[AdversarialJob]:
    """The trials: places, seeds, both manners, and every size of lie."""
    jobs = []
    for place in places:
        for seed in seeds:
            for attack in ("independent", "colluding"):
                for offset in offsets_m:
                    fleet_config = replace(
                        CROWDS["local"],
                        malicious_fraction=MALICIOUS_FRACTION,
                        attack_mode=attack,
                        malicious_offset_m=(offset, offset),
                    )
                    jobs.append(
                        AdversarialJob(
                            FleetTrial(place, NUM_OBSERVATIONS, seed, view_label=attack, fleet_config=fleet_config),
                            settings,
                            results_folder,
                        )
                    )
    return jobs


def run_adversarial_jobs(
    jobs: Sequence[AdversarialJob], executor: Executor, progress: Callable[[int, int], None] | None = None
) -> tuple[AdversarialResult, ...]:
    """All trials, in order."""
    with executor.open() as session:
        return tuple(map_blocks(load_or_run_job, jobs, session, progress))


def load_or_run_job(job: AdversarialJob) -> AdversarialResult:
    """One trial, found where it was done before with the same code and settings, else done and kept."""
    path = map_result_path(MapStudyJob(job.trial, (OURS,), job.settings, job.results_folder / "malicious"), OURS)
    try:
        return AdversarialResult(**restore_row(json.loads(path.read_text(encoding="utf-8"))))
    except (OSError, ValueError, TypeError):
        result = run_adversarial_job(job)
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, (json.dumps(to_plain(result), indent=1) + "\n").encode())
    return result


def run_adversarial_job(job: AdversarialJob) -> AdversarialResult:
    """Run one trial of an attack."""
    trial, experiment = job.trial, run_trial(job.trial)
    honest_map, num_displaced_without_attack = _fuse_without_attack(_without_attack(trial), job.settings)
    displacement_m = measure_displacement(
        honest_map, fuse_observations(OURS, experiment.observations, job.settings, experiment.place.frame)
    )
    finite = displacement_m[np.isfinite(displacement_m)]
    return AdversarialResult(
        place=trial.place,
        seed=trial.seed,
        attack=trial.view_label,
        offset_m=trial.fleet_config.malicious_offset_m[0],
        num_observations=len(experiment.observations),
        num_malicious=sum(int(role == MALICIOUS) for role in experiment.fleet.roles),
        num_stations=len(displacement_m),
        num_displaced=int((displacement_m > MIN_DISPLACEMENT_M).sum()),
        num_lost=int(np.isinf(displacement_m).sum()),
        num_displaced_without_attack=num_displaced_without_attack,
        p99_m=float(np.quantile(finite, 0.99)) if len(finite) else math.nan,
        max_m=float(finite.max()) if len(finite) else math.nan,
    )


def _without_attack(trial: FleetTrial) -> FleetTrial:
    """The trial without displacement of elements; the same for every kind and size of attack."""
    fleet_config = replace(trial.fleet_config, attack_mode="independent", malicious_offset_m=(0.0, 0.0))
    return replace(trial, view_label="truthful", fleet_config=fleet_config)


@lru_cache(maxsize=1)
def _fuse_without_attack(trial: FleetTrial, settings: MethodSettings) -> tuple[VectorMap, int]:
    """The map of the honest agents alone, and how many of its stations the other agents displace without an attack."""
    experiment = run_trial(trial)
    honest_observations = [o for o, role in zip(experiment.observations, experiment.fleet.roles) if role != MALICIOUS]
    honest_map, full_map = (
        fuse_observations(OURS, observations, settings, experiment.place.frame)
        for observations in (honest_observations, experiment.observations)
    )
    return honest_map, int((measure_displacement(honest_map, full_map) > MIN_DISPLACEMENT_M).sum())


def measure_displacement(reference: VectorMap, other: VectorMap, min_agents: int = MIN_AGENTS) -> np.ndarray:
    """(S,) metres across the nearest line of its kind in another map, of each well-seen station; inf where there is none near."""
    before, after = reference.select_published(), other.select_published()
    kind = before.elements.kind[before.elements.element_of_point]
    out = []
    for code, name in enumerate(KINDS):
        selected = (kind == code) & (before.point_evidence.agents >= min_agents)
        lines = select_lines(after.elements, name)
        out.append(
            np.abs(
                find_nearest_line(
                    before.elements.points[selected], lines.points, lines.offsets, MAX_DISPLACEMENT_M
                ).lateral_m
            )
        )
    return np.concatenate(out)
