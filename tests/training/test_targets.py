# SPDX-License-Identifier: Apache-2.0
"""Who answers for which box: the nearest token, no token twice, in metres and not in cells."""

import math

import pytest
import torch

from manyeyes.datatypes import BevGrid, Boxes, Sites
from manyeyes.training.detector.targets import TargetConfig, assign_targets

GRID = BevGrid(-12.8, -12.8, -3.0, 12.8, 12.8, 5.0)


def every(stride: int = 4, batch_size: int = 1) -> Sites:
    grid = GRID.at(stride)
    return Sites(torch.arange(batch_size * grid.shape[0] * grid.shape[1]), grid, batch_size)


def boxes_at(*xy: tuple[float, float]) -> Boxes:
    n = len(xy)
    center = torch.cat((torch.tensor(xy, dtype=torch.float32).view(n, 2), torch.full((n, 1), 0.8)), 1)
    return Boxes.of(center, torch.tensor([4.5, 1.9, 1.6]).expand(n, 3), torch.zeros(n))


def test_the_nearest_token_is_the_centre_and_heat_falls_in_metres():
    sites = every()
    middle = sites.xy[37]
    targets = assign_targets(sites, [boxes_at((float(middle[0]) + 0.5, float(middle[1]) - 0.3))], TargetConfig())
    assert targets.positive.nonzero().flatten().tolist() == [37]
    assert float(targets.heat[37]) == 1.0 and float(targets.weight[37]) == 1.0
    distance = torch.hypot(*(sites.xy - middle - torch.tensor([0.5, -0.3])).T)
    others = torch.arange(len(sites)) != 37
    wanted = torch.exp(-(distance**2) / (2 * 0.6**2)).clamp_max(0.99)
    assert torch.allclose(targets.heat[others], wanted[others], atol=1e-5)
    assert torch.equal(targets.box >= 0, distance < 2.4)


@pytest.mark.parametrize("stride", (2, 4, 8))
def test_two_boxes_of_one_cell_get_a_token_each(stride):
    sites = every(stride)
    x, y = sites.xy[len(sites) // 2 + 2].tolist()
    config = TargetConfig(assign_radius_m=2 * GRID.at(stride).cell_size_m)
    targets = assign_targets(sites, [boxes_at((x, y), (x + 0.2, y + 0.1))], config)
    centres = targets.positive.nonzero().flatten()
    assert len(centres) == 2 and sorted(targets.box[centres].tolist()) == [0, 1]
    assert targets.box[len(sites) // 2 + 2] == 0


def test_box_without_observed_cells_takes_the_nearest_within_the_radius_or_none():
    grid = GRID.at(4)
    some = Sites(torch.tensor([0, 1]), grid)
    x, y = some.xy[1].tolist()
    near = assign_targets(some, [boxes_at((x + 2.0, y))], TargetConfig())
    assert near.positive.tolist() == [False, True]
    far = assign_targets(some, [boxes_at((x + 2.5, y))], TargetConfig())
    assert not far.positive.any() and not (far.box >= 0).any()
    assert float(far.heat.max()) < 0.01


def test_grids_of_a_batch_have_their_own_boxes_and_rows_count_through():
    sites = every(4, 3)
    n = len(sites) // 3
    at = [sites.xy[i].tolist() for i in (10, 20, 30)]
    truth = [boxes_at(tuple(at[0])), boxes_at(), boxes_at(tuple(at[1]), tuple(at[2]))]
    targets = assign_targets(sites, truth, TargetConfig())
    assert targets.positive.nonzero().flatten().tolist() == [10, 2 * n + 20, 2 * n + 30]
    assert targets.box[targets.positive].tolist() == [0, 1, 2] and len(targets.boxes) == 3
    assert not targets.heat[n : 2 * n].any()


def test_no_sites_and_no_boxes():
    none = Sites(torch.zeros(0, dtype=torch.int64), GRID.at(4), 2)
    targets = assign_targets(none, [boxes_at((0.0, 0.0)), boxes_at()], TargetConfig())
    assert len(targets.heat) == 0 and len(targets.boxes) == 1
    assert not assign_targets(every(), [boxes_at()], TargetConfig()).heat.any()


def test_neighbours_learn_the_shape_of_the_nearest_box_with_less_weight():
    sites = every(2)
    targets = assign_targets(sites, [boxes_at((0.0, 0.0), (0.0, 3.0))], TargetConfig())
    owned = targets.box >= 0
    distance = torch.cdist(sites.xy[owned], torch.tensor([[0.0, 0.0], [0.0, 3.0]]))
    assert torch.equal(targets.box[owned], distance.argmin(1))
    soft = owned & ~targets.positive
    wanted = torch.exp(-(distance.min(1).values ** 2) / (2 * 1.2**2))
    assert torch.allclose(targets.weight[soft], wanted[soft[owned]], atol=1e-5)
    assert float(targets.weight[~owned].abs().max()) == 0 and math.isclose(float(targets.weight.max()), 1.0)
