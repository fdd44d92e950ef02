# SPDX-License-Identifier: Apache-2.0
"""Self-attention within windows in compiled loops: for inference on the CPU, where windows hold a few tokens each.

Nothing is padded, and a window costs no call of its own. :mod:`manyeyes.ops.window_attention` is the twin with gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numba import njit
from torch import Tensor


@dataclass(frozen=True, eq=False)
class WindowRuns:
    """order: (N,) int64, tokens window by window; start: (windows + 1,) int64, where each begins. pairs: sum of n^2."""

    order: Tensor
    start: Tensor
    pairs: int


def window_runs(window: Tensor) -> WindowRuns:
    """Tokens of windows (N,) int64, sorted."""
    ids, order = window.sort(stable=True)
    count = torch.unique_consecutive(ids, return_counts=True)[1]
    start = torch.cat((count.new_zeros(1), count.cumsum(0)))
    return WindowRuns(order, start, int((count * count).sum()))


@torch.no_grad()
def attend_in_windows(q: Tensor, k: Tensor, v: Tensor, runs: WindowRuns) -> Tensor:
    """softmax(q k^T / sqrt(d)) v of (N, h, d) float32 over the tokens of each window: (N, h, d)."""
    weights, out = torch.empty(runs.pairs * q.shape[1]), torch.empty_like(v, memory_format=torch.contiguous_format)
    arrays = [t.contiguous().numpy() for t in (q, k, v)]
    order, start = runs.order.numpy(), runs.start.numpy()
    _scores(arrays[0], arrays[1], order, start, weights.numpy())
    _mix(weights.exp_().numpy(), arrays[2], order, start, out.numpy())
    return out


@njit(cache=True, nogil=True, fastmath=True)
def _scores(q, k, order, start, weights):  # pragma: no cover
    """Window by window, head by head, query by query: scores of the window's keys less their largest."""
    _, heads, width = q.shape
    largest = 0
    for w in range(start.shape[0] - 1):
        largest = max(largest, start[w + 1] - start[w])
    across = np.empty((width, largest), np.float32)
    scale, at = np.float32(1.0 / np.sqrt(width)), 0
    for w in range(start.shape[0] - 1):
        first = start[w]
        n = start[w + 1] - first
        for h in range(heads):
            for j in range(n):
                token = order[first + j]
                for c in range(width):
                    across[c, j] = k[token, h, c] * scale
            for i in range(n):
                token, row = order[first + i], weights[at : at + n]
                row[:] = np.float32(0.0)
                for c in range(0, width, 4):
                    a, b, d, e = q[token, h, c], q[token, h, c + 1], q[token, h, c + 2], q[token, h, c + 3]
                    for j in range(n):
                        row[j] += a * across[c, j] + b * across[c + 1, j] + d * across[c + 2, j] + e * across[c + 3, j]
                top = row[0]
                for j in range(n):
                    top = max(top, row[j])
                for j in range(n):
                    row[j] -= top
                at += n


@njit(cache=True, nogil=True, fastmath=True)
def _mix(weights, v, order, start, out):  # pragma: no cover
    """The values by weights that are not yet normalised."""
    _, heads, width = v.shape
    at = 0
    for w in range(start.shape[0] - 1):
        first = start[w]
        n = start[w + 1] - first
        for h in range(heads):
            for i in range(n):
                row, mixed = weights[at : at + n], out[order[first + i], h]
                mixed[:] = np.float32(0.0)
                total = np.float32(0.0)
                for j in range(n):
                    p = row[j]
                    total += p
                    token = order[first + j]
                    for c in range(width):
                        mixed[c] += p * v[token, h, c]
                for c in range(width):
                    mixed[c] /= total
                at += n
