# SPDX-License-Identifier: Apache-2.0
"""Consensus by sampling, after ROBOSAC (Li et al., "Among Us: Adversarially Robust Collaborative Perception by Consensus", ICCV
2023).

Random subsets of senders are fused with the ego; the first whose boxes agree with those of the ego alone is used, and no other
sender. Written from the paper's description: each frame is judged by itself, and what the ego alone does not detect counts as
disagreement.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from manyeyes.agents.trust.agreement import jaccard
from manyeyes.agents.trust.interface import Assessment, MisbehaviourDetector, MisbehaviourInput, SenderAssessment
from manyeyes.agents.trust.registry import register_misbehaviour_detector
from manyeyes.ops.keyed_random import keyed_uniform

NOT_SAMPLED = "in no subset that agrees with the ego"


@register_misbehaviour_detector("robosac")
@dataclass(frozen=True)
class RobosacDetector(MisbehaviourDetector):
    """num_trials: subsets that are fused in a frame. malicious_fraction: assumed. success_prob: that one subset is honest.

    min_agreement: Jaccard index of the boxes of min_score of a subset and of the ego alone, from which on the subset is used.
    """

    num_trials: int = 5
    malicious_fraction: float = 0.25
    success_prob: float = 0.99
    min_agreement: float = 0.3
    min_score: float = 0.3
    seed: int = 0

    @property
    def subset_size(self) -> int:
        """Number of senders of a subset, so that one of num_trials subsets is honest with success_prob; at least 1."""
        failure = 1 - (1 - self.success_prob) ** (1 / self.num_trials)
        return max(1, math.floor(math.log(failure) / math.log(1 - self.malicious_fraction)))

    def assess(self, received: MisbehaviourInput, state: object | None) -> Assessment:
        """Return weight 1 of the senders of the first subset that agrees with the ego, and weight 0 of the others."""
        agent_ids = np.array(received.agent_ids, np.int64)
        size, used = min(self.subset_size, len(agent_ids)), frozenset[int]()
        own = received.own[received.own.score >= self.min_score]
        for trial in range(self.num_trials if size else 0):
            key = ("robosac", received.frame.agent_id, received.frame.timestamp_ns, trial)
            order = keyed_uniform((len(agent_ids),), self.seed, *key).argsort()
            subset = frozenset(agent_ids[order[:size].numpy()].tolist())
            fused = received.fuse(subset)
            if jaccard(own, fused[fused.score >= self.min_score]) >= self.min_agreement:
                used = subset
                break
        return Assessment(
            tuple(
                SenderAssessment(a, 1.0) if a in used else SenderAssessment(a, 0.0, 0.0, reason=NOT_SAMPLED)
                for a in received.agent_ids
            )
        )
