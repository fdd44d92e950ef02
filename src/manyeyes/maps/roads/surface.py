# SPDX-License-Identifier: Apache-2.0
"""Strips of road as triangles in a hash of square buckets: heights and distances at many points at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x1, F64x2, F64x3, I64x1, njit

Array = NDArray[np.float64]

BUCKET_M = 8.0


class _Lattice(NamedTuple):
    """A lattice of columns x rows square buckets, BUCKET_M wide, whose lower corner is x0, y0; bucket r * columns + c."""

    x0: float
    y0: float
    columns: int
    rows: int


class _Buckets(NamedTuple):
    """The triangles (T, 3, 3) of a surface; bucket b of the lattice holds ``member[first[b]:first[b + 1]]`` of them."""

    triangles: F64x3
    lattice: _Lattice
    first: I64x1
    member: I64x1


@dataclass(frozen=True, eq=False)
class RoadSurface:
    """T triangles over the ground plane.

    triangles: (T, 3, 3) metres; strip_index: (T,) int64, the strip each came from. x0, y0, columns, rows: the buckets' lattice,
    BUCKET_M wide; bucket b holds the triangles ``triangle_index[first[b]:first[b + 1]]`` whose bounding boxes touch it.
    """

    triangles: Array
    strip_index: NDArray[np.int64]
    x0: float
    y0: float
    columns: int
    rows: int
    bucket_offsets: NDArray[np.int64]
    triangle_index: NDArray[np.int64]

    @classmethod
    def of_strips(cls, left: Sequence[Array], right: Sequence[Array]) -> RoadSurface:
        """From strips given by two borders of equal length each, (M, 3) and (M, 3)."""
        parts, owners = [np.zeros((0, 3, 3))], [np.zeros(0, np.int64)]
        for k, (a, b) in enumerate(zip(left, right)):
            one = np.stack((a[:-1], b[:-1], a[1:]), 1)
            two = np.stack((b[:-1], b[1:], a[1:]), 1)
            parts += [one, two]
            owners.append(np.full(2 * len(one), k, np.int64))
        triangles, owner = np.concatenate(parts), np.concatenate(owners)
        edge_a, edge_b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        area = np.abs(edge_a[:, 0] * edge_b[:, 1] - edge_a[:, 1] * edge_b[:, 0])
        triangles, owner = np.ascontiguousarray(triangles[area > 1e-9]), owner[area > 1e-9]
        if not len(triangles):
            return cls(triangles, owner, 0.0, 0.0, 1, 1, np.zeros(2, np.int64), np.zeros(0, np.int64))
        low = triangles[..., :2].min((0, 1))
        high = triangles[..., :2].max((0, 1))
        columns, rows = (((high - low) / BUCKET_M).astype(int) + 1).tolist()
        first, member = _fill_buckets(triangles, _Lattice(low[0], low[1], columns, rows))
        return cls(triangles, owner, float(low[0]), float(low[1]), columns, rows, first, member)

    def height(self, xy: Array, near_z: Array | float | None = None) -> Array:
        """Return (N,) z at points (N, 2): of the triangle above or below, else of the nearest triangle's nearest point.

        Where several cover a point, the one nearest to near_z (one for all, or (N,)); the highest when near_z is None.
        """
        return self._query(xy, near_z).height

    def distance(self, xy: Array) -> Array:
        """Return (N,) metres from points (N, 2) to the surface in plan; 0 on it, inf when there is none."""
        return self._query(xy, None).distance

    def strip_at(self, xy: Array, near_z: Array | float | None = None) -> NDArray[np.int64]:
        """Return (N,) the strip of the triangle that :meth:`height` reads; -1 when there is none."""
        index = self._query(xy, near_z).triangle
        return np.where(index >= 0, self.strip_index[np.maximum(index, 0)], -1) if len(self.strip_index) else index

    def height_range(self, xy: Array) -> Array:
        """Return (N,) metres between the lowest and the highest triangle that cover each point; 0 where one or none does."""
        return _height_range(np.ascontiguousarray(xy, np.float64), self._buckets)

    @property
    def _buckets(self) -> _Buckets:
        lattice = _Lattice(self.x0, self.y0, self.columns, self.rows)
        return _Buckets(self.triangles, lattice, self.bucket_offsets, self.triangle_index)

    def _query(self, xy: Array, near_z: Array | float | None) -> _SurfacePoints:
        points = np.ascontiguousarray(xy, np.float64)
        wanted = np.array(np.broadcast_to(np.inf if near_z is None else near_z, len(points)), np.float64)
        return _query(points, wanted, self._buckets)


class _SurfacePoints(NamedTuple):
    """Of N points: height z and distance in plan (N,) metres, and the triangle (N,) that they are of, -1: none."""

    height: F64x1
    distance: F64x1
    triangle: I64x1


@njit(cache=True)
def _fill_buckets(triangles: F64x3, lattice: _Lattice) -> tuple[I64x1, I64x1]:  # pragma: no cover - compiled
    """Return offsets (B + 1,) of the buckets and the triangles in each, ascending."""
    x0, y0, columns, rows = lattice
    count = np.zeros(columns * rows + 1, np.int64)
    span = np.empty((len(triangles), 4), np.int64)
    for t in range(len(triangles)):
        span[t, 0] = int((triangles[t, :, 0].min() - x0) / BUCKET_M)
        span[t, 1] = min(int((triangles[t, :, 0].max() - x0) / BUCKET_M), columns - 1)
        span[t, 2] = int((triangles[t, :, 1].min() - y0) / BUCKET_M)
        span[t, 3] = min(int((triangles[t, :, 1].max() - y0) / BUCKET_M), rows - 1)
        for r in range(span[t, 2], span[t, 3] + 1):
            for c in range(span[t, 0], span[t, 1] + 1):
                count[r * columns + c + 1] += 1
    bucket_offsets = np.cumsum(count)
    cursor = bucket_offsets[:-1].copy()
    member = np.empty(bucket_offsets[-1], np.int64)
    for t in range(len(triangles)):
        for r in range(span[t, 2], span[t, 3] + 1):
            for c in range(span[t, 0], span[t, 1] + 1):
                member[cursor[r * columns + c]] = t
                cursor[r * columns + c] += 1
    return bucket_offsets, member


@njit(cache=True)
def _plane_z(corner: F64x2, x: float, y: float) -> tuple[bool, float]:  # pragma: no cover - compiled
    """Return (inside, z) of a triangle at a point, by barycentric coordinates; a hair of tolerance closes the seams."""
    ax, ay = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1]
    bx, by = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1]
    px, py = x - corner[0, 0], y - corner[0, 1]
    area = ax * by - ay * bx
    u, v = (px * by - py * bx) / area, (ax * py - ay * px) / area
    inside = u >= -1e-6 and v >= -1e-6 and u + v <= 1.0 + 1e-6
    return inside, corner[0, 2] + u * (corner[1, 2] - corner[0, 2]) + v * (corner[2, 2] - corner[0, 2])


@njit(cache=True)
def _edge_nearest(corner: F64x2, x: float, y: float) -> tuple[float, float]:  # pragma: no cover - compiled
    """Return (squared distance, z) of the nearest point on a triangle's rim."""
    best, z = np.inf, 0.0
    for k in range(3):
        n = (k + 1) % 3
        dx, dy = corner[n, 0] - corner[k, 0], corner[n, 1] - corner[k, 1]
        length = dx * dx + dy * dy
        f = 0.0
        if length > 0.0:
            f = min(1.0, max(0.0, ((x - corner[k, 0]) * dx + (y - corner[k, 1]) * dy) / length))
        ex, ey = x - corner[k, 0] - f * dx, y - corner[k, 1] - f * dy
        if ex * ex + ey * ey < best:
            best, z = ex * ex + ey * ey, corner[k, 2] + f * (corner[n, 2] - corner[k, 2])
    return best, z


