# SPDX-License-Identifier: Apache-2.0
"""Layers in one call: what each convolution, bias and ReLU of them gives by itself."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from manyeyes.datatypes import BevGrid, Sites, SparseBev
from manyeyes.ops._sparse_conv_kernels import HAS_BFLOAT16, empty_rows, panels, round_rows
from manyeyes.ops.folded_conv import FoldedConvs, FoldedUp, NormedConv, is_supported
from manyeyes.ops.sparse_conv import (
    inverse_conv,
    inverse_map,
    same_sites_map,
    strided_conv,
    strided_map,
    submanifold_conv,
)
from manyeyes.ops.sparse_index import Window

GROUND = BevGrid(-12.8, -6.4, -3.0, 12.8, 6.4, 1.0)


def scene(channels: int, share: float = 0.4) -> SparseBev:
    random = torch.Generator().manual_seed(channels)
    rows, columns = GROUND.shape
    key = (torch.rand(2 * rows * columns, generator=random) < share).nonzero()[:, 0]
    return SparseBev(torch.randn(len(key), channels, generator=random), Sites(key, GROUND, 2))


def layer(inputs: int, outputs: int, kernel: int, seed: int) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(seed)
    weight = torch.randn(outputs, inputs, kernel, kernel, generator=random) / (kernel * inputs**0.5)
    return weight, torch.randn(outputs, generator=random)


@pytest.mark.parametrize("channels", [16, 32, 48, 64, 112, 128, 256])
@pytest.mark.parametrize("layers", [1, 2, 3])
@torch.no_grad()
def test_a_run_of_layers_equals_one_after_another(channels: int, layers: int) -> None:
    x = scene(channels)
    convs = [layer(channels, channels, 3, seed) for seed in range(layers)]
    folded, wanted, before = FoldedConvs.of(*zip(*convs)), x, x.features.clone()
    for weight, bias in convs:
        wanted = wanted.with_features(torch.relu(submanifold_conv(wanted, weight.double(), bias.double()).features))
    assert folded is not None and is_supported(x.features)
    got = folded(x.features, same_sites_map(x.sites, kernel=3))
    assert torch.equal(x.features, before) and float(wanted.features.abs().max()) > 0.5
    assert 0.2 < float((wanted.features == 0).float().mean()) < 0.8
    assert torch.allclose(got, wanted.features.float(), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("inputs", "outputs"), [(5, 32), (32, 16), (64, 128)])
@pytest.mark.parametrize("dilating", [False, True])
@torch.no_grad()
def test_a_strided_layer_and_one_without_neighbours(inputs: int, outputs: int, dilating: bool) -> None:
    x = scene(inputs, share=0.15)
    weight, bias = layer(inputs, outputs, 3, seed=0)
    folded = FoldedConvs.of([weight], [bias])
    assert folded is not None
    wanted = torch.relu(strided_conv(x, weight, bias, dilating=dilating).features)
    sites, table = strided_map(x.sites, Window(3, 2, 1), dilating)
    got = folded(x.features, table)
    assert got.shape == (len(sites), outputs)
    assert torch.allclose(got, wanted, atol=1e-5)
    weight, bias = layer(inputs, outputs, 1, seed=1)
    alone = FoldedConvs.of([weight], [bias])
    assert alone is not None
    wanted = torch.relu(x.features @ weight[:, :, 0, 0].T + bias)
    assert torch.allclose(alone(x.features, same_sites_map(x.sites, kernel=1)), wanted, atol=1e-5)


@pytest.mark.parametrize(("inputs", "outputs"), [(64, 64), (48, 48), (128, 64)])
@torch.no_grad()
def test_a_layer_whose_rows_are_normed(inputs: int, outputs: int) -> None:
    x, (weight, _), norm = scene(inputs), layer(inputs, outputs, 3, seed=0), nn.LayerNorm(outputs, eps=1e-3)
    nn.init.normal_(norm.weight)
    nn.init.normal_(norm.bias)
    wanted, is_skipped = norm(submanifold_conv(x, weight).features), inputs == outputs
    wanted = torch.relu(wanted + x.features if is_skipped else wanted)
    folded, before = NormedConv.of(weight, norm, is_skipped), x.features.clone()
    assert folded is not None
    got = folded(x.features, same_sites_map(x.sites, kernel=3))
    assert torch.equal(x.features, before) and float(wanted.max()) > 1
    assert torch.allclose(got, wanted, atol=1e-5)


@torch.no_grad()
def test_no_sites() -> None:
    x = scene(16, share=0.0)
    folded = FoldedConvs.of(*zip(*(layer(16, 16, 3, seed) for seed in range(2))))
    assert folded is not None
    assert folded(x.features, same_sites_map(x.sites, kernel=3)).shape == (0, 16)


def test_unsupported_layers_are_not_compiled() -> None:
    assert FoldedConvs.of(*zip(layer(16, 24, 3, seed=0))) is None
    assert FoldedConvs.of([], []) is None
    assert NormedConv.of(layer(16, 24, 3, seed=0)[0], nn.LayerNorm(24), is_skipped=False) is None
    assert not is_supported(torch.zeros(1, 16))  # A gradient might be asked for.
    with torch.no_grad():
        assert is_supported(torch.zeros(1, 16))
        assert not is_supported(torch.zeros(1, 16, dtype=torch.float64))


def test_panels_hold_every_column_once() -> None:
    taps = torch.arange(2 * 3 * 192.0).view(2, 3, 192)
    cut = panels(taps)
    assert np.array_equal(np.concatenate([cut[:, q] for q in range(cut.shape[1])], 2), taps.numpy())


def test_rows_begin_with_a_line_of_the_cache() -> None:
    blocks = [empty_rows(n, 16) for n in (0, 1, 7, 1000, 5000)]
    assert [b.shape[0] for b in blocks] == [0, 1, 7, 1000, 5000]
    assert all(b.ctypes.data % 64 == 0 and b.flags.c_contiguous for b in blocks)
    for block in blocks:
        block[:] = len(block)
    assert all((block == len(block)).all() for block in blocks)
    assert all(not np.shares_memory(a, b) for a, b in pairwise(blocks))


@pytest.mark.parametrize("channels", [1, 6, 33, 64])
def test_rows_are_rounded_to_the_nearest_bfloat16(channels: int) -> None:
    x = torch.randn(50, channels, generator=torch.Generator().manual_seed(1))
    x[0], x[1, 0] = 0.0, 1.00390625  # halfway between two, to the even one
    pairs = torch.from_numpy(round_rows(x.numpy())).view(torch.bfloat16).view(50, -1)
    assert torch.equal(pairs[:, :channels], x.bfloat16())
    assert not pairs[:, channels:].any()


@pytest.mark.skipif(not HAS_BFLOAT16, reason="this processor has no products of bfloat16")
@pytest.mark.parametrize(("inputs", "outputs"), [(16, 16), (33, 32), (64, 112), (128, 256)])
@torch.no_grad()
def test_products_of_bfloat16_are_those_of_rounded_numbers(inputs: int, outputs: int) -> None:
    x, (weight, bias) = scene(inputs), layer(inputs, outputs, 3, seed=0)
    folded = FoldedConvs.of([weight], [bias], in_bfloat16=True)
    assert folded is not None and folded.weight.dtype == torch.int32
    rounded = x.with_features(x.features.bfloat16().double())
    wanted = torch.relu(submanifold_conv(rounded, weight.bfloat16().double(), bias.double()).features).float()
    assert torch.allclose(folded(x.features, same_sites_map(x.sites, 3)), wanted, atol=1e-4, rtol=1e-4)
    exact = torch.relu(submanifold_conv(x, weight, bias).features)
    assert 1e-4 < float((wanted - exact).abs().max()) < 0.05 * float(exact.abs().max())


@torch.no_grad()
def test_an_inverse_convolution_with_its_lateral_layer() -> None:
    fine = scene(32)
    sites, _ = strided_map(fine.sites, Window(3, 2, 1))
    random = torch.Generator().manual_seed(2)
    coarse = SparseBev(torch.randn(len(sites), 48, generator=random), sites)
    weight, bias = layer(48, 64, 3, seed=1)
    lateral = torch.randn(64, 32, generator=random)
    folded = FoldedUp.of(weight, lateral, bias)
    assert folded is not None
    up = inverse_conv(coarse, weight.transpose(0, 1), fine.sites, bias).features
    got = folded(coarse.features, fine.features, inverse_map(fine.sites, sites))
    assert torch.allclose(got, torch.relu(up + fine.features @ lateral.T), atol=1e-4, rtol=1e-4)
