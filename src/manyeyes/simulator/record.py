# SPDX-License-Identifier: Apache-2.0
"""Scenarios to disk in OPV2V's layout, by any number of processes with the same bytes, and a manifest of what was made.

A folder belongs to one run: layout, preset, seed and specifications. A run continues in its own folder, keeps the scenarios
that are finished after a check of their digests, and refuses every other folder before it changes anything.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import platform
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import torch

from manyeyes._io import atomic_write_text
from manyeyes.datasets.dair_v2x.index import find_dair_root
from manyeyes.datasets.manifest import (
    BATCHES,
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
from manyeyes.datasets.opv2v.scan import has_frames
from manyeyes.datatypes import ConfigError, ManyeyesError, RecordingError
from manyeyes.maps.roads.road_network import RoadNetwork
from manyeyes.simulator.scene.scenario import NoSceneError, ScenarioSpec, SimulatedScenario, make_scenario
from manyeyes.simulator.scene.towns import load_town
from manyeyes.simulator.sensors.lidar import lidar_spec

_STEP_S = 0.05
_UNCHANGED = "Nothing was changed: choose another --out, or remove the folder yourself."
_ATTEMPTS = 40
JobT = TypeVar("JobT")


@dataclass(frozen=True)
class Job:
    """One scenario to write: folder of its split, first place to search for the roads of its town (None: the default places)."""

    split: str
    spec: ScenarioSpec
    towns: str | None = None


@dataclass(frozen=True)
class ManifestEntry:
    """The manifest's entry of one scenario.

    seed: the one that gave a scene: the requested one plus the number of failed ones. moving: fraction of the vehicles near it
    that move. returns: mean points of a sweep. sha256: of the lines ``<sha256 of a file>  <path in the scenario>``, sorted by
    path.
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
class RecordingProgress:
    """How far a recording is: scenarios done of all, and the one that was just finished."""

    done: int
    total: int
    name: str


@dataclass(frozen=True)
class RecordingPlan:
    """What a run writes.

    layout: OPV2V or DAIR-V2X. settings: what names the run (preset, seed). requested_specs: the specification of each scenario as
    plain JSON, by the place of the file that marks it as finished, relative to the root. names: split and name of each scenario.
    """

    layout: str
    settings: Mapping[str, str | int]
    requested_specs: Mapping[str, Mapping[str, Any]]
    names: Sequence[tuple[str, str]]

    def manifest(self) -> dict[str, Any]:
        """Return the manifest of the run while it is unfinished."""
        digest = hashlib.sha256(json.dumps(self.requested_specs, sort_keys=True).encode()).hexdigest()
        scenarios = [{"split": split, "name": name} for split, name in self.names]
        return {"format": self.layout, "settings": dict(self.settings), "asked": digest, "scenarios": scenarios}


def record(
    jobs: list[Job],
    out: Path | str,
    workers: int = 1,
    progress: Callable[[RecordingProgress], None] | None = None,
    settings: dict[str, str | int] | None = None,
) -> Path:
    """Write all jobs under ``out/<split>/<name>`` and ``out/manifest.json``; the manifest's path.

    What a former run finished under the same settings is checked and kept; what it left half-written is made again. Each
    process works with one thread. settings: what names this recording (preset, seed), for the manifest.

    Raises:
        ConfigError: the folder holds another recording; nothing in it was changed.
        RecordingError: a file of a finished scenario is missing or damaged; nothing was changed.
    """
    root = Path(out)
    if workers < 1:
        raise ConfigError(f"record needs workers >= 1; got {workers}.")
    names = [(job.split, job.spec.name) for job in jobs]
    if len(set(names)) < len(names):
        raise ConfigError("Two scenarios of one split have one name; give each its own.")
    asked = {f"{job.split}/{job.spec.name}/{SCENARIO}": _plain(asdict(job.spec)) for job in jobs}
    plan = RecordingPlan("OPV2V", settings or {}, asked, names)
    found = sorted(p for p in root.glob(f"*/*/{SCENARIO}") if p.parent.suffix != PARTIAL)
    finished = {path.relative_to(root).as_posix(): read_finished(path) for path in found}
    require_own_folder(root, plan, {place: content["spec"] for place, content in finished.items()})
    require_sound(root, {place: _check(root / place) for place in finished})
    kept = {name: parse_entry(finished[place]) for name, place in zip(names, asked) if place in finished}
    require_listed(root, {place: content["entry"] for place, content in finished.items()})
    entries = kept | run_unfinished(
        record_scenario,
        {name: job for name, job in zip(names, jobs) if name not in kept},
        root,
        workers,
        plan,
        progress,
    )
    if len(kept) < len(names) or not (root / MANIFEST).is_file():
        write_manifest(root, plan, [asdict(entries[name]) for name in names])
    (root / UNFINISHED_MANIFEST).unlink(missing_ok=True)
    return root / MANIFEST


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


