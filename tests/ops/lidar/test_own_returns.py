# SPDX-License-Identifier: Apache-2.0
"""Returns from the own vehicle are removed, and no others."""

import torch

from manyeyes.datatypes import AgentBody, PointCloud
from manyeyes.ops.lidar.own_returns import remove_own_returns


def test_returns_in_the_body_are_those_that_the_box_contains() -> None:
    body = AgentBody((1.4, -0.3, 0.9), (4.9, 2.1, 1.8), 0.4)
    xyz = (torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)) - 0.4) * torch.tensor([9.0, 9.0, 3.0])
    cloud = PointCloud.of(xyz, torch.arange(20_000.0))
    kept = remove_own_returns(cloud, body, 0.1)
    inside = body.contains(xyz, 0.1)
    assert 1000 < int(inside.sum()) < 10_000
    assert torch.equal(kept.xyz, xyz[~inside]) and torch.equal(kept.intensity, cloud.intensity[~inside])


def test_a_cloud_without_own_returns_is_the_same_object() -> None:
    cloud = PointCloud.of(torch.tensor([[10.0, 0.0, 1.0], [0.0, 4.0, 1.0], [0.0, 0.0, 3.0]]))
    assert remove_own_returns(cloud, AgentBody.standing(0.0, 0.0, (5.0, 2.0, 1.6))) is cloud
    assert remove_own_returns(cloud, None) is cloud and len(remove_own_returns(cloud[:0], None)) == 0
