# SPDX-License-Identifier: Apache-2.0
"""The ground of a scene: a raster of heights and a finer raster of what it is made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from manyeyes._jit import Boolx2, F64x1, F64x2, F64x3, U8x2, njit
from manyeyes.datatypes import ConfigError
from manyeyes.maps.roads.road_network import PAVED, WALKABLE, RoadMark, RoadNetwork

Array = NDArray[np.float64]

GRASS, ASPHALT, PAINT, SIDEWALK, CROSSING = 0, 1, 2, 3, 4
_STRIPE_M = 0.5
_GAP_M = 2.5
_LEVEL_GAP_M = 1.5


@dataclass(frozen=True, eq=False)
class GroundRaster:
    """Heights at nodes and surface classes on cells, around one scene, world axes.

    height: (rows, columns) float32 metres at nodes ``x0 + column * cell_m, y0 + row * cell_m``, bilinear between; beyond the
    raster its border goes on. surface: (rows, columns) uint8 on cells of surface_cell_m whose first corner is (x0, y0):
    GRASS, ASPHALT, PAINT, SIDEWALK (shoulders too) or CROSSING (the stripes of a pedestrian crossing).
    """

    x0: float
    y0: float
    cell_m: float
    height: NDArray[np.float32]
    surface_cell_m: float
    surface: NDArray[np.uint8]

    def _cell(self, x: ArrayLike, y: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
        rows, columns = self.height.shape
        u = np.clip((np.asarray(x, np.float64) - self.x0) / self.cell_m, 0.0, columns - 1.0)
        v = np.clip((np.asarray(y, np.float64) - self.y0) / self.cell_m, 0.0, rows - 1.0)
        column = np.minimum(u.astype(np.int64), columns - 2)
        row = np.minimum(v.astype(np.int64), rows - 2)
        return column, row, u - column, v - row

    def height_at(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Return the height at points, any shape; metres."""
        column, row, u, v = self._cell(x, y)
        h = self.height
        near = h[row, column] * (1 - u) + h[row, column + 1] * u
        far = h[row + 1, column] * (1 - u) + h[row + 1, column + 1] * u
        return near * (1 - v) + far * v

    def normal_at(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Upward unit normals (..., 3) at points."""
        column, row, u, v = self._cell(x, y)
        h = self.height.astype(np.float64)
        a, b, c, d = h[row, column], h[row, column + 1], h[row + 1, column], h[row + 1, column + 1]
        dx = ((b - a) * (1 - v) + (d - c) * v) / self.cell_m
        dy = ((c - a) * (1 - u) + (d - b) * u) / self.cell_m
        normal = np.stack((-dx, -dy, np.ones_like(dx)), -1)
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)

    def surface_at(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.uint8]:
        """Class at points; that of the nearest cell outside."""
        rows, columns = self.surface.shape
        column = np.floor((np.asarray(x, np.float64) - self.x0) / self.surface_cell_m).astype(np.int64)
        row = np.floor((np.asarray(y, np.float64) - self.y0) / self.surface_cell_m).astype(np.int64)
        return self.surface[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]


def build_ground(
    network: RoadNetwork,
    center_xy: ArrayLike,
    half_size_m: float,
    cell_m: float = 0.5,
    surface_cell_m: float = 0.125,
) -> GroundRaster:
    """Return the square of 2 half_size_m around a centre: heights of the lanes, filled smoothly between them, and their paint.

    Where roads cross on two levels, the one nearest to the height at the centre is taken; see :func:`is_multilevel`.
    """
    if half_size_m <= cell_m or cell_m <= 0 or surface_cell_m <= 0:
        raise ConfigError(
            f"build_ground needs half_size_m > cell_m > 0 and a positive surface cell; got {half_size_m}, {cell_m}."
        )
    center = np.asarray(center_xy, np.float64).reshape(2)
    x0, y0 = (center - half_size_m).tolist()
    nodes = int(np.ceil(2 * half_size_m / cell_m)) + 1
    cells = int(np.ceil(2 * half_size_m / surface_cell_m))
    level = float(network.height(center[None])[0])
    height = np.full((nodes, nodes), np.nan)
    triangles = network.surface.triangles
    reach = (triangles[..., :2].min(1) <= center + half_size_m).all(-1)
    reach &= (triangles[..., :2].max(1) >= center - half_size_m).all(-1)
    _raster_height(height, triangles[reach], x0, y0, cell_m, level)
    surface = np.zeros((cells, cells), np.uint8)
    _paint_surface(surface, network, x0, y0, surface_cell_m)
    return GroundRaster(x0, y0, cell_m, _fill_smooth(height, level).astype(np.float32), surface_cell_m, surface)


def is_multilevel(network: RoadNetwork, center_xy: ArrayLike, radius_m: float, step_m: float = 2.0) -> bool:
    """Return whether lanes lie over each other, more than 1.5 m apart, within radius_m of a centre."""
    center = np.asarray(center_xy, np.float64).reshape(2)
    axis = np.arange(-radius_m, radius_m + step_m / 2, step_m)
    offsets = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    offsets = offsets[np.linalg.norm(offsets, axis=1) <= radius_m]
    return bool((network.surface.height_range(center + offsets) > _LEVEL_GAP_M).any())


def _paint_surface(surface: NDArray[np.uint8], network: RoadNetwork, x0: float, y0: float, cell: float) -> None:
    """Walkways, then what is paved over them, the gaps that the file leaves within, lines, and the stripes of crossings."""
    size = surface.shape[0] * cell
    low, high = np.array([x0, y0]), np.array([x0, y0]) + size

    def reaches(points: Array) -> bool:
        flat = points[:, :2]
        return bool((flat.min(0) <= high).all() and (flat.max(0) >= low).all())

    for kinds, value in (((*WALKABLE, "border"), SIDEWALK), ((*PAVED, "none"), ASPHALT)):
        for lane in network.lanes:
            if lane.kind in kinds and (reaches(lane.left) or reaches(lane.right)):
                _fill_strip(surface, lane.left, lane.right, x0, y0, cell, value)
    _close_gaps(surface, round(_GAP_M / cell))
    for mark in network.marks:
        if mark.is_paint and reaches(mark.line):
            for left, right in _make_painted_strips(mark, cell):
                _fill_strip(surface, left, right, x0, y0, cell, PAINT)
    for crossing in network.crossings:
        if reaches(crossing.polygon):
            polygon = np.ascontiguousarray(crossing.polygon[:, :2])
            edges = np.roll(polygon, -1, axis=0) - polygon
            direction = edges[np.argmax(np.linalg.norm(edges, axis=1))]
            direction = direction / max(np.linalg.norm(direction), 1e-9)
            _fill_stripes(surface, polygon, direction, x0, y0, cell, _STRIPE_M, CROSSING)


def _close_gaps(surface: NDArray[np.uint8], reach: int) -> None:
    """Grass to asphalt where it is narrower than 2 reach cells between roads: the corners of junctions, ends of parking lanes."""
    lane = surface != GRASS
    pad = np.pad(lane, reach)
    closed = ~_widen(~_widen(pad, reach), reach)[reach:-reach, reach:-reach]
    surface[closed & ~lane] = ASPHALT


def _widen(mask: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Return cells with a true one at most ``reach`` rows and columns away."""
    out = mask.copy()
    for lines in (out, out.T):
        done = 0
        while done < reach:
            # No more than done + 1: a longer step would jump over cells beside a true one on the border.
            step = min(done + 1, reach - done)
            before = lines.copy("K")
            lines[step:] |= before[:-step]
            lines[:-step] |= before[step:]
            done += step
    return out


def _make_painted_strips(mark: RoadMark, cell: float) -> list[tuple[Array, Array]]:
    """Return left and right edges of each painted piece of a line: one when solid, a dash each when broken.

    A line thinner than a cell is widened to one, so that no gaps appear where it runs obliquely.
    """
    line = mark.line[:, :2]
    station = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))))
    tangent = np.gradient(line, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    normal = np.stack((-tangent[:, 1], tangent[:, 0]), -1) * max(mark.width_m, cell) / 2
    left, right = line + normal, line - normal
    if mark.kind != "broken":
        return [(left, right)]
    strips = []
    for start in np.arange(0.0, station[-1], mark.dash_m + mark.gap_m):
        end = min(start + mark.dash_m, station[-1])
        s = np.concatenate(([start], station[(station > start) & (station < end)], [end]))
        strips.append(
            tuple(np.stack([np.interp(s, station, edge[:, k]) for k in (0, 1)], -1) for edge in (left, right))
        )
    return strips


def _fill_strip(
    surface: NDArray[np.uint8], left: Array, right: Array, x0: float, y0: float, cell: float, value: int
) -> None:
    _fill_quads(surface, np.ascontiguousarray(left[:, :2]), np.ascontiguousarray(right[:, :2]), x0, y0, cell, value)


def _fill_smooth(height: Array, default: float) -> Array:
    """Unknown (NaN) nodes from known ones: a pyramid of means for the first guess, then relaxation towards a membrane."""
    known = np.isfinite(height)
    if not known.any():
        return np.full_like(height, default)
    levels = [(np.where(known, height, 0.0), known.astype(np.float64))]
    while levels[-1][1].size > 1:
        values, weights = (np.pad(a, [(0, n % 2) for n in a.shape]) for a in levels[-1])
        rows, columns = values.shape
        shape = (rows // 2, 2, columns // 2, 2)
        total = weights.reshape(shape).sum((1, 3))
        mean = (values * weights).reshape(shape).sum((1, 3)) / np.maximum(total, 1e-12)
        levels.append((mean, np.minimum(total, 1.0)))
    guess = levels[-1][0]
    for values, weights in levels[-2::-1]:
        rows, columns = values.shape
        coarse = np.repeat(np.repeat(guess, 2, 0), 2, 1)[:rows, :columns]
        guess = np.where(weights > 0, values, coarse)
        _relax(guess, weights > 0, 12)
    return guess


@njit(cache=True)
def _relax(z: F64x2, known: Boolx2, sweeps: int) -> None:  # pragma: no cover
    """Gauss-Seidel on the unknown nodes: each becomes the mean of its neighbours."""
    rows, columns = z.shape
    for _ in range(sweeps):
        for r in range(rows):
            for c in range(columns):
                if not known[r, c]:
                    total, count = 0.0, 0
                    if r > 0:
                        total, count = total + z[r - 1, c], count + 1
                    if r < rows - 1:
                        total, count = total + z[r + 1, c], count + 1
                    if c > 0:
                        total, count = total + z[r, c - 1], count + 1
                    if c < columns - 1:
                        total, count = total + z[r, c + 1], count + 1
                    if count:
                        z[r, c] = total / count


@njit(cache=True)
def _raster_height(
    height: F64x2, triangles: F64x3, x0: float, y0: float, cell: float, level: float
) -> None:  # pragma: no cover
    """z of each triangle at the nodes it covers; where several do, the one nearest to level."""
    rows, columns = height.shape
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        c_low = max(0, int(np.ceil((min(a[0], b[0], c[0]) - x0) / cell - 1e-9)))
        c_high = min(columns - 1, int(np.floor((max(a[0], b[0], c[0]) - x0) / cell + 1e-9)))
        r_low = max(0, int(np.ceil((min(a[1], b[1], c[1]) - y0) / cell - 1e-9)))
        r_high = min(rows - 1, int(np.floor((max(a[1], b[1], c[1]) - y0) / cell + 1e-9)))
        for row in range(r_low, r_high + 1):
            for column in range(c_low, c_high + 1):
                px, py = x0 + column * cell - a[0], y0 + row * cell - a[1]
                u = (px * (c[1] - a[1]) - py * (c[0] - a[0])) / area
                v = ((b[0] - a[0]) * py - (b[1] - a[1]) * px) / area
                if u >= -1e-6 and v >= -1e-6 and u + v <= 1.0 + 1e-6:
                    z = a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2])
                    old = height[row, column]
                    if np.isnan(old) or abs(z - level) < abs(old - level):
                        height[row, column] = z


