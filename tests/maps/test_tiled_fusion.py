# SPDX-License-Identifier: Apache-2.0
"""A map fused tile by tile is the map fused in one piece, on any engine, after a kill, and after a few more observations."""

import tracemalloc
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from manyeyes._records import load_record, save_record
from manyeyes.datatypes import ConfigError
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.attributes import to_hex_ids
from manyeyes.maps.fusion.block_linking import LinkedStations, find_block_area
from manyeyes.maps.fusion.fuse import MapFusionConfig, fuse, relate_elements
from manyeyes.maps.fusion.observation_arrays import to_observation_arrays
from manyeyes.maps.fusion.polyline_linking import LinkConfig
from manyeyes.maps.fusion.pose_config import PoseSolverConfig
from manyeyes.maps.fusion.pose_optimization import limit_per_cell, list_domains, solve_poses
from manyeyes.maps.fusion.pose_solution import REJECTED_WEIGHT, make_initial_solution
from manyeyes.maps.store import region_release, tiled_fusion
from manyeyes.maps.store.executors import InlineExecutor, make_executor
from manyeyes.maps.store.log_index import IndexRow, LogIndex
from manyeyes.maps.store.object_store import FolderStore
from manyeyes.maps.store.observation_log import read_active
from manyeyes.maps.store.region_assembly import assemble_region, list_regions
from manyeyes.maps.store.store import MapStore
from manyeyes.maps.store.tiled_fusion import (
    FusionJob,
    FusionStepResult,
    TiledFusionConfig,
    fuse_and,
    iterate_blocks,
    load_result,
)
from manyeyes.simulator.fleet import CROWDS, load_place, simulate_crowd

pytest.importorskip("pyarrow", reason="the map extra is not installed")
pytest.importorskip("shapely", reason="the map extra is not installed")

COUNT = 30


@pytest.fixture(scope="module")
def crowd():
    """Observations of one crossroads, whose arms reach about 150 m."""
    return simulate_crowd(load_place("cross"), COUNT)


@pytest.fixture(scope="module")
def whole(crowd):
    return fuse(crowd.observations, frame=crowd.place.frame)


@pytest.fixture
def store(crowd, tmp_path):
    made = MapStore.create(tmp_path / "store", crowd.place.frame)
    with made.open_for_writing() as log:
        log.append(crowd.observations)
    return made


def _tiled(store, work, tile_m, executor=None, progress=None, config=None):
    job = FusionJob(store.objects, FolderStore(work), config or MapFusionConfig())
    with (executor or InlineExecutor()).open() as session:
        use = partial(_assemble, job, frame=store.frame)
        return fuse_and(use, job, store.log.index, TiledFusionConfig(tile_m, 1), session, progress)


def _assemble(job, blocks, frame):
    """The map of all regions, in the order of a map fused in one piece, without a release."""
    places = {region_release._find_block(key): key for key in blocks}

    def load(block):
        return load_result(job, places[block], LinkedStations) if block in places else None

    regions = list_regions([find_block_area(place, job.config.link) for place in places])
    found = [assemble_region(region, load, job.config, frame).elements for region in regions]
    return relate_elements(region_release._order(VectorMap.cat(found, frame)))


@pytest.mark.slow
def test_four_tiles_that_meet_in_the_crossroads_give_the_map_of_one_piece(store, whole, tmp_path):
    assert len(whole) > 10
    blocks = list(iterate_blocks(store.log.index, TiledFusionConfig(256.0, 1)))
    assert len(blocks) == 4 and all(block.home_ids for block in blocks)
    assert _tiled(store, tmp_path / "work", 256.0).quantised_hash() == whole.quantised_hash()


@pytest.mark.slow
def test_small_tiles_give_the_map_of_one_piece_and_no_line_is_cut_at_a_border(store, whole, tmp_path):
    got = _tiled(store, tmp_path / "work", 90.0)
    assert got.quantised_hash() == whole.quantised_hash()
    assert got.elements.lengths().max() > 90.0


