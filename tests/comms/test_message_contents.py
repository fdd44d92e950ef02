# SPDX-License-Identifier: Apache-2.0
"""What packets hold, counted from their bytes, is what was encoded."""

from __future__ import annotations

import pytest
import torch

from manyeyes.comms import wire
from manyeyes.comms.message_contents import MessageContents, count_contents
from manyeyes.comms.primitives import PacketError
from manyeyes.datatypes import BevGrid, Boxes, Message, PointCloud, Sites, SparseBev, Transform

GRID = BevGrid(-140.8, -38.4, -3.0, 140.8, 38.4, 1.0, 0.4, 8)


def make_message(tokens: int, objects: int, points: int, has_velocity: bool = False) -> Message:
    sites = Sites(torch.arange(tokens), GRID)
    center = torch.rand(objects, 3, generator=torch.Generator().manual_seed(0))
    velocity = torch.full((objects, 2), 3.0 if has_velocity else 0.0)
    return Message(
        3,
        5,
        Transform.identity(),
        torch.zeros(3, 3),
        tokens=SparseBev(torch.rand(tokens, 8), sites) if tokens else None,
        objects=Boxes.of(center, torch.ones(objects, 3), torch.zeros(objects), velocity=velocity) if objects else None,
        points=PointCloud.of(torch.zeros(points, 3)) if points else None,
    )


@pytest.mark.parametrize("counts", [(0, 0, 0), (400, 0, 0), (0, 250, 0), (0, 0, 3000), (70, 9, 500)])
@pytest.mark.parametrize("has_velocity", [False, True])
def test_contents_are_those_of_the_message(counts: tuple[int, int, int], has_velocity: bool) -> None:
    packets = wire.encode(make_message(*counts, has_velocity))
    assert count_contents(packets) == MessageContents(*counts)


def test_a_damaged_packet_is_refused() -> None:
    packet = wire.encode(make_message(4, 0, 0))[0]
    with pytest.raises(PacketError):
        count_contents([packet[:-1] + bytes([packet[-1] ^ 1])])
