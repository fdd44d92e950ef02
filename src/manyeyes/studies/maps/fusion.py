# SPDX-License-Identifier: Apache-2.0
"""Map fusion methods side by side over places, counts of observations, pose noise and seeds.

A cell is a place and a seed; intervals are percentile bootstraps over cells (Efron and Tibshirani, 1993), 95 %, and a difference
of two methods is paired over the same cells. The best baseline of a group has the greatest mean there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from manyeyes.evaluation.maps.experiment import FleetTrial
from manyeyes.evaluation.maps.metrics import Thresholds
from manyeyes.evaluation.maps.oracles import ORACLES
from manyeyes.evaluation.maps.registry import check_method, make_tuned_settings
from manyeyes.evaluation.statistics.bootstrap import Interval, mean_interval
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.maps.registry import MAP_MODEL, OURS, VARIANTS, list_map_fusions
from manyeyes.simulator.fleet.config import CROWDS
from manyeyes.simulator.fleet.place import check_place
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.maps.fleet_cells import MEAN_AP, FleetJob, FleetResult
from manyeyes.studies.options import FleetPoseNoiseOptions, FusionOptions, MapFusionStudyOptions
from manyeyes.viz.study_table import StudyTable, format_interval, format_number, make_comparison_table

TEST_PLACES = ("Town03", "Town05", "av2-miami", "av2-pittsburgh")
SHAPE_PLACES = ("roundabout", "merge")
"""Generated places of another shape than the tuning places, in tables of their own."""
OBSERVATION_COUNTS = (20, 60, 200)
NOISE_SIGMAS_M = (0.0, 0.4, 0.8, 1.2, 1.5)
NOISE_NUM_OBSERVATIONS = 100
TABLE3 = (("Town05", 300.0), ("Town03", 250.0))
TABLE3_NUM_OBSERVATIONS = 60
PROTOCOLS: tuple[tuple[str, Thresholds], ...] = (("exact", "narrow"), ("maptr", "narrow"), ("streammapnet", "wide"))
TITLES = {
    "fusion": "Fusion on places that nothing was tuned on",
    "fleet-pose-noise": "Fusion under pose noise",
    "crowdmap-table3": "Two intersections, stage-1 input local and semi-global (after CrowdMap, Table 3)",
}
HEADINGS = (
    "method", "AP crossing", "AP divider", "mAP Chamfer-exact [95 % CI]", "mAP MapTR",
    "mAP StreamMapNet (1.0/1.5/2.0 m)", "F1@0.5 m divider", "duplication", "fragmentation",
    "lateral error [m]", "lateral p95 [m]", "endpoint error [m]", "time [s]",
)  # fmt: skip


def run(options: MapFusionStudyOptions, context: StudyContext) -> None:
    """Run one of the three studies of this module and write its report."""
    for method in options.methods:
        check_method(method)
    if isinstance(options, FleetPoseNoiseOptions):
        for place in options.places:
            check_place(place)
    # Agents of a fleet detect lines as the defaults describe.
    default_methods = tuple(name for name in list_map_fusions() if name != MAP_MODEL)
    methods = (*(options.methods or default_methods), *(ORACLES if options.oracles else ()))
    settings, store = make_tuned_settings(), context.store
    jobs = [FleetJob(trial, methods, settings, store) for trial in make_trials(options, range(options.seeds))]
    results = [r for job_results in context.run_jobs(jobs, options.workers, "Trials") for r in job_results]
    groups: dict[str, list[FleetResult]] = {}
    for result in results:
        groups.setdefault(group_name(context.name, result), []).append(result)
    summaries = [_summarize(group, m, part) for group, part in groups.items() for m in methods]
    comparisons = (
        [c for group, part in groups.items() for c in compare_with_best(group, part, methods)]
        if context.name == "fusion" and OURS in methods
        else []
    )
    if OURS in methods and options.oracles:
        comparisons += [c for group, part in groups.items() for c in compare_with_oracle(group, part)]
    tables = [_make_table(group, [s for s in summaries if s.group == group]) for group in groups]
    tables += [make_comparison_table(comparisons, "results")] if comparisons else []
    payload: dict[str, object] = {"summaries": summaries, "comparisons": comparisons, "results": results}
    context.write_report(TITLES[context.name], payload, tables, config={"settings": settings})


def make_trials(options: MapFusionStudyOptions, seeds: Sequence[int]) -> list[FleetTrial]:
    """Make the trials of a study, places together: a place is read once a process."""
    local = CROWDS["local"]
    if isinstance(options, FusionOptions):
        return [
            FleetTrial(p, n, s, fleet_config=local)
            for p in options.places or (*TEST_PLACES, *SHAPE_PLACES)
            for n in options.observation_counts or OBSERVATION_COUNTS
            for s in seeds
        ]
    if isinstance(options, FleetPoseNoiseOptions):
        return [
            FleetTrial(p, NOISE_NUM_OBSERVATIONS, s, fleet_config=local).with_pose_noise(sigma)
            for p in options.places or TEST_PLACES
            for s in seeds
            for sigma in NOISE_SIGMAS_M
        ]
    return [
        FleetTrial(p, TABLE3_NUM_OBSERVATIONS, s, size, view_label, CROWDS[view_label])
        for p, size in TABLE3
        for view_label in ("local", "semi-global")
        for s in seeds
    ]


def group_name(study: str, result: FleetResult) -> str:
    """Name the table to which a result belongs."""
    if study == "fleet-pose-noise":
        return f"{result.pose_sigma_m:g} m"
    if study == "crowdmap-table3":
        return f"{result.size_m:g} m {result.place}, {result.view_label}"
    return f"{result.num_observations} observations" + (", other shapes" if result.place in SHAPE_PLACES else "")


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
    lateral_p95_m: float
    endpoint_error_m: float
    seconds: float


def _summarize(group: str, method: str, results: Sequence[FleetResult]) -> MethodSummary:
    own = [r for r in results if r.method == method]
    dividers = [r.metrics.get_kind("divider") for r in own]
    return MethodSummary(
        group=group,
        method=method,
        num_results=len(own),
        crossing=_mean([r.get_ap("crossing") for r in own]),
        divider=_mean([r.get_ap("divider") for r in own]),
        mean_ap=mean_interval([r.get_ap() for r in own]),
        maptr=_mean([r.get_ap(protocol="maptr") for r in own]),
        streammapnet=_mean([r.get_ap(protocol="streammapnet", thresholds="wide") for r in own]),
        f1=_mean([r.metrics.get_length_score("divider").f1 for r in own]),
        duplication=_mean([d.duplication for d in dividers]),
        fragmentation=_mean([d.fragmentation for d in dividers]),
        lateral_error_m=_mean([d.lateral_median_m for d in dividers]),
        lateral_p95_m=_mean([d.lateral_p95_m for d in dividers]),
        endpoint_error_m=_mean([d.endpoint_error_m for d in dividers]),
        seconds=_mean([r.seconds for r in own]),
    )


def compare_with_best(group: str, results: Sequence[FleetResult], methods: Sequence[str]) -> list[Comparison]:
    """Compare our mAP with the best baseline's in each protocol; list AP, F1 and duplication of our dividers."""
    out = []
    for protocol, thresholds in PROTOCOLS:
        baseline = find_best_baseline(results, methods, MEAN_AP, protocol, thresholds)
        if baseline is not None:
            gain = compute_paired_difference(results, OURS, baseline, MEAN_AP, protocol, thresholds)
            out.append(Comparison(f"{group}: {OURS} - {baseline}", f"mAP {protocol}, {thresholds}", gain))
    baseline = find_best_baseline(results, methods, "divider", "exact", "narrow")
    reference = None if baseline is None else _mean([r.get_ap("divider") for r in results if r.method == baseline])

    def measure(metric: str, value: Callable[[FleetResult], float], reference: float | None = None) -> None:
        interval = mean_interval([value(r) for r in results if r.method == OURS])
        out.append(Comparison(f"{group}: {OURS}", metric, interval, reference))

    measure("AP divider", lambda r: r.get_ap("divider"), reference)
    measure("F1@0.5 m divider", lambda r: r.metrics.get_length_score("divider").f1)
    measure("duplication divider", lambda r: r.metrics.get_kind("divider").duplication)
    return out


