# SPDX-License-Identifier: Apache-2.0
"""The vote with a learned acceptance: a network states the log-odds that each of its best candidates is right.

The vote's own limit is on the sum of its pairs' evidence (corrector.py). Here the limit is on the log-odds of the network
(models/pose/candidate_verifier.py), and a prior adds the logarithm of its density as it does to the vote's score. Inputs are the
same boxes: nothing is added to messages.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.models import pretrained
from manyeyes.models.pose.candidate_verifier import CandidateVerifier
from manyeyes.pose.candidate_features import compute_features
from manyeyes.pose.corrector import DETECTOR_BOXES_CONFIG, AcceptanceTest, CorrectorConfig, decide, prior_log_ratios
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior
from manyeyes.pose.voting import Candidate, find_candidates

LEARNED_VOTING = "learned-voting"


@dataclass(frozen=True)
class LearnedVotingConfig:
    """Settings of the learned acceptance.

    Attributes:
        vote: search and acceptance of the vote; the acceptance is for several instants, and for more than max_landmarks.
        accept: limits of the log-odds, and of their margin over the next candidate.
        max_candidates: candidates that the network compares.
        max_landmarks: of one agent; few scenes of the training have more.
    """

    vote: CorrectorConfig = DETECTOR_BOXES_CONFIG
    accept: AcceptanceTest = field(
        default_factory=lambda: AcceptanceTest(
            min_score=6.0, score_per_log_pair=0.0, min_margin=3.0, runner_up_margin_pairs=0.0, conflict_margin=5.0
        )
    )
    max_candidates: int = 3
    max_landmarks: int = 60


@dataclass(frozen=True)
class LearnedVotingCorrector:
    """A corrector on landmarks of one instant."""

    net: CandidateVerifier
    config: LearnedVotingConfig = LearnedVotingConfig()

    def __call__(self, ego: Landmarks, other: Landmarks, prior: PosePrior | None) -> PoseEstimate:
        """Estimate ego_from_other from the common objects of two agents and an optional prior."""
        vote = self.config.vote
        found = find_candidates(ego, other, vote.vote, prior)
        is_single = not (ego.instant.any() or other.instant.any())
        if not found or not is_single or max(len(ego), len(other)) > self.config.max_landmarks:
            return decide(found, prior, vote.accept, len(np.unique(ego.instant)))
        return decide(self.judge(ego, other, found, prior), prior, self.config.accept)

    def judge(
        self, ego: Landmarks, other: Landmarks, found: list[Candidate], prior: PosePrior | None = None
    ) -> list[Candidate]:
        """Return the best candidates of the vote with their log-odds as scores, most likely first."""
        ratios = prior_log_ratios(found, prior, self.config.accept.prior_volume)
        order = sorted(range(len(found)), key=lambda n: (-found[n].score - ratios[n], n))
        ranked = [found[n] for n in order]
        odds = self._compute_odds(ego, other, ranked)
        return sorted((replace(one, score=float(score)) for one, score in zip(ranked, odds)), key=lambda c: -c.score)

    @torch.inference_mode()
    def _compute_odds(self, ego: Landmarks, other: Landmarks, ranked: list[Candidate]) -> NDArray[np.float64]:
        """Return the log-odds of at most max_candidates candidates against "none is right"."""
        vote = self.config.vote.vote
        kept = [x.select_indices(vote.max_range_m, vote.max_landmarks) for x in (ego, other)]
        place = [np.full(len(x), -1, np.int64) for x in (ego, other)]
        for rows, at in zip(kept, place):
            at[rows] = np.arange(len(rows))
        count = self.config.max_candidates
        best = [
            replace(one, pairs=np.stack((place[0][one.pairs[:, 0]], place[1][one.pairs[:, 1]]), 1))
            for one in ranked[:count]
        ]
        features, exists = compute_features(ego[kept[0]], other[kept[1]], [*best, *ranked[count:]], count)
        odds = self.net(torch.from_numpy(features), torch.from_numpy(exists))
        return odds[: len(ranked)].double().numpy()


@cache
def load_learned_voting(weights: str = pretrained.DEFAULT_POSE_VERIFIER) -> LearnedVotingCorrector:
    """Return the corrector with the weights of a shipped name or a file; loaded once per process."""
    return LearnedVotingCorrector(pretrained.load_pose_verifier(weights))


@register_pose_corrector(LEARNED_VOTING)
def correct_by_learned_voting(ego: Landmarks, other: Landmarks, prior: PosePrior | None) -> PoseEstimate:
    """Estimate ego_from_other by the vote's candidates and the shipped network."""
    return load_learned_voting()(ego, other, prior)
