# SPDX-License-Identifier: Apache-2.0
"""One pose is computed on numbers, a batch by tensors: same bits, and gradients where they are required."""

import math

import pytest
import torch

from manyeyes.datatypes import Transform


def test_one_pose_has_the_bits_of_a_batch() -> None:
    angles = torch.randn(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    angles[::7, :2] = 0
    batch = Transform.from_rpy(torch.zeros(200, 3, dtype=torch.float64), *angles.unbind(1))
    for row, rpy in enumerate(angles):
        assert torch.equal(Transform.from_rpy(torch.zeros(3, dtype=torch.float64), *rpy).rotation, batch.rotation[row])
        assert torch.equal(Transform.from_angles((0, 0, 0), rpy.tolist()).rotation, batch.rotation[row])


def test_gradients_reach_the_angles_of_one_pose() -> None:
    yaw = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    zero = torch.zeros((), dtype=torch.float64)
    Transform.from_rpy(torch.zeros(3, dtype=torch.float64), zero, zero, yaw).rotation[1, 0].backward()
    assert float(yaw.grad if yaw.grad is not None else 0) == pytest.approx(math.cos(0.3))
