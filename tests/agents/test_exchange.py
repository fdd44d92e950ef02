# SPDX-License-Identifier: Apache-2.0
"""The exchange of a replay: who receives what, and when."""

import torch

from manyeyes.agents.exchange import Exchange
from manyeyes.comms.channel import channel_preset
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.wire import encode
from manyeyes.datatypes import AgentFrame, Message, PointCloud, Transform

PERIOD_NS = 100_000_000


def frame(agent_id: int, instant: int = 0) -> AgentFrame:
    return AgentFrame.of(PointCloud.of(torch.zeros(0, 3)), Transform.identity(), agent_id, instant * PERIOD_NS)


def packets(agent_id: int, instant: int = 0) -> list[bytes]:
    return encode(Message(agent_id, instant * PERIOD_NS, Transform.identity(), torch.eye(3)))


def senders(inbox: Inbox) -> list[int]:
    return [message.agent_id for message in inbox.messages()]


def test_every_agent_receives_the_others_of_its_instant_in_range() -> None:
    exchange = Exchange(channel_preset("ideal"), 0, lambda _: Inbox(), comm_range_m=50.0)
    frames, positions = [frame(1), frame(2), frame(3)], {1: (0.0, 0.0), 2: (40.0, 0.0), 3: (80.0, 0.0)}
    exchanged = exchange.run(frames, [packets(1), packets(2), packets(3)], [0, 0, 0], positions)
    assert [(f.agent_id, senders(inbox), deadline) for f, inbox, deadline in exchanged] == [
        (1, [2], 0),
        (2, [1, 3], 0),
        (3, [2], 0),
    ]


def test_a_late_packet_arrives_by_a_later_deadline_and_the_inbox_is_kept() -> None:
    made = []
    exchange = Exchange(channel_preset("cellular"), 0, lambda receiver_id: made.append(receiver_id) or Inbox())
    positions = {1: (0.0, 0.0), 9: (500.0, 0.0)}
    exchange.send(frame(1), packets(1), positions)
    assert senders(exchange.receive(9, 0, positions)) == []
    assert senders(exchange.receive(9, 5 * PERIOD_NS, positions)) == [1]
    assert senders(exchange.inbox(9)) == [1] and made == [9]


def test_a_sender_without_a_position_is_in_range() -> None:
    exchange = Exchange(channel_preset("ideal"), 0, lambda _: Inbox(), comm_range_m=1.0)
    exchange.send(frame(1), packets(1), {1: (30.0, 0.0)})
    assert senders(exchange.receive(2, 0, {2: (0.0, 0.0)})) == [1]
