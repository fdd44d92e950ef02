# SPDX-License-Identifier: Apache-2.0
"""The agents of one drive and a cartographer: looks pass among agents that draw together, maps go to the service.

There are two kinds of air: agents hear each other's tokens on one, the cartographer hears everybody's elements on the other.
Nothing else passes, and what passes is counted as it is handed to the radio.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from manyeyes.agents.map_perception import MapPredictor, encode_map_message
from manyeyes.agents.map_server import MapServer
from manyeyes.comms.channel import NS_PER_S, Channel, channel_preset
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.local_bus import LocalBus
from manyeyes.datatypes import AgentFrame

SERVER_ID = -(2**31)
"""The cartographer's number on the bus."""
DRAIN_NS = 10 * NS_PER_S
"""How long the service still listens when the drive is over."""


@dataclass(frozen=True)
class SentRecord:
    """What one agent put on the air at one instant: bytes of its look; bytes and packets of its map, and elements in it."""

    agent_id: int
    time_ns: int
    feature_bytes: int
    map_bytes: int
    map_packets: int
    num_elements: int


@dataclass
class MapReplay:
    """One drive. map_predictor: how agents draw. encode_features: a frame to the packets of its look, for agents that draw
    together; None: each draws from its own. drive: its name, before agents' numbers. fingerprint: of the weights that draw.
    channel: a preset's name.

    latency_budget_s: how long messages are waited for before tiles are drawn and maps are taken; what comes to the service later is
    taken with the next instant.
    """

    map_predictor: MapPredictor
    map_server: MapServer
    drive: str = ""
    encode_features: Callable[[AgentFrame], list[bytes]] | None = None
    fingerprint: bytes = bytes(8)
    channel: str = "ideal"
    seed: int = 0
    latency_budget_s: float = 0.05
    _feature_bus: LocalBus = field(init=False)
    _map_bus: LocalBus = field(init=False)
    _inboxes: dict[int, Inbox] = field(default_factory=dict)
    _now_ns: int = 0

    def __post_init__(self) -> None:
        radio = channel_preset(self.channel)
        self._feature_bus, self._map_bus = LocalBus(Channel(radio, self.seed)), LocalBus(Channel(radio, self.seed))

    def step(self, frames: Sequence[AgentFrame]) -> tuple[SentRecord, ...]:
        """One instant: looks are shared, maps are drawn and sent, and the cartographer takes what has come."""
        feature_sizes = [
            self._send(self._feature_bus, frame, [] if self.encode_features is None else self.encode_features(frame))
            for frame in frames
        ]
        self._now_ns = max((frame.timestamp_ns for frame in frames), default=self._now_ns) + round(
            self.latency_budget_s * NS_PER_S
        )
        records = []
        for frame, feature_bytes in zip(frames, feature_sizes):
            received = (
                ()
                if self.encode_features is None
                else self._receive(self._feature_bus, frame.agent_id, _position_xy(frame)).messages()
            )
            local_map = self.map_predictor(frame, received)
            packets = [] if local_map is None else encode_map_message(frame, local_map, self.fingerprint)
            size, count = self._send(self._map_bus, frame, packets), 0 if local_map is None else len(local_map.elements)
            records.append(SentRecord(frame.agent_id, frame.timestamp_ns, feature_bytes, size, len(packets), count))
        self._ingest(frames)
        return tuple(records)

    def finish(self, frames: Sequence[AgentFrame]) -> None:
        """The drive is over; the service takes what is still under way. frames: the last."""
        self._now_ns += DRAIN_NS
        self._ingest(frames)

    def _ingest(self, frames: Sequence[AgentFrame]) -> None:
        """The service stands amid the agents."""
        if frames:
            x, y = np.mean([_position_xy(frame) for frame in frames], 0).tolist()
            self.map_server.ingest(self._receive(self._map_bus, SERVER_ID, (x, y)).received_messages(), self.drive)

    def _receive(self, bus: LocalBus, receiver_id: int, position_xy: tuple[float, float]) -> Inbox:
        """The inbox of an agent, or of the service, with what has come by now."""
        inbox = self._inboxes.setdefault(receiver_id, Inbox(expire_ns=DRAIN_NS))
        for delivery in bus.deliver(receiver_id, position_xy, self._now_ns):
            inbox.push(delivery.packet, delivery.arrival_ns)
        return inbox

    @staticmethod
    def _send(bus: LocalBus, frame: AgentFrame, packets: list[bytes]) -> int:
        """Hand packets to the agent's radio; their bytes."""
        bus.publish(frame.agent_id, _position_xy(frame), packets, frame.timestamp_ns)
        return sum(map(len, packets))


def _position_xy(frame: AgentFrame) -> tuple[float, float]:
    x, y, _ = frame.world_from_agent.translation.tolist()
    return x, y
