# SPDX-License-Identifier: Apache-2.0
"""Perturbation of sent features along the gradient of the fused scores: BIM and PGD, within the quantisation of the wire.

BIM: Kurakin et al., ICLR Workshop 2017; PGD, with a random start: Madry et al., ICLR 2018. Features alone are changed, in a box of
epsilon standard deviations of their channel around the honest ones; proposals stay honest. Quantisation passes the gradient
straight through (Bengio et al., 2013), so the loss is that of what receivers decode. Through the defence: the attacker's
proposals carry the weight that the defence gives it, and scores are raised only where a proposal is near, since others are capped
as orphans.

The white box uses the victim's view. The transfer attack knows the weights alone: it attacks its own view of the scene, with the
messages that it received before, and sends the result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from manyeyes.datatypes import Message
from manyeyes.models.detector.box_head import BOX_LAYOUT, RawBoxes
from manyeyes.models.detector.codebook import Codebook
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat
from manyeyes.models.detector.protocols import TokenDetector, has_tokens
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.studies.attacks.interface import (
    AlterMessage,
    AttackInput,
    AttackKey,
    AttackOutput,
    GatherTokens,
    Knowledge,
)
from manyeyes.studies.attacks.message_edit import with_features

Goal = Literal["lower", "raise"]
TARGET_SCORE = 0.2
"""Cells of at least this fused score without the attack hold objects; scores of the others are raised."""
NUM_RAISED = 10
ORPHAN_RADIUS_M = 2.5
MIN_PROPOSAL_SCORE = 0.05
MIN_LOG_WEIGHT = -4.0
STEP_FACTOR = 2.5
"""Length of all steps together, in units of epsilon."""


@dataclass(frozen=True)
class GradientAttack:
    """num_steps of epsilon_sigmas * STEP_FACTOR / num_steps along the sign of the gradient.

    goal: lower the scores of objects, or raise those elsewhere. random_start: PGD, else BIM. through_defence: as in the text above.
    """

    num_steps: int = 10
    epsilon_sigmas: float = 0.5
    goal: Goal = "lower"
    random_start: bool = True
    through_defence: bool = True
    num_pseudonyms: int = 0
    knowledge: Knowledge = "white-box"

    def begin(self, key: AttackKey) -> AlterMessage:
        """Return the attack of one malicious agent."""
        return _Gradient(self, key)


@dataclass(frozen=True)
class _Gradient:
    attack: GradientAttack
    key: AttackKey

    def __call__(self, given: AttackInput) -> AttackOutput:
        message, detector = given.message, given.detector
        if message.tokens is None or not len(message.tokens.sites) or detector is None or not has_tokens(detector):
            return AttackOutput(message)
        victim = given.victim
        gather = given.gather if victim is None else victim.gather
        if gather is None:
            return AttackOutput(message)
        others = given.received if victim is None else victim.messages
        log_weight = victim.log_weight if victim is not None and self.attack.through_defence else 0.0
        view = FusedView(detector, gather, others, message, max(log_weight, MIN_LOG_WEIGHT))
        start = keyed_uniform(
            tuple(message.tokens.features[:, :-PROPOSAL_DIM].shape),
            self.key.seed, "gradient start", self.key.scenario, message.agent_id, message.timestamp_ns,
        )  # fmt: skip
        return AttackOutput(with_features(message, perturb(view, self.attack, 2 * start.float() - 1)))


@dataclass(frozen=True, eq=False)
class FusedView:
    """One ego's fusion as a function of the features of one message.

    others: messages that are fused too. message: of the attacker. log_weight: of the attacker's content.
    """

    detector: TokenDetector
    gather: GatherTokens
    others: tuple[Message, ...]
    message: Message
    log_weight: float = 0.0

    def fuse(self, features: Tensor) -> RawBoxes:
        """Return the fused boxes for features (N, C) of the attacker, as receivers decode them."""
        tokens = self.message.tokens
        assert tokens is not None
        rows = torch.cat((features, tokens.features[:, -PROPOSAL_DIM:]), 1)
        rows = quantise_straight_through(rows, self.detector.codebook)
        if self.log_weight:
            offset = rows.new_zeros(rows.shape[1])
            offset[rows.shape[1] - PROPOSAL_DIM + BOX_LAYOUT.heatmap_logit.start] = self.log_weight
            rows = rows + offset
        return self.detector.fuse(self.gather([*self.others, with_features(self.message, rows)]))[1]

    def has_proposal(self, xy: Tensor) -> Tensor:
        """Return (U,) bool: which places (U, 2) in the ego's frame have a proposal near, of any agent."""
        with torch.no_grad():
            tokens = self.gather([*self.others, self.message])
        likely = torch.sigmoid(proposed_heat(tokens.proposal)) >= MIN_PROPOSAL_SCORE
        near = tokens.xy[likely]
        if not len(near):
            return torch.zeros(len(xy), dtype=torch.bool)
        return (torch.cdist(xy.float(), near.float()) < ORPHAN_RADIUS_M).any(1)


