# SPDX-License-Identifier: Apache-2.0
"""Pose correction on simulated landmark scenes: the default corrector and the baselines, by common objects, noise and
density.

Tables: ``success``: fraction of frames whose best candidate is within 1 m and 1 degree, by common objects and by prior
(sparse traffic). ``acceptance``: acceptance on DAIR-V2X's counts of common objects in dense traffic, with one frame and with
five, and on agents without common objects. ``baselines``: success at 1 m and 1 degree, all frames, against the noise of
the prior. ``displacement``: of common objects after fusion with a good prior, over that of the prior alone. ``monitor``:
fraction of frames that conflict with the prior, for priors off by five of their stated sigma and for priors with the stated
error; in single frames, and by the pose monitor over drives of 20 frames at 10 Hz. ``speed``: processor time of one call.
The targets follow the tables.

python -m benchmarks.pose [--tables success acceptance ...] [--scenes 300] [--nulls 1000] [--out benchmarks/results/pose.json]
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from benchmarks.multi_frame import TimedLandmarks, accumulate

from manyeyes.evaluation.pose.metrics import PoseEvaluation, PoseScore, PriorNoise, evaluate_pose, summarize_evaluations
from manyeyes.pose.corrector import AcceptanceTest, CorrectorConfig, correct_by_voting
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.pose_monitor import PoseHealth, PoseMonitorState, update_monitor
from manyeyes.pose.registry import list_correctors, load_corrector
from manyeyes.pose.types import PoseCorrector, PoseStatus
from manyeyes.simulator.fleet.landmark_errors import BoxNoise
from manyeyes.simulator.fleet.landmark_traffic import relative_pose
from manyeyes.simulator.fleet.landmarks import LandmarkScene, LandmarkSpec, make_landmark_scene
from manyeyes.studies.provenance import write_json

NOISY = BoxNoise(0.45, np.radians(4.0), 0.10, 0.3)
GUESS = CorrectorConfig(accept=AcceptanceTest(-1e9, min_margin=0.0, min_pairs=1, runner_up_margin_pairs=0.0))


@dataclass(frozen=True)
class Row:
    """One setting: what the scenes were, the noise of the prior, the method, and its numbers."""

    table: str
    method: str
    common: int | None
    ego_extra: int
    other_extra: int
    instants: int
    noisy: bool
    disjoint: bool
    claim: str
    sigma: float
    score: PoseScore
    mean_ms: float
    p95_ms: float


def make_landmarks(scene: LandmarkScene) -> tuple[Landmarks, Landmarks]:
    """What both agents see, all instants in their frames of now."""
    both = ((scene.ego, scene.ego_from_then), (scene.other, scene.other_from_then))
    one, two = (
        accumulate([TimedLandmarks(Landmarks.of_boxes(b), n, then[n]) for n, b in enumerate(boxes)])
        for boxes, then in both
    )
    return one, two


@lru_cache(maxsize=4)
def prepare_scenes(spec: LandmarkSpec, scenes: int, seed: int) -> list[tuple[LandmarkScene, Landmarks, Landmarks]]:
    """Scenes 0, 1, ... of a seed, and what both agents see: the same for every method and noise."""
    made = [make_landmark_scene(spec, seed, n) for n in range(scenes)]
    return [(scene, *make_landmarks(scene)) for scene in made]


def run(
    table: str, method: str, corrector: PoseCorrector, spec: LandmarkSpec, noise: PriorNoise, scenes: int, seed: int
) -> Row:
    """A method on scenes 0, 1, ... of a seed."""
    frames: list[PoseEvaluation] = []
    spent = []
    for n, (scene, ego, other) in enumerate(prepare_scenes(spec, scenes, seed)):
        prior = noise.make_prior(scene.ego_from_other, n)
        begin = time.process_time()
        estimate = corrector(ego, other, prior)
        spent.append(1e3 * (time.process_time() - begin))
        frames.append(evaluate_pose(estimate, scene.ego_from_other, scene.common_xy))
    return Row(
        table,
        method,
        spec.num_common,
        spec.num_ego_only,
        spec.num_other_only,
        spec.num_instants,
        spec.noise == NOISY,
        spec.disjoint,
        noise.kind,
        noise.sigma_m,
        summarize_evaluations(frames),
        float(np.mean(spent[1:] or spent)),
        float(np.percentile(spent[1:] or spent, 95)),
    )


def success(scenes: int, nulls: int) -> Iterator[Row]:
    """The best candidate, accepted or not."""
    for common in (3, 4, 5, 6, 8):
        spec, guess = LandmarkSpec(common, 8, 10), partial(correct_by_voting, config=GUESS)
        for kind, sigma in (("none", 0.0), ("gaussian", 1.0), ("gaussian", 4.0), ("unknown", 0.0)):
            yield run("success", "voting", guess, spec, PriorNoise(kind, sigma, sigma), scenes, 0)


def acceptance(scenes: int, nulls: int) -> Iterator[Row]:
    """Acceptance; agents without common objects stand at one crossing or at two."""
    none = PriorNoise("none")
    for error in (BoxNoise(), NOISY):
        for spec, divisor in (
            (LandmarkSpec(0, 22, 28, error, disjoint=True), 1),
            (LandmarkSpec(noise=error), 2),
            (LandmarkSpec(0, 22, 28, error), 2),
            (LandmarkSpec(0, 22, 28, error, disjoint=True, num_instants=5), 5),
            (LandmarkSpec(noise=error, num_instants=5), 5),
        ):
            yield run("acceptance", "voting", correct_by_voting, spec, none, nulls // divisor, 1)


def displacement(scenes: int, nulls: int) -> Iterator[Row]:
    """Displacement of common objects after fusion with a good prior."""
    for sigma in (0.1, 0.2, 0.5):
        for method in ("identity", "voting"):
            noise = PriorNoise("gaussian", sigma, sigma)
            yield run("displacement", method, load_corrector(method), LandmarkSpec(), noise, scenes, 4)


def baselines(scenes: int, nulls: int) -> Iterator[Row]:
    """All correctors, against the noise of the prior."""
    for sigma in (0.0, 0.4, 0.8, 1.2, 2.0):
        for method in list_correctors("landmarks"):
            noise = PriorNoise("gaussian", sigma, sigma)
            yield run("baselines", method, load_corrector(method), LandmarkSpec(6, 8, 10), noise, scenes // 2, 5)


def monitor(scenes: int, nulls: int) -> Iterator[Row]:
    """Priors that are five sigma off, and priors with the stated error; sparse and dense."""
    for common in (5, 8):
        for ego_extra, other_extra in ((8, 10), (18, 24)):
            for kind in ("offset", "gaussian"):
                for sigma in (0.2, 0.5, 1.0):
                    spec, noise = LandmarkSpec(common, ego_extra, other_extra), PriorNoise(kind, sigma, sigma)
                    yield run("monitor", "voting", correct_by_voting, spec, noise, scenes, 7)

    for kind in ("offset", "bias", "gaussian"):
        for sigma in (0.2, 0.5, 1.0):
            spec = LandmarkSpec(5, 8, 10, num_instants=20, period_s=0.1)
            yield run_monitor(spec, PriorNoise(kind, sigma, sigma), scenes // 4, 8)


def run_monitor(spec: LandmarkSpec, noise: PriorNoise, scenes: int, seed: int) -> Row:
    """Drives whose every frame is solved independently; a frame conflicts where the monitor reports an offset or a drift.

    An offset is constant over a drive, and so is a bias.
    """
    frames: list[PoseEvaluation] = []
    spent = []
    for n in range(scenes):
        scene, state = make_landmark_scene(spec, seed, n), PoseMonitorState.new()
        for instant in reversed(range(spec.num_instants)):
            truth = relative_pose(scene.ego_from_then[instant], scene.ego_from_other)
            prior = noise.make_prior(truth, n, instant if noise.kind == "gaussian" else 0)
            begin = time.process_time()
            estimate = correct_by_voting(*(Landmarks.of_boxes(b[instant]) for b in (scene.ego, scene.other)), prior)
            state, report = update_monitor(state, estimate, prior, -instant * spec.period_s)
            spent.append(1e3 * (time.process_time() - begin))
            is_flagged = report.health in (PoseHealth.OFFSET, PoseHealth.DRIFTING)
            found = evaluate_pose(estimate, truth, np.zeros((spec.num_common or 0, 2)))
            frames.append(replace(found, status=PoseStatus.CONFLICT if is_flagged else PoseStatus.OK))
    return Row(
        "monitored",
        "voting",
        spec.num_common,
        spec.num_ego_only,
        spec.num_other_only,
        spec.num_instants,
        False,
        False,
        noise.kind,
        noise.sigma_m,
        summarize_evaluations(frames),
        float(np.mean(spent)),
        float(np.percentile(spent, 95)),
    )


def speed(scenes: int, nulls: int) -> Iterator[Row]:
    """40 by 40 objects."""
    yield run("speed", "voting", correct_by_voting, LandmarkSpec(8, 32, 32), PriorNoise("none"), 40, 6)


@dataclass(frozen=True)
class Target:
    """One target: the value of the worst row, and whether all rows meet it; inconclusive where an interval of two standard
    errors contains the target.
    """

    what: str
    value: float
    target: str
    verdict: str


def check_targets(rows: Sequence[Row]) -> Iterator[Target]:
    """Check the rows that were run: consistency of the covariance, and detection rates of the monitor."""
    for row in rows:
        s, shown = row.score, row.claim == "none" and (row.table == "acceptance" or row.table == "success")
        if not shown or not s.nees_standard_error > 0:
            continue
        low, high = s.nees - 2 * s.nees_standard_error, s.nees + 2 * s.nees_standard_error
        verdict = "met" if low >= 2.5 and high <= 3.6 else "not met" if high < 2.5 or low > 3.6 else "inconclusive"
        noise = ", noisy" if row.noisy else ""
        what = f"mean NEES, {row.table}, K={row.common or 'DAIR'}, {row.instants} frames{noise} (+-{2 * s.nees_standard_error:.2f})"
        yield Target(what, s.nees, "2.5 to 3.6", verdict)
    for table, name in (("monitored", "over drives"), ("monitor", "in single frames")):
        for sigma in sorted({row.sigma for row in rows if row.table == table}):
            some = [row for row in rows if (row.table, row.sigma) == (table, sigma)]
            flagged = min(row.score.conflict_rate for row in some if row.claim == "offset")
            false_alarms = max(row.score.conflict_rate for row in some if row.claim != "offset")
            what = f"monitor {name}, sigma {sigma:g} m"
            yield Target(
                f"{what}: five sigma off, flagged", flagged, "at least 0.98", "met" if flagged >= 0.98 else "not met"
            )
            verdict = "met" if false_alarms <= 0.005 else "not met"
            yield Target(f"{what}: stated error, flagged", false_alarms, "at most 0.005", verdict)


TABLES = {f.__name__: f for f in (success, acceptance, displacement, baselines, monitor, speed)}


def line(row: Row) -> str:
    """A row as text."""
    s = row.score
    return (
        f"{row.table:12} {row.method:14} K={row.common!s:4} +{row.ego_extra}/{row.other_extra} x{row.instants}"
        f"{' noisy' if row.noisy else ''}{' disjoint' if row.disjoint else ''} {row.claim} {row.sigma:g}: "
        f"success {s.success_rate[0]:.3f}/{s.success_rate[1]:.3f}/{s.success_rate[2]:.3f} coverage "
        f"{s.coverage:.3f} precision {s.precision:.3f} "
        f"null {s.no_overlap_accept_rate:.4f} OD {s.mean_displacement_m:.3f} NEES {s.nees:.2f} "
        f"(+-{s.nees_standard_error:.2f}) inside {s.within_95_fraction:.3f} "
        f"conflicts {s.conflict_rate:.3f} {row.mean_ms:.1f} ms (p95 {row.p95_ms:.1f})"
    )


def main() -> None:
    """The benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--nulls", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/pose.json"))
    parser.add_argument("--tables", nargs="+", choices=list(TABLES), default=list(TABLES))
    options = parser.parse_args()
    done = []
    for table in options.tables:
        for row in TABLES[table](options.scenes, options.nulls):
            sys.stdout.write(line(row) + "\n")
            sys.stdout.flush()
            done.append(row)
    targets = list(check_targets(done))
    for target in targets:
        sys.stdout.write(f"{target.what}: {target.value:.3f} (target {target.target}): {target.verdict}\n")
    command = f"python -m benchmarks.pose {shlex.join(sys.argv[1:])}".strip()
    write_json(
        options.out,
        {"rows": [asdict(r) for r in done], "targets": [asdict(target) for target in targets]},
        {"command": command},
        0,
    )


if __name__ == "__main__":
    main()
