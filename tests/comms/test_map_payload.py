# SPDX-License-Identifier: Apache-2.0
"""Map elements on the wire: round trips, packets that each decode alone, sizes, and every kind of damage."""

import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from manyeyes.comms import map_payload as elements, wire
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.primitives import PacketError
from manyeyes.datatypes import Boxes, Message, ShapeError, Transform, WireError
from manyeyes.datatypes.map_element import CROSSING, DASHED, DIVIDER, KINDS, STYLES, MapElements, Polygons
from manyeyes.datatypes.message import LocalMap

VIEW = np.array([[0.0, -15.0], [30.0, -15.0], [30.0, 15.0], [0.0, 15.0]])
HALF_A_UNIT = elements.UNIT_M / 2 + 1e-9


def message(local_map: LocalMap | None, **fields) -> Message:
    pose = Transform.from_xyz_yaw(100.25, -200.5, 0.125, 1.0)
    return Message(7, 1_000, pose, torch.zeros(3, 3, dtype=torch.float64), local_map=local_map, **fields)


def random_map(seed: int, count: int) -> LocalMap:
    """Lines of 2 to 30 points, no two of them nearer than the unit, of every kind and style; rings are stars about a point."""
    rng = np.random.default_rng(seed)
    kind = rng.integers(len(KINDS), size=count)
    lines = []
    for k in kind.tolist():
        n = int(rng.integers(3 if k == CROSSING else 2, 30))
        if k == CROSSING:
            angle = np.arange(n) * 2 * np.pi / n
            lines.append(rng.uniform(-20, 20, 2) + rng.uniform(2, 5) * np.stack((np.cos(angle), np.sin(angle)), 1))
        else:
            lines.append(rng.uniform(-30, 30, 2) + np.cumsum(rng.uniform(0.05, 4.0, (n, 2)), 0))
    style = rng.dirichlet(np.ones(len(STYLES)), size=count)
    sigma = np.concatenate([np.full(len(line), rng.uniform(0.011, 19)) for line in lines]) if count else 0.1
    made = MapElements.of(lines, kind, rng.permutation(count) / max(count, 1), sigma, style)
    shadows = [VIEW[:3] * share for share in rng.uniform(0.1, 1.0, int(rng.integers(4)))]
    return LocalMap(made, VIEW, Polygons.of(shadows))


def through(sent: Message, **options) -> Message:
    return wire.assemble(wire.decode_packet(p) for p in wire.encode(sent, **options))


@given(st.integers(0, 10**6), st.integers(0, 120), st.integers(600, 3000))
def test_round_trip(seed, count, mtu):
    local_map = random_map(seed, count)
    packets = wire.encode(message(local_map), mtu=mtu)
    assert all(len(p) <= mtu for p in packets)
    back = wire.assemble(wire.decode_packet(p) for p in packets).local_map
    assert back is not None and len(back.elements) == count
    np.testing.assert_allclose(back.view, VIEW, atol=HALF_A_UNIT)
    assert len(back.occluders) == len(local_map.occluders)
    np.testing.assert_allclose(back.occluders.points, local_map.occluders.points, atol=HALF_A_UNIT)
    sent = local_map.elements.take(np.argsort(-local_map.elements.score, kind="stable"))
    np.testing.assert_array_equal(back.elements.kind, sent.kind)
    np.testing.assert_array_equal(back.elements.offsets, sent.offsets)
    np.testing.assert_allclose(back.elements.points, sent.points, atol=HALF_A_UNIT)
    np.testing.assert_allclose(back.elements.score, sent.score, atol=0.5 / 255 + 1e-9)
    np.testing.assert_allclose(np.log(back.elements.sigma / sent.sigma), 0, atol=np.log(2000) / 254 / 2 + 1e-6)
    likeliest = sent.style.argmax(1)
    np.testing.assert_array_equal(
        back.elements.style.argmax(1)[sent.style.max(1) > 0.3], likeliest[sent.style.max(1) > 0.3]
    )
    np.testing.assert_allclose(back.elements.style.max(1), sent.style.max(1), atol=0.025 + 1e-9)
    np.testing.assert_allclose(back.elements.style.sum(1), 1.0)


