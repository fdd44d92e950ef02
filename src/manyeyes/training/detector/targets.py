# SPDX-License-Identifier: Apache-2.0
"""Targets of the detector: centre heatmap, box assignment of each cell, and cells near objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, count

import torch
from torch import Tensor

from manyeyes.datatypes import Boxes, Sites
from manyeyes.training.detector._target_kernels import find_containing_boxes

ROUNDS_BETWEEN_CHECKS = 2


@dataclass(frozen=True)
class TargetConfig:
    """Settings of the target assignment.

    Attributes:
        heat_sigma_m: standard deviation of the heatmap around a centre, in metres and so independent of the cell
            size.
        assign_radius_m: maximum distance from a box centre at which a cell learns the box's shape.
        shape_sigma_m: standard deviation of the Gaussian weight of the shape loss.
        prune_margin_m: minimum enlargement of boxes for the cells near objects.
    """

    heat_sigma_m: float = 0.6
    assign_radius_m: float = 2.4
    shape_sigma_m: float = 1.2
    prune_margin_m: float = 0.5


@dataclass(frozen=True, eq=False)
class Targets:
    """Targets of N sites and M boxes, concatenated over the grids of a batch.

    heat: (N,), exactly 1 at one distinct site per box. box: (N,) int64, row of the assigned box, -1 for none. weight:
    (N,), of the shape
    loss. boxes: the M boxes. positive: (N,) bool, where heat is exactly 1. class_heat, class_positive: (N, classes), the same for
    each class of a detector of several; None of one.
    """

    heat: Tensor
    box: Tensor
    weight: Tensor
    boxes: Boxes
    positive: Tensor
    class_heat: Tensor | None = None
    class_positive: Tensor | None = None


@dataclass(frozen=True, eq=False)
class BoxBatch:
    """Ground truth of the B grids of a batch, on one device.

    Attributes:
        boxes: the M boxes of all grids, one grid after another, float32.
        places: (B, K, 6) float32, of at most K boxes of each grid: x, y, cosine and sine of the yaw, half length, half width.
        row: (B, K) int64, their rows of boxes; -1 where a grid has fewer than K.
    """

    boxes: Boxes
    places: Tensor
    row: Tensor

    @classmethod
    def of(cls, truth: Sequence[Boxes], device: torch.device) -> BoxBatch:
        """Batch the boxes of every grid, which are on the CPU, and move them to a device."""
        boxes = Boxes.cat(list(truth)).to(torch.float32)
        counts, width = [len(part) for part in truth], max(map(len, truth), default=0)
        at = torch.arange(width, device="cpu")
        first = torch.tensor([0, *accumulate(counts)][:-1], dtype=torch.int64, device="cpu")
        exists = at < torch.tensor(counts, dtype=torch.int64, device="cpu")[:, None]
        row = torch.where(exists, first[:, None] + at, -1)
        columns = (boxes.center[:, :2], boxes.yaw.cos()[:, None], boxes.yaw.sin()[:, None], boxes.size[:, :2] / 2)
        places = torch.cat((torch.cat(columns, 1), boxes.center.new_zeros(1, 6)))[row]
        return cls(boxes.to(device=device), places.to(device), row.to(device))

    def near(self, sites: Sites) -> tuple[Tensor, Tensor]:
        """Return for N sites the places (6, N, K) of the boxes of their grid, and their rows (N, K)."""
        batch = sites.batch
        found = self.places.flatten(1).index_select(0, batch).view(len(sites), self.row.shape[1], 6)
        return found.permute(2, 0, 1), self.row.index_select(0, batch)


def assign_targets(sites: Sites, truth: Sequence[Boxes] | BoxBatch, config: TargetConfig) -> Targets:
    """Assign ground truth boxes to sites: the nearest site of a box is its centre; no site serves two boxes.

    Pairs are taken in ascending order of distance (ties by site, then box), so that a box whose nearest site is taken gets the
    next. A box without site within assign_radius_m has no centre. truth: of every grid of the batch.
    """
    batch = truth if isinstance(truth, BoxBatch) else BoxBatch.of(truth, sites.key.device)
    places, row = batch.near(sites)
    xy = sites.xy
    if not row.numel():
        none = xy.new_zeros(len(sites))
        return Targets(none, torch.full_like(sites.key, -1), none, batch.boxes, none > 0)
    dx, dy = xy[:, :1] - places[0], xy[:, 1:] - places[1]
    distance = torch.where(row >= 0, (dx * dx + dy * dy).sqrt(), torch.inf)
    nearest, which = distance.min(1)
    near = nearest < config.assign_radius_m
    heat = torch.exp(-(nearest**2) / (2 * config.heat_sigma_m**2)).clamp_max(0.99)
    box = torch.where(near, row.gather(1, which[:, None])[:, 0], -1)
    weight = torch.where(near, torch.exp(-(nearest**2) / (2 * config.shape_sigma_m**2)), 0.0)
    site, column = (distance < config.assign_radius_m).nonzero().unbind(1)
    target, order = row[site, column], distance[site, column].sort(stable=True).indices
    centre = match_pairs(site[order], target[order], len(sites), len(batch.boxes))
    positive = centre >= 0
    box = torch.where(positive, centre, box)
    return Targets(heat.masked_fill(positive, 1.0), box, weight.masked_fill(positive, 1.0), batch.boxes, positive)


def add_class_heat(
    targets: Targets, sites: Sites, truth: Sequence[Boxes], classes: Sequence[str], config: TargetConfig
) -> Targets:
    """Return the targets with a heat map for each class; unchanged for one class. truth: of every grid of the batch."""
    if len(classes) == 1:
        return targets
    parts = [assign_targets(sites, [boxes.of_classes((name,)) for boxes in truth], config) for name in classes]
    heat, positive = ([getattr(part, name) for part in parts] for name in ("heat", "positive"))
    return replace(targets, class_heat=torch.stack(heat, 1), class_positive=torch.stack(positive, 1))


def match_pairs(site: Tensor, box: Tensor, num_sites: int, num_boxes: int) -> Tensor:
    """Match sites (P,) and boxes (P,), pairs in descending priority; returns the box (num_sites,) of each site, -1 for none.

    Greedy matching takes a pair if neither side is taken by an earlier one. Here every round takes all pairs that come
    first on both sides, which the greedy rule takes too; a few rounds leave none.
    """
    place = torch.arange(len(site), device=site.device)
    found = site.new_full((num_sites,), -1)
    taken = site.new_zeros(num_boxes)
    free, last = torch.ones_like(site, dtype=torch.bool), len(site)
    for number in count():
        # A pair that is not free counts as one after the last.
        priority = torch.where(free, place, last)
        first_of_site = site.new_full((num_sites,), last).scatter_reduce_(0, site, priority, "amin")
        first_of_box = site.new_full((num_boxes,), last).scatter_reduce_(0, box, priority, "amin")
        is_first = free & (first_of_site[site] == place) & (first_of_box[box] == place)
        found = found.scatter_reduce(0, site, torch.where(is_first, box, -1), "amax")
        taken = taken.index_add(0, box, is_first.long())
        free = free & (found[site] < 0) & (taken[box] == 0)
        # Asking whether pairs are left makes the host wait.
        if number % ROUNDS_BETWEEN_CHECKS == ROUNDS_BETWEEN_CHECKS - 1 and not bool(free.any()):
            return found
    raise AssertionError("every round takes the first free pair")


def find_nearby_objects(sites: Sites, truth: Sequence[Boxes] | BoxBatch, config: TargetConfig) -> Tensor:
    """Return the box (N,) int64, a row over all grids, that contains a cell's centre, -1 for none.

    Boxes are enlarged by max(prune_margin_m, half a cell) on every side; of several, the nearest centre wins.
    """
    batch = truth if isinstance(truth, BoxBatch) else BoxBatch.of(truth, sites.key.device)
    margin = max(config.prune_margin_m, sites.grid.cell_size_m / 2)
    if sites.key.device.type == "cpu":
        columns = sites.xy.numpy(), sites.batch.numpy(), batch.places.contiguous().numpy(), batch.row.numpy()
        return torch.from_numpy(find_containing_boxes(*columns, margin))
    return _find_by_tensors(sites, batch, margin)


def _find_by_tensors(sites: Sites, batch: BoxBatch, margin: float) -> Tensor:
    """Do the same on any device."""
    (x, y, cosine, sine, half_length, half_width), row = batch.near(sites)
    if not row.numel():
        return torch.full_like(sites.key, -1)
    xy = sites.xy
    dx, dy = xy[:, :1] - x, xy[:, 1:] - y
    inside = ((dx * cosine + dy * sine).abs() <= half_length + margin) & (row >= 0)
    inside &= (dy * cosine - dx * sine).abs() <= half_width + margin
    distance, which = torch.where(inside, dx * dx + dy * dy, torch.inf).min(1)
    return torch.where(distance < torch.inf, row.gather(1, which[:, None])[:, 0], -1)
