# SPDX-License-Identifier: Apache-2.0
"""The wire format: round trips, sizes, order of importance, and every kind of damage."""

import math
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from manyeyes.comms import payloads, wire
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
from manyeyes.datatypes.message import DESCRIPTOR_DIM, RequestMap

torch.set_num_threads(1)
GRID = BevGrid(-140.8, -38.4, -3.0, 140.8, 38.4, 1.0, 0.4, 8)


def random_tokens(generator: torch.Generator, count: int, channels: int, grid: BevGrid = GRID) -> SparseBev:
    rows, columns = grid.shape
    key = torch.randperm(rows * columns, generator=generator)[:count].sort().values
    scale = torch.logspace(-3, 3, channels)
    return SparseBev(torch.randn(len(key), channels, generator=generator) * scale, Sites(key, grid))


def random_boxes(generator: torch.Generator, count: int) -> Boxes:
    def uniform(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(count, generator=generator)

    center = torch.stack((uniform(-320, 320), uniform(-320, 320), uniform(0, 2)), -1)
    size = torch.stack((uniform(1, 20), uniform(0.5, 3), uniform(1, 4)), -1)
    score = uniform(0, 1).sort(descending=True).values
    label = torch.randint(0, len(LABELS), (count,), generator=generator)
    ids = torch.randint(-1, 255, (count,), generator=generator)
    sigmas = (uniform(0.011, 19), uniform(0.0011, 3.1), uniform(0, 1))
    velocity = torch.stack((uniform(-31, 31), uniform(-31, 31)), -1)
    return Boxes(center, size, uniform(-math.pi, math.pi), score, label, ids, *sigmas, velocity)


def random_message(seed: int, tokens: int | None = 40, objects: int | None = 5, points: int | None = 50) -> Message:
    g = torch.Generator().manual_seed(seed)
    root = torch.randn(3, 3, generator=g, dtype=torch.float64) * torch.tensor([[0.3], [0.2], [0.01]])
    angles = torch.rand(3, generator=g, dtype=torch.float64) * 6 - 3
    position = torch.randn(3, generator=g, dtype=torch.float64) * 1e4
    xyz = torch.rand(points or 0, 3, generator=g) * 600 - 300
    return Message(
        agent_id=int(torch.randint(-(2**31), 2**31, (), generator=g)),
        timestamp_ns=int(torch.randint(0, 2**62, (), generator=g)),
        world_from_agent=Transform.from_rpy(position, *angles),
        pose_covariance=root @ root.mT,
        fingerprint=bytes(torch.randint(0, 256, (8,), generator=g).tolist()),
        is_infrastructure=bool(torch.rand((), generator=g) < 0.5),
        tokens=None if tokens is None else random_tokens(g, tokens, 8),
        token_score=None if tokens is None else torch.rand(tokens, generator=g),
        objects=None if objects is None else random_boxes(g, objects),
        points=None if points is None else PointCloud.of(xyz, torch.rand(points, generator=g)),
    )


def with_codes(message: Message, width: int = 5) -> Message:
    """The same cells, each with a row of bytes instead of features."""
    if message.tokens is None:
        return message
    rows = np.random.default_rng(message.agent_id + 2**31).integers(0, 256, (len(message.tokens.sites), width))
    return replace(message, tokens=message.tokens.with_features(torch.from_numpy(rows.astype(np.uint8))))


def through(message: Message, **options) -> Message:
    return wire.assemble(wire.decode_packet(p) for p in wire.encode(message, **options))


def correlation_error_bound(correlation: torch.Tensor, half_step: float = 0.5 / 127) -> float:
    """Bound of the error of correlations from their factor in steps of 1/127, large where two errors are nearly one."""
    factor = torch.linalg.cholesky(correlation + 1e-12 * torch.eye(3))
    yx = min(1.0, abs(float(factor[1, 0])) + half_step)
    return abs(float(factor[2, 1])) * (float(factor[1, 1]) - math.sqrt(1 - yx**2)) + 4 * half_step


sizes = st.one_of(st.none(), st.integers(0, 300))
encodings = st.sampled_from([encoding for encoding in payloads.TOKEN_ENCODINGS if encoding != "clusters"])
"""Clusters need rows that a detector clustered: tests/comms/test_cluster_payload.py."""


@given(st.integers(0, 10**6), sizes, sizes, sizes, encodings, st.integers(300, 3000))
def test_round_trip(seed, tokens, objects, points, precision, mtu):
    message = random_message(seed, tokens, objects, points)
    message = with_codes(message) if precision == "codebook" else message
    packets = wire.encode(message, token_encoding=precision, mtu=mtu)
    assert all(len(p) <= mtu for p in packets)
    back = wire.assemble(wire.decode_packet(p) for p in packets)

    assert (back.agent_id, back.timestamp_ns) == (message.agent_id, message.timestamp_ns)
    assert (back.fingerprint, back.is_infrastructure) == (message.fingerprint, message.is_infrastructure)
    moved = back.world_from_agent.translation - message.world_from_agent.translation
    assert moved.abs().max() <= 0.5e-6
    assert (back.world_from_agent.rotation - message.world_from_agent.rotation).abs().max() < 2e-9
    sigma = message.pose_covariance.diagonal().sqrt()
    assert ((back.pose_covariance.diagonal().sqrt() / sigma).log().abs() <= math.log(1e7) / 254 / 2 + 1e-6).all()
    correlation = message.pose_covariance / (sigma[:, None] * sigma)
    back_sigma = back.pose_covariance.diagonal().sqrt()
    error = (back.pose_covariance / (back_sigma[:, None] * back_sigma) - correlation).abs()
    assert (error <= correlation_error_bound(correlation)).all()
    assert torch.linalg.eigvalsh(back.pose_covariance).min() > -1e-12
    for name in ("tokens", "objects", "points"):
        assert (getattr(back, name) is None) == (getattr(message, name) is None)
    if message.tokens is not None:
        check_tokens(back.tokens, message.tokens, precision)
    if message.objects is not None:
        check_objects(back.objects, message.objects)
    if message.points is not None:
        assert ((back.points.xyz - message.points.xyz).abs() <= 0.005 + 1e-4).all()
        assert ((back.points.intensity - message.points.intensity).abs() <= 0.5 / 255 + 1e-6).all()


def check_tokens(got: SparseBev, sent: SparseBev, precision: payloads.TokenEncoding) -> None:
    assert got.grid == sent.grid
    assert torch.equal(got.sites.key, sent.sites.key)
    if precision == "codebook":
        assert got.features.dtype == torch.uint8 and torch.equal(got.features, sent.features)
        return
    error = (got.features - sent.features).abs()
    if precision == "float32":
        assert torch.equal(got.features, sent.features)
    elif precision == "float16":
        assert (error <= sent.features.abs() * 2**-11 + 2**-24).all()
    elif len(sent.sites):
        # A channel's step follows its peak in the packet, at most 9.1 % above; so the whole message's peak is a bound.
        assert (error <= sent.features.abs().amax(0) * 2**0.125 / 127 / 2 * 1.001 + 2**-16).all()


def check_objects(got: Boxes, sent: Boxes) -> None:
    assert torch.equal(got.label, sent.label)
    assert torch.equal(got.id, sent.id)
    assert ((got.center - sent.center)[:, :2].abs() <= 0.005 + 1e-4).all()
    assert ((got.size - sent.size)[:, :2].abs() <= 0.05 + 1e-5).all()
    turn = torch.remainder(got.yaw - sent.yaw + math.pi, 2 * math.pi) - math.pi
    assert (turn.abs() <= math.radians(0.005) + 1e-5).all()
    assert ((got.score - sent.score).abs() <= 0.5 / 65535 + 1e-7).all()
    assert ((got.p_flip - sent.p_flip).abs() <= 0.5 / 31 + 1e-6).all()
    assert ((got.sigma_xy / sent.sigma_xy).log().abs() <= math.log(20 / 0.01) / 254 / 2 + 1e-5).all()
    assert ((got.sigma_yaw / sent.sigma_yaw).log().abs() <= math.log(3.2 / 0.001) / 254 / 2 + 1e-5).all()
    assert ((got.velocity - sent.velocity).abs() <= 0.125 + 1e-5).all()
    assert torch.equal(got.size[:, 2], torch.tensor(payloads.LABEL_HEIGHTS)[sent.label])
    assert torch.equal(got.center[:, 2], got.size[:, 2] / 2)


def golden_message() -> Message:
    """A message with tokens, one object and one point."""
    grid = BevGrid(-1.6, -0.8, -3, 1.6, 0.8, 1, 0.4, 2)
    return Message(
        agent_id=-7,
        timestamp_ns=1_234_567_890_123_456_789,
        world_from_agent=Transform.from_xyz_yaw(100.25, -200.5, 0.125, 1.0),
        pose_covariance=torch.diag(torch.tensor([0.25, 0.0625, 0.0], dtype=torch.float64)),
        fingerprint=b"weights!",
        is_infrastructure=True,
        tokens=SparseBev(torch.tensor([[1.0, -2.0], [0.5, 4.0]]), Sites(torch.tensor([1, 6]), grid)),
        token_score=torch.tensor([0.1, 0.9]),
        objects=Boxes.of(torch.tensor([[1.0, -2.0, 0.8]]), torch.tensor([[4.5, 1.8, 1.6]]), torch.tensor([math.pi])),
        points=PointCloud.of(torch.tensor([[0.01, -0.02, 300.0]]), torch.tensor([1.0])),
    )


def test_golden_bytes():
    """The format of version 4, byte for byte: if this fails, either undo the change or raise wire.VERSION."""
    packets = wire.encode(golden_message(), token_encoding="float16")
    assert [p.hex() for p in packets] == GOLDEN
    assert len(packets[0]) == wire.HEADER_BYTES + 1 + 14
    assert len(packets[2]) == wire.HEADER_BYTES + 7


def test_golden_bytes_of_earlier_versions_are_read():
    """Version 2, and version 3 with the agent's body, whose objects have scores of one byte: 0xff is 1, 0x80 is 128/255."""
    for golden in (GOLDEN_2, GOLDEN_3):
        back = wire.assemble(wire.decode_packet(bytes.fromhex(packet)) for packet in golden)
        assert back.objects.center.tolist() == [pytest.approx([1.0, -2.0, 0.8])]
        assert back.objects.size.tolist() == [pytest.approx([4.5, 1.8, 1.6])] and back.objects.score.tolist() == [1.0]
        assert torch.equal(back.tokens.features, golden_message().tokens.features) and len(back.points) == 1
        assert (back.body is not None) == (golden is GOLDEN_3)
    half = forge(bytes.fromhex(GOLDEN_2[0]), 64 + 1 + 8, b"\x80")
    assert wire.assemble([wire.decode_packet(half)]).objects.score.tolist() == pytest.approx([128 / 255])


def test_versions_are_not_mixed_in_a_message():
    """An object of version 2 among those of version 4 is another form of objects."""
    new, old = wire.encode(golden_message(), token_encoding="float16"), bytes.fromhex(GOLDEN_2[0])
    with pytest.raises(wire.PacketError, match=r"both cannot be true|other things"):
        wire.assemble([wire.decode_packet(new[0]), wire.decode_packet(forge(old, 4, b"\1\0"))])


def test_scores_of_a_sixteen_thousandth_apart_stay_apart():
    count = 100
    boxes = random_boxes(torch.Generator().manual_seed(3), count)
    score = 0.5 - torch.arange(count).double() / 16384
    back = through(replace(random_message(3, None, None, None), objects=replace(boxes, score=score.float()))).objects
    assert len(set(back.score.tolist())) == count and (back.score.diff() < 0).all()


GOLDEN = [
    (
        "4d45040a00000300f9ffffff1581e97df4102211000044060000000078f3ffff0000020000000000000000000000f008c956"
        "635800000000776569676874732100640038ffb0b92d12ffff000000ff6e8ab583"
    ),
    (
        "4d45040901000300f9ffffff1581e97df4102211000044060000000078f3ffff0000020000000000000000000000f008c956"
        "635800000000776569676874732160ffb0ffd4fea0005000640090010201020002000104003c00c00038004467b56d40"
    ),
    (
        "4d45040b02000300f9ffffff1581e97df4102211000044060000000078f3ffff0000020000000000000000000000f008c956"
        "63580000000077656967687473210100feff3075ff51a50494"
    ),
]

GOLDEN_2 = [
    (
        "4d45020a00000300f9ffffff1581e97df4102211000044060000000078f3ffff0000020000000000000000000000f008c956"
        "635800000000776569676874732100640038ffb0b92d12ff000000ffb49a0f09"
    ),
    (
        "4d45020901000300f9ffffff1581e97df4102211000044060000000078f3ffff0000020000000000000000000000f008c956"
        "635800000000776569676874732160ffb0ffd4fea0005000640090010201020002000104003c00c000380044c17f3120"
    ),
    (
        "4d45020b02000300f9ffffff1581e97df4102211000044060000000078f3ffff0000020000000000000000000000f008c956"
        "63580000000077656967687473210100feff3075ff9aa68807"
    ),
]

GOLDEN_3 = [
    (
        "4d45034200000300f9ffffff1581e97df4102211000044060000000078f3ffff0000020000000000000000000000f008c956"
        "63580000000077656967687473218e00f3ff730031151200640038ffb0b92d12ff000000ff4e10717c"
    ),
    (
        "4d45030101000300f9ffffff1581e97df4102211000044060000000078f3ffff0000020000000000000000000000f008c956"
        "635800000000776569676874732160ffb0ffd4fea0005000640090010201020002000104003c00c000380044651f5584"
    ),
    (
        "4d45030302000300f9ffffff1581e97df4102211000044060000000078f3ffff0000020000000000000000000000f008c956"
        "63580000000077656967687473210100feff3075ff7417834d"
    ),
]


def test_25_plain_objects_are_a_packet_of_419_bytes():
    message = random_message(1, None, 25, None)
    still = replace(message.objects, velocity=torch.full((25, 2), 0.1))
    (packet,) = wire.encode(replace(message, objects=still))
    assert len(packet) == wire.HEADER_BYTES + 1 + 25 * 14 == 419
    (moving,) = wire.encode(message)
    assert len(moving) == len(packet) + 25 * 2
    (described,) = wire.encode(replace(message, objects=still, descriptors=torch.zeros(25, DESCRIPTOR_DIM)))
    assert len(described) == len(packet) + 25 * 32


def test_descriptors_stay_with_their_objects():
    message = random_message(12, None, 60, None)
    mixed = torch.randperm(60, generator=torch.Generator().manual_seed(0))
    descriptors = torch.rand(60, DESCRIPTOR_DIM, generator=torch.Generator().manual_seed(1)) * 2 - 1
    back = through(replace(message, objects=message.objects[mixed], descriptors=descriptors[mixed]), mtu=500)
    assert ((back.descriptors - descriptors).abs() <= 0.5 / 127 + 1e-6).all()
    check_objects(back.objects, message.objects)
    assert through(message).descriptors is None


def test_velocities_saturate():
    boxes = Boxes.of(
        torch.zeros(2, 3), torch.ones(2, 3), torch.zeros(2), velocity=torch.tensor([[50.0, -50], [0.2, 0]])
    )
    back = through(replace(random_message(13, None, None, None), objects=boxes)).objects
    assert back.velocity.tolist() == [[31.75, -31.75], [0.25, 0.0]]


def test_a_request_is_a_byte_a_cell():
    grid = GRID.at(32)
    confidence = torch.rand(grid.shape, generator=torch.Generator().manual_seed(0))
    message = replace(random_message(14, 20, 3, None), request=RequestMap(grid, confidence))
    packets = wire.encode(message)
    assert len(packets[1]) == wire.HEADER_BYTES + 15 + confidence.numel()
    back = through(message).request
    assert back.grid == grid and ((back.confidence - confidence).abs() <= 0.5 / 255 + 1e-6).all()
    assert wire.assemble([wire.decode_packet(packets[0])]).request is None
    second = forge(packets[1], 4, b"\2\0")
    with pytest.raises(wire.PacketError, match="second request"):
        wire.assemble(map(wire.decode_packet, [packets[1], second]))
    with pytest.raises(WireError, match="coarser"):
        wire.encode(replace(message, request=RequestMap(GRID, torch.zeros(GRID.shape))))
    with pytest.raises(WireError, match="0 to 1"):
        wire.encode(replace(message, request=RequestMap(grid, confidence + 1)))


@pytest.mark.parametrize("spread", [(0, 0, 0), (1, 0, 2), (5, 5, 0)])
@pytest.mark.parametrize("turn", [0.0, 0.7, math.pi / 4])
def test_covariances_at_the_edge_of_what_can_be(spread, turn):
    """No spread at all, along one line only, or of one value in two axes: still symmetric, none below 0."""
    c, s = math.cos(turn), math.sin(turn)
    axes = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    covariance = axes @ torch.diag(torch.tensor(spread, dtype=torch.float64).square()) @ axes.mT
    back = through(replace(random_message(15, None, None, None), pose_covariance=covariance)).pose_covariance
    assert torch.allclose(back, covariance, rtol=0.08, atol=0.08 * max(spread) ** 2 + 1e-12)
    assert torch.linalg.eigvalsh(back).min() > -1e-9


def test_a_message_without_sections_is_one_header():
    message = random_message(2, None, None, None)
    (packet,) = wire.encode(message)
    assert len(packet) == wire.HEADER_BYTES
    back = through(message)
    assert back.tokens is None and back.objects is None and back.points is None


def test_most_important_first_and_any_prefix_is_a_message():
    message = random_message(3, 300, 5, None)
    packets = wire.encode(message, token_encoding="float32")
    assert len(packets) > 5
    scores = dict(zip(message.tokens.sites.key.tolist(), message.token_score.tolist()))
    lowest_so_far = 1.0
    for packet in packets[1:]:
        got = [scores[k] for k in wire.decode_packet(packet).body.key.tolist()]
        assert max(got) <= lowest_so_far
        lowest_so_far = min(got)
    for cut in (1, 2, len(packets) - 1):
        back = wire.assemble(map(wire.decode_packet, packets[:cut]))
        assert len(back.objects) == 5
        kept = {} if back.tokens is None else set(back.tokens.sites.key.tolist())
        best = sorted(scores, key=lambda k: -scores[k])[: len(kept)]
        assert set(best) == set(kept)


def test_a_lost_packet_of_points_thins_the_cloud_evenly():
    azimuth = torch.linspace(-3.1, 3.1, 2000)
    cloud = PointCloud.of(torch.stack((azimuth.cos() * 50, azimuth.sin() * 50, azimuth * 0), -1))
    packets = wire.encode(replace(random_message(4, None, None, None), points=cloud))
    back = wire.assemble(map(wire.decode_packet, packets[:-1])).points
    angle = torch.atan2(back.xyz[:, 1], back.xyz[:, 0])
    assert len(back) < 2000
    assert angle.diff().max() < 3 * 6.2 / 2000


@given(st.integers(0, 10**6), st.randoms(use_true_random=False))
def test_order_and_copies_do_not_matter(seed, random):
    packets = wire.encode(random_message(seed, 120, 150, 300), token_encoding="float32", mtu=600)
    shuffled = packets + random.choices(packets, k=3)
    random.shuffle(shuffled)
    assert same(wire.assemble(map(wire.decode_packet, shuffled)), wire.assemble(map(wire.decode_packet, packets)))


def same(a: Message, b: Message) -> bool:
    """Equal to the bit: what a message is made of is what its own bytes say."""
    return wire.encode(a, token_encoding="float32", mtu=60000) == wire.encode(b, token_encoding="float32", mtu=60000)


@given(st.binary(max_size=300))
def test_garbage_is_refused(data):
    with pytest.raises(wire.PacketError):
        wire.decode_packet(data)
    with pytest.raises(wire.PacketError):
        wire.decode_packet(b"ME\x04" + data)


@given(st.integers(0, 10**6), st.data())
def test_every_flipped_bit_and_every_cut_is_noticed(seed, data):
    packet = data.draw(st.sampled_from(wire.encode(random_message(seed, 10, 3, 10))))
    bit = data.draw(st.integers(0, len(packet) * 8 - 1))
    damaged = bytearray(packet)
    damaged[bit // 8] ^= 1 << bit % 8
    with pytest.raises(wire.PacketError):
        wire.decode_packet(bytes(damaged))
    with pytest.raises(wire.PacketError):
        wire.decode_packet(packet[: data.draw(st.integers(0, len(packet) - 1))])
    with pytest.raises(wire.PacketError):
        wire.decode_packet(packet + b"\0")


def forge(packet: bytes, at: int, data: bytes) -> bytes:
    """The packet with other bytes and a checksum that fits them: a faulty sender, not a faulty channel."""
    changed = packet[:at] + data + packet[at + len(data) : -4]
    return changed + zlib.crc32(changed).to_bytes(4, "little")


@given(st.integers(0, 1000), st.data())
def test_a_faulty_sender_never_crashes_the_reader(seed, data):
    packet = data.draw(st.sampled_from(wire.encode(random_message(seed, 10, 3, 10))))
    at = data.draw(st.integers(10, len(packet) - 5))
    forged = forge(packet, at, data.draw(st.binary(min_size=1, max_size=min(8, len(packet) - 4 - at))))
    try:
        message = wire.assemble([wire.decode_packet(forged)])
    except wire.PacketError:
        return
    assert torch.isfinite(message.world_from_agent.rotation).all()
    if message.tokens is not None:
        assert torch.isfinite(message.tokens.features).all()
    if message.objects is not None:
        assert (message.objects.label < len(LABELS)).all()


@pytest.mark.parametrize(
    ("at", "data", "reason"),
    [
        (0, b"XX", "garbage"),
        (2, b"\x01", "version"),
        (3, b"\xc1", "garbage"),
        (3, b"\x05", "garbage"),
        (4, b"\xff\xff", "garbage"),
        (6, b"\x00\x00", "garbage"),
        (20, b"\xff\xff\xff\xff\xff\x7f", "implausible"),
        (38, b"\xff\xff\xff\x7f\xff\xff\xff\x7f\xff\xff\xff\x7f", "implausible"),
        (38, b"\x00\x00\x00\x70\x00\x00\x00\x70\x00\x00\x00\x00", "implausible"),
        (64 + 6, b"\x00\x80", "implausible"),
        (64 + 15, b"\x09", "garbage"),
        (64 + 15, b"\x0b", "wrong_model"),
        (64 + 15, b"\x11", "garbage"),
        (64 + 16, b"\x00\x00", "garbage"),
        (64 + 18, b"\xff\xff", "garbage"),
        (64 + 20, b"\xc0\x10", "implausible"),
        (64 + 20, b"\x80\x00", "garbage"),
        (64 + 22, b"\x00\x7c", "implausible"),
    ],
)
def test_invalid_messages_are_refused_by_the_encoder(at, data, reason):
    """Cell 2000 of the 24 x 88 grid takes two bytes, cell 2112 is the first outside: 0xc0 0x10."""
    tokens = SparseBev(torch.ones(1, 3), Sites(torch.tensor([2000]), GRID))
    (packet,) = wire.encode(replace(random_message(5, None, None, None), tokens=tokens))
    wire.decode_packet(forge(packet, 0, b""))
    with pytest.raises(wire.PacketError) as caught:
        wire.decode_packet(forge(packet, at, data))
    assert caught.value.reason == reason
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("row", "value"),
    [("label_flip", 7), ("size", (0, 10)), ("yaw", 18000), ("yaw", -18001), ("velocity", (0, -128))],
)
def test_implausible_objects_are_refused(row, value):
    (packet,) = wire.encode(random_message(6, None, 1, None))
    rows = np.frombuffer(packet[65:-4], payloads._object_type(1)).copy()
    rows[row] = value
    with pytest.raises(wire.PacketError) as caught:
        wire.decode_packet(forge(packet, 65, rows.tobytes()))
    assert caught.value.reason == "implausible"
    with pytest.raises(wire.PacketError, match="flags"):
        wire.decode_packet(forge(packet, 64, b"\4"))


def test_objects_that_change_their_form_within_a_message_are_refused():
    message = random_message(16, None, 60, None)
    still = replace(message, objects=replace(message.objects, velocity=torch.zeros(60, 2)))
    one, other = wire.encode(message, mtu=500)[0], wire.encode(still, mtu=500)[1]
    other = forge(other, 6, one[6:8])
    with pytest.raises(wire.PacketError, match="other things"):
        wire.assemble(map(wire.decode_packet, [one, other]))


def test_contradictions_are_refused():
    one, other = random_message(7, 60, None, None), random_message(8, 60, None, None)
    first = wire.encode(one, mtu=400)
    assert len(first) > 2
    changed = wire.encode(replace(one, tokens=one.tokens.with_features(one.tokens.features + 1)), mtu=400)
    turned = wire.encode(replace(one, world_from_agent=other.world_from_agent), mtu=400)
    reordered = wire.encode(replace(one, token_score=-one.token_score), mtu=400)
    for intruder in (changed[0], turned[1], reordered[-1], wire.encode(one, mtu=400, token_encoding="int8")[1]):
        with pytest.raises(wire.PacketError) as caught:
            wire.assemble(map(wire.decode_packet, [first[0], intruder]))
        assert caught.value.reason == "contradiction"
    with pytest.raises(WireError, match="at least one"):
        wire.assemble([])


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"agent_id": 2**31}, "int32"),
        ({"fingerprint": b"short"}, "8 bytes"),
        ({"pose_covariance": torch.tensor([[1.0, 2, 0], [2, 1, 0], [0, 0, 1]])}, "semidefinite"),
        ({"pose_covariance": torch.full((3, 3), math.nan)}, "finite"),
        ({"world_from_agent": Transform.from_xyz_yaw(math.inf, 0)}, "finite pose"),
        ({"token_score": torch.full((40,), math.nan)}, "without NaN"),
        ({"objects": Boxes.of(torch.full((1, 3), math.nan), torch.ones(1, 3), torch.zeros(1))}, "NaN or infinite"),
        ({"objects": Boxes.of(torch.full((1, 3), 328.0), torch.ones(1, 3), torch.zeros(1))}, "crop them"),
        ({"points": PointCloud.of(torch.full((1, 3), -400.0))}, "crop them"),
        ({"pose_covariance": torch.eye(3) * 4e8}, "10 km"),
        ({"descriptors": torch.zeros(4, DESCRIPTOR_DIM)}, "one an object"),
        ({"descriptors": torch.full((5, DESCRIPTOR_DIM), 1.5)}, "one an object"),
        (
            {"tokens": SparseBev(torch.full((1, 2), math.inf), Sites(torch.tensor([0]), GRID)), "token_score": None},
            "finite",
        ),
        ({"tokens": SparseBev(torch.full((1, 2), 1e6), Sites(torch.tensor([0]), GRID)), "token_score": None}, "65504"),
        (
            {"tokens": SparseBev(torch.ones(1, 900), Sites(torch.tensor([0]), GRID)), "token_score": None},
            "does not fit",
        ),
        (
            {
                "tokens": SparseBev(torch.ones(1, 2), Sites(torch.tensor([0]), replace(GRID, x_max=140.8001))),
                "token_score": None,
            },
            "whole centimetres",
        ),
        ({"tokens": SparseBev(torch.ones(1, 2), Sites(torch.tensor([0]), GRID, 2)), "token_score": None}, "batch of 2"),
    ],
)
def test_values_out_of_range_are_rejected_by_the_sender(change, match):
    with pytest.raises(WireError, match=match):
        wire.encode(replace(random_message(9), **change))


