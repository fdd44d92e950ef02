# SPDX-License-Identifier: Apache-2.0
"""Tiled fusion of large areas, with the same result as fusion in one piece.

The ground is divided into blocks of tiles. A block aligns its home observations, given all that their lines can meet: a coarse
search, then sums of pairs, of which the poses are solved domain by domain (:mod:`manyeyes.maps.fusion.pose_optimization`). Last it
builds the stations of its area from all observations that reach into it. Stations are linked in blocks that the configuration of
the fusion fixes (:mod:`manyeyes.maps.fusion.block_linking`), each from the stations within its halo. From their links the map is
assembled and published region by region (:mod:`manyeyes.maps.store.region_release`).

Every step is a pure function of objects in a store: a worker reads them, and writes its result to the store under a name that holds
a hash of what it was made from and one of its content. So poses pass between neighbours alone, and this process holds the names
of objects: about a kilobyte a block. A run after an interruption, or with a few more observations, computes only what is new. The
result of a step takes the place of the former one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import count, product
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from manyeyes._records import pack_record, unpack_record
from manyeyes._source import source_digest
from manyeyes.datatypes import ConfigError
from manyeyes.maps.fusion.agent_weights import AgentSums, AgentWeights, apply_agents
from manyeyes.maps.fusion.block_linking import find_block_area, link_block, list_blocks
from manyeyes.maps.fusion.fuse import MapFusionConfig
from manyeyes.maps.fusion.observation_arrays import ObservationArrays, to_observation_arrays
from manyeyes.maps.fusion.pose_optimization import (
    find_domain_area,
    limit_per_cell,
    list_domains,
    run_step,
    search_coarse_poses,
    settle_domain,
    solve_domain,
    take_near_domain,
    weigh_agents,
)
from manyeyes.maps.fusion.pose_solution import PoseSolution, make_initial_solution
from manyeyes.maps.fusion.stations import Area, StationTable, build_stations
from manyeyes.maps.isolation import CONTENT_ERRORS, FailedObservation, FailedObservationsError, isolate_failures
from manyeyes.maps.store.executors import ExecutorSession
from manyeyes.maps.store.log_index import ActiveObservations, LogIndex
from manyeyes.maps.store.object_store import ObjectNotFoundError, ObjectStore, StoreError
from manyeyes.maps.store.observation_log import TILE_M, read_active, tile_indices

T = TypeVar("T")
Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Place = tuple[int, int]

#: What releases name as their origin.
ALGORITHM = "manyeyes.fuse/1"
WORK = "work"
_FAN_IN = 64
"""Parts whose sums one worker adds; sums of more are added level by level."""

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

    @property
    def block_m(self) -> float:
        """The side of a block."""
        return self.tile_size_m * self.tiles_per_block


@dataclass(frozen=True, eq=False)
class TileBlock:
    """One unit of work.

    place: column and row. area: (x0, y0, x1, y1) metres. observations: the rows of the index that it reads, ids ascending.
    home_ids: ids of the home observations among them.
    """

    place: Place
    area: Area
    observations: ActiveObservations
    home_ids: tuple[str, ...]


@dataclass(frozen=True)
class FusionJob:
    """What all steps of one fusion share: where the log is, where results go, and the configuration; pickles."""

    log: ObjectStore
    work: ObjectStore
    config: MapFusionConfig


@dataclass(frozen=True)
class _Plan:
    """What this process knows of a block: the key of its TileBlock, and the domains that the observations it reads are at home in;
    home_domains: of its own. size: how many observations it reads.
    """

    place: Place
    area: Area
    members: str
    size: int
    domains: tuple[Place, ...]
    home_domains: tuple[Place, ...]


@dataclass(frozen=True)
class StepTask:
    """One step of one place, a pure function of the objects under ``inputs`` and ``agents`` (a table of agents; "": none yet).

    origins: of a link, what each input was made from: the same keys as those of its own step. They are read where the link fails.
    """

    job: FusionJob
    kind: str
    place: Place
    number: int
    inputs: tuple[str, ...]
    agents: str = ""
    origins: tuple[tuple[str, ...], ...] = ()

    @property
    def folder(self) -> str:
        """The folder of the result."""
        return f"{WORK}/{self.kind}-{self.number}/{self.place[0]}_{self.place[1]}"

    @property
    def digest(self) -> str:
        """Hash of the content of the inputs, of the configuration, and of the code."""
        contents = [_content_digest(key) for key in (*self.inputs, self.agents)]
        text = "|".join((_code(), repr(self.job.config), self.kind, str(self.number), str(self.place), *contents))
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


@dataclass(frozen=True)
class FusionStepResult:
    """The keys of a step's results, or the observations with which it fails."""

    keys: tuple[str, ...]
    failures: tuple[FailedObservation, ...] = ()


