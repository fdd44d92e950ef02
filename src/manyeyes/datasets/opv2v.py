# SPDX-License-Identifier: Apache-2.0
"""OPV2V and V2XSet, read and written: ``<split>/<scenario>/<agent>/<stem>.{pcd,yaml}``, and ``<stem>_camera0.png`` ….

On disk everything is left-handed, in degrees and km/h, and points lie in the LiDAR's frame. What comes out is
right-handed, in radians and m/s, and points lie in the agent's frame, whose z = 0 is the road. The format has neither
the time of a point, nor an agent's estimate of its own error (both read as zero), nor vehicles that no agent lists.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from manyeyes.datasets.base import require_index
from manyeyes.datasets.cache import ArrayCache, default_cache_folder
from manyeyes.datasets.carla import carla_from_transform, mirror_points, transform_from_carla
from manyeyes.datasets.ground_height import PLAUSIBLE_HEIGHT_M, estimate_sensor_height
from manyeyes.datasets.image_io import write_png
from manyeyes.datasets.manifest import PARTIAL, SCENARIO, Digests, list_scenario_files, list_scenarios
from manyeyes.datasets.mismatch import find_mismatched_files
from manyeyes.datasets.missing import FileProblem, MissingFiles
from manyeyes.datasets.opv2v_camera import (
    camera_yaml,
    describe_missing_images,
    find_missing_images,
    image_path,
    read_images,
)
from manyeyes.datasets.opv2v_yaml import (
    AgentRecord,
    DataProtocol,
    read_protocol,
    read_record,
    write_protocol,
    write_record,
)
from manyeyes.datasets.pcd import PcdCloud, read_pcd, write_pcd
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, RecordingError, Snapshot, Transform

_AGENT = re.compile(r"-?\d+")
_KMH = 3.6
_MAX_CACHED_RECORDS = 20_000


@dataclass(frozen=True)
class _AgentFiles:
    """One agent's files. stems: of frames with a cloud and metadata; pictures: stems that a camera lacks, by its number."""

    id: int
    folder: Path
    clouds: frozenset[str]
    records: frozenset[str]
    pictures: Mapping[int, Sequence[str]]

    @cached_property
    def stems(self) -> frozenset[str]:
        return self.clouds & self.records


@dataclass(frozen=True)
class _ScenarioFiles:
    folder: Path
    agents: tuple[_AgentFiles, ...]
    stems: tuple[str, ...]


