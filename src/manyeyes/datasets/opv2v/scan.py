# SPDX-License-Identifier: Apache-2.0
"""What a folder in OPV2V's layout holds, by the names of its files: scenarios, agents, frames, and what is missing."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from manyeyes.datasets.manifest import PARTIAL, list_scenarios
from manyeyes.datasets.missing import FileProblem
from manyeyes.datasets.opv2v.camera import describe_missing_images, find_missing_images, image_path
from manyeyes.datatypes import RecordingError

_AGENT = re.compile(r"-?\d+")
PCD, BINARY = ".pcd", ".bin"
# What lies in folders of other layouts whose names are numbers, too.
_FOREIGN = ("velodyne", "poses.csv")
SPLIT_FOLDERS = {"val": "validate"}
"""Folders of splits whose name is another one."""


@dataclass(frozen=True)
class AgentFiles:
    """One agent's files. stems: of frames with a cloud and metadata; pictures: stems that a camera lacks, by its number.

    binary: those of clouds that are ``.bin`` files, not ``.pcd``.
    """

    id: int
    folder: Path
    clouds: frozenset[str]
    records: frozenset[str]
    pictures: Mapping[int, Sequence[str]]
    binary: frozenset[str] = frozenset()

    def cloud_path(self, stem: str) -> Path:
        """Return the path of a frame's cloud."""
        return self.folder / f"{stem}{BINARY if stem in self.binary else PCD}"

    @cached_property
    def stems(self) -> frozenset[str]:
        """Stems of the frames that have both files."""
        return self.clouds & self.records


@dataclass(frozen=True)
class ScenarioFiles:
    """One scenario's files. stems: of the ego's frames, ascending."""

    folder: Path
    agents: tuple[AgentFiles, ...]
    stems: tuple[str, ...]


def _subfolders(folder: Path) -> list[Path]:
    with os.scandir(folder) as entries:  # knows folders from files without asking the disk again
        return sorted(folder / e.name for e in entries if e.is_dir() and not e.name.startswith("."))


def _is_scenario(folder: Path) -> bool:
    return any(_is_agent(p) for p in _subfolders(folder))


def _is_agent(folder: Path) -> bool:
    is_foreign = any((folder / name).exists() for name in _FOREIGN)
    return _AGENT.fullmatch(folder.name) is not None and not is_foreign and not _is_scenario(folder)


def contains_scenarios(path: Path) -> bool:
    """Return whether a folder is a scenario, holds some, or holds splits with some, by names alone."""
    if not path.is_dir():
        return False
    inside = _subfolders(path)
    return (
        _is_scenario(path)
        or any(map(_is_scenario, inside))
        or any(_is_scenario(q) for p in inside for q in _subfolders(p))
    )


def has_frames(folder: Path) -> bool:
    """Return whether a folder has agents with clouds or metadata, that is, whether it is a scenario with anything in it."""
    agents = [p for p in _subfolders(folder) if _AGENT.fullmatch(p.name)]
    return any(p.suffix in (PCD, BINARY, ".yaml") and p.stem.isdecimal() for agent in agents for p in agent.iterdir())


def get_split_folder(root: Path, split: str | None) -> Path:
    """Return the folder of a split, the root without one."""
    folder = root / (split or "")
    return folder if split not in SPLIT_FOLDERS or folder.is_dir() else root / SPLIT_FOLDERS[split]


def _split_names(folders: Sequence[Path]) -> str:
    names = {folder: split for split, folder in SPLIT_FOLDERS.items()}
    return ", ".join(names.get(folder.name, folder.name) for folder in folders)


def find_scenario_folders(root: Path, split: str | None) -> list[Path]:
    """Find the folders to scan, after the root was checked; the text of every error lists what is there instead."""
    if not root.is_dir():
        raise RecordingError(f"{root}: no such folder, expected a recording in OPV2V's layout; check the path.")
    folder = get_split_folder(root, split)
    if split is not None and (not folder.is_dir() or split in SPLIT_FOLDERS.values()):
        if any(_is_scenario(p) for p in _subfolders(root)) or _is_scenario(root):
            raise RecordingError(f"{root}: no split '{split}': the folder holds scenarios itself; name no split.")
        raise RecordingError(
            f"{root}: no split '{split}'; it has {_split_names(_subfolders(root)) or 'none'}: choose one of them."
        )
    if _is_scenario(folder):
        return [folder]
    inside = _subfolders(folder)
    if any(_is_scenario(p) for p in inside):
        return inside
    splits = [p for p in inside if any(_is_scenario(q) for q in _subfolders(p))]
    if splits:
        raise RecordingError(
            f"{folder}: holds several splits ({_split_names(splits)}), expected scenarios; name a split."
        )
    raise RecordingError(
        f"{folder}: no scenario in it, expected <scenario>/<agent>/<stem>.pcd and .yaml; check the path."
    )


