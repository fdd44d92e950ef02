# SPDX-License-Identifier: Apache-2.0
"""A proposal in another frame: what turns, what is added, what stays, and the way back."""

import math

import pytest
import torch

from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import PROPOSAL_DIM, move_proposal, reset_origin


def proposals(count: int = 20) -> torch.Tensor:
    return torch.randn(count, PROPOSAL_DIM, generator=torch.Generator().manual_seed(3))


def turned(vectors: torch.Tensor, angle: float) -> torch.Tensor:
    """Vectors (N, 2), turned anticlockwise."""
    c, s = math.cos(angle), math.sin(angle)
    return torch.stack((c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]), 1)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_vectors_turn_heights_add_and_the_rest_stays(yaw: float) -> None:
    """An axis is an angle modulo pi, as a vector of twice the angle."""
    before, height = proposals(), torch.linspace(-2, 2, 20)
    after = move_proposal(before, torch.tensor(yaw), height)
    wanted = before.clone()
    wanted[:, BOX_LAYOUT.z] += height[:, None]
    for column, angle in ((BOX_LAYOUT.offset, yaw), (BOX_LAYOUT.direction, yaw), (BOX_LAYOUT.velocity, yaw)):
        wanted[:, column] = turned(before[:, column], angle)
    wanted[:, BOX_LAYOUT.axis] = turned(before[:, BOX_LAYOUT.axis], 2 * yaw)
    torch.testing.assert_close(after, wanted, atol=1e-5, rtol=1e-5)
    back = move_proposal(after, torch.tensor(-yaw), -height)
    torch.testing.assert_close(back, before, atol=1e-5, rtol=1e-5)


def test_another_origin_changes_offsets_alone() -> None:
    before, shift = proposals(), torch.tensor([[3.0, -1.0]]).expand(20, 2)
    changed = reset_origin(before, shift) - before
    torch.testing.assert_close(changed[:, BOX_LAYOUT.offset], shift.clone(), atol=1e-5, rtol=1e-5)
    changed[:, BOX_LAYOUT.offset] = 0
    assert not changed.any()