class Opv2vRecording:
    """Scenarios of OPV2V's layout under a root: a dataset (name the split), a folder of scenarios, or one scenario.

    The ego is the first agent by string order, infrastructure comes last, and the ego's frames are the snapshots; an
    agent that lacks a frame is left out of that snapshot. What is missing stands in ``missing_summary``, one line each; with
    strict it is an error instead. Clouds are read when a snapshot is asked for; pictures too, with images=True.
    cache_folder: where parsed yaml and ascii clouds are kept (default: the user's cache folder); None with ``use_cache=False``.

    All agents of a scenario have the same stems in OPV2V and V2XSet: their public reader finds every agent by the ego's
    stems. A stem that any agent has is hence expected of all, the ego included; ``verify`` names each file that is absent,
    and each whose content does not belong to its frame.
    """

    def __init__(
        self,
        root: Path | str,
        split: str | None = None,
        *,
        strict: bool = False,
        drop_nan: bool = False,
        use_cache: bool = True,
        cache_folder: Path | None = None,
        images: bool = False,
    ) -> None:
        self.root = Path(root)
        self.split = split
        self._with_images = images
        self._drop_nan = drop_nan
        self._cache = ArrayCache(cache_folder or default_cache_folder()) if use_cache else None
        problems: list[str] = []
        missing: list[FileProblem] = []
        folders = _scenario_folders(self.root, split)
        found = [_scan(folder, problems, missing, images) for folder in folders]
        self._scenarios = {s.folder.name: s for s in found if s is not None}
        if folders[0] not in (self.root, self.root / str(split)):  # one scenario may be opened by itself
            _compare_with_manifest(folders, problems, missing)
        self.missing_summary = tuple(problems)
        self._missing = tuple(missing)
        if not self._scenarios or (strict and problems):
            more = f" and {len(problems) - 1} more" if len(problems) > 1 else ""
            first = f"{problems[0]}{more}" if problems else "it is empty"
            raise RecordingError(f"{self.root}: expected whole scenarios; {first}. Download what is missing.")
        self._records: dict[Path, AgentRecord] = {}
        self._protocols: dict[str, DataProtocol] = {}
        self._heights: dict[Path, float] = {}

    @property
    def scenarios(self) -> tuple[str, ...]:
        """The names of all scenarios, sorted."""
        return tuple(self._scenarios)

    def length(self, scenario: str) -> int:
        """How many snapshots the scenario has."""
        return len(self._scenario(scenario).stems)

    def eval_indices(self, scenario: str) -> range:
        """All indices but the first ``history_frames`` of data_protocol.yaml."""
        return range(min(self._protocol(scenario).history_frames, self.length(scenario)), self.length(scenario))

    def agents(self, scenario: str) -> tuple[int, ...]:
        """The ids of all agents of the scenario, the ego first and infrastructure last."""
        return tuple(agent.id for agent in self._scenario(scenario).agents)

    @property
    def unreadable_scenarios(self) -> frozenset[str]:
        """The names of the scenarios of which nothing can be read."""
        return frozenset(problem.scenario for problem in self._missing) - self._scenarios.keys()

    def verify(
        self, scenarios: Collection[str] | None = None, progress: Callable[[int, int], None] | None = None
    ) -> MissingFiles:
        """Name the files that are missing, or whose content does not belong to their frame.

        Scenarios of the simulator are compared with their digests, others by ``find_mismatched_files``. The verdict on a scenario
        is kept in the cache while its files stay as they are.

        Args:
            scenarios: names of the scenarios to verify; None for all.
            progress: called with the number of scenarios that are verified, and of all.
        """
        names = [name for name in self.scenarios if scenarios is None or name in scenarios]
        found = [problem for problem in self._missing if scenarios is None or problem.scenario in scenarios]
        for count, name in enumerate(names, 1):
            found += self._verify_contents(name)
            if progress is not None:
                progress(count, len(names))
        return MissingFiles.of(found)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """All agents that have this frame; the truth is the union of what they list, in the order of ids."""
        return self._snapshot(scenario, index, self._with_images)

    def _snapshot(self, scenario: str, index: int, images: bool) -> Snapshot:
        stem, present = self._present(scenario, index)
        frames = tuple(self._frame(scenario, agent, stem, images) for agent in present)
        records = [self._record(agent.folder / f"{stem}.yaml") for agent in present]
        return Snapshot(scenario, index, frames, _truth(frames, records))

    def present_agents(self, scenario: str, index: int) -> tuple[int, ...]:
        """The ids of the agents that have this frame, in the order of the snapshot's frames."""
        return tuple(agent.id for agent in self._present(scenario, index)[1])

    def frame(self, scenario: str, index: int, agent_id: int) -> AgentFrame:
        """The frame of one agent as it stands in the snapshot; no other agent's files are read."""
        stem, present = self._present(scenario, index)
        found = [agent for agent in present if agent.id == agent_id]
        if not found:
            ids = ", ".join(str(agent.id) for agent in present)
            raise RecordingError(f"Agent {agent_id} has no frame {index} of '{scenario}'; choose one of {ids}.")
        return self._frame(scenario, found[0], stem, self._with_images)

    def _verify_contents(self, name: str) -> list[FileProblem]:
        """Compare the contents of a scenario's files, unless the cache has them as sound."""
        folder = self._scenarios[name].folder
        files = list_scenario_files(folder)
        kind = f"sound1{'-pictures' if self._with_images else ''}"
        state = _state(files, folder)
        kept = self._cache.load(folder, kind) if self._cache is not None else None
        if kept is not None and np.array_equal(kept, state):
            return []
        digests, found = Digests.read(folder / SCENARIO), []
        if digests is not None and digests.by_path is None and any(p.scenario == name for p in self._missing):
            digests = None  # a total digest cannot check files if some are absent
        if digests is not None:
            suffixes = (".pcd", ".yaml", *((".png",) if self._with_images else ()))
            found = digests.check(folder, name, files, used=lambda path: path.endswith(suffixes))
        if digests is None or (found and digests.by_path is None):
            found = (
                find_mismatched_files(lambda index: self._snapshot(name, index, False), name, self._clouds(name))
                or found
            )
        if self._cache is not None and not found:
            self._cache.store(folder, kind, state)
        return found

    def _clouds(self, name: str) -> list[dict[int, Path]]:
        """The paths of the clouds of each snapshot, by agent."""
        scenario = self._scenarios[name]
        return [
            {agent.id: agent.folder / f"{stem}.pcd" for agent in scenario.agents if stem in agent.stems}
            for stem in scenario.stems
        ]

    def _present(self, scenario: str, index: int) -> tuple[str, list[_AgentFiles]]:
        """The stem of an instant's files, and the agents that have them."""
        require_index(self, scenario, index)
        stem = self._scenarios[scenario].stems[index]
        return stem, [agent for agent in self._scenarios[scenario].agents if stem in agent.stems]

    def _scenario(self, name: str) -> _ScenarioFiles:
        if name not in self._scenarios:
            require_index(self, name, 0)
        return self._scenarios[name]

    def _protocol(self, scenario: str) -> DataProtocol:
        if scenario not in self._protocols:
            self._protocols[scenario] = read_protocol(self._scenario(scenario).folder)
        return self._protocols[scenario]

    def _record(self, path: Path) -> AgentRecord:
        if path not in self._records:
            if len(self._records) >= _MAX_CACHED_RECORDS:
                self._records.clear()
            self._records[path] = read_record(path, self._cache)
        return self._records[path]

    def _cloud(self, agent: _AgentFiles, stem: str) -> PcdCloud:
        return read_pcd(agent.folder / f"{stem}.pcd", self._drop_nan, self._cache)

    def _frame(self, scenario: str, agent: _AgentFiles, stem: str, images: bool) -> AgentFrame:
        record, cloud = self._record(agent.folder / f"{stem}.yaml"), self._cloud(agent, stem)
        world_from_lidar = transform_from_carla(record.lidar_pose)
        height = self._sensor_height(agent, record, world_from_lidar)
        xyz = mirror_points(cloud.xyz)
        xyz[:, 2] += np.float32(height)
        world_from_agent = world_from_lidar @ Transform.from_xyz_yaw(0, 0, -height)
        yaml = agent.folder / f"{stem}.yaml"
        return AgentFrame(
            agent_id=agent.id,
            timestamp_ns=round(int(stem) * self._protocol(scenario).fixed_delta_s * 1e9),
            points=PointCloud.of(torch.from_numpy(xyz), torch.from_numpy(cloud.intensity)),
            world_from_agent=world_from_agent,
            pose_covariance=torch.zeros(3, 3, dtype=torch.float64),
            sensor_height_m=height,
            speed_mps=record.speed_kmh / _KMH,
            is_infrastructure=record.is_infrastructure,
            images=read_images(yaml, world_from_agent, self._cache) if images else (),
        )

    def _sensor_height(self, agent: _AgentFiles, record: AgentRecord, world_from_lidar: Transform) -> float:
        """Metres from the road up to the LiDAR along the LiDAR's z axis.

        By the two poses where they say something plausible. Where a pole's place is its sensor's own, the ground is
        searched in the agent's first cloud, once, so that the height is the same in every frame.
        """
        stated = _stated_height(record, world_from_lidar)
        if stated is not None:
            return stated
        if agent.folder not in self._heights:
            self._heights[agent.folder] = estimate_sensor_height(self._cloud(agent, min(agent.stems)).xyz)
        return self._heights[agent.folder]


