# SPDX-License-Identifier: Apache-2.0
"""Scenarios to disk in OPV2V's layout, by any number of processes with the same bytes, and a manifest of what was made.

A folder belongs to one run: layout, preset, seed and specifications. A run continues in its own folder, keeps the scenarios
that are finished after a check of their digests, and refuses every other folder before it changes anything.
"""

from __future__ import annotations

import json
import multiprocessing
import platform
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import torch

from manyeyes._io import atomic_rename, atomic_write_text, flush_files, remove_unfinished
from manyeyes._lock import hold_folder
from manyeyes._workers import start_worker
from manyeyes.datasets.formats.yaml_file import load_yaml
from manyeyes.datasets.manifest import (
    MANIFEST,
    PARTIAL,
    SCENARIO,
    UNFINISHED_MANIFEST,
    Digests,
    compute_total_digest,
    digest_files,
    list_scenario_files,
    read_manifest,
)
from manyeyes.datasets.missing import FileProblem
from manyeyes.datasets.opv2v import Opv2vWriter
from manyeyes.datasets.opv2v.metadata import AGENT_BODIES, PROTOCOL
from manyeyes.datatypes import ConfigError, ManyeyesError, RecordingError
from manyeyes.maps.roads.road_network import RoadNetwork
from manyeyes.simulator.folder_state import (
    Damage,
    FolderState,
    ManifestEntry,
    RecordingPlan,
    clean_draft,
    draft_of,
    install_draft,
    parse_entry,
    require_own_folder,
    require_repairable,
    require_sound,
)
from manyeyes.simulator.scene.scenario import RSU_ID, NoSceneError, ScenarioSpec, SimulatedScenario, make_scenario
from manyeyes.simulator.scene.towns import load_town

APART = "apart"
"""Setting AGENT_BODIES of manifests and protocols where no agent lists the body of an agent as a vehicle; absent: agents do."""
BEFORE_LAWS = {"intensity": "material"}
"""What a specification stated implicitly before it named an intensity law."""
_STEP_S = 0.05
_ATTEMPTS = 40
JobT = TypeVar("JobT")


@dataclass(frozen=True)
class Job:
    """One scenario to write.

    split: folder. towns: first place to search for the roads of its town; None for the default places. lists_agents: as in
    :class:`manyeyes.datasets.opv2v.Opv2vWriter`; a run sets it to what its folder has.
    """

    split: str
    spec: ScenarioSpec
    towns: str | None = None
    lists_agents: bool = False


@dataclass(frozen=True)
class RecordingProgress:
    """How far a recording is: scenarios done of all, and the one that was just finished."""

    done: int
    total: int
    name: str


def record(
    jobs: list[Job],
    out: Path | str,
    workers: int = 1,
    progress: Callable[[RecordingProgress], None] | None = None,
    settings: dict[str, str | int] | None = None,
    on_repair: Callable[[FileProblem], None] | None = None,
) -> Path:
    """Write all jobs under ``out/<split>/<name>`` and ``out/manifest.json``; the manifest's path.

    What a former run finished under the same settings is checked and kept; what it left half-written is made again. Each
    process works with one thread. settings: what names this recording (preset, seed), for the manifest. on_repair: receives every
    missing or altered file of a finished scenario before it is simulated again; None makes these files an error.

    Raises:
        ConfigError: the folder holds another recording; nothing in it was changed.
        RecordingError: a file of a finished scenario is missing or altered; nothing was changed.
        FolderInUseError: another process writes to the folder.
    """
    root = Path(out)
    if workers < 1:
        raise ConfigError(f"record needs workers >= 1; got {workers}.")
    names = [(job.split, job.spec.name) for job in jobs]
    if len(set(names)) < len(names):
        raise ConfigError("Two scenarios of one split have one name; give each its own.")
    asked = {f"{job.split}/{job.spec.name}/{SCENARIO}": _plain(asdict(job.spec)) for job in jobs}
    with hold_folder(root):
        lists_agents = _lists_agents(root, any(job.lists_agents for job in jobs))
        jobs = [replace(job, lists_agents=lists_agents) for job in jobs]
        layout = {} if lists_agents else {AGENT_BODIES: APART}
        plan = RecordingPlan("OPV2V", {**(settings or {}), **layout}, asked, names)
        found = sorted(p for p in root.glob(f"*/*/{SCENARIO}") if p.parent.suffix != PARTIAL)
        state = FolderState.read(root, plan, found, read_finished)
        require_own_folder(state, {place: content["spec"] for place, content in state.contents.items()})
        kept = keep_finished(state, repair_scenario, dict(zip(asked, jobs)), workers, _check, on_repair)
        todo = {name: job for name, job in zip(names, jobs) if name not in kept}
        entries = kept | run_unfinished(record_scenario, todo, root, workers, plan, progress)
        if todo or not (root / MANIFEST).is_file():
            write_manifest(root, plan, [asdict(entries[name]) for name in names])
        (root / UNFINISHED_MANIFEST).unlink(missing_ok=True)
    return root / MANIFEST


