# SPDX-License-Identifier: Apache-2.0
"""Hostile packets with valid checksums, made of bytes by the layout in ``comms.wire``; a seed fixes all of them.

``extremes``: every field of a packet at its extreme values. ``mutate``: random bytes, cuts, and extremes, with a repaired checksum.
``ATTACKS``: named messages of one or several senders against a receiver, each made from the packets of an honest sender.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

NONE, TOKENS, OBJECTS, POINTS, REQUEST, ELEMENTS, SIGHT = range(7)
FLOAT32, FLOAT16, INT8, CODES = range(4)
GAPS, BITMAP, CODED = range(3)
SECOND_NS = 1_000_000_000
HOUR_NS = 3600 * SECOND_NS
BODY_OFFSET, GRID_BYTES = 64, 15
HOSTILE_ID = 66
SCALE_OF_1 = 129
NUM_SECTORS = 180

_HEADER = struct.Struct("<2sBBHHiq6s6s6s3i3B3b8s")
_TOKEN_FORM = struct.Struct("<BHH")
_FLOAT_TYPES = {FLOAT32: "<f4", FLOAT16: "<f2"}


def seal(content: bytes) -> bytes:
    """Return the content of a packet with its checksum."""
    return content + struct.pack("<I", zlib.crc32(content))


def kind_of(packet: bytes) -> int:
    """Return the kind of a packet's body."""
    return packet[3] & 7


@dataclass(frozen=True)
class Header:
    """All fields of a header, as they stand in a packet, apart from the kind of body. position: x, y, z in 2^-20 m. version: of the
    format of the body; crafted ones are of the oldest.
    """

    agent_id: int
    time_ns: int
    position: tuple[int, int, int]
    rotation: tuple[int, int, int]
    sigma: tuple[int, int, int]
    correlation: tuple[int, int, int]
    fingerprint: bytes
    flags: int = 0
    number: int = 0
    count: int = 1
    version: int = 2

    @classmethod
    def read(cls, packet: bytes) -> Header:
        """Return the header of a packet."""
        _, _, flags, number, count, agent_id, time_ns, x, y, z, *rest = _HEADER.unpack_from(packet)
        position = [int.from_bytes(part, "little", signed=True) for part in (x, y, z)]
        return cls(
            agent_id,
            time_ns,
            (position[0], position[1], position[2]),
            tuple(rest[:3]),
            tuple(rest[3:6]),
            tuple(rest[6:9]),
            rest[9],
            flags & ~7,
            number,
            count,
        )

    def packet(self, kind: int, body: bytes = b"") -> bytes:
        """Return a whole packet with this header."""
        place = [v.to_bytes(6, "little", signed=True) for v in self.position]
        values = (*place, *self.rotation, *self.sigma, *self.correlation, self.fingerprint)
        flags = self.flags | kind
        head = _HEADER.pack(b"ME", self.version, flags, self.number, self.count, self.agent_id, self.time_ns, *values)
        return seal(head + body)

    def message(self, bodies: Sequence[tuple[int, bytes]]) -> list[bytes]:
        """Return the packets of one message with bodies of those kinds."""
        return [replace(self, number=n, count=len(bodies)).packet(kind, body) for n, (kind, body) in enumerate(bodies)]


