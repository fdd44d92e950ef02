# SPDX-License-Identifier: Apache-2.0
"""Wire format, version 1: a message as packets that each decode alone, the most important first.

This text is the specification. All numbers are little-endian. A packet is a header, one body and a checksum:

====== ===== ======== =====================================================================================
offset bytes type     meaning
====== ===== ======== =====================================================================================
0      2     bytes    ``ME``
2      1     u8       version, 1
3      1     u8       flags: bits 0-1 kind of body (0 none, 1 tokens, 2 objects, 3 points), bit 2 sender is
                      infrastructure, bits 3-4 which part of the quaternion (w, x, y, z) is left out, 5-7 zero
4      2     u16      length of the whole packet in bytes, checksum included
6      2     u16      number of this packet within its message, from 0
8      2     u16      packets in the message, all kinds together
10     4     i32      agent id
14     8     i64      time of capture, nanoseconds
22     24    3 x f64  claimed position x, y, z in the world, metres
46     12    3 x i32  the other three parts of the unit quaternion of world_from_agent, times 2^31 / sqrt(1/2); the
                      part left out is the largest and is made positive (error below 1e-9 rad)
58     12    6 x f16  lower Cholesky factor L of the pose covariance, rows (xx, yx yy, wx wy ww), metres and
                      radians: the covariance read is L L^T, never indefinite, within 0.2 %
70     8     bytes    model fingerprint
78     ...            body
end-4  4     u32      CRC-32 (zlib) of everything before it
====== ===== ======== =====================================================================================

Tokens (kind 1), some cells of one grid with their features:

====== ===== ======== =====================================================================================
0      12    6 x i16  x_min, y_min, z_min, x_max, y_max, z_max of the grid, centimetres
12     2     u16      pillar, millimetres
14     1     u8       stride
15     1     u8       bits 0-1 features (0 float32, 1 float16, 2 int8), bit 2 cells (0 gaps, 1 bitmap), 3-7 zero
16     2     u16      channels C
18     2     u16      cells n; 0 only where the message's whole section is empty
20     ...            cells, in ascending order of ``row * columns + column``, by ``codec.pack_cells``
...    ...            int8 only: C scale codes u8 (``codec.SCALES``), a channel's step is scale / 127
...    ...            features, n rows of C
====== ===== ======== =====================================================================================

Objects (kind 2), 13 bytes each, in the sender's frame, highest score first:

====== ===== ======== =====================================================================================
0      4     2 x i16  centre x, y, centimetres (to 327.67 m)
4      2     i16      yaw, 0.01 degree, -18000 to 17999
6      2     2 x u8   length, width, 0.1 m, 1 to 255; 255 means 25.5 m or more
8      1     u8       score, 1/255
9      1     u8       sigma_xy: 0 is 0; codes 1 to 255 are 0.01 to 20 m in equal ratios
10     1     u8       sigma_yaw: 0 is 0; codes 1 to 255 are 0.001 to 3.2 rad in equal ratios
11     1     u8       bits 0-2 label (index into LABELS), bits 3-7 probability that the heading is off by pi, 1/31
12     1     u8       the sender's track id modulo 255; 255 is unknown
====== ===== ======== =====================================================================================

Height is not sent: it is read as the mean of the label (``LABEL_HEIGHTS``), and the object stands on the sender's
ground plane, centre z = height / 2. Points (kind 3), 7 bytes each: x, y, z i16 centimetres, intensity u8 1/255; time
within the sweep is not sent. Packet k of K points packets has every K-th point from k on, so a loss thins the cloud.

Packets are numbered objects first, then tokens by falling score (ties by key), then points: a message that is cut after
any packet still helps. A message without sections is one packet of kind 0. Empty sections are one packet with no rows.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.comms import codec
from manyeyes.datatypes import (
    LABELS,
    BevGrid,
    Boxes,
    ConfigError,
    Message,
    PointCloud,
    Sites,
    SparseBev,
    Transform,
    WireError,
)

Precision = Literal["float32", "float16", "int8"]
Reason = Literal["garbage", "version", "checksum", "implausible", "contradiction"]

PRECISIONS: tuple[Precision, ...] = ("float32", "float16", "int8")
VERSION = 1
DEFAULT_MTU = 1398
LABEL_HEIGHTS = (1.6, 2.2, 3.1, 3.3)

_MAGIC = b"ME"
_HEADER = struct.Struct("<2sBBHHHiq3d3i6e8s")
_GRID = struct.Struct("<6hHBBHH")
_CRC = struct.Struct("<I")
HEADER_BYTES = _HEADER.size + _CRC.size
TOKENS_BYTES = _GRID.size

_NONE, _TOKENS, _OBJECTS, _POINTS = range(4)
_OBJECT = np.dtype(
    [("xy", "<i2", 2), ("yaw", "<i2"), ("size", "u1", 2), ("score", "u1")]
    + [(name, "u1") for name in ("sigma_xy", "sigma_yaw", "label_flip", "id")]
)
_POINT = np.dtype([("xyz", "<i2", 3), ("intensity", "u1")])
_FEATURE_TYPES = {"float32": np.dtype("<f4"), "float16": np.dtype("<f2"), "int8": np.dtype("i1")}
_QUATERNION_UNIT = 2.0**31 / np.sqrt(0.5)
_FARTHEST_M = 1e8
_MOST_CELLS = 1 << 24
_SIGMA_XY, _SIGMA_YAW = (0.01, 20.0), (0.001, 3.2)


class PacketError(WireError):
    """A packet that is refused; ``reason`` says of what kind the fault is."""

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.reason: Reason = reason


@dataclass(frozen=True)
class Header:
    """What every packet of a message says alike, apart from its number. pose: position, and quaternion w, x, y, z."""

    agent_id: int
    timestamp_ns: int
    packets: int
    is_infrastructure: bool
    fingerprint: bytes
    pose: tuple[float, ...]
    covariance_factor: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class TokenRows:
    """Some cells of a grid: key (n,) ascending, features (n, C) float32."""

    grid: BevGrid
    precision: Precision
    key: NDArray[np.int64]
    features: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ObjectRows:
    """Some objects, as they stand in the packet."""

    rows: NDArray[Any]


@dataclass(frozen=True, eq=False)
class PointRows:
    """Some points, as they stand in the packet."""

    rows: NDArray[Any]


@dataclass(frozen=True, eq=False)
class Fragment:
    """One packet, read and checked. body is None where the message has no section."""

    header: Header
    number: int
    body: TokenRows | ObjectRows | PointRows | None
    packet: bytes


def encode(message: Message, *, precision: Precision = "float16", mtu: int = DEFAULT_MTU) -> list[bytes]:
    """A message as packets of at most mtu bytes, the most important first; what does not fit the format is a WireError."""
    check_precision(precision)
    if not HEADER_BYTES + TOKENS_BYTES < mtu <= 65535:
        raise ConfigError(f"mtu is from {HEADER_BYTES + TOKENS_BYTES + 1} to 65535 bytes; got {mtu}.")
    bodies: list[tuple[int, bytes]] = []
    if message.objects is not None:
        bodies += [(_OBJECTS, body) for body in _object_bodies(message.objects, mtu - HEADER_BYTES)]
    if message.tokens is not None:
        bodies += [(_TOKENS, b) for b in _token_bodies(message.tokens, message.token_score, precision, mtu)]
    if message.points is not None:
        bodies += [(_POINTS, body) for body in _point_bodies(message.points, mtu - HEADER_BYTES)]
    bodies = bodies or [(_NONE, b"")]
    if len(bodies) > 65535:
        raise WireError(
            f"A message has at most 65535 packets; this one needs {len(bodies)}: send less or raise the mtu."
        )
    common = _common_fields(message)
    packets = []
    for number, (kind, body) in enumerate(bodies):
        head = _HEADER.pack(
            _MAGIC, VERSION, common.flags | kind, HEADER_BYTES + len(body), number, len(bodies), *common.rest
        )
        packets.append(head + body + _CRC.pack(zlib.crc32(body, zlib.crc32(head))))
    return packets


def check_precision(precision: str) -> None:
    """Raise ConfigError where precision is not one of PRECISIONS."""
    if precision not in PRECISIONS:
        raise ConfigError(f"precision is one of {', '.join(PRECISIONS)}; got {precision!r}.")


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
    position = message.world_from_agent.translation.double().numpy()
    rotation = message.world_from_agent.rotation.double().numpy()
    if position.shape != (3,) or not np.isfinite(rotation).all() or not (np.abs(position) <= _FARTHEST_M).all():
        raise WireError(f"Message.world_from_agent is one finite pose within {_FARTHEST_M:.0e} m; got {position}.")
    largest, parts = _smallest_three(rotation)
    factor = _cholesky(message.pose_covariance.double().numpy())
    flags = (4 if message.is_infrastructure else 0) | largest << 3
    values = (message.agent_id, message.timestamp_ns, *position.tolist(), *parts, *factor, message.fingerprint)
    return _Common(flags, values)


def _smallest_three(rotation: NDArray[np.float64]) -> tuple[int, list[int]]:
    """Index of the largest part of the unit quaternion (w, x, y, z), and the other three as integers."""
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
    w, x, y, z = q
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]


def _cholesky(covariance: NDArray[np.float64]) -> list[float]:
    """Six entries of the lower factor of a positive semidefinite (3, 3); zero rows and columns are allowed."""
    if covariance.shape != (3, 3) or not np.isfinite(covariance).all():
        raise WireError(f"Message.pose_covariance is a finite (3, 3); got {covariance.tolist()}.")
    slack = 1e-9 * max(float(np.abs(covariance).max()), 1e-30)
    lower = np.zeros((3, 3))
    for j in range(3):
        pivot = covariance[j, j] - lower[j, :j] @ lower[j, :j]
        column = covariance[j + 1 :, j] - lower[j + 1 :, :j] @ lower[j, :j]
        if pivot > slack:
            lower[j, j] = np.sqrt(pivot)
            lower[j + 1 :, j] = column / lower[j, j]
        elif pivot < -slack or (np.abs(column) > np.sqrt(slack)).any():
            raise WireError(f"Message.pose_covariance is not positive semidefinite: {covariance.tolist()}.")
    factor = lower[np.tril_indices(3)]
    if (np.abs(factor) > 65504).any():
        raise WireError(f"Message.pose_covariance is too large to send (over 65 km): {covariance.tolist()}.")
    return factor.tolist()


def _centimetres(metres: NDArray[np.floating[Any]], what: str) -> NDArray[np.int16]:
    """Metres as int16 centimetres; what does not fit is a WireError that names it."""
    codes = np.rint(metres.astype(np.float64) * 100)
    bad = ~(np.abs(codes) <= 32767)
    if bad.any():
        raise WireError(
            f"{what} are sent within 327.67 m of the agent; {int(bad.sum())} values are not: crop them first."
        )
    return codes.astype(np.int16)


def _object_bodies(boxes: Boxes, capacity: int) -> list[bytes]:
    boxes = boxes[boxes.score.argsort(descending=True, stable=True)]
    values = torch.cat(
        [
            boxes.center,
            boxes.size,
            torch.stack((boxes.yaw, boxes.score, boxes.sigma_xy, boxes.sigma_yaw, boxes.flip), -1),
        ],
        -1,
    ).double()
    if not bool(torch.isfinite(values).all()):
        raise WireError("Message.objects has NaN or infinite values; drop those objects before sending.")
    label = boxes.label.numpy()
    if len(label) and not (0 <= label.min() and label.max() < len(LABELS)):
        raise WireError(
            f"Message.objects.label is an index into {LABELS}; got {int(label.min())} to {int(label.max())}."
        )
    v = values.numpy()
    rows = np.zeros(len(boxes), _OBJECT)
    rows["xy"] = _centimetres(v[:, :2], "Objects")
    hundredths = np.rint(np.rad2deg(v[:, 6]) * 100)
    rows["yaw"] = np.mod(hundredths + 18000, 36000) - 18000
    rows["size"] = np.clip(np.rint(v[:, 3:5] * 10), 1, 255)
    rows["score"] = np.rint(np.clip(v[:, 7], 0, 1) * 255)
    rows["sigma_xy"] = codec.log_codes(v[:, 8], *_SIGMA_XY)
    rows["sigma_yaw"] = codec.log_codes(v[:, 9], *_SIGMA_YAW)
    rows["label_flip"] = label | np.rint(np.clip(v[:, 10], 0, 1) * 31).astype(np.int64) << 3
    ids = boxes.id.numpy()
    rows["id"] = np.where(ids < 0, 255, np.mod(ids, 255))
    each = capacity // _OBJECT.itemsize
    return [rows[i : i + each].tobytes() for i in range(0, max(len(rows), 1), each)]


def _point_bodies(cloud: PointCloud, capacity: int) -> list[bytes]:
    rows = np.zeros(len(cloud), _POINT)
    rows["xyz"] = _centimetres(cloud.xyz.numpy(), "Points")
    rows["intensity"] = np.rint(np.clip(np.nan_to_num(cloud.intensity.numpy()), 0, 1) * 255)
    packets = max(1, -(-len(rows) // (capacity // _POINT.itemsize)))
    return [rows[k::packets].tobytes() for k in range(packets)]


def token_order(tokens: SparseBev, score: Tensor | None) -> NDArray[np.int64]:
    """(N,) rows of tokens by falling score, ties and a missing score by key: the order in which they are sent."""
    if tokens.sites.batch_size != 1:
        raise WireError(f"A message has the tokens of one grid; got a batch of {tokens.sites.batch_size}.")
    if score is None:
        return np.arange(len(tokens.sites))
    if score.shape != (len(tokens.sites),) or bool(score.isnan().any()):
        raise WireError(f"Message.token_score needs ({len(tokens.sites)},) without NaN; got {tuple(score.shape)}.")
    return score.detach().argsort(descending=True, stable=True).cpu().numpy()


def packet_counts(
    key: NDArray[np.int64], channels: int, precision: Precision, mtu: int, budget_bytes: int | None = None
) -> list[int]:
    """How many cells each tokens packet takes, in the order of key (N,), in at most budget_bytes altogether.

    Each packet is filled before the next is begun, so a smaller budget keeps a prefix of what a larger one keeps.
    """
    each = channels * _FEATURE_TYPES[precision].itemsize
    fixed = HEADER_BYTES + TOKENS_BYTES + (channels if precision == "int8" else 0)
    if channels < 1 or channels > 65535 or fixed + each + 5 > mtu:
        raise WireError(
            f"One cell of {channels} channels as {precision} does not fit a packet of {mtu} bytes; lower the precision."
        )
    widest = int(codec.varint_sizes(key.max())) if len(key) else 0
    counts: list[int] = []
    at, left = 0, budget_bytes
    while at < len(key):
        room = max(0, (mtu if left is None else min(mtu, left)) - fixed)
        most = min(len(key) - at, 65535)
        low, high = min(most, room // (each + widest)), min(most, room // each)
        while low < high:
            middle = (low + high + 1) // 2
            size = middle * each + codec.cells_size(np.sort(key[at : at + middle]))
            low, high = (middle, high) if size <= room else (low, middle - 1)
        if low == 0:
            break
        counts.append(low)
        if left is not None:
            left -= fixed + low * each + codec.cells_size(np.sort(key[at : at + low]))
        at += low
    return counts


def _grid_fields(grid: BevGrid) -> tuple[int, ...]:
    """The grid as the integers of the format; a grid that they do not name exactly is a WireError."""
    ends = (grid.x_min, grid.y_min, grid.z_min, grid.x_max, grid.y_max, grid.z_max)
    fields = (*(round(v * 100) for v in ends), round(grid.pillar * 1000), grid.stride)
    rows, columns = grid.shape
    if (
        any(abs(v) > 32767 for v in fields[:6])
        or fields[6] > 65535
        or _grid(fields) != grid
        or rows * columns > _MOST_CELLS
    ):
        raise WireError(
            "A grid is sent in whole centimetres within 327.67 m, a pillar in whole millimetres, at most 2^24 cells; "
            f"got {grid}."
        )
    return fields


def _grid(fields: tuple[int, ...]) -> BevGrid:
    # A correctly rounded quotient gives back the very float that 140.8 is in the source of both sides.
    return BevGrid(*(v / 100 for v in fields[:6]), pillar=fields[6] / 1000, stride=fields[7])


def _token_bodies(tokens: SparseBev, score: Tensor | None, precision: Precision, mtu: int) -> list[bytes]:
    """The bodies of the tokens packets, the cells of highest score in the first."""
    order = token_order(tokens, score)
    key = tokens.sites.key.cpu().numpy()[order]
    features = tokens.features.detach().float().cpu().numpy()[order]
    largest = 65504 if precision == "float16" else np.inf
    if features.size and not (np.isfinite(features).all() and np.abs(features).max() <= largest):
        raise WireError(f"Features sent as {precision} must be finite and at most {largest:g}; these are not.")
    grid, channels = _grid_fields(tokens.grid), features.shape[1]
    if precision == "float16":
        features = features.astype("<f2")
    bodies, at = [], 0
    for count in packet_counts(key, channels, precision, mtu) or [0]:
        rows = slice(at, at + count)
        inner = np.argsort(key[rows])
        layout, cells = codec.pack_cells(key[rows][inner])
        values, scales = features[rows][inner], b""
        if precision == "int8":
            codes, values = codec.quantise_int8(values)
            scales = codes.tobytes()
        form = PRECISIONS.index(precision) | layout << 2
        head = _GRID.pack(*grid, form, channels, count)
        bodies.append(head + cells + scales + values.astype(_FEATURE_TYPES[precision], copy=False).tobytes())
        at += count
    return bodies


def decode_packet(packet: bytes) -> Fragment:
    """One packet, checked from its first to its last byte; every fault is a :class:`PacketError` with a reason."""
    packet = bytes(packet)
    if len(packet) < 3 or packet[:2] != _MAGIC:
        raise PacketError("garbage", f"Not a manyeyes packet: expected the bytes {_MAGIC!r}, got {packet[:2]!r}.")
    if packet[2] != VERSION:
        raise PacketError(
            "version", f"Wire version {packet[2]} is not known here; expected {VERSION}: update the older side."
        )
    if len(packet) < HEADER_BYTES:
        raise PacketError("garbage", f"Truncated packet: {len(packet)} bytes, a header alone has {HEADER_BYTES}.")
    _, _, flags, length, number, count, agent_id, timestamp_ns, *rest = _HEADER.unpack_from(packet)
    if length != len(packet):
        raise PacketError("garbage", f"Truncated or padded packet: it announces {length} bytes and has {len(packet)}.")
    checksum = zlib.crc32(memoryview(packet)[: -_CRC.size])
    if _CRC.unpack_from(packet, length - _CRC.size)[0] != checksum:
        raise PacketError(
            "checksum", f"The checksum of a packet said to be of agent {agent_id} does not match its bytes."
        )
    if flags >> 5 or number >= count:
        raise PacketError("garbage", f"Contradictory header: flags {flags:#04x}, packet {number} of {count}.")
    pose = (*rest[:3], *_quaternion(flags >> 3 & 3, rest[3:6]))
    factor = tuple(rest[6:12])
    if not all(abs(v) <= _FARTHEST_M for v in pose[:3]) or not np.isfinite(factor).all():
        raise PacketError("implausible", f"Agent {agent_id} claims the position {pose[:3]} with the errors {factor}.")
    header = Header(agent_id, timestamp_ns, count, bool(flags & 4), rest[12], pose, factor)
    return Fragment(header, number, _body(flags & 3, packet[_HEADER.size : -_CRC.size]), packet)


def _quaternion(largest: int, codes: list[int]) -> list[float]:
    parts = [v / float(_QUATERNION_UNIT) for v in codes]
    rest = 1 - sum(v * v for v in parts)
    # The part left out is the largest: at least 1/2, up to rounding.
    if rest < 0.25 - 1e-6:
        raise PacketError("implausible", f"The rotation in the header is not one: parts {parts}.")
    parts.insert(largest, rest**0.5)
    return parts


def _body(kind: int, body: bytes) -> TokenRows | ObjectRows | PointRows | None:
    if kind == _TOKENS:
        try:
            return _read_tokens(body)
        except PacketError:
            raise
        except WireError as error:
            raise PacketError("garbage", str(error)) from error
    if kind == _NONE:
        if body:
            raise PacketError("garbage", f"A packet without a section has {len(body)} bytes of body.")
        return None
    dtype = _OBJECT if kind == _OBJECTS else _POINT
    if len(body) % dtype.itemsize:
        raise PacketError("garbage", f"Rows of {dtype.itemsize} bytes do not fill a body of {len(body)}.")
    rows = np.frombuffer(body, dtype)
    if kind == _POINTS:
        return PointRows(rows)
    good = (rows["label_flip"] & 7 < len(LABELS)) & (rows["size"] > 0).all(-1)
    good &= (rows["yaw"] >= -18000) & (rows["yaw"] < 18000)
    if not good.all():
        raise PacketError(
            "implausible", f"{int((~good).sum())} objects have an unknown label, no size, or a yaw over 180°."
        )
    return ObjectRows(rows)


def _read_tokens(body: bytes) -> TokenRows:
    if len(body) < _GRID.size:
        raise PacketError("garbage", f"A tokens body begins with {_GRID.size} bytes; got {len(body)}.")
    *fields, form, channels, count = _GRID.unpack_from(body)
    if form >> 3 or form & 3 >= len(PRECISIONS) or not channels:
        raise PacketError("garbage", f"Unknown form of tokens: {form:#04x}, {channels} channels.")
    try:
        grid = _grid(tuple(fields))
    except ConfigError as error:
        raise PacketError("implausible", str(error)) from error
    rows, columns = grid.shape
    key, used = codec.unpack_cells(form >> 2, body[_GRID.size :], count)
    if rows * columns > _MOST_CELLS or (count and int(key[-1]) >= rows * columns):
        raise PacketError(
            "implausible", f"Cells lie outside a grid of {rows} rows and {columns} columns (or it is huge)."
        )
    precision, at = PRECISIONS[form & 3], _GRID.size + used
    scale_bytes = channels if precision == "int8" else 0
    dtype = _FEATURE_TYPES[precision]
    if len(body) != at + scale_bytes + count * channels * dtype.itemsize:
        raise PacketError(
            "garbage", f"{count} cells of {channels} channels as {precision} do not fill {len(body)} bytes."
        )
    values = np.frombuffer(body, dtype, offset=at + scale_bytes).reshape(count, channels)
    if precision == "int8":
        features = codec.dequantise_int8(np.frombuffer(body, np.uint8, channels, at), values)
    else:
        features = values.astype(np.float32)
    if not np.isfinite(features).all():
        raise PacketError("implausible", "Features are NaN or infinite.")
    return TokenRows(grid, precision, key, features)


class Assembly:
    """The fragments of one message so far, checked against each other as they come."""

    def __init__(self, first: Fragment) -> None:
        self.header = first.header
        self.fragments: dict[int, Fragment] = {}
        self._form: tuple[BevGrid, Precision, int] | None = None
        self._cells: set[int] = set()
        self.add(first)

    def add(self, fragment: Fragment) -> bool:
        """True where the fragment is new, False where it is a copy; one that contradicts is refused (PacketError)."""
        head, held = self.header, self.fragments.get(fragment.number)
        if held is not None and held.packet == fragment.packet:
            return False
        name = f"packet {fragment.number} of agent {head.agent_id} at {head.timestamp_ns} ns"
        if fragment.header != head or held is not None:
            raise PacketError("contradiction", f"A second {name} differs from the first; both cannot be true.")
        if isinstance(fragment.body, TokenRows):
            form = (fragment.body.grid, fragment.body.precision, fragment.body.features.shape[1])
            cells = fragment.body.key.tolist()
            if (self._form or form) != form or not self._cells.isdisjoint(cells):
                raise PacketError("contradiction", f"The cells in {name} do not go with those of the other packets.")
            self._form = form
            self._cells.update(cells)
        self.fragments[fragment.number] = fragment
        return True

    def message(self) -> Message:
        """What has come so far, as a message; sections of which no packet came are None."""
        head = self.header
        bodies = [self.fragments[number].body for number in sorted(self.fragments)]
        factor = torch.zeros(3, 3, dtype=torch.float64)
        factor[tuple(torch.tril_indices(3, 3))] = torch.tensor(head.covariance_factor, dtype=torch.float64)
        return Message(
            agent_id=head.agent_id,
            timestamp_ns=head.timestamp_ns,
            world_from_agent=Transform(
                torch.tensor(_rotation(head.pose[3:]), dtype=torch.float64),
                torch.tensor(head.pose[:3], dtype=torch.float64),
            ),
            pose_covariance=factor @ factor.mT,
            fingerprint=head.fingerprint,
            is_infrastructure=head.is_infrastructure,
            tokens=_tokens([b for b in bodies if isinstance(b, TokenRows)]),
            objects=_boxes([b.rows for b in bodies if isinstance(b, ObjectRows)]),
            points=_cloud([b.rows for b in bodies if isinstance(b, PointRows)]),
        )


def assemble(fragments: Iterable[Fragment]) -> Message:
    """The fragments of one message, in any order, with or without copies and gaps, as that message."""
    assembly: Assembly | None = None
    for fragment in fragments:
        if assembly is None:
            assembly = Assembly(fragment)
        else:
            assembly.add(fragment)
    if assembly is None:
        raise WireError("A message is assembled from at least one fragment; got none.")
    return assembly.message()


def _tokens(parts: list[TokenRows]) -> SparseBev | None:
    if not parts:
        return None
    key = np.concatenate([p.key for p in parts])
    order = np.argsort(key)
    features = np.concatenate([p.features for p in parts])[order]
    return SparseBev(torch.from_numpy(features), Sites(torch.from_numpy(key[order]), parts[0].grid))


def _boxes(parts: list[NDArray[Any]]) -> Boxes | None:
    if not parts:
        return None
    rows = np.concatenate(parts)
    label = torch.from_numpy((rows["label_flip"] & 7).astype(np.int64))
    height = torch.tensor(LABEL_HEIGHTS)[label]
    ids = rows["id"].astype(np.int64)
    return Boxes(
        center=torch.cat((torch.from_numpy(rows["xy"].astype(np.float32) / 100), height[:, None] / 2), -1),
        size=torch.cat((torch.from_numpy(rows["size"].astype(np.float32) / 10), height[:, None]), -1),
        yaw=torch.from_numpy(np.deg2rad(rows["yaw"] / 100).astype(np.float32)),
        score=torch.from_numpy(rows["score"].astype(np.float32) / 255),
        label=label,
        id=torch.from_numpy(np.where(ids == 255, -1, ids)),
        sigma_xy=torch.from_numpy(codec.log_values(rows["sigma_xy"], *_SIGMA_XY)),
        sigma_yaw=torch.from_numpy(codec.log_values(rows["sigma_yaw"], *_SIGMA_YAW)),
        flip=torch.from_numpy((rows["label_flip"] >> 3).astype(np.float32) / 31),
    )


def _cloud(parts: list[NDArray[Any]]) -> PointCloud | None:
    if not parts:
        return None
    # Packet k of K holds points k, k + K, …: sorting by place within the packet restores the order.
    place = np.concatenate([np.arange(len(p)) for p in parts])
    rows = np.concatenate(parts)[np.argsort(place, kind="stable")]
    xyz = torch.from_numpy(rows["xyz"].astype(np.float32) / 100)
    return PointCloud.of(xyz, torch.from_numpy(rows["intensity"].astype(np.float32) / 255))
