# SPDX-License-Identifier: Apache-2.0
"""Tuning every method with the same budget, on places that no study judges.

Each method gets the same number of configurations: its defaults, then draws from the table below, keyed by its name, so that more
trials extend fewer. A configuration is scored by the mean mAP (exact, narrow; crossing and divider) over the tuning places and
counts, one seed that no study uses; of equal ones the first stays. Fields that all baselines share (pre-filter, score and state:
``rules.``) are drawn too. Our own method is tuned by the same draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from manyeyes.evaluation.maps.experiment import FleetTrial
from manyeyes.evaluation.maps.registry import MethodSettings, apply_changes, check_method, make_default_config
from manyeyes.maps.registry import OURS, VARIANTS, list_map_fusions
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.simulator.fleet.config import CROWDS
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.maps.fleet_cells import FleetJob
from manyeyes.studies.options import TuningOptions
from manyeyes.viz.study_table import StudyTable

NUM_CONFIGS, SEED = 8, 1000
PLACES, OBSERVATION_COUNTS = ("Town07", "cross"), (20, 60)

SearchSpace = dict[str, tuple[Any, ...]]
_DISTANCES_M = (0.5, 0.75, 1.0, 1.5, 2.0)
_RULES: SearchSpace = {
    "rules.min_score": (0.0, 0.2, 0.3, 0.4, 0.5),
    "rules.publish_log_odds": (-6.0, 0.0, 1.0, 2.2),
    "rules.min_observations": (1, 2, 3),
}
SEARCH_SPACE: dict[str, SearchSpace] = {
    OURS: {
        "pose_solver.sigma_m": (0.1, 0.2, 0.3),
        "pose_solver.points_per_independent": (4.0, 8.0, 16.0),
        "stations.min_support": (1, 2, 3),
        "stations.ridge.lateral_sigma_m": (0.35, 0.45, 0.6),
        "stations.evidence.min_publish_prob": (0.5, 0.65, 0.75, 0.9),
        "link.max_join_gap_m": (6.0, 12.0, 18.0),
        "link.max_lateral_m": (0.25, 0.4, 0.6),
    },
    "union": _RULES,
    "chamfer-nms": {"max_chamfer_m": _DISTANCES_M, **_RULES},
    "crowdmap-literal": {
        "max_overlap_chamfer_m": _DISTANCES_M,
        "max_registered_chamfer_m": _DISTANCES_M,
        "merge": ("keep", "mean"),
        "cpd.outlier_fraction": (0.0, 0.1, 0.3),
        **_RULES,
    },
    "crowdmap-graph": {
        "graph.max_overlap_offset_m": _DISTANCES_M,
        "min_overlap_fraction": (0.4, 0.6, 0.8),
        "max_registered_chamfer_m": _DISTANCES_M,
        **_RULES,
    },
    "polymerge": {"max_vertex_distance_m": _DISTANCES_M, "min_fraction": (0.3, 0.5), **_RULES},
    "frechet-clustering": {
        "max_frechet_m": (1.0, 1.5, 1.75, 2.0, 3.0),
        "linkage": ("average", "single", "complete"),
        "representative": ("mean", "medoid"),
        **_RULES,
    },
    "heatmap-buffer": {
        "buffer_m": (0.3, 0.5, 0.75, 1.0),
        "min_view_fraction": (0.2, 0.3, 0.4, 0.5),
        "simplify_m": (0.1, 0.2, 0.5),
        **_RULES,
    },
    "global-map-builder": {"simplify_m": (0.2, 0.5, 1.0), "max_buffer_iou": (0.1, 0.3), **_RULES},
}


@dataclass(frozen=True)
class SearchTrial:
    """One configuration and its mean AP; changes: the drawn fields that differ from the defaults."""

    method: str
    config_index: int
    changes: tuple[tuple[str, Any], ...]
    mean_ap: float


def list_tuned_methods() -> tuple[str, ...]:
    """Return the methods that have a configuration of their own to tune."""
    return tuple(name for name in list_map_fusions() if name not in VARIANTS)


def sample_changes(method: str, config_index: int) -> tuple[tuple[str, Any], ...]:
    """Return the fields of one configuration; number 0 is the defaults."""
    if config_index == 0:
        return ()
    applicable = [item for item in SEARCH_SPACE[method].items() if _has_field(make_default_config(method), item[0])]
    unit = keyed_uniform((len(applicable),), SEED, "map-tuning", method.replace("-", "_"), config_index).numpy()
    return tuple((name, values[int(u * len(values))]) for (name, values), u in zip(applicable, unit))


def make_settings(method: str, config: Any) -> MethodSettings:
    """Settings in which one method is configured so."""
    return MethodSettings(((method, config),))


def run(options: TuningOptions, context: StudyContext) -> None:
    """Run the search and write its report."""
    for method in options.methods:
        check_method(method)
    trials = run_random_search(context, options.methods or list_tuned_methods(), options.workers)
    defaults = {trial.method: trial.mean_ap for trial in trials if trial.config_index == 0}
    best = {trial.method: trial for trial in reversed(trials)}
    lines = tuple(
        (m, ", ".join(f"{name}={value}" for name, value in best[m].changes), f"{best[m].mean_ap:.3f}", f"{ap:.3f}")
        for m, ap in defaults.items()
    )
    table = StudyTable("Best configurations", ("method", "changes", "mAP", "mAP of the defaults"), lines)
    payload: dict[str, object] = {"budget": NUM_CONFIGS, "search_trials": trials}
    context.write_report("Random search with equal budgets", payload, [table], config={"search_space": SEARCH_SPACE})


def run_random_search(
    context: StudyContext, methods: Sequence[str], workers: int, num_configs: int = NUM_CONFIGS
) -> tuple[SearchTrial, ...]:
    """Evaluate every method's configurations, the best of each method first."""
    candidates = [(method, config_index) for method in methods for config_index in range(num_configs)]
    settings = [make_settings(m, apply_changes(make_default_config(m), sample_changes(m, k))) for m, k in candidates]
    jobs = [
        FleetJob(FleetTrial(place, count, SEED, fleet_config=CROWDS["local"]), (method,), one, context.store)
        for place in PLACES
        for count in OBSERVATION_COUNTS
        for (method, _), one in zip(candidates, settings)
    ]
    results = [result for part in context.run_jobs(jobs, workers, "Trials") for result in part]
    mean_ap = np.array([result.get_ap() for result in results]).reshape(-1, len(candidates))
    search_trials = [
        SearchTrial(method, config_index, sample_changes(method, config_index), float(np.nanmean(mean_ap[:, k])))
        for k, (method, config_index) in enumerate(candidates)
    ]
    return tuple(sorted(search_trials, key=lambda a: (methods.index(a.method), -a.mean_ap, a.config_index)))


def _has_field(config: Any, name: str) -> bool:
    head, _, rest = name.partition(".")
    return hasattr(config, head) and (not rest or _has_field(getattr(config, head), rest))
