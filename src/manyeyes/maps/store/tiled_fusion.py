# SPDX-License-Identifier: Apache-2.0
"""The fusion of a city, tile by tile, with the map that one piece would give.

Phase A solves the pose of each observation in the block of tiles that it stands in (its home), given all observations that
its lines can meet: a gross search, then sweeps, each of which starts from what all blocks found in the sweep before. Phase B
finds the stations of each block from all observations that reach into it. Then one program links the stations of all blocks,
which are few, so that no line is cut at a border. Every step is a pure function of a block's inputs; its result is kept under
a hash of them, so that a run that was killed, or one after a few more observations, does only what is new.
Source: specs/maps.md 3.5 and 5.2.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from manyeyes._source import source_digest
from manyeyes.datatypes import ConfigError
from manyeyes.maps.elements.observation import Frame
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import FuseConfig, assemble
from manyeyes.maps.fusion.observation_arrays import Sightings, gather
from manyeyes.maps.fusion.pose_optimization import Alignment, advance, merge, search
from manyeyes.maps.fusion.stations import Area, StationTable, find_stations
from manyeyes.maps.store.columns_file import load_columns, save_columns
from manyeyes.maps.store.executors import Executor, ProcessPool, Runner, map_blocks
from manyeyes.maps.store.log_index import Standing
from manyeyes.maps.store.observation_log import TILE_M, StoreError, read_standing, tile_of

T = TypeVar("T")
Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

#: What releases name as their origin.
ALGORITHM = "manyeyes.fuse/1"

#: Called as steps go on: (name of the step, blocks done, blocks in all).
StepProgress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class TileConfig:
    """tile_m: side of a tile. tiles_a_block: tiles along a block's side; a block is what one worker does at a time.

    margin_m: beyond their reaches, how far apart two observations may claim to stand and still influence each other's pose:
    two gross searches of 4.5 m along each axis, the cells of the bound on observations, and the radius in which the looks of
    one agent are counted. halo_m: how far outside a block an observation's lines may lie and still shape the block's stations.
    """

    tile_m: float = TILE_M
    tiles_a_block: int = 2
    margin_m: float = 56.0
    halo_m: float = 64.0

    def __post_init__(self) -> None:
        if not (self.tile_m > 0 and self.tiles_a_block >= 1 and self.margin_m >= 0 and self.halo_m >= 0):
            raise ConfigError(f"TileConfig needs positive sizes and at least one tile a block; got {self}.")


@dataclass(frozen=True, eq=False)
class Block:
    """One worker's part: which observations it reads, which of them are at home in it, and its ground.

    log: the folder of segments. standing: rows of the index that it reads, ids ascending. home: ids of those at home.
    area: (x0, y0, x1, y1) metres. work: folder for results of steps.
    """

    log: Path
    standing: Standing
    home: tuple[str, ...]
    area: Area
    work: Path
    config: FuseConfig

    @property
    def key(self) -> str:
        """Hash of what the block is about: its observations, its home, its area, the settings, the code of the steps."""
        code = f"{ALGORITHM} {source_digest(__name__)}"
        text = "|".join((code, repr(self.config), repr(self.area), ",".join(self.home), ",".join(self.standing.ids)))
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


@dataclass(frozen=True, eq=False)
class _Step:
    """A block with what the step before found: number -1 is the gross search, then sweeps; None: stations."""

    block: Block
    state: Alignment | None
    number: int | None

    @property
    def path(self) -> Path:
        """Where the result is kept."""
        digest = hashlib.blake2b(self.block.key.encode(), digest_size=16)
        digest.update(str(self.number).encode())
        if self.state is not None:
            digest.update(",".join(self.state.ids).encode())
            for f in fields(Alignment):
                value = getattr(self.state, f.name)
                if isinstance(value, np.ndarray):
                    digest.update((value + 0.0).tobytes())
        return self.block.work / f"{digest.hexdigest()}.npz"


def fuse_tiles(
    log: Path,
    standing: Standing,
    frame: Frame,
    work: Path,
    config: FuseConfig | None = None,
    tiles: TileConfig = TileConfig(),
    executor: Executor | None = None,
    progress: StepProgress | None = None,
) -> VectorMap:
    """The map of the log's observations that ``standing`` lists; ``log`` and ``work`` are folders that all workers see."""
    config = config or FuseConfig()
    blocks = make_blocks(log, standing, work, config, tiles)
    used: set[str] = set()
    with (executor or ProcessPool()).open() as runner:
        tables = _tables(blocks, config, runner, progress, used)
    # Steps that this map did not need are those of maps before it; sightings are large and quickly made again.
    for path in sorted(work.glob("*.npz")):
        if path.name not in used:
            path.unlink()
    return assemble(StationTable.cat(tables), config, frame) if tables else VectorMap.empty(frame)


