# SPDX-License-Identifier: Apache-2.0
"""Moving pictures of the ground, and the maximum over those that saw: hand-worked cases, a loop, and laws."""

import itertools
import math

import pytest
import torch

from manyeyes.datatypes import BevGrid, ShapeError, Transform
from manyeyes.ops.bev_warp import MIN_SEEN_FRACTION, masked_max, warp_bev

SMALL = BevGrid(-4.0, -3.0, -1.0, 4.0, 3.0, 1.0, pillar=1.0)
TILE = BevGrid(-8.0, -8.0, -1.0, 8.0, 8.0, 1.0, pillar=1.0)


def one(x=0.0, y=0.0, yaw=0.0):
    return Transform.stack([Transform.from_xyz_yaw(x, y, 0.0, yaw)])


def slowly(features, seen, source, target, motion):
    """Every target cell by itself."""
    rows, columns = target.shape
    out = features.new_zeros(features.shape[1], rows, columns)
    visible = torch.zeros(rows, columns, dtype=torch.bool)
    back = motion.inverse()
    for r in range(rows):
        for c in range(columns):
            place = target.centers(torch.tensor([[r, c]])).double()
            x, y = back.apply(torch.cat((place, torch.zeros(1, 1, dtype=torch.float64)), 1))[0, :2].tolist()
            column = ((x - source.x_min) / source.pillar - 0.5) / source.stride
            row = ((y - source.y_min) / source.pillar - 0.5) / source.stride
            total, weight = features.new_zeros(features.shape[1]), 0.0
            for i in (math.floor(row), math.floor(row) + 1):
                for j in (math.floor(column), math.floor(column) + 1):
                    if 0 <= i < source.shape[0] and 0 <= j < source.shape[1] and bool(seen[0, i, j]):
                        share = (1 - abs(row - i)) * (1 - abs(column - j))
                        total, weight = total + share * features[0, :, i, j], weight + share
            if weight > MIN_SEEN_FRACTION:
                out[:, r, c], visible[r, c] = total / weight, True
    return out, visible


@pytest.mark.parametrize("stride", [1, 2])
def test_values_and_gradients_are_those_of_the_loop(stride):
    generator = torch.Generator().manual_seed(stride)
    source = BevGrid(-4.0, -3.0, -1.0, 4.0, 3.0, 1.0, pillar=1.0 / stride, stride=stride)
    features = torch.randn(1, 2, *source.shape, generator=generator, dtype=torch.float64, requires_grad=True)
    seen = torch.rand(1, *source.shape, generator=generator) > 0.3
    motion = Transform.from_xyz_yaw(1.3, -0.7, 4.0, 0.6)
    fast, visible = warp_bev(features, seen, source, TILE, Transform.stack([motion]))
    slow, expected = slowly(features, seen, source, TILE, motion)
    assert torch.equal(visible[0], expected) and 10 < int(expected.sum()) < expected.numel()
    assert torch.allclose(fast[0], slow, atol=1e-6)
    aim = torch.randn(slow.shape, generator=generator, dtype=torch.float64)
    mine = torch.autograd.grad((fast[0] * aim).sum(), features)[0]
    theirs = torch.autograd.grad((slow * aim).sum(), features)[0]
    assert torch.allclose(mine, theirs, atol=1e-6) and float(theirs.abs().max()) > 0.1


def test_a_quarter_turn_carries_each_cell_to_its_place():
    features = torch.zeros(1, 1, *SMALL.shape)
    # A cell centred on x = 3.5, y = 0.5 stands at x = -0.5 + 2, y = 3.5 after a turn to the left and 2 m ahead.
    features[0, 0, 3, 7] = 5.0
    moved, seen = warp_bev(
        features, torch.ones(1, *SMALL.shape, dtype=torch.bool), SMALL, TILE, one(2.0, 0.0, math.pi / 2)
    )
    row, column = TILE.cells(torch.tensor([[1.5, 3.5]]))[0].tolist()
    assert float(moved[0, 0, row, column]) == pytest.approx(5.0, abs=1e-5)
    assert float(moved.sum()) == pytest.approx(5.0, abs=1e-4) and int(seen.sum()) == 48


