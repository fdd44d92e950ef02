# SPDX-License-Identifier: Apache-2.0
"""Tiled fusion of large areas, with the same result as fusion in one piece.

Phase A solves the pose of each observation in the block of tiles that contains it (its home), given all observations that its
lines can meet: a coarse search, then sweeps, each of which starts from the poses of all blocks after the previous one. Phase B
builds the stations of each block from all observations that reach into it. Then one process links the stations of all blocks,
which are few, so that no line is cut at a border. Every step is a pure function of a block's inputs. Its result is stored under
a hash of them, so that a run after an interruption, or with a few more observations, computes only what is new.
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

from manyeyes._records import load_record, save_record
from manyeyes._source import source_digest
from manyeyes.datatypes import ConfigError
from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import MapFusionConfig, assemble_map
from manyeyes.maps.fusion.observation_arrays import ObservationArrays, to_observation_arrays
from manyeyes.maps.fusion.pose_optimization import merge_solutions, run_step, search_coarse_poses
from manyeyes.maps.fusion.pose_solution import PoseSolution
from manyeyes.maps.fusion.stations import Area, StationTable, build_stations
from manyeyes.maps.isolation import CONTENT_ERRORS, FailedObservation, FailedObservationsError, isolate_failures
from manyeyes.maps.store.executors import Executor, ExecutorSession, ProcessExecutor, map_blocks
from manyeyes.maps.store.log_index import ActiveObservations
from manyeyes.maps.store.observation_log import TILE_M, StoreError, read_active, tile_indices

T = TypeVar("T")
Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

#: What releases name as their origin.
ALGORITHM = "manyeyes.fuse/1"

#: Called as steps go on: (name of the step, blocks done, blocks in all).
StepProgress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class TiledFusionConfig:
    """Configuration of the tiles.

    tile_size_m: side of a tile. tiles_per_block: tiles along the side of a block, the unit of work of a worker.
    margin_m: largest distance, beyond their radii, of the prior positions of two observations that influence each other's pose.
        It covers two coarse searches of 4.5 m along each axis, the cells of the limit per cell, and the radius in which
        observations of one agent count as redundant.
    halo_m: largest distance from a block of an observation whose lines shape the block's stations.
    """

    tile_size_m: float = TILE_M
    tiles_per_block: int = 2
    margin_m: float = 56.0
    halo_m: float = 64.0

    def __post_init__(self) -> None:
        if not (self.tile_size_m > 0 and self.tiles_per_block >= 1 and self.margin_m >= 0 and self.halo_m >= 0):
            raise ConfigError(f"TiledFusionConfig needs positive sizes and at least one tile a block; got {self}.")


@dataclass(frozen=True, eq=False)
class TileBlock:
    """One unit of work: the observations that it reads, the home observations among them, and its area.

    log_folder: folder of segments. observations: rows of the index that it reads, ids ascending.
    home_ids: ids of the home observations. area: (x0, y0, x1, y1) metres. work_folder: folder for results of steps.
    """

    log_folder: Path
    observations: ActiveObservations
    home_ids: tuple[str, ...]
    area: Area
    work_folder: Path
    config: MapFusionConfig

    @property
    def key(self) -> str:
        """Hash of the block's observations, home, area and configuration, and of the code of the steps."""
        code = f"{ALGORITHM} {source_digest(__name__)}"
        text = "|".join(
            (code, repr(self.config), repr(self.area), ",".join(self.home_ids), ",".join(self.observations.ids))
        )
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


@dataclass(frozen=True, eq=False)
class _BlockStep:
    """A block with the solution of the previous step; number -1 is the coarse search, then sweeps; None: stations."""

    block: TileBlock
    solution: PoseSolution | None
    number: int | None

    @property
    def path(self) -> Path:
        """The path of the result."""
        digest = hashlib.blake2b(self.block.key.encode(), digest_size=16)
        digest.update(str(self.number).encode())
        if self.solution is not None:
            digest.update(",".join(self.solution.ids).encode())
            for f in fields(PoseSolution):
                value = getattr(self.solution, f.name)
                if isinstance(value, np.ndarray):
                    digest.update((value + 0.0).tobytes())
        return self.block.work_folder / f"{digest.hexdigest()}.record"


