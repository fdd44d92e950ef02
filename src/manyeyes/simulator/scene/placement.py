# SPDX-License-Identifier: Apache-2.0
"""Where something may stand beside a road: distances to pavement and carriageway, and what is taken already."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx2, F64x2, njit
from manyeyes.ops.raycast import HeightField, Primitives
from manyeyes.simulator.sensors.lidar import OFF_ROAD, SIDEWALK

Array = NDArray[np.float64]

_CELL = 0.5


@njit(cache=True)
def _distance_rows(blocked: Boolx2, out: F64x2) -> None:
    rows, columns = blocked.shape
    for i in range(rows):
        last = -(10**9)
        for j in range(columns):
            if blocked[i, j]:
                last = j
            out[i, j] = float(j - last)
        last = 10**9
        for j in range(columns - 1, -1, -1):
            if blocked[i, j]:
                last = j
            out[i, j] = min(out[i, j], float(last - j))


@njit(cache=True)
def _distance_columns(flat: F64x2, out: F64x2) -> None:
    """Lower envelope of parabolas down each column. Source: Felzenszwalb & Huttenlocher, Theory of Computing 2012."""
    rows, columns = flat.shape
    vertex, bound = np.empty(rows, np.int64), np.empty(rows + 1)
    for j in range(columns):
        k, vertex[0], bound[0], bound[1] = 0, 0, -1e30, 1e30
        for q in range(1, rows):
            while True:
                v = vertex[k]
                s = (flat[q, j] ** 2 + q * q - flat[v, j] ** 2 - v * v) / (2.0 * (q - v))
                if s > bound[k]:
                    break
                k -= 1
            k += 1
            vertex[k], bound[k], bound[k + 1] = q, s, 1e30
        k = 0
        for q in range(rows):
            while bound[k + 1] < q:
                k += 1
            out[q, j] = math.sqrt((q - vertex[k]) ** 2 + flat[vertex[k], j] ** 2)


def distance_transform(blocked: Boolx2) -> Array:
    """Euclidean distance of each cell's centre to the nearest blocked cell's, in cells; at most 1e4."""
    flat, out = np.empty(blocked.shape), np.empty(blocked.shape)
    _distance_rows(blocked, flat)
    _distance_columns(np.minimum(flat, 1e4), out)
    return np.minimum(out, 1e4)


@dataclass(frozen=True)
class PlacementGrid:
    """Where things may stand, on cells of 0.5 m: distances to the carriageway and to any pavement, and what is taken."""

    ground: HeightField
    distance_to_road_m: Array
    distance_to_pavement_m: Array
    is_occupied: NDArray[np.bool_]

    @classmethod
    def of(cls, ground: HeightField) -> PlacementGrid:
        """From a ground, with nothing on it."""
        factor = max(1, round(_CELL / ground.surface_cell))
        rows, columns = (n // factor for n in ground.surface.shape)
        blocks = ground.surface[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
        paved = (blocks != OFF_ROAD).any((1, 3))
        road = ((blocks != OFF_ROAD) & (blocks != SIDEWALK)).any((1, 3))
        size = factor * ground.surface_cell
        return cls(
            ground, distance_transform(road) * size, distance_transform(paved) * size, np.zeros(road.shape, bool)
        )

    @property
    def cell(self) -> float:
        """Edge of a cell, metres."""
        return max(1, round(_CELL / self.ground.surface_cell)) * self.ground.surface_cell

    def index(self, xy: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Return row, column (clamped) and whether inside, of points (..., 2)."""
        column = np.floor((xy[..., 0] - self.ground.x_min) / self.cell).astype(np.int64)
        row = np.floor((xy[..., 1] - self.ground.y_min) / self.cell).astype(np.int64)
        rows, columns = self.is_occupied.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1), inside

    def pavement_clearance(self, xy: Array) -> tuple[float, Array]:
        """Return the distance to the pavement at one point (2,), and the unit direction in which it grows."""
        return self._clearance(self.distance_to_pavement_m, xy)

    def road_clearance(self, xy: Array) -> tuple[float, Array]:
        """Return the distance to the carriageway at one point (2,), and the unit direction in which it grows."""
        return self._clearance(self.distance_to_road_m, xy)

    def _clearance(self, distance_m: Array, xy: Array) -> tuple[float, Array]:
        row, column, _ = self.index(xy)
        i, j = (
            min(max(int(row), 2), self.is_occupied.shape[0] - 3),
            min(max(int(column), 2), self.is_occupied.shape[1] - 3),
        )
        slope = np.array([distance_m[i, j + 2] - distance_m[i, j - 2], distance_m[i + 2, j] - distance_m[i - 2, j]])
        length = float(np.hypot(*slope))
        return float(distance_m[i, j]), slope / length if length > 1e-6 else np.array([1.0, 0.0])

    def footprint(self, center: Array, half: tuple[float, float], yaw: float) -> Array:
        """Return points (P, 2) that fill an oriented rectangle no coarser than a cell."""
        nx, ny = (max(2, math.ceil(2 * h / self.cell) + 1) for h in half)
        u, v = np.meshgrid(np.linspace(-half[0], half[0], nx), np.linspace(-half[1], half[1], ny))
        c, s = math.cos(yaw), math.sin(yaw)
        return np.stack((center[0] + u * c - v * s, center[1] + u * s + v * c), -1).reshape(-1, 2)

    def occupy_if_free(
        self, center: Array, half: tuple[float, float], yaw: float, clear_m: float, road_m: float = 0.0
    ) -> bool:
        """Take a rectangle if all of it is free, at least clear_m from pavement and road_m from the carriageway."""
        row, column, inside = self.index(self.footprint(center, half, yaw))
        free = inside & ~self.is_occupied[row, column]
        if (
            not free.all()
            or (self.distance_to_pavement_m[row, column] < clear_m).any()
            or (self.distance_to_road_m[row, column] < road_m).any()
        ):
            return False
        self.is_occupied[row, column] = True
        return True

    def occupy(self, center: Array, half: tuple[float, float], yaw: float) -> None:
        """Take a rectangle whatever is there."""
        row, column, inside = self.index(self.footprint(center, half, yaw))
        self.is_occupied[row[inside], column[inside]] = True

    def occupy_all(self, center: Array, half: tuple[float, float], yaw: float) -> None:
        """Take every cell that a rectangle touches; :meth:`occupy` leaves holes in one that is turned."""
        reach = math.hypot(*half) + self.cell
        (low_row, high_row), (low_column, high_column), _ = self.index(np.stack((center - reach, center + reach)))
        rows, columns = slice(low_row, high_row + 1), slice(low_column, high_column + 1)
        x = self.ground.x_min + (np.arange(low_column, high_column + 1) + 0.5) * self.cell - center[0]
        y = self.ground.y_min + (np.arange(low_row, high_row + 1) + 0.5) * self.cell - center[1]
        c, s, margin = math.cos(yaw), math.sin(yaw), self.cell / math.sqrt(2)
        ahead, left = np.abs(c * x[None] + s * y[:, None]), np.abs(c * y[:, None] - s * x[None])
        self.is_occupied[rows, columns] |= (ahead <= half[0] + margin) & (left <= half[1] + margin)

    def height(self, xy: Array) -> Array:
        """Return the ground height at points (..., 2), nearest node."""
        column = np.clip(
            np.rint((xy[..., 0] - self.ground.x_min) / self.ground.cell), 0, self.ground.height.shape[1] - 1
        )
        row = np.clip(np.rint((xy[..., 1] - self.ground.y_min) / self.ground.cell), 0, self.ground.height.shape[0] - 1)
        return self.ground.height[row.astype(int), column.astype(int)].astype(np.float64)


