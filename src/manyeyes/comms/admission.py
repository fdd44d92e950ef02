# SPDX-License-Identifier: Apache-2.0
"""Admission of received packets: an ordered list of checks, the cheapest first, each with a named reason.

Checks of the header precede the parsing of the body, and nothing is allocated by what a packet only claims to hold. Bounds of whole
messages are checked with each packet that is added, before it is stored. Bounds: ``ReceiverLimits``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from manyeyes.comms import payloads
from manyeyes.comms.drop_counts import AuthenticationRefusal, DropReason
from manyeyes.comms.entropy import CodeTables
from manyeyes.comms.map_payload import UNIT_M, ElementRows
from manyeyes.comms.network.interface import UNKNOWN_ORIGIN, Origin
from manyeyes.comms.network.tiles import NetworkTile
from manyeyes.comms.payloads import ObjectRows, TokenRows
from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.comms.signatures.envelope import SignedPacket, is_signed, split_signed
from manyeyes.comms.token_format import TokenFormat
from manyeyes.comms.wire import Envelope, Fragment, open_packet, read_fragment
from manyeyes.datatypes import BevGrid
from manyeyes.datatypes.message import RequestMap
from manyeyes.datatypes.sight import Sight

ContentCheck = Callable[[Fragment], DropReason | None]
"""Why a packet is refused by its content; None accepts it."""


class Authenticator(Protocol):
    """Check that a packet is from the agent that it names; called before the packet changes any state of the receiver."""

    def check(
        self, envelope: Envelope, signed: SignedPacket | None, arrival_ns: int | None, origin: Origin
    ) -> AuthenticationRefusal | None:
        """Return why a packet is refused; None accepts it. signed: the parts of a signed packet, None of an unsigned one."""
        ...


class Admission:
    """The checks of one receiver that need no state; those of a sender and of a message are in ``sender_table``.

    token_format: of the receiver's weights; None: only the fingerprint is compared, or nothing where that is None, too.
    authenticator: None accepts all unsigned packets, and reads no signed ones.
    """

    def __init__(
        self,
        limits: ReceiverLimits,
        fingerprint: bytes | None = None,
        token_format: TokenFormat | None = None,
        authenticator: Authenticator | None = None,
    ) -> None:
        self._limits, self._fingerprint, self._token_format = limits, fingerprint, token_format
        self._authenticator = authenticator
        self.content_checks: dict[type, tuple[ContentCheck, ...]] = {
            TokenRows: (self._check_tokens if token_format is not None else self._check_fingerprint, self._check_grid),
            ObjectRows: (self._check_objects,),
            ElementRows: (self._check_elements,),
            RequestMap: (self._check_grid,),
            Sight: (self._check_sight,),
        }

    def open(self, packet: bytes, arrival_ns: int | None, origin: Origin = UNKNOWN_ORIGIN) -> Envelope | DropReason:
        """Return the header of a packet, or why it is refused before its body is read; may raise PacketError."""
        # The length of any buffer, without a copy
        size = len(packet) if type(packet) is bytes else memoryview(packet).nbytes
        if size > self._limits.max_packet_bytes:
            return "oversize"
        is_read = self._authenticator is not None and is_signed(packet)
        signed = split_signed(packet) if is_read else None
        envelope = open_packet(packet if signed is None else signed.packet)
        reason = self._check_time(envelope, arrival_ns) or self._check_tile(envelope, origin)
        if reason is None and self._authenticator is not None:
            reason = self._authenticator.check(envelope, signed, arrival_ns, origin)
        return reason or self._check_claims(envelope) or envelope

    def read(self, envelope: Envelope, tables: CodeTables | None) -> Fragment | DropReason:
        """Return a packet with its body, or why its content is refused; may raise PacketError."""
        fragment = read_fragment(envelope, tables)
        for check in self.content_checks.get(type(fragment.body), ()):
            reason = check(fragment)
            if reason is not None:
                return reason
        return fragment

    def _check_time(self, envelope: Envelope, arrival_ns: int | None) -> DropReason | None:
        """Python integers: the difference of two int64 may overflow."""
        if arrival_ns is None:
            return None
        age_ns = arrival_ns - envelope.header.timestamp_ns
        if age_ns < -self._limits.max_skew_ns:
            return "future"
        return "expired" if age_ns > self._limits.max_age_ns else None

    def _check_tile(self, envelope: Envelope, origin: Origin) -> DropReason | None:
        if not origin.tile:
            return None
        x, y = envelope.header.pose[:2]
        return None if NetworkTile.of_name(origin.tile).is_next_to(NetworkTile.at(x, y)) else "tile"

    def _check_claims(self, envelope: Envelope) -> DropReason | None:
        """Numbers that the reader of the body would allocate for."""
        if envelope.header.num_packets > self._limits.max_message_packets:
            return "message_size"
        if envelope.kind != payloads.TOKENS:
            return None
        return "cells" if envelope.claimed_cells > self._limits.max_cells else None

    def _check_fingerprint(self, fragment: Fragment) -> DropReason | None:
        others = self._fingerprint is not None and fragment.header.fingerprint != self._fingerprint
        return "wrong_model" if others else None

    def _check_tokens(self, fragment: Fragment) -> DropReason | None:
        if self._token_format is None or not isinstance(fragment.body, TokenRows):
            return None
        return self._token_format.check_packet(fragment.header.fingerprint, fragment.body)

    def _check_grid(self, fragment: Fragment) -> DropReason | None:
        body = fragment.body
        if not isinstance(body, TokenRows | RequestMap):
            return None
        return None if _max_edge_m(body.grid) <= self._limits.max_range_m else "range"

    def _check_objects(self, fragment: Fragment) -> DropReason | None:
        if not isinstance(fragment.body, ObjectRows) or not len(fragment.body.rows):
            return None
        xy_cm = fragment.body.rows["xy"].astype(np.float32)
        far = (np.square(xy_cm).sum(1) > (100 * self._limits.max_range_m) ** 2).any()
        return "range" if far else None

    def _check_elements(self, fragment: Fragment) -> DropReason | None:
        if not isinstance(fragment.body, ElementRows) or not fragment.body.lines:
            return None
        max_units = self._limits.max_range_m / UNIT_M
        far = any(int(np.abs(line).max()) > max_units for line in fragment.body.lines)
        return "range" if far else None

    def _check_sight(self, fragment: Fragment) -> DropReason | None:
        if not isinstance(fragment.body, Sight):
            return None
        return None if float(fragment.body.free_m.max()) <= self._limits.max_range_m else "range"


def _max_edge_m(grid: BevGrid) -> float:
    """Return the largest distance of an edge of a grid from its origin, metres along x or y."""
    return max(abs(grid.x_min), abs(grid.x_max), abs(grid.y_min), abs(grid.y_max))
