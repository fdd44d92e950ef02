# SPDX-License-Identifier: Apache-2.0
"""Points to pillars, and reductions of points over their pillar; no caps, nothing padded, nothing dropped in range."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from manyeyes._jit import njit
from manyeyes.datatypes import BevGrid, ConfigError, Sites
from manyeyes.ops.sparse_index import distinct

MOMENTS = (
    "log1p_count",
    "mean_dx",
    "mean_dy",
    "mean_z",
    "min_z",
    "max_z",
    "std_z",
    "std_x",
    "std_y",
    "cov_xy",
    "mean_intensity",
    "max_intensity",
)


@dataclass(frozen=True, eq=False)
class Pillars:
    """sites: the occupied pillars; inside: (P,) bool, points in range; row: (P_inside,) int64, their pillars."""

    sites: Sites
    inside: Tensor
    row: Tensor


def pillar_sites(xyz: Tensor, batch: Tensor, grid: BevGrid, batch_size: int) -> Pillars:
    """Return the pillars that points (P, 3) of clouds batch (P,) fall into, ``floor((x - x_min) / pillar)`` in float64."""
    if grid.stride != 1:
        raise ConfigError(f"pillar_sites works at stride 1; got a grid of stride {grid.stride}: use grid.at(1).")
    rows, columns = grid.shape
    if _in_numba(xyz):
        inside, key = np.empty(xyz.shape[0], np.bool_), np.empty(xyz.shape[0], np.int64)
        limits = (grid.x_min, grid.y_min, grid.z_min, grid.z_max, grid.pillar)
        kept = _point_keys(xyz.detach().numpy(), batch.numpy(), limits, rows, columns, inside, key)
        found, row = distinct(torch.from_numpy(key[:kept]), batch_size * rows * columns)
        return Pillars(Sites(found, grid, batch_size), torch.from_numpy(inside), row)
    # float32 would put points of a border into one or the other pillar, depending on how the quotient is written.
    x = ((xyz[:, 0].double() - grid.x_min) / grid.pillar).floor().long()
    y = ((xyz[:, 1].double() - grid.y_min) / grid.pillar).floor().long()
    z = xyz[:, 2].double()
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows) & (z >= grid.z_min) & (z < grid.z_max)
    key = ((batch * rows + y) * columns + x).index_select(0, inside.nonzero()[:, 0])
    found, row = distinct(key, batch_size * rows * columns)
    return Pillars(Sites(found, grid, batch_size), inside, row)


@njit(cache=True, nogil=True)
def _point_keys(
    xyz: np.ndarray,
    batch: np.ndarray,
    limits: tuple[float, float, float, float, float],
    rows: int,
    columns: int,
    inside: np.ndarray,
    key: np.ndarray,
) -> int:  # pragma: no cover
    """Return which points lie in range, and the keys of those, one after another; how many there are."""
    x_min, y_min, z_min, z_max, pillar = limits
    kept = 0
    for p in range(xyz.shape[0]):
        x = np.floor((np.float64(xyz[p, 0]) - x_min) / pillar)
        y = np.floor((np.float64(xyz[p, 1]) - y_min) / pillar)
        z = np.float64(xyz[p, 2])
        inside[p] = x >= 0 and x < columns and y >= 0 and y < rows and z >= z_min and z < z_max
        if inside[p]:
            key[kept] = (batch[p] * rows + np.int64(y)) * columns + np.int64(x)
            kept += 1
    return kept


def segment_sum(values: Tensor, row: Tensor, n: int) -> Tensor:
    """Return (n, C): the sum of values (P, C) over segments row (P,) in [0, n)."""
    if _in_numba(values) and values.dim() == 2 and not (torch.is_grad_enabled() and values.requires_grad):
        return torch.from_numpy(_sums(values.detach().contiguous().numpy(), row.numpy(), n))
    return values.new_zeros(n, *values.shape[1:]).index_add(0, row, values)


@njit(cache=True, nogil=True)
def _sums(values: np.ndarray, row: np.ndarray, n: int) -> np.ndarray:  # pragma: no cover
    """In the order of the points, as by tensors."""
    out = np.zeros((n, values.shape[1]), values.dtype)
    for p in range(values.shape[0]):
        for c in range(values.shape[1]):
            out[row[p], c] += values[p, c]
    return out


def _count(row: Tensor, n: int) -> Tensor:
    """Return (n,) int64: the size of each segment; off the CPU without waiting for the device, which bincount does."""
    if row.device.type == "cpu":
        return torch.bincount(row, minlength=n)
    return row.new_zeros(n).index_add_(0, row, torch.ones_like(row))


def segment_mean(values: Tensor, row: Tensor, n: int) -> Tensor:
    """Return (n, C): the mean of values (P, C) over segments row (P,) in [0, n); zero where a segment is empty."""
    if _in_numba(values) and values.dim() == 2 and not (torch.is_grad_enabled() and values.requires_grad):
        return torch.from_numpy(_means(values.numpy(), row.numpy(), n))
    return segment_sum(values, row, n) / _count(row, n).clamp_min(1).to(values.dtype)[:, None]


@njit(cache=True, nogil=True)
def _means(values: np.ndarray, row: np.ndarray, n: int) -> np.ndarray:  # pragma: no cover
    """Sums in the order of the points, then the quotients, as by tensors."""
    out, count = np.zeros((n, values.shape[1]), values.dtype), np.zeros(n, values.dtype)
    for p in range(values.shape[0]):
        r = row[p]
        count[r] += 1
        for c in range(values.shape[1]):
            out[r, c] += values[p, c]
    for r in range(n):
        for c in range(values.shape[1]):
            out[r, c] /= max(count[r], 1)
    return out


def segment_max(values: Tensor, row: Tensor, n: int) -> Tensor:
    """Return (n, C): the maximum of values (P, C) over segments row (P,) in [0, n), none empty; ties share the gradient."""
    out: Tensor = _SegmentMax.apply(values, row, n)  # pyright: ignore[reportAssignmentType]
    return out


class _SegmentMax(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, row: Tensor, n: int) -> Tensor:
        values, out = values.contiguous(), values.new_full((n, values.shape[1]), -torch.inf)
        if _in_numba(values):
            _raise_to_max(values.detach().numpy(), row.numpy(), out.numpy())
        else:
            out.scatter_reduce_(0, row[:, None].expand_as(values), values, "amax")
        ctx.save_for_backward(values, row, out)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        values, row, out = ctx.saved_tensors
        if _in_numba(values):
            spread = torch.empty_like(values)
            share = grads[0].clone(memory_format=torch.contiguous_format)
            _share_among_ties(values.numpy(), row.numpy(), out.numpy(), share.numpy(), spread.numpy())
            return spread, None, None
        tied = (values == out[row]).to(values.dtype)
        share = grads[0] / segment_sum(tied, row, out.shape[0])
        return tied * share[row], None, None


def _in_numba(values: Tensor) -> bool:
    return values.device.type == "cpu" and values.dtype in (torch.float32, torch.float64)


@njit(cache=True, nogil=True)
def _raise_to_max(values: np.ndarray, row: np.ndarray, out: np.ndarray) -> None:
    for p in range(values.shape[0]):
        r = row[p]
        for c in range(values.shape[1]):
            v = values[p, c]
            # The second test lets NaN through, as torch does.
            if v > out[r, c] or v != v:
                out[r, c] = v


@njit(cache=True, nogil=True)
def _share_among_ties(
    values: np.ndarray, row: np.ndarray, out: np.ndarray, share: np.ndarray, spread: np.ndarray
) -> None:
    ties = np.zeros_like(out)
    for p in range(values.shape[0]):
        r = row[p]
        for c in range(values.shape[1]):
            ties[r, c] += values[p, c] == out[r, c]
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            share[r, c] /= max(ties[r, c], 1)
    for p in range(values.shape[0]):
        r = row[p]
        for c in range(values.shape[1]):
            spread[p, c] = share[r, c] if values[p, c] == out[r, c] else 0.0


@torch.no_grad()
def pillar_moments(xyz: Tensor, intensity: Tensor, row: Tensor, sites: Sites) -> Tensor:
    """Return (N, 12) statistics of the points (P, 3) in each pillar, in the order of ``MOMENTS``; offsets from its centre.

    A pillar without points has zeros.
    """
    n, points = len(sites), _count(row, len(sites)).to(xyz.dtype)[:, None]
    count = points.clamp_min(1)
    local = torch.cat((xyz[:, :2] - sites.xy.to(xyz.dtype)[row], xyz[:, 2:], intensity[:, None]), 1)
    mean = segment_sum(local, row, n) / count
    off = local[:, :3] - mean[row, :3]
    square = segment_sum(torch.cat((off * off, off[:, :1] * off[:, 1:2]), 1), row, n) / count
    top = segment_max(torch.cat((-local[:, 2:3], local[:, 2:]), 1), row, n) if len(xyz) else local.new_zeros(n, 3)
    top = torch.where(points > 0, top, 0)
    std = square[:, :3].sqrt()
    columns = (
        points.log1p(),
        mean[:, :3],
        -top[:, :1],
        top[:, 1:2],
        std[:, 2:3],
        std[:, :2],
        square[:, 3:],
        mean[:, 3:],
    )
    return torch.cat((*columns, top[:, 2:3]), 1)
