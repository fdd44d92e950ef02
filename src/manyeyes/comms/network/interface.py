# SPDX-License-Identifier: Apache-2.0
"""Interface of networks: what an agent asks of the transport of its packets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol


class Origin(NamedTuple):
    """Where a packet came from. link: of the transport, which an attacker may choose; tile: its scope. Empty: unknown."""

    link: str = ""
    tile: str = ""


UNKNOWN_ORIGIN = Origin()


class ReceivedPacket(NamedTuple):
    """A packet at a receiver. arrival_ns: of the receiver's clock."""

    packet: bytes
    arrival_ns: int
    origin: Origin


class Network(Protocol):
    """The network of one agent. Packets get lost, are duplicated and arrive in any order; none are queued without a bound."""

    def join(self, position_xy: tuple[float, float]) -> None:
        """Receive from the agents around a position (world, metres) from now on; sending does this too."""
        ...

    def send(self, packets: Sequence[bytes], position_xy: tuple[float, float]) -> None:
        """Send packets to the agents around a position (world, metres); what cannot be sent at once is dropped."""
        ...

    def poll(self) -> list[ReceivedPacket]:
        """Return what arrived since the last call, own packets excluded, in order of arrival on each link."""
        ...

    def neighbours(self) -> frozenset[str]:
        """Return the links from which something arrived lately; information for displays, never a condition of receiving."""
        ...

    def close(self) -> None:
        """Leave the network for good."""
        ...
