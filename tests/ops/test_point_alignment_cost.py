# SPDX-License-Identifier: Apache-2.0
"""Sweeps of one object at two instants meet where it has driven: against point by point, and by hand."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from manyeyes.datatypes import Boxes
from manyeyes.ops.point_alignment_cost import (
    BOX_MARGIN_M,
    HEIGHT_SCALE,
    MAX_DISTANCE_M,
    MAX_POINTS,
    MIN_POINTS,
    ROAD_CLEARANCE_M,
    compute_alignment_costs,
    index_points,
)

STEPS = 9


def cars(xy: list[tuple[float, float]], yaw: float) -> Boxes:
    n = len(xy)
    center = torch.tensor([[x, y, 0.8] for x, y in xy]).reshape(n, 3)
    return Boxes.of(center, torch.tensor([4.0, 2.0, 1.6]).repeat(n, 1), torch.full((n,), yaw))


def scattered(seed: int, count: int = 2500) -> Tensor:
    """Points around two cars, on the road and above it too."""
    rng = torch.Generator().manual_seed(seed)
    return (torch.rand(count, 3, generator=rng) - 0.5) * torch.tensor([24.0, 12.0, 3.0]) + torch.tensor([3.0, 0.0, 0.8])


def plain(now: Tensor, then: Tensor, box: Boxes, back: Tensor, slack: float) -> tuple[list[float], int]:
    """The slow twin, for one box."""
    ahead = np.array([np.cos(float(box.yaw[0])), np.sin(float(box.yaw[0]))])
    middle, size = box.center[0].double().numpy(), box.size[0].double().numpy()

    def inside(cloud: Tensor, away: np.ndarray, along: float) -> list[np.ndarray]:
        found = []
        for x, y, z in cloud.double().numpy() - middle:
            dx, dy = x - away[0], y - away[1]
            u, v = dx * ahead[0] + dy * ahead[1], dy * ahead[0] - dx * ahead[1]
            long, wide = abs(u) < size[0] / 2 + along, abs(v) < size[1] / 2 + BOX_MARGIN_M[1]
            if long and wide and ROAD_CLEARANCE_M - size[2] / 2 < z < size[2] / 2 + BOX_MARGIN_M[2]:
                found.append(np.array([u, v, HEIGHT_SCALE * z]))
        return found

    mine, theirs = inside(now, np.zeros(2), BOX_MARGIN_M[0]), inside(then, -back.numpy(), BOX_MARGIN_M[0] + slack)
    if min(len(mine), len(theirs)) < MIN_POINTS:
        return [0.0] * STEPS, 0
    asked = min(len(mine), MAX_POINTS)
    costs = []
    for d in np.linspace(-slack, slack, STEPS):
        worst = [
            min(
                min(((mine[a * len(mine) // asked] - q - [d, 0, 0]) ** 2).sum() for q in theirs) / MAX_DISTANCE_M**2,
                1.0,
            )
            for a in range(asked)
        ]
        costs.append(float(np.mean(worst)))
    return costs, asked


def test_costs_are_those_of_every_pair_of_points() -> None:
    now, then = scattered(0), scattered(1, 900)
    boxes = cars([(0.0, 0.5), (5.0, -1.0), (90.0, 0.0)], 0.4)
    back, slack = torch.tensor([[1.0, 0.3], [-0.5, 0.2], [0.0, 0.0]]), torch.tensor([0.8, 1.5, 1.0])
    cost, count = compute_alignment_costs(now, then, boxes, back, slack, STEPS)
    for n in range(3):
        want, asked = plain(now, then, boxes[n : n + 1], back[n].double(), float(slack[n]))
        np.testing.assert_allclose(cost[n].numpy(), want, atol=1e-5)
        assert int(count[n]) == asked
    again = compute_alignment_costs(index_points(now), then, boxes, back, slack, STEPS)
    assert torch.equal(again[0], cost) and torch.equal(again[1], count)
    assert count.tolist()[2] == 0 and min(count.tolist()[:2]) >= MIN_POINTS
    assert MAX_POINTS in count.tolist()


def test_points_beyond_the_index_count() -> None:
    """Boxes far out and across the border of the index, which its outermost cells hold."""
    for x, y in ((127.5, -127.0), (-400.0, 3.0), (2.0, 260.0)):
        shift = torch.tensor([x, y, 0.0])
        now, then = scattered(2) + shift, scattered(3, 900) + shift
        boxes, back, slack = cars([(x, y)], 1.1), torch.tensor([[1.0, 0.3]]), torch.tensor([0.8])
        cost, count = compute_alignment_costs(now, then, boxes, back, slack, STEPS)
        want, asked = plain(now, then, boxes, back[0].double(), 0.8)
        np.testing.assert_allclose(cost[0].numpy(), want, atol=1e-4)
        assert int(count[0]) == asked >= MIN_POINTS


def test_the_cost_is_zero_at_the_true_motion() -> None:
    """0.6 m farther back than estimated, along its length and not the frame's axis; the road under it does not count."""
    yaw = 0.7
    ahead = torch.tensor([np.cos(yaw), np.sin(yaw)]).float()
    aside = torch.stack((-ahead[1], ahead[0]))
    t = torch.linspace(-2, 2, 15)[:, None]
    side = torch.cat((t * ahead + aside, torch.full((15, 1), 0.9)), 1)
    back_face = torch.cat((-2 * ahead + torch.linspace(-1, 1, 7)[:, None] * aside, torch.full((7, 1), 0.9)), 1)
    road = torch.cat((t * ahead, torch.full((15, 1), 0.05)), 1)
    was = torch.cat((2.0 * ahead + 0.6 * ahead, torch.zeros(1)))
    now, then = torch.cat((side, back_face, road)), torch.cat((side - was, back_face - was, road))
    cost, _ = compute_alignment_costs(now, then, cars([(0.0, 0.0)], yaw), 2.0 * ahead[None], torch.tensor([1.0]), 21)
    assert int(cost[0].argmin()) == 16
    assert float(cost[0, 16]) < 1e-6 and float(cost[0, 6]) > 0.1


def test_no_boxes_and_no_points() -> None:
    none = cars([], 0.0)
    assert compute_alignment_costs(scattered(0), scattered(1), none, torch.zeros(0, 2), torch.zeros(0), 5)[0].shape == (
        0,
        5,
    )
    cost, count = compute_alignment_costs(
        torch.zeros(0, 3), scattered(1), cars([(0, 0)], 0.0), torch.zeros(1, 2), torch.ones(1), 5
    )
    assert cost.tolist() == [[0.0] * 5] and count.tolist() == [0]