def _stated_height(record: AgentRecord, world_from_lidar: Transform) -> float | None:
    if not np.isfinite(record.ego_pose).all():
        return None
    offset = world_from_lidar.translation - transform_from_carla(record.ego_pose).translation
    # Along the LiDAR's axis, not the world's: exact on a slope, with the LiDAR mounted before or behind the middle.
    height = float(offset @ world_from_lidar.rotation[:, 2])
    low, high = PLAUSIBLE_HEIGHT_M
    return height if low <= height <= high and float(offset.norm()) <= high else None


def _truth(frames: tuple[AgentFrame, ...], records: list[AgentRecord]) -> GroundTruth:
    """The union of all lists by id, first agent's copy, in the order of ids."""
    listed = [np.where(r.id != f.agent_id)[0] for f, r in zip(frames, records)]
    id = np.concatenate([r.id[rows] for r, rows in zip(records, listed)])
    _, first = np.unique(id, return_index=True)
    seen = np.stack([np.isin(id[first], r.id[rows]) for r, rows in zip(records, listed)])

    def column(name: str) -> torch.Tensor:
        return torch.from_numpy(np.concatenate([getattr(r, name)[rows] for r, rows in zip(records, listed)])[first])

    center = column("location") + column("center")
    center[:, 1] *= -1
    yaw = -column("angle")[:, 1] * (math.pi / 180)
    velocity = torch.stack((yaw.cos(), yaw.sin()), 1) * (column("speed") / _KMH)[:, None]
    boxes = Boxes.of(center, 2 * column("extent"), yaw, None, column("label"), torch.from_numpy(id[first]), velocity)
    return GroundTruth(boxes, torch.from_numpy(seen), Transform.stack([f.world_from_agent for f in frames]))


