# SPDX-License-Identifier: Apache-2.0
"""Flooding within the budget and the bounds of receivers: as many confident false objects as a message holds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from manyeyes.datatypes import Boxes
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.studies.attacks.interface import (
    AlterMessage,
    AttackInput,
    AttackKey,
    AttackOutput,
    AttackSettings,
    FalseClaims,
)
from manyeyes.studies.attacks.message_edit import CAR_SIZE, find_template, insert_object

RANGE_M = 60.0
MIN_RADIUS_M = 6.0


@dataclass(frozen=True)
class FloodAttack(AttackSettings):
    """Send num_objects false cars around the victim, in new places in every message."""

    num_objects: int = 64
    score: float = 0.99

    def begin(self, key: AttackKey) -> AlterMessage:
        """Return the attack of one malicious agent."""
        return _Flood(self, key)


@dataclass(frozen=True)
class _Flood:
    attack: FloodAttack
    key: AttackKey

    def __call__(self, given: AttackInput) -> AttackOutput:
        message, count = given.message, self.attack.num_objects
        place = "flood", self.key.scenario, self.key.group, message.timestamp_ns
        unit = keyed_uniform((count, 3), self.key.seed, *place)
        radius = MIN_RADIUS_M + (RANGE_M - MIN_RADIUS_M) * unit[:, 0]
        angle = 2 * math.pi * unit[:, 1]
        center = torch.stack((radius * angle.cos(), radius * angle.sin(), torch.full_like(radius, CAR_SIZE[2] / 2)), 1)
        size = torch.tensor(CAR_SIZE, dtype=torch.float64).expand(count, 3)
        boxes = Boxes.of(center, size, 2 * math.pi * unit[:, 2], score=torch.full_like(radius, self.attack.score))
        world = boxes.transform(given.victim_pose)
        here = world.transform(message.world_from_agent.inverse())
        template = find_template(message)
        if template is not None:
            for row in range(count):
                message = insert_object(message, template, here[row : row + 1])
        return AttackOutput(message, FalseClaims(replace(world, id=torch.arange(count))))