@given(st.integers(0, 10**6), st.integers(30, 120))
def test_each_packet_decodes_independently_to_whole_elements(seed, count):
    local_map = random_map(seed, count)
    packets = wire.encode(message(local_map), mtu=700)
    assert len(packets) > 1
    parts = [wire.assemble([wire.decode_packet(p)]).local_map for p in packets]
    whole = wire.assemble(wire.decode_packet(p) for p in packets[::-1]).local_map
    assert whole is not None
    kept = MapElements.cat([part.elements for part in parts if part is not None])
    np.testing.assert_array_equal(kept.points, whole.elements.points)
    assert all(part is not None and np.array_equal(part.view, whole.view) for part in parts)
    assert (np.diff(whole.elements.score) <= 0).all(), "the likeliest are in the first packet"


def test_a_street_costs_few_bytes():
    lines = [np.array([[0.0, y], [15.0, y + 0.1], [30.0, y + 0.5]]) for y in (-7.0, -3.5, 0.0, 3.5, 7.0)]
    ring = np.array([[20.0, -7.0], [24.0, -7.0], [24.0, 7.0], [20.0, 7.0]])
    street = MapElements.of([*lines, ring], [DIVIDER] * 5 + [CROSSING], 0.9)
    (packet,) = wire.encode(message(LocalMap(street, VIEW)))
    # Header; rings: their number, points of the view, and its coordinates; each line: 3 bytes, its number of points, and those.
    view = 1 + 1 + (1 + 2) + (2 + 1) + (1 + 2) + (2 + 1)
    assert len(packet) - wire.HEADER_BYTES - view <= 5 * (4 + 3 + 3 + 3) + (4 + 4 + 3 + 3 + 3) + 8


def test_an_empty_map_keeps_its_view():
    back = through(message(LocalMap(MapElements.empty(), VIEW)))
    assert back.local_map is not None and len(back.local_map.elements) == 0
    assert through(message(None)).local_map is None


def test_a_map_and_objects_go_as_one_message():
    boxes = Boxes.of(torch.tensor([[1.0, -2.0, 0.8]]), torch.tensor([[4.5, 1.8, 1.6]]), torch.tensor([0.3]))
    back = through(message(random_map(3, 20), objects=boxes))
    assert back.objects is not None and len(back.objects) == 1
    assert back.local_map is not None and len(back.local_map.elements) == 20


def test_elements_shorter_than_the_unit_and_repeated_points_are_dropped():
    close = np.array([[1.0, 1.0], [1.004, 1.0], [1.0, 1.004]])
    line = np.array([[0.0, 0.0], [0.001, 0.0], [5.0, 0.0], [5.0, 0.004]])
    closed = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 0.0]])
    local_map = LocalMap(MapElements.of([close, line, closed, close], [DIVIDER, DIVIDER, CROSSING, CROSSING]), VIEW)
    back = through(message(local_map)).local_map
    assert back is not None
    assert [back.elements.polyline(i).tolist() for i in range(2)] == [[[0, 0], [5, 0]], [[0, 0], [4, 0], [4, 4]]]
    assert len(back.elements) == 2


@pytest.mark.parametrize(
    ("local_map", "message_match"),
    [
        (LocalMap(MapElements.of([[[0, 0], [400.0, 0]]], DIVIDER), VIEW), "within 327.66 m"),
        (LocalMap(MapElements.of([[[0, 0], [np.nan, 0]]], DIVIDER), VIEW), "within 327.66 m"),
        (LocalMap(MapElements.of([[[0, 0], [4.0, 0]]], DIVIDER, np.nan), VIEW), "NaN"),
        (LocalMap(MapElements.of([np.arange(2000).reshape(-1, 2) % 97], DIVIDER), VIEW), "simplify it"),
        (LocalMap(MapElements.empty(), VIEW * 1e-4), "rings of 3 points"),
        (LocalMap(MapElements.empty(), VIEW, Polygons.of([VIEW] * elements.MAX_RINGS)), "rings of 3 points"),
        (LocalMap(MapElements.empty(), np.random.default_rng(0).uniform(-9, 9, (900, 2))), "raise the mtu"),
    ],
)
def test_maps_that_do_not_fit_the_format_are_refused(local_map, message_match):
    with pytest.raises(WireError, match=message_match):
        wire.encode(message(local_map))


