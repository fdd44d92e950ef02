# SPDX-License-Identifier: Apache-2.0
"""The vote with a learned acceptance: a network matches all boxes under each of the vote's candidates, and states its log-odds.

The vote's own limit is on the sum of its pairs' evidence (corrector.py). Here the network (models/pose/candidate_matcher.py) states
for each of the best candidates the log-odds against "none is right". The limit is on these odds, and a prior adds the logarithm
of its density as it does to the vote's score. Inputs are the same boxes: nothing is added to messages.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.models import pretrained
from manyeyes.models.pose.candidate_matcher import CandidateMatcher
from manyeyes.pose.candidate_batch import MAX_CANDIDATES, CandidateSet, make_batch
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
        vote: search and acceptance of the vote; the acceptance is for landmarks of several instants and more than max_landmarks.
        accept: limits of the log-odds, and of their margin over the next candidate.
        max_landmarks: of one agent; training has no more.
    """

    vote: CorrectorConfig = DETECTOR_BOXES_CONFIG
    accept: AcceptanceTest = field(
        default_factory=lambda: AcceptanceTest(
            min_score=5.0, score_per_log_pair=0.0, min_margin=1.5, runner_up_margin_pairs=0.0, conflict_margin=5.0
        )
    )
    max_landmarks: int = 56


@dataclass(frozen=True)
class LearnedVotingCorrector:
    """A corrector on landmarks of one instant."""

    net: CandidateMatcher
    config: LearnedVotingConfig = LearnedVotingConfig()

    def __call__(self, ego: Landmarks, other: Landmarks, prior: PosePrior | None) -> PoseEstimate:
        """Estimate ego_from_other from the common objects of two agents and an optional prior."""
        return self.choose(ego, other, find_candidates(ego, other, self.config.vote.vote, prior), prior)

    def choose(self, ego: Landmarks, other: Landmarks, found: list[Candidate], prior: PosePrior | None) -> PoseEstimate:
        """Accept or reject the candidates of the vote."""
        vote, accept = self.config.vote, self.config.accept
        is_single = not (ego.instant.any() or other.instant.any())
        if not found or not is_single or max(len(ego), len(other)) > self.config.max_landmarks:
            return decide(found, prior, vote.accept, len(np.unique(ego.instant)))
        return decide(self.judge(ego, other, found, prior), prior, accept)

    def judge(
        self, ego: Landmarks, other: Landmarks, found: list[Candidate], prior: PosePrior | None = None
    ) -> list[Candidate]:
        """Return the best candidates of the vote with their log-odds as scores, most likely first."""
        ratios = prior_log_ratios(found, prior, self.config.accept.prior_volume)
        order = sorted(range(len(found)), key=lambda n: (-found[n].score - ratios[n], n))[:MAX_CANDIDATES]
        best = [found[n] for n in order]
        odds = self.compute_odds(ego, other, best)
        return sorted((replace(one, score=float(score)) for one, score in zip(best, odds)), key=lambda c: -c.score)

    @torch.inference_mode()
    def compute_odds(self, ego: Landmarks, other: Landmarks, found: list[Candidate]) -> NDArray[np.float64]:
        """Return the log-odds (K,) of at most MAX_CANDIDATES candidates against "none is right"."""
        vote = self.config.vote.vote
        kept = [x.select_indices(vote.max_range_m, vote.max_landmarks) for x in (ego, other)]
        place = [np.full(len(x), -1, np.int64) for x in (ego, other)]
        for rows, at in zip(kept, place):
            at[rows] = np.arange(len(rows))
        moved = [
            replace(one, pairs=np.stack((place[0][one.pairs[:, 0]], place[1][one.pairs[:, 1]]), 1)) for one in found
        ]
        batch = make_batch([CandidateSet.of(ego[kept[0]], other[kept[1]], moved)])
        return self.net(batch).candidate[0, : len(found)].double().numpy()


@cache
def load_learned_voting(weights: str = pretrained.DEFAULT_POSE_MATCHER) -> LearnedVotingCorrector:
    """Return the corrector with the weights of a shipped name or a file; loaded once per process."""
    return LearnedVotingCorrector(pretrained.load_pose_matcher(weights))


@register_pose_corrector(LEARNED_VOTING)
def correct_by_learned_voting(ego: Landmarks, other: Landmarks, prior: PosePrior | None) -> PoseEstimate:
    """Estimate ego_from_other by the vote's candidates and the shipped network."""
    return load_learned_voting()(ego, other, prior)
