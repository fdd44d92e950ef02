# SPDX-License-Identifier: Apache-2.0
"""Replay of one drive with map agents and a map server: agents exchange features, and send local maps to the server.

Features and local maps use separate channels. Only packets are exchanged; their bytes are counted when they are published.
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
"""Receiver id of the map server on the bus."""
DRAIN_NS = 10 * NS_PER_S
"""How long the server still receives packets after the drive has ended."""


@dataclass(frozen=True)
class SentRecord:
    """What one agent sent at one instant: bytes of features; bytes, packets and elements of its local map."""

    agent_id: int
    time_ns: int
    feature_bytes: int
    map_bytes: int
    map_packets: int
    num_elements: int


@dataclass
class MapReplay:
    """Replay of one drive.

    map_predictor: of all agents. encode_features: a frame to the packets of its features, for agents that fuse them; None: each
    agent uses its own only. drive: prefix of agent names at the server. fingerprint: of the weights. channel: name of a preset.
    latency_budget_s: delay before prediction and before ingestion; later packets are ingested at the next instant.
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
        """Replay one instant: share features, predict and send local maps, and ingest them at the server."""
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
        """Ingest the packets still in flight at the end of the drive. frames: of the last instant."""
        self._now_ns += DRAIN_NS
        self._ingest(frames)

    def _ingest(self, frames: Sequence[AgentFrame]) -> None:
        """Ingest what the server received at the mean position of the agents."""
        if frames:
            x, y = np.mean([_position_xy(frame) for frame in frames], 0).tolist()
            self.map_server.ingest(self._receive(self._map_bus, SERVER_ID, (x, y)).received_messages(), self.drive)

    def _receive(self, bus: LocalBus, receiver_id: int, position_xy: tuple[float, float]) -> Inbox:
        """Return the inbox of an agent or of the server, with all packets that have arrived."""
        inbox = self._inboxes.setdefault(receiver_id, Inbox(expire_ns=DRAIN_NS))
        for delivery in bus.deliver(receiver_id, position_xy, self._now_ns):
            inbox.push(delivery.packet, delivery.arrival_ns)
        return inbox

    @staticmethod
    def _send(bus: LocalBus, frame: AgentFrame, packets: list[bytes]) -> int:
        """Publish packets of an agent; returns their number of bytes."""
        bus.publish(frame.agent_id, _position_xy(frame), packets, frame.timestamp_ns)
        return sum(map(len, packets))


def _position_xy(frame: AgentFrame) -> tuple[float, float]:
    x, y, _ = frame.world_from_agent.translation.tolist()
    return x, y
