# SPDX-License-Identifier: Apache-2.0
"""Many agents of one process on one channel: publish packets, collect what has arrived."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from manyeyes.comms.channel import NS_PER_S, Channel, Delivery, PacketInFlight, SharedMedium, Transmission
from manyeyes.datatypes import ConfigError


@dataclass
class _Receiver:
    num_seen: int = 0
    pending: list[Delivery] = field(default_factory=list)


class LocalBus:
    """Simulated channel with a clock. Publish everything up to an instant before delivering up to it.

    Who publishes first at one instant makes no difference. A receiver's distance, hence its loss, is that of the first
    delivery after a packet was sent. Packets that an agent did not collect within keep_s of being sent are let go.
    """

    def __init__(self, channel: Channel, keep_s: float = 10.0) -> None:
        self.channel = channel
        self._keep_ns = round(keep_s * NS_PER_S)
        self._medium = SharedMedium(channel.preset)
        self._clock_ns: int | None = None
        self._on_air: list[PacketInFlight] = []
        self._num_expired = 0
        self._receivers: dict[int, _Receiver] = {}

    @property
    def dropped_in_queue(self) -> int:
        """Packets never sent, because their sender had newer ones before their turn came."""
        return self._medium.dropped_in_queue

    def publish(self, agent_id: int, position_xy: tuple[float, float], packets: Sequence[bytes], now_ns: int) -> None:
        """Hand an agent's packets to its radio at now_ns."""
        if self._clock_ns is not None and now_ns < self._clock_ns:
            raise ConfigError(
                f"Agent {agent_id} publishes at {now_ns} ns, but the bus has delivered up to {self._clock_ns} ns: "
                "publish in order of time, before delivering."
            )
        largest = max((len(p) for p in packets), default=0)
        if largest > self.channel.preset.mtu:
            raise ConfigError(
                f"Channel {self.channel.preset.name} takes packets of at most {self.channel.preset.mtu} bytes; "
                f"got {largest}: encode with mtu={self.channel.preset.mtu}."
            )
        self._medium.offer(Transmission(agent_id, position_xy, tuple(packets), now_ns))

    def deliver(self, agent_id: int, position_xy: tuple[float, float], until_ns: int) -> list[Delivery]:
        """What has arrived at the agent by until_ns and was not given to it before, in order of arrival."""
        self._advance(until_ns)
        receiver = self._receivers.setdefault(agent_id, _Receiver())
        new = self._on_air[max(0, receiver.num_seen - self._num_expired) :]
        receiver.num_seen = self._num_expired + len(self._on_air)
        receiver.pending += self.channel.receive(new, agent_id, position_xy)
        receiver.pending.sort(key=lambda d: d.arrival_ns)
        arrived = [d for d in receiver.pending if d.arrival_ns <= until_ns]
        receiver.pending = receiver.pending[len(arrived) :]
        return arrived

    def _advance(self, until_ns: int) -> None:
        """Move the clock, and forget what has been on the air for too long."""
        if self._clock_ns is not None and until_ns < self._clock_ns:
            return
        self._clock_ns = until_ns
        self._on_air += self._medium.run(until_ns)
        keep = next(
            (i for i, p in enumerate(self._on_air) if p.transmission.sent_ns >= until_ns - self._keep_ns),
            len(self._on_air),
        )
        self._num_expired += keep
        del self._on_air[:keep]
