# SPDX-License-Identifier: Apache-2.0
"""The box of an agent's own vehicle: checked values, points in it, and another frame."""

import math

import pytest
import torch

from manyeyes.datatypes import AgentBody, AgentFrame, ShapeError, Transform

BODY = AgentBody.standing(1.4, 0.0, (4.9, 2.0, 1.6))


def test_a_standing_body_holds_its_middle_and_not_what_is_beside_it() -> None:
    assert BODY.center == (1.4, 0.0, 0.8)
    points = torch.tensor([[1.4, 0.0, 0.8], [3.8, 0.9, 1.5], [3.9, 0.0, 0.8], [0.0, 1.1, 0.8], [0.0, 0.0, 1.7]])
    assert BODY.contains(points).tolist() == [True, True, False, False, False]
    assert BODY.contains(points, 0.2).tolist() == [True] * 5
    assert BODY.contains_xy(points[:, :2]).tolist() == [True, True, False, False, True]


def test_a_body_moves_with_the_frame() -> None:
    new_from_agent = Transform.from_xyz_yaw(1.0, -2.0, 0.3, math.pi / 2)
    moved = BODY.moved(new_from_agent)
    assert moved.center == pytest.approx((1.0, -0.6, 1.1)) and moved.yaw_rad == pytest.approx(math.pi / 2)
    points = (torch.rand(500, 3, dtype=torch.float64) - 0.4) * torch.tensor([6.0, 4.0, 3.0])
    assert torch.equal(moved.contains(new_from_agent.apply(points)), BODY.contains(points))
    frame = AgentFrame.of(points, Transform.identity(), body=BODY)
    assert frame.moved(new_from_agent).body == moved


@pytest.mark.parametrize(
    "center, size, yaw",
    [
        ((math.nan, 0, 0), (4, 2, 1), 0.0),
        ((0, 0, 0), (4, 2, 1), math.inf),
        ((21, 0, 0), (4, 2, 1), 0.0),
        ((0, 0, 0), (0, 2, 1), 0.0),
        ((0, 0, 0), (26, 2, 1), 0.0),
    ],
)
def test_values_that_no_vehicle_has_are_refused(
    center: tuple[float, float, float], size: tuple[float, float, float], yaw: float
) -> None:
    with pytest.raises(ShapeError, match="AgentBody needs"):
        AgentBody(center, size, yaw)
