# SPDX-License-Identifier: Apache-2.0
"""Displacement: one object of the message, or the stated pose of the sender and with it all that it reports.

Small displacements of real objects: scenario attacks (arXiv 2605.01301). The direction of a displacement is drawn once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from manyeyes.datatypes import Transform
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.studies.attacks.families.removal import find_target
from manyeyes.studies.attacks.interface import (
    AlterMessage,
    AttackInput,
    AttackKey,
    AttackOutput,
    AttackSettings,
    FalseClaims,
)
from manyeyes.studies.attacks.message_edit import insert_object, remove_objects, template_at


@dataclass(frozen=True)
class ObjectShiftAttack(AttackSettings):
    """Report the object nearest to the victim displaced by distance_m, and turned by yaw_deg."""

    distance_m: float = 2.0
    yaw_deg: float = 0.0

    def begin(self, key: AttackKey) -> AlterMessage:
        """Return the attack of one malicious agent."""
        return _ObjectShift(self, _draw_direction(key))


@dataclass
class _ObjectShift:
    attack: ObjectShiftAttack
    direction: Tensor
    target: Tensor | None = None

    def __call__(self, given: AttackInput) -> AttackOutput:
        message = given.message
        box = find_target(given, self.target)
        if box is None:
            return AttackOutput(message)
        world = box.to(torch.float64).transform(message.world_from_agent)
        self.target = world.center[0, :2]
        shift = torch.cat((self.attack.distance_m * self.direction, torch.zeros(1, dtype=torch.float64)))
        yaw = world.yaw + math.radians(self.attack.yaw_deg)
        moved = replace(world, center=world.center + shift, yaw=yaw, id=torch.zeros_like(world.id))
        here = moved.transform(message.world_from_agent.inverse()).to(box.center.dtype)
        sent = insert_object(remove_objects(message, box.center[:, :2]), template_at(message, box), here)
        return AttackOutput(sent, FalseClaims(invented=moved, hidden=world))


@dataclass(frozen=True)
class PoseShiftAttack(AttackSettings):
    """State a pose displaced by distance_m and turned by yaw_deg, or one that drifts by drift_mps from the true one."""

    distance_m: float = 0.0
    yaw_deg: float = 0.0
    drift_mps: float = 0.0

    def begin(self, key: AttackKey) -> AlterMessage:
        """Return the attack of one malicious agent."""
        return _PoseShift(self, _draw_direction(key))


@dataclass
class _PoseShift:
    attack: PoseShiftAttack
    direction: Tensor
    began_s: float | None = None

    def __call__(self, given: AttackInput) -> AttackOutput:
        if self.began_s is None:
            self.began_s = given.seconds
        distance = self.attack.distance_m + self.attack.drift_mps * (given.seconds - self.began_s)
        pose = given.message.world_from_agent
        translation = pose.translation + torch.cat((distance * self.direction, torch.zeros(1, dtype=torch.float64)))
        turn = Transform.from_xyz_yaw(0, 0, 0, math.radians(self.attack.yaw_deg)).double()
        stated = Transform(turn.rotation @ pose.rotation, translation)
        return AttackOutput(replace(given.message, world_from_agent=stated))


def _draw_direction(key: AttackKey) -> Tensor:
    """Return a unit vector (2)."""
    angle = 2 * math.pi * float(keyed_uniform((1,), key.seed, "displacement", key.scenario, key.group)[0])
    return torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
