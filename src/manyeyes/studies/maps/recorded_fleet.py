# SPDX-License-Identifier: Apache-2.0
"""Observations of a recorded fleet in a town and the map of each method: one job of the study 'full-map', stored as files."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from manyeyes._source import source_digest
from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.detection.one_instant import SingleFramePerScenario
from manyeyes.evaluation.maps.map_cells import hash_map_sources as fusion_digest
from manyeyes.evaluation.maps.registry import fuse_observations, make_tuned_settings
from manyeyes.evaluation.maps.tile_cells import RecordingSource
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.elements.observation_file import read_observations, write_observations
from manyeyes.maps.store.columns_file import load_columns, save_columns
from manyeyes.models import pretrained
from manyeyes.models.maps.map_model import MapModel
from manyeyes.studies.map_pipeline import MapBuildConfig, build_map
from manyeyes.studies.town_maps import TownMap

COMPUTED_BY = ("manyeyes.studies.map_pipeline", "manyeyes.evaluation.detection.one_instant")


@dataclass(frozen=True)
class FleetMapJob:
    """One town, survey and seed, fused by all methods. recording_hash: the recording's digest; results_folder: where files are
    kept.
    """

    recording_source: RecordingSource
    weights: str
    town_map: TownMap
    map_mode: str
    seed: int
    methods: tuple[str, ...]
    results_folder: Path
    recording_hash: str


@dataclass(frozen=True, eq=False)
class FleetMap:
    """A method's map of one town, cut as the truth is, and the truth in view of these agents. num_observations: observations."""

    fused: MapElements
    truth: MapElements
    num_observations: int
    bytes_per_message: float


@dataclass(frozen=True, eq=False)
class _ObservedTruth:
    elements: MapElements
    bytes_per_message: np.ndarray


def run_fleet_job(job: FleetMapJob) -> tuple[FleetMap, ...]:
    """The maps of a unit in the order of its methods: found, or made and kept."""
    observations, truth = _load_or_observe(job)
    settings, cut_policy = make_tuned_settings(), job.town_map.cut_policy
    assert cut_policy is not None
    observation_ids = "".join(sorted(o.id for o in observations))
    out = []
    for method in job.methods:
        key = repr((observation_ids, method, settings.config_of(method), fusion_digest(method)))
        path = _make_path(job, method, key)
        fused = load_columns(path, MapElements)
        if fused is None:
            fused = cut_policy(
                fuse_observations(method, observations, settings, job.town_map.frame).select_published().elements
            )
            save_columns(path, fused)
        out.append(FleetMap(fused, truth.elements, len(observations), float(truth.bytes_per_message)))
    return tuple(out)


def _load_or_observe(job: FleetMapJob) -> tuple[tuple[Observation, ...], _ObservedTruth]:
    """What the cartographer took of a unit's agents, and what of the truth was in their views."""
    key = repr(
        (
            _load_map_model(job.weights).fingerprint.hex(),
            job.recording_hash,
            job.town_map.scenarios,
            source_digest(*COMPUTED_BY),
        )
    )
    path = _make_path(job, "seen", key)
    truth = load_columns(path, _ObservedTruth)
    if truth is None:
        recording = SingleFramePerScenario(job.recording_source.open_recording(), job.seed)
        built = build_map(
            recording, job.town_map, MapBuildConfig(_load_map_model(job.weights), job.map_mode, frame_stride=1)
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        write_observations(path.with_suffix(".parquet"), built.map_server.observations, job.town_map.frame)
        assert built.truth is not None
        truth = _ObservedTruth(built.truth, np.array(built.stats.bytes_per_message))
        save_columns(path, truth)
    return read_observations(path.with_suffix(".parquet")).observations, truth


def _make_path(job: FleetMapJob, content_name: str, key: str) -> Path:
    digest = hashlib.blake2b(key.encode(), digest_size=8).hexdigest()
    return job.results_folder / f"{job.town_map.name}-{job.map_mode}-{job.seed}-{content_name}-{digest}.npz"


@lru_cache(maxsize=2)
def _load_map_model(weights: str) -> MapModel:
    return pretrained.load_map_model(weights)
