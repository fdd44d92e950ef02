# SPDX-License-Identifier: Apache-2.0
"""What stands between the carriageway and the plots: guard rails, barriers, bollards, pillars, bins, benches, shelters.

All keep off the carriageway and off what is taken; see :class:`~manyeyes.simulator.scene.placement.PlacementGrid`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.raycast import BOX, CYLINDER, Primitives
from manyeyes.simulator.scene.placement import PlacementGrid, SolidList, draw_places, find_places

Array = NDArray[np.float64]

_ROAD_CLEARANCE_M = 0.5
# Adds the piece at (x, y, z) with a yaw along the road.
_Piece = Callable[[SolidList, tuple[float, float, float], float, np.random.Generator], None]


@dataclass(frozen=True)
class StreetFurnitureSpec:
    """Numbers of rows and single pieces, at most, within radius_m of the middle; those without a free place are left out."""

    rails: int = 4
    barriers: int = 4
    bollard_rows: int = 6
    pillar_rows: int = 4
    singles: int = 26
    radius_m: float = 75.0


@dataclass(frozen=True)
class _Row:
    """Pieces in line with the road.

    band: distances to the carriageway in metres. step: between pieces. half: length along the road and depth of a piece's
    place. pieces: at least and at most.
    """

    band: tuple[float, float]
    step: float
    half: tuple[float, float]
    pieces: tuple[int, int]
    piece: _Piece


def place_street_furniture(
    plot: PlacementGrid, spec: StreetFurnitureSpec, middle: Array, key: tuple[int | str, ...]
) -> Primitives:
    """Return the pieces of a scene, around middle (2,) metres; their places are taken from the plot."""
    random, heap = keyed_generator(*key, "furniture"), SolidList([])
    for count, row in (
        (spec.rails, _Row((0.9, 1.8), 4.0, (2.0, 0.2), (3, 9), _rail)),
        (spec.barriers, _Row((1.0, 2.2), 2.05, (1.0, 0.3), (2, 7), _barrier)),
        (spec.bollard_rows, _Row((0.8, 1.6), float(random.uniform(1.2, 2.2)), (0.15, 0.15), (3, 10), _bollard)),
        (spec.pillar_rows, _Row((1.5, 4.5), float(random.uniform(2.8, 4.5)), (0.4, 0.4), (2, 7), _pillar)),
    ):
        rows = 0
        for xy in _starts(plot, middle, random, 3 * count, row.band, spec.radius_m):
            rows += rows < count and _follow_road(heap, plot, row, xy, random) >= row.pieces[0]
    singles = (_bin, _bin, _container, _bench, _cabinet, _column, _shelter, _planter)
    for xy in _starts(plot, middle, random, spec.singles, (0.8, 4.0), spec.radius_m):
        piece = singles[int(random.integers(len(singles)))]
        half = {_shelter: (2.0, 0.9), _container: (0.9, 0.7)}.get(piece, (0.6, 0.6))
        _, away = plot.road_clearance(xy)
        if plot.occupy_if_free(xy, (half[1], half[0]), math.atan2(away[1], away[0]), 0.0, _ROAD_CLEARANCE_M):
            piece(heap, (xy[0], xy[1], float(plot.height(xy))), math.atan2(-away[0], away[1]), random)
    return heap.solids()


def _starts(
    plot: PlacementGrid,
    middle: Array,
    random: np.random.Generator,
    count: int,
    band: tuple[float, float],
    radius_m: float,
) -> Array:
    if count <= 0:
        return np.zeros((0, 2))
    places = find_places(plot, middle, radius_m, *band, plot.distance_to_road_m)
    return draw_places(random, places, count, middle, 90.0)[:count]


def _follow_road(heap: SolidList, plot: PlacementGrid, row: _Row, xy: Array, random: np.random.Generator) -> int:
    """Set pieces along the road's edge from a place on, as long as there is room; returns how many."""
    wanted, side = float(random.uniform(*row.band)), 1.0 if random.random() < 0.5 else -1.0
    pieces = int(random.integers(row.pieces[0], row.pieces[1] + 1))
    for count in range(pieces):
        distance, away = plot.road_clearance(xy)
        if distance <= 0 or distance > row.band[1] + 1.0:
            return count
        along = side * np.array([-away[1], away[0]])
        xy = xy + (wanted - distance) * away
        yaw = math.atan2(along[1], along[0])
        if not plot.occupy_if_free(xy, row.half, yaw, 0.0, _ROAD_CLEARANCE_M):
            return count
        row.piece(heap, (float(xy[0]), float(xy[1]), float(plot.height(xy))), yaw, random)
        xy = xy + row.step * along
    return pieces


