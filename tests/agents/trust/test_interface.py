# SPDX-License-Identifier: Apache-2.0
"""Misbehaviour detectors in an agent: none changes nothing, the oracle is a world without the malicious senders."""

from __future__ import annotations

import pytest
import torch

from manyeyes import Agent
from manyeyes.agents.agent import Perception
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.agents.trust.detectors.oracle import OracleDetector
from manyeyes.agents.trust.interface import MisbehaviourDetector, SenderStatus
from manyeyes.agents.trust.registry import get_misbehaviour_detector, list_misbehaviour_detectors
from manyeyes.datatypes import ConfigError

SENDERS = (1, 2, 3)


def perceive(detector, drive, strategy: str, misbehaviour: MisbehaviourDetector | None, senders=SENDERS) -> Perception:
    """The last of three perceptions of agent 0."""
    agents = {i: Agent(detector, get_strategy(strategy), "float32") for i in senders}
    ego, found = Agent(detector, get_strategy(strategy), misbehaviour=misbehaviour), None
    for index in range(2, 5):
        frames = drive(4).frames(index)
        packets = [packet for i in senders for packet in agents[i].share(frames[i])]
        found = ego.perceive(frames[0], packets)
    assert found is not None
    return found


def same_boxes(one: Perception, other: Perception) -> bool:
    return torch.equal(one.boxes.bev(), other.boxes.bev()) and torch.equal(one.boxes.score, other.boxes.score)


@pytest.mark.parametrize("strategy", ["late", "intermediate-temporal"])
def test_none_changes_no_bit(detector, drive, strategy):
    plain = perceive(detector, drive, strategy, None)
    assessed = perceive(detector, drive, strategy, get_misbehaviour_detector("none"))
    assert same_boxes(plain, assessed) and plain.assessment is None and assessed.evidence is None
    assert assessed.assessment is not None
    assert assessed.assessment.weights == {1: 1.0, 2: 1.0, 3: 1.0} and assessed.rejected == plain.rejected


@pytest.mark.parametrize("strategy", ["late", "intermediate-temporal"])
def test_the_oracle_perceives_as_without_the_malicious_sender(detector, drive, strategy):
    without = perceive(detector, drive, strategy, None, (1, 3))
    assessed = perceive(detector, drive, strategy, OracleDetector(frozenset({2, 9})))
    assert same_boxes(without, assessed) and not same_boxes(without, perceive(detector, drive, strategy, None))
    assert [r.message.agent_id for r in assessed.received] == [1, 3]
    assert [(r.agent_id, r.reason) for r in assessed.rejected] == [(2, "untrusted")]
    assert assessed.assessment is not None
    assert [s.status for s in assessed.assessment.senders if s.agent_id == 2] == [SenderStatus.MALICIOUS]


def test_unknown_names_list_the_known_ones():
    assert {"none", "oracle"} <= set(list_misbehaviour_detectors())
    with pytest.raises(ConfigError, match="none, oracle"):
        get_misbehaviour_detector("no such")
