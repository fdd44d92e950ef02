# SPDX-License-Identifier: Apache-2.0
"""Compiled sorting: numpy's stable order and sorted values, of runs that are inserted and of those that are merged."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays

from manyeyes.ops._sort_kernels import argsort, sort

FEW_VALUES = st.sampled_from([np.nan, -np.inf, np.inf, -0.0, 0.0, 1.0, 1.5])


@given(arrays(np.float64, st.integers(0, 100), elements=st.one_of(FEW_VALUES, st.floats())))
def test_order_of_floats(values: Any) -> None:
    assert argsort(values).tolist() == np.argsort(values, kind="stable").tolist()
    np.testing.assert_array_equal(sort(values), np.sort(values))


@given(arrays(np.int64, st.integers(0, 100), elements=st.integers(-3, 3)))
def test_order_of_integers_with_ties(values: Any) -> None:
    assert argsort(values).tolist() == np.argsort(values, kind="stable").tolist()
    assert sort(values).tolist() == np.sort(values).tolist()


@pytest.mark.parametrize("dtype", [np.int32, np.int64, np.float32, np.float64])
@pytest.mark.parametrize("n", [0, 1, 15, 16, 17, 32, 33, 1000])
def test_sorted_values_keep_their_type(dtype: Any, n: int) -> None:
    values = (np.arange(n)[::-1] * 7 % 50).astype(dtype)
    before = values.copy()
    assert argsort(values).tolist() == np.argsort(values, kind="stable").tolist()
    found = sort(values)
    assert found.dtype == dtype and found.tolist() == np.sort(values).tolist()
    assert (values == before).all()
