# SPDX-License-Identifier: Apache-2.0
"""Request maps: by hand, under motion, and with several receivers."""

import math

import pytest
import torch

from manyeyes.comms import wire
from manyeyes.comms.request_map import build_request_map, compute_request_weights
from manyeyes.datatypes import BevGrid, ConfigError, Message, Transform
from manyeyes.datatypes.message import RequestMap

torch.set_num_threads(1)
GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 1.0, 0.4, 4)
WINDOW = GRID.at(32)


def asking(confidence: torch.Tensor, pose: Transform, agent: int = 9) -> Message:
    return Message(agent, 0, pose, torch.zeros(3, 3), request=RequestMap(WINDOW, confidence))


def test_a_window_has_the_lowest_confidence_of_its_objects():
    """Two in the window from -6.2 to 6.6 m, one far off, one beyond the map."""
    xy = torch.tensor([[-20.0, -20.0], [6.0, 5.0], [6.0, 6.0], [80.0, 0.0]])
    made = build_request_map(xy, torch.tensor([0.5, 0.9, 0.3, 1.0]), WINDOW)
    there = WINDOW.cells(torch.tensor([[-20.0, -20.0], [0.0, 0.0], [20.0, -20.0]]))
    assert made.confidence[there[:, 0], there[:, 1]].tolist() == pytest.approx([0.5, 0.3, 0.0])
    assert int((made.confidence > 0).sum()) == 2
    empty = build_request_map(xy[:0], torch.zeros(0), WINDOW)
    assert not empty.confidence.any()


def test_tokens_at_confident_objects_of_the_receiver_have_less_weight():
    confidence = torch.zeros(WINDOW.shape)
    there = WINDOW.cells(torch.tensor([[12.8, 0.0]]))[0]
    confidence[there[0], there[1]] = 0.8
    # The sender stands 10 m ahead of the receiver, facing it: its (-2.8, 0) is the receiver's (12.8, 0).
    sender = Transform.from_xyz_yaw(110.0, 50.0, 0.0, math.pi)
    receiver = Transform.from_xyz_yaw(100.0, 50.0)
    xy = torch.tensor([[-2.8, 0.0], [5.0, 0.0], [-40.0, 0.0]])
    weight = compute_request_weights(xy, sender, [asking(confidence, receiver)])
    # Seen well; not seen; out of the receiver's map.
    assert weight.tolist() == pytest.approx([0.2, 1.0, 0.1])


def test_the_largest_weight_counts_and_messages_without_request_change_nothing():
    xy, sender = torch.tensor([[0.0, 0.0], [8.0, 3.0]]), Transform.identity()
    plain = Message(3, 0, sender, torch.zeros(3, 3))
    well, badly = asking(torch.full(WINDOW.shape, 0.9), sender), asking(torch.full(WINDOW.shape, 0.4), sender)
    assert compute_request_weights(xy, sender, [plain]).tolist() == [1, 1]
    assert compute_request_weights(xy, sender, [well, plain]).tolist() == pytest.approx([0.1, 0.1])
    for order in ([well, badly], [badly, well], [badly]):
        assert compute_request_weights(xy, sender, order).tolist() == pytest.approx([0.6, 0.6])


def test_request_weights_do_not_depend_on_the_world_origin():
    g = torch.Generator().manual_seed(0)
    xy, confidence = torch.rand(200, 2, generator=g) * 80 - 40, torch.rand(WINDOW.shape, generator=g)
    sender, receiver = Transform.from_xyz_yaw(3.0, 4.0, 0.0, 0.3), Transform.from_xyz_yaw(-8.0, 1.0, 0.0, 2.0)
    moved = Transform.from_xyz_yaw(1000.0, -2000.0, 5.0, 1.1)
    here = compute_request_weights(xy, sender, [asking(confidence, receiver)])
    there = compute_request_weights(xy, moved @ sender, [asking(confidence, moved @ receiver)])
    # A token on the very border of a window may fall to either side.
    assert int(((here - there).abs() > 1e-6).sum()) <= 1


def test_an_encoded_request_map_gives_the_same_weights_within_half_a_step():
    confidence = torch.rand(WINDOW.shape, generator=torch.Generator().manual_seed(1))
    message = asking(confidence, Transform.from_xyz_yaw(5.0, 2.0, 0.0, 0.4))
    received = wire.assemble(wire.decode_packet(p) for p in wire.encode(message))
    xy = torch.rand(100, 2, generator=torch.Generator().manual_seed(2)) * 40 - 20
    a, b = (compute_request_weights(xy, Transform.identity(), [m]) for m in (message, received))
    assert int(((a - b).abs() > 0.5 / 255 + 1e-6).sum()) <= 1


@pytest.mark.parametrize("confidence", [torch.zeros(2), torch.tensor([0.5]), torch.tensor([0.1, 0.2, 1.5])])
def test_invalid_confidence_is_refused(confidence):
    with pytest.raises(ConfigError, match="confidence needs"):
        build_request_map(torch.zeros(3, 2), confidence, WINDOW)
