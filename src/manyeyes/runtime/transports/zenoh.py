# SPDX-License-Identifier: Apache-2.0
"""Network by zenoh (https://zenoh.io): peers that find each other by seeds and gossip, or by multicast.

Keys are ``manyeyes/NETWORK/3/TILE/AGENT/msg``, ``manyeyes/NETWORK/3/live/AGENT`` for the presence of an agent, and
``manyeyes/NETWORK/3/clock/AGENT``, which answers a query with the agent's time. Packets are sent
best-effort and are dropped under congestion. The callback of a subscription only appends to a bounded buffer: a callback that works
makes zenoh queue without a bound.
"""

from __future__ import annotations

import json
import re
import struct
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from manyeyes.comms.network.interface import Origin, ReceivedPacket
from manyeyes.comms.network.link_rings import MAX_LINKS, MAX_PACKET_BYTES, LinkRings
from manyeyes.comms.network.tiles import NetworkTile
from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.extras import import_extra
from manyeyes.runtime.sender_clocks import ClockOffset, TwoWayClock

_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
LEASE_MS = 1_000
"""A process that does not answer for this long is gone."""
MAX_SESSIONS = 128
QUERY_PERIOD_NS, QUERY_TIMEOUT_S = 1_000_000_000, 1.0
_TIMES = struct.Struct("<qq")


@dataclass(frozen=True)
class ZenohConfig:
    """network: its name. listen, connect: endpoints such as tcp/10.0.0.5:7447; port 0 is any. By default, this machine only.

    multicast: find peers by multicast too. config_file: a zenoh configuration (JSON5) that is read first: TLS, access control.
    """

    network: str = "default"
    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)
    connect: tuple[str, ...] = ()
    multicast: bool = False
    config_file: str | None = None


