# SPDX-License-Identifier: Apache-2.0
"""Sockets of single links of UDP multicast, so that a flood from others fills another socket's buffer.

The system gives a datagram to a socket that is connected to its sender, and to the common one. A link that has sent at a moderate
rate for a while gets such a socket, which is read first; of the common one, a bounded number of datagrams a second is read. Then
a flood costs little time, and loses no packet of a link that was known before, unless the flood states the address of that link.
Only Linux delivers multicast so; elsewhere all links share the common socket.
"""

from __future__ import annotations

import socket
import sys
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

HAS_LINK_SOCKETS = sys.platform == "linux"
MAX_LINKS = 64
MAX_LINK_RATE = 800.0
"""Packets a second; a link that sends more shares the common socket."""
REFUSED_S = 60.0
"""A link whose socket was closed for its rate shares the common one for this long."""
OBSERVED_S = 0.5
"""A link is observed for this long before it gets a socket, and so again until its rate is moderate."""
MAX_SILENCE_S = 10.0
"""A socket is closed when its link has been silent for this long."""
_MAX_OBSERVED = 256
_RECEIVE_BYTES = 1 << 20

Sender = tuple[str, int, str]
"""Address and port of a sender, and the group to which it sends."""


@dataclass
class _Rate:
    """Packets since a time."""

    since_s: float
    packets: int = 0

    def add(self, now_s: float) -> float | None:
        """Count a packet; the rate when OBSERVED_S have passed, and then begin again."""
        self.packets += 1
        elapsed_s = now_s - self.since_s
        if elapsed_s < OBSERVED_S:
            return None
        rate, self.since_s, self.packets = self.packets / elapsed_s, now_s, 0
        return rate


@dataclass
class _LinkSocket:
    receiver: socket.socket
    rate: _Rate
    last_s: float


@dataclass
class LinkSockets:
    """Sockets of links. port: of all receivers; clock: monotonic, seconds. Used by one thread."""

    port: int
    clock: Callable[[], float]
    _links: dict[Sender, _LinkSocket] = field(default_factory=dict)
    _observed: OrderedDict[Sender, _Rate] = field(default_factory=OrderedDict)
    _refused_until_s: dict[Sender, float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self._links)

    def __contains__(self, sender: Sender) -> bool:
        return sender in self._links

    def receivers(self) -> dict[Sender, socket.socket]:
        """Return the sockets by sender."""
        return {sender: link.receiver for sender, link in self._links.items()}

    def observe(self, sender: Sender) -> bool:
        """Count a packet that came by the common socket; return whether its sender should get a socket now."""
        now_s, rate = self.clock(), self._observed.get(sender)
        if rate is None:
            while len(self._observed) >= _MAX_OBSERVED:
                self._observed.popitem(last=False)
            rate = self._observed[sender] = _Rate(now_s)
        found = rate.add(now_s)
        is_moderate = found is not None and found <= MAX_LINK_RATE
        has_place = len(self._links) < MAX_LINKS
        return HAS_LINK_SOCKETS and is_moderate and has_place and sender not in self._refused_until_s

    def open(self, sender: Sender) -> socket.socket | None:
        """Open the socket of a sender; None where the system does not allow it."""
        host, port, group = sender
        receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)
            receiver.bind((group, self.port))
            receiver.connect((host, port))
            receiver.setblocking(False)
        except OSError:
            receiver.close()
            return None
        now_s = self.clock()
        self._observed.pop(sender, None)
        self._links[sender] = _LinkSocket(receiver, _Rate(now_s), now_s)
        return receiver

    def count(self, sender: Sender) -> None:
        """Count a packet that came by the socket of a link; the socket of one that sends too much is closed."""
        link = self._links[sender]
        link.last_s = self.clock()
        rate = link.rate.add(link.last_s)
        if rate is not None and rate > MAX_LINK_RATE:
            self._links.pop(sender).receiver.close()
            if len(self._refused_until_s) >= _MAX_OBSERVED:
                del self._refused_until_s[next(iter(self._refused_until_s))]
            self._refused_until_s[sender] = link.last_s + REFUSED_S

    def close_silent(self) -> None:
        """Close the sockets of links that are silent."""
        now_s = self.clock()
        for sender in [s for s, until_s in self._refused_until_s.items() if until_s < now_s]:
            del self._refused_until_s[sender]
        for sender in [s for s, link in self._links.items() if now_s - link.last_s > MAX_SILENCE_S]:
            self._links.pop(sender).receiver.close()

    def close(self) -> None:
        """Close all sockets."""
        for link in self._links.values():
            link.receiver.close()
        self._links.clear()


@dataclass
class ReadBudget:
    """A token bucket: so many datagrams a second, at most burst at once. clock: monotonic, seconds."""

    rate: float
    burst: float
    clock: Callable[[], float]

    def __post_init__(self) -> None:
        self._tokens, self._filled_s = self.burst, self.clock()

    def take(self) -> bool:
        """Take one; False where none is left."""
        if self._tokens < 1.0:
            now_s = self.clock()
            self._tokens = min(self.burst, self._tokens + (now_s - self._filled_s) * self.rate)
            self._filled_s = now_s
            if self._tokens < 1.0:
                return False
        self._tokens -= 1.0
        return True
