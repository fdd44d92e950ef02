# SPDX-License-Identifier: Apache-2.0
"""Studies of map fusion: methods side by side over places, counts of observations and seeds, compared with margins.

A cell is a place and a seed; intervals are percentile bootstraps over cells (Efron and Tibshirani, 1993), 95 %, and a difference
of two methods is paired over the same cells. The best baseline at a count has the greatest mean there. A margin is met
or not met by the whole interval; where the interval contains the margin, the verdict is "inconclusive".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.maps.experiment import FleetTrial
from manyeyes.evaluation.maps.map_cells import MapStudyJob, MapStudyResult, run_study_job
from manyeyes.evaluation.maps.oracles import ORACLES
from manyeyes.evaluation.maps.registry import MethodSettings
from manyeyes.evaluation.statistics.bootstrap import Interval, MarginVerdict, compare_to_margin, mean_interval
from manyeyes.maps.registry import OURS, list_map_fusions
from manyeyes.maps.store.executors import Executor, map_blocks
from manyeyes.simulator.fleet.config import CROWDS

TEST_PLACES = ("Town03", "Town05", "av2-miami", "av2-pittsburgh")
TUNING_PLACES = ("Town01", "Town02", "Town07")
OBSERVATION_COUNTS, SEEDS = (20, 60, 200), (0, 1, 2)
NOISE_SIGMAS_M = (0.0, 0.4, 0.8, 1.2, 1.5)
NOISE_NUM_OBSERVATIONS = 100
TABLE3 = (("Town05", 300.0), ("Town03", 250.0))
TABLE3_NUM_OBSERVATIONS = 60


@dataclass(frozen=True)
class MapStudyConfig:
    """Which trials and methods. counts and noise are used by the studies that have them."""

    name: str
    places: tuple[str, ...] = TEST_PLACES
    observation_counts: tuple[int, ...] = OBSERVATION_COUNTS
    seeds: tuple[int, ...] = SEEDS
    noise_sigmas_m: tuple[float, ...] = NOISE_SIGMAS_M
    methods: tuple[str, ...] = field(default_factory=list_map_fusions)
    settings: MethodSettings = field(default_factory=MethodSettings)


def make_trials(config: MapStudyConfig) -> list[FleetTrial]:
    """The trials of a study, places together: a place is read once a process."""
    fleet_config = CROWDS["local"]
    if config.name == "fusion":
        return [
            FleetTrial(p, n, s, fleet_config=fleet_config)
            for p in config.places
            for n in config.observation_counts
            for s in config.seeds
        ]
    if config.name == "fleet-pose-noise":
        noise_free = [
            FleetTrial(p, NOISE_NUM_OBSERVATIONS, s, fleet_config=fleet_config)
            for p in config.places
            for s in config.seeds
        ]
        return [trial.with_pose_noise(sigma) for trial in noise_free for sigma in config.noise_sigmas_m]
    if config.name == "crowdmap-table3":
        view_labels = ("local", "semi-global")
        return [
            FleetTrial(p, TABLE3_NUM_OBSERVATIONS, s, size, view_label, CROWDS[view_label])
            for p, size in TABLE3
            for view_label in view_labels
            for s in config.seeds
        ]
    raise ConfigError(
        f"No study is called {config.name!r}; known: fusion, fleet-pose-noise, crowdmap-table3, adversarial, tuning."
    )


def run_map_study(
    config: MapStudyConfig, results_folder: Path, executor: Executor, progress: Callable[[int, int], None] | None = None
) -> tuple[MapStudyResult, ...]:
    """All cells of a study, in its own order whatever the executor; those kept in the folder are not made again."""
    jobs = [MapStudyJob(trial, config.methods, config.settings, results_folder) for trial in make_trials(config)]
    with executor.open() as session:
        results_by_job = map_blocks(run_study_job, jobs, session, progress)
    return tuple(result for job_results in results_by_job for result in job_results)


@dataclass(frozen=True)
class MethodSummary:
    """A method's means over cells, with the interval of its mAP (exact, narrow)."""

    group: str
    method: str
    num_results: int
    crossing: float
    divider: float
    mean_ap: Interval
    maptr: float
    streammapnet: float
    f1: float
    duplication: float
    fragmentation: float
    lateral_error_m: float
    endpoint_error_m: float
    seconds: float


