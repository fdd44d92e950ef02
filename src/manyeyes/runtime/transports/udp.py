# SPDX-License-Identifier: Apache-2.0
"""Network by UDP multicast: one datagram a packet, to all agents around; nearest to a broadcast radio.

Each tile (``comms.network.tiles``) of each network has a group in 239.0.0.0/8 by a hash of both names; agents join the groups of
their tile and of the eight around it. A datagram is ``MU``, 8 bytes of that hash, the indices i, j of the tile (2 x i32,
little-endian), and the packet: the groups of two tiles may coincide, their hashes do not.

Links that are known have sockets of their own (``link_sockets``), so that a flood from others neither fills their buffers nor takes
more than a bounded time.
"""

from __future__ import annotations

import contextlib
import hashlib
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from manyeyes.comms.network.interface import Origin, ReceivedPacket
from manyeyes.comms.network.link_rings import LinkRings
from manyeyes.comms.network.tiles import NetworkTile
from manyeyes.datatypes import ConfigError
from manyeyes.runtime.transports.link_sockets import LinkSockets, ReadBudget, Sender

DEFAULT_PORT = 17_448
_MAGIC = b"MU"
_HEADER = struct.Struct("<2s8s2i")
_RECEIVE_BYTES = 1 << 20
_MAX_DATAGRAM = 65_535
_POLL_S = 0.2
_COMMON_RATE, _COMMON_BURST = 2_000.0, 500.0
"""Datagrams a second that are read from the common socket, which links without one of their own share."""
_REFILL_S = 0.005
_MAX_TURN = 64
"""Datagrams of one socket before the others have their turn."""
_MAX_DRAINED = 1_000


@dataclass(frozen=True)
class UdpConfig:
    """network: name of the network. interface: address of the interface that is used; by default other machines see nothing.

    ttl: number of routers that a datagram passes; 0 stays on this machine, 1 in the local network.
    """

    network: str = "default"
    interface: str = "127.0.0.1"
    port: int = DEFAULT_PORT
    ttl: int = 0


