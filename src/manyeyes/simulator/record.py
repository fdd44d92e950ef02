# SPDX-License-Identifier: Apache-2.0
"""Scenarios to disk in OPV2V's layout, by any number of processes with the same bytes, and a manifest of what was made."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import platform
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TypeVar

import torch

from manyeyes.datasets.opv2v import Opv2vWriter
from manyeyes.datatypes import ConfigError, RecordingError
from manyeyes.maps.road_network import RoadNetwork
from manyeyes.simulator.lidar import lidar_spec
from manyeyes.simulator.scenario import NoSceneError, Scenario, ScenarioSpec, make_scenario
from manyeyes.simulator.towns import load_town

MANIFEST = "manifest.json"
_ENTRY = "scenario.json"
_STEP_S = 0.05
_ATTEMPTS = 40
JobT = TypeVar("JobT")


@dataclass(frozen=True)
class Job:
    """One scenario to write: into which split, and where the town's roads are looked for (None: the usual places)."""

    split: str
    spec: ScenarioSpec
    towns: str | None = None


@dataclass(frozen=True)
class Entry:
    """What the manifest says of one scenario.

    seed: the one that gave a scene, which is the wanted one plus as many as failed. moving: share of the vehicles near it
    that move. returns: mean points of a sweep. sha256: of the lines ``<sha256 of a file>  <path in the scenario>``, sorted by path.
    """

    split: str
    name: str
    town: str
    seed: int
    agents: tuple[int, ...]
    frames: int
    history_frames: int
    vehicles: int
    moving: float
    points: int
    returns: int
    files: int
    bytes: int
    sha256: str


@dataclass(frozen=True)
class Progress:
    """How far a recording is: scenarios done of all, and the one that was just finished."""

    done: int
    total: int
    name: str


def record(
    jobs: list[Job],
    out: Path | str,
    workers: int = 1,
    progress: Callable[[Progress], None] | None = None,
    settings: dict[str, str | int] | None = None,
) -> Path:
    """Write all jobs under ``out/<split>/<name>`` and ``out/manifest.json``; the manifest's path.

    What a former run finished under the same settings is kept; what it left half-written is made again. Each process
    works with one thread. settings: what names this recording (preset, seed), for the manifest.
    """
    root = Path(out)
    if workers < 1:
        raise ConfigError(f"record needs workers >= 1; got {workers}.")
    names = [(job.split, job.spec.name) for job in jobs]
    if len(set(names)) < len(names):
        raise ConfigError("Two scenarios of one split have one name; give each its own.")
    root.mkdir(parents=True, exist_ok=True)
    entries: dict[tuple[str, str], Entry] = {}
    for count, (job, entry) in enumerate(run_jobs(record_scenario, jobs, root, workers), 1):
        entries[job.split, job.spec.name] = entry
        if progress is not None:
            progress(Progress(count, len(jobs), f"{job.split}/{job.spec.name}"))
    content = {
        "format": "OPV2V",
        "settings": settings or {},
        "versions": versions(),
        "scenarios": [asdict(entries[name]) for name in names],
    }
    write_json(root / MANIFEST, content)
    return root / MANIFEST


def run_jobs(
    work: Callable[[JobT, Path], Entry], jobs: Sequence[JobT], root: Path, workers: int
) -> Iterator[tuple[JobT, Entry]]:
    """Finished jobs, in whatever order; work is a function of its module, for it is sent to other processes."""
    if workers == 1:
        for job in jobs:
            yield job, work(job, root)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, max(1, len(jobs))), context, _start_worker) as pool:
        running: dict[Future[Entry], JobT] = {pool.submit(work, job, root): job for job in jobs}
        try:
            while running:
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    job = running.pop(future)
                    yield job, future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _start_worker() -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)


@lru_cache(maxsize=2)
def _network(town: str, towns: str | None) -> RoadNetwork:
    return load_town(town, towns)


