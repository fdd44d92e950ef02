# SPDX-License-Identifier: Apache-2.0
"""Whom to believe: what honest errors explain counts, what they do not counts next to nothing."""

from __future__ import annotations

import numpy as np
import pytest

from manyeyes.maps.fusion.agent_weights import NOT_BELIEVED, common_error, faith_of, told_by_lines

LIMITS = (2.0, 3.0, 0.5)
VARIANCE = 0.16


def faith(offset, agent, told=1.0):
    """Faith by observation where lines told ``told`` of each place."""
    count = len(agent)
    matrix = np.tile(told * np.eye(2), (count, 1, 1))
    return faith_of(np.array(offset, float), matrix, np.full(count, VARIANCE), np.array(agent), LIMITS)


def test_the_slow_twin_of_one_agent_s_looks():
    """n looks whose mean is m off: n m² / (sigma² (1 + alike (n - 1))) against scale², by hand for n = 4, told whole."""
    offset = [(0.5, 0.1), (0.3, -0.1), (0.4, 0.0), (0.4, 0.0)]
    mean = np.array([1.6, 0.0]) / 4.1  # the tenth is what no lines tell
    away = 4.0 * mean @ mean / (VARIANCE * (1.0 + 0.5 * 3.0))
    assert faith(offset, [0] * 4) == pytest.approx((4.0 / (4.0 + away)) ** 2)


def test_four_looks_off_alike_tell_more_than_one():
    one, four = faith([(1.1, 0.0)], [0]), faith([(1.1, 0.0)] * 4, [0] * 4)
    apart = faith([(1.1, 0.0), (-1.1, 0.0), (0.0, 1.1), (0.0, -1.1)], [0] * 4)
    assert one[0] > 0.1 and (four < one).all() and apart == pytest.approx(1.0)


def test_beyond_the_limit_nobody_believes_and_what_lines_cannot_tell_counts_for_nothing():
    assert faith([(3.0, 0.0)] * 4, [0] * 4) == pytest.approx(NOT_BELIEVED)
    assert faith([(3.0, 0.0)] * 4, [0] * 4, told=0.0) == pytest.approx(1.0)
    mixed = faith([(3.0, 0.0)] * 3 + [(0.1, 0.0)] * 3, [0] * 3 + [1] * 3)
    assert (mixed[:3] == NOT_BELIEVED).all() and (mixed[3:] > 0.95).all()


def test_lines_told_all_where_the_pose_is_known_and_nothing_where_only_the_claim_is():
    claim = np.tile(VARIANCE * np.eye(2), (2, 1, 1))
    covariance = np.zeros((2, 3, 3))
    covariance[1, :2, :2] = claim[1]
    told = told_by_lines(covariance, claim)
    assert told[0] == pytest.approx(np.eye(2)) and told[1] == pytest.approx(np.zeros((2, 2)))


def test_what_all_were_moved_alike_is_the_common_error_and_a_fifth_who_lie_do_not_make_it():
    rng = np.random.default_rng(3)
    start = np.concatenate((rng.uniform(0.0, 60.0, (50, 2)), np.zeros((50, 1))), 1)
    pose = start.copy()
    pose[:, :2] += (0.4, -0.2) + rng.normal(0.0, 0.1, (50, 2))
    lied = pose.copy()
    lied[:10, 0] += 2.0
    told, weight, variance = np.tile(np.eye(2), (50, 1, 1)), np.ones(50), np.full(50, VARIANCE)
    honest = common_error((start, pose), told, weight, variance, (250.0, 1.0))
    assert honest == pytest.approx(np.tile((0.4, -0.2), (50, 1)), abs=0.05)
    moved = common_error((start, lied), told, weight, variance, (250.0, 1.0)) - honest
    assert np.abs(moved).max() < 0.05, "their mean would move it by 0.4 m"