@pytest.mark.slow
def test_poses_of_domains_that_meet_in_the_crossroads_do_not_depend_on_tiles(store, crowd, tmp_path):
    # The middle of a domain is at the origin, so borders lie at 80 m.
    solver = PoseSolverConfig(domain_m=160.0, domain_halo_m=60.0, drive_support_m=60.0)
    prior = np.array([o.pose for o in crowd.observations])
    assert len(list_domains(prior, solver)) > 3
    config = MapFusionConfig(pose_solver=solver)
    one_piece = fuse(crowd.observations, config, crowd.place.frame)
    assert _tiled(store, tmp_path / "work", 90.0, config=config).quantised_hash() == one_piece.quantised_hash()
    moved = solve_poses(crowd.observations, solver).pose - solve_poses(crowd.observations).pose
    # This halo is smaller than two views; it cuts lines that matter, and yet poses are those of one domain to some centimetres.
    assert 0.0 < np.median(np.hypot(*moved[:, :2].T)) < 0.02


@pytest.mark.slow
def test_links_of_small_blocks_do_not_depend_on_tiles(store, crowd, whole, tmp_path):
    # Borders lie at 40 m, 120 m and so on, and lines of the arms cross them.
    config = MapFusionConfig(link=LinkConfig(block_m=80, block_halo_m=100.0))
    one_piece = fuse(crowd.observations, config, crowd.place.frame)
    got = _tiled(store, tmp_path / "work", 90.0, config=config)
    assert _columns(got) == _columns(one_piece)
    assert got.quantised_hash() == whole.quantised_hash()


def _columns(vector_map):
    """The bytes of elements, evidence and relations."""
    e, t = vector_map.elements, vector_map.topology
    return [
        np.asarray(column).tobytes()
        for column in (e.points, e.offsets, e.kind, e.score, e.sigma, e.style, vector_map.id, vector_map.log_odds,
                       vector_map.state, vector_map.observations, vector_map.sources, t.successor, t.left, t.right, t.branch_xy)
    ]  # fmt: skip


def test_a_drive_that_is_supported_from_beyond_the_halo_is_refused():
    with pytest.raises(ConfigError, match=r"drive_support_m \(300 m\).*domain_halo_m \(200 m\).*lower .* or raise"):
        PoseSolverConfig(domain_halo_m=200.0)
    assert PoseSolverConfig(domain_halo_m=300.0).drive_support_m == 300.0


@pytest.mark.slow
def test_rejected_agents_are_rejected_alike_in_tiles_and_in_one_piece(tmp_path):
    crowd_config = replace(
        CROWDS["local"], malicious_fraction=0.2, attack_mode="colluding", malicious_offset_m=(3.0, 3.0)
    )
    simulated = simulate_crowd(load_place("cross"), COUNT, crowd_config, seed=6)
    assert (solve_poses(simulated.observations).agent_weight == REJECTED_WEIGHT).sum() >= 3
    made = MapStore.create(tmp_path / "store", simulated.place.frame)
    with made.open_for_writing() as log:
        log.append(simulated.observations)
    one_piece = fuse(simulated.observations, frame=simulated.place.frame)
    assert _tiled(made, tmp_path / "work", 90.0).quantised_hash() == one_piece.quantised_hash()


@pytest.mark.slow
def test_finished_steps_are_found_again_and_a_damaged_one_is_done_again(store, whole, tmp_path):
    work = tmp_path / "work"
    seen = []
    _tiled(store, work, 256.0, progress=lambda name, done, total: seen.append((name, done, total)))
    steps = MapFusionConfig().pose_solver.num_steps
    assert [name for name, done, total in seen if done == total] == [
        "search", *(f"step {k + 1}" for k in range(steps)), "stations", "link",
    ]  # fmt: skip
    objects = FolderStore(work)
    schedule = MapFusionConfig().pose_solver.schedule
    joint = sum(step.joint is not None for step in schedule)
    results = objects.list("work")
    # Per block: its rows of the index, the search, pairs or a search a step, stations; of the one domain one a search and two a
    # joint step; agents; links of the one block about the origin.
    assert len(results) == 4 * (steps + 3) + (steps - joint + 1) + 2 * joint + steps + 1 and not [
        k for k in results if "/arrays/" in k
    ]
    before = {key: (work / key).stat().st_mtime_ns for key in results}
    stations = [key for key in results if "/stations-" in key]
    (work / stations[0]).write_bytes((work / stations[0]).read_bytes()[:100])
    objects.delete(stations[1:2])
    assert _tiled(store, work, 256.0).quantised_hash() == whole.quantised_hash()
    after = {key: (work / key).stat().st_mtime_ns for key in objects.list("work")}
    assert {key for key in before if after[key] != before[key]} == set(stations[:2]) and after.keys() == before.keys()


