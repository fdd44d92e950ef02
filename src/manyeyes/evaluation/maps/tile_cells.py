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
from manyeyes.evaluation.maps.tile_sampling import Scenery, stands_of
from manyeyes.evaluation.study import recording_digest
from manyeyes.maps.store.columns_file import load_columns, save_columns
from manyeyes.maps.store.executors import Executor, map_blocks
from manyeyes.models import pretrained
from manyeyes.models.maps.map_model import Mapper

Ints = NDArray[np.int64]

COMPUTED_BY = (__name__, "manyeyes.evaluation.maps.tile_prediction")


@dataclass(frozen=True, eq=False)
class Drawing:
    """One tile as one row of a table draws it. drawn, truth: in the tile's frame; sent: bytes of each look that came to it."""

    row: str
    drawn: MapElements
    truth: MapElements
    sent: tuple[int, ...]


@dataclass(frozen=True)
class World:
    """Where drawings come from: opens the recording, and gives the true maps of its towns. Both are sent to other processes."""

    open: Callable[[], Recording]
    maps: Callable[[Recording], Mapping[str, MapElements]]


class Draw(Protocol):
    """What a study draws of a scenario at a seed."""

    @property
    def key(self) -> str:
        """Its whole setting, other weights than the map model's by what is in them: equal keys, equal drawings."""
        ...

    def __call__(self, mapper: Mapper, scenery: Scenery, scenario: str, seed: int) -> Sequence[Drawing]:
        """The drawings, row by row."""
        ...


@dataclass(frozen=True)
class TileUnit:
    """One cell to be made. data: the recording's digest."""

    world: World
    weights: str
    draw: Draw
    scenario: str
    seed: int
    folder: Path
    data: str


@dataclass(frozen=True, eq=False)
class TileCell:
    """The drawings of one scenario at one seed."""

    scenario: str
    seed: int
    drawings: tuple[Drawing, ...]


def run_tiles(
    world: World,
    weights: str,
    draw: Draw,
    seeds: Sequence[int],
    folder: Path,
    executor: Executor,
    progress: Callable[[int, int], None] | None = None,
    every: int = 1,
) -> tuple[TileCell, ...]:
    """The cells of every n-th scenario at each seed, in that order on any executor; those in the folder are not made again."""
    recording = world.open()
    data = recording_digest(recording)
    chosen = recording.scenarios[::every]
    units = [TileUnit(world, weights, draw, name, seed, folder, data) for name in chosen for seed in seeds]
    with executor.open() as runner:
        return tuple(map_blocks(run_unit, units, runner, progress))


def run_unit(unit: TileUnit) -> TileCell:
    """A cell: found, or made and kept."""
    path = cell_path(unit)
    kept = load_columns(path, _Columns)
    if kept is None:
        drawings = unit.draw(_mapper(unit.weights), _scenery(unit.world), unit.scenario, unit.seed)
        kept = _Columns.of(drawings)
        save_columns(path, kept)
    return TileCell(unit.scenario, unit.seed, kept.drawings())


def cell_path(unit: TileUnit) -> Path:
    """The file of a cell, named by all that it depends on."""
    said = repr(
        (_mapper(unit.weights).fingerprint.hex(), unit.draw.key, unit.seed, unit.data, source_digest(*COMPUTED_BY))
    )
    digest = hashlib.blake2b(said.encode(), digest_size=8).hexdigest()
    return unit.folder / f"{unit.scenario}-{unit.seed}-{digest}.npz"


@dataclass(frozen=True, eq=False)
class _Columns:
    """Drawings as arrays: elements of all rows one after the other, first (R + 1,) where those of each row begin."""

    row: tuple[str, ...]
    drawn: MapElements
    drawn_first: Ints
    truth: MapElements
    truth_first: Ints
    sent: Ints
    sent_first: Ints

    @classmethod
    def of(cls, drawings: Sequence[Drawing]) -> _Columns:
        return cls(
            tuple(one.row for one in drawings),
            MapElements.cat([one.drawn for one in drawings]),
            _firsts([one.drawn for one in drawings]),
            MapElements.cat([one.truth for one in drawings]),
            _firsts([one.truth for one in drawings]),
            np.array([size for one in drawings for size in one.sent], np.int64),
            _firsts([one.sent for one in drawings]),
        )

    def drawings(self) -> tuple[Drawing, ...]:
        return tuple(
            Drawing(
                row,
                self.drawn.take(np.arange(self.drawn_first[k], self.drawn_first[k + 1])),
                self.truth.take(np.arange(self.truth_first[k], self.truth_first[k + 1])),
                tuple(self.sent[self.sent_first[k] : self.sent_first[k + 1]].tolist()),
            )
            for k, row in enumerate(self.row)
        )


def _firsts(parts: Sequence[Sequence[int] | MapElements]) -> Ints:
    return np.cumsum([0, *(len(part) for part in parts)], dtype=np.int64)


@lru_cache(maxsize=4)
def _mapper(weights: str) -> Mapper:
    return pretrained.load_mapper(weights)


@lru_cache(maxsize=2)
def _scenery(world: World) -> Scenery:
    recording = world.open()
    return Scenery(recording, world.maps(recording), stands_of(recording))
