# SPDX-License-Identifier: Apache-2.0
"""What a crowd says of a town, and the map that each method makes of it: one unit of the study 'whole', kept as files."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from manyeyes._source import source_digest
from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.detection.one_instant import OneInstant
from manyeyes.evaluation.maps.map_cells import code_digest as fusion_digest
from manyeyes.evaluation.maps.registry import map_of, tuned
from manyeyes.evaluation.maps.tile_cells import World
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.elements.observation_file import read_observations, write_observations
from manyeyes.maps.store.columns_file import load_columns, save_columns
from manyeyes.models import pretrained
from manyeyes.models.maps.map_model import Mapper
from manyeyes.studies.map_pipeline import Building, build_map
from manyeyes.studies.town_maps import Ground

COMPUTED_BY = ("manyeyes.studies.map_pipeline", "manyeyes.evaluation.detection.one_instant")


@dataclass(frozen=True)
class CrowdUnit:
    """One town, survey and seed, fused by all methods. data: the recording's digest; folder: where files are kept."""

    world: World
    weights: str
    ground: Ground
    survey: str
    seed: int
    methods: tuple[str, ...]
    folder: Path
    data: str


@dataclass(frozen=True, eq=False)
class CrowdMap:
    """A method's map of one town, cut as the truth is, and the truth in view of these agents. seen: observations."""

    made: MapElements
    truth: MapElements
    seen: int
    bytes_per_message: float


@dataclass(frozen=True, eq=False)
class _Truth:
    elements: MapElements
    bytes_per_message: np.ndarray


def run_unit(unit: CrowdUnit) -> tuple[CrowdMap, ...]:
    """The maps of a unit in the order of its methods: found, or made and kept."""
    observations, truth = _seen(unit)
    settings, cut = tuned(), unit.ground.cut
    assert cut is not None
    said = "".join(sorted(o.id for o in observations))
    out = []
    for method in unit.methods:
        key = repr((said, method, settings.of(method), fusion_digest(method)))
        path = _path(unit, method, key)
        made = load_columns(path, MapElements)
        if made is None:
            made = cut(map_of(method, observations, settings, unit.ground.frame).published().elements)
            save_columns(path, made)
        out.append(CrowdMap(made, truth.elements, len(observations), float(truth.bytes_per_message)))
    return tuple(out)


def _seen(unit: CrowdUnit) -> tuple[tuple[Observation, ...], _Truth]:
    """What the cartographer took of a unit's agents, and what of the truth was in their views."""
    key = repr((_mapper(unit.weights).fingerprint.hex(), unit.data, unit.ground.scenarios, source_digest(*COMPUTED_BY)))
    path = _path(unit, "seen", key)
    truth = load_columns(path, _Truth)
    if truth is None:
        recording = OneInstant(unit.world.open(), unit.seed)
        built = build_map(recording, unit.ground, Building(_mapper(unit.weights), unit.survey, every=1))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_observations(path.with_suffix(".parquet"), built.cartographer.observations, unit.ground.frame)
        assert built.truth is not None
        truth = _Truth(built.truth, np.array(built.numbers.bytes_per_message))
        save_columns(path, truth)
    return read_observations(path.with_suffix(".parquet")).observations, truth


def _path(unit: CrowdUnit, what: str, key: str) -> Path:
    digest = hashlib.blake2b(key.encode(), digest_size=8).hexdigest()
    return unit.folder / f"{unit.ground.name}-{unit.survey}-{unit.seed}-{what}-{digest}.npz"


@lru_cache(maxsize=2)
def _mapper(weights: str) -> Mapper:
    return pretrained.load_mapper(weights)
