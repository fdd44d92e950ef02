# SPDX-License-Identifier: Apache-2.0
"""Rays through and to boxes: compiled loops equal the slab test of every ray, and hand-made rays."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from manyeyes.datatypes import Boxes
from manyeyes.ops.lidar.box_rays import (
    MAX_RAISED_M,
    MIN_GROUND_RETURNS,
    count_box_rays,
    count_box_rays_reference,
    place_on_ground,
)

ORIGIN = torch.tensor([0.0, 0.0, 2.0])
CAR = Boxes.of([[10.0, 0.0, 1.0]], [[4.0, 2.0, 2.0]], [0.0])


def count(*returns: tuple[float, float, float], margin_m: float = 0.3, car: Boxes = CAR) -> tuple[int, int]:
    found = count_box_rays(torch.tensor(returns), ORIGIN, car, torch.tensor([margin_m]))
    return int(found.num_passing[0]), int(found.num_hits[0])


@pytest.mark.parametrize("seed", range(3))
def test_loops_equal_the_reference(seed):
    rng = torch.Generator().manual_seed(seed)
    points = torch.randn(2000, 3, generator=rng) * torch.tensor([20.0, 20.0, 1.0])
    center = torch.cat(((torch.rand(60, 2, generator=rng) - 0.5) * 60, torch.full((60, 1), 0.8)), 1)
    boxes = Boxes.of(center, torch.rand(60, 3, generator=rng) * 4 + 1, torch.rand(60, generator=rng) * 7 - 3.5)
    margin = torch.rand(60, generator=rng)
    origin = torch.tensor([0.4, -0.3, 1.9])
    fast, slow = (f(points, origin, boxes, margin) for f in (count_box_rays, count_box_rays_reference))
    assert torch.equal(fast.num_passing, slow.num_passing) and torch.equal(fast.num_hits, slow.num_hits)
    assert torch.equal(fast.num_inner, slow.num_inner) and 50 < int(fast.num_inner.sum()) < int(fast.num_hits.sum())
    assert int(fast.num_passing.sum()) > 50 and int(fast.num_hits.sum()) > 50


def test_a_ray_passes_if_it_returns_from_behind_the_core():
    assert count((20.0, 0.0, 0.0)) == (1, 0)
    assert count((12.1, 0.0, 1.0)) == (0, 1), "less than half a metre behind the core"
    assert count((5.0, 0.0, 1.0)) == (0, 0), "returned before the box"
    assert count((20.0, 3.0, 0.0)) == (0, 0), "beside it"
    assert count((20.0, 0.0, 3.0)) == (0, 0), "above it"


def test_a_margin_shrinks_the_core_and_enlarges_the_hull():
    beside = (7.8, 1.2, 1.0)
    assert count(beside, margin_m=0.1)[1] == 0 and count(beside, margin_m=0.3)[1] == 1
    edge = (20.0, 1.5, 0.5)
    assert count(edge, margin_m=0.1)[0] == 1 and count(edge, margin_m=0.6)[0] == 0
    assert count((20.0, 0.0, 0.0), margin_m=1.1)[0] == 0, "nothing is left of the core"


def test_ground_returns_are_no_hits_and_no_box_around_the_sensor_has_rays():
    assert count((10.0, 0.0, 0.1))[1] == 0
    assert count((20.0, 0.0, 0.0), car=Boxes.of([[1.0, 0.0, 1.0]], [[4.0, 2.0, 2.0]], [0.0])) == (0, 0)


def test_boxes_across_the_negative_x_axis_have_all_their_rays():
    behind = Boxes.of([[-10.0, 0.0, 1.0]], [[4.0, 2.0, 2.0]], [0.5])
    assert count((-20.0, 0.1, 0.0), (-20.0, -0.1, 0.0), (-8.5, 0.5, 1.0), car=behind)[0] == 2


def test_no_points_and_no_boxes():
    none = count_box_rays(torch.zeros(0, 3), ORIGIN, CAR, torch.tensor([0.3]))
    assert none.num_passing.tolist() == none.num_hits.tolist() == [0]
    assert len(count_box_rays(torch.zeros(5, 3), ORIGIN, Boxes.empty(), torch.zeros(0)).num_hits) == 0


def test_a_box_off_the_ground_is_set_on_it_where_the_ground_is_seen():
    ground = np.array([[10.0 + k, 0.5, 0.05] for k in (-2, -1, 0, 1, 2)], np.float32)
    assert len(ground) == MIN_GROUND_RETURNS
    bases = np.array([-2.5, -0.51, -0.49, 0.0, 0.49, 1.0, MAX_RAISED_M + 0.1])
    boxes = np.tile([10.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.3], (len(bases), 1))
    boxes[:, 2] = 0.75 + bases
    placed = place_on_ground(ground, boxes)
    assert placed[:, 2].tolist() == pytest.approx([0.75, 0.75, 0.26, 0.75, 1.24, 0.75, 0.85 + MAX_RAISED_M])
    assert np.array_equal(np.delete(placed, 2, axis=1), np.delete(boxes, 2, axis=1))
    # Too few returns of the ground, returns from elsewhere, or from higher up: nothing moves.
    for returns in (ground[1:], ground + np.float32([6, 0, 0]), ground + np.float32([0, 0, 1]), ground[:0]):
        assert np.array_equal(place_on_ground(returns, boxes), boxes)
