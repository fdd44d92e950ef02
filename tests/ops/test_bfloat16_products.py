# SPDX-License-Identifier: Apache-2.0
"""Products of bfloat16: those of rounded numbers, with float32 sums, by linear layers and every kind of convolution."""

import pytest
import torch

from manyeyes.datatypes import BevGrid, Sites, SparseBev
from manyeyes.ops.bfloat16_products import bfloat16_linear
from manyeyes.ops.sparse_conv import inverse_conv, strided_conv, strided_map, submanifold_conv
from manyeyes.ops.sparse_index import Window

GRID = BevGrid(-6.4, -4.0, -1.0, 6.4, 4.0, 1.0)
CHANNELS = 16
RESULT_ROUNDING = 2.0**-8
"""A GPU rounds each result to bfloat16 once, by half a unit of its 8 bits."""


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def rounded(x: torch.Tensor) -> torch.Tensor:
    return x.detach().to(torch.bfloat16).double()


def make_map(count: int = 150) -> SparseBev:
    rows, columns = GRID.shape
    key = torch.randperm(rows * columns, generator=torch.Generator().manual_seed(0))[:count].sort().values
    return SparseBev(draw(count, CHANNELS), Sites(key, GRID, 1))


def test_a_linear_layer_multiplies_rounded_numbers_and_returns_float32():
    x, weight, bias = draw(40, CHANNELS).requires_grad_(), draw(8, CHANNELS, seed=1).requires_grad_(), draw(8, seed=2)
    out = bfloat16_linear(x, weight, bias)
    exact = rounded(x) @ rounded(weight).T + bias.double()
    assert out.dtype == torch.float32 and torch.allclose(out.double(), exact, atol=1e-5)
    assert not torch.allclose(out, x @ weight.T + bias, atol=1e-3)  # rounding is felt
    slope = draw(40, 8, seed=3)
    out.backward(slope)
    assert x.grad is not None and weight.grad is not None and x.grad.dtype == weight.grad.dtype == torch.float32
    assert torch.allclose(x.grad, slope @ weight.detach().bfloat16().float(), rtol=RESULT_ROUNDING, atol=1e-3)
    assert torch.allclose(weight.grad, slope.T @ x.detach().bfloat16().float(), rtol=RESULT_ROUNDING, atol=1e-3)


@pytest.mark.parametrize("kind", ["centre", "same", "down", "up"])
def test_a_convolution_multiplies_rounded_numbers_and_returns_float32(device, kind):
    fine, outputs = make_map(), 32
    shape = (
        (CHANNELS, outputs, 3, 3) if kind == "up" else (outputs, CHANNELS, *((1, 1) if kind == "centre" else (3, 3)))
    )
    weight, bias = draw(*shape, seed=1), draw(outputs, seed=2)
    x = fine
    if kind == "up":
        coarse = strided_map(fine.sites, Window(3, 2, 1))[0]
        x = SparseBev(draw(len(coarse), CHANNELS, seed=3), coarse)

    def convolve(x: SparseBev, weight: torch.Tensor, bias: torch.Tensor, target: Sites) -> torch.Tensor:
        if kind == "up":
            return inverse_conv(x, weight, target, bias).features
        return (strided_conv if kind == "down" else submanifold_conv)(x, weight, bias).features

    exact = convolve(x.with_features(rounded(x.features)), rounded(weight), bias.double(), fine.sites)
    on_cpu = convolve(x.with_features(x.features.bfloat16()), weight, bias, fine.sites)
    assert on_cpu.dtype == torch.float32 and torch.allclose(on_cpu.double(), exact, atol=1e-4)
    there = x.to(device)
    leaf = there.features.detach().requires_grad_()
    target = fine.sites if kind != "up" else fine.to(device).sites
    out = convolve(there.with_features(leaf.to(torch.bfloat16)), weight.to(device), bias.to(device), target)
    assert out.dtype == torch.float32 and out.device == device
    scale = float(exact.abs().max())
    assert float((out.detach().cpu().double() - exact).abs().max()) <= RESULT_ROUNDING * scale
    out.sum().backward()
    assert leaf.grad is not None and leaf.grad.dtype == torch.float32 and bool(leaf.grad.cpu().isfinite().all())
