# SPDX-License-Identifier: Apache-2.0
"""What stands beside a road: buildings, walls, poles, trees and hedges, placed by a seed on ground that is not paved.

The only input is the ground's raster. Everything keeps its distance from the carriageway and from what stands already.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx2, F64x2, njit
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.raycast import BOX, CYLINDER, ELLIPSOID, HeightField, Primitives
from manyeyes.simulator.sensors.lidar import OFF_ROAD, SIDEWALK

Array = NDArray[np.float64]

_CELL = 0.5


@dataclass(frozen=True)
class RoadsideObjectSpec:
    """Numbers of roadside objects; those without a free place are left out.

    buildings … hedges: at most. setback_m: from the pavement's edge to a front. radius_m: how far from the middle.
    """

    buildings: int = 20
    walls: int = 10
    poles: int = 60
    trees: int = 32
    hedges: int = 12
    setback_m: float = 1.5
    radius_m: float = 100.0


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
        row, column, _ = self.index(xy)
        i, j = (
            min(max(int(row), 2), self.is_occupied.shape[0] - 3),
            min(max(int(column), 2), self.is_occupied.shape[1] - 3),
        )
        slope = np.array(
            [
                self.distance_to_pavement_m[i, j + 2] - self.distance_to_pavement_m[i, j - 2],
                self.distance_to_pavement_m[i + 2, j] - self.distance_to_pavement_m[i - 2, j],
            ]
        )
        length = float(np.hypot(*slope))
        return float(self.distance_to_pavement_m[i, j]), slope / length if length > 1e-6 else np.array([1.0, 0.0])

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

    def height(self, xy: Array) -> Array:
        """Return the ground height at points (..., 2), nearest node."""
        column = np.clip(
            np.rint((xy[..., 0] - self.ground.x_min) / self.ground.cell), 0, self.ground.height.shape[1] - 1
        )
        row = np.clip(np.rint((xy[..., 1] - self.ground.y_min) / self.ground.cell), 0, self.ground.height.shape[0] - 1)
        return self.ground.height[row.astype(int), column.astype(int)].astype(np.float64)


@dataclass
class _SolidList:
    """Solids as they come."""

    rows: list[tuple[int, tuple[float, float, float], float, tuple[float, float, float], float, int, float]]

    def add(
        self, kind: int, center: tuple[float, float, float], half: tuple[float, float, float], yaw: float = 0.0,
        density: float = 0.0, instance: int = 0, reflectivity: float = 0.3,
    ) -> None:  # fmt: skip
        self.rows.append((kind, center, yaw, half, density, instance, reflectivity))

    def solids(self) -> Primitives:
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


def _band(plot: PlacementGrid, middle: Array, radius: float, low: float, high: float, to: Array) -> Array:
    """Return (N, 2) centres of the cells around the middle whose distance ``to`` is within low … high."""
    row, column = np.nonzero((to >= low) & (to <= high))
    x, y = plot.ground.x_min + (column + 0.5) * plot.cell, plot.ground.y_min + (row + 0.5) * plot.cell
    xy = np.stack((x, y), -1).astype(np.float64)
    return xy[np.hypot(*(xy - middle).T) < radius]


def _draw(random: np.random.Generator, places: Array, count: int, middle: Array, pull_m: float) -> Array:
    """At most count places, nearest to the middle first with a jitter of pull_m."""
    if not len(places):
        return places
    chosen = places[random.permutation(len(places))[: 12 * count]]
    order = np.argsort(np.hypot(*(chosen - middle).T) + random.uniform(0, pull_m, len(chosen)))
    return chosen[order][: 4 * count]


def _buildings(
    heap: _SolidList, plot: PlacementGrid, spec: RoadsideObjectSpec, middle: Array, random: np.random.Generator
) -> None:
    """Prisms that front the pavement, those at the crossing's corners first: they decide who sees what."""
    places = _band(plot, middle, spec.radius_m, spec.setback_m, spec.setback_m + 1.5, plot.distance_to_pavement_m)
    for xy in _draw(random, places, spec.buildings, middle, 60.0):
        if len(heap.rows) >= spec.buildings:
            break
        distance, away = plot.pavement_clearance(xy)
        depth, width, height = random.uniform(6, 16), random.uniform(7, 24), random.uniform(4, 18)
        for shrink in (1.0, 0.6, 0.35):
            half = (depth * max(shrink, 0.6) / 2, width * shrink / 2)
            center = xy + away * half[0]
            yaw = math.atan2(away[1], away[0])
            if plot.occupy_if_free(center, half, yaw, 0.6 * min(distance, spec.setback_m), 1.0):
                base = float(plot.height(plot.footprint(center, half, yaw)).min()) - 0.5
                z, half_z = base + height / 2, height / 2
                heap.add(
                    BOX, (center[0], center[1], z), (*half, half_z), yaw, reflectivity=float(random.uniform(0.2, 0.6))
                )
                break


