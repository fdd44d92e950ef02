# SPDX-License-Identifier: Apache-2.0
"""Framing of an honest sender: true content, chosen so that a defence turns against another agent (TrustFlip, arXiv 2605.22122).

The target is the honest sender whose objects differ most from the own ones. Real objects that it does not report are sent at full
confidence, and real objects that it alone reports are contradicted by silence and by an absence where the own tokens reach.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from manyeyes.datatypes import Message
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.studies.attacks.interface import (
    AlterMessage,
    AttackInput,
    AttackKey,
    AttackOutput,
    FalseClaims,
    Knowledge,
)
from manyeyes.studies.attacks.message_edit import list_objects, proposed_xy

SAME_OBJECT_M = 3.0
CERTAIN_SCORE, CERTAIN_LOGIT = 0.98, 4.0
ABSENT_SCORE, ABSENT_LOGIT = 0.05, -6.0


@dataclass(frozen=True)
class FramingAttack:
    """Turn the defence against an honest sender."""

    num_pseudonyms: int = 0
    knowledge: Knowledge = "black-box"

    def begin(self, key: AttackKey) -> AlterMessage:
        """Return the attack of one malicious agent."""
        return frame_sender


def frame_sender(given: AttackInput) -> AttackOutput:
    """Return true objects that the target lacks at full confidence, and its own ones contradicted."""
    target = choose_target(given)
    if target is None:
        return AttackOutput(given.message)
    message = given.message
    target_xy = _object_xy(target)
    inverse = message.world_from_agent.inverse()
    here = inverse.apply(torch.cat((target_xy, target_xy.new_zeros(len(target_xy), 1)), 1))[:, :2].float()
    if message.objects is not None:
        shared = _near(message.objects.center[:, :2].float(), here)
        score = torch.where(shared, ABSENT_SCORE, CERTAIN_SCORE).to(message.objects.score.dtype)
        kept = torch.where(message.objects.score >= 0.3, score, message.objects.score)
        message = replace(message, objects=replace(message.objects, score=kept))
    if message.tokens is not None:
        rows, column = message.tokens.features.clone(), BOX_LAYOUT.heatmap_logit.start - PROPOSAL_DIM
        shared, heat = _near(proposed_xy(message.tokens), here), rows[:, column]
        rows[:, column] = torch.where(shared, ABSENT_LOGIT, torch.where(heat > 0, CERTAIN_LOGIT, heat))
        message = replace(message, tokens=message.tokens.with_features(rows))
    return AttackOutput(message, FalseClaims())


def choose_target(given: AttackInput) -> Message | None:
    """Return the received message of the agent that reports most objects that the own message lacks; ties by agent id."""
    victim_xy = given.victim_pose.translation[:2]
    own = _object_xy(given.message)
    best: tuple[int, int] | None = None
    chosen = None
    for message in given.received:
        if float((message.world_from_agent.translation[:2] - victim_xy).norm()) < 1.0:
            continue  # The ego itself.
        lacking = int((~_near(_object_xy(message), own)).sum())
        if best is None or (lacking, -message.agent_id) > best:
            best, chosen = (lacking, -message.agent_id), message
    return chosen


def _object_xy(message: Message) -> Tensor:
    """Return (M, 2) world positions of the objects of a message."""
    xy = list_objects(message).center[:, :2].double()
    return message.world_from_agent.apply(torch.cat((xy, xy.new_zeros(len(xy), 1)), 1))[:, :2]


def _near(points: Tensor, xy: Tensor) -> Tensor:
    if not len(points) or not len(xy):
        return torch.zeros(len(points), dtype=torch.bool)
    return (torch.cdist(points.double(), xy.double()) < SAME_OBJECT_M).any(1)