def require_own_folder(root: Path, plan: RecordingPlan, finished: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse a folder that holds another recording than that of the plan.

    Args:
        root: the folder; it need not exist.
        plan: what is to be written.
        finished: specifications of the finished scenarios in the folder, by their places.

    Raises:
        ConfigError: what is there, what is wanted, and the remedy.
    """
    if not root.is_dir():
        return
    content, wanted = read_manifest(root), plan.manifest()
    same_run = content is None or (content["format"], content["settings"]) == (wanted["format"], wanted["settings"])
    foreign = _foreign_scenarios(root, plan, finished) if same_run else []
    if foreign:
        raise ConfigError(
            f"{root} holds {_count(len(foreign), 'scenario folder')} that no run of 'manyeyes simulate' for this layout "
            f"wrote, the first is {foreign[0]}. {_UNCHANGED}"
        )
    other = [place for place, asked in finished.items() if plan.requested_specs.get(place) != asked]
    there = "of a run without a manifest" if content is None else _describe(content)
    if same_run and not other:
        if content is None or content.get("asked", wanted["asked"]) == wanted["asked"]:
            return
        there += " with other specifications (cameras, towns or version)"
    why = f" ({_difference(other[0], finished, plan)})" if same_run and other else ""
    count = len(list(root.glob(f"*/*/{SCENARIO}"))) + len(list(root.glob(f"{BATCHES}/*.json")))
    raise ConfigError(
        f"{root} holds {_count(count, 'finished scenario')} {there}; this run makes {len(plan.names)} "
        f"{_describe(wanted)}{why}. {_UNCHANGED}"
    )


def _foreign_scenarios(root: Path, plan: RecordingPlan, finished: Mapping[str, Any]) -> list[Path]:
    """Folders with frames that no finished scenario of the layout accounts for; unfinished ones end in PARTIAL."""
    folders = [root, *_folders(root), *(inner for folder in _folders(root) for inner in _folders(folder))]
    own = {(root / place).parent for place in finished} if plan.layout == "OPV2V" else set()
    foreign = [f for f in folders if f not in own and (has_frames(f) or (f / SCENARIO).is_file())]
    if plan.layout == "OPV2V":
        taken = [(root / place).parent for place in plan.requested_specs]
        foreign += [f for f in taken if f not in own and f not in foreign and f.is_dir() and any(f.iterdir())]
    begun = finished or (root / UNFINISHED_MANIFEST).is_file() or (root / MANIFEST).is_file()
    dair = find_dair_root(root)
    if dair is not None and not (plan.layout == "DAIR-V2X" and dair == root and begun):
        foreign.append(dair)
    return foreign


def _folders(folder: Path) -> list[Path]:
    """Folders in a folder that may hold a recording."""
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".") and p.suffix != PARTIAL)


def _describe(content: Mapping[str, Any]) -> str:
    """Settings and layout of a manifest as text."""
    settings = ", ".join(f"{name} {value!r}" for name, value in content["settings"].items()) or "no named settings"
    return f"of {settings} in the layout of {content['format']}"


def _difference(place: str, finished: Mapping[str, Mapping[str, Any]], plan: RecordingPlan) -> str:
    """What of a finished scenario is not that of the plan."""
    if place not in plan.requested_specs:
        only = next((other for other in plan.requested_specs if other not in finished), "")
        instead = f", which has {_format_scenario(only)}" if only else ""
        return (
            f"{_format_scenario(place)} is not one of this run{instead}; do both runs find the roads of the same towns?"
        )
    there, wanted = _flat(finished[place]), _flat(plan.requested_specs[place])
    name = next(name for name in {**there, **wanted} if there.get(name) != wanted.get(name))
    return f"{_format_scenario(place)} has {name} {there.get(name)!r} instead of {wanted.get(name)!r}"


def _format_scenario(place: str) -> str:
    return place.removesuffix(f"/{SCENARIO}")


def _flat(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return a specification without its nesting."""
    flat: dict[str, Any] = {}
    for name, value in asked.items():
        flat.update(value if isinstance(value, dict) else {name: value})
    return flat


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def require_sound(root: Path, problems: Mapping[str, Sequence[FileProblem]]) -> None:
    """Refuse finished scenarios with missing or damaged files; problems: by the place that marks each as finished."""
    found = [(place, problem) for place, some in problems.items() for problem in some]
    if not found:
        return
    _, first = found[0]
    more = f", and {len(found) - 1} more" if len(found) > 1 else ""
    damaged = [str(_removable(root, place)) for place in dict.fromkeys(place for place, _ in found)]
    others = f" and {len(damaged) - 4} more" if len(damaged) > 4 else ""
    raise RecordingError(
        f"{first.path}: {first.kind} in the finished scenario {first.scenario} ({first.reason}){more}. Nothing was changed: "
        f"remove {', '.join(damaged[:4])}{others} and run again."
    )


def require_listed(root: Path, entries: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse finished scenarios that are not those of the manifest; entries: by the place that marks each as finished."""
    content = read_manifest(root) if (root / MANIFEST).is_file() else None
    if content is None:
        return
    listed = {(entry["split"], entry["name"]): entry for entry in content["scenarios"]}
    for place, entry in entries.items():
        noted = listed.get((entry["split"], entry["name"]), entry)
        if any(noted.get(name) != value for name, value in entry.items()):
            raise RecordingError(
                f"{root / place}: its entry is not that of {root / MANIFEST}. Nothing was changed: remove "
                f"{_removable(root, place)} and run again."
            )


def _removable(root: Path, place: str) -> Path:
    """What a user removes to have a scenario made again."""
    return root / place if place.startswith(f"{BATCHES}/") else (root / place).parent


def run_jobs(
    work: Callable[[JobT, Path], ManifestEntry], jobs: Sequence[JobT], root: Path, workers: int
) -> Iterator[tuple[JobT, ManifestEntry]]:
    """Finished jobs, in whatever order; work is a function of its module, for it is sent to other processes."""
    if workers == 1:
        for job in jobs:
            yield job, work(job, root)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, max(1, len(jobs))), context, _start_worker) as pool:
        running: dict[Future[ManifestEntry], JobT] = {pool.submit(work, job, root): job for job in jobs}
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


def record_scenario(job: Job, root: Path) -> ManifestEntry:
    """Write one scenario; a folder without the suffix .partial is whole."""
    folder = root / job.split / job.spec.name
    partial = folder.with_name(f"{folder.name}{PARTIAL}")
    if partial.exists():
        shutil.rmtree(partial)
    scenario = make_first_scenario(job.spec, job.towns)
    points = _write(scenario, partial)
    files = list_scenario_files(partial)
    digests = digest_files(files, partial)
    agents = (*scenario.agents, *((-1,) if scenario.roadside is not None else ()))
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
    write_json(partial / SCENARIO, {"spec": asdict(job.spec), "entry": asdict(entry), "files": digests})
    partial.rename(folder)
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


def _write(scenario: SimulatedScenario, folder: Path) -> int:
    """Return all frames and the protocol; the number of points."""
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


def read_finished(path: Path) -> dict[str, Any]:
    """Return the content of scenario.json, its specification with the defaults of fields that an older version did not have."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        parse_entry(content)
        return {**content, "spec": _plain(asdict(ScenarioSpec(**content["spec"])))}
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}: expected what a recording run writes; {error}: remove the folder.") from error


def parse_entry(content: Mapping[str, Any]) -> ManifestEntry:
    """Return the entry of a finished scenario."""
    return ManifestEntry(**{**content["entry"], "agents": tuple(content["entry"]["agents"])})


def _check(path: Path) -> list[FileProblem]:
    """Compare a finished scenario with its digests."""
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
