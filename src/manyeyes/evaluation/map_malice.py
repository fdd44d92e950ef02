# SPDX-License-Identifier: Apache-2.0
"""Do liars move the map? What honest agents alone agree on, against what the same agents and the liars give.

A crowd of 200 in which a share of agents is malicious (their elements are moved by 1 to 4 m, each its own way or all the same
way) is fused three times: without the malicious agents' observations, with them, and with the same observations free of their
lie. Judged are the stations of published lines of the honest map that five or more agents saw: how far across the nearest
published line of its kind in the other map each lies (along a line there is no place to be moved from). Where no such line is
within 2 m the station is lost, which counts as moved. More observations move a map even when they are true, since it lies where
claims that scatter have their mode: ``by_truth`` counts that, and is what ``moved`` is to be held against.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from manyeyes.datatypes.map_element import KINDS
from manyeyes.evaluation.map_methods import OURS, Settings, map_of
from manyeyes.evaluation.map_quality import lines_of_kind
from manyeyes.evaluation.map_trial import Trial, carry_out
from manyeyes.maps.engine import Executor, map_blocks
from manyeyes.maps.vector_map import VectorMap
from manyeyes.ops.nearest_line import nearest_line
from manyeyes.simulator.crowd.config import CROWDS
from manyeyes.simulator.crowd.simulate import MALICIOUS

COUNT, SHARE, AGENTS, BAR_M, LOST_M = 200, 0.2, 5, 0.1, 2.0
OFFSETS_M = (1.0, 2.0, 3.0, 4.0)
MANNERS = ("independent", "colluding")


@dataclass(frozen=True)
class Malice:
    """One crowd with liars. stations: judged; lost: with no line near; moved: beyond the bar, lost included.

    by_truth: as moved, when the same agents say the same without their lie.
    """

    place: str
    seed: int
    manner: str
    offset_m: float
    observations: int
    malicious: int
    stations: int
    moved: int
    lost: int
    by_truth: int
    p99_m: float
    largest_m: float


@dataclass(frozen=True)
class MaliceUnit:
    """What one process does at a time."""

    trial: Trial
    settings: Settings


def malice_units(
    places: Sequence[str], seeds: Sequence[int], settings: Settings, offsets_m: Sequence[float] = OFFSETS_M
) -> list[MaliceUnit]:
    """The trials: places, seeds, both manners, and every size of lie."""
    units = []
    for place in places:
        for seed in seeds:
            for manner in ("independent", "colluding"):
                for offset in offsets_m:
                    crowd = replace(
                        CROWDS["local"], malicious_share=SHARE, malicious=manner, malicious_offset=(offset, offset)
                    )
                    units.append(MaliceUnit(Trial(place, COUNT, seed, window=manner, crowd=crowd), settings))
    return units


def run_malice(
    units: Sequence[MaliceUnit], executor: Executor, progress: Callable[[int, int], None] | None = None
) -> tuple[Malice, ...]:
    """All trials, in order."""
    with executor.open() as runner:
        return tuple(map_blocks(malice, units, runner, progress))


def malice(unit: MaliceUnit) -> Malice:
    """One trial."""
    scene = carry_out(unit.trial)
    honest = [o for o, role in zip(scene.observations, scene.crowd.roles) if role != MALICIOUS]
    trial, frame = unit.trial, scene.place.frame
    true = carry_out(replace(trial, crowd=replace(trial.crowd, malicious_offset=(0.0, 0.0)))).observations
    alone, lied, told = (map_of(OURS, seen, unit.settings, frame) for seen in (honest, scene.observations, true))
    away, by_truth = displacement(alone, lied), displacement(alone, told)
    finite = away[np.isfinite(away)]
    return Malice(
        place=trial.place,
        seed=trial.seed,
        manner=trial.window,
        offset_m=trial.crowd.malicious_offset[0],
        observations=len(scene.observations),
        malicious=len(scene.observations) - len(honest),
        stations=len(away),
        moved=int((away > BAR_M).sum()),
        lost=int(np.isinf(away).sum()),
        by_truth=int((by_truth > BAR_M).sum()),
        p99_m=float(np.quantile(finite, 0.99)) if len(finite) else math.nan,
        largest_m=float(finite.max()) if len(finite) else math.nan,
    )


def displacement(alone: VectorMap, together: VectorMap, agents: int = AGENTS) -> np.ndarray:
    """(S,) metres across the nearest line of its kind in another map, of each well-seen station; inf where there is none near."""
    before, after = alone.published(), together.published()
    kind = before.elements.kind[before.elements.owner]
    out = []
    for code, name in enumerate(KINDS):
        chosen = (kind == code) & (before.stations.agents >= agents)
        lines = lines_of_kind(after.elements, name)
        out.append(np.abs(nearest_line(before.elements.points[chosen], lines.points, lines.first, LOST_M).across))
    return np.concatenate(out)
