# SPDX-License-Identifier: Apache-2.0
"""Batch normalisation over rows with a skip connection and ReLU, as one operation in training on the CPU.

Ioffe and Szegedy 2015, algorithm 1. Rows are read twice forward and twice backward; masks and normalised rows are not stored.
``torch.nn.functional.batch_norm`` followed by ``relu`` is the twin, in tests.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from manyeyes._jit import F32x1, F32x2, njit

_FAST = {"contract", "nsz"}


class RunningStatistics(NamedTuple):
    """Mean and variance (C,), which training updates, and the fraction of each batch in them."""

    mean: Tensor
    variance: Tensor
    momentum: float


def norm_relu(
    x: Tensor, skip: Tensor | None, weight: Tensor, bias: Tensor, running: RunningStatistics, eps: float
) -> Tensor:
    """Return relu(weight * (x - mean) / sqrt(variance + eps) + bias + skip) with the statistics of x over its N > 1 rows.

    x, skip: (N, C) float32 in the CPU's memory; weight, bias: (C,). Differentiable once.
    """
    out: Tensor = _NormRelu.apply(x, skip, weight, bias, running, eps)  # pyright: ignore[reportAssignmentType]
    return out


class _NormRelu(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, skip: Tensor | None, weight: Tensor, bias: Tensor, running: RunningStatistics, eps: float
    ) -> Tensor:
        x, n = x.contiguous(), x.shape[0]
        mean, squares = (torch.from_numpy(part) for part in _statistics(x.detach().numpy()))
        momentum = running.momentum
        running.mean.mul_(1 - momentum).add_(mean, alpha=momentum)
        running.variance.mul_(1 - momentum).add_(squares, alpha=momentum / (n - 1))
        steep = (1 / ((squares / n).double() + eps).sqrt()).float()
        scale, out = steep * weight.detach(), torch.empty_like(x)
        shift = (bias.detach().double() - mean.double() * scale.double()).float()
        added = x[:0] if skip is None else skip.contiguous()
        _forward(x.detach().numpy(), added.detach().numpy(), scale.numpy(), shift.numpy(), out.numpy())
        ctx.save_for_backward(x, out, weight, mean, steep)
        ctx.is_skipped = skip is not None
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor | None, Tensor, Tensor, None, None]:
        x, out, weight, mean, steep = ctx.saved_tensors
        dx, dskip = torch.empty_like(x), torch.empty_like(x) if ctx.is_skipped else x[:0]
        grad, kept, rows, centre = (t.detach().numpy() for t in (grads[0].contiguous(), out, x, mean))
        total, tilt = (torch.from_numpy(part) for part in _sums(grad, kept, rows, centre))
        n = x.shape[0]
        slopes = _Slopes(*(part.numpy() for part in (weight.detach() * steep, total / n, tilt * steep * steep / n)))
        _backward(grad, kept, rows, centre, slopes, dx.numpy(), dskip.numpy())
        return dx, dskip if ctx.is_skipped else None, tilt * steep, total, None, None


class _Slopes(NamedTuple):
    """Of the gradient of x: its scale, the mean gradient, and its part per unit of x - mean, each (C,)."""

    scale: F32x1
    centre: F32x1
    slope: F32x1


@njit(cache=True, nogil=True, fastmath=_FAST)
def _statistics(x: F32x2) -> tuple[F32x1, F32x1]:  # pragma: no cover
    """Mean of rows (N, C), and the sum of squared deviations from it, each (C,).

    Row by row in float32, as torch sums: the same bits keep ReLU from switching elsewhere than in the twin.
    """
    n, channels = x.shape
    mean, squares = np.zeros(channels, np.float32), np.zeros(channels, np.float32)
    for i in range(n):
        for c in range(channels):
            mean[c] += x[i, c]
    mean /= np.float32(n)
    for i in range(n):
        for c in range(channels):
            d = x[i, c] - mean[c]
            squares[c] += d * d
    return mean, squares


@njit(cache=True, nogil=True, fastmath=_FAST)
def _forward(x: F32x2, skip: F32x2, scale: F32x1, shift: F32x1, out: F32x2) -> None:  # pragma: no cover
    """out = relu(x * scale + shift + skip); a skip without rows is none. NaN stay."""
    n, channels = x.shape
    if skip.shape[0]:
        for i in range(n):
            for c in range(channels):
                v = x[i, c] * scale[c] + shift[c] + skip[i, c]
                out[i, c] = np.float32(0) if v < 0 else v
    else:
        for i in range(n):
            for c in range(channels):
                v = x[i, c] * scale[c] + shift[c]
                out[i, c] = np.float32(0) if v < 0 else v


@njit(cache=True, nogil=True, fastmath=_FAST)
def _sums(grad: F32x2, out: F32x2, x: F32x2, mean: F32x1) -> tuple[F32x1, F32x1]:  # pragma: no cover
    """Sums over rows (C,) of the gradient where out > 0, and of that times x - mean; row by row, as torch does."""
    n, channels = x.shape
    total, tilt = np.zeros(channels, np.float32), np.zeros(channels, np.float32)
    for i in range(n):
        for c in range(channels):
            g = grad[i, c] if out[i, c] > 0 else np.float32(0)
            total[c] += g
            tilt[c] += g * (x[i, c] - mean[c])
    return total, tilt


@njit(cache=True, nogil=True, fastmath=_FAST)
def _backward(
    grad: F32x2, out: F32x2, x: F32x2, mean: F32x1, slopes: _Slopes, dx: F32x2, dskip: F32x2
) -> None:  # pragma: no cover
    """Write the gradients of x and of the skip; one without rows is none."""
    n, channels = x.shape
    scale, centre, slope = slopes
    if dskip.shape[0]:
        for i in range(n):
            for c in range(channels):
                g = grad[i, c] if out[i, c] > 0 else np.float32(0)
                dskip[i, c] = g
                dx[i, c] = scale[c] * (g - centre[c] - (x[i, c] - mean[c]) * slope[c])
    else:
        for i in range(n):
            for c in range(channels):
                g = grad[i, c] if out[i, c] > 0 else np.float32(0)
                dx[i, c] = scale[c] * (g - centre[c] - (x[i, c] - mean[c]) * slope[c])
