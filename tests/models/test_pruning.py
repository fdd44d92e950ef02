# SPDX-License-Identifier: Apache-2.0
"""Which cells pruning is taught to keep, and what it does with those it is sure of."""

import pytest
import torch

from manyeyes.datatypes import BevGrid, Boxes, Sites, SparseBev
from manyeyes.models.detector.pruning import FocalPrune
from manyeyes.training.detector.targets import TargetConfig, find_nearby_objects

GRID = BevGrid(-51.2, -51.2, -3.0, 51.2, 51.2, 5.0)


def cars_on_a_lattice_of_offsets(stride: int, steps: int = 32) -> tuple[Sites, list[Boxes]]:
    """One axis-aligned car of 4.5 x 1.9 m a grid, its centre at every offset within a cell across its width."""
    grid = GRID.at(stride)
    across = (torch.arange(steps) + 0.5) / steps * grid.cell_size_m
    sites = Sites(torch.arange(steps * grid.shape[0] * grid.shape[1]), grid, steps)
    one = torch.tensor([[4.5, 1.9, 1.6]])
    centre = grid.centers(torch.tensor([[grid.shape[0] // 2, grid.shape[1] // 2]]))[0]
    return sites, [
        Boxes.of(torch.tensor([[float(centre[0]), float(centre[1] + y), 0.8]]), one, torch.zeros(1)) for y in across
    ]


def cars_met(near: torch.Tensor, sites: Sites) -> float:
    return len(sites.batch[near].unique()) / sites.batch_size


def test_without_a_margin_two_of_five_cars_have_no_cell_at_stride_8():
    sites, boxes = cars_on_a_lattice_of_offsets(8)
    xy = sites.xy
    inside = torch.zeros(len(sites), dtype=torch.bool)
    for b, box in enumerate(boxes):
        rows = sites.batch == b
        points = torch.cat((xy[rows], torch.full((int(rows.sum()), 1), 0.8)), 1)
        inside[rows] = box.contains(points)[0]
    assert cars_met(inside, sites) == pytest.approx(1.9 / 3.2, abs=0.02)
    assert cars_met(find_nearby_objects(sites, boxes, TargetConfig()) >= 0, sites) == 1.0


@pytest.mark.parametrize(("stride", "margin"), [(1, 0.5), (2, 0.5), (4, 0.8), (8, 1.6), (32, 6.4)])
def test_the_margin_is_half_a_cell_but_never_below_the_setting(stride, margin):
    grid = GRID.at(stride)
    sites = Sites(torch.arange(grid.shape[0] * grid.shape[1]), grid)
    box = Boxes.of(torch.tensor([[0.3, -0.2, 0.8]]), torch.tensor([[4.5, 1.9, 1.6]]), torch.zeros(1))
    off = (sites.xy - torch.tensor([0.3, -0.2])).abs()
    wanted = (off[:, 0] <= 2.25 + margin) & (off[:, 1] <= 0.95 + margin)
    assert torch.equal(find_nearby_objects(sites, [box], TargetConfig()) >= 0, wanted) and bool(wanted.any())


def test_a_turned_box_turns_its_neighbourhood():
    grid = GRID.at(2)
    sites = Sites(torch.arange(grid.shape[0] * grid.shape[1]), grid)
    box = Boxes.of(torch.zeros(1, 3), torch.tensor([[10.0, 2.0, 1.6]]), torch.tensor([torch.pi / 4]))
    near = sites.xy[find_nearby_objects(sites, [box], TargetConfig()) >= 0]
    along, across = (near[:, 0] + near[:, 1]) / 2**0.5, (near[:, 1] - near[:, 0]) / 2**0.5
    assert float(along.abs().max()) > 4.5 and float(across.abs().max()) <= 1.5


def test_prune_keeps_what_is_above_the_threshold_and_reports_all():
    prune = FocalPrune(3)
    with torch.no_grad():
        prune.score.weight.copy_(torch.tensor([[1.0, 0.0, 0.0]]))
        prune.score.bias.zero_()
    logit = torch.tensor([-3.0, 0.0, 3.0, 0.1])
    x = SparseBev(torch.stack((logit, logit * 0, logit * 0), 1), Sites(torch.tensor([1, 4, 7, 9]), GRID))
    kept, pruned = prune(x, 0.5)
    assert kept.sites.key.tolist() == [7, 9] and kept.sites is not x.sites
    assert pruned.sites is x.sites and torch.equal(pruned.logit, logit)
    assert torch.equal(kept.features, x.features[2:])
    same, _ = prune(x, 0.0)
    assert same is x
    nothing, _ = prune(x, 0.999)
    assert len(nothing.sites) == 0


def test_the_loss_reaches_the_features_through_the_logit():
    prune = FocalPrune(3)
    x = SparseBev(torch.randn(5, 3, requires_grad=True), Sites(torch.arange(5), GRID))
    _, pruned = prune(x, 0.3)
    pruned.logit.sum().backward()
    assert x.features.grad is not None and bool((x.features.grad != 0).all())


def test_a_cell_of_several_boxes_is_near_the_nearest_of_its_own_grid():
    grid = GRID.at(4)
    everywhere = torch.arange(grid.shape[0] * grid.shape[1])
    sites = Sites(torch.cat((everywhere, everywhere + len(everywhere))), grid, 2)
    apart = torch.tensor([[-2.0, 0.0, 0.8], [2.0, 0.0, 0.8]])
    two = Boxes.of(apart, torch.tensor([[4.5, 1.9, 1.6]] * 2), torch.zeros(2))
    near = find_nearby_objects(sites, [two, two[:1]], TargetConfig())
    inside = near[: len(everywhere)] >= 0
    closer = torch.cdist(sites.xy[: len(everywhere)], apart[:, :2]).argmin(1)
    assert torch.equal(near[: len(everywhere)][inside], closer[inside]) and set(near.tolist()) == {-1, 0, 1, 2}
    assert set(near[: len(everywhere)].tolist()) == {-1, 0, 1}
