# SPDX-License-Identifier: Apache-2.0
"""OPV2V's layout, read: ``<split>/<scenario>/<agent>/<stem>.{pcd,yaml}``, and ``<stem>_camera0.png`` ….

OPV2V and V2XSet are left-handed; V2V4Real and V2X-Real, which have the layout but not the axes, are in ``dialect``. On disk
everything is in degrees and km/h, and points lie in the LiDAR's frame. What comes out is right-handed, in radians and m/s, and
points lie in the agent's frame, whose z = 0 is the road. The format has neither the time of a point, nor an agent's estimate of
its own error (both read as zero), nor vehicles that no agent lists.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from manyeyes.datasets.base import RecordingReader, require_index
from manyeyes.datasets.deferred import DeferredCloud
from manyeyes.datasets.formats.cache import ArrayCache, default_cache_folder
from manyeyes.datasets.formats.pcd import PcdCloud, read_pcd
from manyeyes.datasets.formats.point_file import read_bin
from manyeyes.datasets.ground_height import PLAUSIBLE_HEIGHT_M, estimate_sensor_height
from manyeyes.datasets.manifest import SCENARIO, Digests, list_scenario_files
from manyeyes.datasets.mismatch import find_mismatched_files
from manyeyes.datasets.missing import FileProblem
from manyeyes.datasets.opv2v.camera import read_images
from manyeyes.datasets.opv2v.carla import mirror_points, transform_from_carla
from manyeyes.datasets.opv2v.dialect import OPV2V, Dialect, choose_dialect, name_dialect
from manyeyes.datasets.opv2v.metadata import (
    KMH_PER_MPS,
    PROTOCOL,
    AgentRecord,
    DataProtocol,
    read_protocol,
    read_record,
)
from manyeyes.datasets.opv2v.object_lists import MergedList, merge_lists
from manyeyes.datasets.opv2v.scan import (
    BINARY,
    AgentFiles,
    ScenarioFiles,
    compare_with_manifest,
    contains_scenarios,
    find_scenario_folders,
    get_split_folder,
    scan_scenario,
)
from manyeyes.datasets.registry import register_dataset
from manyeyes.datatypes import AgentBody, AgentFrame, GroundTruth, PointCloud, RecordingError, Snapshot, Transform

_MAX_CACHED_RECORDS = 20_000
# Number of first frames that are searched for one that lists objects, which identifies the data set.
_MAX_DIALECT_STEMS = 20
# Of CARLA's Lincoln MKZ of 2017, which carries the sensors of OPV2V and V2XSet (OpenCDA): extents of 2.451, 1.064 and 0.755 m in
# CARLA 0.9, rounded to 0.1 m.
_BODY_SIZE_M = (4.9, 2.1, 1.5)
_MAX_LIDAR_OFFSET_M = 5.0


@register_dataset(
    "opv2v",
    matches=contains_scenarios,
    layout="folders <scenario>/<agent>/<stem>.pcd or .bin, and .yaml, agents named by numbers",
)
class Opv2vRecording(RecordingReader):
    """Scenarios in OPV2V's layout under a root: a dataset (name the split), a folder of scenarios, or one scenario.

    The ego is the first agent by string order, infrastructure comes last, and the ego's frames are the snapshots; an
    agent that lacks a frame is left out of that snapshot. What is missing stands in ``missing_summary``, one line each; with
    strict it is an error instead. Clouds are read when a snapshot is asked for; pictures too, with images=True.
    cache_folder: where parsed yaml and ascii clouds are kept (default: the user's cache folder); None with ``use_cache=False``.
    dialect: the data set whose axes and types the files have; None: by names of folders, and by the first metadata.

    All agents of a scenario have the same stems in OPV2V and V2XSet: their public reader finds every agent by the ego's
    stems. A stem that any agent has is hence expected of all, the ego included; ``verify`` names each file that is absent,
    and each whose content does not belong to its frame.
    """

    reads_images = True

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
        dialect: Dialect | None = None,
    ) -> None:
        self.root = Path(root)
        self.split = split
        self._with_images = images
        self._drop_nan = drop_nan
        self._cache = ArrayCache(cache_folder or default_cache_folder()) if use_cache else None
        problems: list[str] = []
        missing: list[FileProblem] = []
        folders = find_scenario_folders(self.root, split)
        found = [scan_scenario(folder, problems, missing, images) for folder in folders]
        self._scenarios = {s.folder.name: s for s in found if s is not None}
        if folders[0] not in (self.root, get_split_folder(self.root, split)):  # one scenario may be opened by itself
            compare_with_manifest(folders, problems, missing)
        self.scenarios = tuple(self._scenarios)
        self.missing_summary = tuple(problems)
        self.missing_files = tuple(missing)
        if not self._scenarios or (strict and problems):
            more = f" and {len(problems) - 1} more" if len(problems) > 1 else ""
            first = f"{problems[0]}{more}" if problems else "it is empty"
            raise RecordingError(f"{self.root}: expected whole scenarios; {first}. Download what is missing.")
        self._dialect, self._dialects = dialect, dict[str, Dialect]()
        self._records: dict[tuple[Path, str], AgentRecord] = {}
        self._poses: dict[tuple[Path, str], _AgentPose] = {}
        self._lists: dict[tuple[str, int], MergedList] = {}
        self._protocols: dict[str, DataProtocol] = {}
        self._heights: dict[Path, float] = {}

    def length(self, scenario: str) -> int:
        """Return how many snapshots the scenario has."""
        return len(self._scenario(scenario).stems)

    def eval_indices(self, scenario: str) -> range:
        """Return all indices but the first ``history_frames`` of data_protocol.yaml."""
        return range(min(self._protocol(scenario).history_frames, self.length(scenario)), self.length(scenario))

    def agents(self, scenario: str) -> tuple[int, ...]:
        """Return the ids of all agents of the scenario, the ego first and infrastructure last."""
        return tuple(agent.id for agent in self._scenario(scenario).agents)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """Read all agents that have this frame; the truth is the union of what they list, in the order of ids."""
        return self._snapshot(scenario, index, self._with_images)

    def deferred_snapshot(self, scenario: str, index: int) -> Snapshot:
        """Return the snapshot without pictures; each cloud is read at its first use."""
        stem, present = self._present(scenario, index)
        frames = tuple(self._frame(scenario, agent, stem, False, is_deferred=True) for agent in present)
        return Snapshot(scenario, index, frames, self._truth(scenario, index, frames))

    def _snapshot(self, scenario: str, index: int, images: bool) -> Snapshot:
        stem, present = self._present(scenario, index)
        frames = tuple(self._frame(scenario, agent, stem, images) for agent in present)
        return Snapshot(scenario, index, frames, self._truth(scenario, index, frames))

    def _truth(self, scenario: str, index: int, frames: tuple[AgentFrame, ...]) -> GroundTruth:
        """Return the truth of a snapshot's frames."""
        if (scenario, index) not in self._lists:
            stem, present = self._present(scenario, index)
            records = [self._record(agent, stem) for agent in present]
            if len(self._lists) >= _MAX_CACHED_RECORDS:
                self._lists.clear()
            self._lists[scenario, index] = merge_lists(records, [agent.id for agent in present], self.dialect(scenario))
        return GroundTruth(*self._lists[scenario, index].copy(), Transform.stack([f.world_from_agent for f in frames]))

    def dialect(self, scenario: str) -> Dialect:
        """Return the data set whose axes and types the files of a scenario have."""
        if scenario not in self._dialects:
            self._dialects[scenario] = self._dialect or self._find_dialect(self._scenario(scenario))
        return self._dialects[scenario]

    def _find_dialect(self, scenario: ScenarioFiles) -> Dialect:
        """Find the dialect by names, and where they do not tell, by the first frames' metadata."""
        agents = [agent.folder.name for agent in scenario.agents]
        named = name_dialect(scenario.folder.name, any(agent.binary for agent in scenario.agents))
        if named is not None:
            return named
        for stem in scenario.stems[:_MAX_DIALECT_STEMS]:
            records = [r for agent in scenario.agents if stem in agent.stems if (r := self._try_record(agent, stem))]
            if any(len(record.id) or record.has_matrix for record in records):
                return choose_dialect(agents, records)
        return OPV2V

    def _try_record(self, agent: AgentFiles, stem: str) -> AgentRecord | None:
        """Return a frame's metadata; None where they are damaged, which is an error of that frame alone."""
        try:
            return self._record(agent, stem)
        except RecordingError:
            return None

    def present_agents(self, scenario: str, index: int) -> tuple[int, ...]:
        """Return the ids of the agents that have this frame, in the order of the snapshot's frames."""
        return tuple(agent.id for agent in self._present(scenario, index)[1])

    def frame(self, scenario: str, index: int, agent_id: int) -> AgentFrame:
        """Read the frame of one agent as it stands in the snapshot; no other agent's files are read."""
        stem, present = self._present(scenario, index)
        found = [agent for agent in present if agent.id == agent_id]
        if not found:
            ids = ", ".join(str(agent.id) for agent in present)
            raise RecordingError(f"Agent {agent_id} has no frame {index} of '{scenario}'; choose one of {ids}.")
        return self._frame(scenario, found[0], stem, self._with_images)

    def verify_contents(self, scenario: str) -> list[FileProblem]:
        """Compare the contents of a scenario's files, unless the cache has them as sound."""
        folder = self._scenarios[scenario].folder
        files = list_scenario_files(folder)
        kind = f"sound1{'-pictures' if self._with_images else ''}"
        state = _state(files, folder)
        kept = self._cache.load(folder, kind) if self._cache is not None else None
        if kept is not None and np.array_equal(kept, state):
            return []
        digests, found = Digests.read(folder / SCENARIO), []
        if digests is not None and digests.by_path is None and any(p.scenario == scenario for p in self.missing_files):
            digests = None  # a total digest cannot check files if some are absent
        if digests is not None:
            suffixes = (".pcd", ".yaml", *((".png",) if self._with_images else ()))
            found = digests.check(folder, scenario, files, used=lambda path: path.endswith(suffixes))
        if digests is None or (found and digests.by_path is None):
            found = (
                find_mismatched_files(
                    lambda index: self._snapshot(scenario, index, False), scenario, self._clouds(scenario)
                )
                or found
            )
        if self._cache is not None and not found:
            self._cache.store(folder, kind, state)
        return found

    def _clouds(self, name: str) -> list[dict[int, Path]]:
        """Return the paths of the clouds of each snapshot, by agent."""
        scenario = self._scenarios[name]
        return [
            {agent.id: agent.cloud_path(stem) for agent in scenario.agents if stem in agent.stems}
            for stem in scenario.stems
        ]

    def _present(self, scenario: str, index: int) -> tuple[str, list[AgentFiles]]:
        """Return the stem of an instant's files, and the agents that have them."""
        require_index(self, scenario, index)
        stem = self._scenarios[scenario].stems[index]
        return stem, [agent for agent in self._scenarios[scenario].agents if stem in agent.stems]

    def _scenario(self, name: str) -> ScenarioFiles:
        if name not in self._scenarios:
            require_index(self, name, 0)
        return self._scenarios[name]

    def _protocol(self, scenario: str) -> DataProtocol:
        if scenario not in self._protocols:
            self._protocols[scenario] = read_protocol(self._scenario(scenario).folder)
        return self._protocols[scenario]

    def _delta_s(self, scenario: str) -> float:
        """Return the seconds between two stems: of data_protocol.yaml, else those of the data set."""
        has_protocol = (self._scenario(scenario).folder / PROTOCOL).is_file()
        return self._protocol(scenario).fixed_delta_s if has_protocol else self.dialect(scenario).delta_s

    def _record(self, agent: AgentFiles, stem: str) -> AgentRecord:
        key = agent.folder, stem
        if key not in self._records:
            if len(self._records) >= _MAX_CACHED_RECORDS:
                self._records.clear()
            self._records[key] = read_record(agent.folder / f"{stem}.yaml", self._cache)
        return self._records[key]

    def _cloud(self, agent: AgentFiles, stem: str) -> PcdCloud:
        path = agent.cloud_path(stem)
        return read_bin(path, self._drop_nan) if path.suffix == BINARY else read_pcd(path, self._drop_nan, self._cache)

    def _points(self, agent: AgentFiles, stem: str, height: float, is_right_handed: bool) -> PointCloud:
        """Read the cloud of an agent in its frame."""
        cloud = self._cloud(agent, stem)
        xyz = np.array(cloud.xyz, np.float32) if is_right_handed else mirror_points(cloud.xyz)
        xyz[:, 2] += np.float32(height)
        return PointCloud.of(torch.from_numpy(xyz), torch.from_numpy(cloud.intensity))

    def _frame(
        self, scenario: str, agent: AgentFiles, stem: str, images: bool, is_deferred: bool = False
    ) -> AgentFrame:
        record = self._record(agent, stem)
        dialect = self.dialect(scenario)
        pose = self._pose(agent, stem, dialect)
        world_from_agent, height = pose.copy(), pose.height_m
        read = partial(self._points, agent, stem, height, dialect.is_right_handed)
        return AgentFrame(
            agent_id=agent.id,
            timestamp_ns=round(int(stem) * self._delta_s(scenario) * 1e9),
            points=DeferredCloud(read) if is_deferred else read(),
            world_from_agent=world_from_agent,
            pose_covariance=torch.zeros(3, 3, dtype=torch.float64),
            sensor_height_m=height,
            speed_mps=record.speed_kmh / KMH_PER_MPS,
            is_infrastructure=record.is_infrastructure,
            body=pose.body,
            images=read_images(agent.folder / f"{stem}.yaml", world_from_agent, self._cache) if images else (),
        )

    def _pose(self, agent: AgentFiles, stem: str, dialect: Dialect) -> _AgentPose:
        """Return where an agent's frame is; computed once and kept."""
        key = agent.folder, stem
        if key not in self._poses:
            record = self._record(agent, stem)
            world_from_lidar = dialect.world_from_lidar(record.lidar_pose)
            height = self._sensor_height(agent, record, world_from_lidar, dialect)
            pose = world_from_lidar @ Transform.from_xyz_yaw(0, 0, -height)
            if len(self._poses) >= _MAX_CACHED_RECORDS:
                self._poses.clear()
            body = None if dialect.is_right_handed else _carla_body(record, pose)
            self._poses[key] = _AgentPose(pose.rotation.numpy(), pose.translation.numpy(), height, body)
        return self._poses[key]

    def _sensor_height(
        self, agent: AgentFiles, record: AgentRecord, world_from_lidar: Transform, dialect: Dialect
    ) -> float:
        """Return the metres from the road up to the LiDAR along the LiDAR's z axis.

        By the two poses where they say something plausible. Where a pole's place is its sensor's own, the ground is
        searched in the agent's first cloud, once, so that the height is the same in every frame.
        """
        stated = None if dialect.is_right_handed else _stated_height(record, world_from_lidar)
        if stated is not None:
            return stated
        if agent.folder not in self._heights:
            self._heights[agent.folder] = estimate_sensor_height(self._cloud(agent, min(agent.stems)).xyz)
        return self._heights[agent.folder]


@dataclass(frozen=True)
class _AgentPose:
    """Where an agent's frame is: rotation (3, 3) and translation (3,) of world_from_agent, height of the LiDAR, and the body."""

    rotation: np.ndarray
    translation: np.ndarray
    height_m: float
    body: AgentBody | None

    def copy(self) -> Transform:
        """Return world_from_agent, in memory of its own."""
        return Transform(torch.from_numpy(self.rotation.copy()), torch.from_numpy(self.translation.copy()))


def _stated_height(record: AgentRecord, world_from_lidar: Transform) -> float | None:
    if not np.isfinite(record.ego_pose).all():
        return None
    offset = world_from_lidar.translation - transform_from_carla(record.ego_pose).translation
    # Along the LiDAR's axis, not the world's: exact on a slope, with the LiDAR mounted before or behind the middle.
    height = float(offset @ world_from_lidar.rotation[:, 2])
    low, high = PLAUSIBLE_HEIGHT_M
    return height if low <= height <= high and float(offset.norm()) <= high else None


def _carla_body(record: AgentRecord, world_from_agent: Transform) -> AgentBody | None:
    """Return the vehicle at the record's own pose, in the agent's frame; None where that pose is not plausible.

    OPV2V's LiDAR stands 0.5 m behind the middle of the vehicle. The size is that of all vehicles with sensors there.
    """
    if record.is_infrastructure or not np.isfinite(record.ego_pose).all():
        return None
    agent_from_vehicle = world_from_agent.inverse() @ transform_from_carla(record.ego_pose)
    x, y, _ = agent_from_vehicle.translation.tolist()
    if math.hypot(x, y) > _MAX_LIDAR_OFFSET_M:
        return None
    return AgentBody.standing(x, y, _BODY_SIZE_M, float(agent_from_vehicle.yaw))


def _state(files: Sequence[Path], folder: Path) -> np.ndarray:
    """Compute a (32,) uint8 digest of names, sizes and times of files; replacing any of them changes it."""
    lines = []
    for path in files:
        stat = path.stat()
        lines.append(f"{path.relative_to(folder).as_posix()} {stat.st_size} {stat.st_mtime_ns} {stat.st_ctime_ns}")
    return np.frombuffer(hashlib.sha256("\n".join(lines).encode()).digest(), np.uint8)
