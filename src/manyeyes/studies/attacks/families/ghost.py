# SPDX-License-Identifier: Apache-2.0
"""Invented objects: cars that do not exist, at places fixed in the world.

With a common group of the key, malicious agents corroborate each other's objects (collusion); with pseudonyms one agent does so
alone (Sybil). Cai et al., On Data Fabrication in Collaborative Vehicular Perception (USENIX Security 2024), call this spoofing.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch

from manyeyes.datatypes import Boxes, Message
from manyeyes.studies.attacks.interface import (
    AlterMessage,
    AttackInput,
    AttackKey,
    AttackOutput,
    FalseClaims,
    Knowledge,
    Placement,
)
from manyeyes.studies.attacks.message_edit import ObjectTemplate, find_template, insert_object
from manyeyes.studies.attacks.placement import choose_places


@dataclass(frozen=True)
class GhostAttack:
    """Insert false cars. period: they are sent in every period-th message. growth: instants after which one more of count is sent.

    growth 0 sends all at once. Blind places and growth are the blind-area confusion of GCP (arXiv 2501.02450).
    """

    count: int = 1
    placement: Placement = "seen"
    score: float = 0.9
    period: int = 1
    growth: int = 0
    num_pseudonyms: int = 0
    knowledge: Knowledge = "white-box"

    def begin(self, key: AttackKey) -> AlterMessage:
        """Return the attack of one malicious agent."""
        return _Ghosts(self, key)


@dataclass
class _Ghosts:
    """The false objects of one agent, world frame, chosen at the first instant with places, and the object that they copy."""

    attack: GhostAttack
    key: AttackKey
    boxes: Boxes | None = None
    template: ObjectTemplate | None = None
    num_draws: int = field(default=0)

    def __call__(self, given: AttackInput) -> AttackOutput:
        if self.template is None or (self.template.tokens is not None and not len(self.template.tokens)):
            self.template = find_template(given.message)
        if self.boxes is None or not len(self.boxes):
            self.boxes = choose_places(given, self.key, self.attack.placement, self.attack.count, self.num_draws)
            self.num_draws += 1
        if self.template is None or given.instant % self.attack.period:
            return AttackOutput(given.message)
        count = self.attack.count if not self.attack.growth else 1 + given.instant // self.attack.growth
        boxes = self.boxes[: min(count, self.attack.count)]
        return AttackOutput(insert_ghosts(given.message, self.template, boxes, self.attack.score), FalseClaims(boxes))


def insert_ghosts(message: Message, template: ObjectTemplate, boxes: Boxes, score: float) -> Message:
    """Return the message with false cars at boxes (N) in the world."""
    here = replace(boxes, score=torch.full_like(boxes.score, score)).transform(message.world_from_agent.inverse())
    here = replace(here, id=torch.full_like(here.id, -1))
    for row in range(len(here)):
        message = insert_object(message, template, here[row : row + 1])
    return message