@dataclass(frozen=True)
class StudyMarginTest:
    """A margin of the study, the measured value and its interval, and the verdict."""

    group: str
    description: str
    baseline: str
    value: float
    low: float
    high: float
    margin: float
    verdict: MarginVerdict


def group_name(config: MapStudyConfig, result: MapStudyResult) -> str:
    """Which table a cell belongs to."""
    if config.name == "fleet-pose-noise":
        return f"{result.pose_sigma_m:g} m"
    if config.name == "crowdmap-table3":
        return f"{result.size_m:g} m {result.place}, {result.view_label}"
    return f"{result.num_observations} observations"


def summarize_methods(config: MapStudyConfig, results: Sequence[MapStudyResult]) -> tuple[MethodSummary, ...]:
    """The table: a group after the other, methods in the order of the study."""
    out = []
    for group in dict.fromkeys(group_name(config, result) for result in results):
        for method in config.methods:
            method_results = [c for c in results if group_name(config, c) == group and c.method == method]
            if method_results:
                out.append(_summarize(group, method, method_results))
    return tuple(out)


def _summarize(group: str, method: str, results: Sequence[MapStudyResult]) -> MethodSummary:
    dividers = [c.get_kind("divider") for c in results]
    return MethodSummary(
        group=group,
        method=method,
        num_results=len(results),
        crossing=_mean([c.get_ap("crossing") for c in results]),
        divider=_mean([c.get_ap("divider") for c in results]),
        mean_ap=mean_interval([c.get_ap() for c in results]),
        maptr=_mean([c.get_ap(protocol="maptr") for c in results]),
        streammapnet=_mean([c.get_ap(protocol="streammapnet", thresholds="wide") for c in results]),
        f1=_mean([d.f1[1] for d in dividers]),
        duplication=_mean([d.duplication for d in dividers]),
        fragmentation=_mean([d.fragmentation for d in dividers]),
        lateral_error_m=_mean([d.lateral_median_m for d in dividers]),
        endpoint_error_m=_mean([d.endpoint_error_m for d in dividers]),
        seconds=_mean([c.seconds for c in results]),
    )


def check_margins(config: MapStudyConfig, results: Sequence[MapStudyResult]) -> tuple[StudyMarginTest, ...]:
    """The bars of the fusion study, at each count; nothing for other studies."""
    if config.name != "fusion" or OURS not in config.methods:
        return ()
    out = []
    for group in dict.fromkeys(group_name(config, result) for result in results):
        group_results = [c for c in results if group_name(config, c) == group]
        for protocol, thresholds in (("exact", "narrow"), ("maptr", "narrow"), ("streammapnet", "wide")):
            out += _check_best_baseline(group, group_results, config.methods, protocol, thresholds)
        if group.startswith("60 "):
            out += _check_dividers(group, group_results, config.methods)
        if group.startswith("200 "):
            ours = [c.get_kind("divider") for c in group_results if c.method == OURS]
            f1, duplication = mean_interval([k.f1[1] for k in ours]), mean_interval([k.duplication for k in ours])
            out.append(
                StudyMarginTest(
                    group,
                    "F@0.5 m of dividers",
                    "",
                    f1.value,
                    f1.low,
                    f1.high,
                    0.97,
                    compare_to_margin(0.97, f1.low, f1.high),
                )
            )
            low, high = duplication.low, duplication.high
            # Within both sides: the worse of two words.
            verdicts = compare_to_margin(0.95, low, high), compare_to_margin(-1.05, -high, -low)
            verdict: MarginVerdict = (
                "met" if verdicts == ("met",) * 2 else "not met" if "not met" in verdicts else "inconclusive"
            )
            description = "duplication of dividers, 0.95 to 1.05"
            out.append(StudyMarginTest(group, description, "", duplication.value, low, high, 1.0, verdict))
    return tuple(out)


