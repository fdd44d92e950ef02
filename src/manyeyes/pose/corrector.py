# SPDX-License-Identifier: Apache-2.0
"""The default corrector: whether the best vote is believed, and what becomes of the claimed pose.

A vote is accepted by how much likelier it is than chance and than the best distinct other vote, at limits calibrated
on pairs of agents that share no object (calibrate). A claimed pose makes votes near it likelier, by the logarithm of
its density against that of a pose that may be anywhere; a wrong claim takes nothing away. Then the claim is tested
against the vote: squared Mahalanobis distance, chi^2 with 3 degrees of freedom. Where they agree the two are fused by
their information; a doubtful claim is inflated first; a refuted one is not used. Spec: specs/pose.md 4.3, 4.4, which
replaces FeaKM's "use the calculated pose if it differs significantly".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseClaim, PoseEstimate, PoseStatus, difference, unanswered, upright, wrapped
from manyeyes.pose.voting import Candidate, VoteConfig, candidates

Floats = NDArray[np.float64]

DOUBTFUL, REFUTED = 7.815, 16.266
"""chi^2 with 3 degrees of freedom at p = 0.05 and p = 0.001."""


@dataclass(frozen=True)
class Acceptance:
    """When a vote is believed.

    least_score: log-likelihood ratio against chance that it needs; least_margin: and against the best distinct other
    vote. least_pairs: and how many pairs, where no claim supports it. rival_pairs: a runner-up that would be believed
    if it were alone must be so many (mean) pairs behind: a queue that slips by one place loses only one. anywhere:
    volume (m^2 rad) of poses that an unknown pose may take, 100 m around with any yaw. refuting: how much more of score and margin
    a vote needs that refutes the claim, since claims are seldom that wrong.
    """

    least_score: float = 24.0
    least_margin: float = 3.0
    least_pairs: int = 3
    rival_pairs: float = 2.0
    per_instant: float = 4.0
    anywhere: float = 2.0e5
    refuting: float = 0.0

    def __post_init__(self) -> None:
        if not (
            math.isfinite(self.least_score) and self.least_margin >= 0 and self.anywhere > 0 and self.least_pairs > 0
        ):
            raise ConfigError(
                "Acceptance needs a finite least_score, least_margin >= 0, least_pairs >= 1 and anywhere > 0."
            )
        if not self.refuting >= 0:
            raise ConfigError(f"Acceptance needs refuting >= 0; got {self.refuting}.")


@dataclass(frozen=True)
class CorrectorConfig:
    """How the default corrector searches and when it answers."""

    vote: VoteConfig = VoteConfig()
    accept: Acceptance = Acceptance()


DETECTED = CorrectorConfig(VoteConfig(shared=0.05, across=0.6), Acceptance(refuting=5.0))
"""For what detectors find: boxes of one view err alike, each towards who sees but one side of a vehicle, and along a vehicle, whose
far end is seldom seen, more than across it; and vehicles that stand in a queue agree by chance (docs/pose.md has the figures).
"""


def correct(
    ego: Landmarks, other: Landmarks, claimed: PoseClaim | None, config: CorrectorConfig | None = None
) -> PoseEstimate:
    """Where the other agent is, from the objects that both see and from what is claimed, if anything is."""
    config = config or CorrectorConfig()
    instants = len(np.unique(ego.instant))
    return decide(candidates(ego, other, config.vote, claimed), claimed, config.accept, instants)


@dataclass(frozen=True)
class Ranked:
    """The best vote, its score with what the claim adds, by how much that exceeds the runner-up's, and the
    runner-up's pairs.
    """

    best: Candidate
    score: float
    margin: float
    runner_up: int


def rank(found: list[Candidate], claimed: PoseClaim | None, anywhere: float) -> Ranked | None:
    """Votes ordered by score and claim together."""
    if not found:
        return None
    scores = [c.score + _bonus(c, claimed, anywhere) for c in found]
    order = sorted(range(len(found)), key=lambda n: (-scores[n], n))
    first = order[0]
    if len(order) == 1:
        return Ranked(found[first], scores[first], scores[first], 0)
    margin = scores[first] - max(scores[order[1]], 0.0)
    return Ranked(found[first], scores[first], margin, max(len(found[n].pairs) for n in order[1:]))


def decide(found: list[Candidate], claimed: PoseClaim | None, accept: Acceptance, instants: int = 1) -> PoseEstimate:
    """The answer that votes, likeliest first, from so many instants, and a claim give together."""
    least = accept.least_score + accept.per_instant * max(instants - 1, 0)
    ranked = rank(found, claimed, accept.anywhere)
    if ranked is None:
        return unanswered(claimed)
    best = ranked.best
    known = _bonus(best, claimed, accept.anywhere) > 0
    refutes = claimed is not None and mahalanobis(best.pose, best.covariance, claimed) > REFUTED
    more = accept.refuting if refutes else 0.0
    if ranked.score < least + more or len(best.pairs) < (1 if known else accept.least_pairs):
        return replace(unanswered(claimed), inliers=len(best.pairs), runner_up=ranked.runner_up, margin=ranked.margin)
    rival = ranked.score - ranked.margin >= least
    wanted = accept.rival_pairs * best.score / len(best.pairs) if rival else accept.least_margin
    if ranked.margin < max(wanted, accept.least_margin) + more:
        said = unanswered(claimed, PoseStatus.AMBIGUOUS)
        return replace(
            said, inliers=len(best.pairs), runner_up=ranked.runner_up, margin=ranked.margin, pairs=best.pairs
        )
    pose, covariance, status, distance = _joined(best, claimed)
    return PoseEstimate(
        upright(pose, claimed),
        covariance,
        status,
        len(best.pairs),
        ranked.runner_up,
        ranked.margin,
        best.pairs,
        best.pose,
        best.covariance,
        distance,
    )


def fused(pose: Floats, covariance: Floats, other: Floats, other_covariance: Floats) -> tuple[Floats, Floats]:
    """Two independent estimates (3,), (3, 3) of one pose as one, weighted by information; either covariance may be
    zero.
    """
    gain = np.linalg.solve(covariance + other_covariance, covariance).T
    moved = pose + gain @ difference(other, pose)
    rest = np.eye(3) - gain
    joint = rest @ covariance @ rest.T + gain @ other_covariance @ gain.T
    return np.array([moved[0], moved[1], wrapped(moved[2])]), joint


def _joined(best: Candidate, claimed: PoseClaim | None) -> tuple[Floats, Floats, PoseStatus, float]:
    if claimed is None:
        return best.pose, best.covariance, PoseStatus.CORRECTED, float("nan")
    distance = mahalanobis(best.pose, best.covariance, claimed)
    if distance > REFUTED:
        return best.pose, best.covariance, PoseStatus.CONFLICT, distance
    pose, covariance = fused(best.pose, best.covariance, claimed.pose, inflated(claimed, distance).covariance)
    return pose, covariance, PoseStatus.OK if distance <= DOUBTFUL else PoseStatus.CORRECTED, distance


def inflated(claimed: PoseClaim, distance: float) -> PoseClaim:
    """The claim with a wider covariance, where objects lie at a doubtful squared Mahalanobis distance from it."""
    return replace(claimed, covariance=claimed.covariance * max(1.0, distance / DOUBTFUL) ** 2)


def mahalanobis(pose: Floats, covariance: Floats, claimed: PoseClaim) -> float:
    """Squared Mahalanobis distance of a measured pose (3,), (3, 3) from a claimed one."""
    delta = difference(pose, claimed.pose)
    return float(delta @ np.linalg.solve(covariance + claimed.covariance, delta))


def _bonus(candidate: Candidate, claimed: PoseClaim | None, anywhere: float) -> float:
    """Log of how much likelier the claim makes this pose than if it could be anywhere; never negative."""
    if claimed is None:
        return 0.0
    spread = candidate.covariance + claimed.covariance
    distance = mahalanobis(candidate.pose, candidate.covariance, claimed)
    _, size = np.linalg.slogdet(2 * np.pi * spread)
    return max(0.0, math.log(anywhere) - (size + distance) / 2)
