# SPDX-License-Identifier: Apache-2.0
"""What limits pose correction with few common objects, and what a learned acceptance changes.

Scenes, errors and seed are those of benchmarks/pose_real.py, without a prior. Both correctors judge the same candidates, in turn in
one process. ``candidates``: is the right pose the best of the vote, among its best five, or among all? ``correctors``: fraction of
true pairs with an answer within 1 m and 1 degree. ``nulls``: fraction of null pairs with a wrong answer (one place: more than 3 m
off). ``time``: processor time. The curves vary the limit of the vote's score, and of the network's log-odds.

python -m benchmarks.pose_verifier [--scenes 600] [--nulls 3000] [--weights pose-verifier-small] [--seed 2025]
    [--out benchmarks/results/pose_verifier.json]
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.pose_real import SEED, Line, make_mean_line, make_rate_line, observe
from numpy.typing import NDArray

from manyeyes.models.pretrained import DEFAULT_POSE_VERIFIER
from manyeyes.pose.corrector import DETECTOR_BOXES_CONFIG, decide
from manyeyes.pose.learned_voting import LEARNED_VOTING, LearnedVotingCorrector, load_learned_voting
from manyeyes.pose.types import pose_difference
from manyeyes.pose.voting import Candidate, find_candidates
from manyeyes.simulator.fleet.landmark_errors import REAL_BOXES
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, make_landmark_scene
from manyeyes.studies.provenance import write_json

OWN_BOXES, NULL_BOXES = {"15 x 17": (8, 10), "25 x 31": (18, 24)}, {"15 x 17": (15, 17), "25 x 31": (25, 31)}
NUM_COMMON = (3, 4, 5)
MIN_GAIN, MAX_NULLS, WRONG_M = 0.05, 0.002, 3.0
_NAMES = "voting", LEARNED_VOTING
_NULL_RATES = 3.0e-4 * 10 ** np.linspace(0.0, 2.5, 26)


@dataclass(frozen=True)
class Judged:
    """A scene by one corrector. is_right: answered within 1 m and 1 degree; is_wrong: answered more than 3 m off. score: of the
    best candidate; is_best_right, is_best_far: the same of it, answered or not. seconds: of processor time.
    """

    is_right: bool
    is_wrong: bool
    score: float
    is_best_right: bool
    is_best_far: bool
    seconds: float


@dataclass(frozen=True)
class JudgedScene:
    """rank: of the first candidate within 1 m and 1 degree, -1 for none. search_s: of processor time. by_name: of correctors."""

    rank: int
    search_s: float
    by_name: dict[str, Judged]


def judge_scene(spec: LandmarkSpec, seed: int, number: int, learned: LearnedVotingCorrector) -> JudgedScene:
    """Judge the candidates of one scene by both correctors."""
    scene = make_landmark_scene(spec, seed, number)
    ego, other = observe(scene)
    begin = time.process_time()
    found = find_candidates(ego, other, DETECTOR_BOXES_CONFIG.vote)
    search_s = time.process_time() - begin
    right = [n for n, one in enumerate(found) if _is_within(one.pose, scene.ego_from_other)]
    by_name = {}
    for name in _NAMES:
        begin = time.process_time()
        is_learned = name == LEARNED_VOTING and len(found)
        ranked = learned.judge(ego, other, found) if is_learned else found
        accept = learned.config.accept if is_learned else DETECTOR_BOXES_CONFIG.accept
        estimate = decide(ranked, None, accept)
        seconds = time.process_time() - begin
        answer = estimate.measured if estimate.status.has_estimate else None
        by_name[name] = _judge_answer(answer, ranked, scene.ego_from_other, seconds)
    return JudgedScene(right[0] if right else -1, search_s, by_name)


def _judge_answer(
    answer: NDArray[np.float64] | None, ranked: list[Candidate], truth: NDArray[np.float64], seconds: float
) -> Judged:
    best = ranked[0].pose if ranked else None
    return Judged(
        answer is not None and _is_within(answer, truth),
        answer is not None and _is_far(answer, truth),
        ranked[0].score if ranked else -np.inf,
        best is not None and _is_within(best, truth),
        best is not None and _is_far(best, truth),
        seconds,
    )


def _is_within(pose: NDArray[np.float64], truth: NDArray[np.float64]) -> bool:
    error = pose_difference(pose, truth)
    return bool(np.hypot(*error[:2]) < 1.0 and abs(error[2]) < np.radians(1.0))


def _is_far(pose: NDArray[np.float64], truth: NDArray[np.float64]) -> bool:
    return bool(np.hypot(*pose_difference(pose, truth)[:2]) > WRONG_M)


def make_candidate_lines(case: str, scenes: list[JudgedScene]) -> Iterator[Line]:
    """Yield where the right pose is among the candidates of the vote."""
    rank = np.array([s.rank for s in scenes])
    for measure, hits in (
        ("best", rank == 0),
        ("among the best 5", (rank >= 0) & (rank < 5)),
        ("among all", rank >= 0),
    ):
        yield make_rate_line(f"candidates, {case}: {measure}", hits, (None, None))


def make_corrector_lines(case: str, scenes: list[JudgedScene], null_scenes: list[JudgedScene]) -> Iterator[Line]:
    """Yield the fractions of right answers of both, and of the vote with the limit that gives the network's wrong nulls."""
    right = {name: np.array([s.by_name[name].is_right for s in scenes]) for name in _NAMES}
    yield make_rate_line(f"correctors, {case}: voting", right["voting"], (None, None))
    learned_rate = max(np.mean([s.by_name[LEARNED_VOTING].is_wrong for s in null_scenes]), 1 / len(null_scenes))
    (equal,) = compute_success(scenes, null_scenes, "voting", np.array([learned_rate]))
    yield make_mean_line(f"correctors, {case}: voting, limit of equal nulls", [equal] * 2, (None, None))
    least = float(right["voting"].mean()) + MIN_GAIN
    yield make_rate_line(f"correctors, {case}: {LEARNED_VOTING}", right[LEARNED_VOTING], (least, None))
    for name in _NAMES:
        wrong = [s.by_name[name].is_wrong for s in scenes]
        yield make_rate_line(f"correctors, {case}: {name}, wrong by more than 3 m", wrong, (None, None))


