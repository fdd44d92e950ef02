# SPDX-License-Identifier: Apache-2.0
"""The agents of one drive and a cartographer: looks pass among agents that draw together, maps go to the service.

There are two kinds of air: agents hear each other's tokens on one, the cartographer hears everybody's elements on the other.
Nothing else passes, and what passes is counted as it is handed to the radio.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from manyeyes.agents.map_perception import Survey, share_map
from manyeyes.agents.map_server import Cartographer
from manyeyes.comms.channel import NS, Channel, channel_preset
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.local_bus import LocalBus
from manyeyes.datatypes import AgentFrame

SERVICE = -(2**31)
"""The cartographer's number on the bus."""
PATIENCE_NS = 10 * NS
"""How long the service still listens when the drive is over."""


@dataclass(frozen=True)
class Said:
    """What one agent put on the air at one instant: bytes of its look; bytes and packets of its map, and elements in it."""

    agent_id: int
    time_ns: int
    look_bytes: int
    map_bytes: int
    map_packets: int
    elements: int


@dataclass
class MapTeam:
    """One drive. survey: how agents draw. tell: a frame to the packets of its look, for agents that draw together; None: each draws
    from its own. drive: its name, before agents' numbers. fingerprint: of the weights that draw. channel: a preset's name.

    wait_s: how long messages are waited for before tiles are drawn and maps are taken; what comes to the service later is taken
    with the next instant.
    """

    survey: Survey
    cartographer: Cartographer
    drive: str = ""
    tell: Callable[[AgentFrame], list[bytes]] | None = None
    fingerprint: bytes = bytes(8)
    channel: str = "ideal"
    seed: int = 0
    wait_s: float = 0.05
    _among: LocalBus = field(init=False)
    _up: LocalBus = field(init=False)
    _ears: dict[int, Inbox] = field(default_factory=dict)
    _now_ns: int = 0

    def __post_init__(self) -> None:
        radio = channel_preset(self.channel)
        self._among, self._up = LocalBus(Channel(radio, self.seed)), LocalBus(Channel(radio, self.seed))

    def step(self, frames: Sequence[AgentFrame]) -> tuple[Said, ...]:
        """One instant: looks are shared, maps are drawn and sent, and the cartographer takes what has come."""
        looks = [self._hand(self._among, frame, [] if self.tell is None else self.tell(frame)) for frame in frames]
        self._now_ns = max((frame.timestamp_ns for frame in frames), default=self._now_ns) + round(self.wait_s * NS)
        said = []
        for frame, look_bytes in zip(frames, looks):
            heard = () if self.tell is None else self._hear(self._among, frame.agent_id, _place(frame)).messages()
            seen = self.survey(frame, heard)
            packets = [] if seen is None else share_map(frame, seen, self.fingerprint)
            size, count = self._hand(self._up, frame, packets), 0 if seen is None else len(seen.elements)
            said.append(Said(frame.agent_id, frame.timestamp_ns, look_bytes, size, len(packets), count))
        self._take(frames)
        return tuple(said)

    def finish(self, frames: Sequence[AgentFrame]) -> None:
        """The drive is over; the service takes what is still under way. frames: the last."""
        self._now_ns += PATIENCE_NS
        self._take(frames)

    def _take(self, frames: Sequence[AgentFrame]) -> None:
        """The service stands amid the agents."""
        if frames:
            x, y = np.mean([_place(frame) for frame in frames], 0).tolist()
            self.cartographer.listen(self._hear(self._up, SERVICE, (x, y)).receptions(), self.drive)

    def _hear(self, bus: LocalBus, who: int, place: tuple[float, float]) -> Inbox:
        """The inbox of an agent, or of the service, with what has come by now."""
        inbox = self._ears.setdefault(who, Inbox(expire_ns=PATIENCE_NS))
        for delivery in bus.deliver(who, place, self._now_ns):
            inbox.push(delivery.packet, delivery.arrival_ns)
        return inbox

    @staticmethod
    def _hand(bus: LocalBus, frame: AgentFrame, packets: list[bytes]) -> int:
        """Hand packets to the agent's radio; their bytes."""
        bus.publish(frame.agent_id, _place(frame), packets, frame.timestamp_ns)
        return sum(map(len, packets))


def _place(frame: AgentFrame) -> tuple[float, float]:
    x, y, _ = frame.world_from_agent.translation.tolist()
    return x, y
