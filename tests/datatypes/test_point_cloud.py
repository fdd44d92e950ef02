# SPDX-License-Identifier: Apache-2.0
"""Clouds moved in one pass, and parts of them, equal the operations of tensors."""

import pytest
import torch

from manyeyes.datatypes import PointCloud, ShapeError, Transform


def cloud(n: int) -> PointCloud:
    random = torch.Generator().manual_seed(n)
    return PointCloud.of(torch.randn(n, 3, generator=random) * 40, torch.rand(n, generator=random), torch.arange(n))


@pytest.mark.parametrize("points", [0, 1, 5, 3000])
def test_a_moved_cloud_is_that_of_the_transform(points: int) -> None:
    some = cloud(points)
    angles = torch.tensor([0.02, -0.03, 1.3], dtype=torch.float64)
    motion = Transform.from_rpy(torch.tensor([120.0, -3.0, 0.4], dtype=torch.float64), *angles)
    for transform in (motion, motion.inverse()):
        moved, wanted = some.transform(transform), transform.apply(some.xyz.double())
        assert moved.xyz.dtype == torch.float32
        assert torch.allclose(moved.xyz.double(), wanted, rtol=0, atol=3e-5)
        assert torch.equal(moved.intensity, some.intensity) and torch.equal(moved.time_s, some.time_s)


def test_strided_points_and_gradients_take_part() -> None:
    some = cloud(12)
    half = PointCloud(some.xyz[::2], some.intensity[::2], some.time_s[::2])
    motion = Transform.from_xyz_yaw(1.0, 2.0, 3.0, 0.5)
    assert torch.equal(half.transform(motion).xyz, some.transform(motion).xyz[::2])
    xyz = some.xyz.clone().requires_grad_()
    PointCloud(xyz, some.intensity, some.time_s).transform(motion).xyz.sum().backward()
    assert xyz.grad is not None and xyz.grad.abs().sum() > 0


def test_a_mask_selects_the_same_rows_of_every_field() -> None:
    some, mask = cloud(50), torch.rand(50, generator=torch.Generator().manual_seed(0)) < 0.4
    part = some[mask]
    assert 5 < len(part) < 45
    for name in ("xyz", "intensity", "time_s"):
        assert torch.equal(getattr(part, name), getattr(some, name)[mask])


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_point_that_is_not_finite_is_refused_and_a_large_sum_is_not(bad: float) -> None:
    points = torch.zeros(9, 3)
    points[4, 1] = bad
    with pytest.raises(ShapeError, match="1 of 9 points"):
        PointCloud.of(points)
    assert len(PointCloud.of(torch.full((9, 3), 3e38))) == 9


@pytest.mark.parametrize("kept", [0, 7, 50])
def test_a_mask_selects_rows_of_strided_fields_and_of_fields_with_gradients(kept: int) -> None:
    whole, mask = cloud(100), torch.arange(50) < kept
    some = PointCloud(whole.xyz[::2], whole.intensity[::2], whole.time_s[::2])
    assert torch.equal(some[mask].xyz, some.xyz[:kept]) and torch.equal(some[mask].time_s, some.time_s[:kept])
    xyz = some.xyz.clone().requires_grad_()
    PointCloud(xyz, some.intensity, some.time_s)[mask].xyz.sum().backward()
    assert xyz.grad is not None and float(xyz.grad.sum()) == 3 * kept


def test_a_scaled_cloud_has_the_products_of_tensors() -> None:
    some, factors = cloud(500), (1.03, -1.03, 0.97)
    assert torch.equal(some.scale(factors).xyz, some.xyz * torch.tensor(factors))
    xyz = some.xyz.clone().requires_grad_()
    PointCloud(xyz, some.intensity, some.time_s).scale(factors).xyz.sum().backward()
    assert xyz.grad is not None and torch.allclose(xyz.grad[0], torch.tensor(factors))