def compute_success(
    scenes: list[JudgedScene], null_scenes: list[JudgedScene], name: str, null_rates: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the fractions of true scenes whose best candidate is right and above the limit that gives these wrong nulls."""
    null_scores = np.sort([s.by_name[name].score if s.by_name[name].is_best_far else -np.inf for s in null_scenes])[
        ::-1
    ]
    score = np.array([s.by_name[name].score for s in scenes])
    is_right = np.array([s.by_name[name].is_best_right for s in scenes])
    limits = null_scores[np.minimum(np.floor(null_rates * len(null_scores)).astype(int), len(null_scores) - 1)]
    return np.array([(is_right & (score > limit)).mean() for limit in limits])


def run(
    learned: LearnedVotingCorrector, seed: int, num_scenes: int, num_nulls: int
) -> tuple[list[Line], list[dict[str, Any]]]:
    """Return the lines, and the curves of both scores."""
    lines, roc, timed = list[Line](), list[dict[str, Any]](), list[JudgedScene]()
    for boxes, own in OWN_BOXES.items():
        null_specs = {
            "two places": LandmarkSpec(0, *NULL_BOXES[boxes], REAL_BOXES, disjoint=True),
            "one place": LandmarkSpec(0, *NULL_BOXES[boxes], REAL_BOXES, parked_fraction=0.5),
        }
        null_scenes = list[JudgedScene]()
        for kind, spec in null_specs.items():
            judged = [judge_scene(spec, seed + 1, n, learned) for n in range(num_nulls)]
            null_scenes += judged
            for name in _NAMES:
                wrong = [s.by_name[name].is_wrong for s in judged]
                lines.append(make_rate_line(f"nulls, {boxes}, {kind}: {name}", wrong, (None, MAX_NULLS)))
                sys.stdout.write(f"{lines[-1]}\n")
        for common in NUM_COMMON:
            spec, case = LandmarkSpec(common, *own, REAL_BOXES), f"{boxes}, {common} common"
            judged = [judge_scene(spec, seed, n, learned) for n in range(num_scenes)]
            timed += judged
            for line in (*make_candidate_lines(case, judged), *make_corrector_lines(case, judged, null_scenes)):
                lines.append(line)
                sys.stdout.write(f"{line}\n")
            for name in _NAMES:
                success = compute_success(judged, null_scenes, name, _NULL_RATES).tolist()
                curve = {"null_rate": _NULL_RATES.tolist(), "success": success}
                roc.append({"boxes": boxes, "num_common": common, "score": name, **curve})
            sys.stdout.flush()
    for name in _NAMES:
        times_ms = [1e3 * (s.search_s + s.by_name[name].seconds) for s in timed]
        lines.append(make_mean_line(f"time, all true scenes: {name} [ms]", times_ms, (None, None)))
        sys.stdout.write(f"{lines[-1]}\n")
    return lines, roc


def main() -> None:
    """The benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", type=int, default=600)
    parser.add_argument("--nulls", type=int, default=3000)
    parser.add_argument("--weights", default=DEFAULT_POSE_VERIFIER)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/pose_verifier.json"))
    options = parser.parse_args()
    lines, roc = run(load_learned_voting(options.weights), options.seed, options.scenes, options.nulls)
    command = f"python -m benchmarks.pose_verifier {shlex.join(sys.argv[1:])}".strip()
    result = {"benchmark": "pose_verifier", "command": command, "lines": [asdict(line) for line in lines], "roc": roc}
    write_json(options.out, result, {"command": command}, options.seed)


if __name__ == "__main__":
    main()
