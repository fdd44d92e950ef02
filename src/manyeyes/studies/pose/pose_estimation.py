# SPDX-License-Identifier: Apache-2.0
"""How good corrected poses are on agents' own detections, by corrector, error of claims and objects in common (pose.md 3.3)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes._source import source_digest
from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.evaluation.detection.benchmark import load_detector
from manyeyes.evaluation.pose.accuracy import (
    AccuracyRow,
    CorrectorTrial,
    LandmarkPair,
    iterate_landmark_pairs,
    load_or_run,
    run_corrector,
    summarize_run,
)
from manyeyes.evaluation.pose.metrics import PriorNoise
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.study import hash_recording
from manyeyes.models.checkpoint import fingerprint
from manyeyes.pose.registry import load_corrector
from manyeyes.studies.running import StudyContext, prepare_study, write_study_report
from manyeyes.viz.curves import Curve, CurvePanel
from manyeyes.viz.progress import make_progress_bars
from manyeyes.viz.study_table import StudyTable, format_number

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

CORRECTORS = ("identity", "voting", "coalign", "fpv-rcnn", "feaco", "v2x-reg-odist")
SIGMAS = (0.0, 0.4, 0.8, 1.2, 2.0)
NOISE_FAMILIES = (
    ("gaussian_all", 0.8), ("laplace", 0.8), ("bias", 0.8), ("walk", 0.8), ("latency", 2.0), ("heavy", 0.4), ("offset", 0.5),
    ("unknown", 0.0), ("none", 0.0),
)  # fmt: skip
LISTED_NOISE = ("gaussian", 0.8)


def run(options: Options, console: Console) -> None:
    """The study: Gaussian errors for every corrector, every other family for the first two."""
    context = prepare_study(options, console)
    names = options.correctors or CORRECTORS
    for name in names:
        load_corrector(name)
    trials = [CorrectorTrial(n, PriorNoise("gaussian", s, s, options.seed)) for n in names for s in SIGMAS]
    trials += [CorrectorTrial(n, PriorNoise(kind, s, s, options.seed)) for n in names[:2] for kind, s in NOISE_FAMILIES]
    result_rows = run_trials(context, trials)
    payload: dict[str, object] = {"rows": [asdict(row) for row in result_rows]}
    write_study_report(
        context,
        payload,
        [_make_results_table(result_rows), _make_common_objects_table(result_rows)],
        make_panels(result_rows),
        [],
    )


def run_trials(context: StudyContext, trials: Sequence[CorrectorTrial]) -> list[AccuracyRow]:
    """The rows of every trial; answers that are kept under --out are not made again."""
    pairs_by_net: dict[str, list[LandmarkPair]] = {}
    base, detector = context.base, load_detector(context.base.weights)
    recording = context.opener()
    data_key = (
        hash_recording(recording),
        detector.fingerprint.hex(),
        base.frame_stride,
        source_digest("manyeyes.evaluation.pose.accuracy"),
    )
    nets = {name: PoseCorrection(name).net for name in {trial.corrector for trial in trials}}
    net_fingerprints = {name: "" if net is None else fingerprint(net).hex() for name, net in nets.items()}

    def get_pairs(name: str) -> list[LandmarkPair]:
        if net_fingerprints[name] not in pairs_by_net:
            pairs_by_net[net_fingerprints[name]] = list(
                iterate_landmark_pairs(recording, detector, frame_stride=base.frame_stride, net=nets[name])
            )
        return pairs_by_net[net_fingerprints[name]]

    out = []
    with make_progress_bars(context.console) as progress:
        for trial in progress.track(trials, description="Aligning"):
            key = hashlib.blake2b(
                repr((trial, net_fingerprints[trial.corrector], data_key)).encode(), digest_size=8
            ).hexdigest()
            path = context.results_folder / f"pose-{Path(trial.corrector).stem}-{key}.json"
            corrector_run = load_or_run(path, lambda trial=trial: run_corrector(get_pairs(trial.corrector), trial))
            out += summarize_run(trial, corrector_run)
    return out


def _noise_name(row: AccuracyRow) -> str:
    noise = row.trial.noise
    return noise.kind if noise.kind in ("unknown", "none") else f"{noise.kind} {noise.sigma_m:g}"


def _make_results_table(result_rows: Sequence[AccuracyRow]) -> StudyTable:
    headings = (
        "corrector", "errors", "frames", "within 1 m, 1°", "2", "3", "answered", "right", "wrong", "conflict", "m, median",
        "m, p95", "°, median", "objects off m", "NEES", "AURC", "bytes", "ms", "ms p95",
    )  # fmt: skip
    return StudyTable(
        "All meetings",
        headings,
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
    headings = (
        "corrector", "errors", "in common", "frames", "within 1 m, 1°", "2", "3", "answered", "right", "wrong", "conflict",
        "m, median", "m, p95", "°, median", "objects off m", "NEES",
    )  # fmt: skip
    return StudyTable("By objects in common", headings, lines)


def make_panels(result_rows: Sequence[AccuracyRow]) -> list[CurvePanel]:
    """Success and objects' displacement against sigma; risk against coverage at one sigma."""
    overall = [r for r in result_rows if r.common_range is None and r.trial.noise.kind == "gaussian"]
    names = list(dict.fromkeys(r.trial.corrector for r in overall))
    rows_by_corrector = {name: [r for r in overall if r.trial.corrector == name] for name in names}
    success = [
        Curve(
            n,
            tuple(_make_interval(r.score.success_rate[0]) for r in corrector_rows),
            tuple(r.trial.noise.sigma_m for r in corrector_rows),
        )
        for n, corrector_rows in rows_by_corrector.items()
    ]
    displacement = [
        Curve(
            n,
            tuple(_make_interval(r.score.mean_displacement_m) for r in corrector_rows),
            tuple(r.trial.noise.sigma_m for r in corrector_rows),
        )
        for n, corrector_rows in rows_by_corrector.items()
    ]
    coverage = tuple(k / 20 for k in range(1, 21))
    risk = [
        Curve(n, tuple(map(_make_interval, r.risk_by_coverage)), coverage)
        for n, corrector_rows in rows_by_corrector.items()
        for r in corrector_rows
        if r.trial.noise.sigma_m == LISTED_NOISE[1]
    ]
    sigma = "sigma of the claim, metres and degrees"
    return [
        CurvePanel("Success, all meetings", sigma, "within 1 m and 1°", tuple(success)),
        CurvePanel("Objects in common", sigma, "mean displacement, m", tuple(displacement)),
        CurvePanel(f"Risk, sigma {LISTED_NOISE[1]:g}", "coverage", "share not within 2 m and 2°", tuple(risk)),
    ]


def _make_interval(value: float) -> Interval:
    return Interval(value, value, value, 0.95, 1)
