# SPDX-License-Identifier: Apache-2.0
"""Network of agents in one process, on the simulated channel."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from manyeyes.comms.local_bus import LocalBus
from manyeyes.comms.network.interface import Origin, ReceivedPacket

NEIGHBOUR_SILENCE_NS = 1_000_000_000


class LocalNetwork:
    """One agent's side of a bus that several share. clock: nanoseconds, the same for all agents of the bus."""

    def __init__(self, bus: LocalBus, agent_id: int, clock: Callable[[], int]) -> None:
        self._bus, self._agent_id, self._clock = bus, agent_id, clock
        self._position_xy = (0.0, 0.0)
        self._last_ns: dict[str, int] = {}

    def join(self, position_xy: tuple[float, float]) -> None:
        """Receive at a position; sending does this too."""
        self._position_xy = position_xy

    def send(self, packets: Sequence[bytes], position_xy: tuple[float, float]) -> None:
        """Hand packets to the channel; its loss depends on the distance of sender and receiver."""
        self._position_xy = position_xy
        self._bus.publish(self._agent_id, position_xy, packets, self._clock())

    def poll(self) -> list[ReceivedPacket]:
        """Return what has arrived by now."""
        deliveries = self._bus.deliver(self._agent_id, self._position_xy, self._clock())
        self._last_ns.update((str(d.sender_id), d.arrival_ns) for d in deliveries)
        return [ReceivedPacket(d.packet, d.arrival_ns, Origin(str(d.sender_id))) for d in deliveries]

    def neighbours(self) -> frozenset[str]:
        """Return the senders that something arrived of within a second."""
        now_ns = self._clock()
        return frozenset(link for link, last in self._last_ns.items() if now_ns - last <= NEIGHBOUR_SILENCE_NS)

    def close(self) -> None:
        """Leave nothing behind: the bus belongs to the caller."""
