# SPDX-License-Identifier: Apache-2.0
"""The default corrector: accept or reject the best candidate pose, and fuse it with the prior.

A candidate is accepted by its log-likelihood ratio against chance and by its margin over the best distinct other candidate. The
score that chance reaches grows with the logarithm of the number of pairs that were compared, and so does the limit. Limits are
calibrated on pairs of agents without common objects, of several densities (benchmarks/pose_real.py). A prior raises the score of
candidates near it by the logarithm of its density over that of a uniform pose, and never lowers a score. The accepted
candidate is compared with the prior by the squared Mahalanobis distance, a chi^2 test with 3 degrees of freedom. Below
p = 0.05 the two are fused by their information. Below p = 0.001 the prior is not used. In between its covariance is
inflated first. FeaKM's section 4.2.2 instead replaces the prior wherever the computed pose differs significantly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import (
    PoseEstimate,
    PosePrior,
    PoseStatus,
    lift_to_se3,
    no_estimate,
    pose_difference,
    wrap_angle,
)
from manyeyes.pose.voting import Candidate, VoteConfig, find_candidates

Floats = NDArray[np.float64]

CHI2_3DOF_P05, CHI2_3DOF_P001 = 7.815, 16.266
"""chi^2 with 3 degrees of freedom at p = 0.05 and p = 0.001."""


@dataclass(frozen=True)
class AcceptanceTest:
    """Limits for accepting a candidate.

    min_score, score_per_log_pair: the log-likelihood ratio against chance needs min_score + score_per_log_pair ln(num_compared).
    min_margin: over the best distinct other candidate; runner_up_margin_pairs: and at least so many times the mean score of a
    pair, since an evenly spaced queue shifted by one place loses only one pair. min_pairs: pairs, where no prior supports the
    candidate. prior_volume: volume (m^2 rad) of a uniform pose, 100 m around with any yaw. conflict_margin: additional score and
    margin for a candidate that conflicts with the prior.
    """

    min_score: float = 6.5
    score_per_log_pair: float = 3.5
    min_margin: float = 3.0
    min_pairs: int = 3
    runner_up_margin_pairs: float = 1.5
    extra_score_per_instant: float = 4.0
    prior_volume: float = 2.0e5
    conflict_margin: float = 0.0

    def __post_init__(self) -> None:
        if not (
            math.isfinite(self.min_score) and self.min_margin >= 0 and self.prior_volume > 0 and self.min_pairs > 0
        ):
            raise ConfigError(
                "AcceptanceTest needs a finite min_score, min_margin >= 0, min_pairs >= 1 and prior_volume > 0."
            )
        if not min(self.score_per_log_pair, self.runner_up_margin_pairs) >= 0:
            raise ConfigError("AcceptanceTest needs score_per_log_pair and runner_up_margin_pairs of at least 0.")
        if not self.conflict_margin >= 0:
            raise ConfigError(f"AcceptanceTest needs conflict_margin >= 0; got {self.conflict_margin}.")

    def required_score(self, num_compared: int, num_instants: int = 1) -> float:
        """Return the score that a candidate needs: of so many compared pairs of landmarks in so many instants."""
        extra_score = self.extra_score_per_instant * max(num_instants - 1, 0)
        return self.min_score + self.score_per_log_pair * math.log(num_compared) + extra_score


@dataclass(frozen=True)
class CorrectorConfig:
    """Search and acceptance settings of the default corrector."""

    vote: VoteConfig = VoteConfig()
    accept: AcceptanceTest = AcceptanceTest()


DETECTOR_BOXES_CONFIG = CorrectorConfig(
    VoteConfig(
        common_variance_fraction=0.05,
        lateral_sigma_ratio=0.6,
        few_pairs_inflation=2.0,
        floor_xy_m=0.07,
        floor_yaw_rad=math.radians(0.15),
    ),
    AcceptanceTest(conflict_margin=5.0),
)
"""For boxes of detectors: errors of one view are correlated, since a sensor observes one side of a vehicle, longitudinal errors are
larger than lateral ones, since the far end is seldom observed, and their tails are heavy. Vehicles in a queue agree by chance
(docs/concepts/pose-correction.md).
"""


def correct_by_voting(
    ego: Landmarks, other: Landmarks, prior: PosePrior | None, config: CorrectorConfig | None = None
) -> PoseEstimate:
    """Estimate ego_from_other from the common objects of two agents and an optional prior."""
    config = config or CorrectorConfig()
    num_instants = len(np.unique(ego.instant))
    return decide(find_candidates(ego, other, config.vote, prior), prior, config.accept, num_instants)


register_pose_corrector("voting")(partial(correct_by_voting, config=DETECTOR_BOXES_CONFIG))


@dataclass(frozen=True)
class RankedCandidates:
    """The best candidate, its score with the prior's part, its margin over the runner-up, and the runner-up's pairs."""

    best: Candidate
    score: float
    margin: float
    runner_up: int


def rank_candidates(found: list[Candidate], prior: PosePrior | None, prior_volume: float) -> RankedCandidates | None:
    """Rank candidates by score plus the log density ratio of the prior."""
    if not found:
        return None
    scores = [c.score + ratio for c, ratio in zip(found, prior_log_ratios(found, prior, prior_volume))]
    order = sorted(range(len(found)), key=lambda n: (-scores[n], n))
    first = order[0]
    if len(order) == 1:
        return RankedCandidates(found[first], scores[first], scores[first], 0)
    margin = scores[first] - max(scores[order[1]], 0.0)
    return RankedCandidates(found[first], scores[first], margin, max(len(found[n].pairs) for n in order[1:]))


def decide(
    found: list[Candidate], prior: PosePrior | None, acceptance: AcceptanceTest, num_instants: int = 1
) -> PoseEstimate:
    """Accept or reject the best candidate, and fuse it with the prior. num_instants: number of frames of the landmarks."""
    ranked = rank_candidates(found, prior, acceptance.prior_volume)
    if ranked is None:
        return no_estimate(prior)
    best = ranked.best
    prior_agrees = prior_log_ratios([best], prior, acceptance.prior_volume)[0] > 0
    is_conflict = prior is not None and mahalanobis_squared(best.pose, best.covariance, prior) > CHI2_3DOF_P001
    extra_margin = acceptance.conflict_margin if is_conflict else 0.0
    min_score = acceptance.required_score(best.num_compared, num_instants) + extra_margin
    if ranked.score < min_score or len(best.pairs) < (1 if prior_agrees else acceptance.min_pairs):
        return replace(no_estimate(prior), inliers=len(best.pairs), runner_up=ranked.runner_up, margin=ranked.margin)
    mean_pair_score = best.score / len(best.pairs)
    if ranked.margin < max(acceptance.runner_up_margin_pairs * mean_pair_score, acceptance.min_margin) + extra_margin:
        estimate = no_estimate(prior, PoseStatus.AMBIGUOUS)
        return replace(
            estimate, inliers=len(best.pairs), runner_up=ranked.runner_up, margin=ranked.margin, pairs=best.pairs
        )
    pose, covariance, status, distance = _fuse_with_prior(best, prior)
    return PoseEstimate(
        lift_to_se3(pose, prior),
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


def fuse_estimates(pose: Floats, covariance: Floats, other: Floats, other_covariance: Floats) -> tuple[Floats, Floats]:
    """Fuse two independent estimates (3,), (3, 3) of one pose by their information; one covariance may be zero."""
    gain = np.linalg.solve(covariance + other_covariance, covariance).T
    mean = pose + gain @ pose_difference(other, pose)
    rest = np.eye(3) - gain
    joint = rest @ covariance @ rest.T + gain @ other_covariance @ gain.T
    return np.array([mean[0], mean[1], wrap_angle(mean[2])]), joint


def _fuse_with_prior(best: Candidate, prior: PosePrior | None) -> tuple[Floats, Floats, PoseStatus, float]:
    if prior is None:
        return best.pose, best.covariance, PoseStatus.CORRECTED, float("nan")
    distance = mahalanobis_squared(best.pose, best.covariance, prior)
    if distance > CHI2_3DOF_P001:
        return best.pose, best.covariance, PoseStatus.CONFLICT, distance
    pose, covariance = fuse_estimates(
        best.pose, best.covariance, prior.pose, inflate_covariance(prior, distance).covariance
    )
    return pose, covariance, PoseStatus.OK if distance <= CHI2_3DOF_P05 else PoseStatus.CORRECTED, distance


def inflate_covariance(prior: PosePrior, distance: float) -> PosePrior:
    """Inflate the prior's covariance where its squared Mahalanobis distance from the candidate exceeds p = 0.05."""
    return replace(prior, covariance=prior.covariance * max(1.0, distance / CHI2_3DOF_P05) ** 2)


def mahalanobis_squared(pose: Floats, covariance: Floats, prior: PosePrior) -> float:
    """Return the squared Mahalanobis distance of a measured pose (3,), (3, 3) from the prior."""
    delta = pose_difference(pose, prior.pose)
    return float(delta @ np.linalg.solve(covariance + prior.covariance, delta))


def prior_log_ratios(candidates: list[Candidate], prior: PosePrior | None, prior_volume: float) -> list[float]:
    """Return the log density of each pose under the prior, over that of a uniform pose; never negative."""
    if prior is None:
        return [0.0] * len(candidates)
    spread = np.array([c.covariance for c in candidates]) + prior.covariance
    delta = np.array([c.pose for c in candidates]) - prior.pose
    delta[:, 2] = (delta[:, 2] + np.pi) % (2 * np.pi) - np.pi
    distance = (delta * np.linalg.solve(spread, delta[:, :, None])[:, :, 0]).sum(1)
    _, size = np.linalg.slogdet(2 * np.pi * spread)
    return np.maximum(0.0, math.log(prior_volume) - (size + distance) / 2).tolist()
