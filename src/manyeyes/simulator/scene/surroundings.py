# SPDX-License-Identifier: Apache-2.0
"""Everything of a scene that stands still and is not a vehicle, as its environment asks for it."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from manyeyes.ops.raycast import Primitives
from manyeyes.simulator.scene.canopy import place_canopy
from manyeyes.simulator.scene.environment import EnvironmentSpec
from manyeyes.simulator.scene.placement import PlacementGrid
from manyeyes.simulator.scene.roadside_objects import RoadsideObjectSpec, place_roadside_objects
from manyeyes.simulator.scene.street_furniture import StreetFurnitureSpec, place_street_furniture
from manyeyes.simulator.scene.vehicles import VehicleStates
from manyeyes.simulator.scene.yards import YardSpec, place_yards

Array = NDArray[np.float64]
SpecT = TypeVar("SpecT", RoadsideObjectSpec, StreetFurnitureSpec, YardSpec)

_VEHICLE_CLEARANCE_M = 0.2


def place_surroundings(
    plot: PlacementGrid,
    world: EnvironmentSpec,
    clutter: float,
    setback_m: float,
    middle: Array,
    states: tuple[VehicleStates, ...],
    poles: Array,
    key: tuple[int | str, ...],
) -> Primitives:
    """Return the solids of a scene.

    Args:
        plot: what is taken by vehicles that stand still and by poles; everything placed here is added.
        world: what there is.
        clutter: factor on its numbers.
        setback_m: of the buildings' fronts from the pavement.
        middle: (2,) of the scene, metres.
        states: vehicles of all instants; none of them meets anything but open air where the world is not the classic one.
        poles: (K, 2) of roadside units, metres.
        key: of the draws.
    """
    solids = []
    if world.canopy or world.furniture or world.yards:
        everyone = VehicleStates.cat(list(states))
        for position, size, yaw in zip(everyone.position, everyone.size, everyone.yaw):
            half = float(size[0]) / 2 + _VEHICLE_CLEARANCE_M, float(size[1]) / 2 + _VEHICLE_CLEARANCE_M
            plot.occupy_all(position[:2], half, float(yaw))
        if world.canopy:
            solids.append(place_canopy(plot, world.canopy, middle, everyone, poles, key))
    if world.furniture:
        solids.append(place_street_furniture(plot, _scale(world.furniture, clutter), middle, key))
    if world.yards:
        solids.append(place_yards(plot, _scale(world.yards, clutter), middle, key))
    wanted = replace(_scale(world.roadside, clutter), setback_m=setback_m)
    solids.append(place_roadside_objects(plot, wanted, middle, key))
    return Primitives.cat(solids)


def _scale(spec: SpecT, factor: float) -> SpecT:
    """Return a specification with every count times a factor."""
    counts = {name: round(factor * value) for name, value in vars(spec).items() if isinstance(value, int)}
    return replace(spec, **counts)


__all__ = ["place_surroundings"]
