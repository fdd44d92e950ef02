# SPDX-License-Identifier: Apache-2.0
"""Which points of a scene the sun reaches, and how much of the sky they see, among the solids that rays meet.

A point is tried against the solids whose shadow can fall into its cell of a ground raster. A crown throws the shadow of
its leaves on what lies outside it; within it, light fades by its density. Hills throw no shadow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I32x1, I64x1, njit
from manyeyes.ops.pinhole import intersect_primitive
from manyeyes.ops.raycast import BOX, ELLIPSOID, Primitives, SolidArrays, hit_ellipsoid

Array = NDArray[np.float64]

_CELL_M = 4.0
# How far from a wall or a vehicle the ground sees less of the sky, and how little of it at its foot. Chosen.
_NEAR_M, _AT_FOOT = 0.9, 0.35
# The sun of what fades within a crown: half the density, for leaves scatter light on. Chosen.
_SCATTER = 0.5


@dataclass(frozen=True, eq=False)
class ShadowIndex:
    """An index: solids first[c] … first[c + 1] of member may shade cell c = row * columns + column; sun: (3,) unit, towards it."""

    solids: Primitives
    sun: Array
    x_min: float
    y_min: float
    columns: int
    rows: int
    offsets: NDArray[np.int64]
    member: NDArray[np.int32]
    seed: int


def build_shadow_index(solids: Primitives, sun: Array, min_height: float, seed: int = 0) -> ShadowIndex:
    """Of solids whose shadows are wanted down to the height lowest; seed is that of the leaves (ops/pinhole.py)."""
    reach = np.einsum("nij,nj->ni", np.abs(solids.rotation), solids.half)
    top = np.maximum(solids.center[:, 2] + reach[:, 2] - min_height, 0.0)
    shift = -(sun[:2] / sun[2]) * top[:, None]
    low = solids.center[:, :2] - reach[:, :2] + np.minimum(shift, 0) - _NEAR_M
    high = solids.center[:, :2] + reach[:, :2] + np.maximum(shift, 0) + _NEAR_M
    if not len(solids):
        return ShadowIndex(solids, sun, 0.0, 0.0, 0, 0, np.zeros(1, np.int64), np.zeros(0, np.int32), seed)
    corner = low.min(0)
    columns, rows = (int(v) for v in np.ceil((high.max(0) - corner) / _CELL_M + 1e-9))
    a, b = np.floor((low - corner) / _CELL_M).astype(np.int64), np.floor((high - corner) / _CELL_M).astype(np.int64)
    cells, members = [], []
    for i in range(len(solids)):
        x, y = np.meshgrid(np.arange(a[i, 0], b[i, 0] + 1), np.arange(a[i, 1], b[i, 1] + 1))
        cells.append((y * columns + x).ravel())
        members.append(np.full(x.size, i, np.int32))
    cell, member = np.concatenate(cells), np.concatenate(members)
    kept = cell < rows * columns
    cell, member = cell[kept], member[kept]
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], np.arange(rows * columns + 1))
    return ShadowIndex(solids, sun, float(corner[0]), float(corner[1]), columns, rows, first, member[order], seed)


class _ShadowIndex(NamedTuple):
    """The cells of :class:`ShadowIndex` and the solids first[c] … first[c + 1] of member that may shade each."""

    x_min: float
    y_min: float
    columns: int
    rows: int
    first: I64x1
    member: I32x1


@njit(cache=True)
def _light(
    solids: SolidArrays,
    sun: F64x1,
    index: _ShadowIndex,
    seed: int,
    points: F64x2,
    on_ground: Boolx1,
    lit: F64x1,
    open_sky: F64x1,
) -> None:
    """Lower lit (N,) and open_sky (N,) at points (N, 3) by what the solids keep off them."""
    kind, center, rotation, half, density = solids
    x_min, y_min, columns, rows, first, member = index
    o = np.empty(3)
    for n in range(points.shape[0]):
        column = math.floor((points[n, 0] - x_min) / _CELL_M)
        row = math.floor((points[n, 1] - y_min) / _CELL_M)
        if column < 0 or column >= columns or row < 0 or row >= rows:
            continue
        cell = row * columns + column
        for m in range(first[cell], first[cell + 1]):
            i = int(member[m])
            for r in range(3):
                o[r] = 0.0
                for c in range(3):
                    o[r] += rotation[i, c, r] * (points[n, c] - center[i, c])
            if on_ground[n] and kind[i] == BOX:
                beside = math.hypot(max(abs(o[0]) - half[i, 0], 0.0), max(abs(o[1]) - half[i, 1], 0.0))
                if beside < _NEAR_M and o[2] < half[i, 2]:
                    open_sky[n] = min(open_sky[n], _AT_FOOT + (1.0 - _AT_FOOT) * beside / _NEAR_M)
            if lit[n] <= 0.0:
                continue
            d0 = rotation[i, 0, 0] * sun[0] + rotation[i, 1, 0] * sun[1] + rotation[i, 2, 0] * sun[2]
            d1 = rotation[i, 0, 1] * sun[0] + rotation[i, 1, 1] * sun[1] + rotation[i, 2, 1] * sun[2]
            d2 = rotation[i, 0, 2] * sun[0] + rotation[i, 1, 2] * sun[1] + rotation[i, 2, 2] * sun[2]
            if kind[i] == ELLIPSOID and density[i] > 0:
                enter, leave = hit_ellipsoid(o, half[i], d0, d1, d2)
                if leave < math.inf and enter == 0.0:
                    lit[n] *= math.exp(-_SCATTER * density[i] * leave)
                    continue
            if intersect_primitive(kind[i], half[i], density[i], o, d0, d1, d2, seed + i) < math.inf:
                lit[n] = 0.0


def sun_and_sky_visibility(shadows: ShadowIndex, points: Array, on_ground: NDArray[np.bool_]) -> tuple[Array, Array]:
    """At points (N, 3): the share of the sun that comes through, (N,), and of the sky that is open, (N,), both in [0, 1].

    Points on a solid must lie a little outside it. Only what lies on the ground is darkened by what stands beside it.
    """
    lit, open_sky = np.ones(len(points)), np.ones(len(points))
    index = _ShadowIndex(shadows.x_min, shadows.y_min, shadows.columns, shadows.rows, shadows.offsets, shadows.member)
    at = np.ascontiguousarray(points, np.float64)
    _light(shadows.solids.arrays, shadows.sun, index, shadows.seed, at, on_ground, lit, open_sky)
    return lit, open_sky