def scan_scenario(folder: Path, problems: list[str], missing: list[FileProblem], images: bool) -> ScenarioFiles | None:
    """List what a scenario's folder holds, by names alone; what is missing is added to problems and to missing."""
    if folder.name.endswith(PARTIAL):
        reason = "an interrupted run of 'manyeyes simulate' left it unfinished"
        problems.append(f"{folder}: {reason}, the scenario is left out")
        missing.append(FileProblem(folder, "missing", folder.name.removesuffix(PARTIAL), reason))
        return None
    names = [p for p in _subfolders(folder) if _AGENT.fullmatch(p.name)]
    ordered = [p for p in names if int(p.name) >= 0] + [p for p in names if int(p.name) < 0]
    everyone = [_scan_agent(p, problems, images) for p in ordered]
    missing += _absent_files(folder, everyone)
    agents = [a for a in everyone if a.stems]
    if not agents:
        problems.append(f"{folder}: no agent with a whole frame, the scenario is left out")
        return None
    stems = tuple(sorted(agents[0].stems, key=int))
    for agent in agents[1:]:
        lacking = sorted(agents[0].stems - agent.stems, key=int)
        surplus = sorted(agent.stems - agents[0].stems, key=int)
        if lacking:
            text = (
                f"lacks {len(lacking)} of the ego's {len(stems)} frames, the first is {lacking[0]}; it is absent there"
            )
            problems.append(f"{agent.folder}: {text}")
        if surplus:
            text = f"has {len(surplus)} frames that the ego {agents[0].id} lacks, the first is {surplus[0]}; left out"
            problems.append(f"{agent.folder}: {text}")
    return ScenarioFiles(folder, tuple(agents), stems)


def _scan_agent(folder: Path, problems: list[str], images: bool) -> AgentFiles:
    everything = list(folder.iterdir())
    files = [p for p in everything if p.stem.isdecimal()]
    with_header = frozenset(p.stem for p in files if p.suffix == PCD)
    binary = frozenset(p.stem for p in files if p.suffix == BINARY) - with_header
    clouds, cloud_suffix = with_header | binary, "bin" if len(binary) > len(with_header) else "pcd"
    records = frozenset(p.stem for p in files if p.suffix == ".yaml")
    if not clouds and not records:
        problems.append(f"{folder}: holds neither pcd nor yaml, the agent is left out")
    for there, suffix in ((clouds - records, "yaml"), (records - clouds, cloud_suffix)):
        if there:
            count = f"{len(there)} of {len(clouds | records)} frames"
            problems.append(f"{folder}: {count} lack their {suffix}, the first is {min(there, key=int)}; left out")
    stems = sorted(clouds & records, key=int)
    if images:
        problems += [f"{folder}: {line}" for line in describe_missing_images(everything, stems)]
    return AgentFiles(
        int(folder.name), folder, clouds, records, find_missing_images(everything, stems) if images else {}, binary
    )


def _absent_files(folder: Path, agents: Sequence[AgentFiles]) -> Iterator[FileProblem]:
    """Find the files that a scenario lacks: every stem of any agent is expected of all."""
    stems = frozenset[str]().union(*(agent.clouds | agent.records for agent in agents))
    # A folder of something else may stand beside the scenarios; an empty one was a scenario.
    if not stems and (agents or (folder / "data_protocol.yaml").is_file() or not any(folder.iterdir())):
        yield FileProblem(folder, "missing", folder.name, "no agent of the scenario has a frame")
    for agent in agents:
        for stem in sorted(stems, key=int):
            cloud_suffix = "bin" if agent.binary else "pcd"
            for there, beside, suffix in (
                (agent.clouds, agent.records, cloud_suffix),
                (agent.records, agent.clouds, "yaml"),
            ):
                if stem not in there:
                    reason = "the other file of its frame is there" if stem in beside else "other agents have the frame"
                    yield FileProblem(agent.folder / f"{stem}.{suffix}", "missing", folder.name, reason)
        for number, lacking in agent.pictures.items():
            for stem in lacking:
                path = image_path(agent.folder, stem, number)
                yield FileProblem(path, "missing", folder.name, "the camera has pictures of other frames")


def compare_with_manifest(folders: Sequence[Path], problems: list[str], missing: list[FileProblem]) -> None:
    """Add the scenarios of a split that the manifest of the simulator lists and that are not there."""
    split = folders[0].parent
    root = split.absolute().parent
    absent = set(list_scenarios(root, split.absolute().name)) - {folder.name for folder in folders}
    for name in sorted(absent - {problem.scenario for problem in missing}):
        reason = "the recording's manifest lists this scenario"
        problems.append(f"{split / name}: not there, and {reason}")
        missing.append(FileProblem(split / name, "missing", name, reason))
