# SPDX-License-Identifier: Apache-2.0
"""How the objects around an object stand, in its own axes: what two agents see alike wherever they are and look.

Rotary positions hold when a frame is shifted, not when it is turned. Distances, bearings from the object's own axis and
relative headings hold under both; headings are known modulo pi, so that angles enter doubled (specs/pose.md 1.11, 4.9).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

WAVELENGTHS_M = (4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
"""Wavelengths by which a distance is written."""
RELATION_DIM = 2 * len(WAVELENGTHS_M) + 4 + 2


@dataclass(frozen=True)
class NeighbourGeometryConfig:
    """max_distance_m: objects farther away have no part. hidden: width in between."""

    max_distance_m: float = 60.0
    hidden: int = 64


class NeighbourGeometryEncoder(nn.Module):
    """A small net on the relation to each other object, and the largest value and the sum of each channel over them."""

    def __init__(self, width: int, config: NeighbourGeometryConfig) -> None:
        super().__init__()
        self.config = config
        self.relation_net = nn.Sequential(
            nn.Linear(RELATION_DIM, config.hidden), nn.GELU(), nn.Linear(config.hidden, config.hidden), nn.GELU()
        )
        self.out = nn.Linear(2 * config.hidden, width)

    def forward(self, xy: Tensor, yaw: Tensor, size: Tensor, mask: Tensor) -> Tensor:
        """(B, N, 2) m, (B, N) rad, (B, N, 2) m and which are objects (B, N) to (B, N, width)."""
        distance = torch.cdist(xy, xy)
        near = mask[:, :, None] & mask[:, None] & (distance < self.config.max_distance_m)
        near &= ~torch.eye(xy.shape[1], dtype=torch.bool)
        related = self.relation_net(relative_geometry(xy, yaw, size, distance)) * near[..., None]
        maximum = related.amax(2) if xy.shape[1] else related.sum(2)
        return self.out(torch.cat((maximum, related.sum(2) / 8), -1))


def relative_geometry(xy: Tensor, yaw: Tensor, size: Tensor, distance: Tensor) -> Tensor:
    """(B, N, N, RELATION) of the second object as the first sees it; distance: (B, N, N) their distances."""
    delta = xy[:, None] - xy[:, :, None]
    bearing = 2 * (torch.atan2(delta[..., 1], delta[..., 0]) - yaw[:, :, None])
    turn = 2 * (yaw[:, None] - yaw[:, :, None])
    phase = distance[..., None] * (2 * torch.pi / torch.tensor(WAVELENGTHS_M))
    angles = torch.stack((bearing.cos(), bearing.sin(), turn.cos(), turn.sin()), -1)
    other = (size / 5).clamp(0, 4)[:, None].expand(*distance.shape, 2)
    return torch.cat((phase.cos(), phase.sin(), angles, other), -1)