def test_a_view_of_two_points_is_none():
    with pytest.raises(ShapeError, match="K >= 3"):
        LocalMap(MapElements.empty(), VIEW[:2])


def sealed(packet: bytes, body: bytes) -> bytes:
    """A packet with another body and a right checksum."""
    start = packet[: wire.HEADER_BYTES - 4]
    return start + body + zlib.crc32(start + body).to_bytes(4, "little")


@given(st.binary(max_size=200))
def test_any_bytes_are_a_map_or_a_packet_error(body):
    (packet,) = wire.encode(message(LocalMap(MapElements.empty(), VIEW)))
    try:
        back = wire.assemble([wire.decode_packet(sealed(packet, body))]).local_map
    except PacketError as error:
        assert error.reason in ("garbage", "implausible")
        return
    assert back is not None
    assert np.isfinite(back.elements.points).all() and (back.elements.counts >= 2 + back.elements.closed).all()


@given(st.integers(0, 10**6), st.data())
def test_a_damaged_body_is_a_map_or_a_packet_error(seed, data):
    (packet, *_) = wire.encode(message(random_map(seed, 10)))
    body = bytearray(packet[wire.HEADER_BYTES - 4 : -4])
    for _ in range(data.draw(st.integers(1, 4))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    body = body[: data.draw(st.integers(0, len(body)))]
    try:
        back = wire.assemble([wire.decode_packet(sealed(packet, bytes(body)))]).local_map
    except PacketError:
        return
    assert back is not None and (np.abs(back.elements.points) <= 327.67).all()
    # What was read can be encoded again: all of it is within the format.
    again = wire.assemble(wire.decode_packet(p) for p in wire.encode(message(back), mtu=65535)).local_map
    assert again is not None
    np.testing.assert_allclose(np.sort(again.elements.points, 0), np.sort(back.elements.points, 0), atol=1e-9)


def test_a_line_that_announces_more_points_than_there_are_bytes_takes_no_room():
    (packet,) = wire.encode(message(LocalMap(MapElements.empty(), VIEW)))
    body = packet[wire.HEADER_BYTES - 4 : -4] + bytes([0, 255, 255]) + bytes([255, 255, 255, 255, 127])
    with pytest.raises(PacketError, match="does not lie in"):
        wire.decode_packet(sealed(packet, body))


@pytest.mark.parametrize(
    "line", [[0, 0, 0, 0], [5, 5, 0, 0], [0, 0, 0xFE, 0xFF, 0x7F, 0]], ids=["still", "still later", "far"]
)
def test_lines_that_cannot_be_are_implausible(line):
    (packet,) = wire.encode(message(LocalMap(MapElements.empty(), VIEW)))
    body = packet[wire.HEADER_BYTES - 4 : -4] + bytes([0, 255, 255, 2, *line])
    with pytest.raises(PacketError, match="repeats a point"):
        wire.decode_packet(sealed(packet, body))


def test_two_views_in_one_message_are_a_contradiction():
    local_map = random_map(5, 60)
    packets, others = (wire.encode(message(m), mtu=700) for m in (local_map, replace(local_map, view=VIEW + 1.0)))
    inbox = Inbox()
    inbox.push(packets[0])
    inbox.push(others[1])
    assert inbox.dropped.contradiction == 1
    (reception,) = inbox.received_messages()
    assert not reception.complete and reception.message.local_map is not None


def test_golden_bytes_of_map_elements():
    """Kind 5 since version 2, byte for byte: if this fails, either undo the change or raise wire.VERSION."""
    style = np.eye(len(STYLES))[[DASHED, DASHED]] * 0.8 + 0.05
    line, ring = [[1.0, -2.0], [11.0, -2.5]], [[4.0, -1.0], [6.0, -1.0], [6.0, 1.0]]
    made = MapElements.of([line, ring], [DIVIDER, CROSSING], [0.5, 0.75], 0.12, style)
    (packet,) = wire.encode(message(LocalMap(made, VIEW[:3])))
    assert packet[3] & 7 == 5
    assert packet[wire.HEADER_BYTES - 4 : -4].hex() == GOLDEN


GOLDEN = (
    "010300db0bb8170000b817"  # the view
    "c6bf5403900363c8010000c801"  # the crossing, the more likely
    "c480540264c701e80731"  # the divider
)
