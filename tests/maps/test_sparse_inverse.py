# SPDX-License-Identifier: Apache-2.0
"""The inverse on the pattern of the factors against the dense inverse."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csc_array

from manyeyes.maps.fusion import sparse_inverse
from manyeyes.maps.fusion.sparse_inverse import SymmetricFactor, solve_by_factors


def make_blocks(side, rng, axis_aligned=False):
    """A grid of side x side nodes with three unknowns each, each node coupled with its neighbours; positive definite."""
    count = side * side
    dense = np.eye(3 * count)
    for a in range(count):
        for b in (a + 1, a + side, a + side + 1):
            if b < count:
                root = np.diag(rng.uniform(0.5, 1.0, 3)) if axis_aligned else rng.normal(size=(3, 3))
                block, at = root @ root.T, np.r_[3 * a : 3 * a + 3, 3 * b : 3 * b + 3]
                dense[np.ix_(at, at)] += np.block([[block, -block], [-block, block]])
    return dense


@pytest.mark.parametrize("max_columns", [1, 4, 256])
@pytest.mark.parametrize("axis_aligned", [False, True])
def test_diagonal_blocks_and_solution_equal_those_of_the_dense_inverse(monkeypatch, max_columns, axis_aligned):
    monkeypatch.setattr(sparse_inverse, "_MAX_COLUMNS", max_columns)
    rng = np.random.default_rng(4)
    dense, right_side = make_blocks(9, rng, axis_aligned), rng.normal(size=243)
    found, factor = solve_by_factors(csc_array(dense), right_side)
    inverse = np.linalg.inv(dense)
    np.testing.assert_allclose(found, inverse @ right_side, atol=1e-11)
    blocks = factor.compute_diagonal_blocks(80)
    assert blocks.shape == (80, 3, 3)
    for k, block in enumerate(blocks):
        np.testing.assert_allclose(block, inverse[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], atol=1e-11)


def test_an_entry_that_cancels_is_put_back():
    """The entry (2, 1) of L is an exact zero, but that of the inverse, which the first column needs, is none."""
    dense = np.eye(6)
    dense[1, 0] = dense[2, 0] = 0.5
    dense[2, 1] = 0.25
    dense[3, 1] = dense[3, 2] = 0.25
    dense += np.tril(dense, -1).T
    root = np.linalg.cholesky(dense)
    diagonal = np.diag(root) ** 2
    lower = csc_array(root / np.diag(root))
    assert root[2, 1] == 0.0 and np.linalg.inv(dense)[2, 1] != 0.0
    columns = sparse_inverse._close_pattern(lower.indptr.astype(np.int64), lower.indices.astype(np.int32), lower.data)
    assert len(columns[1]) == lower.nnz + 1
    factor = SymmetricFactor(*columns, diagonal, np.arange(6))
    np.testing.assert_allclose(factor.compute_diagonal_blocks(1)[0], np.linalg.inv(dense)[:3, :3], atol=1e-14)