def record_scenario(job: Job, root: Path) -> Entry:
    """Write one scenario, or read back the entry of a former run; a folder without the suffix .partial is whole."""
    folder = root / job.split / job.spec.name
    kept = _kept(folder, job.spec)
    if kept is not None:
        return kept
    for stale in (folder, folder.with_name(f"{folder.name}.partial")):
        if stale.exists():
            shutil.rmtree(stale)
    scenario = first_scene(job.spec, job.towns)
    partial = folder.with_name(f"{folder.name}.partial")
    points = _write(scenario, partial)
    files = sorted(p for p in partial.rglob("*") if p.is_file())
    agents = (*scenario.agents, *((-1,) if scenario.roadside is not None else ()))
    entry = Entry(
        split=job.split,
        name=job.spec.name,
        town=job.spec.town,
        seed=scenario.spec.seed,
        agents=agents,
        frames=len(scenario),
        history_frames=job.spec.lead_frames + job.spec.history_frames,
        vehicles=len(scenario.states[0].id),
        moving=round(scenario.moving_share, 4),
        points=points,
        returns=points // (len(agents) * len(scenario)),
        files=len(files),
        bytes=sum(p.stat().st_size for p in files),
        sha256=digest_of(files, partial),
    )
    write_json(partial / _ENTRY, {"spec": asdict(job.spec), "entry": asdict(entry)})
    partial.rename(folder)
    return entry


def digest_of(files: list[Path], folder: Path) -> str:
    """What Entry.sha256 is, of files below a folder."""
    lines = [f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.relative_to(folder).as_posix()}" for p in files]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def first_scene(spec: ScenarioSpec, towns: str | None, roadside: bool = False) -> Scenario:
    """The scenario of the first of the seeds s, s + 1, … whose traffic offers one; roadside: with a unit on a pole."""
    network = _network(spec.town, towns)
    reason = ""
    for attempt in range(_ATTEMPTS):
        try:
            scenario = make_scenario(replace(spec, seed=spec.seed + attempt), network)
        except NoSceneError as error:
            reason = str(error)
            continue
        if scenario.roadside is not None or not roadside:
            return scenario
        reason = f"seed {spec.seed + attempt} has no place for a pole"
    raise NoSceneError(f"{spec.name}: none of {_ATTEMPTS} seeds gives a scene in {spec.town}; last: {reason}")


def _write(scenario: Scenario, folder: Path) -> int:
    """All frames and the protocol; the number of points."""
    spec, points = scenario.spec, 0
    writer = Opv2vWriter(folder, _STEP_S)
    for index in range(len(scenario)):
        snapshot = scenario.snapshot(index)
        writer.write(snapshot, torch.from_numpy(scenario.states[index].speed))
        points += sum(len(frame.points) for frame in snapshot.frames)
    sensors = {"vehicle": asdict(lidar_spec(spec.lidar))}
    if scenario.roadside is not None:
        sensors["roadside"] = asdict(scenario.roadside.lidar)
    writer.close(
        {
            "history_frames": spec.lead_frames + spec.history_frames,
            "world": {"fixed_delta_seconds": _STEP_S, "town": spec.town, "seed": spec.seed},
            "simulation": asdict(spec),
            "lidar": sensors,
        }
    )
    return points


def _kept(folder: Path, spec: ScenarioSpec) -> Entry | None:
    path = folder / _ENTRY
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text())
        if ScenarioSpec(**content["spec"]) != spec:
            return None
        entry = content["entry"]
        return Entry(**{**entry, "agents": tuple(entry["agents"])})
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}: expected what a recording run writes; {error}: remove the folder.") from error


def versions() -> dict[str, str]:
    """Of Python and of the packages that a recording depends on."""
    found = {"python": platform.python_version()}
    for package in ("manyeyes", "numpy", "numba", "torch", "libsumo"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    return found


def write_json(path: Path, content: object) -> None:
    """Write a file whole or not at all."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_text(json.dumps(content, indent=1) + "\n")
    temporary.replace(path)