def fuse_tiles(
    log_folder: Path,
    active: ActiveObservations,
    frame: MapFrame,
    work_folder: Path,
    config: MapFusionConfig | None = None,
    tile_config: TiledFusionConfig = TiledFusionConfig(),
    executor: Executor | None = None,
    progress: StepProgress | None = None,
) -> VectorMap:
    """Fuse the observations of the log that ``active`` lists; all workers can access ``log_folder`` and ``work_folder``.

    Raises:
        FailedObservationsError: the fusion fails with some observations; without them it may succeed.
    """
    config = config or MapFusionConfig()
    used: set[str] = set()
    with (executor or ProcessExecutor()).open() as runner:

        def fuse_rows(rows: Sequence[int]) -> VectorMap:
            chosen = active if len(rows) == len(active) else _select_active(active, np.array(rows, np.int64))
            blocks = make_blocks(log_folder, chosen, work_folder, config, tile_config)
            used.clear()
            tables = _run_steps(blocks, config, runner, progress, used)
            return assemble_map(StationTable.cat(tables), config, frame) if tables else VectorMap.empty(frame)

        fused, failures = isolate_failures(fuse_rows, len(active))
    if failures:
        raise FailedObservationsError([FailedObservation(active.ids[one.row], one.reason) for one in failures])
    # Unused results belong to previous maps; observation arrays are large and cheap to recompute.
    for path in sorted(work_folder.glob("*.record")):
        if path.name not in used:
            path.unlink()
    return fused


def make_blocks(
    log_folder: Path,
    active: ActiveObservations,
    work_folder: Path,
    config: MapFusionConfig,
    tile_config: TiledFusionConfig,
) -> list[TileBlock]:
    """Make every block that contains an observation or that one reaches into, by column and row; empty ones are left out."""
    size = tile_config.tile_size_m * tile_config.tiles_per_block
    home = tile_indices(active.xy, size)
    radius = active.radius_m + tile_config.halo_m
    low, high = tile_indices(active.xy - radius[:, None], size), tile_indices(active.xy + radius[:, None], size)
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
        chosen = _reaches_area(active, area, tile_config.halo_m)
        chosen[at_home] = True
        chosen |= _may_interact(active, at_home, tile_config.margin_m)
        rows = np.flatnonzero(chosen)
        if len(rows):
            ids = tuple(active.ids[k] for k in at_home.tolist())
            blocks.append(TileBlock(log_folder, _select_active(active, rows), ids, area, work_folder, config))
    return blocks


def _run_steps(
    blocks: Sequence[TileBlock],
    config: MapFusionConfig,
    runner: ExecutorSession,
    progress: StepProgress | None,
    used: set[str],
) -> list[StationTable]:
    """Return stations of all blocks: search, sweeps with a barrier after each, stations; ``used`` gets the names of all
    results.
    """

    def run_all(steps: Sequence[_BlockStep], name: str, kind: type[T]) -> list[T]:
        report = None if progress is None else partial(progress, name)
        failures = [failure for found in map_blocks(_run_step, steps, runner, report) for failure in found]
        if failures:
            raise FailedObservationsError(failures)
        used.update(step.path.name for step in steps)
        return [_load_result(step, kind) for step in steps]

    if not blocks:
        return []
    homes = [b for b in blocks if b.home_ids]
    steps = [_BlockStep(b, None, -1) for b in homes]
    state = merge_solutions(run_all(steps, "search", PoseSolution), config.pose_solver)
    for number in range(config.pose_solver.num_steps):
        steps = [_BlockStep(b, _select_block(state, b), number) for b in homes]
        state = merge_solutions(run_all(steps, f"step {number + 1}", PoseSolution), config.pose_solver, number)
    return run_all([_BlockStep(b, _select_block(state, b), None) for b in blocks], "stations", StationTable)


def _select_block(state: PoseSolution, block: TileBlock) -> PoseSolution:
    """Return the rows of a state that a block reads."""
    return state.take(state.row_indices(block.observations.ids))


def _load_result(step: _BlockStep, kind: type[T]) -> T:
    """Load the result of a step from the work folder; compute it here if the file is missing or damaged."""
    found = load_record(step.path, kind)
    if found is None:
        step.path.unlink(missing_ok=True)
        if failures := _run_step(step):
            raise FailedObservationsError(failures)
        found = load_record(step.path, kind)
    if found is None:
        raise StoreError(f"{step.path}: expected a step's result, but it cannot be written or read; check the disk.")
    return found


