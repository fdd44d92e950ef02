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

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from manyeyes._io import atomic_write
from manyeyes.datatypes.map_element import KINDS
from manyeyes.evaluation.maps.experiment import Trial, carry_out
from manyeyes.evaluation.maps.map_cells import Unit, cell_path, numbers, plain
from manyeyes.evaluation.maps.metrics import lines_of_kind
from manyeyes.evaluation.maps.registry import OURS, Settings, map_of
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.store.executors import Executor, map_blocks
from manyeyes.ops.nearest_line import nearest_line
from manyeyes.simulator.fleet.config import CROWDS
from manyeyes.simulator.fleet.simulate import MALICIOUS

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
    """What one process does at a time. folder: where trials that are done are kept."""

    trial: Trial
    settings: Settings
    folder: Path


def malice_units(
    places: Sequence[str],
    seeds: Sequence[int],
    settings: Settings,
    folder: Path,
    offsets_m: Sequence[float] = OFFSETS_M,
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
                    units.append(MaliceUnit(Trial(place, COUNT, seed, window=manner, crowd=crowd), settings, folder))
    return units


def run_malice(
    units: Sequence[MaliceUnit], executor: Executor, progress: Callable[[int, int], None] | None = None
) -> tuple[Malice, ...]:
    """All trials, in order."""
    with executor.open() as runner:
        return tuple(map_blocks(kept_malice, units, runner, progress))


def kept_malice(unit: MaliceUnit) -> Malice:
    """One trial, found where it was done before with the same code and settings, else done and kept."""
    path = cell_path(Unit(unit.trial, (OURS,), unit.settings, unit.folder / "malicious"), OURS)
    try:
        return Malice(**numbers(json.loads(path.read_text(encoding="utf-8"))))
    except (OSError, ValueError, TypeError):
        found = malice(unit)
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, (json.dumps(plain(found), indent=1) + "\n").encode())
    return found


def malice(unit: MaliceUnit) -> Malice:
    """One trial."""
    trial, scene = unit.trial, carry_out(unit.trial)
    alone, by_truth = _without_lies(_truthful(trial), unit.settings)
    away = displacement(alone, map_of(OURS, scene.observations, unit.settings, scene.place.frame))
    finite = away[np.isfinite(away)]
    return Malice(
        place=trial.place,
        seed=trial.seed,
        manner=trial.window,
        offset_m=trial.crowd.malicious_offset[0],
        observations=len(scene.observations),
        malicious=sum(int(role == MALICIOUS) for role in scene.crowd.roles),
        stations=len(away),
        moved=int((away > BAR_M).sum()),
        lost=int(np.isinf(away).sum()),
        by_truth=by_truth,
        p99_m=float(np.quantile(finite, 0.99)) if len(finite) else math.nan,
        largest_m=float(finite.max()) if len(finite) else math.nan,
    )


def _truthful(trial: Trial) -> Trial:
    """The trial whose malicious agents say what they saw: one and the same for every manner and size of lie."""
    crowd = replace(trial.crowd, malicious="independent", malicious_offset=(0.0, 0.0))
    return replace(trial, window="truthful", crowd=crowd)


@lru_cache(maxsize=1)
def _without_lies(trial: Trial, settings: Settings) -> tuple[VectorMap, int]:
    """The map of the honest agents alone, and how many of its stations the others move by telling the truth."""
    scene = carry_out(trial)
    honest = [o for o, role in zip(scene.observations, scene.crowd.roles) if role != MALICIOUS]
    alone, told = (map_of(OURS, seen, settings, scene.place.frame) for seen in (honest, scene.observations))
    return alone, int((displacement(alone, told) > BAR_M).sum())


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
