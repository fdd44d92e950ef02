# SPDX-License-Identifier: Apache-2.0
"""Mean shift to ridges against a slow twin, on two noisy parallel lines, and what must not depend on the lattice of its grid."""

from __future__ import annotations

import numpy as np
import pytest

from manyeyes.maps.fusion.mean_shift import RidgeConfig, choose_seeds, mean_shift_to_ridges, thin_ridges
from manyeyes.maps.fusion.point_grid import line_residual

CONFIG = RidgeConfig()


def make_lines(count=120, seed=3):
    """Points, unit tangents of either sense, kinds and weights of two noisy lines 3.5 m apart at 20 degrees."""
    rng = np.random.default_rng(seed)
    along, lane = rng.uniform(0.0, 30.0, count), rng.integers(0, 2, count)
    aside = 3.5 * lane + rng.normal(0.0, 0.25, count)
    heading = np.radians(20.0) + rng.normal(0.0, 0.05, count) + np.pi * rng.integers(0, 2, count)
    u, v = np.cos(np.radians(20.0)), np.sin(np.radians(20.0))
    xy = np.stack((u * along - v * aside, v * along + u * aside), 1)
    return xy, np.stack((np.cos(heading), np.sin(heading)), 1), np.zeros(count, np.int64), rng.uniform(0.2, 2.0, count)


def shift_slowly(xy, tangent, weight, config):
    """The definition, point by point over all points."""
    out = []
    for k in range(len(xy)):
        (x, y), (u, v), density = xy[k], tangent[k], 0.0
        for _ in range(config.num_iterations):
            sums = np.zeros(4)
            for q in range(len(xy)):
                along, aside = line_residual(
                    xy[q, 0] - x, xy[q, 1] - y, u, v, *tangent[q], float(np.cos(config.max_heading_rad))
                )
                if abs(along) > config.longitudinal_extent_m or abs(aside) > config.lateral_extent_m:
                    continue
                square = (along / config.longitudinal_sigma_m) ** 2 + (aside / config.lateral_sigma_m) ** 2
                w, double = weight[q] * np.exp(-0.5 * square), 2 * np.arctan2(tangent[q, 1], tangent[q, 0])
                sums += w * np.array([1.0, aside, np.cos(double), np.sin(double)])
            density, pull, cc, ss = sums
            x, y = x - v * pull / density, y + u * pull / density
            u, v = np.cos(0.5 * np.arctan2(ss, cc)), np.sin(0.5 * np.arctan2(ss, cc))
        out.append((x, y, u, v, density))
    return np.array(out)


@pytest.mark.slow
def test_points_move_as_the_definition_says():
    xy, tangent, kind, weight = make_lines()
    # Some points start so far from their ridge that the points around them are gathered again on the way.
    xy[:6] += 0.7 * np.stack((-tangent[:6, 1], tangent[:6, 0]), 1)
    places, turned, density = mean_shift_to_ridges(np.arange(len(xy)), xy, tangent, kind, weight, CONFIG)
    slow = shift_slowly(xy, tangent, weight, CONFIG)
    assert np.hypot(*(places - xy).T).max() > 0.6
    np.testing.assert_allclose(places, slow[:, :2], atol=1e-7)
    np.testing.assert_allclose(turned, slow[:, 2:4], atol=1e-7)
    np.testing.assert_allclose(density, slow[:, 4], rtol=1e-6)


def test_lines_a_lane_apart_stay_separate_and_other_kinds_do_not_count():
    xy, tangent, kind, weight = make_lines(400)
    places, turned, _ = mean_shift_to_ridges(np.arange(len(xy)), xy, tangent, kind, weight, CONFIG)
    u, v = np.cos(np.radians(20.0)), np.sin(np.radians(20.0))
    aside = places @ (-v, u)
    error = np.minimum(abs(aside), abs(aside - 3.5))
    assert np.percentile(error, 90) < 0.12
    kept = thin_ridges(places, turned, kind, np.arange(len(xy), dtype=np.uint64), CONFIG)
    assert 60 < len(kept) < 110  # two lines of 30 m, a point every 0.7 m at most
    # A third line between both, of another kind, changes nothing.
    middle = xy + 1.75 * np.array([-v, u])
    both = mean_shift_to_ridges(
        np.arange(len(xy)), np.concatenate((xy, middle)), np.concatenate((tangent, tangent)),
        np.concatenate((kind, kind + 1)), np.concatenate((weight, weight)), CONFIG,
    )[0]  # fmt: skip
    np.testing.assert_array_equal(both, places)


def test_few_seeds_reach_the_ridges_of_all_points():
    xy, tangent, kind, weight = make_lines(1500)
    priority = np.random.default_rng(8).permutation(len(xy)).astype(np.uint64)
    seeds = choose_seeds(xy, tangent, kind, priority, CONFIG)
    assert 3 * len(seeds) < len(xy)
    ridges = []
    for rows in (np.arange(len(xy)), seeds):
        places, turned, _ = mean_shift_to_ridges(rows, xy, tangent, kind, weight, CONFIG)
        ridges.append(places[thin_ridges(places, turned, kind[rows], priority[rows], CONFIG)])
    every, few = ridges
    assert len(few) > 0.9 * len(every)
    u, v = np.cos(np.radians(20.0)), np.sin(np.radians(20.0))
    aside = few @ (-v, u)
    assert np.percentile(np.minimum(abs(aside), abs(aside - 3.5)), 90) < 0.08
    # A point is missing only beside one that stands for it.
    for middle in (0.0, 3.5):
        along = np.sort((few @ (u, v))[abs(few @ (-v, u) - middle) < 1.0])
        assert np.diff(along).max() < 2.0 * (CONFIG.spacing_m + CONFIG.seed_spacing_m)


def test_a_seed_stands_for_the_points_of_its_own_line_alone():
    # Four points at one place: two along x of either sense, one that crosses them, one of another kind.
    xy = np.array([[10.0, 4.0], [10.1, 4.1], [10.1, 4.0], [10.0, 4.1]])
    tangent = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
    priority = np.array([7, 3, 9, 5], np.uint64)
    assert choose_seeds(xy, tangent, np.array([0, 0, 0, 1]), priority, CONFIG).tolist() == [1, 2, 3]


@pytest.mark.parametrize("moved", [(0.3, 0.0), (0.0, 1.1), (1.7, -0.9)])
def test_the_result_moves_with_the_points(moved):
    xy, tangent, kind, weight = make_lines(300)
    rows = np.arange(len(xy))
    first = mean_shift_to_ridges(rows, xy, tangent, kind, weight, CONFIG)
    other = mean_shift_to_ridges(rows, xy + moved, tangent, kind, weight, CONFIG)
    np.testing.assert_allclose(other[0] - moved, first[0], atol=1e-9)
    np.testing.assert_allclose(other[2], first[2], rtol=1e-9)
