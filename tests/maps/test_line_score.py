# SPDX-License-Identifier: Apache-2.0
"""Scores of fused lines: competitors against a slow twin, monotone in each feature, and the order that they give fused lines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.maps.fusion.line_score import (
    ChainPoints,
    LineFeatures,
    LineScoreConfig,
    compute_line_score,
    describe_lines,
)

DAY_NS = 86_400_000_000_000


def make_chains(*lines, log_odds=(), sigma_m=0.1):
    """Chains of (x0, y0, x1, y1), a point a metre, with the log-odds of each line."""
    parts = []
    for x0, y0, x1, y1 in lines:
        count = int(np.hypot(x1 - x0, y1 - y0)) + 1
        parts.append(np.stack((np.linspace(x0, x1, count), np.linspace(y0, y1, count)), 1))
    offsets = np.concatenate(([0], np.cumsum([len(p) for p in parts]))).astype(np.int64)
    xy = np.concatenate(parts)
    return ChainPoints(xy, offsets, np.repeat(np.asarray(log_odds, float), np.diff(offsets)), np.full(len(xy), sigma_m))


def competitors_slow(points, config):
    """The fraction of each line with a competitor, point against point."""
    size = np.diff(points.offsets)
    line = np.repeat(np.arange(len(size)), size)
    mean = np.array([points.log_odds[line == c].mean() for c in range(len(size))])
    out = np.zeros(len(size))
    for p in range(len(line)):
        a, b = points.offsets[line[p]], points.offsets[line[p] + 1] - 1
        step = points.xy[min(p + 1, b)] - points.xy[max(p - 1, a)]
        u = step / np.hypot(*step)
        for q in range(len(line)):
            a, b = points.offsets[line[q]], points.offsets[line[q] + 1] - 1
            other = points.xy[min(q + 1, b)] - points.xy[max(q - 1, a)]
            e = points.xy[q] - points.xy[p]
            aside = abs(e[1] * u[0] - e[0] * u[1])
            if (
                line[q] != line[p]
                and mean[line[q]] > mean[line[p]] + config.min_advantage
                and abs(e @ u) < 1.0
                and config.min_competitor_m < aside < config.max_competitor_m
                and abs(u @ other) / np.hypot(*other) > 0.97
            ):
                out[line[p]] += 1
                break
    return out / size


def test_competitors_are_those_of_the_slow_twin():
    rng = np.random.default_rng(4)
    lines = [
        (x, y, x + 20 * np.cos(t), y + 20 * np.sin(t)) for x, y, t in rng.uniform((0, 0, 0), (12, 12, 0.3), (14, 3))
    ]
    points = make_chains(*lines, log_odds=rng.uniform(-1, 5, 14))
    config = LineScoreConfig()
    slow = competitors_slow(points, config)
    assert 0.2 < slow.mean() < 0.8
    np.testing.assert_allclose(describe_lines(points, np.full(14, 20.0), config).competitor, slow)


@pytest.mark.parametrize(
    ("aside", "share"),
    [(0.6, 0.0), (1.6, 1.0), (3.5, 0.0)],
    ids=["a double line", "half a lane", "a lane"],
)
def test_only_a_line_half_a_lane_aside_competes(aside, share):
    points = make_chains((0, 0, 20, 0), (0, aside, 20, aside), log_odds=(4.0, 1.0))
    assert describe_lines(points, np.full(2, 20.0)).competitor.tolist() == [0.0, share]


@pytest.mark.parametrize(("field", "rises"), [("log_odds", 1), ("length_m", 1), ("sigma_m", -1), ("competitor", -1)])
def test_score_is_monotone(field, rises):
    values = np.linspace(0.05, 1.0, 5)
    base = LineFeatures(*(np.full(5, v) for v in (2.0, 20.0, 0.2, 0.0)))
    score = compute_line_score(base._replace(**{field: values}))
    assert (np.diff(score) * rises > 0).all() and (score > 0).all() and (score < 1).all()


def test_no_lines_have_no_scores():
    empty = ChainPoints(np.zeros((0, 2)), np.zeros(1, np.int64), np.zeros(0), np.zeros(0))
    assert len(compute_line_score(describe_lines(empty, np.zeros(0)))) == 0


def make_observation(heights, agent, pose_sigma_m=0.1):
    lines = [np.stack((np.linspace(-25, 25, 20), np.full(20, y)), 1) for y in heights]
    covariance = np.diag([pose_sigma_m**2, pose_sigma_m**2, (pose_sigma_m / 50) ** 2])
    elements = MapElements.of(lines, [DIVIDER] * len(lines), 0.9)
    view = np.array([[-30.0, -15.0], [30.0, -15.0], [30.0, 15.0], [-30.0, 15.0]])
    pose = np.array([30.0, 0.0, 0.0])
    return Observation(agent, agent + "-1", DAY_NS, pose, elements=elements, covariance=covariance, view=view)


def scores_by_height(vector_map):
    e = vector_map.elements
    return {round(float(e.polyline(k)[:, 1].mean()), 1): float(e.score[k]) for k in range(len(e))}


def test_a_false_line_half_a_lane_beside_a_true_one_ranks_below_a_line_as_certain():
    """Six agents detect a line; three of them detect another 1.8 m beside it, too, and one 7 m away."""
    agents = [make_observation((0.0,), f"agent{k}") for k in range(3)]
    scores = scores_by_height(fuse([*agents, *(make_observation((0.0, 1.8, 7.0), f"other{k}") for k in range(3))]))
    assert scores[0.0] > scores[7.0] > scores[1.8] + 0.1


def test_a_line_whose_place_is_uncertain_ranks_below_one_as_long_and_as_certain_to_exist():
    sure = scores_by_height(fuse([make_observation((0.0,), "a", 0.1)]))
    unsure = scores_by_height(fuse([make_observation((0.0,), "a", 0.8)]))
    assert sure[0.0] > unsure[0.0] + 0.02


def test_scores_move_with_the_map():
    observations = [make_observation((0.0, 3.5), f"agent{k}") for k in range(3)]
    moved = [replace(o, pose=np.array(o.pose) + (400.0, -70.0, 0.0)) for o in observations]
    np.testing.assert_allclose(sorted(fuse(observations).elements.score), sorted(fuse(moved).elements.score), atol=1e-6)
