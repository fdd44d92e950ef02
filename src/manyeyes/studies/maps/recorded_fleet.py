# SPDX-License-Identifier: Apache-2.0
"""Observations of a recorded fleet in a town and the map of each method: one job of the study 'full-map', stored as files."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.detection.one_instant import SingleFramePerScenario
from manyeyes.evaluation.maps.registry import fuse_observations, make_tuned_settings
from manyeyes.maps.elements.observation import Observation
from manyeyes.studies.engine.cells import Cell, CellStore
from manyeyes.studies.map_pipeline import MapBuildConfig, build_map
from manyeyes.studies.maps.fleet_cells import method_source
from manyeyes.studies.maps.tile_cells import RecordingSource, load_map_model
from manyeyes.studies.town_maps import TownMap

COMPUTED_BY = ("manyeyes.studies.map_pipeline", "manyeyes.evaluation.detection.one_instant")


@dataclass(frozen=True, eq=False)
class FleetMap:
    """A method's map of one town, cut as the truth is, and the truth in view of these agents. num_observations: observations."""

    fused: MapElements
    truth: MapElements
    num_observations: int
    bytes_per_message: float


@dataclass(frozen=True, eq=False)
class _ObservedTown:
    """What the map server received of a town's agents, and what of the truth was in their views."""

    observations: tuple[Observation, ...]
    truth: MapElements
    bytes_per_message: float


@dataclass(frozen=True)
class FleetMapJob:
    """One town, map mode and seed, fused by all methods. recording_hash: the recording's digest."""

    source: RecordingSource
    weights: str
    town_map: TownMap
    map_mode: str
    seed: int
    methods: tuple[str, ...]
    store: CellStore
    recording_hash: str

    def __call__(self) -> tuple[FleetMap, ...]:
        """Load or compute the maps in the order of the methods."""
        key = load_map_model(self.weights).fingerprint.hex(), self.recording_hash, self.town_map.scenarios
        cell = Cell[_ObservedTown](self._cell_name("seen"), _ObservedTown, key, COMPUTED_BY)
        town = self.store.load_or_compute(cell, self._observe)
        ids, settings, out = "".join(sorted(o.id for o in town.observations)), make_tuned_settings(), []
        for method in self.methods:
            key = ids, method, settings.config_of(method), method_source(method)
            cell = Cell[MapElements](self._cell_name(method), MapElements, key, (__name__, *COMPUTED_BY))
            fused = self.store.load_or_compute(cell, partial(self._fuse, method, town.observations))
            out.append(FleetMap(fused, town.truth, len(town.observations), town.bytes_per_message))
        return tuple(out)

    def _cell_name(self, content: str) -> str:
        return f"{self.town_map.name}-{self.map_mode}-{self.seed}-{content}"

    def _observe(self) -> _ObservedTown:
        recording = SingleFramePerScenario(self.source.open_recording(), self.seed)
        config = MapBuildConfig(load_map_model(self.weights), self.map_mode, frame_stride=1)
        built = build_map(recording, self.town_map, config)
        assert built.truth is not None
        return _ObservedTown(tuple(built.map_server.observations), built.truth, built.stats.bytes_per_message)

    def _fuse(self, method: str, observations: tuple[Observation, ...]) -> MapElements:
        fused = fuse_observations(method, observations, make_tuned_settings(), self.town_map.frame)
        cut_policy = self.town_map.cut_policy
        assert cut_policy is not None
        return cut_policy(fused.select_published().elements)
