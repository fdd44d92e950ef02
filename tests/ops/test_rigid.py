# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch

from manyeyes.datatypes import ShapeError, Transform
from manyeyes.ops.rigid import fit_rigid, fit_se2


def points(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 10


def move(pose, xy):
    x, y, yaw = pose.unbind(-1)
    c, s = yaw.cos()[..., None], yaw.sin()[..., None]
    return torch.stack(
        (c * xy[..., 0] - s * xy[..., 1] + x[..., None], s * xy[..., 0] + c * xy[..., 1] + y[..., None]), -1
    )


@pytest.mark.parametrize("yaw", [0.0, 0.4, 3.0, -3.1415])
def test_exact_points_are_recovered_in_the_plane(yaw):
    pose = torch.tensor([[30.0, -4.0, yaw], [5000.0, 2.0, -yaw]], dtype=torch.float64)
    source = points(2, 6, 2)
    torch.testing.assert_close(fit_se2(source, move(pose, source)), pose, atol=1e-9, rtol=0)


def test_exact_points_are_recovered_in_space():
    angles = points(4, 3, seed=1) / 10
    pose = Transform.from_rpy(points(4, 3, seed=2), *angles.unbind(-1))
    source = points(4, 7, 3)
    got = fit_rigid(source, pose.apply(source))
    torch.testing.assert_close(got.rotation, pose.rotation, atol=1e-9, rtol=0)
    torch.testing.assert_close(got.translation, pose.translation, atol=1e-9, rtol=0)


def test_the_plane_is_a_slice_of_space():
    """Two far, heavy points on the vertical axis leave the spatial fit only the plane to turn in."""
    source, target, weight = points(9, 2), points(9, 2, seed=1), points(9, seed=2).abs()
    flat = fit_se2(source, target, weight)
    source, target = (v - (weight[:, None] * v).sum(0) / weight.sum() for v in (source, target))
    pole = torch.tensor([[0, 0, 1e4], [0, 0, -1e4]], dtype=torch.float64)
    p, q = (torch.cat((torch.nn.functional.pad(v, (0, 1)), pole)) for v in (source, target))
    got = fit_rigid(p, q, torch.cat((weight, torch.ones(2, dtype=torch.float64))))
    assert got.yaw.item() == pytest.approx(flat[2].item(), abs=1e-9)


def cost(pose, source, target, weight):
    return (weight * (move(pose, source) - target).square().sum(-1)).sum()


def test_noisy_points_reach_the_minimum_of_the_weighted_cost():
    source, target, weight = points(20, 2), points(20, 2, seed=1), points(20, seed=2).abs()
    pose = fit_se2(source, target, weight).requires_grad_(True)
    best = cost(pose, source, target, weight)
    best.backward()
    assert pose.grad.abs().max() < 1e-8 * best.item()
    for step in torch.eye(3, dtype=torch.float64) * 0.05:
        assert cost(pose + step, source, target, weight) > best
        assert cost(pose - step, source, target, weight) > best
    assert cost(fit_se2(source, target), source, target, weight) > best


def test_a_weight_is_a_multiplicity_and_zero_removes():
    source, target = points(5, 3), points(5, 3, seed=1)
    weight = torch.tensor([1.0, 3, 0, 1, 1], dtype=torch.float64)
    rows = [0, 1, 1, 1, 3, 4]
    for fit, axes in ((fit_se2, 2), (fit_rigid, 3)):
        a = fit(source[:, :axes], target[:, :axes], weight)
        b = fit(source[rows, :axes], target[rows, :axes])
        a, b = (v if isinstance(v, torch.Tensor) else v.matrix() for v in (a, b))
        torch.testing.assert_close(a, b, atol=1e-10, rtol=0)


def test_a_mirror_image_is_answered_by_a_rotation():
    source = points(8, 3)
    got = fit_rigid(source, source * torch.tensor([1.0, 1.0, -1.0]))
    assert torch.det(got.rotation).item() == pytest.approx(1.0)
    target, even = source[:, :2] * torch.tensor([1.0, -1.0]), torch.ones(8, dtype=torch.float64)
    mirrored = fit_se2(source[:, :2], target)
    for yaw in torch.linspace(-3, 3, 25, dtype=torch.float64):
        other = torch.cat((torch.zeros(2, dtype=torch.float64), yaw[None]))
        other[:2] = (target - move(other, source[:, :2])).mean(0)
        assert cost(mirrored, source[:, :2], target, even) <= cost(other, source[:, :2], target, even) + 1e-9
    flat = torch.cat(
        (points(8, 2), torch.zeros(8, 1, dtype=torch.float64)), 1
    )  # coplanar: the third singular value is 0
    turned = Transform.from_xyz_yaw(1, 2, 3, 2.5)
    torch.testing.assert_close(fit_rigid(flat, turned.apply(flat)).rotation, turned.rotation, atol=1e-9, rtol=0)


def test_gradients():
    source, target = points(6, 2).requires_grad_(True), points(6, 2, seed=1).requires_grad_(True)
    weight = (points(6, seed=2).abs() + 0.1).requires_grad_(True)
    assert torch.autograd.gradcheck(fit_se2, (source, target, weight))
    pose = Transform.from_xyz_yaw(1, 2, 3, 0.5)
    p = points(6, 3).requires_grad_(True)
    q = (pose.apply(points(6, 3)) + points(6, 3, seed=3) / 30).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda a, b, w: fit_rigid(a, b, w).matrix()[:3], (p, q, weight), atol=1e-4)


def test_degenerate_sets_give_finite_values_and_gradients():
    for n in (0, 1):
        source, target = (points(n, 2, seed=k).requires_grad_(True) for k in (0, 1))
        got = fit_se2(source, target)
        got.sum().backward()
        assert got[2] == 0 and torch.isfinite(source.grad).all() and torch.isfinite(target.grad).all()
        if n:
            torch.testing.assert_close(got[:2], (target - source)[0])
    assert fit_se2(points(4, 2), points(4, 2, seed=1), torch.zeros(4, dtype=torch.float64)).tolist() == [0, 0, 0]
    same = torch.ones(3, 2, dtype=torch.float64)
    assert fit_se2(same, same * 3).tolist() == [2, 2, 0]
    assert math.isclose(torch.det(fit_rigid(points(1, 3), points(1, 3, seed=1)).rotation).item(), 1, abs_tol=1e-9)


def test_misshapen_input():
    with pytest.raises(ShapeError, match=r"\(\.\.\., N, 2\)"):
        fit_se2(points(4, 3), points(4, 3))
    with pytest.raises(ShapeError, match="one a point"):
        fit_rigid(points(4, 3), points(4, 3), torch.ones(3))
