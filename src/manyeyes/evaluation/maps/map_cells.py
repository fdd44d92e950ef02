# SPDX-License-Identifier: Apache-2.0
"""Cells of a map study: one method on one trial, judged, kept as one JSON file that a study that was stopped finds again."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from inspect import getsource
from pathlib import Path
from typing import Any

from manyeyes._io import atomic_write
from manyeyes._source import source_digest
from manyeyes.datatypes.map_element import KINDS, MapElements
from manyeyes.evaluation.maps.experiment import FleetExperiment, FleetTrial, run_trial
from manyeyes.evaluation.maps.metrics import THRESHOLDS, MapMetrics, evaluate_map
from manyeyes.evaluation.maps.oracles import ORACLES
from manyeyes.evaluation.maps.registry import MethodSettings, fuse_experiment
from manyeyes.maps.registry import MAP_FUSION_METHODS


@dataclass(frozen=True)
class ApRow:
    """AP of one way at one set of thresholds; NaN for a kind without truth. mean_ap: crossing and divider, as in the paper."""

    protocol: str
    thresholds: str
    crossing: float
    divider: float
    boundary: float
    stop_line: float
    mean_ap: float


@dataclass(frozen=True)
class KindRow:
    """The other numbers of one kind; f at .3, .5 and 1 m."""

    kind: str
    n_predicted: int
    n_truth: int
    f1: tuple[float, ...]
    precision: tuple[float, ...]
    recall: tuple[float, ...]
    duplication: float
    fragmentation: float
    lateral_median_m: float
    lateral_p95_m: float
    frechet_m: float
    endpoint_error_m: float
    branch_f1: float


@dataclass(frozen=True)
class MapStudyResult:
    """A method's numbers on a trial. seconds: of the method alone."""

    place: str
    size_m: float
    view_label: str
    num_observations: int
    seed: int
    pose_sigma_m: float
    method: str
    seconds: float
    ap_rows: tuple[ApRow, ...]
    kind_rows: tuple[KindRow, ...]

    def get_ap(self, kind: str = "mean_ap", protocol: str = "exact", thresholds: str = "narrow") -> float:
        """One AP: what is a kind, or mean."""
        return next(
            getattr(row, kind) for row in self.ap_rows if (row.protocol, row.thresholds) == (protocol, thresholds)
        )

    def get_kind(self, name: str) -> KindRow:
        """The other numbers of a kind."""
        return next(row for row in self.kind_rows if row.kind == name)


@dataclass(frozen=True)
class MapStudyJob:
    """One trial and all methods on it: what one process does at a time. results_folder: where cells are kept."""

    trial: FleetTrial
    methods: tuple[str, ...]
    settings: MethodSettings
    results_folder: Path


def map_result_path(job: MapStudyJob, method: str) -> Path:
    """The file of a cell; its name holds a digest of the trial, the method's configuration and the code that they run."""
    content = repr((job.trial, method, job.settings.config_of(method), hash_map_sources(method)))
    digest = hashlib.blake2b(content.encode(), digest_size=6).hexdigest()
    trial = job.trial
    return (
        job.results_folder
        / f"{trial.place}-{trial.view_label}-{trial.num_observations:04d}-{trial.seed}-{method}-{digest}.json"
    )


def hash_map_sources(method: str) -> str:
    """A hash of the code that a cell of a method follows from."""
    code = source_digest("manyeyes.evaluation.maps.map_cells")
    # A method of another distribution is not in the closure.
    return code if method in ORACLES else code + getsource(sys.modules[MAP_FUSION_METHODS.get(method).fuse.__module__])


def run_study_job(job: MapStudyJob) -> list[MapStudyResult]:
    """The cells of a unit: found, or made and kept."""
    results: dict[str, MapStudyResult] = {}
    experiment: FleetExperiment | None = None
    for method in job.methods:
        path = map_result_path(job, method)
        result = read_map_result(path)
        if result is None:
            experiment = experiment or run_trial(job.trial)
            result = run_method(experiment, method, job.settings)
            path.parent.mkdir(parents=True, exist_ok=True)
            atomic_write(path, (json.dumps(to_plain(result), indent=1) + "\n").encode())
        results[method] = result
    return list(results.values())


def run_method(experiment: FleetExperiment, method: str, settings: MethodSettings) -> MapStudyResult:
    """One method on a scene, judged."""
    start = time.perf_counter()
    elements = fuse_experiment(method, experiment, settings)
    seconds = time.perf_counter() - start
    metrics = evaluate_map(experiment.cut_policy(elements), experiment.truth)
    trial = experiment.trial
    return MapStudyResult(
        place=trial.place,
        size_m=trial.size_m,
        view_label=trial.view_label,
        num_observations=trial.num_observations,
        seed=trial.seed,
        pose_sigma_m=trial.fleet_config.pose_sigma_m,
        method=method,
        seconds=seconds,
        ap_rows=tuple(make_ap_rows(metrics)),
        kind_rows=tuple(make_kind_rows(metrics)),
    )


def make_ap_rows(metrics: MapMetrics) -> Iterable[ApRow]:
    """Every AP of a judged map."""
    for protocol in dict.fromkeys(p.protocol for p in metrics.kinds[0].ap_scores):
        for thresholds in THRESHOLDS:
            kinds = {kind: metrics.get_ap(kind, protocol, thresholds) for kind in KINDS}
            yield ApRow(protocol, thresholds, mean_ap=metrics.mean_ap(protocol, thresholds), **kinds)


def make_kind_rows(metrics: MapMetrics) -> Iterable[KindRow]:
    """The numbers of every kind of a judged map."""
    for k in metrics.kinds:
        yield KindRow(
            kind=k.kind,
            n_predicted=k.n_predicted,
            n_truth=k.n_truth,
            f1=tuple(s.f1 for s in k.length_scores),
            precision=tuple(s.precision for s in k.length_scores),
            recall=tuple(s.recall for s in k.length_scores),
            duplication=k.duplication,
            fragmentation=k.fragmentation,
            lateral_median_m=k.lateral_median_m,
            lateral_p95_m=k.lateral_p95_m,
            frechet_m=k.frechet_m,
            endpoint_error_m=k.endpoint_error_m,
            branch_f1=k.branch_f1,
        )


def read_map_result(path: Path) -> MapStudyResult | None:
    """A kept cell; None where there is none, or one of another form."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8"), parse_constant=float)
        ap = tuple(ApRow(**restore_row(row)) for row in stored.pop("ap_rows"))
        kinds = tuple(KindRow(**restore_row(row)) for row in stored.pop("kind_rows"))
        return MapStudyResult(ap_rows=ap, kind_rows=kinds, **stored)
    except (OSError, ValueError, TypeError, KeyError):
        return None


def evaluate_map_rows(elements: MapElements, truth: MapElements) -> tuple[tuple[ApRow, ...], tuple[KindRow, ...]]:
    """Evaluate a map against a ground-truth map, outside of a study."""
    metrics = evaluate_map(elements, truth)
    return tuple(make_ap_rows(metrics)), tuple(make_kind_rows(metrics))


def to_plain(value: object) -> object:
    """A cell as JSON holds it; NaN is null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [to_plain(v) for v in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def restore_row(row: dict[str, Any]) -> dict[str, Any]:
    """A row as it was: null is NaN, lists are tuples."""

    def restore(value: Any) -> Any:
        if value is None:
            return math.nan
        return tuple(restore(v) for v in value) if isinstance(value, list) else value

    return {name: restore(value) for name, value in row.items()}
