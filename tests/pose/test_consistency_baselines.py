# SPDX-License-Identifier: Apache-2.0
"""CLIPPER and the maximum clique on graphs small enough to work by hand."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from manyeyes.datatypes import ConfigError
from manyeyes.pose.baselines import clipper, max_clique
from manyeyes.pose.baselines._consistency import ConsistencyConfig, build_consistency_graph
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseStatus, pose_difference

CORRECTORS = {"clipper": clipper.correct, "max-clique": max_clique.correct}


def symmetric(count: int, weights: dict[tuple[int, int], float]) -> csr_matrix:
    """weights: {(i, j): w}."""
    dense = np.zeros((count, count))
    for (i, j), weight in weights.items():
        dense[i, j] = dense[j, i] = weight
    return csr_matrix(dense)


#   0 --- 1        four nodes joined weakly (0, 1, 2, 3, weight 0.2) and three
#   |  X  |        joined strongly (4, 5, 6, weight 1); 3 and 4 are joined, too.
#   2 --- 3 --- 4 --- 5
#                \   /
#                  6
WEAK_FOUR_STRONG_THREE = symmetric(
    7,
    dict.fromkeys(itertools.combinations((0, 1, 2, 3), 2), 0.2)
    | dict.fromkeys(itertools.combinations((4, 5, 6), 2), 1.0)
    | {(3, 4): 1.0},
)


def test_the_densest_clique_and_the_largest_one_differ() -> None:
    # u' M u of equal entries is 1 + (n - 1) w: 1 + 3 * 0.2 = 1.6 of the four, 1 + 2 = 3 of the three.
    assert clipper.find_densest_clique(WEAK_FOUR_STRONG_THREE).tolist() == [4, 5, 6]
    assert max_clique.find_max_clique(WEAK_FOUR_STRONG_THREE, 1000).tolist() == [0, 1, 2, 3]


def test_clipper_keeps_no_two_inconsistent_nodes() -> None:
    # A path of three: the principal eigenvector spreads over all, but 0 and 2 are not joined. The two edges weigh 1 and 0.9.
    assert clipper.find_densest_clique(symmetric(3, {(0, 1): 1.0, (1, 2): 0.9})).tolist() == [0, 1]


def test_without_an_edge_there_is_no_clique() -> None:
    empty = symmetric(3, {})
    assert clipper.find_densest_clique(empty).tolist() == []
    assert max_clique.find_max_clique(empty, 100).tolist() in ([0], [1], [2])


def test_the_largest_clique_of_random_graphs_is_that_of_all_subsets() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        dense = np.triu(rng.random((9, 9)) < 0.5, 1)
        dense = dense | dense.T
        largest = max(
            size
            for size in range(1, 10)
            for nodes in itertools.combinations(range(9), size)
            if all(dense[i, j] for i, j in itertools.combinations(nodes, 2))
        )
        found = max_clique.find_max_clique(csr_matrix(dense.astype(float)), 10**6)
        assert len(found) == largest
        assert all(dense[i, j] for i, j in itertools.combinations(found, 2))


def test_the_search_ends_after_its_branches() -> None:
    everyone = csr_matrix(1.0 - np.eye(12))
    assert len(max_clique.find_max_clique(everyone, 10**6)) == 12
    assert len(max_clique.find_max_clique(everyone, 4)) < 12


def boxes(places: Sequence[tuple[float, float]], yaw: Sequence[float]) -> Landmarks:
    n = len(places)
    ones = np.ones(n)
    size = np.tile([4.5, 1.9], (n, 1))
    return Landmarks(
        np.array(places, float), np.array(yaw), size, ones, 0.25 * ones, 0.04 * ones, 0.03 * ones, np.zeros(n, int)
    )


def test_a_mirror_image_is_not_consistent() -> None:
    # Lengths of a triangle and of its mirror image are equal: three boxes at (0, 0), (10, 0), (0, 6), headings along x.
    place, yaw = [(0, 0), (10, 0), (0, 6)], [0.0, 0.0, 0.0]
    one, mirrored = boxes(place, yaw), boxes([(x, -y) for x, y in place], yaw)
    same = build_consistency_graph(one, one, ConsistencyConfig())
    # Of nine associations, the three true ones are consistent with each other; so is no triple of the mirror image, where the edges
    # from (10, 0) to (0, 6) differ by 2 atan(6 / 10) = 62 degrees in direction.
    is_true = same.pairs[:, 0] == same.pairs[:, 1]
    assert (same.length_difference[is_true][:, is_true].toarray() > 0).sum() == 6
    other = build_consistency_graph(one, mirrored, ConsistencyConfig())
    assert len(max_clique.find_max_clique(other.length_difference, 1000)) == 2


def test_headings_count_modulo_pi() -> None:
    place = [(0, 0), (12, 3), (4, 15), (-9, 6)]
    one, turned = boxes(place, [0.1, 0.7, 1.4, 2.0]), boxes(place, [0.1 + np.pi, 0.7, 1.4 - np.pi, 2.0])
    for correct in CORRECTORS.values():
        assert correct(one, turned, None).inliers == 4


@pytest.mark.parametrize("name", CORRECTORS)
@pytest.mark.parametrize("pose", [(0.6, -0.4, 0.02), (30.0, 12.0, 2.0)])
def test_any_pose_of_five_boxes_is_found(name: str, pose: tuple[float, float, float]) -> None:
    ego = boxes([(2, 10), (20, 0), (5, -15), (-12, 4), (16, -9)], [0.3, 1.2, -0.4, 2.0, 0.0])
    x, y, yaw = pose
    c, s = np.cos(yaw), np.sin(yaw)
    other = ego.transform(np.array([-c * x - s * y, s * x - c * y, -yaw]))
    found = CORRECTORS[name](ego, other, None)
    assert (
        found.status is PoseStatus.CORRECTED and (found.pairs[:, 0] == found.pairs[:, 1]).all() and found.inliers == 5
    )
    assert found.pose is not None
    np.testing.assert_allclose(pose_difference(found.pose, np.array(pose)), 0, atol=1e-6)
    assert np.linalg.inv(found.covariance)[0, 0] == pytest.approx(5 / (2 * 0.25**2))


@pytest.mark.parametrize("name", CORRECTORS)
def test_two_boxes_are_too_few(name: str) -> None:
    pair = boxes([(0, 0), (10, 0)], [0.0, 0.5])
    assert CORRECTORS[name](pair, pair, None).status is PoseStatus.NO_MATCH


@pytest.mark.parametrize("limits", [{"max_boxes": 0}, {"max_turn_rad": 0.0}, {"min_length_m": -1.0}])
def test_limits_are_checked(limits: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="ConsistencyConfig needs"):
        ConsistencyConfig(**limits)