class UdpNetwork:
    """UDP multicast of one agent. A thread moves datagrams to bounded buffers.

    Raises:
        ConfigError: the interface has no multicast, or the port is in use by a program that does not share it.
    """

    def __init__(self, config: UdpConfig, clock: Callable[[], int]) -> None:
        self._config, self._rings = config, LinkRings(clock)
        self._tile: NetworkTile | None = None
        self._joined: dict[str, int] = {}
        self._scopes: dict[NetworkTile, bytes] = {}
        self._address = socket.inet_aton(config.interface)
        try:
            self._receiver, self._sender = self._open()
        except OSError as error:
            raise ConfigError(f"UDP multicast on {config.interface}, port {config.port}: {error}.") from error
        # With the port, the address of a packet of this agent.
        self._own_port = self._sender.getsockname()[1]
        self._links = LinkSockets(config.port, time.monotonic)
        self._budget = ReadBudget(_COMMON_RATE, _COMMON_BURST, time.monotonic)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._receive, name="udp", daemon=True)
        self._thread.start()

    def _open(self) -> tuple[socket.socket, socket.socket]:
        receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)
        receiver.bind(("", self._config.port))
        receiver.setblocking(False)
        sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, self._address)
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, self._config.ttl)
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        sender.bind((self._config.interface, 0))
        sender.setblocking(False)
        return receiver, sender

    @property
    def overflows(self) -> int:
        """Number of packets that gave way to newer ones of their link before they were polled."""
        return self._rings.overflows

    def send(self, packets: Sequence[bytes], position_xy: tuple[float, float]) -> None:
        """Send each packet as a datagram to the group of the agent's tile."""
        tile = self._move(position_xy)
        group = self._group(tile)
        header = _HEADER.pack(_MAGIC, self._scope(tile), tile.i, tile.j)
        for packet in packets:
            # A full buffer of the interface drops, as a radio does.
            with contextlib.suppress(BlockingIOError, OSError):
                self._sender.sendto(header + packet, (group, self._config.port))

    def poll(self) -> list[ReceivedPacket]:
        """Return what arrived since the last call."""
        return self._rings.take()

    def neighbours(self) -> frozenset[str]:
        """Return the addresses that something came from within a second."""
        return self._rings.links()

    def join(self, position_xy: tuple[float, float]) -> None:
        """Receive from the tiles around a position; sending does this too."""
        self._move(position_xy)

    def close(self) -> None:
        """Stop the thread and close the sockets."""
        self._stopped.set()
        self._thread.join()
        self._links.close()
        self._receiver.close()
        self._sender.close()

    def _move(self, position_xy: tuple[float, float]) -> NetworkTile:
        """Join the groups of the tiles around a position, and leave others."""
        tile = NetworkTile.at(*position_xy) if self._tile is None else self._tile.move_to(*position_xy)
        if tile != self._tile:
            self._tile = tile
            self._scopes = {other: self._scope(other) for other in tile.with_neighbours()}
            wanted = {self._group(other) for other in tile.with_neighbours()}
            for group in self._joined.keys() - wanted:
                self._set_membership(socket.IP_DROP_MEMBERSHIP, group)
                del self._joined[group]
            for group in wanted - self._joined.keys():
                self._set_membership(socket.IP_ADD_MEMBERSHIP, group)
                self._joined[group] = 1
        return tile

    def _set_membership(self, option: int, group: str) -> None:
        try:
            self._receiver.setsockopt(socket.IPPROTO_IP, option, socket.inet_aton(group) + self._address)
        except OSError as error:
            raise ConfigError(f"Multicast group {group} on {self._config.interface}: {error}.") from error

    def _receive(self) -> None:
        buffer, has_budget = memoryview(bytearray(_MAX_DATAGRAM)), True
        while not self._stopped.is_set():
            receivers = self._links.receivers()
            waiting = [*receivers.values(), *([self._receiver] if has_budget else [])]
            select.select(waiting, [], [], _POLL_S if has_budget else _REFILL_S)
            for sender, receiver in receivers.items():
                self._read_link(sender, receiver, buffer)
            has_budget = self._read_common(buffer)
            self._links.close_silent()

    def _read_link(
        self, sender: Sender, receiver: socket.socket, buffer: memoryview, taken: frozenset[bytes] = frozenset()
    ) -> None:
        """Read the socket of a link; taken: datagrams that came by the common one already."""
        host, port, _ = sender
        for _ in range(_MAX_TURN):
            size = _receive_into(receiver, buffer)
            if size is None:
                return
            if not taken or bytes(buffer[:size]) not in taken:
                self._put(buffer[:size], host, port)
            self._links.count(sender)
            if sender not in self._links:
                return

    def _read_common(self, buffer: memoryview) -> bool:
        """Read the common socket; return whether more may be read at once."""
        for _ in range(_MAX_TURN):
            if not self._budget.take():
                return False
            try:
                size, (host, port) = self._receiver.recvfrom_into(buffer)
            except OSError:  # nothing is left
                return True
            sender = self._find_sender(buffer[:size], host, port)
            if sender is None or sender in self._links:
                continue
            self._put(buffer[:size], host, port)
            if self._links.observe(sender):
                self._open_link(sender, buffer)
        return True

    def _open_link(self, sender: Sender, buffer: memoryview) -> None:
        """Give a link a socket, so that none of its datagrams is lost or comes twice."""
        receiver = self._links.open(sender)
        if receiver is None:
            return
        # Those before the connection are in the common socket alone, later ones in both.
        taken = set[bytes]()
        for _ in range(_MAX_DRAINED):
            try:
                size, (host, port) = self._receiver.recvfrom_into(buffer)
            except OSError:
                break
            found = self._find_sender(buffer[:size], host, port)
            if found is not None and (found == sender or found not in self._links):
                self._put(buffer[:size], host, port)
                taken |= {bytes(buffer[:size])} if found == sender else set()
        self._read_link(sender, receiver, buffer, frozenset(taken))

    def _find_sender(self, data: memoryview, host: str, port: int) -> Sender | None:
        """Return who sent a datagram of this network, from a tile around; None of others and of the agent's own."""
        if len(data) < _HEADER.size or (port == self._own_port and host == self._config.interface):
            return None
        magic, scope, i, j = _HEADER.unpack_from(data)
        if magic != _MAGIC or scope != self._scopes.get(NetworkTile(i, j)):
            return None
        return host, port, _group_of(scope)

    def _put(self, data: memoryview, host: str, port: int) -> None:
        """Store the packet of a datagram of this network and of a tile around."""
        magic, scope, i, j = _HEADER.unpack_from(data)
        sent_in = NetworkTile(i, j)
        if magic == _MAGIC and scope == self._scopes.get(sent_in):
            self._rings.put(bytes(data[_HEADER.size :]), Origin(f"{host}:{port}", sent_in.name))

    def _scope(self, tile: NetworkTile) -> bytes:
        return hashlib.sha256(f"manyeyes/{self._config.network}/3/{tile.name}".encode()).digest()[:8]

    def _group(self, tile: NetworkTile) -> str:
        return _group_of(self._scope(tile))


def _group_of(scope: bytes) -> str:
    return f"239.{scope[0]}.{scope[1]}.{scope[2]}"


def _receive_into(receiver: socket.socket, buffer: memoryview) -> int | None:
    """Receive a datagram; None where nothing is left."""
    try:
        return receiver.recv_into(buffer)
    except OSError:
        return None
