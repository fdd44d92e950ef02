# SPDX-License-Identifier: Apache-2.0
"""The hashed surface against one numpy pass over every triangle."""

from __future__ import annotations

import numpy as np
import pytest

from manyeyes.maps.roads.surface import RoadSurface


def strips(random: np.random.Generator, count: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Wavy ribbons on a few levels, some of which cross."""
    left, right = [], []
    for _ in range(count):
        m = int(random.integers(2, 12))
        start, angle = random.uniform(-40, 40, 2), random.uniform(0, 2 * np.pi)
        turn = angle + np.cumsum(random.normal(0, 0.1, m))
        middle = start + np.cumsum(np.stack((np.cos(turn), np.sin(turn)), -1) * 3, 0)
        normal = np.stack((-np.sin(turn), np.cos(turn)), -1) * random.uniform(1, 3)
        z = random.uniform(0, 8) + np.cumsum(random.normal(0, 0.2, m))
        left.append(np.c_[middle + normal, z])
        right.append(np.c_[middle - normal, z + 0.1])
    return left, right


def slow(surface: RoadSurface, point: np.ndarray, near_z: float | None) -> tuple[float, float]:
    """Height and distance by looking at everything."""
    covering, best = [], (np.inf, 0.0)
    for corner in surface.triangles:
        matrix = np.array([corner[1, :2] - corner[0, :2], corner[2, :2] - corner[0, :2]]).T
        u, v = np.linalg.solve(matrix, point - corner[0, :2])
        if u >= 0 and v >= 0 and u + v <= 1:
            covering.append(corner[0, 2] + u * (corner[1, 2] - corner[0, 2]) + v * (corner[2, 2] - corner[0, 2]))
        for a, b in ((0, 1), (1, 2), (2, 0)):
            edge = corner[b] - corner[a]
            f = np.clip((point - corner[a, :2]) @ edge[:2] / (edge[:2] @ edge[:2]), 0, 1)
            foot = corner[a] + f * edge
            distance = float(np.linalg.norm(point - foot[:2]))
            if distance < best[0]:
                best = distance, foot[2]
    if covering:
        return (max(covering) if near_z is None else min(covering, key=lambda z: abs(z - near_z))), 0.0
    return best[1], best[0]


@pytest.mark.slow
def test_height_and_distance_equal_the_slow_twin():
    random = np.random.default_rng(5)
    surface = RoadSurface.of_strips(*strips(random, 14))
    points = random.uniform(-90, 90, (150, 2))
    for near_z in (None, 2.0):
        wanted = np.array([slow(surface, p, near_z) for p in points])
        np.testing.assert_allclose(surface.distance(points), wanted[:, 1], atol=1e-6)
        np.testing.assert_allclose(surface.height(points, near_z), wanted[:, 0], atol=1e-5)
    assert (surface.distance(points) == 0).sum() > 5


def test_owner_names_the_strip():
    flat = np.array([[0.0, 1, 0], [10, 1, 0]]), np.array([[0.0, -1, 0], [10, -1, 0]])
    far = flat[0] + [0, 20, 3], flat[1] + [0, 20, 3]
    surface = RoadSurface.of_strips([flat[0], far[0]], [flat[1], far[1]])
    assert surface.strip_at(np.array([[5.0, 0.5], [5.0, 19.5]])).tolist() == [0, 1]


def test_spread_is_the_gap_between_levels():
    low = np.array([[-10.0, 2, 0], [10, 2, 0]]), np.array([[-10.0, -2, 0], [10, -2, 0]])
    high = low[0][:, [1, 0, 2]] * [-1, 1, 1] + [0, 0, 5.0], low[1][:, [1, 0, 2]] * [-1, 1, 1] + [0, 0, 5.0]
    surface = RoadSurface.of_strips([low[0], high[0]], [low[1], high[1]])
    np.testing.assert_allclose(surface.height_range(np.array([[0.0, 0.0], [6.0, 0.0], [50.0, 0.0]])), [5, 0, 0])


def test_nothing_is_infinitely_far():
    surface = RoadSurface.of_strips([], [])
    assert np.isinf(surface.distance(np.zeros((2, 2)))).all()
    assert surface.height(np.zeros((2, 2))).tolist() == [0, 0]
    assert surface.strip_at(np.zeros((2, 2))).tolist() == [-1, -1]