def _subfolders(folder: Path) -> list[Path]:
    with os.scandir(folder) as entries:  # knows folders from files without asking the disk again
        return sorted(folder / e.name for e in entries if e.is_dir() and not e.name.startswith("."))


def _is_scenario(folder: Path) -> bool:
    return any(_AGENT.fullmatch(p.name) and not _is_scenario(p) for p in _subfolders(folder))


def has_frames(folder: Path) -> bool:
    """Whether a folder has agents with clouds or metadata, that is, whether it is a scenario with anything in it."""
    agents = [p for p in _subfolders(folder) if _AGENT.fullmatch(p.name)]
    return any(p.suffix in (".pcd", ".yaml") and p.stem.isdecimal() for agent in agents for p in agent.iterdir())


def _scenario_folders(root: Path, split: str | None) -> list[Path]:
    """The folders to scan, after the root was checked; the text of every error lists what is there instead."""
    if not root.is_dir():
        raise RecordingError(f"{root}: no such folder, expected a recording in OPV2V's layout; check the path.")
    folder = root if split is None else root / split
    if split is not None and not folder.is_dir():
        there = [p.name for p in _subfolders(root)]
        if any(_is_scenario(p) for p in _subfolders(root)) or _is_scenario(root):
            raise RecordingError(f"{root}: no split '{split}': the folder holds scenarios itself; name no split.")
        raise RecordingError(f"{root}: no split '{split}'; it has {', '.join(there) or 'none'}: choose one of them.")
    if _is_scenario(folder):
        return [folder]
    inside = _subfolders(folder)
    if any(_is_scenario(p) for p in inside):
        return inside
    splits = [p.name for p in inside if any(_is_scenario(q) for q in _subfolders(p))]
    if splits:
        raise RecordingError(f"{folder}: holds several splits ({', '.join(splits)}), expected scenarios; name a split.")
    raise RecordingError(
        f"{folder}: no scenario in it, expected <scenario>/<agent>/<stem>.pcd and .yaml; check the path."
    )


def _scan(folder: Path, problems: list[str], missing: list[FileProblem], images: bool) -> _ScenarioFiles | None:
    """What a scenario's folder holds, by names alone; what is missing is added to problems and to missing."""
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
    return _ScenarioFiles(folder, tuple(agents), stems)