@dataclass(frozen=True)
class Template:
    """Packets of an honest sender to the same receiver, and what hostile ones copy of them.

    header: of the hostile sender, which stands beside the honest one. grid: the first bytes of a tokens body; channels: C of it.
    """

    packets: tuple[bytes, ...]
    header: Header
    grid: bytes
    channels: int

    @classmethod
    def of(cls, packets: Sequence[bytes], agent_id: int = HOSTILE_ID) -> Template:
        """Return the template of one honest message; a message without tokens gives the grid of COSTR_TINY's tokens."""
        header = replace(Header.read(packets[0]), agent_id=agent_id, number=0, count=1)
        tokens = next((p for p in packets if kind_of(p) == TOKENS), None)
        if tokens is None:
            return cls(tuple(packets), header, struct.pack("<6hHB", -2560, -2560, -300, 2560, 2560, 500, 400, 4), 52)
        grid, (_, channels, _) = tokens[BODY_OFFSET:][:GRID_BYTES], _TOKEN_FORM.unpack_from(tokens, BODY_OFFSET + 15)
        return cls(tuple(packets), header, grid, channels)

    @property
    def victim_id(self) -> int:
        """The honest sender."""
        return Header.read(self.packets[0]).agent_id

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        x0, y0, _, x1, y1, _, pillar, stride = struct.unpack("<6hHB", self.grid)
        cell = pillar * stride / 10
        return round((y1 - y0) / cell), round((x1 - x0) / cell)


# Bodies.


def token_body(
    grid: bytes, values: np.ndarray, encoding: int = FLOAT32, first_key: int = 0, scale: int = SCALE_OF_1
) -> bytes:
    """Return tokens of a grid, one cell for each row of values (N, C), from a key on: gaps of 0. scale: code of int8 values."""
    count, channels = values.shape
    gaps = _varint(first_key) + bytes(count - 1) if count else b""
    scales = bytes([scale]) * channels if encoding == INT8 else b""
    data = values.astype(_FLOAT_TYPES.get(encoding, "i1")).tobytes()
    return grid + _TOKEN_FORM.pack(encoding, channels, count) + gaps + scales + data


def _varint(value: int) -> bytes:
    out = bytearray()
    while value >> 7:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


OBJECT_ROW = struct.Struct("<3h7B")


def object_body(xy_m: np.ndarray, score: int = 255, yaw: int = 0, size: tuple[int, int] = (45, 19)) -> bytes:
    """Return objects at places (N, 2) in the sender's frame."""
    codes = np.clip(np.rint(xy_m * 100), -32768, 32767).astype(int).tolist()
    return b"\0" + b"".join(OBJECT_ROW.pack(x, y, yaw, *size, score, 1, 1, 0, 255) for x, y in codes)


def point_body(xyz_m: np.ndarray, intensity: int = 255) -> bytes:
    """Return points (N, 3)."""
    rows = np.zeros(len(xyz_m), [("xyz", "<i2", 3), ("intensity", "u1")])
    rows["xyz"], rows["intensity"] = np.clip(np.rint(xyz_m * 100), -32768, 32767), intensity
    return rows.tobytes()


def line_bytes(units: Sequence[tuple[int, int]]) -> bytes:
    """Return a line of whole units of 2 cm."""
    out, before = _varint(len(units)), (0, 0)
    for x, y in units:
        for step in (x - before[0], y - before[1]):
            out += _varint((step << 1 ^ step >> 63) & (1 << 35) - 1)
        before = x, y
    return out


def map_body(elements: Sequence[tuple[bytes, bytes]], rings: Sequence[bytes] = ()) -> bytes:
    """Return map elements, each of three bytes and a line. rings: view and occluders; without any, a view of 40 m."""
    view = line_bytes([(0, -1000), (2000, -1000), (2000, 1000), (0, 1000)])
    rings = rings or (view,)
    return bytes([len(rings)]) + b"".join(rings) + b"".join(head + line for head, line in elements)


# Every field at its extremes.