def _check_best_baseline(
    group: str, results: Sequence[MapStudyResult], methods: Sequence[str], protocol: str, thresholds: str
) -> list[StudyMarginTest]:
    baseline = find_best_baseline(results, methods, "mean_ap", protocol, thresholds)
    if baseline is None:
        return []
    gain = compute_paired_difference(results, OURS, baseline, "mean_ap", protocol, thresholds)
    description = f"mAP ({protocol}, {thresholds}) above the best baseline"
    return [
        StudyMarginTest(
            group,
            description,
            baseline,
            gain.value,
            gain.low,
            gain.high,
            0.10,
            compare_to_margin(0.10, gain.low, gain.high),
        )
    ]


def _check_dividers(group: str, results: Sequence[MapStudyResult], methods: Sequence[str]) -> list[StudyMarginTest]:
    """AP of dividers: twice the best baseline's, or half of its remaining error."""
    baseline = find_best_baseline(results, methods, "divider", "exact", "narrow")
    if baseline is None:
        return []
    baseline_ap = _mean([c.get_ap("divider") for c in results if c.method == baseline])
    margin = min(2 * baseline_ap, baseline_ap + 0.5 * (1 - baseline_ap))
    ours = mean_interval([c.get_ap("divider") for c in results if c.method == OURS])
    description = f"AP of dividers; {baseline} has {baseline_ap:.3f}"
    return [
        StudyMarginTest(
            group,
            description,
            baseline,
            ours.value,
            ours.low,
            ours.high,
            margin,
            compare_to_margin(margin, ours.low, ours.high),
        )
    ]


def find_best_baseline(
    results: Sequence[MapStudyResult], methods: Sequence[str], kind: str, protocol: str, thresholds: str
) -> str | None:
    """The baseline with the greatest mean AP; of equal ones the first. Oracles are no baselines."""
    baselines = [m for m in methods if m != OURS and m not in ORACLES]
    means = [_mean([c.get_ap(kind, protocol, thresholds) for c in results if c.method == m]) for m in baselines]
    known = [(-mean, k) for k, mean in enumerate(means) if not math.isnan(mean)]
    return baselines[min(known)[1]] if known else None


def compute_paired_difference(
    results: Sequence[MapStudyResult], first_method: str, second_method: str, kind: str, protocol: str, thresholds: str
) -> Interval:
    """AP of one method less that of another, paired over the cells that both have."""

    def ap_by_key(method: str) -> dict[tuple[object, ...], float]:
        return {
            (c.place, c.size_m, c.view_label, c.num_observations, c.seed, c.pose_sigma_m): c.get_ap(
                kind, protocol, thresholds
            )
            for c in results
            if c.method == method
        }

    one, other = ap_by_key(first_method), ap_by_key(second_method)
    gains = [one[key] - other[key] for key in sorted(one.keys() & other.keys())]
    return mean_interval([g for g in gains if not math.isnan(g)])


def _mean(values: Sequence[float]) -> float:
    """The mean of those that are numbers; NaN where none is."""
    known = [v for v in values if not math.isnan(v)]
    return float(np.mean(known)) if known else math.nan


def restrict_study(
    config: MapStudyConfig, places: Sequence[str] | None, observation_counts: Sequence[int] | None, num_seeds: int
) -> MapStudyConfig:
    """A study over fewer places, counts or seeds."""
    return replace(
        config,
        places=tuple(places or config.places),
        observation_counts=tuple(observation_counts or config.observation_counts),
        seeds=tuple(range(num_seeds)),
    )
