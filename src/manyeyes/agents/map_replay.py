# SPDX-License-Identifier: Apache-2.0
"""Replay of one drive with map agents and a map server: agents exchange features, and send local maps to the server.

Features and local maps use separate channels. Only packets are exchanged; their bytes are counted when they are published.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from manyeyes.agents.exchange import Exchange
from manyeyes.agents.map_perception import MapPredictor, encode_map_message
from manyeyes.agents.map_server import MapServer
from manyeyes.comms.channel import NS_PER_S, channel_preset
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.receiver_limits import ReceiverLimits
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
    _features: Exchange = field(init=False)
    _maps: Exchange = field(init=False)
    _now_ns: int = 0

    def __post_init__(self) -> None:
        radio = channel_preset(self.channel)
        self._features, self._maps = (
            Exchange(radio, self.seed, lambda _: Inbox(limits=ReceiverLimits(max_age_ns=DRAIN_NS))) for _ in range(2)
        )

    def step(self, frames: Sequence[AgentFrame]) -> tuple[SentRecord, ...]:
        """Replay one instant: share features, predict and send local maps, and ingest them at the server."""
        features = [[] if self.encode_features is None else self.encode_features(frame) for frame in frames]
        latest_ns = max((frame.timestamp_ns for frame in frames), default=self._now_ns)
        self._now_ns = latest_ns + round(self.latency_budget_s * NS_PER_S)
        positions = {frame.agent_id: _position_xy(frame) for frame in frames}
        exchanged = self._features.run(frames, features, [self._now_ns] * len(frames), positions)
        records = []
        for (frame, inbox, _), sent in zip(exchanged, features):
            local_map = self.map_predictor(frame, inbox.messages())
            packets = [] if local_map is None else encode_map_message(frame, local_map, self.fingerprint)
            self._maps.send(frame, packets, positions)
            sizes = sum(map(len, sent)), sum(map(len, packets)), len(packets)
            count = 0 if local_map is None else len(local_map.elements)
            records.append(SentRecord(frame.agent_id, frame.timestamp_ns, *sizes, count))
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
            inbox = self._maps.receive(SERVER_ID, self._now_ns, {SERVER_ID: (x, y)})
            self.map_server.ingest(inbox.received_messages(), self.drive)


def _position_xy(frame: AgentFrame) -> tuple[float, float]:
    x, y, _ = frame.world_from_agent.translation.tolist()
    return x, y
