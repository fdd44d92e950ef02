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

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from manyeyes.datatypes.map_element import KINDS
from manyeyes.evaluation.maps.experiment import FleetTrial, run_trial
from manyeyes.evaluation.maps.metrics import select_lines
from manyeyes.evaluation.maps.registry import MethodSettings, fuse_observations
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.registry import OURS
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


def make_attacks(
    places: Sequence[str],
    seeds: Sequence[int],
    offsets_m: Sequence[float] = OFFSETS_M,
    fraction: float = MALICIOUS_FRACTION,
) -> list[FleetTrial]:
    """Make the trials: places, seeds, both attack modes, and every offset; fraction: of agents that are malicious."""
    return [
        FleetTrial(
            place,
            NUM_OBSERVATIONS,
            seed,
            view_label=attack,
            fleet_config=replace(
                CROWDS["local"],
                malicious_fraction=fraction,
                attack_mode=attack,
                malicious_offset_m=(offset, offset),
            ),
        )
        for place in places
        for seed in seeds
        for attack in ATTACKS
        for offset in offsets_m
    ]


def run_attack(trial: FleetTrial, settings: MethodSettings) -> AdversarialResult:
    """Run one trial of an attack."""
    experiment = run_trial(trial)
    honest_map, num_displaced_without_attack = _fuse_without_attack(_without_attack(trial), settings)
    fused = fuse_observations(OURS, experiment.observations, settings, experiment.place.frame)
    displacement_m = measure_displacement(honest_map, fused)
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
    """Return the trial without displacement of elements; the same for every kind and size of attack."""
    fleet_config = replace(trial.fleet_config, attack_mode="independent", malicious_offset_m=(0.0, 0.0))
    return replace(trial, view_label="truthful", fleet_config=fleet_config)


@lru_cache(maxsize=1)
def _fuse_without_attack(trial: FleetTrial, settings: MethodSettings) -> tuple[VectorMap, int]:
    """Return the map of the honest agents alone, and how many of its stations the other agents displace without an attack."""
    experiment = run_trial(trial)
    honest_observations = [o for o, role in zip(experiment.observations, experiment.fleet.roles) if role != MALICIOUS]
    honest_map, full_map = (
        fuse_observations(OURS, observations, settings, experiment.place.frame)
        for observations in (honest_observations, experiment.observations)
    )
    return honest_map, int((measure_displacement(honest_map, full_map) > MIN_DISPLACEMENT_M).sum())


def measure_displacement(reference: VectorMap, other: VectorMap, min_agents: int = MIN_AGENTS) -> np.ndarray:
    """Return (S,) metres across the nearest line of its kind in another map, of each well-seen station; inf where there is
    none near.
    """
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