def _rail(heap: SolidList, at: tuple[float, float, float], yaw: float, random: np.random.Generator) -> None:
    x, y, z = at
    heap.add(BOX, (x, y, z + 0.62), (2.0, 0.04, 0.16), yaw, reflectivity=0.55)
    heap.add(BOX, (x, y, z + 0.25), (0.06, 0.06, 0.45), yaw, reflectivity=0.5)


def _barrier(heap: SolidList, at: tuple[float, float, float], yaw: float, random: np.random.Generator) -> None:
    x, y, z = at
    heap.add(BOX, (x, y, z + 0.10), (1.0, 0.28, 0.25), yaw, reflectivity=0.4)
    heap.add(BOX, (x, y, z + 0.55), (1.0, 0.13, 0.30), yaw, reflectivity=0.4)


def _bollard(heap: SolidList, at: tuple[float, float, float], yaw: float, random: np.random.Generator) -> None:
    x, y, z = at
    heap.add(CYLINDER, (x, y, z + 0.4), (0.08, 0.08, 0.6), reflectivity=0.45)


def _pillar(heap: SolidList, at: tuple[float, float, float], yaw: float, random: np.random.Generator) -> None:
    x, y, z = at
    radius, height = random.uniform(0.18, 0.4), random.uniform(2.4, 5.0)
    kind = CYLINDER if random.random() < 0.5 else BOX
    heap.add(kind, (x, y, z + height / 2 - 0.15), (radius, radius, height / 2 + 0.15), yaw, reflectivity=0.4)


def _bin(heap: SolidList, at: tuple[float, float, float], yaw: float, random: np.random.Generator) -> None:
    x, y, z = at
    half = random.uniform(0.25, 0.5), random.uniform(0.25, 0.4), random.uniform(0.4, 0.7)
    heap.add(BOX, (x, y, z + half[2] - 0.05), half, yaw, reflectivity=float(random.uniform(0.1, 0.4)))


def _container(heap: SolidList, at: tuple[float, float, float], yaw: float, random: np.random.Generator) -> None:
    x, y, z = at
    heap.add(BOX, (x, y, z + 0.65), (0.8, 0.55, 0.7), yaw, reflectivity=float(random.uniform(0.1, 0.5)))


def _bench(heap: SolidList, at: tuple[float, float, float], yaw: float, random: np.random.Generator) -> None:
    x, y, z = at
    c, s = math.cos(yaw), math.sin(yaw)
    heap.add(BOX, (x, y, z + 0.43), (0.6, 0.22, 0.04), yaw, reflectivity=0.3)
    heap.add(BOX, (x + 0.24 * s, y - 0.24 * c, z + 0.68), (0.6, 0.03, 0.18), yaw, reflectivity=0.3)
    for end in (-0.5, 0.5):
        heap.add(BOX, (x + end * c, y + end * s, z + 0.18), (0.05, 0.2, 0.24), yaw, reflectivity=0.3)


def _cabinet(heap: SolidList, at: tuple[float, float, float], yaw: float, random: np.random.Generator) -> None:
    x, y, z = at
    heap.add(BOX, (x, y, z + 0.6), (random.uniform(0.3, 0.6), 0.22, 0.7), yaw, reflectivity=0.35)


def _column(heap: SolidList, at: tuple[float, float, float], yaw: float, random: np.random.Generator) -> None:
    x, y, z = at
    heap.add(CYLINDER, (x, y, z + 1.4), (0.55, 0.55, 1.5), reflectivity=0.4)


def _planter(heap: SolidList, at: tuple[float, float, float], yaw: float, random: np.random.Generator) -> None:
    x, y, z = at
    heap.add(BOX, (x, y, z + 0.25), (0.55, 0.4, 0.35), yaw, reflectivity=0.35)
    heap.add(BOX, (x, y, z + 0.8), (0.4, 0.3, 0.25), yaw, reflectivity=0.25)


def _shelter(heap: SolidList, at: tuple[float, float, float], yaw: float, random: np.random.Generator) -> None:
    """A shelter of a bus stop: back, one side, roof and seat."""
    x, y, z = at
    c, s = math.cos(yaw), math.sin(yaw)

    def put(u: float, v: float, w: float, half: tuple[float, float, float], bright: float) -> None:
        heap.add(BOX, (x + u * c - v * s, y + u * s + v * c, z + w), half, yaw, reflectivity=bright)

    put(0.0, -0.7, 1.1, (1.9, 0.04, 1.25), 0.15)
    put(-1.9, 0.0, 1.1, (0.04, 0.7, 1.25), 0.15)
    put(0.0, 0.0, 2.4, (1.95, 0.8, 0.06), 0.4)
    put(0.2, -0.45, 0.45, (1.2, 0.2, 0.04), 0.3)
