# SPDX-License-Identifier: Apache-2.0
"""Scenarios to disk in DAIR-V2X's layout: a vehicle and a unit on a pole at a crossing, in any number of processes."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from manyeyes.datasets.dair_writer import DairRows, DairWriter, write_dair_index
from manyeyes.datatypes import ConfigError, RecordingError
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.simulator.record import (
    MANIFEST,
    Entry,
    Job,
    Progress,
    digest_of,
    first_scene,
    run_jobs,
    versions,
    write_json,
)
from manyeyes.simulator.scenario import RSU_ID, Scenario

BATCHES = "batches"
# The world is stepped so many times between two pairs, and the pole's sweep is at most _LATEST steps older than the
# vehicle's: 0 or 20 ms at 10 pairs a second. Chosen; DAIR-V2X's own pairs are not simultaneous either.
_STEPS = 5
_LATEST = 1
# Standard deviation of system_error_offset along each axis; of the real pairs they lie in -1.1 … 0.7 m (recordings.md).
_OFFSET_SIGMA_M = 0.4


@dataclass(frozen=True)
class DairJob:
    """One drive: the job, the number that is its ``batch_id``, and the id of its first frame."""

    job: Job
    batch: int
    first_frame: int


def record_dair(
    jobs: list[Job],
    out: Path | str,
    workers: int = 1,
    progress: Callable[[Progress], None] | None = None,
    settings: dict[str, str | int] | None = None,
) -> Path:
    """Write all drives into one root in DAIR-V2X's layout, with its split file and a manifest; the manifest's path.

    What a former run finished under the same settings is kept. Drives are numbered in the order of jobs, frames throughout.
    """
    root = Path(out)
    if workers < 1:
        raise ConfigError(f"record_dair needs workers >= 1; got {workers}.")
    if any(job.spec.vehicles != 1 for job in jobs):
        raise ConfigError("DAIR-V2X has one vehicle a drive; give every ScenarioSpec vehicles=1.")
    (root / BATCHES).mkdir(parents=True, exist_ok=True)
    starts = [sum(job.spec.frames for job in jobs[:i]) for i in range(len(jobs))]
    work = [DairJob(job, i, start) for i, (job, start) in enumerate(zip(jobs, starts))]
    entries: dict[int, Entry] = {}
    for count, (one, entry) in enumerate(run_jobs(record_drive, work, root, workers), 1):
        entries[one.batch] = entry
        if progress is not None:
            progress(Progress(count, len(work), f"{one.job.split}/{one.job.spec.name}"))
    drives = [_rows(root, one) for one in work]
    splits: dict[str, list[str]] = {}
    for one, rows in zip(work, drives):
        splits.setdefault(one.job.split, []).extend(rows.frames)
    write_dair_index(root, drives, splits)
    content = {
        "format": "DAIR-V2X",
        "settings": settings or {},
        "versions": versions(),
        "scenarios": [{"batch": one.batch, **asdict(entries[one.batch])} for one in work],
    }
    write_json(root / MANIFEST, content)
    return root / MANIFEST


def record_drive(one: DairJob, root: Path) -> Entry:
    """Write one drive's files, its rows of the indices last; or read back the entry of a former run."""
    kept = _kept(root, one)
    if kept is not None:
        return kept
    spec = one.job.spec
    fast = replace(spec, frames=_STEPS * spec.frames, rate_hz=_STEPS * spec.rate_hz, history_frames=0)
    scenario = first_scene(fast, one.job.towns, roadside=True)
    writer = DairWriter(root, str(one.batch), spec.town)
    points = _write(scenario, writer, one.first_frame)
    rows = writer.rows
    files = sorted(writer.files)
    agents = (*scenario.agents, RSU_ID)
    entry = Entry(
        split=one.job.split,
        name=spec.name,
        town=spec.town,
        seed=scenario.spec.seed,
        agents=agents,
        frames=spec.frames,
        history_frames=0,
        vehicles=len(scenario.states[0].id),
        moving=round(scenario.moving_share, 4),
        points=points,
        returns=points // (len(agents) * spec.frames),
        files=len(files),
        bytes=sum(p.stat().st_size for p in files),
        sha256=digest_of(files, root),
    )
    write_json(_batch_file(root, one), {"asked": _asked(one), "entry": asdict(entry), "rows": asdict(rows)})
    return entry


def _write(scenario: Scenario, writer: DairWriter, first_frame: int) -> int:
    """All pairs of a drive; the number of points."""
    spec, points = scenario.spec, 0
    random = keyed_generator(spec.seed, "dair", spec.town)
    lag = int(random.integers(_LATEST + 1))
    offset = tuple(round(float(v), 4) for v in random.normal(0, _OFFSET_SIGMA_M, 2))
    for number, index in enumerate(range(_STEPS - 1, len(scenario), _STEPS)):
        snapshot = scenario.snapshot(index)
        unit = scenario.snapshot(index - lag) if lag else snapshot
        writer.write(snapshot, first_frame + number, unit, (offset[0], offset[1]))
        points += len(snapshot.frames[0].points) + len(unit.frames[1].points)
    return points


def _batch_file(root: Path, one: DairJob) -> Path:
    return root / BATCHES / f"{one.batch:06d}.json"


def _asked(one: DairJob) -> dict[str, object]:
    asked = {"split": one.job.split, "first_frame": one.first_frame, "spec": asdict(one.job.spec)}
    return json.loads(json.dumps(asked))


def _kept(root: Path, one: DairJob) -> Entry | None:
    path = _batch_file(root, one)
    if not path.is_file():
        return None
    content = _content(path)
    if content.get("asked") != _asked(one):
        return None
    entry = content["entry"]
    return Entry(**{**entry, "agents": tuple(entry["agents"])})


def _rows(root: Path, one: DairJob) -> DairRows:
    return DairRows(**_content(_batch_file(root, one))["rows"])


def _content(path: Path) -> dict:
    try:
        content = json.loads(path.read_text())
        return {key: content[key] for key in ("asked", "entry", "rows")}
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}: expected what a recording run writes; {error}: remove the file.") from error
