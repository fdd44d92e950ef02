# SPDX-License-Identifier: Apache-2.0
"""Sampling between cells equals a dense grid_sample of the same features, in values and gradients."""

import pytest
import torch
from torch.nn import functional

from manyeyes.datatypes import BevGrid, Sites, SparseBev
from manyeyes.ops.sparse_sample import bilinear


def sparse(stride: int, n: int = 40) -> SparseBev:
    rng = torch.Generator().manual_seed(stride)
    grid = BevGrid(-8.0, -4.0, -3.0, 8.0, 4.0, 3.0, stride=stride)
    rows, columns = grid.shape
    key = torch.randperm(rows * columns, generator=rng)[: min(n, rows * columns // 2)].sort().values
    return SparseBev(torch.randn(len(key), 5, generator=rng), Sites(key, grid))


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_sampling_equals_dense_grid_sample(stride):
    x = sparse(stride)
    grid, rng = x.grid, torch.Generator().manual_seed(7)
    xy = (torch.rand(200, 2, generator=rng) - 0.5) * torch.tensor([20.0, 12.0])
    features = x.features.clone().requires_grad_(True)
    found = bilinear(x.with_features(features), xy)

    dense_features = x.features.clone().requires_grad_(True)
    rows, columns = grid.shape
    cell = (xy - torch.tensor([grid.x_min, grid.y_min])) / grid.pillar
    place = ((cell - 0.5) / stride) * 2 / (torch.tensor([columns, rows]) - 1) - 1
    dense = x.with_features(dense_features).dense()
    wanted = functional.grid_sample(dense, place[None, None], align_corners=True)[0, :, 0].T
    torch.testing.assert_close(found, wanted, atol=1e-4, rtol=1e-4)
    weight = torch.randn(found.shape, generator=rng)
    (found * weight).sum().backward()
    (wanted * weight).sum().backward()
    torch.testing.assert_close(features.grad, dense_features.grad, atol=1e-4, rtol=1e-4)
    assert float(found.detach().abs().max()) > 0.5


def test_sampling_at_a_centre_is_the_cell_and_outside_is_zero():
    x = sparse(4)
    torch.testing.assert_close(bilinear(x, x.sites.xy), x.features, atol=1e-5, rtol=1e-5)
    assert not bilinear(x, torch.tensor([[500.0, 0.0], [-500.0, 3.0]])).any()
    empty = SparseBev(torch.zeros(0, 5), Sites(torch.zeros(0, dtype=torch.int64), x.grid))
    assert bilinear(empty, torch.zeros(3, 2)).shape == (3, 5)
