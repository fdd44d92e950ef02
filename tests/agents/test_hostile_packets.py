# SPDX-License-Identifier: Apache-2.0
"""Packets that are whole and wrong: they change nothing for the others, raise nothing, and are rejected by name.

All packets are made of bytes, by the layout in ``comms.wire``.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable

import numpy as np
import pytest
import torch

from manyeyes import Agent, AgentFrame, Boxes, Inbox
from manyeyes.agents.strategies.registry import FusionStrategy, get_strategy, list_strategies

BODY, CHANNELS, CELLS, KEYS = 64, 80, 82, 84
TENTH_NS = 100_000_000


def sealed(packet: bytes) -> bytes:
    """The packet with its checksum made right again; packet: without one."""
    return packet + struct.pack("<I", zlib.crc32(packet))


def forged(packet: bytes, agent_id: int, body: bytes | None = None, kind: int = 1, time_ns: int | None = None) -> bytes:
    """One whole message of another sender with the header of an honest packet, and another body."""
    (flags,) = struct.unpack_from("<B", packet, 3)
    (stamp,) = struct.unpack_from("<q", packet, 12)
    head = packet[:3] + struct.pack("<BHHiq", flags & ~7 | kind, 0, 1, agent_id, stamp if time_ns is None else time_ns)
    return sealed(head + packet[20:BODY] + (packet[BODY:-4] if body is None else body))


def token_body(packet: bytes, values: np.ndarray) -> bytes:
    """A body of tokens on the grid of an honest packet: one cell for each row of values (N, C) float32, from key 0 on."""
    form, (count, channels) = struct.pack("<B", 0), values.shape
    return (
        packet[BODY : BODY + 15]
        + form
        + struct.pack("<HH", channels, count)
        + bytes(count)
        + values.astype("<f4").tobytes()
    )


def hostile_bodies(packet: bytes) -> dict[str, bytes]:
    (channels,) = struct.unpack_from("<H", packet, CHANNELS)
    values = np.full((3, channels), 0.5, np.float32)
    huge, one_huge = np.full_like(values, 3e38), values.copy()
    one_huge[1, 5] = -3e38
    other_grid = token_body(packet, values)
    return {
        "one channel": token_body(packet, values[:, :1]),
        "a channel too many": token_body(packet, np.ones((3, channels + 1), np.float32)),
        "3e38": token_body(packet, huge),
        "one value of -3e38": token_body(packet, one_huge),
        "1e20": token_body(packet, values * 2e20),
        "beyond the range": token_body(packet, values * 100),
        "another grid": other_grid[:12] + struct.pack("<H", 500) + other_grid[14:],
        "another stride": other_grid[:14] + bytes([16]) + other_grid[15:],
    }


WRONG = {
    "one channel": "width",
    "a channel too many": "width",
    "3e38": "value",
    "one value of -3e38": "value",
    "1e20": "value",
    "beyond the range": "value",
    "another grid": "grid",
    "another stride": "grid",
}


@pytest.fixture(scope="module")
def honest_packets(drive, detector) -> list[list[bytes]]:
    """What an honest sender shares at each of 14 instants: it receives nothing, so it is the same in every drive."""
    sender = Agent(detector, get_strategy("intermediate-temporal"), token_encoding="float32")
    return [sender.share(drive(2).frame(1, index)) for index in range(14)]


def drive_through(
    detector, drive, honest: list[list[bytes]], hostile: Iterable[tuple[int, bytes]], own_inbox: bool
) -> list[tuple[Boxes, list]]:
    """What an ego perceives in 14 instants, with an honest sender beside it, and hostile packets (instant, bytes) among them."""
    some, ego = drive(2), Agent(detector, get_strategy("intermediate-temporal"))
    inbox, found = Inbox(detector.fingerprint), []
    for index in range(14):
        packets = [p for at, p in hostile if at == index] + honest[index]
        frame = some.frame(0, index)
        if own_inbox:
            for packet in packets:
                inbox.push(packet)
            perception = ego.perceive(frame, inbox)
        else:
            perception = ego.perceive(frame, packets)
        found.append((perception.boxes, [(r.agent_id, r.reason) for r in perception.rejected]))
    return found


@pytest.fixture(scope="module")
def undisturbed(drive, detector, honest_packets) -> dict[bool, list[tuple[Boxes, list]]]:
    """What an ego perceives without hostile packets, by whether the caller keeps the inbox."""
    return {own: drive_through(detector, drive, honest_packets, [], own) for own in (False, True)}


@pytest.mark.slow
@pytest.mark.parametrize("own_inbox", [False, True], ids=["packets", "an inbox of the caller"])
@pytest.mark.parametrize("what", WRONG)
def test_one_whole_packet_of_wrong_tokens_changes_nothing(
    drive, detector, honest_packets, undisturbed, what: str, own_inbox: bool
) -> None:
    """It raised in perceive, and again for as long as the history kept it."""
    honest = Agent(detector, token_encoding="float32").share(drive(2).frame(1, 2))[0]
    packet = forged(honest, 66, hostile_bodies(honest)[what], time_ns=2 * TENTH_NS)
    clean = undisturbed[own_inbox]
    struck = drive_through(detector, drive, honest_packets, [(2, packet)], own_inbox)
    assert all(torch.equal(a.bev(), b.bev()) and torch.equal(a.score, b.score) for (a, _), (b, _) in zip(clean, struck))
    assert [names for _, names in clean] == [[]] * 14
    assert struck[2][1] == [(66, WRONG[what])]


def test_a_sender_with_invalid_content_is_rejected_and_the_others_are_fused(drive, detector) -> None:
    """A fusion of one's own that cannot bear something: the sender is named, the honest one still counts, no history is kept."""
    intermediate = get_strategy("intermediate-temporal")

    class Fragile(FusionStrategy):
        uses_history = True

        def fuse(self, cache, frame, messages):
            if any(m.agent_id in (66, 68) for m in messages):
                raise RuntimeError("an unexpected shape")
            return intermediate.fuse(cache, frame, messages)

    some = drive(2)
    honest = Agent(detector).share(some.frame(1, 2))
    packets = [*honest, *(forged(honest[0], agent_id) for agent_id in (66, 67, 68))]
    ego, other = Agent(detector, Fragile()), Agent(detector)
    perception = ego.perceive(some.frame(0, 2), packets)
    assert [(r.agent_id, r.reason) for r in perception.rejected] == [(66, "content_error"), (68, "content_error")]
    assert "RuntimeError: an unexpected shape" in perception.rejected[0].text
    assert {r.message.agent_id for r in perception.received} == {1, 67}
    wanted = other.perceive(some.frame(0, 2), [*honest, forged(honest[0], 67)])
    assert torch.equal(perception.boxes.bev(), wanted.boxes.bev())
    later = some.frame(1, 3)
    assert ego.perceive(some.frame(0, 3), Agent(detector).share(later)).rejected == ()