@dataclass
class SolidList:
    """Solids as they come, upright, and what they are made of; see :class:`~manyeyes.ops.raycast.Primitives`."""

    rows: list[tuple[int, tuple[float, float, float], float, tuple[float, float, float], float, int, float]]

    def add(
        self, kind: int, center: tuple[float, float, float], half: tuple[float, float, float], yaw: float = 0.0,
        density: float = 0.0, instance: int = 0, reflectivity: float = 0.3,
    ) -> None:  # fmt: skip
        """Append one solid, turned by yaw about its upright axis."""
        self.rows.append((kind, center, yaw, half, density, instance, reflectivity))

    def solids(self) -> Primitives:
        """Return all of them."""
        if not self.rows:
            return Primitives.empty()
        kind, center, yaw, half, density, instance, reflectivity = zip(*self.rows)
        c, s = np.cos(yaw), np.sin(yaw)
        rotation = np.zeros((len(yaw), 3, 3))
        rotation[:, 0, 0], rotation[:, 0, 1], rotation[:, 1, 0], rotation[:, 1, 1], rotation[:, 2, 2] = c, -s, s, c, 1
        return Primitives(
            np.array(kind, np.uint8), np.array(center), rotation, np.array(half), np.array(density),
            np.array(instance, np.int64), np.array(reflectivity),
        )  # fmt: skip


def find_places(plot: PlacementGrid, middle: Array, radius: float, low: float, high: float, to: Array) -> Array:
    """Return (N, 2) centres of the cells around the middle whose distance ``to`` is within low … high."""
    row, column = np.nonzero((to >= low) & (to <= high))
    x, y = plot.ground.x_min + (column + 0.5) * plot.cell, plot.ground.y_min + (row + 0.5) * plot.cell
    xy = np.stack((x, y), -1).astype(np.float64)
    return xy[np.hypot(*(xy - middle).T) < radius]


def draw_places(random: np.random.Generator, places: Array, count: int, middle: Array, pull_m: float) -> Array:
    """At most count places, nearest to the middle first with a jitter of pull_m."""
    if not len(places):
        return places
    chosen = places[random.permutation(len(places))[: 12 * count]]
    order = np.argsort(np.hypot(*(chosen - middle).T) + random.uniform(0, pull_m, len(chosen)))
    return chosen[order][: 4 * count]
