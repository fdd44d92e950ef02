# SPDX-License-Identifier: Apache-2.0
"""A map server on the network of live agents: it receives their local maps, and sends nothing.

```python
subscriber = MapSubscriber(MapServer(origin_xy=(x, y)), network, clock)
while running:
    subscriber.poll()
fused = subscriber.server.rebuild()
```
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace

from manyeyes.agents.map_server import MapServer
from manyeyes.comms.admission import Authenticator
from manyeyes.comms.drop_counts import DropCounts
from manyeyes.comms.inbox import Inbox, ReceivedMessage
from manyeyes.comms.network.interface import Network, ReceivedPacket
from manyeyes.comms.primitives import PacketError
from manyeyes.comms.signatures.envelope import is_signed, split_signed
from manyeyes.comms.wire import open_packet
from manyeyes.runtime.clock import Clock

MAX_MESSAGES = 256
"""Number of messages whose unread packets are remembered, the last ones."""


class MapSubscriber:
    """Moves local maps from a network to a map server. authenticator: of received packets; None accepts unsigned ones alone.

    Tokens need no weights here: packets of tokens that cannot be read count as received, and of a message the local map is used.
    """

    def __init__(
        self, server: MapServer, network: Network, clock: Clock, authenticator: Authenticator | None = None
    ) -> None:
        self.server, self._network, self._clock = server, network, clock
        self._inbox = Inbox(authenticator=authenticator)
        self._unread: OrderedDict[tuple[int, int], set[int]] = OrderedDict()
        self._coming: dict[int, int] = {}

    @property
    def dropped(self) -> DropCounts:
        """Packets not taken so far, by reason."""
        return self._inbox.dropped

    def poll(self) -> int:
        """Receive what arrived since the last call; return the number of new observations."""
        num_new = sum(map(self._take, self._network.poll()))
        return num_new + self._ingest(self._clock.now_ns())

    def _take(self, received: ReceivedPacket) -> int:
        """Take a packet; return the number of new observations of messages before it.

        The inbox keeps one message of a sender: where several waited in the network, each is ingested before the next one begins.
        """
        is_short = len(received.packet) <= self._inbox.limits.max_packet_bytes
        stated, num_new = _read_stated(received.packet) if is_short else None, 0
        if stated is not None and self._coming.get(stated[0], stated[1]) != stated[1]:
            num_new = self._ingest(received.arrival_ns)
        before = self._inbox.dropped
        self._inbox.push(received.packet, received.arrival_ns, received.origin)
        after = self._inbox.dropped
        if after.wrong_model > before.wrong_model:
            self._record_unread(received.packet)
        elif after.total > before.total:
            return num_new
        if stated is not None:
            self._coming[stated[0]] = stated[1]
        return num_new

    def _ingest(self, now_ns: int) -> int:
        """Ingest the messages of the inbox that are not out of date at a time; return the number of new observations."""
        self._coming.clear()
        return len(self.server.ingest(map(self._complete, self._inbox.received_messages(now_ns))))

    def _record_unread(self, packet: bytes) -> None:
        """Record a packet of tokens that was refused after all checks of its sender."""
        envelope = open_packet(split_signed(packet).packet if is_signed(packet) else packet)
        key = envelope.header.agent_id, envelope.header.timestamp_ns
        self._unread.setdefault(key, set()).add(envelope.number)
        if len(self._unread) > MAX_MESSAGES:
            self._unread.popitem(last=False)

    def _complete(self, one: ReceivedMessage) -> ReceivedMessage:
        """Return a message as complete if only packets of unread tokens are missing."""
        num_unread = len(self._unread.get((one.message.agent_id, one.message.timestamp_ns), ()))
        is_complete = one.received_packets + num_unread >= one.expected_packets
        return replace(one, received_packets=one.expected_packets) if is_complete else one


def _read_stated(packet: bytes) -> tuple[int, int] | None:
    """Return the agent id and the time that a packet states; None where it cannot be read."""
    try:
        header = open_packet(split_signed(packet).packet if is_signed(packet) else packet).header
    except PacketError:
        return None
    return header.agent_id, header.timestamp_ns