def test_an_error_of_the_agents_own_is_raised(drive, detector) -> None:
    class Broken(FusionStrategy):
        def fuse(self, cache, frame, messages):
            raise ValueError("a defect")

    packets = Agent(detector).share(drive(2).frame(1, 2))
    with pytest.raises(ValueError, match="a defect"):
        Agent(detector, Broken()).perceive(drive(2).frame(0, 2), packets)


def far_boxes(count: int, x_m: float, y_m: float) -> bytes:
    """A body of so many objects at score 1, 4 m apart, from a place on in the sender's frame (m)."""
    rows = []
    for i in range(count):
        x, y = x_m + 4 * (i % 40), y_m + 4 * (i // 40)
        rows.append(struct.pack("<3h7B", round(x * 100), round(y * 100), 0, 45, 19, 255, 1, 1, 0, 255))
    return b"\0" + b"".join(rows)


def with_rows(detector, drive):
    """An ego that sees every car of the drive, and an honest packet whose header strangers copy."""
    frame = drive(2).frame(0, 2)
    return frame, Agent(detector, get_strategy("late")).share(drive(2).frame(1, 2))[0]


@pytest.mark.parametrize("name", ["late", "late-temporal"])
@pytest.mark.parametrize("x_m", [150.0, 0.0], ids=["out of range", "within range"])
def test_received_boxes_remove_no_own_detection(drive, detector, name: str, x_m: float) -> None:
    """Ten messages of 1,000 boxes at score 1 filled the suppression's list, and no own box was left."""
    frame, honest = with_rows(detector, drive)
    alone = Agent(detector, get_strategy("no-fusion")).perceive(frame).boxes
    assert len(alone) > 5
    packets = [forged(honest, 70 + k, far_boxes(1000, x_m + k, 0.3 * k), kind=2) for k in range(10)]
    found = Agent(detector, get_strategy(name)).perceive(frame, packets).boxes
    nearest = torch.cdist(alone.center[:, :2], found.center[:, :2]).min(1)
    assert float(nearest.values.max()) <= 1.0
    if x_m:
        assert torch.equal(found.bev(), alone.bev()) and torch.equal(found.score, alone.score)


def test_a_received_box_at_the_side_of_an_own_box_does_not_replace_it(drive, detector) -> None:
    """One box at score 1, 1.5 m beside each own one, suppressed them all."""
    frame, honest = with_rows(detector, drive)
    alone = Agent(detector, get_strategy("no-fusion")).perceive(frame).boxes
    ego_from_sender = frame.world_from_agent.inverse() @ drive(2).frame(1, 2).world_from_agent
    beside = alone.transform(ego_from_sender.inverse())
    rows = b"".join(
        struct.pack(
            "<3h7B",
            round((x + 1.5 * np.cos(yaw)) * 100), round((y + 1.5 * np.sin(yaw)) * 100), round(np.degrees(yaw) * 100),
            46, 20, 255, 1, 1, 0, 255,
        )
        for x, y, yaw in zip(*beside.center[:, :2].T.tolist(), beside.yaw.tolist())
    )  # fmt: skip
    found = Agent(detector, get_strategy("late")).perceive(frame, [forged(honest, 71, b"\0" + rows, kind=2)]).boxes
    assert float(torch.cdist(alone.center[:, :2], found.center[:, :2]).min(1).values.max()) <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", list_strategies())
def test_no_bytes_make_perceive_raise(drive, detector, name: str) -> None:
    """Bytes of honest packets at random places, with checksums made right: everything decodable is fused or rejected."""
    some, random = drive(2), np.random.default_rng(20)
    ego = Agent(detector, get_strategy(name))
    for index in range(12):
        packets = []
        for precision in ("float32", "float16", "int8"):
            for packet in Agent(detector, get_strategy(name), token_encoding=precision).share(some.frame(1, index)):
                for _ in range(4):
                    spoilt = bytearray(packet[:-4])
                    for at in random.integers(0, len(spoilt), int(random.integers(1, 6))):
                        spoilt[at] = random.integers(256)
                    packets.append(sealed(bytes(spoilt)))
        assert len(ego.perceive(some.frame(0, index), packets).boxes) >= 0


def test_the_honest_sender_of_a_replayed_drive_is_never_rejected(drive, detector) -> None:
    some, ego, sender = drive(2), Agent(detector), Agent(detector)
    for index in range(6):
        frame: AgentFrame = some.frame(0, index)
        assert ego.perceive(frame, sender.share(some.frame(1, index))).rejected == ()
