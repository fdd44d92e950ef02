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

from manyeyes.agents.map_server import MapServer
from manyeyes.comms.admission import Authenticator
from manyeyes.comms.drop_counts import DropCounts
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.network.interface import Network
from manyeyes.runtime.clock import Clock


class MapSubscriber:
    """Moves local maps from a network to a map server. authenticator: of received packets; None accepts unsigned ones alone.

    Tokens are not read: of a message, the local map is used.
    """

    def __init__(
        self, server: MapServer, network: Network, clock: Clock, authenticator: Authenticator | None = None
    ) -> None:
        self.server, self._network, self._clock = server, network, clock
        self._inbox = Inbox(authenticator=authenticator)

    @property
    def dropped(self) -> DropCounts:
        """Packets not taken so far, by reason."""
        return self._inbox.dropped

    def poll(self) -> int:
        """Receive what arrived since the last call; return the number of new observations."""
        for received in self._network.poll():
            self._inbox.push(received.packet, received.arrival_ns, received.origin)
        return len(self.server.ingest(self._inbox.received_messages(self._clock.now_ns())))