def compare_with_oracle(group: str, results: Sequence[FleetResult]) -> list[Comparison]:
    """Return our lateral errors over those of the oracle with joint poses and true associations, mean of ratios over cells."""
    ours, limit = (
        {
            (r.place, r.size_m, r.view_label, r.num_observations, r.seed): r.metrics.get_kind("divider")
            for r in results
            if r.method == m
        }
        for m in (OURS, "oracle-joint")
    )
    keys = sorted(ours.keys() & limit.keys())
    pairs = {
        "lateral median": [(ours[k].lateral_median_m, limit[k].lateral_median_m) for k in keys],
        "lateral p95": [(ours[k].lateral_p95_m, limit[k].lateral_p95_m) for k in keys],
    }
    return [
        Comparison(
            f"{group}: {OURS} / oracle-joint",
            name,
            mean_interval([a / b for a, b in values if b > 0 and not math.isnan(a)]),
        )
        for name, values in pairs.items()
    ]


def find_best_baseline(
    results: Sequence[FleetResult], methods: Sequence[str], kind: str, protocol: str, thresholds: Thresholds
) -> str | None:
    """Find the baseline with the greatest mean AP; of equal ones the first. Oracles and our other rows are no baselines."""
    baselines = [m for m in methods if m not in (OURS, *VARIANTS, *ORACLES)]
    means = [_mean([r.get_ap(kind, protocol, thresholds) for r in results if r.method == m]) for m in baselines]
    known = [(-mean, k) for k, mean in enumerate(means) if not math.isnan(mean)]
    return baselines[min(known)[1]] if known else None