# One function: split in two, it takes a tenth longer.
@njit(cache=True)
def _query(xy: F64x2, near_z: F64x1, buckets: _Buckets) -> _SurfacePoints:  # pragma: no cover - compiled
    """Return height, distance and triangle at each point: the own bucket first, then rings of buckets until none can be
    nearer.
    """
    triangles, (x0, y0, columns, rows), bucket_offsets, member = buckets
    n = len(xy)
    height, distance, index = np.zeros(n), np.full(n, np.inf), np.full(n, -1, np.int64)
    if len(triangles) == 0:
        return _SurfacePoints(height, distance, index)
    for i in range(n):
        x, y = xy[i, 0], xy[i, 1]
        column, row = int(np.floor((x - x0) / BUCKET_M)), int(np.floor((y - y0) / BUCKET_M))
        outside = max(0, -column, column - columns + 1, -row, row - rows + 1)
        ring, best = max(0, outside - 1), np.inf
        while ring <= outside + columns + rows:
            for r in range(max(0, row - ring), min(rows - 1, row + ring) + 1):
                whole = abs(r - row) == ring
                c = max(0, column - ring) if whole else column - ring
                while c <= min(columns - 1, column + ring):
                    if c >= 0:
                        for m in range(bucket_offsets[r * columns + c], bucket_offsets[r * columns + c + 1]):
                            t = member[m]
                            inside, z = _plane_z(triangles[t], x, y)
                            if inside:
                                near = near_z[i]
                                better = z > height[i] if near == np.inf else abs(z - near) < abs(height[i] - near)
                                if best > 0.0 or better:
                                    best, height[i], index[i] = 0.0, z, t
                            elif best > 0.0:
                                d, z = _edge_nearest(triangles[t], x, y)
                                if d < best:
                                    best, height[i], index[i] = d, z, t
                    c += 1 if whole else max(1, 2 * ring)
            # Whatever lies in the next ring is at least ring * BUCKET_M (less the offset in the own bucket) away.
            if best == 0.0 or best <= (ring * BUCKET_M) ** 2:
                break
            ring += 1
        distance[i] = np.sqrt(best)
    return _SurfacePoints(height, distance, index)


@njit(cache=True)
def _height_range(xy: F64x2, buckets: _Buckets) -> F64x1:  # pragma: no cover - compiled
    """Return (N,) metres between the lowest and the highest triangle that cover each point; 0 where one or none does."""
    triangles, (x0, y0, columns, rows), bucket_offsets, member = buckets
    out = np.zeros(len(xy))
    if len(triangles) == 0:
        return out
    for i in range(len(xy)):
        column, row = int(np.floor((xy[i, 0] - x0) / BUCKET_M)), int(np.floor((xy[i, 1] - y0) / BUCKET_M))
        if not (0 <= column < columns and 0 <= row < rows):
            continue
        low, high = np.inf, -np.inf
        for m in range(bucket_offsets[row * columns + column], bucket_offsets[row * columns + column + 1]):
            inside, z = _plane_z(triangles[member[m]], xy[i, 0], xy[i, 1])
            if inside:
                low, high = min(low, z), max(high, z)
        out[i] = max(0.0, high - low)
    return out
