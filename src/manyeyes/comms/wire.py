# SPDX-License-Identifier: Apache-2.0
"""Wire format, versions 2 to 4: a message as packets that each decode alone, the most important first.

This text is the specification. All numbers are little-endian. A packet is a header, one body and a checksum:

====== ===== ======== =====================================================================================
offset bytes type     meaning
====== ===== ======== =====================================================================================
0      2     bytes    ``ME``
2      1     u8       version, 4; 3 and 2 are read too
3      1     u8       flags: bits 0-2 kind of body (0 none, 1 tokens, 2 objects, 3 points, 4 request, 5 map
                      elements, 6 sight), bit 3 sender is infrastructure, bits 4-5 which part of the quaternion (w, x, y, z)
                      is left out, bit 6 the agent's body follows the header, bit 7 zero
4      2     u16      number of this packet within its message, from 0
6      2     u16      packets in the message, all kinds together
8      4     i32      agent id
12     8     i64      time of capture, nanoseconds
20     18    3 x i48  stated position x, y, z in the world, 2^-20 m, within 100,000 km (error below 0.5 um)
38     12    3 x i32  the other three parts of the unit quaternion of world_from_agent, times 2^31 / sqrt(1/2); the
                      part left out is the largest and is made positive (error below 1e-9 rad)
50     3     3 x u8   standard deviations of x and y, 0 or 1 mm to 10 km, and of yaw, 0 or 1e-5 to 10 rad: 0 is 0,
                      codes 1 to 255 are equal ratios (within 3.3 %)
53     3     3 x i8   lower factor L of their correlations (yx, wx wy), 1/127; the diagonal follows, since rows have
                      length 1 (a longer row is shortened): the covariance is never indefinite
56     8     bytes    model fingerprint
64     9              packet 0 only, where bit 6 is set: the agent's body
...    ...            body
end-4  4     u32      CRC-32 (zlib) of everything before it
====== ===== ======== =====================================================================================

Earlier versions differ in two points. Packet 0 of version 3 always has the agent's body, and version 2 never has it; both write the
score of an object in one byte, 1/255, so that a row has 13 bytes.

The agent's body is the box of its vehicle in its own frame, which stands on the ground plane; without it, the body is unknown:

====== ===== ======== =====================================================================================
0      4     2 x i16  centre x, y, centimetres, within 20 m
4      2     i16      yaw, 0.01 degree, -18000 to 17999
6      3     3 x u8   length, width, height, 0.1 m, 1 to 250
====== ===== ======== =====================================================================================

Tokens (kind 1), some cells of one grid with their features:

====== ===== ======== =====================================================================================
0      12    6 x i16  x_min, y_min, z_min, x_max, y_max, z_max of the grid, centimetres
12     2     u16      pillar, millimetres
14     1     u8       stride
15     1     u8       bits 0-1 features (0 float32, 1 float16, 2 int8, 3 codes), bits 2-3 layout (0 cells as gaps,
                      1 cells as a bitmap, 2 cells and codes as one coded stream), bit 4 clusters, of float16 in
                      layouts 0 and 1 only, 5-7 zero
16     2     u16      channels C; bytes of a row of codes
18     2     u16      cells n; 0 only where the message's whole section is empty
20     ...            layouts 0, 1: cells, in ascending order of ``row * columns + column``, by ``primitives.pack_cells``
...    ...            int8 only: C scale codes u8 (``primitives.SCALES``), a channel's step is scale / 127
...    ...            layouts 0, 1: features, n rows of C
20     ...            layout 2, codes only: both, by ``entropy.pack_coded`` and the tables of the model's codebook
====== ===== ======== =====================================================================================

With bit 4, tokens of a cluster have equal features, which stand in the packet once. Then, from byte 20: u8 clusters K, 1 to 255,
0 only without cells; u8 bytes W of a token's own; the cells; K rows of C float16; n times u8 number of the token's cluster and W
bytes. Each packet has the clusters of its tokens, in the order of their first tokens, all of them used. Bit 4 came after version 4:
a reader that does not know it refuses the packet as garbage and uses the other sections.

Objects (kind 2): one byte of flags (bit 0 velocities, bit 1 descriptors, 2-7 zero, the same in all packets), then 14 bytes
each, in the sender's frame, highest score first:

====== ===== ======== =====================================================================================
0      4     2 x i16  centre x, y, centimetres (to 327.67 m)
4      2     i16      yaw, 0.01 degree, -18000 to 17999
6      2     2 x u8   length, width, 0.1 m, 1 to 255; 255 means 25.5 m or more
8      2     u16      score, 1/65535
10     1     u8       sigma_xy: 0 is 0; codes 1 to 255 are 0.01 to 20 m in equal ratios
11     1     u8       sigma_yaw: 0 is 0; codes 1 to 255 are 0.001 to 3.2 rad in equal ratios
12     1     u8       bits 0-2 label (index into LABELS), bits 3-7 probability that the heading is off by pi, 1/31
13     1     u8       the sender's track id modulo 255; 255 is unknown
14     2     2 x i8   with velocities: vx, vy over the ground, 0.25 m/s, -127 to 127; 127 means 31.75 m/s or more
...    32    32 x i8  with descriptors: 1/127, -127 to 127
====== ===== ======== =====================================================================================

Height is not sent: it is read as the mean of the label (``payloads.LABEL_HEIGHTS``), and the object stands on the sender's
ground plane, centre z = height / 2. Points (kind 3), 7 bytes each: x, y, z i16 centimetres, intensity u8 1/255; time
within the sweep is not sent. Packet k of K points packets has every K-th point from k on, so a loss thins the cloud. A
request (kind 4) is one packet: a grid as tokens begin with (15 bytes), then for each of its cells, row by row, u8 how sure the
sender is of what it sees there, 1/255.

Map elements (kind 5), in the sender's frame: u8 rings R, 1 to 32, then R rings, the same in all packets: what the sender could
see, then what hid parts of it from it. Then elements to the end of the body, the highest score first:

====== ===== ======== =====================================================================================
0      1     u8       bits 0-1 kind (index into KINDS), bits 2-3 likeliest style (index into STYLES), bits 4-7 its
                      probability, 1/4 to 1 in 15 steps; the other styles share the rest evenly
1      1     u8       score, 1/255
2      1     u8       sigma, the mean of its points': 0 is 0; codes 1 to 255 are 0.01 to 20 m in equal ratios
3      ...            its line
====== ===== ======== =====================================================================================

A line is varints (``primitives.pack_varints``): the number of points, 2 or more (3 of a ring, whose first is not repeated), then x
and y of the first and the difference of each further one to the one before it, units of 2 cm, zigzag (v << 1 ^ v >> 63), within
327.66 m. No point equals the one before it.

A sight (kind 6) is one packet of 180 bytes, in the sender's frame: byte k is the free range of the azimuths from 2 k to 2 k + 2
degrees, counterclockwise from x, 0.5 m (``datatypes.sight``). From 5 m to that range rays at the height of vehicles passed; 0
states nothing. Kind 6 came after version 4: a reader that does not know it refuses the packet as garbage and uses the other
sections.

Packets are numbered objects first, then the request, the sight, tokens by falling score (ties by key), map elements, and points:
a message that is cut after any packet still helps. A message without sections is one packet of kind 0. Empty sections are one
packet with no rows. There is no length: what was cut or padded fails the checksum.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.comms import payloads, primitives
from manyeyes.comms.agent_body import AGENT_BODY_BYTES, count_agent_body_bytes, pack_agent_body, read_agent_body
from manyeyes.comms.entropy import CodeTables
from manyeyes.comms.map_payload import ElementRows, merge_elements, pack_element_bodies
from manyeyes.comms.payloads import Body, ObjectRows, PointRows, TokenCodec, TokenEncoding, TokenRows
from manyeyes.comms.primitives import PacketError, log_codes, log_values
from manyeyes.datatypes import AgentBody, BevGrid, ConfigError, Message, Transform, WireError
from manyeyes.datatypes.message import RequestMap
from manyeyes.datatypes.sight import NUM_SECTORS, Sight

VERSION = 4
VERSION_COARSE_SCORES, VERSION_WITHOUT_BODY = 3, 2
"""Earlier versions, which are read."""
DEFAULT_MTU = 1398

_MAGIC = b"ME"
_START = struct.Struct("<2sBBHH")
_COMMON = struct.Struct("<iq18s3i3B3b8s")
_CRC = struct.Struct("<I")
_BODY_AT = _START.size + _COMMON.size
HEADER_BYTES = _BODY_AT + _CRC.size
SIGHT_PACKET_BYTES = HEADER_BYTES + NUM_SECTORS
"""Bytes that a sight adds to a message, without envelopes."""
_QUATERNION_UNIT = 2.0**31 / math.sqrt(0.5)
_POSITION_UNITS = 1 << 20
_POSITION_BYTES = 6
_MAX_POSITION_M = 1e8
_SIGMA_M, _SIGMA_RAD = (1e-3, 1e4), (1e-5, 10.0)
_CODES = np.arange(256, dtype=np.uint8)
_SIGMAS_M: list[float] = log_values(_CODES, *_SIGMA_M).tolist()
_SIGMAS_RAD: list[float] = log_values(_CODES, *_SIGMA_RAD).tolist()
_HAS_BODY = 1 << 6
_EMPTY_BITMAP = np.zeros(0, np.uint8)
_SENDING_ORDER = (
    payloads.OBJECTS,
    payloads.REQUEST,
    payloads.SIGHT,
    payloads.TOKENS,
    payloads.ELEMENTS,
    payloads.POINTS,
)


@dataclass(frozen=True)
class MessageHeader:
    """Fields that all packets of a message share, apart from the packet number.

    pose: position, and quaternion w, x, y, z. covariance_codes: codes of three standard deviations, then of three entries of L.
    """

    agent_id: int
    timestamp_ns: int
    num_packets: int
    is_infrastructure: bool
    fingerprint: bytes
    pose: tuple[float, ...]
    covariance_codes: tuple[int, ...]


class EncodedBody(NamedTuple):
    """The body of one packet. kind: of its section, ``payloads.TOKENS`` ..."""

    kind: int
    content: bytes


class Fragment(NamedTuple):
    """One packet, read and checked. body is None where the message has no section. agent_body: of the sender, in packet 0."""

    header: MessageHeader
    number: int
    body: Body
    packet: bytes
    agent_body: AgentBody | None = None


def encode(
    message: Message,
    *,
    token_encoding: TokenEncoding = "float16",
    mtu: int = DEFAULT_MTU,
    tables: CodeTables | None = None,
    own_bytes: int = 0,
) -> list[bytes]:
    """Return a message as packets of at most mtu bytes, the most important first; what does not fit the format is a WireError.

    tables: those of the weights that the message names; with them, codes are entropy-coded. own_bytes: last bytes of a row of
    clusters, which are the token's own.
    """
    tokens = encode_tokens(message, token_encoding=token_encoding, mtu=mtu, tables=tables, own_bytes=own_bytes)
    return make_packets(message, [*encode_other_sections(message, mtu), *tokens])


def encode_other_sections(message: Message, mtu: int = DEFAULT_MTU) -> list[EncodedBody]:
    """Return the sections of a message apart from its tokens, as the bodies of packets."""
    capacity, bodies = _body_capacity(mtu, message), dict[int, list[bytes]]()
    if message.objects is not None:
        bodies[payloads.OBJECTS] = payloads.pack_object_bodies(message.objects, message.descriptors, capacity)
    if message.request is not None:
        bodies[payloads.REQUEST] = [payloads.pack_request_body(message.request, capacity)]
    if message.sight is not None:
        bodies[payloads.SIGHT] = [payloads.pack_sight_body(message.sight, capacity)]
    if message.local_map is not None:
        bodies[payloads.ELEMENTS] = pack_element_bodies(message.local_map, capacity)
    if message.points is not None:
        bodies[payloads.POINTS] = payloads.pack_point_bodies(message.points, capacity)
    return [EncodedBody(kind, content) for kind, contents in bodies.items() for content in contents]


def encode_tokens(
    message: Message,
    *,
    token_encoding: TokenEncoding = "float16",
    mtu: int = DEFAULT_MTU,
    tables: CodeTables | None = None,
    counts: Sequence[int] | None = None,
    own_bytes: int = 0,
) -> list[EncodedBody]:
    """Return the tokens of a message as the bodies of packets, none without tokens; arguments and errors as in :func:`encode`.

    counts: how many tokens each packet takes, where ``token_selection.select_for_packets`` has counted them.
    """
    token_codec, capacity = TokenCodec(token_encoding, tables, own_bytes), _body_capacity(mtu, message)
    if message.tokens is None:
        return []
    if tables is not None and tables.fingerprint != message.fingerprint:
        raise WireError(
            f"Tables of weights {tables.fingerprint.hex()} do not code tokens of {message.fingerprint.hex()}."
        )
    rows = payloads.pack_token_bodies(message.tokens, message.token_score, token_codec, capacity, counts)
    return [EncodedBody(payloads.TOKENS, content) for content in rows]


def _body_capacity(mtu: int, message: Message) -> int:
    # Which packet is the first is not known before all sections are packed: each leaves room for the agent's body.
    header_bytes = HEADER_BYTES + count_agent_body_bytes(message.body)
    if not header_bytes + payloads.TOKENS_BYTES < mtu <= 65535:
        raise ConfigError(f"mtu is from {header_bytes + payloads.TOKENS_BYTES + 1} to 65535 bytes; got {mtu}.")
    return mtu - header_bytes


def count_bytes(bodies: Iterable[EncodedBody], agent_body: AgentBody | None = None, envelope_bytes: int = 0) -> int:
    """Return bytes of the packets of these bodies, each in an envelope of envelope_bytes, and of the body of their agent."""
    header_bytes = HEADER_BYTES + envelope_bytes
    return sum(header_bytes + len(body.content) for body in bodies) + count_agent_body_bytes(agent_body)


def make_packets(message: Message, bodies: Sequence[EncodedBody]) -> list[bytes]:
    """Return packets of the bodies of a message, in the order of their kinds; without any body one packet of kind 0."""
    bodies = sorted(bodies, key=lambda body: _SENDING_ORDER.index(body.kind)) or [EncodedBody(payloads.NONE, b"")]
    if len(bodies) > 65535:
        raise WireError(
            f"A message has at most 65535 packets; this one needs {len(bodies)}: send less or raise the mtu."
        )
    common = _common_fields(message)
    rest, count, packets = _COMMON.pack(*common.rest), len(bodies), []
    agent_body = b"" if message.body is None else pack_agent_body(message.body)
    for number, (kind, content) in enumerate(bodies):
        flags, extension = (common.flags, b"") if number else (common.flags | bool(agent_body) * _HAS_BODY, agent_body)
        start = _START.pack(_MAGIC, VERSION, flags | kind, number, count)
        packet = b"".join((start, rest, extension, content))
        packets.append(packet + _CRC.pack(zlib.crc32(packet)))
    return packets


@dataclass(frozen=True)
class _Common:
    flags: int
    rest: tuple[Any, ...]


def _common_fields(message: Message) -> _Common:
    """Flags without the kind, and the fields from the agent id to the fingerprint."""
    if not -(2**31) <= message.agent_id < 2**31 or not -(2**63) <= message.timestamp_ns < 2**63:
        raise WireError(
            f"agent_id is an int32 and timestamp_ns an int64; got {message.agent_id}, {message.timestamp_ns}."
        )
    if len(message.fingerprint) != 8:
        raise WireError(f"Message.fingerprint has 8 bytes; got {len(message.fingerprint)}.")
    position = message.world_from_agent.translation.double().cpu().numpy()
    rotation = message.world_from_agent.rotation.double().cpu().numpy()
    if position.shape != (3,) or not np.isfinite(rotation).all() or not (np.abs(position) <= _MAX_POSITION_M).all():
        raise WireError(f"Message.world_from_agent is one finite pose within {_MAX_POSITION_M:.0e} m; got {position}.")
    largest, parts = _smallest_three(rotation)
    spread = _encode_covariance(message.pose_covariance.double().cpu().numpy())
    flags = (8 if message.is_infrastructure else 0) | largest << 4
    place = b"".join(
        round(v * _POSITION_UNITS).to_bytes(_POSITION_BYTES, "little", signed=True) for v in position.tolist()
    )
    values = (message.agent_id, message.timestamp_ns, place, *parts, *spread, message.fingerprint)
    return _Common(flags, values)


def _smallest_three(rotation: NDArray[np.float64]) -> tuple[int, list[int]]:
    """Return the index of the largest part of the unit quaternion (w, x, y, z), and the other three as integers."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    # Each row is the quaternion times four of its parts; the row of the largest part is the best conditioned.
    rows = np.array(
        [
            [1 + a + e + i, h - f, c - g, d - b],
            [h - f, 1 + a - e - i, b + d, c + g],
            [c - g, b + d, 1 - a + e - i, f + h],
            [d - b, c + g, f + h, 1 - a - e + i],
        ]
    )
    largest = int(np.argmax(np.diag(rows)))
    quaternion = rows[largest] / np.linalg.norm(rows[largest])
    codes = np.rint(np.delete(quaternion, largest) * _QUATERNION_UNIT)
    return largest, [int(v) for v in np.clip(codes, -(2**31) + 1, 2**31 - 1)]