def test_which_points_count_is_computed_once_a_search_and_again_where_it_is_damaged(store, tmp_path, monkeypatch):
    arrays = to_observation_arrays(read_active(store.objects, store.log.active_observations(), np.arange(COUNT)), 1.0)
    state = make_initial_solution(arrays)
    moved = replace(state, initial_pose=state.initial_pose + [50.0, 0.0, 0.3])
    calls = []

    def count_calls(*given):
        calls.append(given)
        return limit_per_cell(*given)

    monkeypatch.setattr(tiled_fusion, "limit_per_cell", count_calls)
    config = replace(MapFusionConfig(), pose_solver=PoseSolverConfig(max_observations_per_cell=2))
    work = FolderStore(tmp_path / "work")
    task = tiled_fusion.StepTask(FusionJob(store.objects, work, config), "pairs", (0, 0), 3, ())
    want = limit_per_cell(arrays, state.initial_pose[state.row_indices(arrays.ids)], 2)
    for one in (task, replace(task, number=4)):
        np.testing.assert_array_equal(tiled_fusion._load_limit(one, arrays, state), want)
    assert len(calls) == 1 and 0 < want.sum() < len(want)
    assert not np.array_equal(tiled_fusion._load_limit(task, arrays, moved), want) and len(calls) == 2
    for key in work.list("work"):
        (tmp_path / "work" / key).write_bytes(b"damaged")
    np.testing.assert_array_equal(tiled_fusion._load_limit(task, arrays, state), want)
    assert len(calls) == 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["process", "dask", "ray"])
def test_engines_give_the_identical_map(store, whole, tmp_path, name):
    module = {"process": "concurrent.futures", "dask": "dask.distributed", "ray": "ray"}[name]
    pytest.importorskip(module, reason=f"the {name} extra is not installed")
    got = _tiled(store, tmp_path / "work", 256.0, make_executor(name, workers=2))
    assert got.quantised_hash() == whole.quantised_hash()


@pytest.mark.slow
def test_a_store_fuses_and_publishes_and_a_retraction_fuses_again(store, crowd, whole):
    first = store.fuse(executor=InlineExecutor())
    assert first.content == whole.quantised_hash() and first.watermark.observations == COUNT
    taken = [o.id for o in crowd.observations[:6]]
    with store.open_for_writing() as log:
        log.retract(taken, "test")
    second = store.fuse(executor=InlineExecutor())
    rest = [o for o in crowd.observations if o.id not in taken]
    assert second.content == fuse(rest, frame=crowd.place.frame).quantised_hash() != first.content
    assert second.watermark.observations == COUNT - 6 and second.parent == 1
    assert set(store.delta(2).modified) & set(to_hex_ids(store.read(1).id))


def test_every_block_reads_overlapping_observations_only(store):
    standing = store.log.active_observations()
    blocks = list(iterate_blocks(store.log.index, TiledFusionConfig(50.0, 1, halo_m=10.0, margin_m=5.0)))
    assert sorted(name for block in blocks for name in block.home_ids) == list(standing.ids)
    for block in blocks:
        x0, y0, x1, y1 = block.area
        middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
        far = np.hypot(*(block.observations.xy - middle).T)
        assert set(block.home_ids) <= set(block.observations.ids)
        assert far.max() <= 36.0 + 2 * block.observations.radius_m.max() + 10.0
    assert len({block.place for block in blocks}) == len(blocks)


def test_observation_arrays_round_trip_through_work_folder(store, tmp_path):
    standing = store.log.active_observations()
    want = to_observation_arrays(read_active(store.objects, standing, np.arange(5)), 1.0)
    save_record(tmp_path / "a.record", want)
    got = load_record(tmp_path / "a.record", type(want))
    assert got is not None and got.ids == want.ids and got.agents == want.agents
    for name in ("xy", "pose", "time_ns", "priority"):
        a, b = getattr(got, name), getattr(want, name)
        np.testing.assert_array_equal(a, b)
        assert (a.dtype, a.flags.writeable) == (b.dtype, b.flags.writeable)
    np.testing.assert_array_equal(got.view.xy, want.view.xy)
    np.testing.assert_array_equal(got.elements.points, want.elements.points)
    (tmp_path / "a.record").write_bytes((tmp_path / "a.record").read_bytes()[:-50])
    assert load_record(tmp_path / "a.record", type(want)) is None
    assert load_record(tmp_path / "none.record", type(want)) is None


