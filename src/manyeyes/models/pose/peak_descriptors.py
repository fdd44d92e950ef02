# SPDX-License-Identifier: Apache-2.0
"""Keypoints without a confidence map: peaks of the features' norm, described by the tokens around them.

The rows of FeaKM's Table 3 without a confidence map, for the matcher of ``feakm-small``: boxes and scores are not used. A peak
has no heading: descriptors are made of lengths of vector channels and of means over rings, which do not depend on the agent's
heading, and the axis of a keypoint is the principal axis of the cells around it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from manyeyes._bounds import ChannelCount, StageCount
from manyeyes.datatypes import ConfigError, SparseBev
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.datatypes.message import DESCRIPTOR_DIM
from manyeyes.models.pose.keypoint_net import DetectorView, local_maxima, make_point_boxes
from manyeyes.ops.sparse_sample import bilinear

UNKNOWN_AXIS_RAD = math.pi / math.sqrt(12)
"""Standard deviation of an axis that may have any direction."""


@dataclass(frozen=True)
class PeakKeypointConfig:
    """Settings of keypoints at peaks of the features' norm.

    Attributes:
        in_channels: channels of the tokens, half of them (x, y) pairs of vectors.
        descriptor_dim: length of a descriptor.
        hidden_channels: width of the hidden layer.
        max_keypoints: maximum number of keypoints, the highest peaks first.
        nms_radius_m: distance within which only the highest peak is kept.
        ring_radii_m: radii of the rings around a peak whose mean features are part of the descriptor.
        samples_per_ring: samples on each ring.
        axis_radius_m: cells within this distance determine the axis.
    """

    in_channels: ChannelCount = 64
    descriptor_dim: ChannelCount = DESCRIPTOR_DIM
    hidden_channels: ChannelCount = 128
    max_keypoints: int = 64
    nms_radius_m: float = 2.4
    ring_radii_m: tuple[float, ...] = (1.6, 3.2, 6.4)
    samples_per_ring: StageCount = 8
    axis_radius_m: float = 4.0

    def __post_init__(self) -> None:
        lengths = self.max_keypoints, self.nms_radius_m, self.axis_radius_m, *self.ring_radii_m
        if not self.ring_radii_m or not min(lengths) > 0:
            raise ConfigError(
                "PeakKeypointConfig needs max_keypoints, nms_radius_m, axis_radius_m and at least one of ring_radii_m above 0."
            )


class PeakKeypointNet(nn.Module):
    """Describe the highest peaks of the features' norm with a small network."""

    def __init__(self, config: PeakKeypointConfig) -> None:
        super().__init__()
        self.config = config
        per_place = config.in_channels - config.in_channels // 4 + 1
        self.inner = nn.Linear((1 + len(config.ring_radii_m)) * per_place + 1, config.hidden_channels)
        self.net = nn.Sequential(
            nn.LayerNorm(config.hidden_channels), nn.GELU(), nn.Linear(config.hidden_channels, config.descriptor_dim)
        )

    def forward(self, views: Sequence[DetectorView], group_size: int = 0) -> list[Keypoints]:
        """Describe the peaks of each view; group_size has no effect."""
        return [self._describe(view) for view in views]

    def _describe(self, view: DetectorView) -> Keypoints:
        grid, norm = view.tokens.grid, view.tokens.features.float().norm(dim=1)
        xy, height = self._find_peaks(view.tokens.with_features(norm[:, None]))
        boxes = make_point_boxes(xy, functional.normalize(height, dim=0), grid.cell_size_m / math.sqrt(12))
        axis = _principal_axes(xy, view.tokens.sites.xy, norm, self.config.axis_radius_m)
        boxes = replace(boxes, yaw=axis, sigma_yaw=torch.full_like(axis, UNKNOWN_AXIS_RAD))
        places = self._places(xy)
        sampled = bilinear(self._make_invariant(view.tokens), places.flatten(0, 1)).unflatten(0, places.shape[:2])
        center, rings = sampled[:, 0], sampled[:, 1:].unflatten(1, (len(self.config.ring_radii_m), -1)).mean(2)
        around = torch.cat((center, rings.flatten(1), height.clamp_min(1e-6).log()[:, None]), 1)
        return Keypoints(boxes, functional.normalize(self.net(self.inner(around))))

    def _find_peaks(self, norm: SparseBev) -> tuple[Tensor, Tensor]:
        """Return positions (N, 2) in metres and norms (N,) of the highest peaks."""
        grid, dense = norm.grid, norm.dense()[0]
        kept = local_maxima(dense, max(1, round(self.config.nms_radius_m / grid.cell_size_m)))[0]
        height = torch.where(kept, dense[0], 0.0).flatten()
        best = height.sort(descending=True, stable=True).indices[: self.config.max_keypoints]
        best = best[height[best] > 0]
        yx = torch.stack((best // grid.shape[1], best % grid.shape[1]), 1)
        return grid.centers(yx).float(), height[best]

    def _make_invariant(self, tokens: SparseBev) -> SparseBev:
        """Replace vector channels by their lengths, and add a channel of ones that distinguishes empty cells from zeros."""
        channels = self.config.in_channels
        rows = functional.rms_norm(tokens.features.float(), (channels,))
        vectors, scalars = rows[:, : channels // 4 * 2], rows[:, channels // 4 * 2 :]
        lengths = vectors.unflatten(1, (-1, 2)).square().sum(2).add(1e-12).sqrt()
        return tokens.with_features(torch.cat((lengths, scalars, rows.new_ones(len(rows), 1)), 1))

    def _places(self, xy: Tensor) -> Tensor:
        """Return the sampled places (N, 1 + rings * samples, 2): the peak, then ring by ring."""
        count = self.config.samples_per_ring
        angle = torch.arange(count, device=xy.device) * (2 * math.pi / count)
        circle = torch.stack((angle.cos(), angle.sin()), 1)
        offsets = torch.cat((circle.new_zeros(1, 2), *(radius * circle for radius in self.config.ring_radii_m)))
        return xy[:, None] + offsets


def _principal_axes(xy: Tensor, cells: Tensor, weight: Tensor, radius_m: float) -> Tensor:
    """Return the directions (N,) in radians, modulo pi, of the cells (M, 2) of that weight within the radius of xy (N, 2)."""
    delta = cells.float() - xy[:, None]
    near = weight * (delta.square().sum(2) <= radius_m**2)
    delta = delta - (near[..., None] * delta).sum(1, keepdim=True) / near.sum(1).clamp_min(1e-6)[:, None, None]
    xx, yy, mixed = ((near * delta[..., i] * delta[..., k]).sum(1) for i, k in ((0, 0), (1, 1), (0, 1)))
    return torch.atan2(2 * mixed, xx - yy) / 2
