# SPDX-License-Identifier: Apache-2.0
import torch

from manyeyes.models.detector.layers import ActiveNorm


def test_statistics_are_those_of_active_rows():
    rows = torch.randn(50, 4, generator=torch.Generator().manual_seed(0)) * 3 + 1
    norm = ActiveNorm(4)
    wanted = (rows - rows.mean(0)) / (rows.var(0, correction=0) + norm.eps).sqrt()
    assert torch.allclose(norm(rows), wanted, atol=1e-5)
    assert torch.allclose(norm.running_mean, norm.momentum * rows.mean(0), atol=1e-6)


def test_none_or_one_row_leaves_the_statistics_alone():
    norm = ActiveNorm(4)
    norm.running_mean += 2.0
    before = norm.running_mean.clone()
    for n in (0, 1):
        rows = torch.ones(n, 4, requires_grad=True)
        out = norm(rows)
        out.sum().backward()
        assert torch.allclose(out, (rows - 2.0) / (1 + norm.eps) ** 0.5)
        assert torch.equal(norm.running_mean, before) and rows.grad is not None


def test_norm_and_relu_in_one_operation_equal_them_apart() -> None:
    random = torch.Generator().manual_seed(1)
    rows, skip = torch.randn(60, 4, generator=random), torch.randn(60, 4, generator=random)
    for training in (True, False):
        for n in (60, 1, 0):
            norms = [ActiveNorm(4).train(training) for _ in range(2)]
            together = norms[0].forward_relu(rows[:n].clone(), skip[:n])
            apart = torch.relu(norms[1](rows[:n]) + skip[:n])
            assert torch.allclose(together, apart, atol=1e-6)
            for name, value in norms[0].state_dict().items():
                assert torch.allclose(value, norms[1].state_dict()[name], atol=1e-6), name
