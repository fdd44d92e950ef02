# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from manyeyes.agents.trust._association_kernels import find_supporting_claims
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


def test_the_evidence_at_a_place_is_the_highest_of_the_nearest_claims_of_all_senders():
    rng = np.random.default_rng(3)
    xy, places, first = rng.uniform(-9, 9, (40, 2)), rng.uniform(-9, 9, (30, 2)), np.array([0, 12, 12, 30])
    claimed, trust = rng.integers(0, 5, 30).astype(np.uint8), np.array([0.9, 0.7, 0.4])
    kinds, highest, is_near = find_supporting_claims(xy, places, claimed, first, trust, 4, 2.0)
    for row, place in enumerate(xy):
        best, senders = 0, []
        for sender in range(3):
            rows = [k for k in range(first[sender], first[sender + 1]) if claimed[k] != 4]
            distance = np.array([np.hypot(*(places[k] - place)) for k in rows])
            if len(rows) and distance.min() <= 2.0:
                senders.append(sender)
                best = max(best, claimed[rows[distance.argmin()]])
        assert kinds[row] == best and np.flatnonzero(is_near[:, row]).tolist() == senders
        assert highest[row] == max((trust[sender] for sender in senders), default=0.0)
    assert is_near.any(1).tolist() == [True, False, True]
