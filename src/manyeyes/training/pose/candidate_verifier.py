# SPDX-License-Identifier: Apache-2.0
"""Train the verification of candidate poses on generated scenes (candidate_scenes.py); no recording and no detector is needed.

A scene is a choice among its candidates and "none is right", by cross entropy.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from manyeyes.models.pose.candidate_verifier import FORMAT, MASKED_LOGIT, CandidateVerifier, CandidateVerifierConfig
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.training.pose.candidate_scenes import LabelledCandidates
from manyeyes.training.trainer import Task, TrainConfig


@dataclass(frozen=True)
class CandidateVerifierTrainConfig(TrainConfig):
    """net: configuration of the network. num_scenes: generated, each used several times."""

    net: CandidateVerifierConfig = CandidateVerifierConfig()
    _: KW_ONLY
    num_scenes: int = 16000


CANDIDATE_VERIFIER_TRAINING_PRESETS: dict[str, CandidateVerifierTrainConfig] = {
    "pose-verifier-small": CandidateVerifierTrainConfig(
        steps=2500, batch=256, learning_rate=3e-3, ema_decay=0.99, save_every=500
    )
}
"""The shipped weights."""


def choice_loss(odds: Tensor, is_right: Tensor, is_unclear: Tensor) -> Tensor:
    """Return the mean cross entropy of the choice among candidates (B, K) and none; unclear ones are left out."""
    odds = odds.masked_fill(is_unclear, MASKED_LOGIT)
    every = functional.pad(odds, (1, 0))
    target = torch.cat((~is_right.any(1, keepdim=True), is_right), 1)
    return (every.logsumexp(1) - every.masked_fill(~target, MASKED_LOGIT).logsumexp(1)).mean()


@lru_cache(maxsize=2)
def _permute(seed: int, round_number: int, count: int) -> NDArray[np.int64]:
    return keyed_generator(seed, "candidate order", round_number).permutation(count)


@dataclass
class CandidateVerifierTask(Task[CandidateVerifierTrainConfig, CandidateVerifier, int]):
    """Train the network on labelled scenes; a sample is the number of a scene."""

    format = FORMAT

    config: CandidateVerifierTrainConfig
    scenes: LabelledCandidates
    seed: int = 0

    def make_model(self) -> CandidateVerifier:
        """Make the network with random weights, standardised by the scenes."""
        model = CandidateVerifier(self.config.net)
        model.standardise(torch.from_numpy(self.scenes.features[self.scenes.exists]))
        return model

    def draw(self, number: int) -> int:
        """Draw a scene: every one once before any is drawn again, in another order each time."""
        count = len(self.scenes.exists)
        return int(_permute(self.seed, number // count, count)[number % count])

    def loss(
        self, model: CandidateVerifier, samples: list[int], numbers: range, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the loss of the choice."""
        device = model.mean.device
        features, exists, right, unclear = (
            torch.from_numpy(getattr(self.scenes, name)[samples]).to(device)
            for name in ("features", "exists", "is_right", "is_unclear")
        )
        return choice_loss(model(features, exists), right, unclear), {}