def log_scores(raw: RawBoxes, iou_score_weight: float) -> Tensor:
    """Return the logarithm of the decoded score (U,), differentiable."""
    heat, overlap = (torch.nn.functional.logsigmoid(v) for v in (raw.heatmap_logit, raw.iou_logit))
    return (1 - iou_score_weight) * heat + iou_score_weight * overlap


def make_loss(view: FusedView, attack: GradientAttack) -> Callable[[RawBoxes], Tensor]:
    """Return the loss that the attack lowers: summed scores of objects, or minus the mean of the highest log-scores elsewhere."""
    tokens, weight = view.message.tokens, view.detector.decode_config.iou_score_weight
    assert tokens is not None
    with torch.no_grad():
        clean = view.fuse(tokens.features[:, :-PROPOSAL_DIM])
    is_object = log_scores(clean, weight).exp() >= TARGET_SCORE
    if attack.goal == "lower":
        return lambda raw: log_scores(raw, weight)[is_object].exp().sum()
    allowed = ~is_object
    if attack.through_defence:
        allowed &= view.has_proposal(clean.sites.xy)

    def raised(raw: RawBoxes) -> Tensor:
        scores = log_scores(raw, weight)[allowed]
        return -scores.topk(min(NUM_RAISED, len(scores))).values.mean() if len(scores) else raw.heatmap_logit.sum() * 0

    return raised


def perturb(view: FusedView, attack: GradientAttack, start: Tensor) -> Tensor:
    """Return the rows (N, C + PROPOSAL_DIM) of least loss among all steps, the honest ones included; start (N, C) in [-1, 1]."""
    tokens = view.message.tokens
    assert tokens is not None
    honest, proposal = tokens.features[:, :-PROPOSAL_DIM], tokens.features[:, -PROPOSAL_DIM:]
    radius = attack.epsilon_sigmas * honest.std(0, unbiased=False)
    loss_of, step = make_loss(view, attack), radius * STEP_FACTOR / attack.num_steps
    delta = start * radius if attack.random_start else torch.zeros_like(honest)
    with torch.no_grad():
        best, lowest = honest, float(loss_of(view.fuse(honest)))
    for _ in range(attack.num_steps):
        features = (honest + delta).detach().requires_grad_()
        with torch.enable_grad():
            loss = loss_of(view.fuse(features))
            (gradient,) = torch.autograd.grad(loss, features, allow_unused=True, materialize_grads=True)
        value = float(loss.detach())
        if value < lowest:
            best, lowest = features.detach(), value
        delta = (delta - step * gradient.sign()).clamp(-radius, radius)
    with torch.no_grad():
        if float(loss_of(view.fuse(honest + delta))) < lowest:
            best = honest + delta
    return torch.cat((best, proposal), 1)


def quantise_straight_through(rows: Tensor, codebook: Codebook | None) -> Tensor:
    """Return rows (N, C + PROPOSAL_DIM) as receivers decode them, with the gradient of the identity."""
    with torch.no_grad():
        decoded = rows.half().to(rows.dtype) if codebook is None else codebook.decode(codebook.encode(rows))
    return rows + (decoded.to(rows.dtype) - rows).detach()
