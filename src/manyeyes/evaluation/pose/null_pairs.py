# SPDX-License-Identifier: Apache-2.0
"""Pairs of agents that no corrector can match, and risk against coverage among them.

*Other place*: the ego of one scenario and the other agent of the next; every answer is wrong. *Same place*: the ego at one instant
and the other agent of the same scenario at the instant farthest from it, where the road and what is parked are the same; an
answer is wrong if it is off by more than 3 m. Neither has a prior.

The curves order answers by the corrector's own confidence. *Coverage* is the fraction of true pairs answered; *risk* is the
fraction of wrong answers among all answers of at least that confidence, null pairs weighted as if they were as many as true ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.evaluation.pose.accuracy import LandmarkPair
from manyeyes.evaluation.pose.metrics import PoseEvaluation, evaluate_pose
from manyeyes.pose.registry import load_corrector
from manyeyes.pose.types import project_to_se2

Floats = NDArray[np.float64]

NULL_KINDS = ("other place", "same place")
COVERAGES = tuple(k / 20 for k in range(1, 21))
MAX_ERROR_M = 3.0
"""A same-place answer that is farther off is wrong."""
MAX_TRUE_ERROR = 2.0
"""A true pair's answer that is off by more metres or degrees is wrong."""


@dataclass(frozen=True)
class NullPair:
    """Landmarks of two agents that do not belong together: the pair to correct, and its kind. The pose of the pair is true where
    the place is the same, and means nothing where it is another.
    """

    kind: str
    pair: LandmarkPair


@dataclass(frozen=True)
class NullRun:
    """Answers of a corrector without priors: of true pairs, and of null pairs by kind, in the order of NULL_KINDS."""

    true: tuple[PoseEvaluation, ...]
    null: tuple[tuple[PoseEvaluation, ...], ...]


@dataclass(frozen=True)
class NullRisk:
    """A corrector's numbers for one kind of null pairs. answered, wrong: fractions of the null pairs; wrong is NaN without any.
    coverage: of the true pairs. risk_by_coverage: at COVERAGES, NaN above the largest coverage.
    """

    corrector: str
    kind: str
    num_true: int
    num_null: int
    coverage: float
    answered: float
    wrong: float
    risk_by_coverage: tuple[float, ...]


def make_null_pairs(pairs: Sequence[LandmarkPair]) -> list[NullPair]:
    """Return the null pairs of a recording's true ones, at most two for each: other place, where there is more than one scenario,
    and same place, where there is more than one instant.
    """
    scenarios = list(dict.fromkeys(pair.scenario for pair in pairs))
    by_scenario = {name: [p for p in pairs if p.scenario == name] for name in scenarios}
    out = []
    for n, name in enumerate(scenarios):
        following = by_scenario[scenarios[(n + 1) % len(scenarios)]]
        for k, pair in enumerate(by_scenario[name]):
            if len(scenarios) > 1:
                stranger = following[k % len(following)]
                mixed = replace(pair, other=stranger.other, common_xy=np.zeros((0, 2)))
                out.append(NullPair("other place", mixed))
            then = max(
                (p for p in by_scenario[name] if p.agent_id == pair.agent_id), key=lambda p: abs(p.index - pair.index)
            )
            if then.index != pair.index:
                ego_from_other = pair.world_from_ego.inverse() @ then.world_from_ego @ then.ego_from_other
                later = replace(pair, other=then.other, ego_from_other=ego_from_other, common_xy=np.zeros((0, 2)))
                out.append(NullPair("same place", later))
    return out


def run_null_pairs(pairs: Sequence[LandmarkPair], corrector: str) -> NullRun:
    """Return the answers of a corrector to true pairs and to their null pairs."""
    correct = load_corrector(corrector)

    def evaluate(pair: LandmarkPair) -> PoseEvaluation:
        return evaluate_pose(correct(pair.ego, pair.other, None), project_to_se2(pair.ego_from_other), pair.common_xy)

    nulls = make_null_pairs(pairs)
    return NullRun(
        tuple(map(evaluate, pairs)),
        tuple(tuple(evaluate(one.pair) for one in nulls if one.kind == kind) for kind in NULL_KINDS),
    )


def summarize_null_run(corrector: str, run: NullRun) -> list[NullRisk]:
    """Return the numbers for each kind of null pairs that there is."""
    out = []
    is_answered = np.array([f.status.has_estimate for f in run.true])
    for kind, evaluations in zip(NULL_KINDS, run.null):
        if not evaluations:
            continue
        is_wrong = find_wrong_nulls(kind, evaluations)
        out.append(
            NullRisk(
                corrector,
                kind,
                len(run.true),
                len(evaluations),
                float(is_answered.mean()) if len(is_answered) else math.nan,
                float(np.mean([f.status.has_estimate for f in evaluations])),
                float(is_wrong.mean()),
                tuple(compute_null_risk(run.true, evaluations, is_wrong).tolist()),
            )
        )
    return out


def find_wrong_nulls(kind: str, evaluations: Sequence[PoseEvaluation]) -> NDArray[np.bool_]:
    """Return (N,) bool: which answers to null pairs are wrong."""
    limit = MAX_ERROR_M if kind == "same place" else -math.inf
    return np.array([f.status.has_estimate and f.translation_error_m > limit for f in evaluations], bool)


def compute_null_risk(
    true: Sequence[PoseEvaluation], null: Sequence[PoseEvaluation], is_wrong: NDArray[np.bool_]
) -> Floats:
    """Return the risk at COVERAGES (20,), NaN where so many true pairs are not answered. is_wrong: (N,) of null pairs.

    Answers of equal confidence come in as one, so that no order of the lists can improve the curve.
    """
    confidence = np.array([f.confidence for f in (*true, *null)])
    is_answer = np.array([f.status.has_estimate for f in (*true, *null)], bool)
    is_true = np.arange(len(confidence)) < len(true)
    bad = np.concatenate(([not f.is_within(MAX_TRUE_ERROR) for f in true], is_wrong)).astype(bool) & is_answer
    weight = np.where(is_true, 1.0, len(true) / max(len(null), 1))
    risk = np.full(len(COVERAGES), math.nan)
    answered_true = -np.sort(-confidence[is_true & is_answer])
    for n, coverage in enumerate(COVERAGES):
        needed = math.ceil(round(coverage * len(true), 9))
        if not 0 < needed <= len(answered_true):
            continue
        taken = is_answer & (confidence >= answered_true[needed - 1])
        risk[n] = (weight * (taken & bad)).sum() / (weight * taken).sum()
    return risk