def _rotation(q: tuple[float, ...]) -> list[list[float]]:
    """Return the rotation matrix of a unit quaternion w, x, y, z."""
    w, x, y, z = q
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]


def _encode_covariance(covariance: NDArray[np.float64]) -> list[int]:
    """Codes of the standard deviations and of the factor of the correlations of a (3, 3), where zero rows are allowed."""
    if covariance.shape != (3, 3) or not np.isfinite(covariance).all():
        raise WireError(f"Message.pose_covariance is a finite (3, 3); got {covariance.tolist()}.")
    rows = covariance.tolist()
    sigma = [math.sqrt(max(rows[k][k], 0.0)) for k in range(3)]
    lower = _correlation_factor(rows, sigma)
    if lower is None:
        raise WireError(f"Message.pose_covariance is symmetric and positive semidefinite; got {rows}.")
    if max(sigma[:2]) > _SIGMA_M[1]:
        raise WireError(f"Message.pose_covariance is too large to send (over 10 km): {rows}.")
    codes = [*log_codes(np.array(sigma[:2]), *_SIGMA_M), *log_codes(np.array(sigma[2:]), *_SIGMA_RAD)]
    # Rows have length 1, except for rounding and for zero variances.
    lengths = [max(math.sqrt(sum(v * v for v in row)), 1e-9) for row in lower]
    return [*map(int, codes), *(round(lower[i][j] / lengths[i] * 127) for i, j in ((1, 0), (2, 0), (2, 1)))]


