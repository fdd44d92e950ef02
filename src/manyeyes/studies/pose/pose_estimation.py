# SPDX-License-Identifier: Apache-2.0
"""Errors of corrected poses on agents' own detections, by corrector, noise of the prior and common objects; and risk against
coverage among pairs of agents that do not belong together (evaluation/pose/null_pairs.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig, load_detector
from manyeyes.evaluation.pose.accuracy import (
    AccuracyRow,
    CorrectorRun,
    CorrectorTrial,
    LandmarkPair,
    iterate_landmark_pairs,
    run_corrector,
    summarize_run,
)
from manyeyes.evaluation.pose.metrics import PriorNoise
from manyeyes.evaluation.pose.null_pairs import (
    COVERAGES,
    NULL_KINDS,
    NullRisk,
    NullRun,
    run_null_pairs,
    summarize_null_run,
)
from manyeyes.evaluation.statistics.bootstrap import exact_interval
from manyeyes.models.checkpoint import fingerprint
from manyeyes.pose.registry import load_corrector
from manyeyes.studies.engine.cells import Cell, hash_recording
from manyeyes.studies.engine.replay_study import ReplayStudy, open_study
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import PoseEstimationOptions
from manyeyes.viz.curves import Curve, CurvePanel
from manyeyes.viz.progress import make_progress_bars
from manyeyes.viz.study_table import StudyTable, format_number

COMPUTED_BY = ("manyeyes.evaluation.pose.accuracy",)
NULLS_COMPUTED_BY = ("manyeyes.evaluation.pose.null_pairs",)
CORRECTORS = ("identity", "voting", "coalign", "fpv-rcnn", "feaco", "v2x-reg-odist")
SIGMAS = (0.0, 0.4, 0.8, 1.2, 2.0)
NOISE_FAMILIES = (
    ("gaussian_all", 0.8), ("laplace", 0.8), ("bias", 0.8), ("walk", 0.8), ("latency", 2.0), ("heavy", 0.4), ("offset", 0.5),
    ("unknown", 0.0), ("none", 0.0),
)  # fmt: skip
LISTED_NOISE = ("gaussian", 0.8)
_SCORE_HEADINGS = (
    "frames", "within 1 m, 1° [%]", "2 m, 2° [%]", "3 m, 3° [%]", "coverage [%]", "precision [%]", "false accepts [%]",
    "conflicts [%]", "RTE median [m]", "RTE p95 [m]", "RRE median [deg]", "object displacement [m]", "NEES", "AURC",
    "bytes/message", "mean [ms]", "p95 [ms]",
)  # fmt: skip


def run(options: PoseEstimationOptions, context: StudyContext) -> None:
    """Run the study: Gaussian errors for every corrector, every other family for the first two."""
    names = options.correctors or CORRECTORS
    for name in names:
        load_corrector(name)
    study = open_study(options, context, BenchmarkConfig(options.weights))
    trials = [CorrectorTrial(n, PriorNoise("gaussian", s, s, options.seed)) for n in names for s in SIGMAS]
    trials += [CorrectorTrial(n, PriorNoise(kind, s, s, options.seed)) for n in names[:2] for kind, s in NOISE_FAMILIES]
    result_rows, nulls = run_trials(study, trials)
    tables = [_make_results_table(result_rows), _make_common_objects_table(result_rows), _make_null_table(nulls)]
    panels = [*make_panels(result_rows), *make_null_panels(nulls)]
    study.write_report({"rows": result_rows, "nulls": nulls}, tables, panels)


def run_trials(study: ReplayStudy, trials: Sequence[CorrectorTrial]) -> tuple[list[AccuracyRow], list[NullRisk]]:
    """Return the rows of every trial, and the risk among null pairs of every corrector; stored results are not computed again."""
    pairs_by_net: dict[str, list[LandmarkPair]] = {}
    stride, detector = study.base.frame_stride, load_detector(study.base.weights)
    recording = replace(study.base, frame_stride=1).filter_recording(study.opener())
    data_key = hash_recording(recording), detector.fingerprint.hex(), stride
    nets = {name: PoseCorrection(name).net for name in dict.fromkeys(trial.corrector for trial in trials)}
    net_fingerprints = {name: "" if net is None else fingerprint(net).hex() for name, net in nets.items()}

    def get_pairs(name: str) -> list[LandmarkPair]:
        if net_fingerprints[name] not in pairs_by_net:
            pairs_by_net[net_fingerprints[name]] = list(
                iterate_landmark_pairs(recording, detector, frame_stride=stride, net=nets[name])
            )
        return pairs_by_net[net_fingerprints[name]]

    def run_trial(trial: CorrectorTrial) -> CorrectorRun:
        return run_corrector(get_pairs(trial.corrector), trial)

    out = []
    with make_progress_bars(study.context.console) as progress:
        for trial in progress.track(trials, description="Correcting poses"):
            key = trial, net_fingerprints[trial.corrector], data_key
            cell = Cell[CorrectorRun](f"pose-{Path(trial.corrector).stem}", CorrectorRun, key, COMPUTED_BY)
            out += summarize_run(trial, study.context.store.load_or_compute(cell, partial(run_trial, trial)))
        risks = list[NullRisk]()
        for name in progress.track(list(nets), description="Null pairs"):
            key = name, net_fingerprints[name], data_key
            cell = Cell[NullRun](f"pose-nulls-{Path(name).stem}", NullRun, key, NULLS_COMPUTED_BY)
            run = study.context.store.load_or_compute(cell, lambda name=name: run_null_pairs(get_pairs(name), name))
            risks += summarize_null_run(name, run)
    return out, risks


def _noise_name(row: AccuracyRow) -> str:
    noise = row.trial.noise
    return noise.kind if noise.kind in ("unknown", "none") else f"{noise.kind} {noise.sigma_m:g}"


def _make_results_table(result_rows: Sequence[AccuracyRow]) -> StudyTable:
    return StudyTable(
        "All pairs of agents",
        ("corrector", "noise", *_SCORE_HEADINGS),
        tuple((r.trial.corrector, _noise_name(r), *_format_cells(r)) for r in result_rows if r.common_range is None),
    )


def _format_cells(row: AccuracyRow) -> tuple[str, ...]:
    s = row.score
    shares = (*s.success_rate, s.coverage, s.precision, s.false_accept_rate, s.conflict_rate)
    lengths = (
        s.median_translation_error_m,
        s.p95_translation_error_m,
        s.median_rotation_error_deg,
        s.mean_displacement_m,
        s.nees,
        s.aurc,
    )
    return (
        format_number(s.num_frames),
        *(format_number(100 * x, 1) for x in shares),
        *(format_number(x, 2) for x in lengths),
        format_number(row.bytes_per_message),
        format_number(row.mean_ms, 1),
        format_number(row.p95_ms, 1),
    )


def _make_common_objects_table(result_rows: Sequence[AccuracyRow]) -> StudyTable:
    listed = [
        r
        for r in result_rows
        if r.common_range and (r.trial.noise.kind, r.trial.noise.sigma_m) in (LISTED_NOISE, ("offset", 0.5))
    ]
    lines = tuple(
        (
            r.trial.corrector,
            _noise_name(r),
            f"{r.common_range[0]}+"
            if r.common_range[1] >= 10**9
            else "-".join(dict.fromkeys(map(str, r.common_range))),
            *_format_cells(r)[:13],
        )
        for r in listed
        if r.common_range
    )
    headings = ("corrector", "noise", "common objects", *_SCORE_HEADINGS[:13])
    return StudyTable("By common objects", headings, lines)


def _make_null_table(nulls: Sequence[NullRisk]) -> StudyTable:
    """Tabulate the risk at every fifth coverage; empty where so many true pairs are not answered."""
    shown = range(4, len(COVERAGES), 5)
    headings = (
        "corrector", "null pairs", "number", "answered [%]", "wrong [%]", "true pairs answered [%]",
        *(f"risk at {100 * COVERAGES[k]:.0f} % [%]" for k in shown),
    )  # fmt: skip
    lines = tuple(
        (
            r.corrector,
            r.kind,
            format_number(r.num_null),
            *(format_number(100 * x, 1) for x in (r.answered, r.wrong, r.coverage)),
            *(format_number(100 * r.risk_by_coverage[k], 1) for k in shown),
        )
        for r in nulls
    )
    return StudyTable("Risk and coverage with null pairs, without priors", headings, lines)


def make_null_panels(nulls: Sequence[NullRisk]) -> list[CurvePanel]:
    """Return risk against coverage for each kind of null pairs, a line for each corrector that answers."""
    out = []
    for kind in NULL_KINDS:
        curves = []
        for risk in (r for r in nulls if r.kind == kind):
            points = [(c, exact_interval(y)) for c, y in zip(COVERAGES, risk.risk_by_coverage) if not math.isnan(y)]
            if points:
                curves.append(Curve(risk.corrector, tuple(y for _, y in points), tuple(c for c, _ in points)))
        if curves:
            ylabel = "fraction of wrong answers"
            out.append(CurvePanel(f"No prior, nulls: {kind}", "coverage of true pairs", ylabel, tuple(curves)))
    return out


def make_panels(result_rows: Sequence[AccuracyRow]) -> list[CurvePanel]:
    """Success and objects' displacement against sigma; risk against coverage at one sigma."""
    overall = [r for r in result_rows if r.common_range is None and r.trial.noise.kind == "gaussian"]
    names = list(dict.fromkeys(r.trial.corrector for r in overall))
    rows_by_corrector = {name: [r for r in overall if r.trial.corrector == name] for name in names}

    def make_curves(value: Callable[[AccuracyRow], float]) -> tuple[Curve, ...]:
        return tuple(
            Curve(name, tuple(exact_interval(value(r)) for r in rows), tuple(r.trial.noise.sigma_m for r in rows))
            for name, rows in rows_by_corrector.items()
        )

    coverage = tuple(k / 20 for k in range(1, 21))
    risk = [
        Curve(n, tuple(map(exact_interval, r.risk_by_coverage)), coverage)
        for n, corrector_rows in rows_by_corrector.items()
        for r in corrector_rows
        if r.trial.noise.sigma_m == LISTED_NOISE[1]
    ]
    sigma = "sigma of the prior, metres and degrees"
    return [
        CurvePanel("Success, all pairs", sigma, "within 1 m and 1°", make_curves(lambda r: r.score.success_rate[0])),
        CurvePanel("Common objects", sigma, "mean displacement, m", make_curves(lambda r: r.score.mean_displacement_m)),
        CurvePanel(f"Risk, sigma {LISTED_NOISE[1]:g}", "coverage", "fraction not within 2 m and 2°", tuple(risk)),
    ]
