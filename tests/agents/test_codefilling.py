# SPDX-License-Identifier: Apache-2.0
"""CodeFilling's demand by hand: two equal senders, a third that is more confident, and the ends of the demand."""

import math

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.codefilling import (
    MIN_CONFIDENCE,
    KnownConfidence,
    select_by_filling,
    weigh_by_filling,
)
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.datatypes import Message
from manyeyes.datatypes.message import RequestMap


def known(agent_id: int, confidence: float, is_inside: bool = True) -> KnownConfidence:
    return KnownConfidence(agent_id, torch.tensor([confidence]), torch.tensor([is_inside]))


def sends(own: KnownConfidence, *others: KnownConfidence, demand: float = 1.0) -> bool:
    return bool(select_by_filling(own, others, demand)[0])


RECEIVER = known(0, 0.0)


@pytest.mark.parametrize("demand", [0.7, 1.0, 1.19])
def test_of_two_equal_senders_the_one_of_lower_id_sends(demand: float) -> None:
    """Each has 0.6: a demand between one and two of them. The other sender, as a receiver, has 0.6 itself."""
    first, second = known(1, 0.6), known(2, 0.6)
    assert sends(first, RECEIVER, second, demand=demand)
    assert not sends(second, RECEIVER, first, demand=demand)
    assert sends(second, RECEIVER, first, demand=1.21)


def test_a_more_confident_third_agent_silences_both() -> None:
    first, second, third = known(1, 0.6), known(2, 0.6), known(3, 0.8)
    assert sends(third, RECEIVER, first, second)
    assert not sends(first, RECEIVER, second, third) and not sends(second, RECEIVER, first, third)


def test_the_ends_of_the_demand() -> None:
    own, others = known(1, 0.6), (RECEIVER, known(2, 0.9))
    assert sends(own, *others, demand=math.inf)
    assert not sends(own, *others, demand=0.0)


def test_a_receiver_needs_nothing_off_its_map_and_nothing_that_it_sees_itself() -> None:
    own = known(1, 0.6)
    assert not sends(own, known(0, 0.0, is_inside=False))
    assert not sends(own, known(0, 0.5)) and sends(own, known(0, 0.3))
    # A sender does not fill where its map ends.
    assert sends(own, RECEIVER, known(2, 0.9, is_inside=False))
    assert not sends(own, RECEIVER, known(2, 0.9))


def test_requests_of_messages_decide_which_tokens_are_sent(drive, detector) -> None:
    """Receivers of 0 need all, those of 1 nothing; a sender of confidence 1 fills the demand of the first."""
    cache, frame = PerceptionCache(detector), drive(2).frame(1, 5)
    frame = cache.level(frame).levelled
    tokens = cache.process_tokens(frame).shared_tokens
    score = torch.linspace(0, 1, len(tokens.sites))

    def message(agent_id: int, confidence: float) -> Message:
        windows = detector.grid.at(32)
        wide = RequestMap(windows, torch.full(windows.shape, confidence))
        return Message(agent_id, frame.timestamp_ns, frame.world_from_agent, frame.pose_covariance, request=wide)

    everything = torch.where(score > MIN_CONFIDENCE, score, -torch.inf)
    for requests, wanted in (
        ((), everything),
        ((message(0, 0.0),), everything),
        ((message(0, 1.0),), torch.full_like(score, -torch.inf)),
        ((message(0, 0.0), message(2, 1.0)), torch.full_like(score, -torch.inf)),
    ):
        assert torch.equal(weigh_by_filling(cache, frame, tokens, score, requests), wanted)
    agent = Agent(detector, get_strategy("intermediate-codefilling"), "float16")
    inbox = agent.inbox()
    for packet in agent.share(frame):
        inbox.push(packet)
    assert inbox.messages()[0].request is not None
