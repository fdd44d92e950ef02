# SPDX-License-Identifier: Apache-2.0
"""Scenarios to disk in DAIR-V2X's layout: a vehicle and a unit on a pole at a crossing, in any number of processes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from manyeyes.datasets.dair_v2x.writer import DairRows, DairWriter, list_index_files, list_pair_files, write_dair_index
from manyeyes.datasets.manifest import (
    BATCHES,
    MANIFEST,
    UNFINISHED_MANIFEST,
    Digests,
    compute_total_digest,
    digest_files,
)
from manyeyes.datasets.missing import FileProblem
from manyeyes.datatypes import ConfigError, RecordingError
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.simulator.record import (
    Job,
    ManifestEntry,
    RecordingPlan,
    RecordingProgress,
    make_first_scenario,
    parse_entry,
    require_listed,
    require_own_folder,
    require_sound,
    run_unfinished,
    write_json,
    write_manifest,
)
from manyeyes.simulator.scene.scenario import RSU_ID, ScenarioSpec, SimulatedScenario

# The world is stepped so many times between two pairs, and the pole's sweep is at most _LATEST steps older than the
# vehicle's: 0 or 20 ms at 10 pairs a second. Chosen; DAIR-V2X's own pairs are not simultaneous either.
_STEPS = 5
_MAX_LAG_STEPS = 1
# Standard deviation of system_error_offset along each axis; of the real pairs they lie in -1.1 … 0.7 m (recordings.md).
_OFFSET_SIGMA_M = 0.4


@dataclass(frozen=True)
class DairJob:
    """One drive: the job, the number that is its ``batch_id``, and the id of its first frame."""

    job: Job
    batch_id: int
    first_frame: int


def record_dair(
    jobs: list[Job],
    out: Path | str,
    workers: int = 1,
    progress: Callable[[RecordingProgress], None] | None = None,
    settings: dict[str, str | int] | None = None,
) -> Path:
    """Write all drives into one root in DAIR-V2X's layout, with its split file and a manifest; the manifest's path.

    What a former run finished under the same settings is checked and kept. Drives are numbered in the order of jobs, frames
    throughout.

    Raises:
        ConfigError: the folder holds another recording; nothing in it was changed.
        RecordingError: a file of a finished drive is missing or damaged; nothing was changed.
    """
    root = Path(out)
    if workers < 1:
        raise ConfigError(f"record_dair needs workers >= 1; got {workers}.")
    if any(job.spec.vehicles != 1 for job in jobs):
        raise ConfigError("DAIR-V2X has one vehicle a drive; give every ScenarioSpec vehicles=1.")
    names = [(job.split, job.spec.name) for job in jobs]
    if len(set(names)) < len(names):
        raise ConfigError("Two drives of one split have one name; give each its own.")
    starts = [sum(job.spec.frames for job in jobs[:i]) for i in range(len(jobs))]
    work = [DairJob(job, i, start) for i, (job, start) in enumerate(zip(jobs, starts))]
    plan = RecordingPlan("DAIR-V2X", settings or {}, {_place(one): _make_request(one) for one in work}, names)
    finished = {p.relative_to(root).as_posix(): _content(p) for p in sorted((root / BATCHES).glob("*.json"))}
    require_own_folder(root, plan, {place: content["asked"] for place, content in finished.items()})
    require_sound(root, {place: _check(root, place, content) for place, content in finished.items()})
    require_listed(root, {place: content["entry"] for place, content in finished.items()})
    kept = {name: parse_entry(finished[_place(one)]) for name, one in zip(names, work) if _place(one) in finished}
    todo = {name: one for name, one in zip(names, work) if name not in kept}
    entries = kept | run_unfinished(record_drive, todo, root, workers, plan, progress)
    if todo or not all(path.is_file() for path in (root / MANIFEST, *list_index_files(root))):
        drives = [_rows(root, one) for one in work]
        splits: dict[str, list[str]] = {}
        for one, rows in zip(work, drives):
            splits.setdefault(one.job.split, []).extend(rows.frames)
        write_dair_index(root, drives, splits)
        scenarios = [{"batch": one.batch_id, **asdict(entries[name])} for name, one in zip(names, work)]
        write_manifest(root, plan, scenarios)
    (root / UNFINISHED_MANIFEST).unlink(missing_ok=True)
    return root / MANIFEST


def record_drive(one: DairJob, root: Path) -> ManifestEntry:
    """Write one drive's files, its rows of the indices last."""
    spec = one.job.spec
    fast = replace(spec, frames=_STEPS * spec.frames, rate_hz=_STEPS * spec.rate_hz, history_frames=0)
    scenario = make_first_scenario(fast, one.job.towns, roadside=True)
    writer = DairWriter(root, str(one.batch_id), spec.town)
    points = _write(scenario, writer, one.first_frame)
    rows = writer.rows
    files = sorted(writer.files)
    digests = digest_files(files, root)
    agents = (*scenario.agents, RSU_ID)
    entry = ManifestEntry(
        split=one.job.split,
        name=spec.name,
        town=spec.town,
        seed=scenario.spec.seed,
        agents=agents,
        frames=spec.frames,
        history_frames=0,
        vehicles=len(scenario.states[0].id),
        moving=round(scenario.moving_fraction, 4),
        points=points,
        returns=points // (len(agents) * spec.frames),
        files=len(files),
        bytes=sum(p.stat().st_size for p in files),
        sha256=compute_total_digest(digests),
    )
    content = {"asked": _make_request(one), "entry": asdict(entry), "rows": asdict(rows), "files": digests}
    (root / BATCHES).mkdir(exist_ok=True)
    write_json(root / _place(one), content)
    return entry