def _correlation_factor(covariance: list[list[float]], sigma: list[float]) -> list[list[float]] | None:
    """Return the lower factor of the correlations of a (3, 3), where zero rows are allowed; None where there is none."""
    # Metres and radians differ by orders of magnitude: what counts as zero is evaluated on the correlations.
    correlation, lower = ([[0.0] * 3 for _ in range(3)] for _ in range(2))
    for i in range(3):
        for j in range(3):
            scale = sigma[i] * sigma[j]
            correlation[i][j] = covariance[i][j] / scale if scale > 0 else 0.0
            back = correlation[i][j] * scale
            if abs(covariance[i][j] - back) > 1e-6 * abs(back):
                return None
    if any(abs(correlation[i][j] - correlation[j][i]) > 1e-6 for i, j in ((0, 1), (0, 2), (1, 2))):
        return None
    for j in range(3):
        pivot = correlation[j][j] - sum(v * v for v in lower[j][:j])
        column = [correlation[i][j] - sum(u * v for u, v in zip(lower[i][:j], lower[j])) for i in range(j + 1, 3)]
        if pivot > 1e-9:
            lower[j][j] = math.sqrt(pivot)
            for i, value in enumerate(column, j + 1):
                lower[i][j] = value / lower[j][j]
        elif pivot <= -1e-6 or any(abs(v) >= 1e-3 for v in column):
            return None
    return lower