def _run_step(step: _BlockStep) -> tuple[FailedObservation, ...]:
    """Run a step and store its result, unless it is stored; return the observations of the block with which it fails."""
    if step.path.exists():
        return ()
    try:
        result = _compute_step(step, _load_arrays(step.block))
    except CONTENT_ERRORS:
        result, failures = _isolate_step(step)
        if failures:
            return failures
    save_record(step.path, result)
    return ()


def _compute_step(step: _BlockStep, arrays: ObservationArrays) -> PoseSolution | StationTable:
    """Compute the search, a sweep of a block's home, or the block's stations."""
    config = step.block.config
    if step.solution is not None and step.number is None:
        return build_stations(arrays, step.solution, step.block.area, config.stations)
    row = {name: k for k, name in enumerate(arrays.ids)}
    home = np.array([row[name] for name in step.block.home_ids], np.int64)
    if step.solution is None or step.number is None:
        return search_coarse_poses(arrays, home, config.pose_solver)
    return run_step(arrays, step.solution, step.number, home, config.pose_solver)


def _isolate_step(step: _BlockStep) -> tuple[PoseSolution | StationTable, tuple[FailedObservation, ...]]:
    """Compute a step without the observations with which it fails; raises its error where leaving some out does not help."""
    block, config = step.block, step.block.config
    stored = read_active(block.log_folder, block.observations, np.arange(len(block.observations)))
    home = set(block.home_ids)
    # Home first: only with home observations does a step compute anything.
    ordered = sorted(stored, key=lambda o: (o.id not in home, o.id))

    def compute(rows: Sequence[int]) -> PoseSolution | StationTable:
        chosen = [ordered[row] for row in rows]
        arrays = to_observation_arrays(chosen, config.pose_solver.spacing_m)
        part = replace(block, home_ids=tuple(o.id for o in chosen if o.id in home))
        solution = None if step.solution is None else step.solution.take(step.solution.row_indices(sorted(arrays.ids)))
        return _compute_step(replace(step, block=part, solution=solution), arrays)

    result, failures = isolate_failures(compute, len(ordered))
    return result, tuple(FailedObservation(ordered[one.row].id, one.reason) for one in failures)


def _load_arrays(block: TileBlock) -> ObservationArrays:
    """Load the block's observations as arrays from the work folder, or make and store them."""
    path = block.work_folder / f"{block.key}.arrays.record"
    found = load_record(path, ObservationArrays)
    if found is None:
        rows = np.arange(len(block.observations))
        found = to_observation_arrays(
            read_active(block.log_folder, block.observations, rows), block.config.pose_solver.spacing_m
        )
        save_record(path, found)
    return found


def _reaches_area(active: ActiveObservations, area: Area, halo_m: float) -> NDArray[np.bool_]:
    """Return (O,) whether each observation reaches into the area widened by the halo."""
    x, y = active.xy[:, 0], active.xy[:, 1]
    dx = np.maximum(np.maximum(area[0] - x, x - area[2]), 0.0)
    dy = np.maximum(np.maximum(area[1] - y, y - area[3]), 0.0)
    return np.hypot(dx, dy) <= active.radius_m + halo_m


def _may_interact(active: ActiveObservations, home: Ints, margin_m: float) -> NDArray[np.bool_]:
    """Return (O,) whether each observation's lines can meet those of a home observation."""
    out = np.zeros(len(active), bool)
    if not len(home):
        return out
    xy, radius = active.xy[home], active.radius_m[home]
    low, high = xy.min(0), xy.max(0)
    max_distance = active.radius_m + radius.max() + margin_m
    near = np.flatnonzero(
        ((active.xy >= low - max_distance[:, None]) & (active.xy <= high + max_distance[:, None])).all(1)
    )
    # In slices, so that the table of distances stays small.
    for rows in np.array_split(near, max(1, len(near) * len(home) // 2_000_000)):
        gap = np.hypot(*(active.xy[rows, None] - xy).transpose(2, 0, 1))
        out[rows] = (gap <= active.radius_m[rows, None] + radius + margin_m).any(1)
    return out


def _select_active(active: ActiveObservations, rows: Ints) -> ActiveObservations:
    used, segment = np.unique(active.segment[rows], return_inverse=True)
    return replace(
        active,
        ids=tuple(active.ids[k] for k in rows.tolist()),
        segments=tuple(active.segments[k] for k in used.tolist()),
        segment=segment,
        row_group=active.row_group[rows],
        time_ns=active.time_ns[rows],
        xy=active.xy[rows],
        radius_m=active.radius_m[rows],
    )
