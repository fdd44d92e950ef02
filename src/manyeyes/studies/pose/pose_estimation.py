# SPDX-License-Identifier: Apache-2.0
"""How good corrected poses are on agents' own detections, by corrector, error of claims and objects in common (pose.md 3.3)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes._source import source_digest
from manyeyes.agents.pose_correction import Aligner
from manyeyes.evaluation.detection.benchmark import loaded
from manyeyes.evaluation.pose.accuracy import AccuracyRow, Meeting, Trial, answered, kept, meetings, rows
from manyeyes.evaluation.pose.metrics import ClaimNoise
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.study import recording_digest
from manyeyes.models.checkpoint import fingerprint
from manyeyes.pose.registry import corrector
from manyeyes.studies.running import Start, publish, start
from manyeyes.viz.curves import Curve, Panel
from manyeyes.viz.progress import bars
from manyeyes.viz.study_table import Sheet, number

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

CORRECTORS = ("given", "vote", "coalign", "fpv-rcnn", "feaco", "v2x-reg-odist")
SIGMAS = (0.0, 0.4, 0.8, 1.2, 2.0)
FAMILIES = (
    ("gaussian_all", 0.8), ("laplace", 0.8), ("bias", 0.8), ("walk", 0.8), ("latency", 2.0), ("heavy", 0.4), ("offset", 0.5),
    ("unknown", 0.0), ("none", 0.0),
)  # fmt: skip
SHOWN = ("gaussian", 0.8)


def run(options: Options, console: Console) -> None:
    """The study: Gaussian errors for every corrector, every other family for the first two."""
    begun = start(options, console)
    names = options.correctors or CORRECTORS
    for name in names:
        corrector(name)
    trials = [Trial(n, ClaimNoise("gaussian", s, s, options.seed)) for n in names for s in SIGMAS]
    trials += [Trial(n, ClaimNoise(kind, s, s, options.seed)) for n in names[:2] for kind, s in FAMILIES]
    table = carried_out(begun, trials)
    payload: dict[str, object] = {"rows": [asdict(row) for row in table]}
    publish(begun, payload, [_sheet(table), _by_common(table)], panels(table), [])


def carried_out(begun: Start, trials: Sequence[Trial]) -> list[AccuracyRow]:
    """The rows of every trial; answers that are kept under --out are not made again."""
    met: dict[str, list[Meeting]] = {}
    base, detector = begun.base, loaded(begun.base.weights)
    recording = begun.opener()
    data = (
        recording_digest(recording),
        detector.fingerprint.hex(),
        base.every,
        source_digest("manyeyes.evaluation.pose.accuracy"),
    )
    nets = {name: Aligner(name).net for name in {trial.corrector for trial in trials}}
    marks = {name: "" if net is None else fingerprint(net).hex() for name, net in nets.items()}

    def seen(name: str) -> list[Meeting]:
        if marks[name] not in met:
            met[marks[name]] = list(meetings(recording, detector, every=base.every, net=nets[name]))
        return met[marks[name]]

    out = []
    with bars(begun.console) as progress:
        for trial in progress.track(trials, description="Aligning"):
            key = hashlib.blake2b(repr((trial, marks[trial.corrector], data)).encode(), digest_size=8).hexdigest()
            path = begun.cells / f"pose-{Path(trial.corrector).stem}-{key}.json"
            found = kept(path, lambda trial=trial: answered(seen(trial.corrector), trial))
            out += rows(trial, found)
    return out


def _name(row: AccuracyRow) -> str:
    noise = row.trial.noise
    return noise.kind if noise.kind in ("unknown", "none") else f"{noise.kind} {noise.sigma_m:g}"


def _sheet(table: Sequence[AccuracyRow]) -> Sheet:
    headings = (
        "corrector", "errors", "frames", "within 1 m, 1°", "2", "3", "answered", "right", "wrong", "conflict", "m, median",
        "m, p95", "°, median", "objects off m", "NEES", "AURC", "bytes", "ms", "ms p95",
    )  # fmt: skip
    return Sheet(
        "All meetings", headings, tuple((r.trial.corrector, _name(r), *_cells(r)) for r in table if r.common is None)
    )


def _cells(row: AccuracyRow) -> tuple[str, ...]:
    s = row.score
    shares = (*s.success, s.coverage, s.precision, s.wrong_accepts, s.conflicts)
    lengths = (s.median_metres, s.p95_metres, s.median_degrees, s.displacement, s.nees, s.aurc)
    return (
        number(s.frames),
        *(number(100 * x, 1) for x in shares),
        *(number(x, 2) for x in lengths),
        number(row.bytes),
        number(row.mean_ms, 1),
        number(row.p95_ms, 1),
    )


def _by_common(table: Sequence[AccuracyRow]) -> Sheet:
    shown = [r for r in table if r.common and (r.trial.noise.kind, r.trial.noise.sigma_m) in (SHOWN, ("offset", 0.5))]
    lines = tuple(
        (
            r.trial.corrector,
            _name(r),
            f"{r.common[0]}+" if r.common[1] >= 10**9 else "-".join(dict.fromkeys(map(str, r.common))),
            *_cells(r)[:13],
        )
        for r in shown
        if r.common
    )
    headings = (
        "corrector", "errors", "in common", "frames", "within 1 m, 1°", "2", "3", "answered", "right", "wrong", "conflict",
        "m, median", "m, p95", "°, median", "objects off m", "NEES",
    )  # fmt: skip
    return Sheet("By objects in common", headings, lines)


def panels(table: Sequence[AccuracyRow]) -> list[Panel]:
    """Success and objects' displacement against sigma; risk against coverage at one sigma."""
    every = [r for r in table if r.common is None and r.trial.noise.kind == "gaussian"]
    names = list(dict.fromkeys(r.trial.corrector for r in every))
    own = {name: [r for r in every if r.trial.corrector == name] for name in names}
    success = [
        Curve(n, tuple(_plain(r.score.success[0]) for r in rs), tuple(r.trial.noise.sigma_m for r in rs))
        for n, rs in own.items()
    ]
    shift = [
        Curve(n, tuple(_plain(r.score.displacement) for r in rs), tuple(r.trial.noise.sigma_m for r in rs))
        for n, rs in own.items()
    ]
    share = tuple(k / 20 for k in range(1, 21))
    risk = [
        Curve(n, tuple(map(_plain, r.risk)), share)
        for n, rs in own.items()
        for r in rs
        if r.trial.noise.sigma_m == SHOWN[1]
    ]
    sigma = "sigma of the claim, metres and degrees"
    return [
        Panel("Success, all meetings", sigma, "within 1 m and 1°", tuple(success)),
        Panel("Objects in common", sigma, "mean displacement, m", tuple(shift)),
        Panel(f"Risk, sigma {SHOWN[1]:g}", "coverage", "share not within 2 m and 2°", tuple(risk)),
    ]


def _plain(value: float) -> Interval:
    return Interval(value, value, value, 0.95, 1)
