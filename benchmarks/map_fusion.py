# SPDX-License-Identifier: Apache-2.0
"""Cost of map fusion, in five measurements.

literal  our fusion against the paper's literal pipeline with pycpd, per observation, in turn in one process (bars: the fold 20
         times as fast, one more observation 10 times)
stream   one observation of about 25 elements taken into a map of 100,000 elements (bar: 10 ms)
city     a growing city, 10^4, 10^5, 10^6 observed elements, from the log to a release (bar at 10^6, two cores: 20 min, 8 GB)
engines  10^5 observed elements inline, over processes, Dask and Ray: the map must be identical
driver   memory of the process that drives a fusion, 10^4 to 10^7 observed elements; workers are stand-ins, no step is run

Observations are simulated before the clock starts. Besides wall time the processors' own time is given, which a busy
machine does not change; memory is the largest sum of resident memory over this process and its workers, and that of the largest
worker, sampled four times a second, shared pages counted for each. That of the driver is the peak of what Python and NumPy allocate
in it while it fuses and publishes (tracemalloc).

python benchmarks/map_fusion.py literal|stream|city|engines|driver [--elements 10000 ...] [--workers 2] [--out FILE.json]
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import tempfile
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import numpy as np
import psutil
import torch

from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.maps.baselines import crowdmap_literal
from manyeyes.maps.baselines.cpd import CpdConfig
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import MapFusionConfig, fuse
from manyeyes.maps.fusion.incremental import IncrementalMap
from manyeyes.maps.store.executors import make_executor
from manyeyes.maps.store.log_index import IndexRow, LogIndex
from manyeyes.maps.store.store import MapStore
from manyeyes.maps.store.tiled_fusion import FusionJob, FusionStepResult, StepTask, TiledFusionConfig, fuse_and
from manyeyes.ops.polyline import close_rings, resample
from manyeyes.ops.polyline_distance import chamfer_distance
from manyeyes.simulator.fleet import CROWDS, CrowdConfig, load_place, simulate_crowd
from manyeyes.studies.provenance import write_json

CITY = replace(CROWDS["local"], range_x_m=(-45.0, 45.0), range_y_m=(-25.0, 25.0))
# Of the simulated city of 10^5 elements.
ELEMENTS_PER_OBSERVATION, OBSERVATIONS_PER_KM2 = 20.3, 3600.0
LITERAL_BARS = {"fold": 20.0, "one more": 10.0}
STREAM_BAR_MS, CITY_BAR_S, CITY_BAR_GB = 10.0, 1200.0, 8.0


@dataclass(frozen=True)
class Literal:
    """Seconds of processor time per observation, medians over the rounds, and how many times ours is faster.

    way: "fold", the map of all observations again; "one more", each of the second half taken into the map of those before it.
    """

    way: str
    observations: int
    elements: float
    ours_s: float
    literal_s: float
    times: float
    met: bool


@dataclass(frozen=True)
class Stream:
    """Milliseconds of processor time of one observation, median and largest, after some that only compile."""

    map_elements: int
    elements: float
    median_ms: float
    most_ms: float
    met: bool


@dataclass(frozen=True)
class City:
    """One size: observations, observed elements, seconds to ingest and to fuse and publish, processor time, peak memory of all
    processes and of the largest worker; of the driver what it allocated.
    """

    executor: str
    observations: int
    elements: int
    map_elements: int
    map_hash: str
    ingest_s: float
    fuse_s: float
    fuse_cpu_s: float
    peak_gb: float
    worker_gb: float
    driver_mb: float
    load: float


@dataclass(frozen=True)
class Driver:
    """One size: observations, elements that they stand for, blocks, steps that were given out, peak of the driver's memory."""

    observations: int
    elements: int
    blocks: int
    tasks: int
    driver_mb: float
    seconds: float


class _Registered:
    """A result of pycpd with the interface of the project's own registration."""

    def __init__(self, moved: np.ndarray) -> None:
        self.moved = moved

    def apply(self, _: np.ndarray) -> np.ndarray:
        """The moved points."""
        return self.moved


