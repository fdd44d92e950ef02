# SPDX-License-Identifier: Apache-2.0
"""Who answers for which box: the nearest token, no token twice, in metres and not in cells."""

import math
from dataclasses import replace

import pytest
import torch

from manyeyes.datatypes import BevGrid, Boxes, Sites
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.training.detector.targets import TargetConfig, Targets, assign_targets, find_nearby_objects, match_pairs

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


def assign_slowly(sites: Sites, truth: list[Boxes], config: TargetConfig) -> Targets:
    """Grid by grid, and pair by pair in ascending order of distance."""
    n, batch, xy = len(sites), sites.batch, sites.xy
    heat, weight, box = torch.zeros(n), torch.zeros(n), torch.full((n,), -1)
    positive, first = torch.zeros(n, dtype=torch.bool), 0
    for b, boxes in enumerate(truth):
        rows = (batch == b).nonzero()[:, 0]
        if len(rows) and len(boxes):
            delta = xy[rows][:, None] - boxes.center[None, :, :2].float()
            distance = (delta[..., 0] ** 2 + delta[..., 1] ** 2).sqrt()
            nearest, which = distance.min(1)
            near = nearest < config.assign_radius_m
            heat[rows] = torch.exp(-(nearest**2) / (2 * config.heat_sigma_m**2)).clamp_max(0.99)
            box[rows[near]] = which[near] + first
            weight[rows[near]] = torch.exp(-(nearest[near] ** 2) / (2 * config.shape_sigma_m**2))
            for site, target in match_slowly(distance, config.assign_radius_m):
                heat[rows[site]], weight[rows[site]], positive[rows[site]] = 1.0, 1.0, True
                box[rows[site]] = first + target
        first += len(boxes)
    return Targets(heat, box, weight, Boxes.cat(truth), positive)


def match_slowly(distance: torch.Tensor, max_distance_m: float) -> list[tuple[int, int]]:
    site, target = (distance < max_distance_m).nonzero(as_tuple=True)
    order = distance[site, target].sort(stable=True).indices
    pairs: list[tuple[int, int]] = []
    for s, t in zip(site[order].tolist(), target[order].tolist()):
        if all(s != other and t != box for other, box in pairs):
            pairs.append((s, t))
    return pairs


def find_slowly(sites: Sites, truth: list[Boxes], config: TargetConfig) -> torch.Tensor:
    margin = max(config.prune_margin_m, sites.grid.cell_size_m / 2)
    near, first, xy, batch = torch.full((len(sites),), -1), 0, sites.xy, sites.batch
    for b, boxes in enumerate(truth):
        for row in (batch == b).nonzero()[:, 0].tolist():
            delta = xy[row] - boxes.center[:, :2].float()
            c, s = boxes.yaw.float().cos(), boxes.yaw.float().sin()
            ahead, aside = delta[:, 0] * c + delta[:, 1] * s, delta[:, 1] * c - delta[:, 0] * s
            half = boxes.size[:, :2].float() / 2 + margin
            inside = ((ahead.abs() <= half[:, 0]) & (aside.abs() <= half[:, 1])).nonzero()[:, 0]
            if len(inside):
                near[row] = first + int(inside[(delta[inside] ** 2).sum(1).argmin()])
        first += len(boxes)
    return near


def crowded_truth(seed: int) -> list[Boxes]:
    """Three grids: many boxes, some of them nearly in one place, none, and one."""
    u = keyed_uniform((20, 3), "targets", seed).float()
    xy = (u[:, :2] - 0.5) * 20
    xy[10:] = xy[:10] + (u[10:, :2] - 0.5) * 1.5
    many = replace(boxes_at(*map(tuple, xy.tolist())), yaw=u[:, 2] * 6)
    return [many, boxes_at(), boxes_at((1.0, 2.0))]


@pytest.mark.parametrize("stride", (2, 4, 8))
@pytest.mark.parametrize("seed", range(4))
def test_all_grids_at_once_have_the_targets_of_a_loop(stride, seed):
    sites, truth = every(stride, 3), crowded_truth(seed)
    keep = keyed_uniform((len(sites),), "targets sites", seed) < 0.7
    sites = Sites(sites.key[keep], sites.grid, 3)
    for config in (TargetConfig(), TargetConfig(assign_radius_m=4.0)):
        mine, its = assign_targets(sites, truth, config), assign_slowly(sites, truth, config)
        assert torch.equal(mine.positive, its.positive) and torch.equal(mine.box, its.box)
        assert int(mine.positive.sum()) >= 5
        assert torch.allclose(mine.heat, its.heat, rtol=1e-5) and torch.allclose(mine.weight, its.weight, rtol=1e-5)
        assert torch.equal(find_nearby_objects(sites, truth, config), find_slowly(sites, truth, config))


def test_a_long_chain_of_boxes_is_matched_like_the_greedy_rule():
    """Every box lies nearest to the site of the one before: each round settles one pair."""
    site = torch.tensor([0, 0, 1, 1, 2, 2, 3, 3, 4])
    box = torch.tensor([0, 1, 1, 2, 2, 3, 3, 4, 4])
    assert match_pairs(site, box, 6, 5).tolist() == [0, 1, 2, 3, 4, -1]
    assert match_pairs(site.flip(0), box.flip(0), 6, 5).tolist() == [0, 1, 2, 3, 4, -1]
    assert match_pairs(site[1:-1], box[1:-1], 6, 5).tolist() == [1, 2, 3, 4, -1, -1]
    assert match_pairs(site[:0], box[:0], 2, 0).tolist() == [-1, -1]


def test_targets_of_another_device_are_those_of_the_cpu(device, is_gpu):
    """Equal bit by bit where the operators are the CPU's; a GPU's exponential and logarithm round otherwise."""
    sites, truth, config = every(4, 3), crowded_truth(0), TargetConfig()
    there = sites.to(device)
    mine, its = assign_targets(sites, truth, config), assign_targets(there, truth, config)
    assert its.heat.device == its.boxes.center.device == device
    rtol, atol = (1e-5, 1e-6) if is_gpu else (0.0, 0.0)
    for name in ("heat", "box", "weight"):
        torch.testing.assert_close(getattr(its, name).cpu(), getattr(mine, name), rtol=rtol, atol=atol)
    assert torch.equal(mine.positive, its.positive.cpu())
    assert torch.equal(find_nearby_objects(sites, truth, config), find_nearby_objects(there, truth, config).cpu())
