# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from manyeyes.agents.trust.association import associate, associate_reference, find_nearest


@pytest.mark.parametrize("seed", range(5))
def test_loops_equal_the_reference(seed):
    rng = np.random.default_rng(seed)
    one, other, gate = rng.uniform(0, 8, (20, 2)), rng.uniform(0, 8, (15, 2)), rng.uniform(0.5, 3, 20)
    assert associate(one, other, gate).tolist() == associate_reference(one, other, gate).tolist()
    distance = np.hypot(*(one[:, None] - other[None]).transpose(2, 0, 1))
    nearest = np.where(distance.min(1) <= 1.0, distance.argmin(1), -1)
    assert find_nearest(one, other, 1.0).tolist() == nearest.tolist()


def test_pairs_are_unique_and_nearest_first():
    one, other = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[0.9, 0.0]])
    assert associate(one, other, 2.0).tolist() == [-1, 0]
    assert associate(one, np.zeros((0, 2)), 2.0).tolist() == [-1, -1]
    assert associate(one, other, 0.05).tolist() == [-1, -1]
