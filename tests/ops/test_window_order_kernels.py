# SPDX-License-Identifier: Apache-2.0
"""The order of tokens by windows is that of a stable sort, whether windows lie close together or far apart."""

import numpy as np
import pytest
import torch

from manyeyes.ops._window_attention_kernels import window_runs
from manyeyes.ops._window_order_kernels import order_windows
from manyeyes.ops.window_attention import window_ids


def _check(window: np.ndarray) -> None:
    assert np.array_equal(order_windows(window), np.argsort(window, kind="stable"))
    runs = window_runs(torch.from_numpy(window))
    ids, counts = np.unique(window, return_counts=True)
    assert np.array_equal(runs.start.numpy(), np.cumsum([0, *counts]))
    assert np.array_equal(window[runs.order.numpy()], ids.repeat(counts))


@pytest.mark.parametrize("batch_size", (1, 3))
@pytest.mark.parametrize("extent_m", (3.0, 60.0, 4000.0))
def test_windows_of_places(extent_m: float, batch_size: int) -> None:
    """Far places and several batches leave too many possible windows to count."""
    random = torch.Generator().manual_seed(int(extent_m) + batch_size)
    xy = (torch.rand(500, 2, generator=random) - 0.5) * 2 * extent_m
    batch = torch.randint(batch_size, (500,), generator=random)
    _check(window_ids(xy, batch, (-70.4, -70.4), 12.8, 6.4).numpy())


@pytest.mark.parametrize("numbers", ([], [5], [3, 3, 3], [2**62, -(2**62), 0, 2**62], [-1, 0, -1, -(2**20)]))
def test_any_numbers(numbers: list[int]) -> None:
    _check(np.array(numbers, np.int64))