def test_sizes_that_make_no_sense_are_refused():
    with pytest.raises(ConfigError, match="TiledFusionConfig"):
        TiledFusionConfig(tile_size_m=0.0)


class NoWork:
    """An object store that keeps nothing, and an engine whose workers return names at once."""

    location = "nowhere"

    def list(self, _):
        return []

    def put(self, *_, **__):
        pass

    def delete(self, _):
        pass

    def run(self, _, tasks):
        for index, task in enumerate(tasks):
            names = ("poses", "sums") if task.kind == "solve" else ("poses",)
            yield index, FusionStepResult(tuple(f"{task.folder}/{'0' * 32}-{'1' * 32}.{name}" for name in names))


def test_what_the_driver_holds_grows_by_names_of_blocks_alone(tmp_path):
    """Sixteen and a hundred blocks of one density: 25 observations a block."""
    peaks, blocks = [], []
    for side in (4, 10):
        index = LogIndex(tmp_path / f"{side}.sqlite")
        index.clear("")
        places = np.stack(np.meshgrid(*[np.arange(side * 5) * 102.4 + 1.0] * 2), -1).reshape(-1, 2).tolist()
        rows = [IndexRow(f"{k:032x}", k // 128, k, f"car{k % 7}", x, y, 51.0, "p") for k, (x, y) in enumerate(places)]
        index.add_segment("1.parquet", rows)
        job, nowhere = FusionJob(NoWork(), NoWork(), MapFusionConfig()), NoWork()
        tracemalloc.start()
        fuse_and(tuple, job, index, TiledFusionConfig(), nowhere)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        blocks.append(sum(1 for _ in iterate_blocks(index, TiledFusionConfig())))
    assert blocks[0] < 40 and blocks[1] > 100
    # An observation with its id and place takes some 300 bytes; a block of this density holds 25, a dense one thousands.
    assert (peaks[1] - peaks[0]) / (blocks[1] - blocks[0]) < 5000


class Recorder(NoWork):
    """An engine that keeps the tasks in the order in which they begin."""

    def __init__(self):
        self.tasks = []

    def run(self, _, tasks):
        def kept():
            for task in tasks:
                self.tasks.append(task)
                yield task

        return super().run(_, kept())


def test_the_largest_tasks_of_a_step_begin_first_and_agents_are_added_in_one_order(tmp_path):
    """The farther east, the more observations a block has; sums must not depend on which domain is the largest."""
    index = LogIndex(tmp_path / "index.sqlite")
    index.clear("")
    places = [(512.0 * column + 5.0 * k, 100.0) for column in range(12) for k in range(3 + 4 * column)]
    rows = [IndexRow(f"{k:032x}", k // 128, k, f"car{k % 7}", x, y, 51.0, "p") for k, (x, y) in enumerate(places)]
    index.add_segment("1.parquet", rows)
    job, engine = FusionJob(NoWork(), NoWork(), MapFusionConfig()), Recorder()
    keys = fuse_and(tuple, job, index, TiledFusionConfig(), engine)
    size = {block.place: len(block.observations) for block in iterate_blocks(index, TiledFusionConfig())}
    for kind in ("search", "pairs", "stations"):
        sizes = [size[task.place] for task in engine.tasks if task.kind == kind and task.number == 0]
        assert len(set(sizes)) > 5 and sizes == sorted(sizes, reverse=True)
    solved = [task.place for task in engine.tasks if task.kind == "solve" and task.number == 0]
    assert len(solved) > 3 and solved[0] != min(solved) and solved[-1] == min(solved)
    weighed = next(task for task in engine.tasks if task.kind == "weigh")
    linked = [task for task in engine.tasks if task.kind == "link"]
    for names in (weighed.inputs, keys):
        in_order = [tuple(map(int, name.split("/")[2].split("_"))) for name in names]
        assert len(in_order) > 3 and in_order == sorted(in_order)
    assert [task.place for task in linked] != sorted(task.place for task in linked)
