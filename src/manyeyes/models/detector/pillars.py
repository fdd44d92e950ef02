# SPDX-License-Identifier: Apache-2.0
"""Encode points to pillar features, without limits on the number of points or pillars."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from manyeyes.datatypes import BevGrid, PointCloud, SparseBev
from manyeyes.models.detector.layers import ActiveNorm, fold_norm
from manyeyes.ops._pillar_kernels import cloud_moments, pillar_maxima
from manyeyes.ops.voxelize import Pillars, pillar_moments, pillar_sites, segment_max, segment_mean

PillarKind = Literal["points", "moments"]
NUM_MOMENTS = 12


class PointPillars(nn.Module):
    """Per-point linear layer and maximum over each pillar (PointPillars, Lang et al. 2019, section 2.1).

    With two sweeps, the age of a point in sweeps is another input.
    """

    def __init__(self, channels: int, sweeps: int = 1) -> None:
        super().__init__()
        self.sweeps = sweeps
        self.linear, self.norm = nn.Linear(9 + sweeps, channels, bias=False), ActiveNorm(channels)

    def forward(self, xyz: Tensor, intensities: Tensor, is_previous: Tensor, pillars: Pillars) -> Tensor:
        """Encode points (P, 3), their intensities (P,) and is_previous (P,) bool to (N, channels)."""
        intensity = (
            intensities[:, None]
            if self.sweeps == 1
            else torch.stack((intensities, is_previous.to(intensities.dtype)), 1)
        )
        sites, row = pillars.sites, pillars.row
        mean = segment_mean(xyz, row, len(sites))
        grid = sites.grid
        centre = torch.cat((sites.xy, sites.xy.new_full((len(sites), 1), (grid.z_min + grid.z_max) / 2)), -1)
        inputs = torch.cat((xyz, intensity[:, :1], xyz - mean[row], xyz - centre[row], intensity[:, 1:]), -1)
        return segment_max(torch.relu(self.norm(self.linear(inputs))), row, len(sites))

    def infer(self, clouds: list[PointCloud], previous_clouds: list[PointCloud], grid: BevGrid) -> SparseBev:
        """Encode whole clouds for inference, with the norm folded in; float32 on the CPU, same values as forward."""
        weight, bias = fold_norm(self.linear.weight, self.norm)
        return pillar_maxima(clouds, previous_clouds, grid, nn.functional.pad(weight, (0, 2 - self.sweeps)), bias)


class MomentPillars(nn.Module):
    """A two-layer perceptron on twelve moments of each pillar; without gradients through points, so cheap to train.

    With two sweeps there are twelve moments of each.
    """

    def __init__(self, channels: int, sweeps: int = 1) -> None:
        super().__init__()
        self.sweeps = sweeps
        self.scale = ActiveNorm(NUM_MOMENTS * sweeps)
        self.layers = nn.Sequential(
            nn.Linear(NUM_MOMENTS * sweeps, 2 * channels), nn.ReLU(), nn.Linear(2 * channels, channels, bias=False)
        )
        self.norm = ActiveNorm(channels)

    def forward(self, xyz: Tensor, intensities: Tensor, is_previous: Tensor, pillars: Pillars) -> Tensor:
        """Encode points (P, 3), their intensities (P,) and is_previous (P,) bool to (N, channels)."""
        sweeps = (~is_previous, is_previous) if self.sweeps == 2 else (slice(None),)
        moments = torch.cat([pillar_moments(xyz[s], intensities[s], pillars.row[s], pillars.sites) for s in sweeps], 1)
        return self.encode(moments)

    def encode(self, moments: Tensor) -> Tensor:
        """Encode moments (N, NUM_MOMENTS * sweeps) to (N, channels)."""
        return self.norm.forward_relu(self.layers(self.scale(moments)))


class PillarEncoder(nn.Module):
    """Encode the clouds of a batch of agents, and with two sweeps the previous ones, at stride 1."""

    def __init__(self, grid: BevGrid, channels: int, kind: PillarKind, sweeps: int = 1) -> None:
        super().__init__()
        self.grid, self.sweeps = grid.at(1), sweeps
        self.net = PointPillars(channels, sweeps) if kind == "points" else MomentPillars(channels, sweeps)

    def forward(self, clouds: list[PointCloud], previous_clouds: list[PointCloud] | None = None) -> SparseBev:
        """Encode one cloud per agent, in that agent's frame, to (N, channels) on one grid per agent.

        previous_clouds: the previous sweeps, transformed to the same frames; omitted where the network takes one
        sweep.
        """
        before = previous_clouds if previous_clouds is not None and self.sweeps == 2 else []
        many, agents = [*clouds, *before], [*range(len(clouds)), *range(len(before))]
        device = next(self.parameters()).device
        is_inference = not self.training and not torch.is_grad_enabled()
        if isinstance(self.net, PointPillars) and is_inference and device.type == "cpu" and _plain(many):
            return self.net.infer(clouds, before, self.grid)
        if isinstance(self.net, MomentPillars) and device.type == "cpu" and _plain(many):
            moments = cloud_moments(clouds, before, self.grid, self.sweeps)
            return moments.with_features(self.net.encode(moments.features))
        numbers = [cloud.xyz.new_full((len(cloud),), agent, dtype=torch.int64) for cloud, agent in zip(many, agents)]
        parts = ([cloud.xyz for cloud in many], [cloud.intensity for cloud in many], numbers)
        # The clouds of a batch become three tensors first, so that three copies bring them to the device.
        xyz, intensities, batch = (_move(_concatenate(part), device) for part in parts)
        pillars = pillar_sites(xyz, batch, self.grid, len(clouds))
        kept = pillars.inside.nonzero()[:, 0]
        is_previous = kept >= sum(map(len, clouds))
        xyz, intensities = xyz.index_select(0, kept), intensities.index_select(0, kept)
        features = self.net(xyz, intensities, is_previous, pillars)
        return SparseBev(features, pillars.sites)


def _plain(clouds: list[PointCloud]) -> bool:
    """Return whether compiled loops can read these tensors."""
    return all(cloud.xyz.dtype == torch.float32 and cloud.xyz.device.type == "cpu" for cloud in clouds)


def _move(rows: Tensor, device: torch.device) -> Tensor:
    """Bring rows to the device of the weights; from pinned memory to a GPU, so that the host does not wait."""
    pinned = rows.pin_memory() if device.type == "cuda" and not rows.is_cuda and torch.cuda.is_available() else rows
    return pinned.to(device, non_blocking=True)


def _concatenate(parts: list[Tensor]) -> Tensor:
    """Concatenate rows; a single part is not copied."""
    return parts[0] if len(parts) == 1 else torch.cat(parts)
