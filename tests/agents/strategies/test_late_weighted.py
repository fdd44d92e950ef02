# SPDX-License-Identifier: Apache-2.0
"""Boxes of one object are averaged by score and covariance; worked by hand.

Two cars of 4.5 m at x = 0 (score 0.8, sigma 0.1 m) and x = 0.6 (score 0.4, sigma 0.2 m): weights 0.8 / 0.01 = 80 and 0.4 / 0.04 =
10, so the mean is at 0.6 * 10 / 90 = 0.0667 m, with a standard deviation of 1 / sqrt(100 + 25) = 0.0894 m.
"""

import math
from dataclasses import replace

import pytest
import torch

from manyeyes.agents.strategies.late import LateFusion
from manyeyes.agents.strategies.late_weighted import WeightedLateFusion, merge_boxes_weighted
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.agents.strategies.temporal_boxes import merge_boxes_nms
from manyeyes.datatypes import AgentFrame, Boxes, Message, PointCloud, Transform


def boxes(places, scores, sigmas, yaws=None) -> Boxes:
    n = len(places)
    center = torch.tensor([[x, 0.0, 0.8] for x in places]).view(n, 3)
    blank = Boxes.of(center, torch.tensor([[4.5, 1.9, 1.6]]).expand(n, 3), torch.tensor(yaws or [0.0] * n))
    return replace(blank, score=torch.tensor(scores), sigma_xy=torch.tensor(sigmas))


def test_two_boxes_worked_by_hand() -> None:
    merged = merge_boxes_weighted(boxes([0.6, 0.0, 30.0], [0.4, 0.8, 0.5], [0.2, 0.1, 0.3]), 0.15)
    assert merged.center[:, 0].tolist() == pytest.approx([0.6 * 10 / 90, 30.0], abs=1e-6)
    assert merged.score.tolist() == pytest.approx([0.8, 0.5])
    assert merged.sigma_xy.tolist() == pytest.approx([1 / math.sqrt(125), 0.3], abs=1e-6)


def test_the_groups_and_the_ranking_are_those_of_plain_suppression() -> None:
    """A chain: the best box suppresses the second, not the third, which the second overlaps."""
    some = boxes([0.0, 2.5, 5.0, 80.0], [0.9, 0.8, 0.7, 0.1], [0.1] * 4)
    merged, kept = merge_boxes_weighted(some, 0.15), merge_boxes_nms([some], 0.15)
    assert merged.score.tolist() == kept.score.tolist() == pytest.approx([0.9, 0.7, 0.1])
    assert merged.center[:, 0].tolist() == pytest.approx([2.5 * 0.8 / 1.7, 5.0, 80.0])
    assert len(merge_boxes_weighted(some[:0], 0.15)) == 0


def test_headings_are_averaged_modulo_pi_around_the_best() -> None:
    yaws = [0.1, math.pi - 0.1]
    merged = merge_boxes_weighted(boxes([0.0, 0.0], [0.8, 0.8], [0.1, 0.1], yaws), 0.15)
    assert float(merged.yaw) == pytest.approx(0.0, abs=1e-6)


def agents(claim_m: float, claim_rad: float, age_ns: int = 0) -> tuple[AgentFrame, Message]:
    ego = AgentFrame.of(PointCloud.of(torch.zeros(0, 3)), Transform.identity(), 0, 500_000_000)
    covariance = torch.tensor([claim_m**2, claim_m**2, claim_rad**2]).double().diag()
    return ego, Message(5, 500_000_000 - age_ns, Transform.from_xyz_yaw(10.0, 0.0), covariance)


def test_claimed_covariance_distance_and_age_make_a_box_less_certain() -> None:
    """10 m before its sender, sigma 0.1 m: claims of 0.3 m and 0.02 rad give sqrt(0.01 + 0.09 + (10 * 0.02)^2) = 0.374 m."""
    far = boxes([10.0], [0.5], [0.1])
    plain = WeightedLateFusion().place(*agents(0.0, 0.0), far)
    claimed = WeightedLateFusion().place(*agents(0.3, 0.02), far)
    aged = WeightedLateFusion().place(*agents(0.0, 0.0, 200_000_000), far)
    assert plain.center[0].tolist() == pytest.approx([20.0, 0.0, 0.8])
    assert [float(b.sigma_xy) for b in (plain, claimed, aged)] == pytest.approx(
        [0.1, math.sqrt(0.01 + 0.09 + 0.04), math.sqrt(0.01 + 0.04)], abs=1e-6
    )
    assert float(LateFusion().place(*agents(0.3, 0.02), far).sigma_xy) == pytest.approx(0.1)


def test_forms() -> None:
    assert [get_strategy(n).uses_history for n in ("late-weighted", "late-weighted-temporal")] == [False, True]
