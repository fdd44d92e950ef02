# SPDX-License-Identifier: Apache-2.0
"""Certificate of a public key, 126 bytes: who may send what, where and when. Modelled on IEEE 1609.2 / ETSI TS 103 097.

All numbers are little-endian:

====== ===== ======== =====================================================================================
offset bytes type     meaning
====== ===== ======== =====================================================================================
0      1     u8       version, 1
1      1     u8       suite, as in ``comms.signatures.envelope``
2      2     u16      rights, one bit each, in the order of ``RIGHTS``
4      4     i32      agent id, the pseudonym; 0 of an issuer
8      4     u32      start of validity, seconds since 1970
12     2     u16      lifetime, minutes
14     8     4 x i16  area (``Area``): i, j of its first square, numbers of squares along x and y; zero is anywhere
22     32    bytes    public key
54     8     bytes    identifier of the issuer
62     64    bytes    signature of ``CONTEXT`` and everything before it, by the issuer
====== ===== ======== =====================================================================================

The identifier of a certificate is the last 8 bytes of its SHA-256.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, field
from typing import Literal, get_args

from manyeyes.comms.network.tiles import TILE_M, NetworkTile
from manyeyes.datatypes import WireError

Right = Literal["objects", "tokens", "points", "map", "infrastructure", "issuer"]
RIGHTS: tuple[Right, ...] = get_args(Right)
SENDER_RIGHTS = frozenset[Right](("objects", "tokens", "points", "map"))
VERSION = 1
SUITE = 1
CONTEXT = b"manyeyes certificate 1\0"
IDENTIFIER_BYTES, KEY_BYTES, SIGNATURE_BYTES = 8, 32, 64
_LAYOUT = struct.Struct("<BBHiIH4h32s8s")
CERTIFICATE_BYTES = _LAYOUT.size + SIGNATURE_BYTES
MAX_LIFETIME_MIN = 65_535


def make_identifier(data: bytes) -> bytes:
    """Return the identifier of a packed certificate, or of a bare public key (that of an anchor)."""
    return hashlib.sha256(data).digest()[-IDENTIFIER_BYTES:]


@dataclass(frozen=True)
class Area:
    """A rectangle of ``num_i`` by ``num_j`` squares of ``comms.network.tiles``, from the square (i, j) on."""

    i: int
    j: int
    num_i: int = 1
    num_j: int = 1

    def __post_init__(self) -> None:
        if self.num_i < 1 or self.num_j < 1 or not all(-(2**15) <= v < 2**15 for v in self._fields):
            raise WireError(f"Area has at least one square each way and indices within 16 bits; got {self}.")

    @property
    def _fields(self) -> tuple[int, int, int, int]:
        return self.i, self.j, self.num_i, self.num_j

    def contains(self, x: float, y: float) -> bool:
        """Return whether a position in the world, metres, is in the rectangle."""
        tile = NetworkTile.at(x, y)
        return 0 <= tile.i - self.i < self.num_i and 0 <= tile.j - self.j < self.num_j

    def is_within(self, other: Area) -> bool:
        """Return whether another rectangle contains this one."""
        ends = ((self.i, self.num_i, other.i, other.num_i), (self.j, self.num_j, other.j, other.num_j))
        return all(there <= here and here + num <= there + limit for here, num, there, limit in ends)

    def __str__(self) -> str:
        x, y = self.i * TILE_M, self.j * TILE_M
        return f"x {x:g} to {x + self.num_i * TILE_M:g} m, y {y:g} to {y + self.num_j * TILE_M:g} m"


@dataclass(frozen=True)
class Certificate:
    """A certificate. area: None is anywhere. issuer: identifier of the certificate, or anchor, that signed it."""

    rights: frozenset[Right]
    agent_id: int
    not_before_s: int
    lifetime_min: int
    area: Area | None
    public_key: bytes
    issuer: bytes
    signature: bytes = field(default=bytes(SIGNATURE_BYTES), repr=False)

    def __post_init__(self) -> None:
        if not self.rights or self.rights - set(RIGHTS):
            raise WireError(
                f"Certificate.rights are some of {', '.join(RIGHTS)}; got {', '.join(sorted(self.rights))}."
            )
        if not (-(2**31) <= self.agent_id < 2**31 and 0 <= self.not_before_s < 2**32):
            raise WireError(
                f"Certificate.agent_id is an int32, not_before_s a uint32; got {self.agent_id}, {self.not_before_s}."
            )
        if not 0 < self.lifetime_min <= MAX_LIFETIME_MIN:
            raise WireError(f"Certificate.lifetime_min is from 1 to {MAX_LIFETIME_MIN}; got {self.lifetime_min}.")
        sizes = len(self.public_key), len(self.issuer), len(self.signature)
        if sizes != (KEY_BYTES, IDENTIFIER_BYTES, SIGNATURE_BYTES):
            raise WireError(f"Certificate has a key of 32 bytes, an issuer of 8 and a signature of 64; got {sizes}.")

    @property
    def identifier(self) -> bytes:
        """The last 8 bytes of its SHA-256."""
        return make_identifier(self.pack())

    @property
    def not_after_s(self) -> int:
        """End of validity, seconds since 1970."""
        return self.not_before_s + 60 * self.lifetime_min

    @property
    def signed_content(self) -> bytes:
        """What the signature is of."""
        return CONTEXT + self.pack()[:-SIGNATURE_BYTES]

    def is_valid_at(self, time_s: float, tolerance_s: float = 60.0) -> bool:
        """Return whether a time is in the period of validity, within a tolerance of clocks."""
        return self.not_before_s - tolerance_s <= time_s <= self.not_after_s + tolerance_s

    def pack(self) -> bytes:
        """Return the certificate as bytes."""
        rights = sum(1 << bit for bit, right in enumerate(RIGHTS) if right in self.rights)
        area = (0, 0, 0, 0) if self.area is None else (self.area.i, self.area.j, self.area.num_i, self.area.num_j)
        fields = (rights, self.agent_id, self.not_before_s, self.lifetime_min, *area, self.public_key, self.issuer)
        return _LAYOUT.pack(VERSION, SUITE, *fields) + self.signature

    @classmethod
    def read(cls, data: bytes) -> Certificate:
        """Read a packed certificate; its signature is not verified.

        Raises:
            WireError: the bytes are no certificate.
        """
        if len(data) != CERTIFICATE_BYTES:
            raise WireError(f"A certificate has {CERTIFICATE_BYTES} bytes; got {len(data)}.")
        version, suite, bits, agent_id, start, lifetime, *area, key, issuer = _LAYOUT.unpack_from(data)
        if (version, suite) != (VERSION, SUITE):
            raise WireError(
                f"A certificate of version {version}, suite {suite} is not known here; expected {VERSION}, {SUITE}."
            )
        if bits >> len(RIGHTS):
            raise WireError(f"Rights {bits:#06x} of a certificate are not known here.")
        rights = frozenset[Right](right for bit, right in enumerate(RIGHTS) if bits >> bit & 1)
        place = Area(*area) if any(area) else None
        return cls(rights, agent_id, start, lifetime, place, key, issuer, data[-SIGNATURE_BYTES:])
