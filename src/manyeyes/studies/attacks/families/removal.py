# SPDX-License-Identifier: Apache-2.0
"""Removal of a real object: the object of the malicious agent that is nearest to the victim is not reported, or contradicted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from manyeyes.datatypes import Boxes, Message
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat
from manyeyes.studies.attacks.interface import (
    AlterMessage,
    AttackInput,
    AttackKey,
    AttackOutput,
    FalseClaims,
    Knowledge,
)
from manyeyes.studies.attacks.message_edit import (
    OBJECT_RADIUS_M,
    insert_object,
    list_objects,
    proposed_xy,
    remove_objects,
    template_at,
)

RemovalMode = Literal["silent", "twin", "features"]
TWIN_OFFSET_M, TWIN_SCORE = 0.8, 0.1
ABSENT_LOGIT = -8.0
MIN_TARGET_M, MAX_STEP_M = 3.0, 4.0
"""The target is at least so far from the victim, which is an object itself; and it moves by at most so much between messages."""


@dataclass(frozen=True)
class RemovalAttack:
    """Suppress one object.

    mode: silent omits it; twin reports it displaced, at a low score; features sends tokens of empty ground in its place, whose
    proposals state that nothing is there.
    """

    mode: RemovalMode = "silent"
    num_pseudonyms: int = 0
    knowledge: Knowledge = "black-box"

    def begin(self, key: AttackKey) -> AlterMessage:
        """Return the attack of one malicious agent."""
        return _Removal(self.mode)


@dataclass
class _Removal:
    mode: RemovalMode
    target: Tensor | None = None

    def __call__(self, given: AttackInput) -> AttackOutput:
        box = find_target(given, self.target)
        if box is None:
            return AttackOutput(given.message)
        world = _to_world(given.message, box)
        self.target = world.center[0, :2]
        return AttackOutput(_suppress(given.message, box, self.mode), FalseClaims(hidden=world))


def find_target(given: AttackInput, last_xy: Tensor | None) -> Boxes | None:
    """Return the object (1) of the message nearest to the last place of the target, or to the victim at first; None without any."""
    boxes = list_objects(given.message)
    world = _to_world(given.message, boxes)
    victim_m = (world.center[:, :2] - given.victim_pose.translation[:2]).norm(dim=1)
    distance = victim_m if last_xy is None else (world.center[:, :2] - last_xy).norm(dim=1)
    allowed = (victim_m >= MIN_TARGET_M) & (distance <= (torch.inf if last_xy is None else MAX_STEP_M))
    if not bool(allowed.any()):
        return None
    row = int(torch.where(allowed, distance, torch.inf).argmin())
    return boxes[row : row + 1]


def _suppress(message: Message, box: Boxes, mode: RemovalMode) -> Message:
    place = box.center[:, :2].float()
    if mode == "silent":
        return remove_objects(message, place)
    if mode == "twin":
        twin = replace(box, center=box.center + box.center.new_tensor([TWIN_OFFSET_M, 0, 0]))
        twin = replace(twin, score=torch.full_like(box.score, TWIN_SCORE))
        return insert_object(remove_objects(message, place), template_at(message, box), twin)
    if message.tokens is None:
        return remove_objects(message, place)
    rows = message.tokens.features.clone()
    near = torch.cdist(proposed_xy(message.tokens), place)[:, 0] < OBJECT_RADIUS_M
    emptiest = proposed_heat(rows[:, -PROPOSAL_DIM:]).argmin()
    rows[near] = rows[emptiest].clone()
    rows[near, len(rows[0]) - PROPOSAL_DIM + BOX_LAYOUT.heatmap_logit.start] = ABSENT_LOGIT
    return replace(message, tokens=message.tokens.with_features(rows))


def _to_world(message: Message, boxes: Boxes) -> Boxes:
    return boxes.to(torch.float64).transform(message.world_from_agent)
