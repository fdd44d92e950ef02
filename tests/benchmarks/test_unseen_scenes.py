# SPDX-License-Identifier: Apache-2.0
"""Counts of a frame drawn by hand: one vehicle found, one missed under a crown, one box off the road.

y
|        [found]   [missed, leaves above]      [false]
+---------10---------------20--------------------30-----> x
"""

import torch
from benchmarks.unseen_scenes import CASES, Count, add_frame, count_points_above, match

from manyeyes.datatypes import AgentFrame, Boxes, PointCloud, Transform

SIZE = [4.0, 2.0, 1.6]
TRUTH = Boxes.of([[10.0, 0.0, 0.8], [20.0, 0.0, 0.8]], [SIZE] * 2, [0.0, 0.0]).to(torch.float32)
LEAVES = torch.tensor([[20.0, 0.1 * k, 4.0] for k in range(6)])
POINTS = torch.cat([torch.tensor([[x, 0.1 * k, 0.5] for x in (10.0, 20.0) for k in range(6)]), LEAVES])


def boxes(x: list[float], score: list[float]) -> Boxes:
    n = len(x)
    place = [[value, 0.0, 0.8] for value in x]
    return Boxes.of(place, [SIZE] * n, [0.0] * n, score=torch.tensor(score)).to(torch.float32)


def test_a_frame_is_counted():
    frame = AgentFrame.of(PointCloud.of(POINTS), Transform.identity())
    count = Count("crowns")
    add_frame(count, CASES["crowns"], boxes([10.2, 30.0, 31.0], [0.9, 0.8, 0.3]), frame, TRUTH, 0.4)
    assert (count.frames, count.vehicles, count.matched, count.false_boxes) == (1, 2, 1, 1)
    assert (count.under_crowns, count.matched_under_crowns) == (1, 0)


def test_vehicles_of_too_few_points_or_out_of_range_do_not_count():
    frame = AgentFrame.of(PointCloud.of(POINTS), Transform.identity())
    count = Count("near-field")
    add_frame(count, CASES["near-field"], boxes([10.0], [0.9]), frame, TRUTH, 0.4)
    assert (count.vehicles, count.matched, count.false_boxes) == (0, 0, 0)


def test_each_vehicle_is_matched_once_by_the_best_scores():
    assert match(boxes([10.1, 10.2], [0.9, 0.8]), TRUTH).tolist() == [True, False]
    assert match(boxes([14.0], [0.9]), TRUTH).tolist() == [False, False]


def test_points_above_a_roof_are_counted_without_those_below():
    assert count_points_above(TRUTH, POINTS).tolist() == [0, 6]


def test_without_vehicles_every_strong_box_is_false():
    frame = AgentFrame.of(PointCloud.of(POINTS), Transform.identity())
    count = Count("no-vehicles")
    add_frame(count, CASES["no-vehicles"], boxes([10.0, 20.0], [0.9, 0.5]), frame, TRUTH[:0], 0.4)
    assert (count.vehicles, count.false_boxes) == (0, 2)
