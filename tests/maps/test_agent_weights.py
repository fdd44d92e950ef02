# SPDX-License-Identifier: Apache-2.0
"""Agent weights and the gauge offset, against values computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from manyeyes.maps.fusion.agent_weights import (
    REJECTED_WEIGHT,
    compute_observability,
    estimate_agent_weights,
    estimate_gauge_offset,
)

LIMITS = (2.0, 3.0, 0.5)
VARIANCE = 0.16


def agent_weights(offset, agent, observability=1.0):
    """Estimate the agent weight of each observation at this observability."""
    count = len(agent)
    matrix = np.tile(observability * np.eye(2), (count, 1, 1))
    return estimate_agent_weights(np.array(offset, float), matrix, np.full(count, VARIANCE), np.array(agent), LIMITS)


def test_weight_matches_hand_computed_value():
    """n observations with mean offset m: n m² / (sigma² (1 + rho (n - 1))) against scale², for n = 4 and observability 1."""
    offset = [(0.5, 0.1), (0.3, -0.1), (0.4, 0.0), (0.4, 0.0)]
    mean = np.array([1.6, 0.0]) / 4.1  # 0.1 is the regularization of unobservable directions
    away = 4.0 * mean @ mean / (VARIANCE * (1.0 + 0.5 * 3.0))
    assert agent_weights(offset, [0] * 4) == pytest.approx((4.0 / (4.0 + away)) ** 2)


def test_equal_offsets_lower_weight_more_than_one():
    one, four = agent_weights([(1.1, 0.0)], [0]), agent_weights([(1.1, 0.0)] * 4, [0] * 4)
    apart = agent_weights([(1.1, 0.0), (-1.1, 0.0), (0.0, 1.1), (0.0, -1.1)], [0] * 4)
    assert one[0] > 0.1 and (four < one).all() and apart == pytest.approx(1.0)


def test_agent_beyond_limit_is_rejected_only_where_observable():
    assert agent_weights([(3.0, 0.0)] * 4, [0] * 4) == pytest.approx(REJECTED_WEIGHT)
    assert agent_weights([(3.0, 0.0)] * 4, [0] * 4, observability=0.0) == pytest.approx(1.0)
    mixed = agent_weights([(3.0, 0.0)] * 3 + [(0.1, 0.0)] * 3, [0] * 3 + [1] * 3)
    assert (mixed[:3] == REJECTED_WEIGHT).all() and (mixed[3:] > 0.95).all()


def test_observability_is_one_for_known_pose_and_zero_for_prior_only():
    prior_covariance = np.tile(VARIANCE * np.eye(2), (2, 1, 1))
    covariance = np.zeros((2, 3, 3))
    covariance[1, :2, :2] = prior_covariance[1]
    observability = compute_observability(covariance, prior_covariance)
    assert observability[0] == pytest.approx(np.eye(2)) and observability[1] == pytest.approx(np.zeros((2, 2)))


def test_gauge_offset_is_robust_to_a_fifth_of_malicious_agents():
    rng = np.random.default_rng(3)
    start = np.concatenate((rng.uniform(0.0, 60.0, (50, 2)), np.zeros((50, 1))), 1)
    pose = start.copy()
    pose[:, :2] += (0.4, -0.2) + rng.normal(0.0, 0.1, (50, 2))
    attacked = pose.copy()
    attacked[:10, 0] += 2.0
    observability, weight, variance = np.tile(np.eye(2), (50, 1, 1)), np.ones(50), np.full(50, VARIANCE)
    honest = estimate_gauge_offset((start, pose), observability, weight, variance, (250.0, 1.0))
    assert honest == pytest.approx(np.tile((0.4, -0.2), (50, 1)), abs=0.05)
    moved = estimate_gauge_offset((start, attacked), observability, weight, variance, (250.0, 1.0)) - honest
    assert np.abs(moved).max() < 0.05, "their mean would move it by 0.4 m"