def _decode_covariance(covariance_codes: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the inverse of _encode_covariance; any codes are some covariance."""
    x, y, yaw, *correlations = covariance_codes
    a, b, c = (code / 127 for code in correlations)
    second, third = max(abs(a), 1.0), max(math.sqrt(b * b + c * c), 1.0)
    a, b, c = a / second, b / third, c / third
    sigma = (_SIGMAS_M[x], _SIGMAS_M[y], _SIGMAS_RAD[yaw])
    lower = (
        (1.0, 0.0, 0.0),
        (a, math.sqrt(max(1 - a * a, 0.0)), 0.0),
        (b, c, math.sqrt(max(1 - (b * b + c * c), 0.0))),
    )
    factor = np.array([[s * value for value in row] for s, row in zip(sigma, lower)])
    return factor @ factor.T


class Envelope(NamedTuple):
    """Header of one packet whose checksum matches; its body is not read. number: of the packet; kind: of the body, which begins
    at body_at.
    """

    header: MessageHeader
    number: int
    kind: int
    packet: bytes
    agent_body: AgentBody | None
    body_at: int

    @property
    def claimed_cells(self) -> int:
        """Number of cells that a body of tokens claims to hold; 0 of other kinds."""
        return payloads.claimed_cells(self.packet, self.body_at) if self.kind == payloads.TOKENS else 0


def open_packet(packet: bytes) -> Envelope:
    """Return the header of a packet, checked, its checksum too; every fault is a :class:`PacketError` with a reason."""
    packet = packet if type(packet) is bytes else bytes(memoryview(packet))
    if len(packet) < 3 or packet[:2] != _MAGIC:
        raise PacketError("garbage", f"Not a manyeyes packet: expected the bytes {_MAGIC!r}, got {packet[:2]!r}.")
    version = packet[2]
    if not VERSION_WITHOUT_BODY <= version <= VERSION:
        known = f"{VERSION_WITHOUT_BODY} to {VERSION}"
        raise PacketError(
            "version", f"Wire version {version} is not known here; expected {known}: update the older side."
        )
    if len(packet) < HEADER_BYTES:
        raise PacketError("garbage", f"Truncated packet: {len(packet)} bytes, a header alone has {HEADER_BYTES}.")
    _, _, flags, number, count = _START.unpack_from(packet)
    common = packet[_START.size : _BODY_AT]
    if _CRC.unpack_from(packet, len(packet) - _CRC.size)[0] != zlib.crc32(memoryview(packet)[: -_CRC.size]):
        agent_id = _COMMON.unpack(common)[0]
        raise PacketError("checksum", f"The checksum of a packet with agent id {agent_id} does not match its bytes.")
    has_body = bool(flags & _HAS_BODY)
    may_have_body, must_have_body = (
        number == 0 and version >= VERSION_COARSE_SCORES,
        number == 0 and version == VERSION_COARSE_SCORES,
    )
    if flags >> 7 or number >= count or not must_have_body <= has_body <= may_have_body:
        raise PacketError("garbage", f"Contradictory header: flags {flags:#04x}, packet {number} of {count}.")
    header = _header(common, flags >> 3 & 7, count)
    if not has_body:
        return Envelope(header, number, flags & 7, packet, None, _BODY_AT)
    if len(packet) < HEADER_BYTES + AGENT_BODY_BYTES:
        raise PacketError("garbage", f"Truncated packet: {len(packet)} bytes do not hold the body of its agent.")
    agent_body = read_agent_body(packet[_BODY_AT : _BODY_AT + AGENT_BODY_BYTES])
    return Envelope(header, number, flags & 7, packet, agent_body, _BODY_AT + AGENT_BODY_BYTES)


def read_fragment(envelope: Envelope, tables: CodeTables | None = None) -> Fragment:
    """Return a packet with its body, checked to its last byte; every fault is a :class:`PacketError` with a reason.

    tables: of the reader's weights, by which coded tokens are read.
    """
    header, (content, has_fine_scores) = envelope.header, read_content(envelope)
    body = payloads.read_body(envelope.kind, content, header.fingerprint, tables, has_fine_scores)
    return Fragment(header, envelope.number, body, envelope.packet, envelope.agent_body)


def read_content(envelope: Envelope) -> tuple[bytes, bool]:
    """Return the bytes of a packet's body, and whether scores of its objects have two bytes."""
    return envelope.packet[envelope.body_at : -_CRC.size], envelope.packet[2] > VERSION_COARSE_SCORES


def decode_packet(packet: bytes, tables: CodeTables | None = None) -> Fragment:
    """Return one packet by :func:`open_packet` and :func:`read_fragment`."""
    return read_fragment(open_packet(packet), tables)


# The packets of a message come one after another, and what they say alike is read once.
@lru_cache(maxsize=64)
def _header(common: bytes, flags: int, count: int) -> MessageHeader:
    """Return the fields from the agent id to the fingerprint, checked; flags without the kind of body."""
    agent_id, timestamp_ns, place, *rest = _COMMON.unpack(common)
    position = tuple(
        int.from_bytes(place[at : at + _POSITION_BYTES], "little", signed=True) / _POSITION_UNITS
        for at in range(0, 3 * _POSITION_BYTES, _POSITION_BYTES)
    )
    if not all(abs(v) <= _MAX_POSITION_M for v in position):
        raise PacketError("implausible", f"Agent {agent_id} claims the position {position}.")
    pose = (*position, *_quaternion(flags >> 1, rest[:3]))
    return MessageHeader(agent_id, timestamp_ns, count, bool(flags & 1), rest[9], pose, tuple(rest[3:9]))


def _quaternion(largest: int, codes: list[int]) -> list[float]:
    """Return the unit quaternion w, x, y, z of three integers and the index of the part left out."""
    parts = [v / _QUATERNION_UNIT for v in codes]
    rest = 1 - sum(v * v for v in parts)
    # The part left out is the largest: at least 1/2, up to rounding.
    if rest < 0.25 - 1e-6:
        raise PacketError("implausible", f"The rotation in the header is not one: parts {parts}.")
    parts.insert(largest, rest**0.5)
    return parts


def count_bitmap_bytes(grid: BevGrid) -> int:
    """Return bytes of one bit a cell of a grid."""
    rows, columns = grid.shape
    return (rows * columns + 7) // 8


class Assembly:
    """The fragments of one message so far, checked against each other as they come."""

    def __init__(self, first: Fragment) -> None:
        self.header = first.header
        self.fragments: dict[int, Fragment] = {}
        self._token_layout: tuple[BevGrid, TokenEncoding, int, int] | None = None
        self._objects: np.dtype[Any] | None = None
        self._has_request = self._has_sight = False
        self._rings: bytes | None = None
        self._cells = _EMPTY_BITMAP
        self.add(first)

    @property
    def has_content(self) -> bool:
        """Whether any packet has a section."""
        return any(fragment.body is not None for fragment in self.fragments.values())

    def has_copy(self, fragment: Fragment) -> bool:
        """Return whether the packet was added before."""
        held = self.fragments.get(fragment.number)
        return held is not None and held.packet == fragment.packet

    def add(self, fragment: Fragment) -> bool:
        """Return whether the fragment is new, False where it is a copy; one that contradicts is refused (PacketError)."""
        head = self.header
        if self.has_copy(fragment):
            return False
        if (fragment.header is not head and fragment.header != head) or fragment.number in self.fragments:
            name = self._name(fragment)
            raise PacketError("contradiction", f"A second {name} differs from the first; both cannot be true.")
        if isinstance(fragment.body, TokenRows):
            form = fragment.body.form
            if self._token_layout is None:
                self._cells = np.zeros(count_bitmap_bytes(fragment.body.grid), np.uint8)
            if (self._token_layout or form) != form or not primitives.mark_new(self._cells, fragment.body.key):
                name = self._name(fragment)
                raise PacketError("contradiction", f"The cells in {name} do not go with those of the other packets.")
            self._token_layout = form
        if isinstance(fragment.body, ObjectRows):
            if (self._objects or fragment.body.rows.dtype) != fragment.body.rows.dtype:
                name = self._name(fragment)
                raise PacketError("contradiction", f"The objects in {name} say other things than those before.")
            self._objects = fragment.body.rows.dtype
        if isinstance(fragment.body, RequestMap):
            if self._has_request:
                name = self._name(fragment)
                raise PacketError("contradiction", f"{name} is a second request; there is one a message.")
            self._has_request = True
        if isinstance(fragment.body, Sight):
            if self._has_sight:
                name = self._name(fragment)
                raise PacketError("contradiction", f"{name} is a second sight; there is one a message.")
            self._has_sight = True
        if isinstance(fragment.body, ElementRows):
            if (self._rings or fragment.body.rings) != fragment.body.rings:
                name = self._name(fragment)
                raise PacketError("contradiction", f"The map in {name} was seen in another view than those before.")
            self._rings = fragment.body.rings
        self.fragments[fragment.number] = fragment
        return True

    def _name(self, fragment: Fragment) -> str:
        return f"packet {fragment.number} of agent {self.header.agent_id} at {self.header.timestamp_ns} ns"

    def message(self) -> Message:
        """What has come so far, as a message; sections of which no packet came are None."""
        head = self.header
        bodies = [self.fragments[number].body for number in sorted(self.fragments)]
        objects = [b.rows for b in bodies if isinstance(b, ObjectRows)]
        return Message(
            agent_id=head.agent_id,
            timestamp_ns=head.timestamp_ns,
            world_from_agent=Transform(
                torch.tensor(_rotation(head.pose[3:]), dtype=torch.float64),
                torch.tensor(head.pose[:3], dtype=torch.float64),
            ),
            pose_covariance=torch.from_numpy(_decode_covariance(head.covariance_codes)),
            fingerprint=head.fingerprint,
            is_infrastructure=head.is_infrastructure,
            tokens=payloads.merge_tokens([b for b in bodies if isinstance(b, TokenRows)]),
            objects=payloads.merge_objects(objects),
            descriptors=payloads.merge_descriptors(objects),
            points=payloads.merge_points([b.rows for b in bodies if isinstance(b, PointRows)]),
            request=next((b for b in bodies if isinstance(b, RequestMap)), None),
            local_map=merge_elements([b for b in bodies if isinstance(b, ElementRows)]),
            body=self.fragments[0].agent_body if 0 in self.fragments else None,
            sight=next((b for b in bodies if isinstance(b, Sight)), None),
        )


def assemble(fragments: Iterable[Fragment]) -> Message:
    """Return the fragments of one message, in any order, with or without copies and gaps, as that message."""
    assembly: Assembly | None = None
    for fragment in fragments:
        if assembly is None:
            assembly = Assembly(fragment)
        else:
            assembly.add(fragment)
    if assembly is None:
        raise WireError("A message is assembled from at least one fragment; got none.")
    return assembly.message()
