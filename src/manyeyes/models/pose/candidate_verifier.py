# SPDX-License-Identifier: Apache-2.0
"""Learned verification of candidate poses: log-odds that a pose of the vote is right, from the geometry of both agents' boxes.

The vote (pose/voting.py) adds the evidence of a candidate's pairs as if they agreed by chance independently of each other, and
ignores the other boxes. A small network weighs that sum with what the boxes say besides (pose/candidate_features.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from manyeyes._bounds import ChannelCount
from manyeyes.models import checkpoint

FORMAT = "manyeyes-candidate-verifier-1"
NUM_FEATURES = 25
"""Of a candidate; pose/candidate_features.py names them."""
MASKED_LOGIT = -1e4
_MAX_SIGMAS = 6.0


@dataclass(frozen=True)
class CandidateVerifierConfig:
    """hidden: width of the two hidden layers. dropout: in training."""

    hidden: ChannelCount = 48
    dropout: float = 0.1


class CandidateVerifier(nn.Module):
    """A perceptron with two hidden layers on standardised features, the same for every candidate."""

    mean: Tensor
    scale: Tensor

    def __init__(self, config: CandidateVerifierConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.zeros(NUM_FEATURES, device="cpu"))
        self.register_buffer("scale", torch.ones(NUM_FEATURES, device="cpu"))
        width = config.hidden
        self.net = nn.Sequential(
            nn.Linear(NUM_FEATURES, width),
            nn.GELU(),
            nn.Dropout(config.dropout),
            nn.Linear(width, width),
            nn.GELU(),
            nn.Dropout(config.dropout),
            nn.Linear(width, 1),
        )

    def standardise(self, features: Tensor) -> None:
        """Set mean and scale to those of features (N, NUM_FEATURES)."""
        self.mean.copy_(features.mean(0))
        self.scale.copy_(features.std(0).clamp_min(1e-3))

    def forward(self, features: Tensor, exists: Tensor) -> Tensor:
        """Return the log-odds (..., K) of candidates against "none is right"; MASKED_LOGIT where exists (..., K) is false.

        Args:
            features: (..., K, NUM_FEATURES).
        """
        x = ((features - self.mean) / self.scale).clamp(-_MAX_SIGMAS, _MAX_SIGMAS)
        return self.net(x)[..., 0].masked_fill(~exists, MASKED_LOGIT)


def load(path: Path) -> CandidateVerifier:
    """Load a network in evaluation mode."""
    return checkpoint.load_as(path, FORMAT, CandidateVerifierConfig, CandidateVerifier)