def _write(scenario: SimulatedScenario, writer: DairWriter, first_frame: int) -> int:
    """Return all pairs of a drive; the number of points."""
    spec, points = scenario.spec, 0
    random = keyed_generator(spec.seed, "dair", spec.town)
    lag = int(random.integers(_MAX_LAG_STEPS + 1))
    offset = tuple(round(float(v), 4) for v in random.normal(0, _OFFSET_SIGMA_M, 2))
    for number, index in enumerate(range(_STEPS - 1, len(scenario), _STEPS)):
        snapshot = scenario.snapshot(index)
        unit = scenario.snapshot(index - lag) if lag else snapshot
        writer.write(snapshot, first_frame + number, unit, (offset[0], offset[1]))
        points += len(snapshot.frames[0].points) + len(unit.frames[1].points)
    return points


def _place(one: DairJob) -> str:
    """Return the file that marks a drive as finished."""
    return f"{BATCHES}/{one.batch_id:06d}.json"


def _make_request(one: DairJob) -> dict[str, Any]:
    asked = {"split": one.job.split, "first_frame": one.first_frame, "spec": asdict(one.job.spec)}
    return json.loads(json.dumps(asked))


def _rows(root: Path, one: DairJob) -> DairRows:
    return DairRows(**_content(root / _place(one))["rows"])


def _check(root: Path, place: str, content: Mapping[str, Any]) -> list[FileProblem]:
    """Compare a finished drive with its digests."""
    entry, digests = content["entry"], Digests.read(root / place)
    if digests is None:
        return [FileProblem(root / place, "mismatched", entry["name"], "it has no digests")]
    files = sorted(p for stem in DairRows(**content["rows"]).frames for p in list_pair_files(root, stem) if p.is_file())
    return digests.check(root, f"{entry['split']}/{entry['name']}", files, place)


def _content(path: Path) -> dict[str, Any]:
    """Return the content of a drive's file, its specification with the defaults of fields that an older version did not have."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        asked = {**content["asked"], "spec": asdict(ScenarioSpec(**content["asked"]["spec"]))}
        parse_entry(content)
        DairRows(**content["rows"])
        return {"asked": json.loads(json.dumps(asked)), "entry": content["entry"], "rows": content["rows"]}
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}: expected what a recording run writes; {error}: remove the file.") from error
