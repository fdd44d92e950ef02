# SPDX-License-Identifier: Apache-2.0
"""Named worlds: what a scene holds beside its roads, and how its ground and its vehicles vary."""

from __future__ import annotations

from dataclasses import dataclass, replace

from manyeyes.datatypes import ConfigError
from manyeyes.simulator.scene.canopy import CanopySpec
from manyeyes.simulator.scene.roadside_objects import RoadsideObjectSpec
from manyeyes.simulator.scene.street_furniture import StreetFurnitureSpec
from manyeyes.simulator.scene.terrain import TerrainSpec
from manyeyes.simulator.scene.vehicle_market import CLASSIC_MARKET, WORLD_MARKET, VehicleMarket
from manyeyes.simulator.scene.yards import YardSpec


@dataclass(frozen=True)
class EnvironmentSpec:
    """A world. Numbers of things are multiplied with the clutter of the scenario, those of trees in canopies excepted.

    market: which vehicles there are. parked_fraction: range of the mean share of parking places that are taken.
    min_moving_fraction: of the vehicles of the first frame; parked ones beyond are left out. roadside: buildings, walls, poles.
    terrain, canopy, furniture, yards: None for none. other_vehicles: whether there are vehicles that are not agents.
    """

    market: VehicleMarket = CLASSIC_MARKET
    parked_fraction: tuple[float, float] = (0.1, 0.6)
    min_moving_fraction: float = 0.5
    roadside: RoadsideObjectSpec = RoadsideObjectSpec()
    terrain: TerrainSpec | None = None
    canopy: CanopySpec | None = None
    furniture: StreetFurnitureSpec | None = None
    yards: YardSpec | None = None
    other_vehicles: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.min_moving_fraction <= 1:
            raise ConfigError(
                f"EnvironmentSpec needs min_moving_fraction within 0 … 1; got {self.min_moving_fraction}."
            )


_URBAN = EnvironmentSpec(
    market=WORLD_MARKET,
    parked_fraction=(0.2, 0.9),
    min_moving_fraction=0.3,
    roadside=RoadsideObjectSpec(buildings=16, walls=8, poles=50, trees=16, hedges=0),
    terrain=TerrainSpec(),
    canopy=CanopySpec(),
    furniture=StreetFurnitureSpec(),
    yards=YardSpec(),
)

# A name stands for its world for good: another world takes another name.
ENVIRONMENTS: dict[str, EnvironmentSpec] = {
    "classic": EnvironmentSpec(),
    "urban-2026": _URBAN,
    # The same without any vehicle but the agents.
    "urban-2026-no-vehicles": replace(_URBAN, other_vehicles=False),
}


def environment_spec(name: str) -> EnvironmentSpec:
    """Return a world by its name in ENVIRONMENTS."""
    if name not in ENVIRONMENTS:
        raise ConfigError(f"No environment '{name}'; choose one of {', '.join(ENVIRONMENTS)}.")
    return ENVIRONMENTS[name]