def _lists_agents(root: Path, wanted: bool) -> bool:
    """Return whether agents list the bodies of agents as vehicles: as the folder's run did, else as wanted.

    A recording that was begun before the setting existed has none, and goes on as it is.
    """
    content = read_manifest(root)
    if content is not None:
        return content["settings"].get(AGENT_BODIES) != APART
    protocols = (path.with_name(PROTOCOL) for path in sorted(root.glob(f"*/*/{SCENARIO}")))
    protocol = next((path for path in protocols if path.is_file()), None)
    return wanted if protocol is None else load_yaml(protocol).get(AGENT_BODIES) != APART


def keep_finished(
    state: FolderState,
    work: Callable[[tuple[JobT, Damage], Path], ManifestEntry],
    jobs: Mapping[str, JobT],
    workers: int,
    check: Callable[[Path, str], Sequence[FileProblem]],
    on_repair: Callable[[FileProblem], None] | None,
) -> dict[tuple[str, str], ManifestEntry]:
    """Check the finished scenarios of a folder, and repair them where on_repair is given; their entries by split and name.

    Args:
        state: of the folder, which is this run's.
        work: simulates again what a job's scenario lacks.
        jobs: by place.
        workers: number of processes.
        check: compares the files of a place with their digests.
        on_repair: as in :func:`record`.
    """
    root, names = state.root, dict(zip(state.plan.requested_specs, state.plan.names))
    damages = state.find_damage(partial(check, root))
    if on_repair is None:
        require_sound([problem for damage in damages for problem in damage.problems])
    require_repairable(root, damages)
    remove_unfinished(root)
    for place in names:
        with clean_draft(draft_of(root, place)):  # of a repair that was stopped
            pass
    for damage in damages:
        for problem in damage.problems:
            assert on_repair is not None
            on_repair(problem)
    for _ in run_jobs(work, [(jobs[damage.place], damage) for damage in damages], root, workers):
        pass
    require_sound([problem for damage in damages for problem in check(root, damage.place)])
    kept = {names[place]: parse_entry(content) for place, content in state.contents.items()}
    return kept | {names[damage.place]: damage.entry for damage in damages}


def run_unfinished(
    work: Callable[[JobT, Path], ManifestEntry],
    jobs: Mapping[tuple[str, str], JobT],
    root: Path,
    workers: int,
    plan: RecordingPlan,
    progress: Callable[[RecordingProgress], None] | None,
) -> dict[tuple[str, str], ManifestEntry]:
    """Run the jobs of scenarios that are not finished, by split and name, while the root is marked as unfinished."""
    total, kept = len(plan.names), [name for name in plan.names if name not in jobs]
    if progress is not None:
        for count, (split, name) in enumerate(kept, 1):
            progress(RecordingProgress(count, total, f"{split}/{name}"))
    if not jobs:
        return {}
    root.mkdir(parents=True, exist_ok=True)
    write_json(root / UNFINISHED_MANIFEST, plan.manifest())
    entries: dict[tuple[str, str], ManifestEntry] = {}
    try:
        for _, entry in run_jobs(work, list(jobs.values()), root, workers):
            entries[entry.split, entry.name] = entry
            if progress is not None:
                progress(RecordingProgress(len(kept) + len(entries), total, f"{entry.split}/{entry.name}"))
    except ManyeyesError:
        if not kept and not entries:
            (root / UNFINISHED_MANIFEST).unlink(missing_ok=True)  # nothing was made that another run could damage
        raise
    return entries


def write_manifest(root: Path, plan: RecordingPlan, scenarios: Sequence[Mapping[str, Any]]) -> None:
    """Write the manifest of a finished run."""
    content = {
        "format": plan.layout,
        "settings": dict(plan.settings),
        "versions": package_versions(),
        "scenarios": list(scenarios),
    }
    write_json(root / MANIFEST, content)


def run_jobs(
    work: Callable[[JobT, Path], ManifestEntry], jobs: Sequence[JobT], root: Path, workers: int
) -> Iterator[tuple[JobT, ManifestEntry]]:
    """Finished jobs, in whatever order; work is a function of its module, for it is sent to other processes."""
    if workers == 1:
        for job in jobs:
            yield job, work(job, root)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, max(1, len(jobs))), context, start_worker) as pool:
        running: dict[Future[ManifestEntry], JobT] = {pool.submit(work, job, root): job for job in jobs}
        try:
            while running:
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    job = running.pop(future)
                    yield job, future.result()
        finally:
            pool.shutdown(cancel_futures=True)