def test_height_and_tilt_do_not_move_the_ground():
    features = torch.randn(1, 2, *SMALL.shape)
    seen = torch.ones(1, *SMALL.shape, dtype=torch.bool)
    flat = Transform.from_xyz_yaw(1.0, 2.0, 0.0, 0.4)
    zero = torch.zeros((), dtype=torch.float64)
    tilted = Transform.from_rpy(torch.tensor([1.0, 2.0, 30.0], dtype=torch.float64), zero, zero + 0.02, zero + 0.4)
    a, b = (warp_bev(features, seen, SMALL, TILE, Transform.stack([t]))[0] for t in (flat, tilted))
    assert torch.allclose(a, b, atol=1e-5)


def test_negative_features_are_kept_at_the_border_of_the_view():
    features = torch.tensor([-3.0, -1.0]).view(1, 2, 1, 1, 1).expand(1, 2, 1, 1, 4)
    seen = torch.tensor([[[[True, True, False, False]], [[True, False, True, False]]]])
    fused = masked_max(features, seen, torch.tensor([7.0]))
    assert fused.flatten().tolist() == [-1.0, -3.0, -1.0, 7.0]


def test_the_maximum_is_invariant_to_order_and_to_agents_without_coverage():
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(2, 4, 3, 5, 6, generator=generator)
    seen = torch.rand(2, 4, 5, 6, generator=generator) > 0.4
    null = torch.randn(3, generator=generator)
    fused = masked_max(features, seen, null)
    order = torch.tensor([2, 0, 3, 1])
    assert torch.equal(fused, masked_max(features[:, order], seen[:, order], null))
    blind = torch.cat((features, torch.full_like(features[:, :1], 1e9)), 1)
    assert torch.equal(fused, masked_max(blind, torch.cat((seen, torch.zeros_like(seen[:, :1])), 1), null))


def test_the_maximum_is_that_of_the_loop_in_values_and_gradients():
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(2, 4, 3, 5, 6, generator=generator, dtype=torch.float64).requires_grad_()
    seen = torch.rand(2, 4, 5, 6, generator=generator) > 0.6
    null = torch.randn(3, generator=generator, dtype=torch.float64).requires_grad_()
    weight = torch.randn(2, 3, 5, 6, generator=generator, dtype=torch.float64)
    cells = []
    for b, c, row, column in itertools.product(range(2), range(3), range(5), range(6)):
        those = [features[b, k, c, row, column] for k in range(4) if seen[b, k, row, column]]
        cells.append(torch.stack(those).max() if those else null[c])
    slow, fast = torch.stack(cells).view(2, 3, 5, 6), masked_max(features, seen, null)
    assert torch.equal(slow, fast)
    for one, other in zip(*(torch.autograd.grad((out * weight).sum(), (features, null)) for out in (slow, fast))):
        assert torch.allclose(one, other, atol=1e-12)


def test_gradients_go_to_the_largest_observed_feature_else_to_null():
    features = torch.tensor([[1.0, 5.0, 2.0]]).T.view(1, 3, 1, 1, 1).repeat(1, 1, 1, 1, 2).requires_grad_()
    seen = torch.tensor([[True, False], [False, False], [True, False]]).view(1, 3, 1, 2)
    null = torch.zeros(1, requires_grad=True)
    masked_max(features, seen, null).sum().backward()
    assert features.grad is not None and features.grad.flatten().tolist() == [0, 0, 0, 0, 1, 0]
    assert null.grad is not None and null.grad.tolist() == [1]


def test_features_of_another_grid_are_refused():
    with pytest.raises(ShapeError, match="warp_bev needs features"):
        warp_bev(torch.zeros(1, 2, 3, 3), torch.ones(1, 3, 3, dtype=torch.bool), SMALL, TILE, one())
