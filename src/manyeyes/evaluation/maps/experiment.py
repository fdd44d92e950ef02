# SPDX-License-Identifier: Apache-2.0
"""One trial of a map study: a crowd in a place, the truth that it could see, and the cut that every method's map gets.

The cut policy is the truth's own (maps.truth, rule 5), applied to every method alike, since AP depends on it: lines are cut where
they enter or leave the ground of a junction; dividers inside junctions are dropped, as the truth has none; lines are cut to the
area of the place; parts below 2 m are dropped. The truth is cut to the union of all views at true poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.evaluation.maps.observed_area import MIN_PART_LENGTH_M, clip_to_area, compute_observed_area
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.roads.ground_truth import cut_elements
from manyeyes.simulator.fleet.config import CrowdConfig
from manyeyes.simulator.fleet.place import Place, clip_to_box, load_place
from manyeyes.simulator.fleet.simulate import Crowd, simulate_crowd

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry


@dataclass(frozen=True)
class FleetTrial:
    """Which crowd, where. size_m: side of the place's square area. view_label: what the study calls the crowd's views."""

    place: str
    num_observations: int
    seed: int
    size_m: float = 300.0
    view_label: str = "local"
    fleet_config: CrowdConfig = field(default_factory=CrowdConfig)

    def with_pose_noise(self, pose_sigma_m: float) -> FleetTrial:
        """Return the same trial with other pose errors, the heading's in proportion (1° a metre)."""
        fleet_config = replace(
            self.fleet_config, pose_sigma_m=pose_sigma_m, yaw_sigma_rad=float(np.radians(pose_sigma_m))
        )
        return replace(self, fleet_config=fleet_config)


@dataclass(frozen=True, eq=False)
class CutPolicy:
    """The cut policy of this module at one place: the ground of its junctions, and its area (x_min, y_min, x_max, y_max)."""

    junctions: BaseGeometry
    area: tuple[float, float, float, float]

    def __call__(self, elements: MapElements) -> MapElements:
        """Anybody's elements, cut."""
        cut = clip_to_box(cut_elements(elements, self.junctions, MIN_PART_LENGTH_M), self.area, MIN_PART_LENGTH_M)
        return cut.take(~((cut.kind == DIVIDER) & _inside(cut, self.junctions)))


@dataclass(frozen=True, eq=False)
class FleetExperiment:
    """A trial carried out: the crowd, and what its maps are held against."""

    trial: FleetTrial
    fleet: Crowd

    @property
    def place(self) -> Place:
        """The place of the trial, read once."""
        return self.fleet.place

    @property
    def observations(self) -> tuple[Observation, ...]:
        """The observations that a method receives."""
        return self.fleet.observations

    @cached_property
    def truth(self) -> MapElements:
        """The true elements that were in view of any agent, at the time of the last observation."""
        last = max((o.time_ns for o in self.observations), default=0)
        full_map = self.place.clip_to_area(self.fleet.changing_map.at(last), min_line_m=MIN_PART_LENGTH_M)
        area = compute_observed_area([o.view for o in self.observations], self.fleet.true_poses)
        return self.cut_policy(clip_to_area(full_map, area))

    @property
    def cut_policy(self) -> CutPolicy:
        """The cut policy here."""
        return CutPolicy(self.place.junctions, self.place.area)


@lru_cache(maxsize=2)
def run_trial(trial: FleetTrial) -> FleetExperiment:
    """Return the trial's crowd, driven; the last two are kept, as a study asks for one trial with many settings in turn."""
    return FleetExperiment(
        trial,
        simulate_crowd(load_place(trial.place, trial.size_m), trial.num_observations, trial.fleet_config, trial.seed),
    )


def replace_poses(observations: Sequence[Observation], poses: np.ndarray, sigma_m: float = 0.02) -> list[Observation]:
    """Return the same observations with other poses (N, 3), claimed with a small sigma (m, and rad): an oracle's."""
    covariance = np.diag([sigma_m**2, sigma_m**2, (sigma_m / 10) ** 2])
    return [replace(o, pose=pose, covariance=covariance) for o, pose in zip(observations, poses)]


def _inside(elements: MapElements, ground: BaseGeometry) -> np.ndarray:
    """Return (N,) whether the middle of each element lies on a ground."""
    import shapely

    middles = [_middle(elements.polyline(row)) for row in range(len(elements))]
    if not middles:
        return np.zeros(0, dtype=bool)
    shapely.prepare(ground)
    return np.asarray(shapely.contains(ground, shapely.points(np.array(middles))))


def _middle(line: np.ndarray) -> np.ndarray:
    """Return the point halfway along."""
    arc_length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    return np.array([np.interp(arc_length[-1] / 2, arc_length, line[:, axis]) for axis in (0, 1)])