def _scan_agent(folder: Path, problems: list[str], images: bool) -> _AgentFiles:
    everything = list(folder.iterdir())
    files = [p for p in everything if p.stem.isdecimal()]
    clouds = frozenset(p.stem for p in files if p.suffix == ".pcd")
    records = frozenset(p.stem for p in files if p.suffix == ".yaml")
    if not clouds and not records:
        problems.append(f"{folder}: holds neither pcd nor yaml, the agent is left out")
    for there, suffix in ((clouds - records, "yaml"), (records - clouds, "pcd")):
        if there:
            count = f"{len(there)} of {len(clouds | records)} frames"
            problems.append(f"{folder}: {count} lack their {suffix}, the first is {min(there, key=int)}; left out")
    stems = sorted(clouds & records, key=int)
    if images:
        problems += [f"{folder}: {line}" for line in describe_missing_images(everything, stems)]
    return _AgentFiles(
        int(folder.name), folder, clouds, records, find_missing_images(everything, stems) if images else {}
    )


def _absent_files(folder: Path, agents: Sequence[_AgentFiles]) -> Iterator[FileProblem]:
    """The files that a scenario lacks: every stem of any agent is expected of all."""
    stems = frozenset[str]().union(*(agent.clouds | agent.records for agent in agents))
    # A folder of something else may stand beside the scenarios; an empty one was a scenario.
    if not stems and (agents or (folder / "data_protocol.yaml").is_file() or not any(folder.iterdir())):
        yield FileProblem(folder, "missing", folder.name, "no agent of the scenario has a frame")
    for agent in agents:
        for stem in sorted(stems, key=int):
            for there, beside, suffix in ((agent.clouds, agent.records, "pcd"), (agent.records, agent.clouds, "yaml")):
                if stem not in there:
                    reason = "the other file of its frame is there" if stem in beside else "other agents have the frame"
                    yield FileProblem(agent.folder / f"{stem}.{suffix}", "missing", folder.name, reason)
        for number, lacking in agent.pictures.items():
            for stem in lacking:
                path = image_path(agent.folder, stem, number)
                yield FileProblem(path, "missing", folder.name, "the camera has pictures of other frames")


def _compare_with_manifest(folders: Sequence[Path], problems: list[str], missing: list[FileProblem]) -> None:
    """Add the scenarios of a split that the manifest of the simulator lists and that are not there."""
    split = folders[0].parent
    root = split.absolute().parent
    absent = set(list_scenarios(root, split.absolute().name)) - {folder.name for folder in folders}
    for name in sorted(absent - {problem.scenario for problem in missing}):
        reason = "the recording's manifest lists this scenario"
        problems.append(f"{split / name}: not there, and {reason}")
        missing.append(FileProblem(split / name, "missing", name, reason))


def _state(files: Sequence[Path], folder: Path) -> np.ndarray:
    """(32,) uint8 digest of names, sizes and times of files; replacing any of them changes it."""
    lines = []
    for path in files:
        stat = path.stat()
        lines.append(f"{path.relative_to(folder).as_posix()} {stat.st_size} {stat.st_mtime_ns} {stat.st_ctime_ns}")
    return np.frombuffer(hashlib.sha256("\n".join(lines).encode()).digest(), np.uint8)