def with_pycpd(anchor: np.ndarray, other: np.ndarray, _: object) -> _Registered:
    """Rigid registration by pycpd with its defaults."""
    from pycpd import RigidRegistration

    return _Registered(RigidRegistration(X=anchor, Y=other).register()[0])


def literal(count: int, rounds: int, config: CrowdConfig) -> list[Literal]:
    """Both pipelines on one crowd of a crossroads, in turn."""
    crowd = simulate_crowd(load_place("cross"), count, config)
    many, half = crowd.observations, count // 2
    fuse(many[:20]), crowdmap_literal.fuse(many[:5])
    own = crowdmap_literal.register
    spent: dict[str, tuple[list[float], list[float]]] = {"fold": ([], []), "one more": ([], [])}
    for _ in range(rounds):
        live = IncrementalMap(fuse(many[:half]))
        spent["fold"][0].append(_cpu(lambda: fuse(many)) / count)
        # The first two of the second half compile what is left to compile.
        for o in many[half : half + 2]:
            live.update(o)
        spent["one more"][0].append(
            _cpu(lambda live=live: [live.update(o) for o in many[half + 2 :]]) / (count - half - 2)
        )
        crowdmap_literal.register = with_pycpd
        spent["fold"][1].append(_cpu(lambda: crowdmap_literal.fuse(many)) / count)
        held = LiteralMap(crowdmap_literal.fuse(many[:half]).elements)
        spent["one more"][1].append(
            _cpu(lambda held=held: [held.assimilate(o) for o in many[half + 2 :]]) / (count - half - 2)
        )
        crowdmap_literal.register = own
    rows = []
    for way, (ours, theirs) in spent.items():
        times = median(theirs) / median(ours)
        rows.append(
            Literal(way, count, _mean_elements(many), median(ours), median(theirs), times, times >= LITERAL_BARS[way])
        )
    return rows


class LiteralMap:
    """The literal pipeline one observation at a time: what overlaps is registered onto the most confident, which stays."""

    def __init__(self, start: MapElements) -> None:
        self.elements = start

    def assimilate(self, observation: Observation, gate_m: float = 1.5, samples: int = 50) -> int:
        """Gate by Chamfer, register each pair that overlaps by pycpd, keep the more confident; how many pairs there were."""
        observed = observation.elements_in_map()
        both = MapElements.cat([self.elements, observed])
        held = len(self.elements)
        boxes = both.bounds()
        a, b = boxes[held:, None], boxes[None, :held]
        near = (a[..., :2] - gate_m <= b[..., 2:]).all(2) & (b[..., :2] - gate_m <= a[..., 2:]).all(2)
        near &= observed.kind[:, None] == self.elements.kind[None]
        pairs = np.argwhere(near)
        line = resample(*close_rings(both.points, both.offsets, both.closed), samples)[0].reshape(-1, samples, 2)
        ends = np.arange(len(both) + 1) * samples
        distance = chamfer_distance(line.reshape(-1, 2), ends, line.reshape(-1, 2), ends, pairs + (held, 0))
        pairs = pairs[distance < gate_m]
        dropped = np.zeros(len(both), bool)
        for new, old in pairs.tolist():
            one, two = held + new, old
            anchor, other = (one, two) if both.score[one] > both.score[two] else (two, one)
            crowdmap_literal.register(line[anchor], line[other], CpdConfig())
            dropped[other] = True
        self.elements = both.take(~dropped)
        return len(pairs)