class ZenohNetwork:
    """zenoh session of one agent.

    Raises:
        ConfigError: an endpoint cannot be used, or a name has other characters than letters, digits, - and _.
        MissingExtraError: zenoh is not installed.
    """

    _queried_ns: int | None

    def __init__(self, config: ZenohConfig, agent_id: int, clock: Callable[[], int]) -> None:
        if not _NAME.fullmatch(config.network):
            raise ConfigError(f"A network is named by letters, digits, - and _; got {config.network!r}.")
        self._zenoh = import_extra("zenoh", "live", "The network zenoh")
        self._prefix, self._agent_id = f"manyeyes/{config.network}/3", agent_id
        self._rings = LinkRings(clock)
        self._tile: NetworkTile | None = None
        self._clock, self._offsets, self._queried_ns = clock, OrderedDict[str, TwoWayClock](), None
        self._subscriptions: dict[NetworkTile, Any] = {}
        self._publisher: Any = None
        try:
            self._session = self._zenoh.open(self._make_config(config))
            self._token = self._session.liveliness().declare_token(f"{self._prefix}/live/{agent_id}")
            self._queryable = self._declare_clock()
        except self._zenoh.ZError as error:
            raise ConfigError(f"zenoh, listening on {', '.join(config.listen)}: {error}") from error

    def _make_config(self, config: ZenohConfig) -> Any:
        made = self._zenoh.Config.from_file(config.config_file) if config.config_file else self._zenoh.Config()
        settings = {
            "mode": "peer",
            "listen/endpoints": list(config.listen),
            "connect/endpoints": list(config.connect),
            "scouting/multicast/enabled": config.multicast,
            "scouting/gossip/enabled": True,
            "transport/link/rx/max_message_size": MAX_PACKET_BYTES + 1,
            "transport/link/tx/lease": LEASE_MS,
            "transport/unicast/max_sessions": MAX_SESSIONS,
            "transport/shared_memory/enabled": False,
        }
        for key, value in settings.items():
            made.insert_json5(key, json.dumps(value))
        return made

    @property
    def overflows(self) -> int:
        """Number of packets that gave way to newer ones of their link before they were polled."""
        return self._rings.overflows

    def join(self, position_xy: tuple[float, float]) -> None:
        """Receive from the tiles around a position; sending does this too."""
        self._move(position_xy)

    def send(self, packets: Sequence[bytes], position_xy: tuple[float, float]) -> None:
        """Publish packets under the key of the agent's tile."""
        self._move(position_xy)
        for packet in packets:
            self._publisher.put(packet)

    def poll(self) -> list[ReceivedPacket]:
        """Return what arrived since the last call."""
        return self._rings.take()

    def neighbours(self) -> frozenset[str]:
        """Return the ids in the keys that something came under within a second."""
        return self._rings.links()

    def present(self) -> frozenset[str]:
        """Ask the network which agents are connected, whether they send or not."""
        replies = self._session.liveliness().get(f"{self._prefix}/live/*", timeout=1.0)
        keys = (str(reply.ok.key_expr) for reply in replies if reply.ok is not None)
        return frozenset(key.rpartition("/")[2] for key in keys) - {str(self._agent_id)}

    def rename(self, agent_id: int) -> None:
        """Go on under another id: keys change with the pseudonym."""
        if agent_id != self._agent_id:
            self._agent_id, self._tile = agent_id, None
            self._token.undeclare()
            self._token = self._session.liveliness().declare_token(f"{self._prefix}/live/{agent_id}")
            self._queryable.undeclare()
            self._queryable = self._declare_clock()
            self._offsets.clear()

    def clock_offsets(self) -> dict[str, ClockOffset]:
        """Return the clocks of others less the own one, by the ids that they state; other agents are asked once a second.

        Answers are not authenticated: they inform displays, and exclude no sender.
        """
        now_ns = self._clock()
        if self._queried_ns is None or now_ns - self._queried_ns >= QUERY_PERIOD_NS:
            self._queried_ns = now_ns
            self._session.get(f"{self._prefix}/clock/*", partial(self._take_time, now_ns), timeout=QUERY_TIMEOUT_S)
        estimates = {agent: clock.estimate() for agent, clock in list(self._offsets.items())}
        return {agent: one for agent, one in estimates.items() if one is not None}

    def _declare_clock(self) -> Any:
        key = f"{self._prefix}/clock/{self._agent_id}"

        def answer(query: Any) -> None:
            query.reply(key, _TIMES.pack(now_ns := self._clock(), max(now_ns, self._clock())))

        return self._session.declare_queryable(key, answer)

    def _take_time(self, sent_ns: int, reply: Any) -> None:
        """Record an answer, of at most MAX_LINKS agents."""
        received_ns = self._clock()
        if reply.ok is None or len(reply.ok.payload) != _TIMES.size:
            return
        agent = str(reply.ok.key_expr).rpartition("/")[2]
        if agent == str(self._agent_id) or (agent not in self._offsets and len(self._offsets) >= MAX_LINKS):
            return
        there_ns, answered_ns = _TIMES.unpack(reply.ok.payload.to_bytes())
        self._offsets.setdefault(agent, TwoWayClock()).add(sent_ns, there_ns, answered_ns, received_ns)

    def close(self) -> None:
        """Undeclare everything and close the session."""
        self._session.close()

    def _move(self, position_xy: tuple[float, float]) -> None:
        """Subscribe to the tiles around a position, and publish in its own."""
        tile = NetworkTile.at(*position_xy) if self._tile is None else self._tile.move_to(*position_xy)
        if tile == self._tile:
            return
        self._tile, wanted = tile, tile.with_neighbours()
        for other in self._subscriptions.keys() - wanted:
            self._subscriptions.pop(other).undeclare()
        for other in wanted - self._subscriptions.keys():
            key = f"{self._prefix}/{other.name}/*/msg"
            self._subscriptions[other] = self._session.declare_subscriber(key, self._receive)
        if self._publisher is not None:
            self._publisher.undeclare()
        self._publisher = self._session.declare_publisher(
            f"{self._prefix}/{tile.name}/{self._agent_id}/msg",
            congestion_control=self._zenoh.CongestionControl.DROP,
            priority=self._zenoh.Priority.REAL_TIME,
            express=True,
            reliability=self._zenoh.Reliability.BEST_EFFORT,
        )

    def _receive(self, sample: Any) -> None:
        """Append a packet to the buffer of its link, nothing else."""
        tile, agent, _ = str(sample.key_expr).split("/")[-3:]
        if len(sample.payload) <= MAX_PACKET_BYTES and agent != str(self._agent_id):
            self._rings.put(sample.payload.to_bytes(), Origin(agent, tile))
