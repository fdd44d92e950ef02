# SPDX-License-Identifier: Apache-2.0
"""Norm, skip and ReLU in one operation: values, gradients and running statistics of the three operations of torch."""

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from manyeyes.ops.active_norm import RunningStatistics, norm_relu

EPS, MOMENTUM = 1e-3, 0.02


def slow(x: Tensor, skip: Tensor | None, weight: Tensor, bias: Tensor, running: RunningStatistics) -> Tensor:
    normed = functional.batch_norm(x, running.mean, running.variance, weight, bias, True, running.momentum, EPS)
    return torch.relu(normed if skip is None else normed + skip)


@pytest.mark.parametrize(("rows", "channels"), [(2, 16), (3, 5), (700, 32), (5000, 24)])
@pytest.mark.parametrize("has_skip", [False, True])
def test_equals_the_operations_of_torch(rows: int, channels: int, has_skip: bool) -> None:
    random = torch.Generator().manual_seed(rows)
    x, skip, grad = (torch.randn(rows, channels, generator=random) * 2 + 0.5 for _ in range(3))
    weight, bias = torch.randn(channels, generator=random), torch.randn(channels, generator=random)
    found = []
    for function in (norm_relu, slow):
        values = [v.clone().requires_grad_() for v in (x, skip, weight, bias)]
        running = RunningStatistics(torch.full((channels,), 3.0), torch.full((channels,), 2.0), MOMENTUM)
        given = (values[0], values[1] if has_skip else None, *values[2:], running)
        out = function(*given, EPS) if function is norm_relu else function(*given)
        out.backward(grad)
        slopes = [v.grad if v.grad is not None else torch.zeros(()) for v in values]
        found.append([out.detach(), running.mean, running.variance, *slopes])
    for ours, torchs in zip(*found, strict=True):
        assert float((ours - torchs).norm()) <= 2e-6 * max(1e-3, float(torchs.norm()))
    assert 0.1 < float((found[1][0] == 0).float().mean()) < 0.9


def test_rows_without_gaps_are_not_required() -> None:
    x = torch.randn(6, 40, generator=torch.Generator().manual_seed(0)).T
    weight, bias = torch.ones(6), torch.zeros(6)
    running = [RunningStatistics(torch.zeros(6), torch.ones(6), MOMENTUM) for _ in range(2)]
    ours = norm_relu(x, None, weight, bias, running[0], EPS)
    assert torch.allclose(ours, slow(x.contiguous(), None, weight, bias, running[1]), atol=1e-6)


def test_a_value_that_is_no_number_is_not_hidden() -> None:
    x = torch.ones(4, 2)
    x[1, 0] = torch.nan
    running = RunningStatistics(torch.zeros(2), torch.ones(2), MOMENTUM)
    out = norm_relu(x, None, torch.ones(2), torch.zeros(2), running, EPS)
    assert out[:, 0].isnan().all() and not out[:, 1].isnan().any()