def compute_paired_difference(
    results: Sequence[FleetResult], method: str, baseline: str, kind: str, protocol: str, thresholds: Thresholds
) -> Interval:
    """Return the AP of one method minus that of another, paired over the cells that both have."""

    def ap_by_key(method: str) -> dict[tuple[object, ...], float]:
        return {
            (r.place, r.size_m, r.view_label, r.num_observations, r.seed, r.pose_sigma_m): r.get_ap(
                kind, protocol, thresholds
            )
            for r in results
            if r.method == method
        }

    one, other = ap_by_key(method), ap_by_key(baseline)
    gains = [one[key] - other[key] for key in sorted(one.keys() & other.keys())]
    return mean_interval([g for g in gains if not math.isnan(g)])


def _make_table(group: str, summaries: Sequence[MethodSummary]) -> StudyTable:
    lines = tuple(
        (
            s.method,
            *(format_number(value, 3) for value in (s.crossing, s.divider)),
            format_interval(s.mean_ap),
            *(format_number(value, 3) for value in (s.maptr, s.streammapnet, s.f1)),
            *(format_number(v, 2) for v in (s.duplication, s.fragmentation)),
            *(format_number(v, 3) for v in (s.lateral_error_m, s.lateral_p95_m)),
            format_number(s.endpoint_error_m, 2),
            format_number(s.seconds, 1),
        )
        for s in summaries
    )
    return StudyTable(f"{group}, {summaries[0].num_results} results", HEADINGS, lines)


def _mean(values: Sequence[float]) -> float:
    """Return the mean of those that are numbers; NaN where none is."""
    known = [v for v in values if not math.isnan(v)]
    return float(np.mean(known)) if known else math.nan
