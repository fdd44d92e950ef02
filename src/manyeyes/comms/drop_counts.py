# SPDX-License-Identifier: Apache-2.0
"""Reasons why a receiver drops a packet, and their counters."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

from manyeyes.comms.primitives import Reason
from manyeyes.comms.token_format import TokenRefusal

ContentRefusal = Literal["cells", "objects", "points", "map_elements", "range"]
SenderRefusal = Literal["rate", "message_size", "duplicate", "superseded", "empty", "full"]
AuthenticationRefusal = Literal[
    "unsigned", "unknown_signer", "certificate", "revoked", "identity", "replayed", "busy", "forged"
]
HeaderRefusal = Literal["oversize", "future", "expired", "tile"]
DropReason = Reason | TokenRefusal | ContentRefusal | SenderRefusal | AuthenticationRefusal | HeaderRefusal


@dataclass(frozen=True)
class DropCounts:
    """Number of dropped packets by reason, in the order of the checks. The bounds are those of ``ReceiverLimits``."""

    # Longer than max_packet_bytes; not read any further
    oversize: int = 0
    # Not a packet, or truncated
    garbage: int = 0
    # Of another version of the wire format
    version: int = 0
    # Bytes were changed
    checksum: int = 0
    # Values that cannot be: NaN, cells outside their grid, a position beyond the range of the format
    implausible: int = 0
    # Captured more than max_skew_ns after its arrival, or more than max_age_ns before it
    future: int = 0
    expired: int = 0
    # The stated position is not in the tile that the packet was sent in, nor next to it
    tile: int = 0
    # Authentication (``runtime.authentication``): no signature where one is needed; no certificate of the signer yet
    unsigned: int = 0
    unknown_signer: int = 0
    # A certificate that is invalid or expired, of an unknown issuer, or without the right to this content or place; a revoked one
    certificate: int = 0
    revoked: int = 0
    # The agent id is not that of the certificate, or is in use on another link
    identity: int = 0
    # Received before; beyond the number of signatures that are verified at one instant; a wrong signature
    replayed: int = 0
    busy: int = 0
    forged: int = 0
    # Too many packets or bytes of this sender within instant_ns
    rate: int = 0
    # Without any section, while the sender's last message has content
    empty: int = 0
    # Of an earlier message of its sender, or of a smaller one of the same instant
    superseded: int = 0
    # Tokens of other weights; with the receiver's fingerprint, but another grid, width, or beyond its range of values
    wrong_model: int = 0
    grid: int = 0
    width: int = 0
    value: int = 0
    # More content in one message than the bounds allow, or content farther from the sender than max_range_m
    cells: int = 0
    objects: int = 0
    points: int = 0
    map_elements: int = 0
    range: int = 0
    # More packets or bytes in one message than the bounds allow
    message_size: int = 0
    # A copy; or inconsistent with another packet of the same message
    duplicate: int = 0
    contradiction: int = 0
    # No place for another sender, or no memory for more of this one
    full: int = 0

    @property
    def total(self) -> int:
        """Packets not taken, for whatever reason."""
        return sum(getattr(self, f.name) for f in fields(self))
