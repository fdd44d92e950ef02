# SPDX-License-Identifier: Apache-2.0
"""Comparisons of positions are those of a matrix of distances."""

from __future__ import annotations

import numpy as np
import pytest

from manyeyes.agents._distance_kernels import count_earlier, has_neighbour, propagate_centres


@pytest.mark.parametrize("num_sent", (0, 30))
def test_earlier_tokens_are_those_of_the_matrix_of_distances(num_sent: int) -> None:
    rng = np.random.default_rng(0)
    place, sent = (rng.uniform(0, 12, (n, 2)).astype(np.float32) for n in (60, num_sent))
    heat = rng.integers(-3, 4, 60).astype(np.float32)
    near = np.linalg.norm(place[:, None] - place[None], axis=2) < 2.0
    rank = np.argsort(np.argsort(-heat, kind="stable"))
    want = (near & (rank[None] < rank[:, None])).sum(1)
    want += (np.linalg.norm(place[:, None] - sent[None], axis=2) < 2.0).any(1)
    assert count_earlier(place, heat, sent, 2.0).tolist() == want.tolist()
    assert len(set(want.tolist())) > 3


def test_neighbours_lie_within_the_radius_or_on_it() -> None:
    rng = np.random.default_rng(1)
    center, others = (rng.uniform(0, 20, (n, 3)).astype(np.float32) for n in (40, 25))
    others[0, :2] = center[0, :2] + np.float32((1.5, 0.0))
    apart = np.linalg.norm(center[:, None, :2].astype(float) - others[None, :, :2], axis=2)
    found = has_neighbour(center, others, 1.5)
    assert found.tolist() == (apart <= 1.5).any(1).tolist() and 0 < found.sum() < 40
    assert found[0] == (np.abs(apart[0]).min() <= 1.5)
    assert not has_neighbour(center, others[:0], 1.5).any()


def test_propagated_centres_are_those_of_tensors() -> None:
    rng = np.random.default_rng(2)
    tokens, xy = rng.normal(size=(20, 9)).astype(np.float32), rng.uniform(-50, 50, (20, 2)).astype(np.float32)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    translation = rng.normal(size=3)
    found = propagate_centres(tokens, xy, (3, 6), (2.0, 0.7), (np.ascontiguousarray(rotation), translation))
    flat = np.column_stack((xy + 2.0 * tokens[:, 3:5] + 0.7 * tokens[:, 6:8], np.zeros(20)))
    np.testing.assert_allclose(found, (flat @ rotation.T + translation)[:, :2], atol=1e-4)
