# SPDX-License-Identifier: Apache-2.0
"""The gradient of a weight is the sum of outer products over the pairs of each tap."""

import numpy as np
import pytest
import torch

from manyeyes.ops._outer_product_kernels import sum_outer_products
from manyeyes.ops.sparse_index import Pairs


@pytest.mark.parametrize(("inputs", "outputs"), [(1, 16), (5, 48), (13, 64), (32, 32), (64, 112), (3, 160)])
@pytest.mark.parametrize("pairs", [0, 1, 7, 128, 300])
@pytest.mark.parametrize("is_symmetric", [False, True])
def test_equals_the_sum_over_pairs(inputs: int, outputs: int, pairs: int, is_symmetric: bool) -> None:
    random = torch.Generator().manual_seed(pairs)
    rows, taps = 400, 3 if is_symmetric else 2
    x, dy = torch.randn(rows, inputs, generator=random), torch.randn(rows, outputs, generator=random)
    given = 1 if is_symmetric else 2
    source, target = (torch.cat([torch.randperm(rows, generator=random)[:pairs] for _ in range(given)]) for _ in "ab")
    before = torch.randn(taps, inputs, outputs, generator=random)
    wanted = before.double()
    for tap in range(given):
        s, t = (part[tap * pairs : (tap + 1) * pairs] for part in (source, target))
        wanted[tap] += x[s].double().T @ dy[t].double()
        if is_symmetric:
            wanted[2] += x[t].double().T @ dy[s].double()
    if is_symmetric:
        wanted[1] += x.double().T @ dy.double()
    out = before.clone()
    listed = Pairs(source.numpy(), target.numpy(), np.full(given, pairs))
    sum_outer_products(x.numpy(), dy.numpy(), listed, is_symmetric, out.numpy())
    assert float((out - wanted).norm()) <= 1e-6 * float(wanted.norm())
