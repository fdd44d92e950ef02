# SPDX-License-Identifier: Apache-2.0
"""Exchange of packets in a replay: a simulated channel with a clock, and the inbox of each receiver."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from manyeyes.comms.channel import Channel, ChannelPreset
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.local_bus import LocalBus
from manyeyes.datatypes import AgentFrame

Positions = Mapping[int, tuple[float, float]]
"""Antenna of each agent by id: x, y in metres, world frame."""


@dataclass
class Exchange:
    """Agents on one channel.

    make_inbox: makes the inbox of a receiver. comm_range_m: maximum distance of sender and receiver; senders whose position is
    not known are within it.
    """

    radio: ChannelPreset
    seed: int
    make_inbox: Callable[[int], Inbox]
    comm_range_m: float = math.inf
    _inboxes: dict[int, Inbox] = field(default_factory=dict)
    _bus: LocalBus = field(init=False)

    def __post_init__(self) -> None:
        self._bus = LocalBus(Channel(self.radio, self.seed))

    def inbox(self, receiver_id: int) -> Inbox:
        """Return the inbox of a receiver, as of its last reception."""
        if receiver_id not in self._inboxes:
            self._inboxes[receiver_id] = self.make_inbox(receiver_id)
        return self._inboxes[receiver_id]

    def send(self, frame: AgentFrame, packets: Sequence[bytes], positions: Positions) -> None:
        """Publish packets of an agent at the time of its frame."""
        self._bus.publish(frame.agent_id, positions[frame.agent_id], packets, frame.timestamp_ns)

    def receive(self, receiver_id: int, deadline_ns: int, positions: Positions) -> Inbox:
        """Return the inbox of a receiver with the packets that have arrived by the deadline."""
        inbox, here = self.inbox(receiver_id), positions[receiver_id]
        for delivery in self._bus.deliver(receiver_id, here, deadline_ns):
            if math.dist(here, positions.get(delivery.sender_id, here)) <= self.comm_range_m:
                inbox.push(delivery.packet, delivery.arrival_ns)
        return inbox

    def run(
        self,
        frames: Sequence[AgentFrame],
        packets: Sequence[Sequence[bytes]],
        deadlines_ns: Sequence[int],
        positions: Positions,
    ) -> Iterator[tuple[AgentFrame, Inbox, int]]:
        """Send the packets of all agents of one instant; yield each agent's frame, inbox and deadline, in order."""
        for frame, own in zip(frames, packets):
            self.send(frame, own, positions)
        for frame, deadline_ns in zip(frames, deadlines_ns):
            yield frame, self.receive(frame.agent_id, deadline_ns, positions), deadline_ns
