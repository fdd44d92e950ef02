# SPDX-License-Identifier: Apache-2.0
"""The blocks of pairs against a dense matrix that is filled pair by pair."""

from __future__ import annotations

import hashlib

import numpy as np

from manyeyes.maps.fusion.joint_solver import bsr_from_blocks
from manyeyes.maps.fusion.pair_blocks import PairBlocks, multiply_couplings
from manyeyes.maps.fusion.pose_solution import PairSums

IDS = sorted(hashlib.blake2b(bytes([k]), digest_size=16).hexdigest() for k in range(6))
# Both directions, one alone in either order, one with an observation that is not among them; in no order.
MET = [(0, (4, 2, 9)), (1, ()), (2, (0, 5)), (3, (1,)), (4, (9,)), (5, (3, 2))]


def make_sums(rng):
    numbers = [o for _, others in MET for o in others]
    digests = [
        np.frombuffer(bytes.fromhex(IDS[o]), np.uint8) if o < len(IDS) else np.full(16, 7, np.uint8) for o in numbers
    ]
    offsets = np.cumsum([0, *(len(others) for _, others in MET)])
    return PairSums(rng.normal(size=(len(IDS), 11)), offsets, np.array(digests), rng.normal(size=(len(numbers), 12)))


def fill_densely(sums):
    """The couplings as a matrix, and the blocks and right sides of the observations."""
    dense, n = np.zeros((3 * len(IDS), 3 * len(IDS))), 0
    upper = np.triu_indices(3)
    own, right = np.zeros((len(IDS), 3, 3)), sums.own[:, 6:9].copy()

    def add_symmetric(block, values):
        full = np.zeros((3, 3))
        full[upper] = values
        block += full + np.triu(full, 1).T

    for k in range(len(IDS)):
        add_symmetric(own[k], sums.own[k, :6])
    for row, others in MET:
        for o in others:
            if o < len(IDS):
                xx, xy, yy, xu, yu, uu, tx, ty, tu = sums.shared[n, :9]
                block = -np.array([[xx, xy, xu], [xy, yy, yu], [tx, ty, tu]])
                dense[3 * row : 3 * row + 3, 3 * o : 3 * o + 3] += block
                dense[3 * o : 3 * o + 3, 3 * row : 3 * row + 3] += block.T
                add_symmetric(own[o], (xx, xy, xu, yy, yu, uu))
                right[o] -= sums.shared[n, 9:]
            n += 1
    return dense, own, right


def test_blocks_equal_those_of_a_dense_matrix_filled_pair_by_pair():
    rng = np.random.default_rng(3)
    sums = make_sums(rng)
    dense, own, right = fill_densely(sums)
    blocks = PairBlocks.of_sums(sums, IDS)
    np.testing.assert_allclose(blocks.own, own, atol=1e-14)
    np.testing.assert_allclose(blocks.right_side, right, atol=1e-14)
    # Each two observations once, under the earlier one, in ascending order.
    assert [(int(a), int(b)) for a, b in zip(blocks.row, blocks.other)] == [(0, 2), (0, 4), (1, 3), (2, 5), (3, 5)]
    matrix = bsr_from_blocks([(blocks.row, blocks.other, blocks.coupling)], len(IDS)).toarray()
    np.testing.assert_allclose(matrix + matrix.T, dense, atol=1e-14)
    vector = rng.normal(size=(len(IDS), 3))
    product = np.ones_like(vector)
    multiply_couplings(blocks, vector, product)
    np.testing.assert_allclose(product.ravel(), 1.0 + dense @ vector.ravel(), atol=1e-13)


def test_blocks_of_observations_that_meet_no_other():
    empty = PairSums(np.ones((2, 11)), np.zeros(3, np.int64), np.zeros((0, 16), np.uint8), np.zeros((0, 12)))
    blocks = PairBlocks.of_sums(empty, IDS[:2])
    assert blocks.other.shape == (0,) and blocks.coupling.shape == (0, 3, 3)
    product = np.zeros((2, 3))
    multiply_couplings(blocks, np.ones((2, 3)), product)
    assert (product == 0.0).all()
