# SPDX-License-Identifier: Apache-2.0
"""Features of occupied cells at any place between their centres."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from manyeyes.datatypes import SparseBev


def bilinear(x: SparseBev, xy: Tensor) -> Tensor:
    """Return (M, C) features at places (M, 2), metres, on the first grid of the batch; empty cells count as zeros.
    Differentiable in the features.
    """
    grid, keys = x.grid, x.sites.key
    if not len(keys):
        return x.features.new_zeros(len(xy), x.features.shape[1])
    rows, columns = grid.shape
    origin = torch.tensor([grid.x_min, grid.y_min], dtype=torch.float64, device=xy.device)
    place = ((xy.double() - origin) / grid.pillar - 0.5) / grid.stride
    low = place.floor()
    share = (place - low).to(x.features.dtype)
    total = x.features.new_zeros(len(xy), x.features.shape[1])
    for right, up in itertools.product((0, 1), (0, 1)):
        column, row = (low + torch.tensor([right, up], device=xy.device)).long().unbind(1)
        key = row * columns + column
        at = torch.searchsorted(keys, key).clamp_max(len(keys) - 1)
        found = (keys[at] == key) & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        offset_x, offset_y = (share if right else 1 - share)[:, 0], (share if up else 1 - share)[:, 1]
        total = total + x.features[at] * (offset_x * offset_y * found)[:, None]
    return total
