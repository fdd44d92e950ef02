# SPDX-License-Identifier: Apache-2.0
"""Bounded buffers between the thread of a network and an agent: the newest packets of each link, never a queue without a bound."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable

from manyeyes.comms.network.interface import Origin, ReceivedPacket

RING_PACKETS = 128
"""Packets that are kept of a link; the oldest gives way. A message has at most a few."""
MAX_LINKS = 64
MAX_PACKET_BYTES = 65_535
NEIGHBOUR_SILENCE_NS = 1_000_000_000
"""A link without packets for this long gives way to a new one, and is no neighbour."""


class LinkRings:
    """Packets by link. One thread puts, another takes. overflows: number of packets that gave way, or found no place."""

    def __init__(self, clock: Callable[[], int], ring_packets: int = RING_PACKETS, max_links: int = MAX_LINKS) -> None:
        self._clock, self._ring_packets, self._max_links = clock, ring_packets, max_links
        self._rings: OrderedDict[str, deque[ReceivedPacket]] = OrderedDict()
        self._last_ns: dict[str, int] = {}
        self._lock = threading.Lock()
        self.overflows = 0

    def put(self, packet: bytes, origin: Origin) -> None:
        """Store a packet with its time of arrival; of a packet that is too long, nothing."""
        if len(packet) > MAX_PACKET_BYTES:
            self.overflows += 1
            return
        now_ns, link = self._clock(), origin.link
        with self._lock:
            ring = self._rings.get(link)
            if ring is None:
                if len(self._rings) >= self._max_links and not self._remove_silent(now_ns):
                    self.overflows += 1
                    return
                ring = self._rings[link] = deque(maxlen=self._ring_packets)
            self.overflows += len(ring) == self._ring_packets
            ring.append(ReceivedPacket(packet, now_ns, origin))
            self._last_ns[link] = now_ns

    def take(self) -> list[ReceivedPacket]:
        """Return and remove all packets, one of each link in turn, so that no link delays another."""
        with self._lock:
            rings = [ring for ring in self._rings.values() if ring]
            taken: list[ReceivedPacket] = []
            while rings:
                taken += [ring.popleft() for ring in rings]
                rings = [ring for ring in rings if ring]
            return taken

    def links(self) -> frozenset[str]:
        """Return the links from which something came within NEIGHBOUR_SILENCE_NS."""
        now_ns = self._clock()
        with self._lock:
            return frozenset(link for link, last in self._last_ns.items() if now_ns - last <= NEIGHBOUR_SILENCE_NS)

    def _remove_silent(self, now_ns: int) -> bool:
        """Remove the link that has been silent for longest, if for long enough; return whether there was one."""
        link = min(self._last_ns, key=lambda other: self._last_ns[other])
        if now_ns - self._last_ns[link] <= NEIGHBOUR_SILENCE_NS:
            return False
        del self._rings[link], self._last_ns[link]
        return True
