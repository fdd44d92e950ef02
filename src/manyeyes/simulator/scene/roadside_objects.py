# SPDX-License-Identifier: Apache-2.0
"""What stands beside a road: buildings, walls, poles, trees and hedges, placed by a seed on ground that is not paved.

The only input is the ground's raster. Everything keeps its distance from the carriageway and from what stands already.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.raycast import BOX, CYLINDER, ELLIPSOID, Primitives
from manyeyes.simulator.scene.placement import PlacementGrid, SolidList, draw_places, find_places

Array = NDArray[np.float64]


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


def _buildings(
    heap: SolidList, plot: PlacementGrid, spec: RoadsideObjectSpec, middle: Array, random: np.random.Generator
) -> None:
    """Prisms that front the pavement, those at the crossing's corners first: they decide who sees what."""
    places = find_places(plot, middle, spec.radius_m, spec.setback_m, spec.setback_m + 1.5, plot.distance_to_pavement_m)
    for xy in draw_places(random, places, spec.buildings, middle, 60.0):
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
    heap: SolidList, plot: PlacementGrid, spec: RoadsideObjectSpec, middle: Array, random: np.random.Generator
) -> None:
    """Walls and fences along the pavement, and hedges, which are low and dark."""
    for count, thick, low, high, bright in ((spec.walls, 0.12, 1.0, 2.4, 0.4), (spec.hedges, 0.4, 0.8, 1.7, 0.25)):
        places = find_places(plot, middle, 0.8 * spec.radius_m, 0.6, 3.0, plot.distance_to_pavement_m)
        for xy in draw_places(random, places, count, middle, 150.0)[:count]:
            _, away = plot.pavement_clearance(xy)
            half, height = (thick, random.uniform(2, 8)), random.uniform(low, high)
            yaw = math.atan2(away[1], away[0])
            if plot.occupy_if_free(xy, half, yaw, 0.3, 0.8):
                z = float(plot.height(xy)) + height / 2 - 0.1
                heap.add(BOX, (xy[0], xy[1], z), (*half, height / 2 + 0.1), yaw, reflectivity=bright)


def _poles(
    heap: SolidList, plot: PlacementGrid, spec: RoadsideObjectSpec, middle: Array, random: np.random.Generator
) -> None:
    """Lamps, signs with a retro-reflecting plate, and traffic lights near the crossing."""
    placed: list[Array] = []
    for xy in draw_places(
        random,
        find_places(plot, middle, 0.8 * spec.radius_m, 0.6, 1.6, plot.distance_to_road_m),
        spec.poles,
        middle,
        80.0,
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
    heap: SolidList, plot: PlacementGrid, spec: RoadsideObjectSpec, middle: Array, random: np.random.Generator
) -> None:
    """A trunk and a crown that lets rays through; the crown's lower side stays above 2.3 m."""
    placed: list[Array] = []
    for xy in draw_places(
        random, find_places(plot, middle, spec.radius_m, 1.5, 9.0, plot.distance_to_road_m), spec.trees, middle, 200.0
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
    heap, random = SolidList([]), keyed_generator(*key, "clutter")
    _buildings(heap, plot, spec, middle, random)
    _walls(heap, plot, spec, middle, random)
    _poles(heap, plot, spec, middle, random)
    _trees(heap, plot, spec, middle, random)
    return heap.solids()


def find_pole_sites(plot: PlacementGrid, middle: Array, low_m: float = 0.6, high_m: float = 2.5) -> Array:
    """Return (N, 2) free places beside the carriageway, nearest to the middle first: where a roadside unit's pole can stand."""
    places = find_places(plot, middle, 45.0, low_m, high_m, plot.distance_to_road_m)
    row, column, _ = plot.index(places)
    places = places[~plot.is_occupied[row, column]]
    return places[np.argsort(np.hypot(*(places - middle).T), kind="stable")]


def make_pole(xy: Array, z: float, height: float, instance: int) -> Primitives:
    """Return a roadside unit's pole: its own instance, so that it is not met by the sensor it carries."""
    heap = SolidList([])
    heap.add(
        CYLINDER, (xy[0], xy[1], z + height / 2), (0.1, 0.1, height / 2 + 0.3), instance=instance, reflectivity=0.5
    )
    return heap.solids()
