# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from manyeyes.datatypes import ShapeError
from manyeyes.ops.assignment import assign


def test_a_case_by_hand():
    # Row by row the cheapest would be (0, 0) and (1, 0); together 2 + 3 beats 1 + 9.
    np.testing.assert_array_equal(assign(np.array([[1.0, 2.0], [3.0, 9.0]])), [[0, 1], [1, 0]])


@pytest.mark.parametrize("shape", [(1, 1), (4, 4), (3, 8), (9, 2), (0, 5), (5, 0)])
def test_the_cost_is_scipys(shape):
    optimize = pytest.importorskip("scipy.optimize")
    for seed in range(5):
        cost = np.random.default_rng(seed).normal(size=shape)
        pairs = assign(cost)
        rows, columns = optimize.linear_sum_assignment(cost)
        assert len(pairs) == len(rows) and (np.diff(pairs[:, 0]) > 0).all() and len(set(pairs[:, 1])) == len(pairs)
        assert cost[tuple(pairs.T)].sum() == pytest.approx(cost[rows, columns].sum())


def test_an_infinite_cost_is_refused():
    with pytest.raises(ShapeError, match="finite"):
        assign(np.array([[np.inf]]))
