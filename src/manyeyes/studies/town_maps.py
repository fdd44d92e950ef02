# SPDX-License-Identifier: Apache-2.0
"""Where a recording was driven: its scenarios by town, each town with the true map that its name stands for, if it is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from manyeyes.datasets.base import Recording
from manyeyes.datatypes.map_element import MapElements
from manyeyes.maps.elements.observation import MapFrame, Observation

if TYPE_CHECKING:
    from manyeyes.evaluation.maps.experiment import CutPolicy
    from manyeyes.simulator.fleet.place import Place

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TownMap:
    """Scenarios of one piece of world. town: whose true map is known by name. map_file: a file of the true map of elsewhere, in the
    recording's world; without either no ground truth is known.

    start_xy: where the first agent begins, world metres.
    """

    name: str
    scenarios: tuple[str, ...]
    town: str | None
    start_xy: tuple[float, float]
    map_file: Path | None = None

    @cached_property
    def place(self) -> Place | None:
        """The whole town, or what the file shows: true map, ground of junctions, frame."""
        from manyeyes.simulator.fleet.place import load_place, load_place_from_map

        if self.town is not None:
            return load_place(self.town, None)
        return None if self.map_file is None else load_place_from_map(self.map_file)

    @property
    def frame(self) -> MapFrame:
        """The map's frame; where nothing is known of the place it lies off Africa."""
        return MapFrame() if self.place is None else self.place.frame

    @property
    def origin_xy(self) -> tuple[float, float]:
        """The map's zero in the recording's world, metres."""
        return self.start_xy if self.place is None else self.place.world_xy

    @property
    def cut_policy(self) -> CutPolicy | None:
        """The cut that maps get before they are evaluated, as in the studies."""
        from manyeyes.evaluation.maps.experiment import CutPolicy

        return None if self.place is None else CutPolicy(self.place.junctions, self.place.area)

    def observed_truth(self, observations: Sequence[Observation], true_poses: Floats) -> MapElements | None:
        """Return the true elements that were in view of any agent, at true poses (N, 3) in the map's frame; cut."""
        from manyeyes.evaluation.maps.observed_area import MIN_PART_LENGTH_M, clip_to_area, compute_observed_area

        if self.place is None or self.cut_policy is None:
            return None
        full_map = self.place.clip_to_area(min_line_m=MIN_PART_LENGTH_M)
        return self.cut_policy(
            clip_to_area(full_map, compute_observed_area([o.view for o in observations], true_poses))
        )


def group_by_town(
    recording: Recording, scenarios: Sequence[str], default_name: str, map_file: Path | None = None
) -> list[TownMap]:
    """Return the grounds of the scenarios: one a town, and one, called otherwise, of all whose names are no town's; map_file:
    its map.
    """
    groups: dict[str | None, list[str]] = {}
    for scenario in scenarios:
        groups.setdefault(find_named_town(scenario), []).append(scenario)
    town_maps = []
    for town, town_scenarios in groups.items():
        x, y = recording.snapshot(town_scenarios[0], 0).frames[0].world_from_agent.translation[:2].round().tolist()
        own_map_file = map_file if town is None else None
        town_maps.append(
            TownMap(default_name if town is None else town.lower(), tuple(town_scenarios), town, (x, y), own_map_file)
        )
    return town_maps


def find_named_town(scenario: str) -> str | None:
    """Return the town that a scenario is named after, ``town05_0066`` after Town05; None where it is no town's name."""
    from manyeyes.simulator.scene.towns import GENERATED, TOWNS

    name = scenario.rpartition("_")[0]
    if name.startswith(GENERATED) and name[len(GENERATED) :].isdigit():
        return name
    return next((town for town in TOWNS if town.lower() == name.lower()), None)