class Opv2vWriter:
    """Writes one scenario's folder, so that :class:`Opv2vRecording` reads the same snapshots back.

    Exact to rounding: poses and boxes as float64 text, points as float32, intensity in 8 bits. Not in the format, hence
    not written: the time of a point, boxes that no agent lists, the covariance of a claim. The true pose goes to
    ``lidar_pose``, the claimed one to ``predicted_ego_pos``, which the reader does not use. Snapshots come back with
    agents in string order of their ids, infrastructure (negative ids) last, and boxes in the order of ids.
    """

    def __init__(self, folder: Path | str, fixed_delta_s: float = 0.05, digits: int = 6) -> None:
        self.folder = Path(folder)
        self._fixed_delta_s = fixed_delta_s
        self._digits = digits
        self.folder.mkdir(parents=True, exist_ok=True)

    def write(self, snapshot: Snapshot, box_speed_mps: torch.Tensor | None = None) -> None:
        """Write one instant of all agents; box_speed_mps: (N,) of truth.boxes, zero where it is not given."""
        _check_ids(snapshot)
        for row, frame in enumerate(snapshot.frames):
            steps = frame.timestamp_ns * 1e-9 / self._fixed_delta_s
            if abs(steps - round(steps)) > 1e-3:
                raise RecordingError(
                    f"{self.folder}: agent {frame.agent_id} has time {frame.timestamp_ns} ns, expected a multiple "
                    f"of {self._fixed_delta_s} s, for OPV2V names files by steps; choose another fixed_delta_s."
                )
            folder = self.folder / str(frame.agent_id)
            folder.mkdir(exist_ok=True)
            stem = f"{round(steps):0{self._digits}d}"
            xyz = mirror_points(frame.points.xyz.numpy())
            xyz[:, 2] -= np.float32(frame.sensor_height_m)
            write_pcd(folder / f"{stem}.pcd", xyz, frame.points.intensity.numpy())
            record, cameras = _record_of(snapshot, row, box_speed_mps), {}
            true_pose = transform_from_carla(record.ego_pose), transform_from_carla(record.lidar_pose)
            for number, image in enumerate(frame.images):
                write_png(image_path(folder, stem, number), image.rgb)
                cameras |= camera_yaml(number, image.camera, *true_pose)
            # Last, so that a yaml without its cloud never comes of an interrupted run.
            write_record(folder / f"{stem}.yaml", record, carla_from_transform(frame.world_from_agent), cameras)

    def close(self, protocol: Mapping[str, Any]) -> None:
        """Write data_protocol.yaml; ``history_frames`` is the number of first frames that are not evaluated."""
        write_protocol(self.folder, protocol, self._fixed_delta_s)


def _check_ids(snapshot: Snapshot) -> None:
    agents = [f.agent_id for f in snapshot.frames]
    boxes = snapshot.truth.boxes.id.tolist() if snapshot.truth is not None else []
    if len(set(agents)) < len(agents) or len(set(boxes)) < len(boxes) or any(id < 0 for id in boxes):
        name = f"Snapshot {snapshot.index} of '{snapshot.scenario}'"
        raise RecordingError(
            f"{name} has agents {agents} and boxes {boxes}: OPV2V needs ids that occur once, boxes' >= 0."
        )
    for frame in snapshot.frames:
        if frame.is_infrastructure != (frame.agent_id < 0):
            kind = "infrastructure" if frame.is_infrastructure else "a vehicle"
            raise RecordingError(
                f"Agent {frame.agent_id} is {kind}: OPV2V gives infrastructure, and nothing else, ids < 0."
            )


def _record_of(snapshot: Snapshot, row: int, box_speed_mps: torch.Tensor | None) -> AgentRecord:
    frame, truth = snapshot.frames[row], snapshot.truth
    world_from_agent = frame.world_from_agent if truth is None else truth.world_from_agent[row]
    boxes = Boxes.empty(torch.float64)
    speed = torch.zeros(0)
    if truth is not None:
        listed = truth.seen[row] & (truth.boxes.id != frame.agent_id)
        boxes = truth.boxes[listed].to(torch.float64)
        speed = torch.zeros(len(boxes)) if box_speed_mps is None else box_speed_mps[listed]
    size, middle = boxes.size.numpy(), boxes.center.numpy() * (1, -1, 1)
    above = np.zeros_like(size)
    above[:, 2] = size[:, 2] / 2
    angle = np.zeros_like(size)
    angle[:, 1] = -np.degrees(boxes.yaw.numpy())
    return AgentRecord(
        lidar_pose=carla_from_transform(world_from_agent @ Transform.from_xyz_yaw(0, 0, frame.sensor_height_m)),
        ego_pose=carla_from_transform(world_from_agent),
        speed_kmh=frame.speed_mps * _KMH,
        is_infrastructure=frame.is_infrastructure,
        id=boxes.id.numpy(),
        label=boxes.label.numpy(),
        location=middle - above,
        center=above,
        extent=size / 2,
        angle=angle,
        speed=speed.double().numpy() * _KMH,
    )
