# SPDX-License-Identifier: Apache-2.0
"""A network with faults, for tests: packets are duplicated, reordered, delayed and cut off on their way to the receiver."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from manyeyes.comms.network.interface import Network, ReceivedPacket
from manyeyes.datatypes import ConfigError
from manyeyes.ops.keyed_random import keyed_uniform


@dataclass(frozen=True)
class FaultPlan:
    """Faults of received packets, each drawn by (seed, number of the packet).

    duplicate_fraction: of packets that come twice. reorder_ns: each comes later by up to this much. late_fraction:
    of packets that come late_ns later.
    """

    seed: int = 0
    duplicate_fraction: float = 0.0
    reorder_ns: int = 0
    late_fraction: float = 0.0
    late_ns: int = 0

    def __post_init__(self) -> None:
        fractions = (self.duplicate_fraction, self.late_fraction)
        if not all(0 <= fraction <= 1 for fraction in fractions) or min(self.reorder_ns, self.late_ns) < 0:
            raise ConfigError(f"FaultPlan has fractions from 0 to 1 and delays of at least 0; got {self}.")


class FaultyNetwork:
    """Another network, with faults. accepts: which packets come through, for partitions; it may be exchanged at any time."""

    def __init__(self, network: Network, clock: Callable[[], int], plan: FaultPlan | None = None) -> None:
        self._network, self._clock, self.plan = network, clock, plan or FaultPlan()
        self.accepts: Callable[[ReceivedPacket], bool] = lambda received: True
        self._waiting: list[tuple[int, int, ReceivedPacket]] = []
        self._num_packets = self._num_waiting = 0

    @property
    def overflows(self) -> int:
        """Packets that gave way to newer ones in the network."""
        return int(getattr(self._network, "overflows", 0))

    def join(self, position_xy: tuple[float, float]) -> None:
        """Receive from the agents around a position."""
        self._network.join(position_xy)

    def send(self, packets: Sequence[bytes], position_xy: tuple[float, float]) -> None:
        """Send packets; faults happen at the receivers."""
        self._network.send(packets, position_xy)

    def poll(self) -> list[ReceivedPacket]:
        """Return the packets that are due by now, with their delayed times of arrival, in the order of these."""
        for received in self._network.poll():
            if self.accepts(received):
                self._delay(received)
        due, now_ns = list[ReceivedPacket](), self._clock()
        while self._waiting and self._waiting[0][0] <= now_ns:
            due.append(heapq.heappop(self._waiting)[2])
        return due

    def neighbours(self) -> frozenset[str]:
        """Return the links of the network."""
        return self._network.neighbours()

    def close(self) -> None:
        """Close the network that carries the packets."""
        self._network.close()

    def _delay(self, received: ReceivedPacket) -> None:
        plan = self.plan
        self._num_packets += 1
        twice, late, first, second = keyed_uniform((4,), plan.seed, "network fault", self._num_packets).tolist()
        extra_ns = plan.late_ns if late < plan.late_fraction else 0
        for draw in (first, second) if twice < plan.duplicate_fraction else (first,):
            arrival_ns = received.arrival_ns + extra_ns + round(draw * plan.reorder_ns)
            self._num_waiting += 1
            heapq.heappush(self._waiting, (arrival_ns, self._num_waiting, received._replace(arrival_ns=arrival_ns)))