@lru_cache(maxsize=2)
def _network(town: str, towns: str | None) -> RoadNetwork:
    return load_town(town, towns)


def record_scenario(job: Job, root: Path) -> ManifestEntry:
    """Write one scenario; a folder without the suffix .partial is whole."""
    folder = root / job.split / job.spec.name
    with clean_draft(folder.with_name(f"{folder.name}{PARTIAL}")) as draft:
        scenario = make_first_scenario(job.spec, job.towns)
        entry = _finish(job, scenario, draft, _write(job, scenario, draft))
        atomic_rename(draft, folder)
    return entry


def repair_scenario(damaged: tuple[Job, Damage], root: Path) -> ManifestEntry:
    """Simulate again the files that a finished scenario lacks."""
    job, damage = damaged
    with clean_draft(draft_of(root, damage.place)) as draft:
        scenario = make_first_scenario(job.spec, job.towns)
        if damage.names is None:
            _finish(job, scenario, draft, _write(job, scenario, draft))
        else:
            stems = {Path(name).name.partition(".")[0].partition("_")[0] for name in damage.names}
            _write(job, scenario, draft, {round(int(s) * _STEP_S * job.spec.rate_hz) for s in stems if s.isdigit()})
        install_draft(root, damage)
    return damage.entry


def _finish(job: Job, scenario: SimulatedScenario, draft: Path, points: int) -> ManifestEntry:
    """Flush the files of a scenario, and write the one that marks it as finished."""
    files = list_scenario_files(draft)
    digests = digest_files(files, draft)
    agents = _agents(scenario)
    entry = ManifestEntry(
        split=job.split,
        name=job.spec.name,
        town=job.spec.town,
        seed=scenario.spec.seed,
        agents=agents,
        frames=len(scenario),
        history_frames=job.spec.lead_frames + job.spec.history_frames,
        vehicles=len(scenario.states[0].id),
        moving=round(scenario.moving_fraction, 4),
        points=points,
        returns=points // (len(agents) * len(scenario)),
        files=len(files),
        bytes=sum(p.stat().st_size for p in files),
        sha256=compute_total_digest(digests),
    )
    flush_files(files)
    write_json(draft / SCENARIO, {"spec": asdict(job.spec), "entry": asdict(entry), "files": digests})
    return entry


def make_first_scenario(spec: ScenarioSpec, towns: str | None, roadside: bool = False) -> SimulatedScenario:
    """Return the scenario of the first of the seeds s, s + 1, … whose traffic offers one; roadside: with a unit on a pole."""
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


def _write(job: Job, scenario: SimulatedScenario, folder: Path, frames: Collection[int] | None = None) -> int:
    """Write the protocol and these frames, all for None; returns the number of points."""
    spec, points = scenario.spec, 0
    # What training draws other intensity laws from must not be rounded.
    has_float_intensity = spec.sensor_mix != "none"
    writer = Opv2vWriter(folder, _STEP_S, has_float_intensity=has_float_intensity, lists_agents=job.lists_agents)
    for index in range(len(scenario)) if frames is None else sorted(frames):
        snapshot = scenario.snapshot(index)
        writer.write(snapshot, torch.from_numpy(scenario.states[index].speed))
        points += sum(len(frame.points) for frame in snapshot.frames)
    writer.close(
        {
            "history_frames": spec.lead_frames + spec.history_frames,
            **({} if job.lists_agents else {AGENT_BODIES: APART}),
            "world": {"fixed_delta_seconds": _STEP_S, "town": spec.town, "seed": spec.seed},
            "simulation": asdict(spec),
            "lidar": {str(agent): scenario.lidar(agent).describe() for agent in _agents(scenario)},
        }
    )
    return points


def _agents(scenario: SimulatedScenario) -> tuple[int, ...]:
    return (*scenario.agents, *((RSU_ID,) if scenario.roadside is not None else ()))


def read_finished(path: Path) -> dict[str, Any]:
    """Return the content of scenario.json, its specification with the defaults of fields that an older version did not have."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        parse_entry(content)
        return {**content, "spec": _plain(asdict(ScenarioSpec(**{**BEFORE_LAWS, **content["spec"]})))}
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}: expected what a recording run writes; {error}: remove the folder.") from error


def _check(root: Path, place: str) -> list[FileProblem]:
    """Compare a finished scenario with its digests."""
    path = root / place
    digests, folder = Digests.read(path), path.parent
    if digests is None:
        return [FileProblem(path, "mismatched", folder.name, "it has no digests")]
    return digests.check(folder, f"{folder.parent.name}/{folder.name}", list_scenario_files(folder))


def _plain(content: Any) -> Any:
    """Return values as JSON gives them back."""
    return json.loads(json.dumps(content))


def package_versions() -> dict[str, str]:
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
    atomic_write_text(path, json.dumps(content, indent=1) + "\n")