@dataclass(frozen=True)
class _PointLimit:
    """keep: (P,) points of a block that count, :func:`~manyeyes.maps.fusion.pose_optimization.limit_per_cell`."""

    keep: NDArray[np.bool_]


class LostResultError(StoreError):
    """A result that a step has left is missing or damaged; key: its own."""

    def __init__(self, key: str) -> None:
        super().__init__(key)
        self.key = key


def fuse_and(
    use: Callable[[tuple[str, ...]], T],
    job: FusionJob,
    index: LogIndex,
    tile_config: TiledFusionConfig,
    session: ExecutorSession,
    progress: StepProgress | None = None,
) -> T:
    """Link the stations of all blocks and give the keys of the results to ``use``; again where a result is damaged.

    Raises:
        FailedObservationsError: the fusion fails with some observations; without them it may succeed.
    """
    lost: set[str] = set()
    while True:
        try:
            plans = _make_plans(job, index, tile_config)
            return use(_Run(job, plans, tile_config, session, progress).run())
        except LostResultError as error:
            if error.key in lost:
                raise StoreError(
                    f"{job.work.location}/{error.key}: expected a step's result, but it cannot be written or read; check the disk."
                ) from None
            lost.add(error.key)
            job.work.delete([error.key])


def iterate_blocks(index: LogIndex, tile_config: TiledFusionConfig) -> Iterator[TileBlock]:
    """Yield every block that an observation stands in or reaches into, by column and row, one at a time."""
    size = tile_config.block_m
    cells, radius = index.active_cells()
    halo = radius + tile_config.halo_m
    reach = max(halo, 2 * radius + tile_config.margin_m)
    ranges = (
        product(*(range(int((c * TILE_M - halo) // size), int(((c + 1) * TILE_M + halo) // size) + 1) for c in cell))
        for cell in cells
    )
    for x, y in sorted({place for places in ranges for place in places}):
        area = (x * size, y * size, (x + 1) * size, (y + 1) * size)
        near = index.active_within((area[0] - reach, area[1] - reach, area[2] + reach, area[3] + reach))
        at_home = np.flatnonzero((tile_indices(near.xy, size) == (x, y)).all(1))
        chosen = _reaches_area(near, area, tile_config.halo_m)
        chosen[at_home] = True
        chosen |= _may_interact(near, at_home, tile_config.margin_m)
        rows = np.flatnonzero(chosen)
        if len(rows):
            yield TileBlock((x, y), area, _select_active(near, rows), tuple(near.ids[k] for k in at_home.tolist()))


def _make_plans(job: FusionJob, index: LogIndex, tile_config: TiledFusionConfig) -> list[_Plan]:
    """Write what each block reads to the job's work, and plan the blocks, the largest first."""
    plans = []
    for block in iterate_blocks(index, tile_config):
        folder = f"{WORK}/block/{block.place[0]}_{block.place[1]}"
        (key,) = put_results(job.work, folder, {"block": block}, "")
        home = np.isin(np.array(block.observations.ids), np.array(block.home_ids))
        xy, solver = block.observations.xy, job.config.pose_solver
        plans.append(
            _Plan(
                block.place,
                block.area,
                key,
                len(xy),
                tuple(list_domains(xy, solver)),
                tuple(list_domains(xy[home], solver)) if home.any() else (),
            )
        )
    return sorted(plans, key=lambda plan: (-plan.size, plan.place))


@dataclass(frozen=True, eq=False)
class _Run:
    """One pass over all steps. Of each step the largest tasks begin first, so that workers end it together."""

    job: FusionJob
    plans: list[_Plan]
    tile_config: TiledFusionConfig
    session: ExecutorSession
    progress: StepProgress | None

    def run(self) -> tuple[str, ...]:
        """Run the search, the steps of the schedule, the stations and their links; the keys of the linked stations."""
        if not self.plans:
            return ()
        homes = [plan for plan in self.plans if plan.home_domains]
        domains = self._blocks_of_domains(homes)
        task = partial(StepTask, self.job)
        total = len(homes) + len(domains)

        def search(name: str, kind: str, number: int, agents: str) -> dict[Place, str]:
            """Search the poses of all blocks, and settle them domain by domain; the keys by domain."""
            tasks = (task(kind, p.place, number, (p.members,), agents) for p in homes)
            found = self._map(name, tasks, total)
            keys = dict(zip((p.place for p in homes), (keys[0] for keys in found)))
            tasks = (task("settle", d, number, tuple(keys[b] for b in domains[d])) for d in domains)
            settled = self._map(name, tasks, total, len(homes))
            return dict(zip(domains, (keys[0] for keys in settled)))

        agents, poses = "", search("search", "search", 0, "")

        def read_by(plan: _Plan) -> tuple[str, ...]:
            """The keys of the block and of the poses that it reads."""
            return plan.members, *(poses[place] for place in plan.domains)

        for number, step in enumerate(self.job.config.pose_solver.schedule):
            name = f"step {number + 1}"
            if step.joint is None:
                ((agents,),) = self._map("", [task("restart", (0, 0), number, (), agents)], 1)
                poses = search(name, "repeat", number, agents)
                continue
            tasks = (task("pairs", p.place, number, read_by(p), agents) for p in homes)
            found = self._map(name, tasks, total)
            pairs = dict(zip((p.place for p in homes), (keys[0] for keys in found)))
            tasks = (task("solve", d, number, tuple(pairs[b] for b in domains[d])) for d in domains)
            solved = self._map(name, tasks, total, len(homes))
            poses = dict(zip(domains, (keys[0] for keys in solved)))
            sums = dict(zip(domains, (keys[1] for keys in solved)))
            agents = self._weigh(number, [sums[place] for place in sorted(sums)], agents)
        tasks = (task("stations", p.place, 0, read_by(p), agents) for p in self.plans)
        stations = [keys[0] for keys in self._map("stations", tasks, len(self.plans))]
        made_from = [(agents, *read_by(p)) for p in self.plans]
        blocks = self._blocks_to_link()
        tasks = (
            task("link", block, 0, tuple(stations[k] for k in rows), "", tuple(made_from[k] for k in rows))
            for block, rows in blocks.items()
        )
        linked = dict(zip(blocks, (keys[0] for keys in self._map("link", tasks, len(blocks)))))
        return tuple(linked[block] for block in sorted(linked))

    def _blocks_to_link(self) -> dict[Place, tuple[int, ...]]:
        """Return the blocks to link, the largest first, each with the plans whose stations may lie within its halo."""
        config, side = self.job.config.link, self.tile_config.block_m
        rows = {plan.place: row for row, plan in enumerate(self.plans)}
        out = {}
        for block in list_blocks((plan.area for plan in self.plans), config):
            x0, y0, x1, y1 = find_block_area(block, config)
            halo = config.block_halo_m
            columns, lines = (
                range(int((low - halo) // side), int((high + halo) // side) + 1) for low, high in ((x0, x1), (y0, y1))
            )
            out[block] = tuple(rows[place] for place in product(columns, lines) if place in rows)
        return _sort_by_size(out, lambda row: self.plans[row].size)

    def _blocks_of_domains(self, homes: Sequence[_Plan]) -> dict[Place, tuple[Place, ...]]:
        """Return the domains, the largest first, each with the blocks whose home observations may lie within its halo."""
        known, side = {p.place: p.size for p in homes}, self.tile_config.block_m
        solver = self.job.config.pose_solver
        out = {}
        for domain in sorted({d for p in homes for d in p.home_domains}):
            x0, y0, x1, y1 = find_domain_area(domain, solver)
            ranges = (range(int(low // side), int(high // side) + 1) for low, high in ((x0, x1), (y0, y1)))
            out[domain] = tuple(place for place in product(*ranges) if place in known)
        return _sort_by_size(out, known.__getitem__)

    def _weigh(self, number: int, sums: list[str], agents: str) -> str:
        """Add the sums of all domains level by level, and weigh the agents; returns the key of their table."""
        for level in count():
            if len(sums) <= _FAN_IN:
                break
            groups = [tuple(sums[k : k + _FAN_IN]) for k in range(0, len(sums), _FAN_IN)]
            tasks = (StepTask(self.job, "sums", (level, k), number, group) for k, group in enumerate(groups))
            sums = [keys[0] for keys in self._map("", tasks, len(groups))]
        ((table,),) = self._map("", [StepTask(self.job, "weigh", (0, 0), number, tuple(sums), agents)], 1)
        return table

    def _map(self, name: str, tasks: Iterable[StepTask], total: int, done: int = 0) -> list[tuple[str, ...]]:
        """Run tasks on the engine; the keys of their results, in order. done: of total, by tasks before them."""
        keys: dict[int, tuple[str, ...]] = {}
        failures: list[FailedObservation] = []
        for index, result in self.session.run(_run_task, tasks):
            keys[index] = result.keys
            failures += result.failures
            if self.progress is not None and name:
                self.progress(name, done + len(keys), total)
        if failures:
            raise FailedObservationsError(failures)
        return [keys[index] for index in range(len(keys))]


def _sort_by_size(parts: dict[Place, tuple[T, ...]], size_of: Callable[[T], int]) -> dict[Place, tuple[T, ...]]:
    """Return places with their parts, those with the largest sum of sizes first."""
    sizes = {place: sum(map(size_of, found)) for place, found in parts.items()}
    return {place: parts[place] for place in sorted(parts, key=lambda place: (-sizes[place], place))}


_NUM_RESULTS = {"solve": 2}


def _run_task(task: StepTask) -> FusionStepResult:
    """Run a step and store its results, unless they are stored."""
    work = task.job.work
    stored = work.list(task.folder)
    found = sorted(key for key in stored if key.startswith(f"{task.folder}/{task.digest}"))
    if len(found) == _NUM_RESULTS.get(task.kind, 1):
        return FusionStepResult(tuple(sorted(found, key=lambda key: key.rpartition(".")[2])))
    results, failures = _compute(task)
    if failures:
        return FusionStepResult((), failures)
    keys = put_results(work, task.folder, results, task.digest, stored)
    if task.kind == "stations":
        # Arrays are large and cheap to make again.
        work.delete(work.list(_arrays_folder(task.place)))
    return FusionStepResult(keys)


def _compute(task: StepTask) -> tuple[dict[str, object], tuple[FailedObservation, ...]]:
    """Compute the results of a step, by name in order, or find the observations with which it fails."""
    job, solver = task.job, task.job.config.pose_solver
    table = load_result(job, task.agents, AgentWeights) if task.agents else None
    if task.kind == "restart":
        assert table is not None
        return {"agents": table.restart()}, ()
    if task.kind in ("sums", "weigh"):
        sums = AgentSums.merge([load_result(job, key, AgentSums) for key in task.inputs])
        if task.kind == "sums":
            return {"sums": sums}, ()
        return {"agents": weigh_agents(sums, table, solver.schedule[task.number], solver)}, ()
    if task.kind == "settle":
        parts = [load_result(job, key, PoseSolution) for key in task.inputs]
        return {"poses": settle_domain(parts, task.place, solver)}, ()
    if task.kind == "solve":
        return _compute_solve(task)
    if task.kind == "link":
        return _compute_link(task)
    block, solution = _load_block(job, task.inputs, table)
    try:
        return _compute_block(task, block, _load_arrays(task, block), solution, table), ()
    except CONTENT_ERRORS:
        return _isolate_block(task, block, solution, table)


def _compute_solve(task: StepTask) -> tuple[dict[str, object], tuple[FailedObservation, ...]]:
    """Solve a domain, without the observations with which that fails."""
    solver = task.job.config.pose_solver
    parts = (load_result(task.job, key, PoseSolution) for key in task.inputs)
    whole = PoseSolution.cat([take_near_domain(part, task.place, solver) for part in parts])

    def solve(rows: Sequence[int]) -> tuple[PoseSolution, AgentSums]:
        part = whole.take_with_pairs(np.array(rows, np.int64))
        return solve_domain([part], task.place, solver.schedule[task.number], solver)

    (state, sums), failures = isolate_failures(solve, len(whole.ids))
    found = tuple(FailedObservation(whole.ids[one.row], one.reason) for one in failures)
    return {"poses": state, "sums": sums}, found


def _load_block(
    job: FusionJob, keys: Sequence[str], table: AgentWeights | None
) -> tuple[TileBlock, PoseSolution | None]:
    """Load a block and the poses of what it reads, if there are keys of them."""
    poses = [load_result(job, key, PoseSolution) for key in keys[1:]]
    return load_result(job, keys[0], TileBlock), apply_agents(PoseSolution.cat(poses), table) if poses else None


def _compute_link(task: StepTask) -> tuple[dict[str, object], tuple[FailedObservation, ...]]:
    """Link the stations of a block, or find the observations without whose stations that succeeds."""
    config = task.job.config

    def link(tables: Sequence[StationTable]) -> dict[str, object]:
        return {"links": link_block(StationTable.cat(tables), task.place, config.link, config.parallel_extension)}

    area, halo = find_block_area(task.place, config.link), config.link.block_halo_m
    tables = [load_result(task.job, key, StationTable).take_area(area, halo) for key in task.inputs]
    try:
        return link(tables), ()
    except CONTENT_ERRORS:
        return _isolate_link(task, link)


def _isolate_link(
    task: StepTask, link: Callable[[Sequence[StationTable]], dict[str, object]]
) -> tuple[dict[str, object], tuple[FailedObservation, ...]]:
    """Link stations made without the observations with which linking fails; raises its error where that does not help."""
    config = task.job.config
    origins = []
    for agents, *keys in task.origins:
        block, solution = _load_block(task.job, keys, load_result(task.job, agents, AgentWeights) if agents else None)
        stored = read_active(task.job.log, block.observations, np.arange(len(block.observations)))
        origins.append((block, solution, stored))
    ids = sorted({o.id for _, _, stored in origins for o in stored})

    def compute(rows: Sequence[int]) -> dict[str, object]:
        chosen, tables = {ids[row] for row in rows}, []
        for block, solution, stored in origins:
            part = [o for o in stored if o.id in chosen]
            if part:
                arrays = to_observation_arrays(part, config.pose_solver.spacing_m)
                made = _compute_block(replace(task, kind="stations"), block, arrays, solution, None)["stations"]
                assert isinstance(made, StationTable)
                tables.append(made)
        return link(tables)

    results, failures = isolate_failures(compute, len(ids))
    return results, tuple(FailedObservation(ids[one.row], one.reason) for one in failures)


def _compute_block(
    task: StepTask,
    block: TileBlock,
    arrays: ObservationArrays,
    solution: PoseSolution | None,
    table: AgentWeights | None,
) -> dict[str, object]:
    """Compute the search, the sums of a block's home, or the block's stations; solution: poses of all that it reads."""
    config = task.job.config
    if solution is not None:
        solution = solution.take(solution.row_indices(sorted(arrays.ids)))
    if task.kind == "stations":
        assert solution is not None
        return {"stations": build_stations(arrays, solution, block.area, config.stations)}
    row = {name: k for k, name in enumerate(arrays.ids)}
    home = np.array([row[name] for name in block.home_ids], np.int64)
    if task.kind == "search":
        return {"poses": search_coarse_poses(arrays, home, config.pose_solver)}
    state = apply_agents(make_initial_solution(arrays), table) if solution is None else solution
    keep = None if task.kind == "repeat" else _load_limit(task, arrays, state)
    return {"poses": run_step(arrays, state, task.number, home, config.pose_solver, keep)}


def _isolate_block(
    task: StepTask, block: TileBlock, solution: PoseSolution | None, table: AgentWeights | None
) -> tuple[dict[str, object], tuple[FailedObservation, ...]]:
    """Compute a step without the observations with which it fails; raises its error where leaving some out does not help."""
    active = block.observations
    stored = read_active(task.job.log, active, np.arange(len(active)))
    home = set(block.home_ids)
    # Home first: only with home observations does a step compute anything.
    ordered = sorted(stored, key=lambda o: (o.id not in home, o.id))

    def compute(rows: Sequence[int]) -> dict[str, object]:
        chosen = [ordered[row] for row in rows]
        arrays = to_observation_arrays(chosen, task.job.config.pose_solver.spacing_m)
        part = replace(block, home_ids=tuple(o.id for o in chosen if o.id in home))
        return _compute_block(task, part, arrays, solution, table)

    results, failures = isolate_failures(compute, len(ordered))
    return results, tuple(FailedObservation(ordered[one.row].id, one.reason) for one in failures)


def _load_arrays(task: StepTask, block: TileBlock) -> ObservationArrays:
    """Load the block's observations as arrays from the job's work, or make and store them."""
    job, key = task.job, f"{_arrays_folder(block.place)}/{_content_digest(task.inputs[0])}"
    try:
        found = unpack_record(job.work.get(key), ObservationArrays)
    except ObjectNotFoundError:
        found = None
    if found is None:
        observations = read_active(job.log, block.observations, np.arange(len(block.observations)))
        found = to_observation_arrays(observations, job.config.pose_solver.spacing_m)
        job.work.put(key, pack_record(found), durable=False)
    return found


def _load_limit(task: StepTask, arrays: ObservationArrays, state: PoseSolution) -> NDArray[np.bool_]:
    """Load which points (P,) count at the initial poses, which only a search changes, or compute and store it."""
    work, config = task.job.work, task.job.config.pose_solver
    initial = np.ascontiguousarray(state.initial_pose[state.row_indices(arrays.ids)])
    digest = hashlib.blake2b(initial.tobytes(), digest_size=16)
    digest.update(repr((_code(), arrays.ids, task.job.config)).encode())
    key = f"{_arrays_folder(task.place)}/{digest.hexdigest()}.limit"
    try:
        found = unpack_record(work.get(key), _PointLimit)
    except ObjectNotFoundError:
        found = None
    if found is None:
        found = _PointLimit(limit_per_cell(arrays, initial, config.max_observations_per_cell))
        work.put(key, pack_record(found), durable=False)
    return found.keep


def _arrays_folder(place: Place) -> str:
    return f"{WORK}/arrays/{place[0]}_{place[1]}"


def put_results(
    work: ObjectStore, folder: str, results: dict[str, Any], made_from: str, stored: Sequence[str] | None = None
) -> tuple[str, ...]:
    """Store results by name, each under a key that ends with a hash of its content; they take the place of what was there.

    stored: the keys below the folder, where the caller has listed them.
    """
    before, keys = set(work.list(folder) if stored is None else stored), []
    for name, value in results.items():
        data = pack_record(value)
        keys.append(f"{folder}/{made_from}-{hashlib.blake2b(data, digest_size=16).hexdigest()}.{name}")
        if keys[-1] not in before:
            work.put(keys[-1], data, durable=False)
    work.delete(sorted(before - set(keys)))
    return tuple(keys)


def load_result(job: FusionJob, key: str, kind: type[T]) -> T:
    """Load a result of a step; LostResultError where it is missing or damaged."""
    try:
        data = job.work.get(key)
    except ObjectNotFoundError:
        raise LostResultError(key) from None
    whole = hashlib.blake2b(data, digest_size=16).hexdigest() == _content_digest(key)
    found = unpack_record(data, kind) if whole else None
    if found is None:
        raise LostResultError(key)
    return found


def _content_digest(key: str) -> str:
    return key.rpartition("-")[2].partition(".")[0] if "." in key else key


@lru_cache(maxsize=1)
def _code() -> str:
    return f"{ALGORITHM} {source_digest(__name__)}"


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
    for rows in np.array_split(near, max(1, len(near) * len(home) // 200_000)):
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
