# SPDX-License-Identifier: Apache-2.0
"""Cells of the map model's studies: the tiles that were predicted of one scenario at one seed.

A cell holds predictions and truths, not metrics: evaluating is cheap beside predicting, and figures need the lines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

from manyeyes.datasets.base import Recording
from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.tile_prediction import ScenarioPredictions, TilePrediction
from manyeyes.evaluation.maps.tile_sampling import TileSource, collect_observer_poses
from manyeyes.models import pretrained
from manyeyes.models.maps.map_model import MapModel
from manyeyes.studies.engine.cells import Cell, CellStore, hash_recording

COMPUTED_BY = (__name__, "manyeyes.evaluation.maps.tile_prediction")


@dataclass(frozen=True)
class RecordingSource:
    """Where tiles come from: opens the recording, and gives the true maps of its towns. Both are sent to other processes."""

    open_recording: Callable[[], Recording]
    load_maps: Callable[[Recording], Mapping[str, MapElements]]


class TilePredictor(Protocol):
    """What a study predicts of a scenario at a seed."""

    @property
    def cache_key(self) -> str:
        """Its whole setting, other weights than the map model's by what is in them: equal keys, equal predictions."""
        ...

    def __call__(self, map_model: MapModel, source: TileSource, scenario: str, seed: int) -> Sequence[TilePrediction]:
        """Return the predictions, row by row."""
        ...


@dataclass(frozen=True)
class TileJob:
    """One cell, loaded or computed. recording_hash: the recording's digest."""

    source: RecordingSource
    weights: str
    predictor: TilePredictor
    scenario: str
    seed: int
    store: CellStore
    recording_hash: str

    @property
    def cell(self) -> Cell[ScenarioPredictions]:
        """The cell and what it depends on."""
        weights = load_map_model(self.weights).fingerprint.hex()
        key = (weights, self.predictor.cache_key, self.seed, self.recording_hash)
        return Cell(f"{self.scenario}-{self.seed}", ScenarioPredictions, key, COMPUTED_BY)

    def __call__(self) -> ScenarioPredictions:
        """Load or compute the cell."""
        return self.store.load_or_compute(self.cell, self._predict)

    def _predict(self) -> ScenarioPredictions:
        model, source = load_map_model(self.weights), _load_source(self.source)
        predictions = tuple(self.predictor(model, source, self.scenario, self.seed))
        return ScenarioPredictions(self.scenario, self.seed, predictions)


def make_tile_jobs(
    source: RecordingSource,
    weights: str,
    predictor: TilePredictor,
    seeds: Sequence[int],
    store: CellStore,
    scenario_stride: int = 1,
) -> list[TileJob]:
    """Make the jobs of every n-th scenario at each seed, in that order."""
    recording = source.open_recording()
    recording_hash = hash_recording(recording)
    return [
        TileJob(source, weights, predictor, name, seed, store, recording_hash)
        for name in recording.scenarios[::scenario_stride]
        for seed in seeds
    ]


@lru_cache(maxsize=4)
def load_map_model(weights: str) -> MapModel:
    """Load a map model once a process."""
    return pretrained.load_map_model(weights)


@lru_cache(maxsize=2)
def _load_source(source: RecordingSource) -> TileSource:
    recording = source.open_recording()
    return TileSource(recording, source.load_maps(recording), collect_observer_poses(recording))
