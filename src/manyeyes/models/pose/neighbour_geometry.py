# SPDX-License-Identifier: Apache-2.0
"""Encode the relative geometry of the objects around an object, invariant to the agent's pose.

Rotary positions are invariant to translation, not to rotation. Distances, bearings from the object's axis and relative headings are
invariant to both. Headings are known modulo pi, so angles are doubled.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from manyeyes._bounds import ChannelCount

WAVELENGTHS_M = (4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
"""Wavelengths of the sine encoding of distances."""
RELATION_DIM = 2 * len(WAVELENGTHS_M) + 4 + 2


@dataclass(frozen=True)
class NeighbourGeometryConfig:
    """max_distance_m: objects farther away are ignored. hidden: width of the hidden layer."""

    max_distance_m: float = 60.0
    hidden: ChannelCount = 64


class NeighbourGeometryEncoder(nn.Module):
    """A small network on the relation to every other object, followed by channel-wise maximum and sum."""

    def __init__(self, width: int, config: NeighbourGeometryConfig) -> None:
        super().__init__()
        self.config = config
        self.relation_net = nn.Sequential(
            nn.Linear(RELATION_DIM, config.hidden), nn.GELU(), nn.Linear(config.hidden, config.hidden), nn.GELU()
        )
        self.out = nn.Linear(2 * config.hidden, width)

    def forward(self, xy: Tensor, yaw: Tensor, size: Tensor, mask: Tensor) -> Tensor:
        """Encode xy (B, N, 2) m, yaw (B, N) rad, size (B, N, 2) m with mask (B, N) to (B, N, width)."""
        distance = torch.cdist(xy, xy)
        near = mask[:, :, None] & mask[:, None] & (distance < self.config.max_distance_m)
        near &= ~torch.eye(xy.shape[1], dtype=torch.bool, device=xy.device)
        related = self.relation_net(relative_geometry(xy, yaw, size, distance)) * near[..., None]
        maximum = related.amax(2) if xy.shape[1] else related.sum(2)
        return self.out(torch.cat((maximum, related.sum(2) / 8), -1))


def relative_geometry(xy: Tensor, yaw: Tensor, size: Tensor, distance: Tensor) -> Tensor:
    """Return (B, N, N, RELATION_DIM), the second object relative to the first; distance: (B, N, N) metres."""
    delta = xy[:, None] - xy[:, :, None]
    bearing = 2 * (torch.atan2(delta[..., 1], delta[..., 0]) - yaw[:, :, None])
    turn = 2 * (yaw[:, None] - yaw[:, :, None])
    phase = distance[..., None] * (2 * torch.pi / distance.new_tensor(WAVELENGTHS_M))
    angles = torch.stack((bearing.cos(), bearing.sin(), turn.cos(), turn.sin()), -1)
    other = (size / 5).clamp(0, 4)[:, None].expand(*distance.shape, 2)
    return torch.cat((phase.cos(), phase.sin(), angles, other), -1)
