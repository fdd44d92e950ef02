# SPDX-License-Identifier: Apache-2.0
"""From points to features on pillars, without caps on points or pillars."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from manyeyes.datatypes import BevGrid, PointCloud, SparseBev
from manyeyes.models.layers import ActiveNorm, fold_norm
from manyeyes.ops.segment_affine import affine_segment_max
from manyeyes.ops.voxelize import Pillars, pillar_moments, pillar_sites, segment_max, segment_mean

PillarKind = Literal["points", "moments"]
MOMENTS = 12


class PointPillars(nn.Module):
    """Per-point linear layer and maximum over each pillar (PointPillars, Lang et al. 2019, eq. in section 2.1)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.linear, self.norm = nn.Linear(10, channels, bias=False), ActiveNorm(channels)

    def forward(self, xyz: Tensor, intensity: Tensor, pillars: Pillars) -> Tensor:
        """Kept points (P, 3) and (P,) to pillar features (N, channels)."""
        sites, row = pillars.sites, pillars.row
        mean = segment_mean(xyz, row, len(sites))
        grid = sites.grid
        centre = torch.cat((sites.xy, sites.xy.new_full((len(sites), 1), (grid.z_min + grid.z_max) / 2)), -1)
        if not self.training and not torch.is_grad_enabled():
            return self._infer(xyz, intensity, row, mean, centre)
        inputs = torch.cat((xyz, intensity[:, None], xyz - mean[row], xyz - centre[row]), -1)
        return segment_max(torch.relu(self.norm(self.linear(inputs))), row, len(sites))

    def _infer(self, xyz: Tensor, intensity: Tensor, row: Tensor, mean: Tensor, centre: Tensor) -> Tensor:
        """The same numbers with the norm folded in: within a pillar only four of the ten inputs differ from point to point."""
        weight, bias = fold_norm(self.linear.weight, self.norm)
        place, bright, to_mean, to_centre = weight.split((3, 1, 3, 3), 1)
        varying = torch.cat((place + to_mean + to_centre, bright), 1)
        points = torch.cat((xyz, intensity[:, None]), 1)
        origin = torch.cat((centre, centre.new_zeros(len(centre), 1)), 1)
        top = affine_segment_max(points, origin, varying, row)
        return torch.relu_(top + centre @ place.T + (centre - mean) @ to_mean.T + bias)


class MomentPillars(nn.Module):
    """A two-layer perceptron on twelve statistics of each pillar: no gradient through points, so training it costs less."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.scale = ActiveNorm(MOMENTS)
        self.layers = nn.Sequential(
            nn.Linear(MOMENTS, 2 * channels), nn.ReLU(), nn.Linear(2 * channels, channels, bias=False)
        )
        self.norm = ActiveNorm(channels)

    def forward(self, xyz: Tensor, intensity: Tensor, pillars: Pillars) -> Tensor:
        """Kept points (P, 3) and (P,) to pillar features (N, channels)."""
        moments = pillar_moments(xyz, intensity, pillars.row, pillars.sites)
        return torch.relu(self.norm(self.layers(self.scale(moments))))


class PillarEncoder(nn.Module):
    """Clouds of a batch of agents to features at stride 1."""

    def __init__(self, grid: BevGrid, channels: int, kind: PillarKind) -> None:
        super().__init__()
        self.grid = grid.at(1)
        self.net = PointPillars(channels) if kind == "points" else MomentPillars(channels)

    def forward(self, clouds: list[PointCloud]) -> SparseBev:
        """One cloud an agent, each in that agent's frame, to (N, channels) on a batch of as many grids."""
        cloud = PointCloud.cat(clouds)
        batch = torch.repeat_interleave(torch.arange(len(clouds)), torch.tensor([len(c) for c in clouds]))
        pillars = pillar_sites(cloud.xyz, batch, self.grid, len(clouds))
        kept = pillars.inside.nonzero()[:, 0]
        features = self.net(cloud.xyz.index_select(0, kept), cloud.intensity.index_select(0, kept), pillars)
        return SparseBev(features, pillars.sites)
