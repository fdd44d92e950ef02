# SPDX-License-Identifier: Apache-2.0
"""What a folder of the simulator holds: whose run it is, what its finished scenarios lack, and the repair of that.

The authority is ``manifest.json`` in a finished folder, else the digests that each finished scenario has.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from manyeyes._io import atomic_rename, flush_files
from manyeyes._text import count_noun
from manyeyes.datasets.dair_v2x.index import find_dair_root
from manyeyes.datasets.manifest import (
    BATCHES,
    MANIFEST,
    PARTIAL,
    SCENARIO,
    UNFINISHED_MANIFEST,
    Digests,
    read_manifest,
    sha256_of,
)
from manyeyes.datasets.missing import FileProblem
from manyeyes.datasets.opv2v.scan import has_frames
from manyeyes.datatypes import ConfigError, RecordingError

_UNCHANGED = "Nothing was changed: choose another --out, or remove the folder yourself."


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


def require_own_folder(state: FolderState, finished: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse a folder that holds another recording than that of the plan.

    Args:
        state: of the folder, which need not exist.
        finished: specifications of the finished scenarios in the folder, by their places.

    Raises:
        ConfigError: what is there, what is wanted, and the remedy.
    """
    root, plan = state.root, state.plan
    finished = {**{place: plan.requested_specs[place] for place in state.lacking}, **finished}
    if not root.is_dir():
        return
    content, wanted = read_manifest(root), plan.manifest()
    same_run = content is None or (content["format"], content["settings"]) == (wanted["format"], wanted["settings"])
    foreign = _foreign_scenarios(root, plan, finished) if same_run else []
    if foreign:
        raise ConfigError(
            f"{root} holds {count_noun(len(foreign), 'scenario folder')} that no run of 'manyeyes simulate' for this layout "
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
        f"{root} holds {count_noun(count, 'finished scenario')} {there}; this run makes {len(plan.names)} "
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


@dataclass(frozen=True)
class Damage:
    """Missing and altered files of a finished scenario.

    place: of the file that marks it as finished. problems: one a file. names: paths of the files to simulate again, relative to the
    folder of the scenario's files; None for all. entry: of the manifest, or of the marking file in a folder without one.
    """

    place: str
    problems: tuple[FileProblem, ...]
    names: frozenset[str] | None
    entry: ManifestEntry


@dataclass(frozen=True)
class FolderState:
    """Finished scenarios of a folder.

    contents: of the files that mark them as finished, by place. lacking: by place, marking files of scenarios of the manifest that
    are missing or damaged. listed: entries of the manifest of a finished folder, by split and name.
    """

    root: Path
    plan: RecordingPlan
    contents: Mapping[str, Mapping[str, Any]]
    lacking: Mapping[str, FileProblem]
    listed: Mapping[tuple[str, str], ManifestEntry]

    @classmethod
    def read(
        cls, root: Path, plan: RecordingPlan, found: Sequence[Path], read: Callable[[Path], Mapping[str, Any]]
    ) -> FolderState:
        """Read the marking files that were found; only those of scenarios of the manifest may be damaged."""
        listed = _read_listed(root) if (root / MANIFEST).is_file() else {}
        names = {place: name for name, place in zip(plan.names, plan.requested_specs) if name in listed}
        reason = f"{MANIFEST} lists it"
        lacking = {
            place: FileProblem(path if path.parent.is_dir() else path.parent, "missing", "/".join(name), reason)
            for place, name in names.items()
            if not (path := root / place).is_file()
        }
        contents = {}
        for path in found:
            place = path.relative_to(root).as_posix()
            try:
                contents[place] = read(path)
            except RecordingError:
                if place not in names:
                    raise
                reason = "it is not what a recording run writes"
                lacking[place] = FileProblem(path, "mismatched", "/".join(names[place]), reason)
        return cls(root, plan, contents, lacking, listed)

    def find_damage(self, check: Callable[[str], Sequence[FileProblem]]) -> list[Damage]:
        """Compare the finished scenarios with the manifest; check compares the files of a place with their digests."""
        out = []
        for (split, name), place in zip(self.plan.names, self.plan.requested_specs):
            listed = self.listed.get((split, name))
            if place in self.lacking:
                assert listed is not None
                out.append(Damage(place, (self.lacking[place],), None, listed))
                continue
            if place not in self.contents:
                continue
            entry = parse_entry(self.contents[place])
            if listed not in (None, entry):
                reason = f"its entry is not that of {MANIFEST}"
                problem = FileProblem(self.root / place, "mismatched", f"{split}/{name}", reason)
                out.append(Damage(place, (problem,), None, listed))
            elif problems := check(place):
                names = _repairable_names(self.root, place, problems)
                out.append(Damage(place, tuple(problems), names, entry))
        return out


def _read_listed(root: Path) -> dict[tuple[str, str], ManifestEntry]:
    """Read the entries of a finished folder's manifest, by split and name."""
    content = read_manifest(root)
    try:
        entries = [parse_entry({"entry": entry}) for entry in content["scenarios"]] if content else []
    except (KeyError, TypeError) as error:
        raise RecordingError(
            f"{root / MANIFEST}: an entry lacks {error}. Nothing was changed: remove this file and run again."
        ) from error
    return {(entry.split, entry.name): entry for entry in entries}


def _repairable_names(root: Path, place: str, problems: Sequence[FileProblem]) -> frozenset[str] | None:
    """Return the paths of those files that have digests; None where the scenario has a total only."""
    digests, base = Digests.read(root / place), base_of(root, place)
    if digests is None or digests.by_path is None:
        return None
    names = (problem.path.relative_to(base).as_posix() for problem in problems)
    return frozenset(name for name in names if name in digests.by_path)


def base_of(root: Path, place: str) -> Path:
    """Return the folder to which the paths of a scenario's files are relative."""
    return root if place.startswith(f"{BATCHES}/") else (root / place).parent


def draft_of(root: Path, place: str) -> Path:
    """Return the folder of a scenario's files while they are simulated."""
    path = root / place
    return (
        path.with_suffix(PARTIAL)
        if place.startswith(f"{BATCHES}/")
        else path.parent.with_name(f"{path.parent.name}{PARTIAL}")
    )


@contextmanager
def clean_draft(draft: Path) -> Iterator[Path]:
    """Yield an empty draft folder's path; what is left of the folder at the end is removed."""
    if draft.exists():
        shutil.rmtree(draft)
    try:
        yield draft
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def require_sound(problems: Sequence[FileProblem]) -> None:
    """Refuse missing and altered files of finished scenarios.

    Raises:
        RecordingError: the files by name, and the remedy.
    """
    if not problems:
        return
    first, others = problems[0], [str(problem.path) for problem in problems[1:]]
    more = f"; also {', '.join(others[:3])}" if others else ""
    more += f" and {len(others) - 3} more" if len(others) > 3 else ""
    raise RecordingError(
        f"{first.path}: {first.kind} in the finished scenario {first.scenario} ({first.reason}){more}. Nothing was changed: "
        f"add --repair to simulate {'these files' if others else 'this file'} again."
    )


def require_repairable(root: Path, damages: Sequence[Damage]) -> None:
    """Refuse files in finished scenarios that no run wrote."""
    for damage in damages:
        for problem in damage.problems:
            name = problem.path.relative_to(base_of(root, damage.place)).as_posix()
            if damage.names is not None and name not in damage.names:
                raise RecordingError(
                    f"{problem} in {problem.scenario}. Nothing was changed: remove this file yourself."
                )


def install_draft(root: Path, damage: Damage) -> None:
    """Move the files that were simulated again into their scenario, the marking file last.

    Raises:
        RecordingError: they are not those of the first run; nothing was changed.
    """
    base, draft = base_of(root, damage.place), draft_of(root, damage.place)
    marker = (root / damage.place).relative_to(base).as_posix()
    if damage.names is None:
        content = json.loads((draft / marker).read_text(encoding="utf-8"))
        names, is_same = [*content["files"], marker], parse_entry(content) == damage.entry
    else:
        digests = Digests.read(root / damage.place)
        assert digests is not None and digests.by_path is not None
        names, by_path = sorted(damage.names), digests.by_path
        is_same = all((draft / name).is_file() and sha256_of(draft / name) == by_path[name] for name in names)
    if not is_same:
        raise RecordingError(
            f"{root / damage.place}: simulated again, its files are not those of the first run; another version of manyeyes or of "
            f"its packages wrote them ({MANIFEST} lists versions). Nothing was changed: restore the files, or choose another --out."
        )
    flush_files(draft / name for name in names)
    for name in names:
        (base / name).parent.mkdir(parents=True, exist_ok=True)
        atomic_rename(draft / name, base / name)


def parse_entry(content: Mapping[str, Any]) -> ManifestEntry:
    """Return the entry of a finished scenario."""
    entry = {field.name: content["entry"][field.name] for field in fields(ManifestEntry)}
    return ManifestEntry(**{**entry, "agents": tuple(entry["agents"])})