@njit(cache=True)
def _fill_quads(
    raster: U8x2, left: F64x2, right: F64x2, x0: float, y0: float, cell: float, value: int
) -> None:  # pragma: no cover
    """Cells whose centre lies in the convex hull's rows of each quad between two borders."""
    rows, columns = raster.shape
    x, y = np.empty(4), np.empty(4)
    for i in range(len(left) - 1):
        x[0], y[0] = left[i, 0], left[i, 1]
        x[1], y[1] = left[i + 1, 0], left[i + 1, 1]
        x[2], y[2] = right[i + 1, 0], right[i + 1, 1]
        x[3], y[3] = right[i, 0], right[i, 1]
        r_low = max(0, int(np.ceil((y.min() - y0) / cell - 0.5)))
        r_high = min(rows - 1, int(np.floor((y.max() - y0) / cell - 0.5)))
        for r in range(r_low, r_high + 1):
            at = y0 + (r + 0.5) * cell
            low, high = np.inf, -np.inf
            for k in range(4):
                n = (k + 1) % 4
                if (y[k] <= at) != (y[n] <= at):
                    cross = x[k] + (at - y[k]) / (y[n] - y[k]) * (x[n] - x[k])
                    low, high = min(low, cross), max(high, cross)
            if low <= high:
                c_low = max(0, int(np.ceil((low - x0) / cell - 0.5)))
                c_high = min(columns - 1, int(np.floor((high - x0) / cell - 0.5)))
                for c in range(c_low, c_high + 1):
                    raster[r, c] = value


@njit(cache=True)
def _fill_stripes(
    raster: U8x2, polygon: F64x2, direction: F64x1, x0: float, y0: float, cell: float, stripe: float, value: int
) -> None:  # pragma: no cover
    """Every other band across ``direction`` of the cells inside a polygon (even-odd)."""
    rows, columns = raster.shape
    n = len(polygon)
    c_low = max(0, int((polygon[:, 0].min() - x0) / cell))
    c_high = min(columns - 1, int((polygon[:, 0].max() - x0) / cell))
    r_low = max(0, int((polygon[:, 1].min() - y0) / cell))
    r_high = min(rows - 1, int((polygon[:, 1].max() - y0) / cell))
    for r in range(r_low, r_high + 1):
        for c in range(c_low, c_high + 1):
            x, y = x0 + (c + 0.5) * cell, y0 + (r + 0.5) * cell
            inside = False
            for k in range(n):
                ax, ay = polygon[k]
                bx, by = polygon[(k + 1) % n]
                if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
                    inside = not inside
            if inside:
                u = (x - polygon[0, 0]) * direction[0] + (y - polygon[0, 1]) * direction[1]
                if int(np.floor(u / stripe)) % 2 == 0:
                    raster[r, c] = value
