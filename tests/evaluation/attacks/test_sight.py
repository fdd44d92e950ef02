# SPDX-License-Identifier: Apache-2.0
"""Rays against boxes, in cases drawn by hand: the sensor stands 2 m above the origin, a car 10 m ahead."""

import numpy as np
import pytest
import torch

from manyeyes.datatypes import AgentFrame, Boxes, Transform
from manyeyes.evaluation.attacks.sight import count_rays, is_checkable

CAR = Boxes.of(torch.tensor([[10.0, 0.0, 0.8]]), torch.tensor([[4.0, 2.0, 1.6]]), torch.zeros(1))


def frame_of(*points: tuple[float, float, float]) -> AgentFrame:
    return AgentFrame.of(np.array(points, dtype=np.float32), Transform.identity(), sensor_height_m=2.0)


def test_a_return_far_behind_crosses_and_one_inside_does_not() -> None:
    counts = count_rays(frame_of((30.0, 0.0, 0.0), (10.0, 0.0, 1.0), (5.0, 0.0, 0.0), (30.0, 20.0, 0.0)), CAR)
    assert counts.num_crossing.tolist() == [1] and counts.num_inside.tolist() == [1]


def test_a_ray_above_the_box_does_not_cross_it() -> None:
    assert count_rays(frame_of((30.0, 0.0, 2.0)), CAR).num_crossing.tolist() == [0]


def test_a_return_just_behind_the_box_does_not_count() -> None:
    # The ray leaves the shrunk box at x = 11.7 m.
    near, far = (count_rays(frame_of((x, 0.0, 0.6)), CAR).num_crossing[0] for x in (12.0, 12.5))
    assert (near, far) == (0, 1)


def test_ground_under_a_box_is_not_inside() -> None:
    assert count_rays(frame_of((10.0, 0.5, 0.0)), CAR).num_inside.tolist() == [0]


def test_counts_do_not_depend_on_the_frame() -> None:
    rng = torch.Generator().manual_seed(0)
    points = (torch.rand(2000, 3, generator=rng) - 0.5) * torch.tensor([80.0, 80.0, 4.0])
    turned = Transform.from_xyz_yaw(0, 0, 0, 0.7)
    first = count_rays(AgentFrame.of(points, Transform.identity(), sensor_height_m=2.0), CAR)
    moved = count_rays(
        AgentFrame.of(turned.apply(points), Transform.identity(), sensor_height_m=2.0),
        CAR.to(torch.float64).transform(turned),
    )
    assert first.num_crossing[0] > 3
    assert abs(int(first.num_crossing[0]) - int(moved.num_crossing[0])) <= 1


@pytest.mark.parametrize(
    ("rays", "expected"),
    [
        ((10, 10, 10), True),
        ((10, 0, 10, 0, 10), True),
        ((10, 0, 0, 10, 0, 10), False),
        ((9, 9, 9, 9), False),
        ((), False),
    ],
)
def test_a_claim_is_checkable_by_three_frames_of_five(rays: tuple[int, ...], expected: bool) -> None:
    assert is_checkable(np.array(rays, dtype=np.int64)) is expected