def make_blocks(log: Path, standing: Standing, work: Path, config: FuseConfig, tiles: TileConfig) -> list[Block]:
    """Every block that an observation stands in or reaches into, by column and row; empty ones are left out."""
    size = tiles.tile_m * tiles.tiles_a_block
    home = tile_of(standing.xy, size)
    wide = standing.reach_m + tiles.halo_m
    low, high = tile_of(standing.xy - wide[:, None], size), tile_of(standing.xy + wide[:, None], size)
    places = {
        (x, y)
        for (x0, y0), (x1, y1) in zip(low.tolist(), high.tolist())
        for x in range(x0, x1 + 1)
        for y in range(y0, y1 + 1)
    }
    blocks = []
    for x, y in sorted(places):
        area = (x * size, y * size, (x + 1) * size, (y + 1) * size)
        at_home = np.flatnonzero((home == (x, y)).all(1))
        chosen = _reaching(standing, area, tiles.halo_m)
        chosen[at_home] = True
        chosen |= _meeting(standing, at_home, tiles.margin_m)
        rows = np.flatnonzero(chosen)
        if len(rows):
            ids = tuple(standing.ids[k] for k in at_home.tolist())
            blocks.append(Block(log, _take(standing, rows), ids, area, work, config))
    return blocks


def _tables(
    blocks: Sequence[Block], config: FuseConfig, runner: Runner, progress: StepProgress | None, used: set[str]
) -> list[StationTable]:
    """Stations of all blocks: search, sweeps with a barrier after each, stations; ``used`` gets the names of all results."""

    def each(steps: Sequence[_Step], name: str, fn: Callable[[_Step], None], kind: type[T]) -> list[T]:
        told = None if progress is None else partial(progress, name)
        map_blocks(fn, steps, runner, told)
        used.update(step.path.name for step in steps)
        return [_result(step, fn, kind) for step in steps]

    if not blocks:
        return []
    homes = [b for b in blocks if b.home]
    steps = [_Step(b, None, -1) for b in homes]
    state = merge(each(steps, "search", _pose_step, Alignment), config.align)
    for number in range(config.align.steps):
        steps = [_Step(b, _part(state, b), number) for b in homes]
        state = merge(each(steps, f"step {number + 1}", _pose_step, Alignment), config.align, number)
    return each([_Step(b, _part(state, b), None) for b in blocks], "stations", _station_step, StationTable)


def _part(state: Alignment, block: Block) -> Alignment:
    """The rows of a state that a block reads."""
    return state.take(state.rows(block.standing.ids))


def _result(step: _Step, fn: Callable[[_Step], None], kind: type[T]) -> T:
    """What a step left in the work folder; done here where it left nothing whole, as after a loss of power."""
    found = load_columns(step.path, kind)
    if found is None:
        step.path.unlink(missing_ok=True)
        fn(step)
        found = load_columns(step.path, kind)
    if found is None:
        raise StoreError(f"{step.path}: expected a step's result, but it cannot be written or read; check the disk.")
    return found


def _pose_step(step: _Step) -> None:
    """Do the search or a sweep for a block's home, unless its result is there."""
    if step.path.exists():
        return
    sightings = _sightings(step.block)
    row = {name: k for k, name in enumerate(sightings.ids)}
    home = np.array([row[name] for name in step.block.home], np.int64)
    if step.state is None or step.number is None:
        found = search(sightings, home, step.block.config.align)
    else:
        found = advance(sightings, step.state, step.number, home, step.block.config.align)
    save_columns(step.path, found)


def _station_step(step: _Step) -> None:
    """Find a block's stations, unless they are there."""
    if step.state is None or step.path.exists():
        return
    table = find_stations(_sightings(step.block), step.state, step.block.area, step.block.config.stations)
    save_columns(step.path, table)


def _sightings(block: Block) -> Sightings:
    """The block's observations as columns, kept in the work folder for the next step of this fusion."""
    path = block.work / f"{block.key}.sightings.npz"
    found = load_columns(path, Sightings)
    if found is None:
        rows = np.arange(len(block.standing))
        found = gather(read_standing(block.log, block.standing, rows), block.config.align.spacing_m)
        save_columns(path, found)
    return found


def _reaching(standing: Standing, area: Area, halo_m: float) -> NDArray[np.bool_]:
    """(O,) whether an observation reaches into the area widened by the halo."""
    x, y = standing.xy[:, 0], standing.xy[:, 1]
    dx = np.maximum(np.maximum(area[0] - x, x - area[2]), 0.0)
    dy = np.maximum(np.maximum(area[1] - y, y - area[3]), 0.0)
    return np.hypot(dx, dy) <= standing.reach_m + halo_m


def _meeting(standing: Standing, home: Ints, margin_m: float) -> NDArray[np.bool_]:
    """(O,) whether an observation's lines can meet those of one at home."""
    out = np.zeros(len(standing), bool)
    if not len(home):
        return out
    xy, reach = standing.xy[home], standing.reach_m[home]
    low, high = xy.min(0), xy.max(0)
    far = standing.reach_m + reach.max() + margin_m
    near = np.flatnonzero(((standing.xy >= low - far[:, None]) & (standing.xy <= high + far[:, None])).all(1))
    # In slices, so that the table of distances stays small.
    for rows in np.array_split(near, max(1, len(near) * len(home) // 2_000_000)):
        gap = np.hypot(*(standing.xy[rows, None] - xy).transpose(2, 0, 1))
        out[rows] = (gap <= standing.reach_m[rows, None] + reach + margin_m).any(1)
    return out


def _take(standing: Standing, rows: Ints) -> Standing:
    used, segment = np.unique(standing.segment[rows], return_inverse=True)
    return replace(
        standing,
        ids=tuple(standing.ids[k] for k in rows.tolist()),
        segments=tuple(standing.segments[k] for k in used.tolist()),
        segment=segment,
        row_group=standing.row_group[rows],
        time_ns=standing.time_ns[rows],
        xy=standing.xy[rows],
        reach_m=standing.reach_m[rows],
    )
