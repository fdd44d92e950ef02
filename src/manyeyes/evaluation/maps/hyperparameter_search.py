# SPDX-License-Identifier: Apache-2.0
"""Tuning every method with the same budget, on places that no study judges.

Each method gets the same number of configurations: its defaults, then draws from the table below, keyed by its name, so that more
trials extend fewer. A configuration's worth is the mean mAP (exact, narrow; crossing and divider) over the tuning places and
counts, one seed that no study uses; of equal ones the first stays. Fields that all rivals share (pre-filter, score and state:
``rules.``) are drawn too. Our own method is tuned by the same draws.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from manyeyes.evaluation.maps.experiment import Trial
from manyeyes.evaluation.maps.map_cells import Unit, run_unit
from manyeyes.evaluation.maps.registry import OURS, Settings, configured, defaults
from manyeyes.maps.store.executors import Executor, map_blocks
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.simulator.fleet.config import CROWDS

BUDGET, SEED = 8, 1000
PLACES, COUNTS = ("Town07", "cross"), (20, 60)

Choices = dict[str, tuple[Any, ...]]
_GATES = (0.5, 0.75, 1.0, 1.5, 2.0)
_RULES: Choices = {
    "rules.min_score": (0.0, 0.2, 0.3, 0.4, 0.5),
    "rules.publish": (-6.0, 0.0, 1.0, 2.2),
    "rules.least_observations": (1, 2, 3),
}
CHOICES: dict[str, Choices] = {
    OURS: {
        "align.sigma_m": (0.1, 0.2, 0.3),
        "align.correlation": (4.0, 8.0, 16.0),
        "stations.least_support": (1, 2, 3),
        "stations.ridge.across_sigma_m": (0.35, 0.45, 0.6),
        "stations.evidence.publish": (1.0, 1.5, 2.2, 3.0),
        "stations.evidence.publish_ring": (0.5, 1.0, 2.2),
        "stations.evidence.publish_seldom": (0.3, 1.0, 2.2),
        "stations.evidence.publish_agents": (1, 2),
        "link.join_m": (6.0, 12.0, 18.0),
        "link.lateral_m": (0.25, 0.4, 0.6),
    },
    "union": _RULES,
    "chamfer_nms": {"gate_m": _GATES, **_RULES},
    "crowdmap_literal": {
        "gate_m": _GATES,
        "accept_m": _GATES,
        "merge": ("keep", "mean"),
        "cpd.outlier": (0.0, 0.1, 0.3),
        **_RULES,
    },
    "polymerge": {"gate_m": _GATES, "share": (0.3, 0.5), **_RULES},
    "frechet_clustering": {
        "gate_m": (1.0, 1.5, 1.75, 2.0, 3.0),
        "linkage": ("average", "single", "complete"),
        "take": ("mean", "medoid"),
        **_RULES,
    },
    "heatmap_buffer": {
        "buffer_m": (0.3, 0.5, 0.75, 1.0),
        "share": (0.2, 0.3, 0.4, 0.5),
        "simplify_m": (0.1, 0.2, 0.5),
        **_RULES,
    },
    "global_map_builder": {"simplify_m": (0.2, 0.5, 1.0), "overlap": (0.1, 0.3), **_RULES},
}


@dataclass(frozen=True)
class Attempt:
    """One configuration and its worth; changed: the drawn fields that differ from the defaults."""

    method: str
    number: int
    changed: tuple[tuple[str, Any], ...]
    worth: float


def drawn(method: str, number: int) -> tuple[tuple[str, Any], ...]:
    """The fields of one configuration; number 0 is the defaults."""
    if number == 0:
        return ()
    known = [item for item in CHOICES[method].items() if _has(defaults(method), item[0])]
    unit = keyed_uniform((len(known),), SEED, "map-tuning", method, number).numpy()
    return tuple((name, values[int(u * len(values))]) for (name, values), u in zip(known, unit))


def settings_with(method: str, config: Any) -> Settings:
    """Settings in which one method is configured so."""
    return Settings(ours=config) if method == OURS else Settings(chosen=((method, config),))


def tune(
    methods: Sequence[str],
    folder: Path,
    executor: Executor,
    progress: Callable[[int, int], None] | None = None,
    budget: int = BUDGET,
) -> tuple[Attempt, ...]:
    """Every method's configurations with their worth, the best of each method first."""
    asked = [(method, number) for method in methods for number in range(budget)]
    units = []
    for place in PLACES:
        for count in COUNTS:
            trial = Trial(place, count, SEED, crowd=CROWDS["local"])
            for method, number in asked:
                config = configured(defaults(method), drawn(method, number))
                units.append(Unit(trial, (method,), settings_with(method, config), folder))
    with executor.open() as runner:
        cells = [cell for held in map_blocks(run_unit, units, runner, progress) for cell in held]
    worth = np.array([cell.ap_of() for cell in cells]).reshape(-1, len(asked))
    attempts = [
        Attempt(method, number, drawn(method, number), float(np.nanmean(worth[:, k])))
        for k, (method, number) in enumerate(asked)
    ]
    return tuple(sorted(attempts, key=lambda a: (methods.index(a.method), -a.worth, a.number)))


def _has(config: Any, name: str) -> bool:
    head, _, rest = name.partition(".")
    return hasattr(config, head) and (not rest or _has(getattr(config, head), rest))
