# SPDX-License-Identifier: Apache-2.0
"""The nearest points of a set, scene by scene."""

from __future__ import annotations

import torch
from torch import Tensor

_CHUNK = 512
"""Positions whose distances are held at once."""


def nearest_rows(
    xy: Tensor, batch: Tensor, points: Tensor, point_batch: Tensor, count: int, max_distance_m: float
) -> Tensor:
    """Return (N, count) int64: for each position (N, 2) the rows of the nearest points (M, 2), nearest first; then -1.

    batch (N,) and point_batch (M,): scenes, from 0; points of other scenes are not found, nor are those beyond max_distance_m.
    Points at equal distance come in the order of their rows.
    """
    found = torch.full((len(xy), count), -1, dtype=torch.int64, device=xy.device)
    for scene in batch.unique().tolist():
        there = (point_batch == scene).nonzero()[:, 0]
        for here in (batch == scene).nonzero()[:, 0].split(_CHUNK):
            distance, order = torch.cdist(xy[here].detach(), points[there].detach()).sort(dim=1, stable=True)
            distance, order = distance[:, :count], order[:, :count]
            rows = torch.where(distance <= max_distance_m, there[order], -1)
            found[here, : rows.shape[1]] = rows
    return found