def test_unknown_settings_are_refused():
    with pytest.raises(ConfigError, match="float32, float16, int8, codebook"):
        wire.encode(random_message(9), token_encoding="float8")
    with pytest.raises(WireError, match="only codes are"):
        wire.encode(random_message(9), token_encoding="codebook")
    with pytest.raises(WireError, match="only codes are"):
        wire.encode(with_codes(random_message(9)), token_encoding="int8")
    with pytest.raises(ConfigError, match="mtu"):
        wire.encode(random_message(9), mtu=80)


@pytest.mark.parametrize("turn", [0.0, 1e-9, math.pi / 2, math.pi, -math.pi, 3.0])
def test_rotations_at_the_seams_of_the_quaternion(turn):
    zero = torch.zeros((), dtype=torch.float64)
    for angles in ((turn, 0, 0), (0, turn, 0), (0, 0, turn), (turn, turn, turn)):
        pose = Transform.from_rpy(torch.zeros(3, dtype=torch.float64), *(zero + a for a in angles))
        back = through(replace(random_message(10, None, None, None), world_from_agent=pose))
        assert (back.world_from_agent.rotation - pose.rotation).abs().max() < 2e-9


def test_sizes_and_ids_outside_their_range_saturate_or_wrap():
    boxes = Boxes.of(torch.zeros(3, 3), torch.tensor([[40.0, 0.0, 1], [4, 2, 1], [4, 2, 1]]), torch.zeros(3))
    boxes = replace(boxes, id=torch.tensor([300, -1, 254]))
    back = through(replace(random_message(11, None, None, None), objects=boxes)).objects
    assert back.size[0, :2].tolist() == pytest.approx([25.5, 0.1])
    assert back.id.tolist() == [45, -1, 254]
    assert back.sigma_xy.tolist() == [0, 0, 0]
