# SPDX-License-Identifier: Apache-2.0
"""Sampling at learned places against a loop over every place, in values and gradients."""

import math

import pytest
import torch

from manyeyes.datatypes import ShapeError
from manyeyes.ops.deformable import sample_weighted


def slowly(values, at, weight):
    """The definition, one number at a time: bilinear between centres of cells, zero outside."""
    b, heads, channels, rows, columns = values.shape
    _, q, _, p, _ = at.shape
    out = []
    for i in range(b):
        for query in range(q):
            for head in range(heads):
                total = torch.zeros(channels, dtype=values.dtype)
                for point in range(p):
                    x = at[i, query, head, point, 0] * columns - 0.5
                    y = at[i, query, head, point, 1] * rows - 0.5
                    for r in (math.floor(float(y.detach())), math.floor(float(y.detach())) + 1):
                        for c in (math.floor(float(x.detach())), math.floor(float(x.detach())) + 1):
                            if 0 <= r < rows and 0 <= c < columns:
                                share = (1 - (x - c).abs()) * (1 - (y - r).abs())
                                total = total + weight[i, query, head, point] * share * values[i, head, :, r, c]
                out.append(total)
    return torch.stack(out).view(b, q, heads * channels)


def test_values_and_gradients_are_those_of_the_loop():
    generator = torch.Generator().manual_seed(3)
    values = torch.randn(2, 2, 3, 4, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    # Some places lie outside of the picture, or within half a cell of its border.
    at = (torch.rand(2, 3, 2, 4, 2, generator=generator, dtype=torch.float64) * 1.4 - 0.2).requires_grad_()
    weight = torch.rand(2, 3, 2, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    fast, slow = sample_weighted(values, at, weight), slowly(values, at, weight)
    assert torch.allclose(fast, slow, atol=1e-12)
    aim = torch.randn(fast.shape, generator=generator, dtype=torch.float64)
    for mine, theirs in zip(
        torch.autograd.grad((fast * aim).sum(), (values, at, weight)),
        torch.autograd.grad((slow * aim).sum(), (values, at, weight)),
        strict=True,
    ):
        assert float(theirs.abs().max()) > 0
        assert torch.allclose(mine, theirs, atol=1e-10)


def test_the_centre_of_a_cell_is_that_cell_and_the_border_between_two_their_mean():
    values = torch.arange(6.0).view(1, 1, 1, 2, 3)
    at = torch.tensor([[0.5, 0.25], [1 / 3, 0.75]]).view(1, 2, 1, 1, 2)
    assert sample_weighted(values, at, torch.ones(1, 2, 1, 1)).flatten().tolist() == pytest.approx([1.0, 3.5])


def test_places_of_another_number_of_heads_are_refused():
    with pytest.raises(ShapeError, match=r"\(B, Q, heads, P, 2\)"):
        sample_weighted(torch.zeros(1, 2, 3, 4, 4), torch.zeros(1, 5, 1, 2, 2), torch.zeros(1, 5, 1, 2))
