# SPDX-License-Identifier: Apache-2.0
"""Features changed without gradients: noise, scale, and values at the bounds that receivers accept. Proposals stay honest.

Boxes have no features: of a message without tokens the scores are changed alike, as logits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from manyeyes.datatypes import Message
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.ops.keyed_random import keyed_normal
from manyeyes.studies.attacks.interface import AlterMessage, AttackInput, AttackKey, AttackOutput, Knowledge

MAX_VALUE = 32.0
"""Magnitude beyond every bound of a receiver; senders clamp to the bound of their weights (``comms.token_format``)."""


@dataclass(frozen=True)
class FeatureNoiseAttack:
    """Replace features f by scale * f + sigmas * s * n with n standard normal, s the standard deviation of their channel.

    saturate: send values at the bounds instead, with random signs.
    """

    sigmas: float = 1.0
    scale: float = 1.0
    saturate: bool = False
    num_pseudonyms: int = 0
    knowledge: Knowledge = "black-box"

    def begin(self, key: AttackKey) -> AlterMessage:
        """Return the attack of one malicious agent."""
        return _Noise(self, key)


@dataclass(frozen=True)
class _Noise:
    attack: FeatureNoiseAttack
    key: AttackKey

    def __call__(self, given: AttackInput) -> AttackOutput:
        message = given.message
        if message.tokens is not None:
            rows = message.tokens.features
            features = self._change(rows[:, :-PROPOSAL_DIM], given)
            changed = message.tokens.with_features(torch.cat((features, rows[:, -PROPOSAL_DIM:]), 1))
            message = replace(message, tokens=changed)
        return AttackOutput(self._change_scores(message, given))

    def _change(self, values: Tensor, given: AttackInput) -> Tensor:
        """Return changed values (N, C)."""
        key = self.key
        place = "feature noise", key.scenario, given.message.agent_id, given.message.timestamp_ns
        noise = keyed_normal(tuple(values.shape), key.seed, *place).to(values.dtype)
        if self.attack.saturate:
            return MAX_VALUE * noise.sign()
        spread = values.std(0, unbiased=False) if len(values) else values.new_zeros(values.shape[1])
        return self.attack.scale * values + self.attack.sigmas * spread * noise

    def _change_scores(self, message: Message, given: AttackInput) -> Message:
        if message.objects is None or not len(message.objects):
            return message
        logits = torch.logit(message.objects.score.double(), eps=1e-4)[:, None]
        score = torch.sigmoid(self._change(logits, given)[:, 0]).to(message.objects.score.dtype)
        return replace(message, objects=replace(message.objects, score=score))