def large_map(elements: int, frame: MapFrame) -> VectorMap:
    """Lines of 20 stations on a lattice of streets: three side by side each 30 m, as many as asked for."""
    side = int(np.ceil(np.sqrt(elements / 3)))
    k = np.arange(elements)
    row, column = np.divmod(k // 3, side)
    start = np.stack((column * 30.0, row * 30.0 + (k % 3) * 3.5), 1) - side * 15.0
    points = start[:, None] + np.stack((np.linspace(0.0, 20.0, 20), np.zeros(20)), 1)
    made = MapElements(
        np.full(elements, DIVIDER), np.arange(elements + 1) * 20, points.reshape(-1, 2), np.full(elements, 0.9),
        np.full(elements * 20, 0.1), np.tile((1.0, 0.0, 0.0, 0.0), (elements, 1)),
    )  # fmt: skip
    return VectorMap.of(made, frame, log_odds=4.0)


def stream(elements: int, rounds: int) -> Stream:
    """Observations of a large map's lines, moved by half a metre, one after the other."""
    base = large_map(elements, MapFrame())
    live = IncrementalMap(base)
    spent, counts = [], []
    view = np.array([[-60.0, -50.0], [60.0, -50.0], [60.0, 50.0], [-60.0, 50.0]])
    middles = base.elements.points[base.elements.offsets[:-1]] + (10.0, 0.0)
    for k in range(rounds + 5):
        # A number that has no factor in common with the rows of the lattice walks all over the map.
        at = middles[(k * 7919) % elements]
        near = np.flatnonzero(np.hypot(*(middles - at).T) < 60.0)[:25]
        observed = base.elements.take(near).transform(-float(at[0]), -float(at[1]) + 0.5, 0.0)
        pose, covariance = np.array([at[0], at[1], 0.0]), np.diag((0.5, 0.5, 2e-4))
        observation = Observation(f"agent{k}", "pass", 1000 + k, pose, covariance, view, observed)
        assert observation.id
        began = time.process_time()
        live.update(observation)
        spent.append(1e3 * (time.process_time() - began))
        counts.append(len(near))
    spent = spent[5:]
    return Stream(elements, float(np.mean(counts)), median(spent), max(spent), median(spent) < STREAM_BAR_MS)


def city(elements: int, engine: str, workers: int, crowd: Sequence[Observation], frame: MapFrame) -> City:
    """Ingest, fuse, publish."""
    with tempfile.TemporaryDirectory() as folder:
        store = MapStore.create(Path(folder) / "city", frame)
        load = os.getloadavg()[0]
        with _peak() as peak:
            began = time.perf_counter()
            with store.open_for_writing() as log:
                log.append(crowd)
            ingested = time.perf_counter()
            cpu = _all_cpu()
            tracemalloc.start()
            made = store.fuse(None, TiledFusionConfig(), make_executor(engine, workers), _report_progress)
            driver_mb = tracemalloc.get_traced_memory()[1] / 1e6
            tracemalloc.stop()
            cpu = _all_cpu() - cpu
            ended = time.perf_counter()
        return City(
            engine,
            len(crowd),
            elements,
            made.elements,
            made.content,
            ingested - began,
            ended - ingested,
            cpu,
            *peak,
            driver_mb,
            load,
        )


class _NoWork:
    """An object store that keeps nothing, and an engine whose workers return names at once."""

    location = "nowhere"

    def __init__(self) -> None:
        self.blocks, self.tasks = 0, 0

    def list(self, _: str) -> list[str]:
        """No objects."""
        return []

    def put(self, _: str, __: bytes, durable: bool = True) -> None:
        """Count a block that is planned."""
        self.blocks += 1

    def delete(self, _: Sequence[str]) -> None:
        """Nothing is there."""

    def run(self, _: object, tasks: Iterable[StepTask]) -> Iterator[tuple[int, FusionStepResult]]:
        """Names such as a worker would return."""
        for index, task in enumerate(tasks):
            self.tasks += 1
            names = ("poses", "sums") if task.kind == "solve" else ("poses",)
            yield index, FusionStepResult(tuple(f"{task.folder}/{task.digest}-{task.digest}.{name}" for name in names))


def driver(elements: int, seed: int) -> Driver:
    """Drive a fusion of observations as dense as those of the city, on a square that grows with their number."""
    count = round(elements / ELEMENTS_PER_OBSERVATION)
    side = 1000.0 * float(np.sqrt(count / OBSERVATIONS_PER_KM2))
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        index = LogIndex(Path(folder) / "catalogue.sqlite")
        index.clear("")
        for first in range(0, count, 10_000):
            xy = rng.uniform(0.0, side, (min(10_000, count - first), 2)).tolist()
            rows = [
                IndexRow(rng.bytes(16).hex(), k // 128, k, f"car{k % 977}", x, y, 51.0, "p")
                for k, (x, y) in enumerate(xy)
            ]
            index.add_segment(f"{first:08d}.parquet", rows)
        began, nowhere = time.perf_counter(), _NoWork()
        job = FusionJob(nowhere, nowhere, MapFusionConfig())
        tracemalloc.start()
        fuse_and(len, job, index, TiledFusionConfig(), nowhere)
        driver_mb = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
        return Driver(count, elements, nowhere.blocks, nowhere.tasks, driver_mb, time.perf_counter() - began)


def city_crowd(elements: int, seed: int) -> tuple[tuple[Observation, ...], MapFrame]:
    """Observations of a lattice of streets that grows with their number, until they hold so many elements."""
    side = max(2, round(np.sqrt(elements / 2500)))
    where = load_place(f"grid-{side}", None)
    probe = simulate_crowd(where, 40, CITY, seed)
    count = int(np.ceil(elements / max(_mean_elements(probe.observations), 1.0)))
    return simulate_crowd(
        where, count, CITY, seed, progress=lambda k, n: _report_progress("simulate", k, n)
    ).observations, where.frame


def _mean_elements(many: Sequence[Observation]) -> float:
    return float(np.mean([len(o.elements) for o in many]))


def _cpu(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def _report_progress(name: str, done: int, total: int) -> None:
    if sys.stderr.isatty():
        print(f"\r{name} {done}/{total}   ", end="", file=sys.stderr, flush=True)


def _family() -> list[psutil.Process]:
    own = psutil.Process()
    return [own, *own.children(recursive=True)]


def _all_cpu() -> float:
    """Seconds that this process and its workers, those that ended too, have spent on processors."""
    total = 0.0
    for process in _family():
        try:
            times = process.cpu_times()
        except psutil.NoSuchProcess:
            continue
        total += times.user + times.system + times.children_user + times.children_system
    return total


@contextmanager
def _peak() -> Iterator[list[float]]:
    """The largest resident memory in GB, of all processes and of one worker, once the block has ended."""
    max_gb, ended = [0.0, 0.0], threading.Event()

    def sample_memory() -> None:
        while not ended.wait(0.5):
            sizes = []
            for process in _family():
                try:
                    sizes.append(process.memory_info().rss / 1e9)
                except psutil.NoSuchProcess:
                    continue
            max_gb[:] = max(max_gb[0], sum(sizes)), max(max_gb[1], *sizes[1:], 0.0)

    thread = threading.Thread(target=sample_memory, daemon=True)
    thread.start()
    try:
        yield max_gb
    finally:
        ended.set()
        thread.join()


def _cities(sizes: Sequence[int], engines: Sequence[str], workers: int, seed: int) -> list[City]:
    rows = []
    for size in sizes:
        crowd, frame = city_crowd(size, seed)
        num_elements = sum(len(o.elements) for o in crowd)
        for engine in engines:
            row = city(num_elements, engine, workers, crowd, frame)
            rows.append(row)
            print(
                f"{engine}: {row.observations} observations, {row.elements} elements -> {row.map_elements}, {row.map_hash}: "
                f"ingest {row.ingest_s:.1f} s, fuse and publish {row.fuse_s:.1f} s ({row.fuse_cpu_s:.1f} s of processors), "
                f"{row.peak_gb:.2f} GB, largest worker {row.worker_gb:.2f} GB, driver {row.driver_mb:.1f} MB, load {row.load:.1f}",
                flush=True,
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", default="stream", choices=("literal", "stream", "city", "engines", "driver"))
    parser.add_argument("--elements", type=int, nargs="+")
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--engines", nargs="+", default=["inline", "process", "dask", "ray"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    wanted = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[object] = []
    if wanted.what == "literal":
        for row in literal(wanted.count, wanted.rounds, CITY):
            print(
                f"{row.way}: {row.observations} observations of {row.elements:.1f} elements: ours {1e3 * row.ours_s:.1f} ms, "
                f"literal with pycpd {1e3 * row.literal_s:.0f} ms an observation: {row.times:.0f} times; "
                f"bar {LITERAL_BARS[row.way]:.0f} {_met(row.met)}"
            )
            rows.append(row)
    elif wanted.what == "stream":
        for size in wanted.elements or [100_000]:
            live = stream(size, wanted.rounds * 20)
            print(
                f"map of {live.map_elements} elements, observation of {live.elements:.1f}: {live.median_ms:.2f} ms (most "
                f"{live.most_ms:.2f}); bar {STREAM_BAR_MS:.0f} ms {_met(live.met)}"
            )
            rows.append(live)
    elif wanted.what == "driver":
        for size in wanted.elements or [10_000, 100_000, 1_000_000, 10_000_000]:
            held = driver(size, wanted.seed)
            print(
                f"{held.elements} elements, {held.observations} observations: {held.blocks} blocks, {held.tasks} steps, driver "
                f"{held.driver_mb:.1f} MB, {held.seconds:.0f} s",
                flush=True,
            )
            rows.append(held)
    elif wanted.what == "city":
        cities = _cities(wanted.elements or [10_000, 100_000, 1_000_000], ["process"], wanted.workers, wanted.seed)
        for one in cities:
            if one.elements >= 990_000:
                print(
                    f"bar {CITY_BAR_S:.0f} s, {CITY_BAR_GB:.0f} GB {_met(one.fuse_s <= CITY_BAR_S and one.peak_gb <= CITY_BAR_GB)}"
                )
        rows = list(cities)
    else:
        cities = _cities(wanted.elements or [100_000], wanted.engines, wanted.workers, wanted.seed)
        print("identical" if len({one.map_hash for one in cities}) == 1 else "MAPS DIFFER")
        rows = list(cities)
    if wanted.out:
        settings = {"what": wanted.what, "workers": wanted.workers, "load": os.getloadavg()[0]}
        command = shlex.join(["python", *sys.argv])
        result = {"command": command, "study": f"map-{wanted.what}", "settings": settings, "costs": rows}
        write_json(wanted.out, {**result, "tables": _make_tables(rows)}, settings, wanted.seed)


def _make_tables(rows: Sequence[object]) -> list[dict[str, object]]:
    """Tables for documents, one for each kind of row."""
    cities, drivers = [r for r in rows if isinstance(r, City)], [r for r in rows if isinstance(r, Driver)]
    literals, streams = [r for r in rows if isinstance(r, Literal)], [r for r in rows if isinstance(r, Stream)]
    out: list[dict[str, object]] = []
    if literals:
        headings = ("", "observations", "elements each", "ours [ms]", "literal with pycpd [ms]", "times as fast")
        lines = [
            (
                r.way,
                f"{r.observations}",
                f"{r.elements:.1f}",
                f"{1e3 * r.ours_s:.1f}",
                f"{1e3 * r.literal_s:.0f}",
                f"{r.times:.0f}",
            )
            for r in literals
        ]
        out.append({"title": "Processor time of an observation", "headings": headings, "lines": lines})
    if streams:
        headings = ("elements of the map", "elements of the observation", "median [ms]", "maximum [ms]")
        lines = [
            (f"{r.map_elements:,}", f"{r.elements:.1f}", f"{r.median_ms:.1f}", f"{r.most_ms:.1f}") for r in streams
        ]
        out.append({"title": "One observation into a map", "headings": headings, "lines": lines})
    if cities:
        headings = ("observed elements", "observations", "engine", "fuse and publish [s]", "processor time [s]", "map elements",
                    "driver [MB]", "largest worker [GB]", "all processes [GB]", "load")  # fmt: skip
        lines = [
            (f"{r.elements:,}", f"{r.observations:,}", r.executor, f"{r.fuse_s:.0f}", f"{r.fuse_cpu_s:.0f}", f"{r.map_elements:,}",
             f"{r.driver_mb:.1f}", f"{r.worker_gb:.2f}", f"{r.peak_gb:.2f}", f"{r.load:.1f}")
            for r in cities
        ]  # fmt: skip
        out.append({"title": "City", "headings": headings, "lines": lines})
    if drivers:
        headings = ("observed elements", "observations", "blocks", "steps given out", "driver [MB]")
        lines = [
            (f"{r.elements:,}", f"{r.observations:,}", f"{r.blocks:,}", f"{r.tasks:,}", f"{r.driver_mb:.1f}")
            for r in drivers
        ]
        out.append({"title": "Driver", "headings": headings, "lines": lines})
    return out


def _met(met: bool) -> str:
    return "met" if met else "MISSED"


if __name__ == "__main__":
    main()