@dataclass(frozen=True)
class Field:
    """Bytes of a packet and the integer type that they hold."""

    name: str
    offset: int
    code: str

    def values(self) -> list[bytes]:
        """Return the extremes of the type, zero, ones and a number of the middle."""
        size = 6 if self.code == "i48" else struct.calcsize(self.code)
        bits, signed = 8 * size, self.code[-1].islower() or self.code == "i48"
        low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
        chosen = dict.fromkeys((low, low + 1, 0, 1, high // 2, high - 1, high, -1 if signed else 2))
        return [value.to_bytes(size, "little", signed=signed) for value in chosen]


HEADER_FIELDS = (
    Field("version", 2, "B"),
    Field("flags", 3, "B"),
    Field("number", 4, "H"),
    Field("count", 6, "H"),
    Field("agent id", 8, "i"),
    Field("time", 12, "q"),
    *(Field(f"position {axis}", 20 + 6 * n, "i48") for n, axis in enumerate("xyz")),
    *(Field(f"rotation {n}", 38 + 4 * n, "i") for n in range(3)),
    *(Field(f"sigma {n}", 50 + n, "B") for n in range(3)),
    *(Field(f"correlation {n}", 53 + n, "b") for n in range(3)),
    Field("fingerprint", 56, "Q"),
)
_GRID_FIELDS = tuple(
    Field(name, BODY_OFFSET + at, code)
    for name, at, code in (
        *((f"grid {name}", 2 * n, "h") for n, name in enumerate(("x0", "y0", "z0", "x1", "y1", "z1"))),
        ("pillar", 12, "H"),
        ("stride", 14, "B"),
    )
)
_TOKEN_FIELDS = (
    Field("encoding", BODY_OFFSET + 15, "B"),
    Field("channels", BODY_OFFSET + 16, "H"),
    Field("cells", BODY_OFFSET + 18, "H"),
    Field("first cells", BODY_OFFSET + 20, "I"),
)
_OBJECT_FIELDS = tuple(
    Field(f"object {name}", BODY_OFFSET + 1 + at, code)
    for name, at, code in (
        ("x", 0, "h"),
        ("y", 2, "h"),
        ("yaw", 4, "h"),
        ("length", 6, "B"),
        ("width", 7, "B"),
        ("score", 8, "H"),
        *((name, 10 + n, "B") for n, name in enumerate(("sigma xy", "sigma yaw", "label", "id"))),
        ("velocity x", 14, "b"),
        ("velocity y", 15, "b"),
        ("descriptor", 16, "b"),
    )
)  # fmt: skip
_POINT_FIELDS = (*(Field(f"point {axis}", BODY_OFFSET + 2 * n, "h") for n, axis in enumerate("xyz")),)
_ELEMENT_FIELDS = (Field("rings", BODY_OFFSET, "B"), *(Field(f"ring {n}", BODY_OFFSET + 1 + n, "I") for n in range(4)))
BODY_FIELDS = {
    NONE: (),
    TOKENS: (*_GRID_FIELDS, *_TOKEN_FIELDS),
    OBJECTS: (Field("object flags", BODY_OFFSET, "B"), *_OBJECT_FIELDS),
    POINTS: (*_POINT_FIELDS, Field("intensity", BODY_OFFSET + 6, "B")),
    REQUEST: (*_GRID_FIELDS, Field("confidence", BODY_OFFSET + 15, "Q")),
    ELEMENTS: _ELEMENT_FIELDS,
    SIGHT: tuple(Field(f"sector {k}", BODY_OFFSET + k, "B") for k in (0, NUM_SECTORS - 1)),
}


def extremes(packet: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield a packet with each of its fields at each extreme, and with its whole body of one byte, by the name of the field."""
    content, kind = packet[:-4], kind_of(packet)
    for field in (*HEADER_FIELDS, *BODY_FIELDS.get(kind, ())):
        for value in field.values():
            if field.offset + len(value) <= len(content):
                changed = content[: field.offset] + value + content[field.offset + len(value) :]
                yield field.name, seal(changed)
    start = BODY_OFFSET + {TOKENS: 20, OBJECTS: 1, REQUEST: 15}.get(kind, 0)
    for byte in (0, 1, 0x7F, 0x80, 0xFE, 0xFF):
        yield f"body of {byte:#04x}", seal(content[:start] + bytes([byte]) * (len(content) - start))


def mutate(packets: Sequence[bytes], random: np.random.Generator) -> bytes:
    """Return one of the packets changed at random, with a repaired checksum; often of another sender, so that it is read at all."""
    packet = packets[int(random.integers(len(packets)))]
    content, way = bytearray(packet[:-4]), int(random.integers(8))
    if random.random() < 0.7:
        content[8:12] = struct.pack("<i", int(random.integers(2, 40)))
    fields = (*HEADER_FIELDS, *BODY_FIELDS.get(kind_of(packet), ()))
    if way < 4:
        for at in random.integers(0 if way == 0 else 20, len(content), int(random.integers(1, 9))):
            content[at] = random.integers(256)
    elif way < 6:
        for index in random.integers(len(fields), size=int(random.integers(1, 4))):
            values = fields[index].values()
            value = values[int(random.integers(len(values)))]
            if fields[index].offset + len(value) <= len(content):
                content[fields[index].offset : fields[index].offset + len(value)] = value
    elif way == 6:
        at = int(random.integers(BODY_OFFSET, len(content) + 1))
        content = content[:at] + (bytes(random.integers(0, 256, 16, np.uint8)) if random.random() < 0.5 else b"")
    else:
        other = packets[int(random.integers(len(packets)))]
        content = content[:BODY_OFFSET] + other[BODY_OFFSET:-4]
        content[3] = content[3] & ~7 | int(random.choice((kind_of(packet), kind_of(other))))
    return seal(bytes(content))


# Named attacks. Each is a function of a template and of the receiver's time.

Attack = Callable[[Template, int], list[bytes]]
ATTACKS: dict[str, Attack] = {}


def _attack(name: str) -> Callable[[Attack], Attack]:
    def register(attack: Attack) -> Attack:
        ATTACKS[name] = attack
        return attack

    return register


def attack_packets(name: str, honest: Sequence[bytes], now_ns: int) -> list[bytes]:
    """Return the packets of an attack in the order of their arrival. honest: of the sender whose header and grid are copied."""
    return ATTACKS[name](Template.of(honest), now_ns)


def _rows(count: int, x_m: float, y_m: float) -> np.ndarray:
    """Return places (count, 2) 4 m apart, from one on."""
    index = np.arange(count)
    return np.stack((x_m + 4.0 * (index % 40), y_m + 4.0 * (index // 40)), 1)


@_attack("1,000 boxes a packet beyond 150 m")
def _far_boxes(template: Template, now_ns: int) -> list[bytes]:
    return template.header.message([(OBJECTS, object_body(_rows(1000, 150.0 + k, 0.3 * k))) for k in range(10)])


@_attack("1,000 boxes a sender beyond 150 m")
def _far_boxes_of_ten(template: Template, now_ns: int) -> list[bytes]:
    bodies = [object_body(_rows(1000, 150.0 + k, 0.3 * k)) for k in range(10)]
    return [replace(template.header, agent_id=HOSTILE_ID + k).packet(OBJECTS, body) for k, body in enumerate(bodies)]


@_attack("1,000 boxes around the ego")
def _near_boxes(template: Template, now_ns: int) -> list[bytes]:
    return template.header.message([(OBJECTS, object_body(_rows(1000, -80.0 + k, -50.0))) for k in range(10)])


@_attack("boxes of full size at one place")
def _boxes_at_one_place(template: Template, now_ns: int) -> list[bytes]:
    return template.header.message([(OBJECTS, object_body(np.zeros((1000, 2)), size=(255, 255)))])


@_attack("empty message 1 ns later")
def _empty_later(template: Template, now_ns: int) -> list[bytes]:
    head = replace(template.header, agent_id=template.victim_id)
    return [replace(head, time_ns=head.time_ns + 1).packet(NONE)]


@_attack("empty message 0.999 s later")
def _empty_much_later(template: Template, now_ns: int) -> list[bytes]:
    head = replace(template.header, agent_id=template.victim_id)
    return [replace(head, time_ns=head.time_ns + 999_000_000).packet(NONE)]


@_attack("64 invented ids 0.999 s ahead")
def _invented_ids(template: Template, now_ns: int) -> list[bytes]:
    head = replace(template.header, time_ns=now_ns + 999_000_000)
    return [replace(head, agent_id=100 + k).packet(NONE) for k in range(64)]


@_attack("64 invented ids")
def _invented_ids_now(template: Template, now_ns: int) -> list[bytes]:
    return [replace(template.header, agent_id=100 + k, time_ns=now_ns).packet(NONE) for k in range(64)]


@_attack("0.9 s ahead")
def _ahead(template: Template, now_ns: int) -> list[bytes]:
    return _resent(template, time_ns=now_ns + 900_000_000)


@_attack("an hour old")
def _old(template: Template, now_ns: int) -> list[bytes]:
    return _resent(template, time_ns=now_ns - HOUR_NS)


@_attack("earliest time")
def _earliest(template: Template, now_ns: int) -> list[bytes]:
    return _resent(template, time_ns=-(1 << 63))


@_attack("latest time")
def _latest(template: Template, now_ns: int) -> list[bytes]:
    return _resent(template, time_ns=(1 << 63) - 1)


def _few_objects() -> tuple[int, bytes]:
    """Return a plausible body: three boxes."""
    return OBJECTS, object_body(np.array([(12.0, 3.0), (25.0, -4.0), (40.0, 3.5)]))


def _resent(template: Template, **fields: object) -> list[bytes]:
    """Return the honest packets as of the hostile sender, with other fields in their headers."""
    head = replace(template.header, count=len(template.packets), **fields)
    return [
        replace(head, number=n, version=packet[2]).packet(kind_of(packet), packet[BODY_OFFSET:-4])
        for n, packet in enumerate(template.packets)
    ]


@_attack("height of 1e6 m")
def _high(template: Template, now_ns: int) -> list[bytes]:
    x, y, _ = template.header.position
    return _resent(template, position=(x, y, 10**6 << 20))


@_attack("position of 1e8 m")
def _far(template: Template, now_ns: int) -> list[bytes]:
    return _resent(template, position=(10**8 << 20, -(10**8) << 20, 0))


@_attack("upside down")
def _upside_down(template: Template, now_ns: int) -> list[bytes]:
    # x is the part left out, the other three are 0: half a turn about x.
    return _resent(template, rotation=(0, 0, 0), flags=template.header.flags & ~0x30 | 0x10)


@_attack("displaced by 3 m")
def _displaced(template: Template, now_ns: int) -> list[bytes]:
    x, y, z = template.header.position
    return _resent(template, position=(x + (3 << 20), y, z))


@_attack("largest covariance")
def _uncertain(template: Template, now_ns: int) -> list[bytes]:
    return _resent(template, sigma=(255, 255, 255), correlation=(127, 127, 127))


@_attack("largest covariance at 1e8 m")
def _uncertain_and_far(template: Template, now_ns: int) -> list[bytes]:
    return _resent(template, position=(10**8 << 20, 0, 0), sigma=(255, 255, 255))


def _features(value: float, encoding: int = FLOAT32, scale: int = SCALE_OF_1) -> Attack:
    def attack(template: Template, now_ns: int) -> list[bytes]:
        values = np.full((32, template.channels), value)
        return template.header.message([(TOKENS, token_body(template.grid, values, encoding, 100, scale))])

    return attack


for _value in (1e20, -1e20, 3e38, -3e38, 6e4, -6e4, 32.0, -32.0):
    ATTACKS[f"features of {_value:g}"] = _features(_value)
for _value in (6e4, -6e4):
    ATTACKS[f"float16 features of {_value:g}"] = _features(_value, FLOAT16)
ATTACKS["int8 features of the largest scale"] = _features(127, INT8, 255)


@_attack("one channel")
def _one_channel(template: Template, now_ns: int) -> list[bytes]:
    return template.header.message([(TOKENS, token_body(template.grid, np.full((3, 1), 0.5)))])


@_attack("a channel too many")
def _another_channel(template: Template, now_ns: int) -> list[bytes]:
    return template.header.message([(TOKENS, token_body(template.grid, np.ones((3, template.channels + 1))))])


@_attack("another grid")
def _another_grid(template: Template, now_ns: int) -> list[bytes]:
    grid = template.grid[:12] + struct.pack("<H", 500) + template.grid[14:]
    return template.header.message([(TOKENS, token_body(grid, np.ones((3, template.channels))))])


@_attack("another stride")
def _another_stride(template: Template, now_ns: int) -> list[bytes]:
    return template.header.message(
        [(TOKENS, token_body(template.grid[:14] + b"\x10", np.ones((3, template.channels))))]
    )


@_attack("one packet of 200 MB")
def _one_long_packet(template: Template, now_ns: int) -> list[bytes]:
    return [template.header.packet(POINTS, bytes(7 * (200_000_000 // 7)))]


@_attack("4.1 MB of cells")
def _many_cells(template: Template, now_ns: int) -> list[bytes]:
    """Cells of one byte, gaps of 0, on a grid of 2^24 cells; each packet holds other ones."""
    grid = struct.pack("<6hHB", -20480, -20480, -300, 20480, 20480, 500, 100, 1)
    bodies = [
        (TOKENS, token_body(grid, np.zeros((65535, 1)), INT8, first_key=65535 * k)) for k in range(4_100_000 // 131_100)
    ]
    return template.header.message(bodies)


def _all_cells(senders: int) -> Attack:
    def attack(template: Template, now_ns: int) -> list[bytes]:
        rows, columns = template.shape
        values, each = np.full((rows * columns, template.channels), 64), max(1, 60_000 // template.channels)
        bodies = [
            (TOKENS, token_body(template.grid, values[at : at + each], INT8, at))
            for at in range(0, rows * columns, each)
        ]
        heads = [replace(template.header, agent_id=HOSTILE_ID + k) for k in range(senders)]
        return [packet for head in heads for packet in head.message(bodies)]

    return attack


for _senders in (1, 8, 32):
    ATTACKS[f"all cells by {_senders}"] = _all_cells(_senders)


@_attack("200,000 points at one place")
def _points_at_one_place(template: Template, now_ns: int) -> list[bytes]:
    body = point_body(np.full((9_000, 3), 1.0))
    return template.header.message([(POINTS, body)] * 22)


@_attack("points at the extremes")
def _points_at_extremes(template: Template, now_ns: int) -> list[bytes]:
    corners = np.array([(x, y, z) for x in (-327.68, 327.67) for y in (-327.68, 327.67) for z in (-327.68, 327.67)])
    return template.header.message([(POINTS, point_body(np.repeat(corners, 100, 0)))])


@_attack("largest request map")
def _large_request(template: Template, now_ns: int) -> list[bytes]:
    grid = struct.pack("<6hHB", -20480, -20480, -300, 20480, 20480, 500, 100, 1)
    return template.header.message([_few_objects(), (REQUEST, grid + b"\xff" * (1 << 24))])


@_attack("objects with descriptors at their extremes")
def _descriptors(template: Template, now_ns: int) -> list[bytes]:
    rows = b"".join(
        OBJECT_ROW.pack(400 * k, 0, 17999, 255, 255, 255, 255, 255, 0xFB, 254) + struct.pack("<2b", 127, -127) + fill
        for k, fill in enumerate((b"\x7f" * 32, b"\x81" * 32, bytes(32)))
    )
    return template.header.message([(OBJECTS, b"\x03" + rows)])


def _sight(*bodies: bytes, metres: tuple[int, int, int] = (3, 0, 0), **fields: object) -> Attack:
    """Return the attack of a message of sights alone, as of a place some metres from the honest sender. fields: of the header."""

    def attack(template: Template, now_ns: int) -> list[bytes]:
        x, y, z = (at + (step << 20) for at, step in zip(template.header.position, metres))
        return replace(template.header, position=(x, y, z), **fields).message([(SIGHT, body) for body in bodies])

    return attack


_ALL_FREE, _NAN = b"\xff" * NUM_SECTORS, struct.pack("<f", math.nan)
ATTACKS["sight of the largest ranges"] = _sight(_ALL_FREE)
ATTACKS["sight of nothing"] = _sight(bytes(NUM_SECTORS))
ATTACKS["sight of NaN as float32"] = _sight(_NAN * (NUM_SECTORS // 4))
ATTACKS["sight of NaN, a float32 a sector"] = _sight(_NAN * NUM_SECTORS)
ATTACKS["sight of a sector too few"] = _sight(_ALL_FREE[1:])
ATTACKS["sight of a sector too many"] = _sight(_ALL_FREE + b"\xff")
ATTACKS["sight of 60,000 sectors"] = _sight(b"\xff" * 60_000)
ATTACKS["sight cut in the middle"] = _sight(_ALL_FREE[: NUM_SECTORS // 2])
ATTACKS["sight without a body"] = _sight(b"")
ATTACKS["two sights in a message"] = _sight(bytes(NUM_SECTORS), _ALL_FREE)
ATTACKS["sight of the largest covariance"] = _sight(_ALL_FREE, sigma=(255, 255, 255))
ATTACKS["sight at 1e8 m"] = _sight(_ALL_FREE, metres=(10**8, -(10**8), 0))
ATTACKS["sight from 900 m away"] = _sight(_ALL_FREE, metres=(900, 0, 0))
ATTACKS["sight from 40 m above"] = _sight(_ALL_FREE, metres=(3, 0, 40))


@_attack("sight of a sender upside down")
def _sight_upside_down(template: Template, now_ns: int) -> list[bytes]:
    return _sight(_ALL_FREE, rotation=(0, 0, 0), flags=template.header.flags & ~0x30 | 0x10)(template, now_ns)


@_attack("sights of 100 senders")
def _many_sights(template: Template, now_ns: int) -> list[bytes]:
    return [p for k in range(100) for p in _sight(_ALL_FREE, metres=(3, 3 * k, 0), agent_id=100 + k)(template, now_ns)]


@_attack("10,000 map elements")
def _map_elements(template: Template, now_ns: int) -> list[bytes]:
    element = (b"\xff\xff\xff", line_bytes([(-16383, -16383), (16383, 16383)]))
    return template.header.message([(ELEMENTS, map_body([element] * 5000))] * 2)


@_attack("map line of 20,000 points")
def _map_line(template: Template, now_ns: int) -> list[bytes]:
    line = line_bytes([(n % 2, n % 3 - 1) for n in range(20_000)])
    return template.header.message([(ELEMENTS, map_body([(b"\0\xff\0", line)]))])


@_attack("32 rings of a map")
def _map_rings(template: Template, now_ns: int) -> list[bytes]:
    ring = line_bytes([(-16383, -16383), (16383, -16383), (16383, 16383), (-16383, 16383)])
    return template.header.message([(ELEMENTS, map_body([], [ring] * 32))])


@_attack("65,535 packets announced")
def _many_announced(template: Template, now_ns: int) -> list[bytes]:
    head = replace(template.header, count=65535, number=65534)
    return [head.packet(*_few_objects())]


@_attack("5,000 empty packets")
def _many_empty(template: Template, now_ns: int) -> list[bytes]:
    return template.header.message([(OBJECTS, b"\0")] * 5000)


@_attack("stamps going back")
def _backwards(template: Template, now_ns: int) -> list[bytes]:
    return [packet for k in range(20) for packet in _resent(template, time_ns=template.header.time_ns - 20_000_000 * k)]


@_attack("another message each nanosecond")
def _every_nanosecond(template: Template, now_ns: int) -> list[bytes]:
    return [packet for k in range(50) for packet in _resent(template, time_ns=template.header.time_ns + k)]
