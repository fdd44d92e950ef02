# SPDX-License-Identifier: Apache-2.0
import pytest
import torch
from torch.nn import functional

from manyeyes.datatypes import Boxes, ShapeError, Transform
from manyeyes.datatypes.keypoints import Keypoints


def some(n: int = 4) -> Keypoints:
    center = torch.arange(3.0 * n).reshape(n, 3)
    descriptor = functional.normalize(torch.randn(n, 32, generator=torch.Generator().manual_seed(0)))
    return Keypoints(Boxes.of(center, torch.ones(n, 3), torch.zeros(n)), descriptor)


def test_points_move_and_descriptors_stay():
    points = some()
    moved = points.transform(Transform.from_xyz_yaw(10.0, 0.0, 0.0, torch.pi / 2))
    torch.testing.assert_close(moved.xy[1], torch.tensor([10.0 - 4.0, 3.0]))
    assert torch.equal(moved.descriptor, points.descriptor)
    assert len(points[torch.tensor([2, 0])]) == 2 and torch.equal(points[torch.tensor([2, 0])].xy[0], points.xy[2])


def test_a_descriptor_too_few_is_refused():
    with pytest.raises(ShapeError, match=r"descriptors \(4, D\); got \(3, 32\)"):
        Keypoints(some().boxes, some().descriptor[:3])
