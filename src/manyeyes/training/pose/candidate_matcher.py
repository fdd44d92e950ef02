# SPDX-License-Identifier: Apache-2.0
"""Train the learned matcher on generated scenes (candidate_scenes.py); no recording and no detector is needed.

A scene is a choice among its candidates and "none is right", by cross entropy; a pair is one object or not, by binary cross
entropy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from manyeyes.models.pose.candidate_matcher import (
    FORMAT,
    MASKED_LOGIT,
    CandidateMatcher,
    CandidateMatcherConfig,
    CandidateOdds,
)
from manyeyes.pose.candidate_batch import make_batch
from manyeyes.training.pose.candidate_scenes import SCENES_PER_DENSITY, LabelledCandidates, draw_labelled_candidates
from manyeyes.training.trainer import Task, TrainConfig


@dataclass(frozen=True)
class CandidateMatcherTrainConfig(TrainConfig):
    """net: configuration of the network. pair_loss_weight: of the pairs' loss beside that of the choice."""

    net: CandidateMatcherConfig = CandidateMatcherConfig()
    _: KW_ONLY
    pair_loss_weight: float = 0.3


CANDIDATE_MATCHER_TRAINING_PRESETS: dict[str, CandidateMatcherTrainConfig] = {
    "pose-matcher-small": CandidateMatcherTrainConfig(
        steps=600,
        batch=32,
        micro_batch=SCENES_PER_DENSITY,
        learning_rate=2e-3,
        max_grad_norm=2.0,
        ema_decay=0.98,
        warmup_steps=50,
        save_every=50,
    )
}
"""The shipped weights."""


def choice_loss(odds: Tensor, is_right: Tensor, is_unclear: Tensor) -> Tensor:
    """Return the mean cross entropy of the choice among candidates (B, K) and none; unclear ones are left out."""
    odds = odds.masked_fill(is_unclear, MASKED_LOGIT)
    every = functional.pad(odds, (1, 0))
    target = torch.cat((~is_right.any(1, keepdim=True), is_right), 1)
    return (every.logsumexp(1) - every.masked_fill(~target, MASKED_LOGIT).logsumexp(1)).mean()


def pair_loss(odds: CandidateOdds, is_match: Tensor, is_pair: Tensor) -> Tensor:
    """Return the mean binary cross entropy of pairs (B, K, P); padding is left out."""
    each = functional.binary_cross_entropy_with_logits(odds.pair, is_match.to(odds.pair.dtype), reduction="none")
    return torch.where(is_pair, each, 0.0).sum() / is_pair.sum().clamp_min(1)


@dataclass
class CandidateMatcherTask(Task[CandidateMatcherTrainConfig, CandidateMatcher, LabelledCandidates]):
    """Train the matcher; the log holds the fraction of scenes whose choice is right."""

    format = FORMAT
    shown_terms = ("choice", "is_right")

    config: CandidateMatcherTrainConfig
    seed: int = 0

    def make_model(self) -> CandidateMatcher:
        """Make the network with random weights."""
        return CandidateMatcher(self.config.net)

    def draw(self, number: int) -> LabelledCandidates:
        """Draw the scene of this number."""
        return draw_labelled_candidates(self.seed, number)

    def loss(
        self, model: CandidateMatcher, samples: list[LabelledCandidates], numbers: range, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the loss of the choice and of the pairs."""
        device = next(model.parameters()).device
        batch = make_batch([s.candidates for s in samples]).to(device)
        right, unclear, match = (
            _stack([getattr(s, name) for s in samples]).to(device) for name in ("is_right", "is_unclear", "is_match")
        )
        odds = model(batch)
        choice = choice_loss(odds.candidate, right, unclear)
        pairs = pair_loss(odds, match, batch.pairs[..., 0] >= 0)
        none = torch.cat((~right.any(1, keepdim=True), right), 1)
        chosen = functional.pad(odds.candidate, (1, 0)).argmax(1, keepdim=True)
        is_right = none.gather(1, chosen).float().mean()
        return choice + self.config.pair_loss_weight * pairs, {"choice": choice, "pairs": pairs, "is_right": is_right}


def _stack(many: Sequence[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(many))
