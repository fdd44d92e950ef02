# SPDX-License-Identifier: Apache-2.0
"""Scenarios to disk in DAIR-V2X's layout: a vehicle and a unit on a pole at a crossing, in any number of processes."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from manyeyes._io import atomic_write_text, flush_files
from manyeyes._lock import hold_folder
from manyeyes.datasets.dair_v2x.writer import DairRows, DairWriter, list_pair_files, make_dair_index
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
    require_sound,
)
from manyeyes.simulator.record import (
    BEFORE_LAWS,
    Job,
    RecordingProgress,
    keep_finished,
    make_first_scenario,
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
    on_repair: Callable[[FileProblem], None] | None = None,
) -> Path:
    """Write all drives into one root in DAIR-V2X's layout, with its split file and a manifest; the manifest's path.

    What a former run finished under the same settings is checked and kept, or repaired as in
    :func:`~manyeyes.simulator.record.record`. Drives are numbered in the order of jobs, frames throughout.

    Raises:
        ConfigError: the folder holds another recording; nothing in it was changed.
        RecordingError: a file of a finished drive is missing or altered; nothing was changed.
        FolderInUseError: another process writes to the folder.
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
    with hold_folder(root):
        state = FolderState.read(root, plan, sorted((root / BATCHES).glob("*.json")), _content)
        require_own_folder(state, {place: content["asked"] for place, content in state.contents.items()})
        kept = keep_finished(state, repair_drive, {_place(one): one for one in work}, workers, _check, on_repair)
        todo = {name: one for name, one in zip(names, work) if name not in kept}
        if not todo and (root / MANIFEST).is_file():
            _keep_index(root, work, on_repair)
        else:
            entries = kept | run_unfinished(record_drive, todo, root, workers, plan, progress)
            for path, text in _make_index(root, work).items():
                atomic_write_text(path, text)
            scenarios = [{"batch": one.batch_id, **asdict(entries[name])} for name, one in zip(names, work)]
            write_manifest(root, plan, scenarios)
        (root / UNFINISHED_MANIFEST).unlink(missing_ok=True)
    return root / MANIFEST


def _make_index(root: Path, work: Sequence[DairJob]) -> dict[Path, str]:
    """Make the texts of the index files of all drives from their rows."""
    drives = [_rows(root, one) for one in work]
    splits: dict[str, list[str]] = {}
    for one, rows in zip(work, drives):
        splits.setdefault(one.job.split, []).extend(rows.frames)
    return make_dair_index(root, drives, splits)


def _keep_index(root: Path, work: Sequence[DairJob], on_repair: Callable[[FileProblem], None] | None) -> None:
    """Compare the index files of a finished folder with the rows of its drives, and write them again where on_repair is given."""
    texts = _make_index(root, work)
    problems = []
    for path, text in texts.items():
        if not path.is_file():
            problems.append(FileProblem(path, "missing", "of all drives", "every reader needs it"))
        elif path.read_bytes() != text.encode():
            problems.append(FileProblem(path, "mismatched", "of all drives", f"it is not that of {BATCHES}"))
    if on_repair is None:
        require_sound(problems)
    for problem in problems:
        assert on_repair is not None
        on_repair(problem)
        atomic_write_text(problem.path, texts[problem.path])


def record_drive(one: DairJob, root: Path) -> ManifestEntry:
    """Write one drive's files, its rows of the indices last."""
    scenario = _make_scenario(one)
    writer = DairWriter(root, str(one.batch_id), one.job.spec.town)
    return _finish(one, scenario, writer, _write(scenario, writer, one.first_frame))


def repair_drive(damaged: tuple[DairJob, Damage], root: Path) -> ManifestEntry:
    """Simulate again the files that a finished drive lacks."""
    one, damage = damaged
    with clean_draft(draft_of(root, damage.place)) as draft:
        scenario = _make_scenario(one)
        writer = DairWriter(draft, str(one.batch_id), one.job.spec.town)
        if damage.names is None:
            _finish(one, scenario, writer, _write(scenario, writer, one.first_frame))
        else:
            _write(scenario, writer, one.first_frame, {int(Path(name).stem) for name in damage.names})
        install_draft(root, damage)
    return damage.entry


def _make_scenario(one: DairJob) -> SimulatedScenario:
    spec = one.job.spec
    fast = replace(spec, frames=_STEPS * spec.frames, rate_hz=_STEPS * spec.rate_hz, history_frames=0)
    return make_first_scenario(fast, one.job.towns, roadside=True)


def _finish(one: DairJob, scenario: SimulatedScenario, writer: DairWriter, points: int) -> ManifestEntry:
    """Flush the files of a drive, and write the one that marks it as finished."""
    spec, files = one.job.spec, sorted(writer.files)
    digests = digest_files(files, writer.root)
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
    flush_files(files)
    content = {"asked": _make_request(one), "entry": asdict(entry), "rows": asdict(writer.rows), "files": digests}
    write_json(writer.root / _place(one), content)
    return entry


def _write(
    scenario: SimulatedScenario, writer: DairWriter, first_frame: int, ids: Collection[int] | None = None
) -> int:
    """Write the pairs with these ids, all of a drive for None; returns the number of points."""
    spec, points = scenario.spec, 0
    random = keyed_generator(spec.seed, "dair", spec.town)
    lag = int(random.integers(_MAX_LAG_STEPS + 1))
    offset = tuple(round(float(v), 4) for v in random.normal(0, _OFFSET_SIGMA_M, 2))
    for number, index in enumerate(range(_STEPS - 1, len(scenario), _STEPS)):
        if ids is not None and first_frame + number not in ids:
            continue
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


def _check(root: Path, place: str) -> list[FileProblem]:
    """Compare a finished drive with its digests."""
    content, digests = _content(root / place), Digests.read(root / place)
    entry = content["entry"]
    if digests is None:
        return [FileProblem(root / place, "mismatched", entry["name"], "it has no digests")]
    files = sorted(p for stem in DairRows(**content["rows"]).frames for p in list_pair_files(root, stem) if p.is_file())
    return digests.check(root, f"{entry['split']}/{entry['name']}", files, place)


def _content(path: Path) -> dict[str, Any]:
    """Return the content of a drive's file, its specification with the defaults of fields that an older version did not have."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        spec = ScenarioSpec(**{**BEFORE_LAWS, **content["asked"]["spec"]})
        asked = {**content["asked"], "spec": asdict(spec)}
        parse_entry(content)
        DairRows(**content["rows"])
        return {"asked": json.loads(json.dumps(asked)), "entry": content["entry"], "rows": content["rows"]}
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}: expected what a recording run writes; {error}: remove the file.") from error
