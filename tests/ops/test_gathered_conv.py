# SPDX-License-Identifier: Apache-2.0
"""The gathered product of other devices against the product of pairs, by every kind of layer, in values and gradients."""

import pytest
import torch

from manyeyes.datatypes import BevGrid, Sites, SparseBev
from manyeyes.ops import gathered_conv
from manyeyes.ops.sparse_conv import inverse_conv, same_sites_map, strided_conv, strided_map, submanifold_conv
from manyeyes.ops.sparse_index import Window

GRID = BevGrid(-6.4, -4.0, -1.0, 6.4, 4.0, 1.0)


def make_map(count: int = 150, channels: int = 6, batch_size: int = 2) -> SparseBev:
    random = torch.Generator().manual_seed(0)
    rows, columns = GRID.shape
    key = torch.randperm(batch_size * rows * columns, generator=random)[:count].sort().values
    features = torch.randn(count, channels, generator=random, dtype=torch.float64)
    return SparseBev(features, Sites(key, GRID, batch_size))


def by_pairs(x, weight, kind, sites):
    if kind == "same":
        return submanifold_conv(x, weight).features
    if kind == "down":
        return strided_conv(x, weight).features
    return inverse_conv(x, weight, sites).features


def tables(kind, x, fine):
    """The map of a layer, and its map turned round."""
    if kind == "same":
        table = same_sites_map(x.sites, 3)
        return table.index, table.back
    table = strided_map(fine.sites, Window(3, 2, 1))[1]
    return (table.index, table.back) if kind == "down" else (table.back, table.index)


@pytest.mark.parametrize("kind", ["same", "down", "up"])
@pytest.mark.parametrize("max_gathered", [1 << 27, 1000, 1])
def test_it_equals_the_product_of_pairs(monkeypatch, kind, max_gathered):
    monkeypatch.setattr(gathered_conv, "MAX_GATHERED", max_gathered)
    fine = make_map()
    coarse = strided_map(fine.sites, Window(3, 2, 1))[0]
    random = torch.Generator().manual_seed(1)
    rows = torch.randn(len(coarse), 6, generator=random, dtype=torch.float64)
    x = SparseBev(rows, coarse) if kind == "up" else fine
    shape = (6, 5, 3, 3) if kind == "up" else (5, 6, 3, 3)
    weight = torch.randn(shape, generator=random, dtype=torch.float64).requires_grad_()
    features = x.features.requires_grad_()
    wanted = by_pairs(x.with_features(features), weight, kind, fine.sites)
    turned = weight.transpose(0, 1) if kind == "up" else weight
    taps = turned.permute(2, 3, 1, 0).reshape(9, 6, 5)
    got = gathered_conv.gathered_conv(features, taps, *tables(kind, x, fine))
    assert got.shape == wanted.shape and torch.allclose(got, wanted, atol=1e-12)
    pull = wanted.detach().sin()
    for mine, its in zip(
        *(torch.autograd.grad((out * pull).sum(), (features, weight)) for out in (got, wanted)), strict=True
    ):
        assert torch.allclose(mine, its, atol=1e-11) and bool(mine.any())


def test_no_sites():
    none = make_map(0)
    table = same_sites_map(none.sites, 3)
    out = gathered_conv.gathered_conv(none.features, torch.randn(9, 6, 5, dtype=torch.float64), table.index, table.back)
    assert out.shape == (0, 5)


def test_a_layer_on_a_device_equals_that_of_the_cpu(device):
    x, weight = make_map(), torch.randn(5, 6, 3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    there = x.to(device)
    for layer in (submanifold_conv, strided_conv):
        ours, theirs = layer(x, weight), layer(there, weight.to(device))
        assert theirs.features.device == device
        assert torch.equal(ours.sites.key, theirs.sites.key.cpu())
        assert torch.allclose(ours.features, theirs.features.cpu(), atol=1e-12)
