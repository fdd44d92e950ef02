# SPDX-License-Identifier: Apache-2.0
"""Cells of the map model's studies: what was drawn of one scenario's tiles at one seed, kept as a file that a study finds again.

A cell holds drawings and truths, not numbers: judging is cheap beside drawing, and pictures want the lines. Its file's name
holds a digest of the weights, the recording, the setting and the sources that drawings follow from.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from manyeyes._source import source_digest
from manyeyes.datasets.base import Recording
from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.tile_sampling import TileSource, collect_observer_poses
from manyeyes.evaluation.study import hash_recording
from manyeyes.maps.store.columns_file import load_columns, save_columns
from manyeyes.maps.store.executors import Executor, map_blocks
from manyeyes.models import pretrained
from manyeyes.models.maps.map_model import MapModel

Ints = NDArray[np.int64]

COMPUTED_BY = (__name__, "manyeyes.evaluation.maps.tile_prediction")


@dataclass(frozen=True, eq=False)
class TilePrediction:
    """The prediction of one tile for one row of a table. predicted, truth: in the tile's frame; frame_bytes: bytes of each frame
    that the tile was predicted from.
    """

    row_name: str
    predicted: MapElements
    truth: MapElements
    frame_bytes: tuple[int, ...]


@dataclass(frozen=True)
class RecordingSource:
    """Where drawings come from: opens the recording, and gives the true maps of its towns. Both are sent to other processes."""

    open_recording: Callable[[], Recording]
    load_maps: Callable[[Recording], Mapping[str, MapElements]]


class TilePredictor(Protocol):
    """What a study draws of a scenario at a seed."""

    @property
    def cache_key(self) -> str:
        """Its whole setting, other weights than the map model's by what is in them: equal keys, equal drawings."""
        ...

    def __call__(self, map_model: MapModel, source: TileSource, scenario: str, seed: int) -> Sequence[TilePrediction]:
        """The drawings, row by row."""
        ...


@dataclass(frozen=True)
class TileStudyJob:
    """One cell to be made. recording_hash: the recording's digest."""

    recording_source: RecordingSource
    weights: str
    predictor: TilePredictor
    scenario: str
    seed: int
    results_folder: Path
    recording_hash: str


@dataclass(frozen=True, eq=False)
class TileStudyResult:
    """The drawings of one scenario at one seed."""

    scenario: str
    seed: int
    predictions: tuple[TilePrediction, ...]


def run_tile_study(
    recording_source: RecordingSource,
    weights: str,
    predictor: TilePredictor,
    seeds: Sequence[int],
    folder: Path,
    executor: Executor,
    progress: Callable[[int, int], None] | None = None,
    scenario_stride: int = 1,
) -> tuple[TileStudyResult, ...]:
    """The cells of every n-th scenario at each seed, in that order on any executor; those in the folder are not made again."""
    recording = recording_source.open_recording()
    recording_hash = hash_recording(recording)
    selected = recording.scenarios[::scenario_stride]
    jobs = [
        TileStudyJob(recording_source, weights, predictor, name, seed, folder, recording_hash)
        for name in selected
        for seed in seeds
    ]
    with executor.open() as session:
        return tuple(map_blocks(run_tile_job, jobs, session, progress))


def run_tile_job(job: TileStudyJob) -> TileStudyResult:
    """A cell: found, or made and kept."""
    path = tile_result_path(job)
    stored = load_columns(path, _PredictionColumns)
    if stored is None:
        predictions = job.predictor(
            _load_map_model(job.weights), _load_source(job.recording_source), job.scenario, job.seed
        )
        stored = _PredictionColumns.of(predictions)
        save_columns(path, stored)
    return TileStudyResult(job.scenario, job.seed, stored.to_predictions())


def tile_result_path(job: TileStudyJob) -> Path:
    """The file of a cell, named by all that it depends on."""
    content = repr(
        (
            _load_map_model(job.weights).fingerprint.hex(),
            job.predictor.cache_key,
            job.seed,
            job.recording_hash,
            source_digest(*COMPUTED_BY),
        )
    )
    digest = hashlib.blake2b(content.encode(), digest_size=8).hexdigest()
    return job.results_folder / f"{job.scenario}-{job.seed}-{digest}.npz"


@dataclass(frozen=True, eq=False)
class _PredictionColumns:
    """Drawings as arrays: elements of all rows one after the other, first (R + 1,) where those of each row begin."""

    row_name: tuple[str, ...]
    predicted: MapElements
    predicted_offsets: Ints
    truth: MapElements
    truth_offsets: Ints
    frame_bytes: Ints
    frame_bytes_offsets: Ints

    @classmethod
    def of(cls, predictions: Sequence[TilePrediction]) -> _PredictionColumns:
        return cls(
            tuple(one.row_name for one in predictions),
            MapElements.cat([one.predicted for one in predictions]),
            _make_offsets([one.predicted for one in predictions]),
            MapElements.cat([one.truth for one in predictions]),
            _make_offsets([one.truth for one in predictions]),
            np.array([size for one in predictions for size in one.frame_bytes], np.int64),
            _make_offsets([one.frame_bytes for one in predictions]),
        )

    def to_predictions(self) -> tuple[TilePrediction, ...]:
        return tuple(
            TilePrediction(
                row,
                self.predicted.take(np.arange(self.predicted_offsets[k], self.predicted_offsets[k + 1])),
                self.truth.take(np.arange(self.truth_offsets[k], self.truth_offsets[k + 1])),
                tuple(self.frame_bytes[self.frame_bytes_offsets[k] : self.frame_bytes_offsets[k + 1]].tolist()),
            )
            for k, row in enumerate(self.row_name)
        )


def _make_offsets(parts: Sequence[Sequence[int] | MapElements]) -> Ints:
    return np.cumsum([0, *(len(part) for part in parts)], dtype=np.int64)


@lru_cache(maxsize=4)
def _load_map_model(weights: str) -> MapModel:
    return pretrained.load_map_model(weights)


@lru_cache(maxsize=2)
def _load_source(recording_source: RecordingSource) -> TileSource:
    recording = recording_source.open_recording()
    return TileSource(recording, recording_source.load_maps(recording), collect_observer_poses(recording))
