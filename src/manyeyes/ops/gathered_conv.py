# SPDX-License-Identifier: Apache-2.0
"""The products of a sparse convolution for devices on which launching an operator costs more than multiplying by zeros.

All taps of an output are gathered side by side, a row of zeros where a tap meets nothing, and multiplied by one matrix: two calls
instead of three for each tap, and no number that the host has to wait for. ``ops.sparse_conv`` is the twin, which multiplies
only what exists.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

MAX_GATHERED = 1 << 27
"""Maximum number of gathered values at a time (512 MiB of float32); larger layers are computed in blocks of rows."""


def gathered_conv(x: Tensor, taps: Tensor, index: Tensor, back: Tensor) -> Tensor:
    """Return (M, D): for each output the sum over taps of the row of x (N, C) that a tap meets, times its matrix of taps (T, C, D).

    index: (M, T) int32, the row of x under a tap, N where there is none. back: (N, T), the output that meets a row by a tap, M
    where there is none. Differentiable in x and taps.
    """
    out: Tensor = _GatheredConv.apply(x, taps, index, back)  # pyright: ignore[reportAssignmentType]
    return out


class _GatheredConv(torch.autograd.Function):
    """Keeps the input alone for its backward pass."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, taps: Tensor, index: Tensor, back: Tensor) -> Tensor:
        ctx.save_for_backward(x, taps, index, back)
        return _product(x, taps, index)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        x, taps, index, back = ctx.saved_tensors
        dx = _product(grads[0], taps.transpose(1, 2), back) if ctx.needs_input_grad[0] else None
        dw = _outer(x, grads[0], index).view(taps.shape) if ctx.needs_input_grad[1] else None
        return dx, dw, None, None


def _product(x: Tensor, taps: Tensor, index: Tensor) -> Tensor:
    matrix = taps.flatten(0, 1)
    parts = [rows @ matrix for _, rows in _gather(x, index)]
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _outer(x: Tensor, dy: Tensor, index: Tensor) -> Tensor:
    """Return (T * C, D): the gathered rows of x, transposed, times dy."""
    parts = [
        rows.T @ (dy if len(rows) == len(dy) else dy[start : start + len(rows)]) for start, rows in _gather(x, index)
    ]
    return parts[0] if len(parts) == 1 else torch.stack(parts).sum(0)


def _gather(x: Tensor, index: Tensor) -> Iterator[tuple[int, Tensor]]:
    """Yield blocks of gathered rows (m, T * C), each with its first row."""
    num_rows, taps = index.shape
    padded = pad(x, (0, 0, 0, 1))
    size = max(1, MAX_GATHERED // (taps * x.shape[1]))
    for start in range(0, max(num_rows, 1), size):
        some = index if num_rows <= size else index[start : start + size]
        yield start, padded.index_select(0, some.flatten()).view(some.shape[0], taps * x.shape[1])
