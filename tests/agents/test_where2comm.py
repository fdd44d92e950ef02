# SPDX-License-Identifier: Apache-2.0
"""Where2comm's selection: order, requests of confident and of empty receivers, and prefixes of budgets."""

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.agents.strategies.where2comm import MIN_SCORE, smoothed_confidence, weigh_by_demand
from manyeyes.datatypes import Message
from manyeyes.datatypes.message import RequestMap

NOW = 5


@pytest.fixture
def sender(drive, detector):
    """A cache, a frame, its tokens and their scores."""
    frame, cache = drive(2).frame(1, NOW), PerceptionCache(detector)
    frame = cache.level(frame).levelled
    return cache, frame, cache.process_tokens(frame).shared_tokens, smoothed_confidence(cache, frame)


def request(sender, confidence: float) -> Message:
    """The message of a receiver at the sender's place that is as confident everywhere."""
    cache, frame, *_ = sender
    windows = cache.detector.grid.at(32)
    wide = RequestMap(windows, torch.full(windows.shape, confidence))
    return Message(9, frame.timestamp_ns, frame.world_from_agent, frame.pose_covariance, bytes(8), request=wide)


def test_no_sender_and_an_empty_street_leave_the_order_of_confidence(sender) -> None:
    score = sender[3]
    kept = score > MIN_SCORE
    for requests in ((), (request(sender, 0.0),)):
        weighed = weigh_by_demand(*sender, requests)
        assert torch.equal(weighed[kept], score[kept]) and bool((weighed[~kept] == -torch.inf).all())


def test_a_receiver_that_is_confident_everywhere_is_sent_nothing(sender) -> None:
    assert bool((weigh_by_demand(*sender, (request(sender, 1.0),)) == -torch.inf).all())
    # Of two receivers the one counts that requests more.
    both = weigh_by_demand(*sender, (request(sender, 1.0), request(sender, 0.5)))
    assert torch.equal(both, weigh_by_demand(*sender, (request(sender, 0.5),)))
    assert bool((both > -torch.inf).any())


def test_confidence_is_smoothed_over_occupied_cells(sender) -> None:
    cache, _, tokens, score = sender
    raw = torch.sigmoid(tokens.features[:, cache.detector.encoder.out_channels])
    line = torch.exp(-0.5 * torch.arange(-2.0, 3.0) ** 2)
    weight = (line[:, None] * line)[None, None] / line.sum() ** 2
    dense = torch.nn.functional.conv2d(tokens.with_features(raw[:, None]).dense(), weight, padding=2)[0, 0]
    y, x = tokens.sites.yx.unbind(1)
    assert torch.allclose(score, dense[y, x], atol=1e-6)


def test_messages_carry_a_request_map_and_smaller_budgets_keep_a_prefix(drive, detector) -> None:
    frame, sizes, kept = drive(2).frame(1, NOW), [], []
    for budget in (None, 4000, 1500):
        agent = Agent(detector, get_strategy("intermediate-where2comm"), "float16", budget)
        packets, inbox = agent.share(frame), agent.inbox()
        for packet in packets:
            inbox.push(packet)
        (message,) = inbox.messages()
        assert message.request is not None
        sizes.append(sum(map(len, packets)))
        kept.append(set(message.tokens.sites.key.tolist()))
    assert sizes[0] > sizes[1] > sizes[2] and sizes[1] <= 4000 and sizes[2] <= 1500
    assert kept[2] < kept[1] < kept[0]
