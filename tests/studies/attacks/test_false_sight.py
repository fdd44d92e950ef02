# SPDX-License-Identifier: Apache-2.0
"""A sender whose sight states the place of a real car to be free, on the crossing of ``tests.agents.trust.test_observers``.

Agent 1 alone claims a car that a wall hides from the ego; agents 2 to 5 have sights that end before it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.agents.trust.street import SEEN, cars, sender
from tests.agents.trust.test_observers import (
    CAR_THERE,
    DISPUTED,
    EAST,
    GHOST,
    NORTH,
    REFUTED,
    SEEN_TOO,
    SOUTH,
    TWO_COLLUDE,
    UNCHECKED,
    Crossing,
    Sender,
    after_trust,
    ghost_kind,
    honest,
    kinds,
    sees,
)
from tests.studies.attacks.cases import KEY, make_input

from manyeyes.agents.trust.interface import Evidence, SenderStatus
from manyeyes.datatypes import AgentFrame, Boxes, Message, PointCloud, Transform
from manyeyes.ops.lidar.free_range import find_free
from manyeyes.studies.attacks.families.false_sight import FalseSightAttack
from manyeyes.studies.attacks.interface import AttackInput, Victim

SENDERS = {
    1: TWO_COLLUDE[1],
    2: sees(2, NORTH, CAR_THERE),
    3: sees(3, EAST, CAR_THERE),
    4: sees(4, SOUTH, CAR_THERE),
    5: sees(5, (60.0, -20.0), CAR_THERE),
}
EGO_OBJECTS = cars(SEEN, SEEN_TOO)


def message_of(agent_id: int, one: Sender) -> Message:
    pose = Transform.from_xyz_yaw(*one.at, 0.0, one.yaw).double()
    return Message(
        agent_id, 0, pose, torch.zeros(3, 3).double(), objects=one.boxes.transform(pose.inverse()), sight=one.sight
    )


def attack_of(agent_id: int, own: Boxes = EGO_OBJECTS) -> Sender:
    """The sender with the sight of the attack, which knows all messages of the instant."""
    messages = {k: message_of(k, one) for k, one in SENDERS.items()}
    ego = AgentFrame.of(PointCloud.of(torch.zeros(0, 3)), Transform.identity(), 0, 0)
    mine, of_ego = messages.pop(agent_id), message_of(0, Sender(own, (0.0, 0.0)))
    victim = Victim(ego, of_ego, tuple(messages.values()), lambda messages: None)  # type: ignore[arg-type,return-value]
    given = AttackInput(replace(ego, agent_id=agent_id), mine, (), Transform.identity(), 0, victim=victim)
    sent = FalseSightAttack().begin(KEY)(given).message
    assert sent is not None and sent.objects is mine.objects and sent.world_from_agent is mine.world_from_agent
    return replace(SENDERS[agent_id], sight=sent.sight)


def steps_of(one: Sender) -> np.ndarray:
    assert one.sight is not None
    return one.sight.steps


def states_free(one: Sender, place: tuple[float, float], margin_m: float) -> bool:
    box = np.array([[place[0] - one.at[0], place[1] - one.at[1], 0.8, 4.5, 1.9, 1.6, 0.0]])
    assert one.sight is not None
    return bool(find_free(one.sight, box, np.array([margin_m]))[0])


@pytest.mark.parametrize("agent_id", [2, 3, 4, 5])
def test_it_states_the_target_to_be_free_and_no_object_of_the_ego(agent_id):
    false = attack_of(agent_id)
    assert states_free(false, GHOST, 2.5) and not states_free(SENDERS[agent_id], GHOST, 0.0)
    assert not any(states_free(false, place, 0.0) for place in (SEEN, SEEN_TOO))


def test_it_changes_the_sectors_of_the_target_alone():
    changed = steps_of(attack_of(3)) != steps_of(SENDERS[3])
    assert 0 < changed.sum() <= 20 and (steps_of(attack_of(3)) >= steps_of(SENDERS[3])).all()


def test_without_a_target_or_without_sights_the_message_is_the_honest_one():
    detected = attack_of(3, cars(SEEN, SEEN_TOO, GHOST))
    assert np.array_equal(steps_of(detected), steps_of(SENDERS[3])), "the ego detects the only other object"
    given = make_input()
    assert FalseSightAttack().begin(KEY)(given).message is given.message


@pytest.mark.parametrize("agent_id", [2, 3, 4, 5])
def test_a_single_sender_removes_no_object_and_changes_no_trust_of_others(agent_id):
    attacked = {**SENDERS, agent_id: attack_of(agent_id)}
    found, wanted = (after_trust(SENDERS, has_car=True).run(20, senders) for senders in (attacked, SENDERS))
    assert kinds(found, 1) == [Evidence.SUPPORTED, Evidence.SUPPORTED, UNCHECKED]
    for one in (2, 3, 4, 5):
        assert kinds(found, one) == [Evidence.SUPPORTED] * 2
    assert [(s.agent_id, s.trust, s.weight, s.status) for s in found.senders] == [
        (s.agent_id, s.trust, s.weight, s.status) for s in wanted.senders
    ]


def test_two_colluding_senders_remove_what_the_ego_cannot_see_and_accuse_no_sender():
    attacked = {**SENDERS, 2: attack_of(2), 3: attack_of(3)}
    found = after_trust(SENDERS, has_car=True).run(20, attacked)
    assert ghost_kind(found) == REFUTED
    assert all(s.status is SenderStatus.NORMAL and s.trust > 0.8 and s.weight == 1.0 for s in found.senders)


def test_two_colluding_senders_remove_nothing_that_the_ego_or_a_third_sender_detects():
    attacked = {**SENDERS, 2: attack_of(2), 3: attack_of(3)}
    crossing: Crossing = after_trust(SENDERS, has_car=True)
    crossing.own = cars(SEEN, SEEN_TOO, GHOST)
    found = crossing.run(20, attacked)
    assert ghost_kind(found) == Evidence.SUPPORTED
    seconded = {**attacked, 4: replace(SENDERS[4], boxes=honest(4, (GHOST[0] + 0.2, GHOST[1] - 0.2)))}
    found = after_trust(SENDERS, has_car=True).run(20, seconded)
    assert ghost_kind(found) == ghost_kind(found, 4) == DISPUTED
    assert sender(found, 1).trust > 0.8 and sender(found, 4).trust > 0.8