def _walls(
    heap: _SolidList, plot: PlacementGrid, spec: RoadsideObjectSpec, middle: Array, random: np.random.Generator
) -> None:
    """Walls and fences along the pavement, and hedges, which are low and dark."""
    for count, thick, low, high, bright in ((spec.walls, 0.12, 1.0, 2.4, 0.4), (spec.hedges, 0.4, 0.8, 1.7, 0.25)):
        places = _band(plot, middle, 0.8 * spec.radius_m, 0.6, 3.0, plot.distance_to_pavement_m)
        for xy in _draw(random, places, count, middle, 150.0)[:count]:
            _, away = plot.pavement_clearance(xy)
            half, height = (thick, random.uniform(2, 8)), random.uniform(low, high)
            yaw = math.atan2(away[1], away[0])
            if plot.occupy_if_free(xy, half, yaw, 0.3, 0.8):
                z = float(plot.height(xy)) + height / 2 - 0.1
                heap.add(BOX, (xy[0], xy[1], z), (*half, height / 2 + 0.1), yaw, reflectivity=bright)


def _poles(
    heap: _SolidList, plot: PlacementGrid, spec: RoadsideObjectSpec, middle: Array, random: np.random.Generator
) -> None:
    """Lamps, signs with a retro-reflecting plate, and traffic lights near the crossing."""
    placed: list[Array] = []
    for xy in _draw(
        random, _band(plot, middle, 0.8 * spec.radius_m, 0.6, 1.6, plot.distance_to_road_m), spec.poles, middle, 80.0
    ):
        if len(placed) >= spec.poles or any(np.hypot(*(xy - other)) < 7.0 for other in placed):
            continue
        if not plot.occupy_if_free(xy, (0.2, 0.2), 0.0, 0.0, 0.5):
            continue
        placed.append(xy)
        z, (_, away) = float(plot.height(xy)), plot.pavement_clearance(xy)
        what, yaw = random.uniform(), math.atan2(away[1], away[0])
        x, y = float(xy[0]), float(xy[1])
        if what < 0.5:
            heap.add(CYLINDER, (x, y, z + 3.5), (0.1, 0.1, 3.7), reflectivity=0.5)
        elif what < 0.75:
            heap.add(CYLINDER, (x, y, z + 1.3), (0.04, 0.04, 1.5), reflectivity=0.5)
            heap.add(BOX, (x, y, z + 2.5), (0.3, 0.03, 0.3), yaw, reflectivity=0.95)
        else:
            heap.add(CYLINDER, (x, y, z + 2.2), (0.07, 0.07, 2.4), reflectivity=0.4)
            heap.add(BOX, (x, y, z + 3.6), (0.16, 0.16, 0.45), yaw, reflectivity=0.1)


def _trees(
    heap: _SolidList, plot: PlacementGrid, spec: RoadsideObjectSpec, middle: Array, random: np.random.Generator
) -> None:
    """A trunk and a crown that lets rays through; the crown's lower side stays above 2.3 m."""
    placed: list[Array] = []
    for xy in _draw(
        random, _band(plot, middle, spec.radius_m, 1.5, 9.0, plot.distance_to_road_m), spec.trees, middle, 200.0
    ):
        if len(placed) >= spec.trees or any(np.hypot(*(xy - other)) < 4.0 for other in placed):
            continue
        if not plot.occupy_if_free(xy, (0.4, 0.4), 0.0, 0.0, 1.2):
            continue
        placed.append(xy)
        z, wide, tall = float(plot.height(xy)), random.uniform(1.2, 2.6), random.uniform(1.2, 2.4)
        x, y, bole = float(xy[0]), float(xy[1]), 2.3 + random.uniform(0, 0.8)
        girth, density, bright = random.uniform(0.1, 0.25), random.uniform(0.5, 1.4), random.uniform(0.25, 0.5)
        heap.add(CYLINDER, (x, y, z + (bole + 0.5) / 2), (girth, girth, (bole + 0.7) / 2), reflectivity=0.2)
        crown = (x, y, z + bole + tall)
        heap.add(ELLIPSOID, crown, (wide, wide, tall), density=float(density), reflectivity=float(bright))


def place_roadside_objects(
    plot: PlacementGrid, spec: RoadsideObjectSpec, middle: Array, key: tuple[int | str, ...]
) -> Primitives:
    """Return all that stands beside the roads around middle (2,). Buildings come first, so that nothing else is built over."""
    heap, random = _SolidList([]), keyed_generator(*key, "clutter")
    _buildings(heap, plot, spec, middle, random)
    _walls(heap, plot, spec, middle, random)
    _poles(heap, plot, spec, middle, random)
    _trees(heap, plot, spec, middle, random)
    return heap.solids()


def find_pole_sites(plot: PlacementGrid, middle: Array, low_m: float = 0.6, high_m: float = 2.5) -> Array:
    """Return (N, 2) free places beside the carriageway, nearest to the middle first: where a roadside unit's pole can stand."""
    places = _band(plot, middle, 45.0, low_m, high_m, plot.distance_to_road_m)
    row, column, _ = plot.index(places)
    places = places[~plot.is_occupied[row, column]]
    return places[np.argsort(np.hypot(*(places - middle).T), kind="stable")]


def make_pole(xy: Array, z: float, height: float, instance: int) -> Primitives:
    """Return a roadside unit's pole: its own instance, so that it is not met by the sensor it carries."""
    heap = _SolidList([])
    heap.add(
        CYLINDER, (xy[0], xy[1], z + height / 2), (0.1, 0.1, height / 2 + 0.3), instance=instance, reflectivity=0.5
    )
    return heap.solids()
