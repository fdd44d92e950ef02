# SPDX-License-Identifier: Apache-2.0
"""A linear map of points and the maximum over their segments, in one pass that writes no row for a point.

For inference on the CPU: 50,000 points by 64 channels would be 14 MB of a temporary that is faulted in and read once.
:func:`affine_segment_max_reference` is the slow twin, and what other devices run.
"""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from manyeyes.ops.voxelize import segment_max


@torch.no_grad()
def affine_segment_max(points: Tensor, origin: Tensor, weight: Tensor, row: Tensor) -> Tensor:
    """(n, C): the maximum over the points (P, D) of a segment of ``weight @ (point - origin)``.

    weight: (C, D); row: (P,) int64, the segment of each point; origin: (n, D), each segment's own; no segment is empty.
    """
    if points.device.type != "cpu" or points.dtype != torch.float32:
        return affine_segment_max_reference(points, origin, weight, row)
    out = torch.full((origin.shape[0], weight.shape[0]), -torch.inf)
    taps = weight.detach().T.contiguous()
    _affine_max(points.contiguous().numpy(), origin.contiguous().numpy(), taps.numpy(), row.numpy(), out.numpy())
    return out


@torch.no_grad()
def affine_segment_max_reference(points: Tensor, origin: Tensor, weight: Tensor, row: Tensor) -> Tensor:
    """The same by a row of its own for every point."""
    return segment_max((points - origin[row]) @ weight.T, row, origin.shape[0])


@numba.njit(cache=True, nogil=True, fastmath={"contract", "nsz", "nnan"})
def _affine_max(
    points: np.ndarray, origin: np.ndarray, taps: np.ndarray, row: np.ndarray, out: np.ndarray
) -> None:  # pragma: no cover
    inputs, channels = taps.shape
    if inputs == 4:
        # What pillars have: one loop over the channels instead of five.
        for p in range(points.shape[0]):
            r = row[p]
            x, y = points[p, 0] - origin[r, 0], points[p, 1] - origin[r, 1]
            z, w = points[p, 2] - origin[r, 2], points[p, 3] - origin[r, 3]
            for c in range(channels):
                out[r, c] = max(out[r, c], taps[0, c] * x + taps[1, c] * y + taps[2, c] * z + taps[3, c] * w)
        return
    value = np.empty(channels, np.float32)
    for p in range(points.shape[0]):
        r = row[p]
        value[:] = np.float32(0.0)
        for d in range(inputs):
            x = points[p, d] - origin[r, d]
            for c in range(channels):
                value[c] += taps[d, c] * x
        for c in range(channels):
            out[r, c] = max(out[r, c], value[c])
