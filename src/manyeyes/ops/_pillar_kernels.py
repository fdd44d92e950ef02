# SPDX-License-Identifier: Apache-2.0
"""PointPillars' features (Lang et al. 2019, section 2.1) in compiled passes over the points that write no row for a point.

For inference on the CPU: 50,000 points by 64 channels would be 14 MB of a temporary that is faulted in and read once.
``models.detector.pillars`` holds the twin with gradients. Moments have none, so that training takes the same passes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from manyeyes._jit import F32x1, F32x2, F32x3, I32x1, I64x1, njit
from manyeyes.datatypes import BevGrid, PointCloud, Sites, SparseBev
from manyeyes.ops.sparse_index import mark_ranks
from manyeyes.ops.voxelize import MOMENTS


class _Limits(NamedTuple):
    """The range of a grid, metres; x_max and y_max follow from its shape."""

    x_min: float
    y_min: float
    z_min: float
    z_max: float


class _Points(NamedTuple):
    """xyz (P, 3), intensity (P,), and how many are of now; those of before follow."""

    xyz: F32x2
    intensity: F32x1
    num_now: int


class _PillarWeights(NamedTuple):
    """What differs within a pillar, (5, C) of offsets from its middle, intensity and age; what is common, (7, C).

    common: of the pillar's middle (3) and of its offset from the mean of its points (3), and the bias.
    """

    varying: F32x2
    common: F32x2


@torch.no_grad()
def pillar_maxima(
    now: Sequence[PointCloud], before: Sequence[PointCloud], grid: BevGrid, weight: Tensor, bias: Tensor
) -> SparseBev:
    """max(0, bias + the maximum over a pillar's points of weight @ inputs): (N, C) at stride 1, for every occupied pillar.

    now, before: a cloud for each grid of the batch, float32 in the CPU's memory; before may be empty. weight: (C, 11), for a
    point's x, y, z, intensity, offsets from the mean of its pillar's points (3) and from the pillar's middle (3), and age: 0
    of now, 1 of before.
    """
    points, key, found, rank, middle = _locate(now, before, grid)
    # Within a pillar only five of the eleven inputs differ from point to point.
    place, light, to_mean, to_middle, age = weight.split((3, 1, 3, 3, 1), 1)
    varying = torch.cat((place + to_mean + to_middle, light, age), 1).T.contiguous().numpy()
    common = torch.cat((place, to_mean, bias[:, None]), 1).T.contiguous().numpy()
    out = np.empty((len(found), len(weight)), np.float32)
    _reduce(points, key, rank, middle, _PillarWeights(varying, common), out)
    return SparseBev(torch.from_numpy(out), Sites(torch.from_numpy(found), grid, len(now)))


@torch.no_grad()
def cloud_moments(now: Sequence[PointCloud], before: Sequence[PointCloud], grid: BevGrid, sweeps: int) -> SparseBev:
    """Return the moments of every occupied pillar's points at stride 1: (N, 12), or (N, 24) with those of before behind.

    The twin of ``voxelize.pillar_moments`` for whole clouds, one for each grid of the batch, float32 in the CPU's memory.
    """
    points, key, found, rank, middle = _locate(now, before, grid)
    out = np.zeros((len(found), sweeps, len(MOMENTS)), np.float32)
    _moments(points, key, rank, middle, out)
    features = torch.from_numpy(out)
    features[:, :, 0].log1p_()
    return SparseBev(features.flatten(1), Sites(torch.from_numpy(found), grid, len(now)))


def _locate(
    now: Sequence[PointCloud], before: Sequence[PointCloud], grid: BevGrid
) -> tuple[_Points, I32x1, I64x1, I32x1, F32x2]:
    """Return the points of all clouds, their keys (P,), the occupied keys (N,), the number of each, and the middles (N, 3)."""
    clouds, (rows, columns) = [*now, *before], grid.shape
    limits = _Limits(grid.x_min, grid.y_min, grid.z_min, grid.z_max)
    xyz, bright = (_concatenate(part).numpy() for part in zip(*((cloud.xyz, cloud.intensity) for cloud in clouds)))
    key, end = np.empty(len(xyz), np.int32), 0
    for agent, cloud in zip((*range(len(now)), *range(len(before))), clouds):
        start, end = end, end + len(cloud)
        part, first = key[start:end], agent * rows * columns
        _point_keys(xyz[start:end].reshape(-1), limits, grid.pillar, float(rows), float(columns), first, part)
    found, rank = _find_occupied(key, len(now) * rows * columns)
    points = _Points(xyz, bright, sum(map(len, now)))
    return points, key, found, rank, _middles(found, rows, columns, limits, grid.pillar)


def _concatenate(parts: Sequence[Tensor]) -> Tensor:
    """Return all rows as one tensor without gaps; a single part is not copied."""
    return (parts[0] if len(parts) == 1 else torch.cat(list(parts))).contiguous()


@njit(cache=True, nogil=True)
def _point_keys(
    xyz: F32x1, limits: _Limits, pillar: float, rows: float, columns: float, first: int, key: I32x1
) -> None:  # pragma: no cover
    """key (P,): the pillar of each point of xyz (3 P,), numbered from first on; -1 out of range.

    As ``voxelize.pillar_sites``, without branches; unsigned places and whole numbers as floats leave a loop of vectors.
    """
    x_min, y_min, z_min, z_max = limits
    for p in range(np.uintp(key.shape[0])):
        at = np.uintp(3) * p
        x, y = (np.float64(xyz[at]) - x_min) / pillar, (np.float64(xyz[at + np.uintp(1)]) - y_min) / pillar
        z = np.float64(xyz[at + np.uintp(2)])
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows) & (z >= z_min) & (z < z_max)
        place = np.int32(first) + np.int32(y) * np.int32(columns) + np.int32(x)
        key[p] = place if inside else np.int32(-1)


@njit(cache=True, nogil=True)
def _find_occupied(key: I32x1, size: int) -> tuple[I64x1, I32x1]:  # pragma: no cover
    """Return ascending distinct keys of key (P,) from 0 on, and the number (size,) of each among them."""
    marks = np.zeros(size // 8 * 8 + 8, np.uint8)
    for k in key:
        if k >= 0:
            marks[k] = 1
    return mark_ranks(marks)


@njit(cache=True, nogil=True)
def _middles(found: I64x1, rows: int, columns: int, limits: _Limits, pillar: float) -> F32x2:  # pragma: no cover
    """Return (N, 3): the middle of each pillar of ascending keys (N,)."""
    middle, line = np.empty((found.shape[0], 3), np.float32), 0
    for r in range(found.shape[0]):
        while found[r] >= (line + 1) * columns:
            line += 1
        middle[r, 0] = limits.x_min + (found[r] - line * columns + 0.5) * pillar
        middle[r, 1] = limits.y_min + (line % rows + 0.5) * pillar
        middle[r, 2] = (limits.z_min + limits.z_max) / 2
    return middle


@njit(cache=True, nogil=True, fastmath={"contract", "nsz", "nnan"})
def _reduce(
    points: _Points, key: I32x1, rank: I32x1, middle: F32x2, weights: _PillarWeights, out: F32x2
) -> None:  # pragma: no cover
    """The maxima over points, then what all points of a pillar have in common."""
    (xyz, bright, young), (varying, common) = points, weights
    n, channels = out.shape
    total = np.zeros((n, 4), np.float32)
    out[:] = np.float32(-np.inf)
    for p in range(xyz.shape[0]):
        if key[p] >= 0:
            r = rank[key[p]]
            total[r, 0] += xyz[p, 0]
            total[r, 1] += xyz[p, 1]
            total[r, 2] += xyz[p, 2]
            total[r, 3] += np.float32(1)
            x, y, z = xyz[p, 0] - middle[r, 0], xyz[p, 1] - middle[r, 1], xyz[p, 2] - middle[r, 2]
            light, old = bright[p], np.float32(p >= young)
            for c in range(channels):
                v = varying[0, c] * x + varying[1, c] * y + varying[2, c] * z + varying[3, c] * light
                out[r, c] = max(out[r, c], v + varying[4, c] * old)
    for r in range(n):
        x, y, z, count = middle[r, 0], middle[r, 1], middle[r, 2], total[r, 3]
        dx, dy, dz = x - total[r, 0] / count, y - total[r, 1] / count, z - total[r, 2] / count
        for c in range(channels):
            v = common[0, c] * x + common[1, c] * y + common[2, c] * z
            v += common[3, c] * dx + common[4, c] * dy + common[5, c] * dz + common[6, c]
            out[r, c] = max(out[r, c] + v, np.float32(0))


@njit(cache=True, nogil=True)
def _moments(points: _Points, key: I32x1, rank: I32x1, middle: F32x2, out: F32x3) -> None:  # pragma: no cover
    """Write the moments of each sweep's points to out (N, sweeps, 12) of zeros; the count without its logarithm."""
    xyz, bright, young = points
    one, infinity = np.float32(1), np.float32(np.inf)
    out[:, :, 4], out[:, :, 5], out[:, :, 11] = infinity, -infinity, -infinity
    for p in range(xyz.shape[0]):
        if key[p] >= 0:
            key[p] = rank[key[p]]
            r = key[p]
            to, z = out[r, int(p >= young)], xyz[p, 2]
            to[0] += one
            to[1] += xyz[p, 0] - middle[r, 0]
            to[2] += xyz[p, 1] - middle[r, 1]
            to[3] += z
            to[4], to[5] = min(to[4], z), max(to[5], z)
            to[10] += bright[p]
            to[11] = max(to[11], bright[p])
    for r in range(out.shape[0]):
        for sweep in range(out.shape[1]):
            to = out[r, sweep]
            if to[0] == 0:
                to[:] = np.float32(0)
            else:
                to[1], to[2], to[3], to[10] = to[1] / to[0], to[2] / to[0], to[3] / to[0], to[10] / to[0]
    for p in range(xyz.shape[0]):
        if key[p] >= 0:
            r = key[p]
            to = out[r, int(p >= young)]
            x, y, z = xyz[p, 0] - middle[r, 0] - to[1], xyz[p, 1] - middle[r, 1] - to[2], xyz[p, 2] - to[3]
            to[6] += z * z
            to[7] += x * x
            to[8] += y * y
            to[9] += x * y
    for r in range(out.shape[0]):
        for sweep in range(out.shape[1]):
            to = out[r, sweep]
            count = max(to[0], one)
            to[6], to[7], to[8] = np.sqrt(to[6] / count), np.sqrt(to[7] / count), np.sqrt(to[8] / count)
            to[9] /= count
