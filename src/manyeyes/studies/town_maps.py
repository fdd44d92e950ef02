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
from manyeyes.maps.elements.observation import Frame, Observation

if TYPE_CHECKING:
    from manyeyes.evaluation.maps.experiment import Cut
    from manyeyes.simulator.fleet.place import Place

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Ground:
    """Scenarios of one piece of world. town: whose true map is known by name. map: a file of the true map of elsewhere, in the
    recording's world; without either nobody knows what is true.

    first_xy: where the first agent begins, world metres.
    """

    name: str
    scenarios: tuple[str, ...]
    town: str | None
    first_xy: tuple[float, float]
    map: Path | None = None

    @cached_property
    def place(self) -> Place | None:
        """The whole town, or what the file shows: true map, ground of junctions, frame."""
        from manyeyes.simulator.fleet.place import place, place_of_map

        if self.town is not None:
            return place(self.town, None)
        return None if self.map is None else place_of_map(self.map)

    @property
    def frame(self) -> Frame:
        """The map's frame; where nothing is known of the place it lies off Africa."""
        return Frame() if self.place is None else self.place.frame

    @property
    def origin_xy(self) -> tuple[float, float]:
        """The map's zero in the recording's world, metres."""
        return self.first_xy if self.place is None else self.place.world_xy

    @property
    def cut(self) -> Cut | None:
        """The cut that maps get before they are judged, as in the studies."""
        from manyeyes.evaluation.maps.experiment import Cut

        return None if self.place is None else Cut(self.place.junctions, self.place.area)

    def truth(self, observations: Sequence[Observation], true_poses: Floats) -> MapElements | None:
        """The true elements that were in somebody's view, at true poses (N, 3) in the map's frame; cut."""
        from manyeyes.evaluation.maps.observed_area import SHORTEST_PART_M, clip, observed_area

        if self.place is None or self.cut is None:
            return None
        whole = self.place.in_area(min_line_m=SHORTEST_PART_M)
        return self.cut(clip(whole, observed_area([o.view for o in observations], true_poses)))


def grounds_of(
    recording: Recording, scenarios: Sequence[str], otherwise: str, real: Path | None = None
) -> list[Ground]:
    """The grounds of the scenarios: one a town, and one, called otherwise, of all whose names are no town's; real: its map."""
    groups: dict[str | None, list[str]] = {}
    for scenario in scenarios:
        groups.setdefault(town_named(scenario), []).append(scenario)
    found = []
    for town, own in groups.items():
        x, y = recording.snapshot(own[0], 0).frames[0].world_from_agent.translation[:2].round().tolist()
        mapped = real if town is None else None
        found.append(Ground(otherwise if town is None else town.lower(), tuple(own), town, (x, y), mapped))
    return found


def town_named(scenario: str) -> str | None:
    """The town that a scenario is named after, ``town05_0066`` after Town05; None where it is no town's name."""
    from manyeyes.simulator.scene.towns import GENERATED, TOWNS

    name = scenario.rpartition("_")[0]
    if name.startswith(GENERATED) and name[len(GENERATED) :].isdigit():
        return name
    return next((town for town in TOWNS if town.lower() == name.lower()), None)
