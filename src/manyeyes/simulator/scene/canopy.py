# SPDX-License-Identifier: Apache-2.0
"""Street trees whose crowns reach over the road and over parked vehicles: a trunk and several clouds of foliage each.

Foliage is porous (:class:`~manyeyes.ops.raycast.Primitives`); its lower side stays above the road and above every vehicle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.raycast import CYLINDER, ELLIPSOID, Primitives
from manyeyes.simulator.scene.placement import PlacementGrid, SolidList, draw_places, find_places
from manyeyes.simulator.scene.vehicles import VehicleStates

Array = NDArray[np.float64]

_ROOF_GAP_M = 0.25
_POLE_GAP_M = 2.0


@dataclass(frozen=True)
class CanopySpec:
    """Street trees; each range is drawn uniformly, for a scene (trees) or for a tree (all others).

    trees: at most so many within radius_m of the middle; below 0 counts as none. base_m: lowest branches above the ground.
    reach_m: radius of a crown. depth_m: its height. density_per_m: of the foliage. spacing_m: between trunks at least.
    """

    trees: tuple[float, float] = (-15.0, 55.0)
    radius_m: float = 75.0
    base_m: tuple[float, float] = (2.5, 5.0)
    reach_m: tuple[float, float] = (2.5, 6.0)
    depth_m: tuple[float, float] = (2.0, 6.5)
    density_per_m: tuple[float, float] = (0.12, 0.8)
    spacing_m: tuple[float, float] = (5.0, 12.0)

    def __post_init__(self) -> None:
        if not 0 < self.base_m[0] <= self.base_m[1] or self.density_per_m[0] <= 0:
            raise ConfigError(f"CanopySpec needs base_m and density_per_m above 0 in order; got {self}.")


def place_canopy(
    plot: PlacementGrid,
    spec: CanopySpec,
    middle: Array,
    vehicles: VehicleStates,
    poles: Array,
    key: tuple[int | str, ...],
) -> Primitives:
    """Return the street trees of a scene.

    Args:
        plot: what is taken; trunks are added.
        spec: the trees.
        middle: (2,) of the scene, metres.
        vehicles: all that stand or drive under the crowns at any time; an id may occur often.
        poles: (K, 2) of roadside units, metres, which foliage keeps clear of.
        key: of the draws.
    """
    random = keyed_generator(*key, "canopy")
    trees, spacing = round(random.uniform(*spec.trees)), float(random.uniform(*spec.spacing_m))
    heap = SolidList([])
    if trees <= 0:
        return heap.solids()
    places = find_places(plot, middle, spec.radius_m, 1.0, 5.0, plot.distance_to_road_m)
    placed: list[Array] = []
    for xy in draw_places(random, places, 4 * trees, middle, 60.0):
        if len(placed) >= trees:
            break
        if any(np.hypot(*(xy - other)) < spacing for other in placed):
            continue
        if plot.occupy_if_free(xy, (0.3, 0.3), 0.0, 0.0, 0.75):
            placed.append(xy)
            _tree(heap, plot, spec, xy, (vehicles, poles), random)
    return heap.solids()


def _tree(
    heap: SolidList,
    plot: PlacementGrid,
    spec: CanopySpec,
    xy: Array,
    keep_clear: tuple[VehicleStates, Array],
    random: np.random.Generator,
) -> None:
    """A trunk, a main cloud of foliage that leans towards the road, and two branches, one of them over the road.

    keep_clear: vehicles and poles.
    """
    vehicles, poles = keep_clear
    ground = float(plot.height(xy))
    _, away = plot.road_clearance(xy)
    base, reach, depth = (float(random.uniform(*r)) for r in (spec.base_m, spec.reach_m, spec.depth_m))
    density, bright = float(random.uniform(*spec.density_per_m)), float(random.uniform(0.25, 0.5))
    to_road = math.atan2(-away[1], -away[0])
    lean, spread = float(random.uniform(0.1, 0.55)), random.uniform(-0.7, 0.7, 2)
    clouds = [(to_road, lean * reach, 0.8 * reach, depth / 2, 0.0)]
    for angle in (to_road + spread[0], to_road + math.pi + spread[1]):
        share = float(random.uniform(0.4, 0.6))
        clouds.append((angle, (1 - share) * reach, share * reach, depth * share / 2, float(random.uniform(0.0, 0.4))))
    top = ground + base
    for angle, distance, wide, half_z, lift in clouds:
        center = xy + distance * np.array([math.cos(angle), math.sin(angle)])
        if (np.hypot(*(poles - center).T) < wide + _POLE_GAP_M).any():
            continue
        low = max(ground, float(plot.height(center))) + base + lift * depth
        low = max(low, _clear_height(vehicles, center, wide))
        top = max(top, low + half_z)
        heap.add(
            ELLIPSOID, (center[0], center[1], low + half_z), (wide, wide, half_z), density=density, reflectivity=bright
        )
    girth, half_z = float(random.uniform(0.1, 0.3)), (top - ground + 0.3) / 2
    heap.add(CYLINDER, (xy[0], xy[1], ground - 0.3 + half_z), (girth, girth, half_z), reflectivity=0.2)


def _clear_height(vehicles: VehicleStates, center: Array, radius: float) -> float:
    """Return the least height of foliage within a radius of a point that stays clear of every vehicle's roof."""
    if not len(vehicles):
        return -math.inf
    distance = np.hypot(*(vehicles.position[:, :2] - center).T)
    under = distance < radius + np.hypot(vehicles.size[:, 0], vehicles.size[:, 1]) / 2
    top = vehicles.position[:, 2] + vehicles.size[:, 2]
    return float(top[under].max()) + _ROOF_GAP_M if under.any() else -math.inf
