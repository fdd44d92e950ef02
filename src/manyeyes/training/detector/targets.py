# SPDX-License-Identifier: Apache-2.0
"""Targets of the detector: centre heatmap, box assignment of each cell, and cells near objects."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from manyeyes.datatypes import Boxes, Sites


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
    loss. boxes: the M boxes. positive: (N,) bool, where heat is exactly 1.
    """

    heat: Tensor
    box: Tensor
    weight: Tensor
    boxes: Boxes
    positive: Tensor


def assign_targets(sites: Sites, truth: list[Boxes], config: TargetConfig) -> Targets:
    """Assign ground truth boxes to sites: the nearest site of a box is its centre; no site serves two boxes.

    Pairs are taken in ascending order of distance (ties by site, then box), so that a box whose nearest site is taken
    gets the next. A box
    without site within assign_radius_m has no centre.
    """
    n, batch, xy = len(sites), sites.batch, sites.xy
    heat, weight = torch.zeros(n), torch.zeros(n)
    box = torch.full((n,), -1, dtype=torch.int64)
    positive, first = torch.zeros(n, dtype=torch.bool), 0
    for b, boxes in enumerate(truth):
        rows = (batch == b).nonzero()[:, 0]
        if len(rows) and len(boxes):
            distance = torch.cdist(xy[rows], boxes.center[:, :2].float())
            nearest, which = distance.min(1)
            near = nearest < config.assign_radius_m
            heat[rows] = torch.exp(-(nearest**2) / (2 * config.heat_sigma_m**2)).clamp_max(0.99)
            box[rows[near]] = which[near] + first
            weight[rows[near]] = torch.exp(-(nearest[near] ** 2) / (2 * config.shape_sigma_m**2))
            for site, target in _unique_pairs(distance, config.assign_radius_m):
                heat[rows[site]], weight[rows[site]], positive[rows[site]] = 1.0, 1.0, True
                box[rows[site]] = first + target
        first += len(boxes)
    return Targets(heat, box, weight, Boxes.cat(truth), positive)


def _unique_pairs(distance: Tensor, max_distance_m: float) -> list[tuple[int, int]]:
    site, target = (distance < max_distance_m).nonzero(as_tuple=True)
    order = distance[site, target].sort(stable=True).indices
    taken_sites: set[int] = set()
    taken_boxes: set[int] = set()
    pairs = []
    for s, t in zip(site[order].tolist(), target[order].tolist()):
        if s not in taken_sites and t not in taken_boxes:
            taken_sites.add(s)
            taken_boxes.add(t)
            pairs.append((s, t))
    return pairs


def find_nearby_objects(sites: Sites, truth: list[Boxes], config: TargetConfig) -> Tensor:
    """Return the box (N,) int64, a row over all grids, that contains a cell's centre, -1 for none.

    Boxes are enlarged by max(prune_margin_m, half a cell) on every side; of several, the nearest centre wins.
    """
    margin = max(config.prune_margin_m, sites.grid.cell_size_m / 2)
    batch, xy = sites.batch, sites.xy
    near, first = torch.full((len(sites),), -1, dtype=torch.int64), 0
    for b, boxes in enumerate(truth):
        rows = (batch == b).nonzero()[:, 0]
        if len(rows) and len(boxes):
            delta = xy[rows][:, None] - boxes.center[None, :, :2].float()
            c, s = boxes.yaw.float().cos(), boxes.yaw.float().sin()
            longitudinal, lateral = delta[..., 0] * c + delta[..., 1] * s, delta[..., 1] * c - delta[..., 0] * s
            half = boxes.size[:, :2].float() / 2 + margin
            inside = (longitudinal.abs() <= half[:, 0]) & (lateral.abs() <= half[:, 1])
            distance, which = torch.where(inside, delta.norm(dim=2), torch.inf).min(1)
            near[rows] = torch.where(distance < torch.inf, which + first, -1)
        first += len(boxes)
    return near
