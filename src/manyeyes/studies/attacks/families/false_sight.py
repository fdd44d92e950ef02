# SPDX-License-Identifier: Apache-2.0
"""False sights: free space stated where a real object stands, so that a defence refutes the honest sender that claims it.

The targets are objects that honest senders claim and the ego does not detect. In all other directions the sight stays the true one,
and it never states an object of the ego to be free, since a receiver would then not use it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import Message, Transform
from manyeyes.datatypes.sight import NUM_SECTORS, STEP_M, Sight
from manyeyes.ops.lidar.free_range import find_free
from manyeyes.studies.attacks.interface import AlterMessage, AttackInput, AttackKey, AttackOutput, Knowledge
from manyeyes.studies.attacks.message_edit import list_objects

SAME_OBJECT_M = 3.0
MAX_STEPS = 255


@dataclass(frozen=True)
class FalseSightAttack:
    """Extend the own sight beyond the targets. margin_m: around their footprints, as large as the defence tests at most."""

    margin_m: float = 2.5
    num_pseudonyms: int = 0
    knowledge: Knowledge = "white-box"

    def begin(self, key: AttackKey) -> AlterMessage:
        """Return the attack of one malicious agent."""
        return self.state_free

    def state_free(self, given: AttackInput) -> AttackOutput:
        """Return the message with a false sight; the honest message where no sights are sent."""
        message, victim = given.message, given.victim
        if message.sight is None or victim is None:
            return AttackOutput(message)
        pose = message.world_from_agent
        own = _columns(victim.own, pose)
        sight = message.sight
        for other in victim.messages:
            if other.agent_id != message.agent_id:
                for target in _columns(other, pose):
                    if not len(own) or np.hypot(*(own[:, :2] - target[:2]).T).min() >= SAME_OBJECT_M:
                        extended = extend_sight(sight, target, self.margin_m)
                        sight = sight if find_free(extended, own, np.zeros(len(own))).any() else extended
        return AttackOutput(replace(message, sight=sight))


def extend_sight(sight: Sight, box: NDArray[np.float64], margin_m: float) -> Sight:
    """Return a sight that reaches beyond the enlarged footprint of a box (7) of its frame: centre, size and yaw."""
    x, y, yaw = box[0], box[1], box[6]
    along, across = np.meshgrid([-1.0, 1.0], [-1.0, 1.0])
    along, across = along.ravel() * (box[3] / 2 + margin_m), across.ravel() * (box[4] / 2 + margin_m)
    corner_x = x + along * np.cos(yaw) - across * np.sin(yaw)
    corner_y = y + along * np.sin(yaw) + across * np.cos(yaw)
    middle = np.arctan2(y, x)
    offset = (np.arctan2(corner_y, corner_x) - middle + np.pi) % (2 * np.pi) - np.pi
    first, last = np.floor((middle + np.array([offset.min(), offset.max()])) / (2 * np.pi) * NUM_SECTORS).astype(int)
    reach = min(int(np.ceil(np.hypot(corner_x, corner_y).max() / STEP_M)), MAX_STEPS)
    steps = sight.steps.copy()
    sectors = np.arange(first, last + 1) % NUM_SECTORS
    steps[sectors] = np.maximum(steps[sectors], reach)
    return Sight(steps)


def _columns(message: Message, world_from_here: Transform) -> NDArray[np.float64]:
    """Return the objects of a message (N, 7), centre, size and yaw, in the frame of a pose."""
    boxes = list_objects(message).to(torch.float64)
    boxes = boxes.transform(message.world_from_agent).transform(world_from_here.inverse())
    return torch.cat((boxes.center, boxes.size, boxes.yaw[:, None]), 1).numpy()
