# SPDX-License-Identifier: Apache-2.0
"""DAIR-V2X-C and V2X-Seq, read: one vehicle (agent 0, the ego) and one infrastructure (agent -1) at a crossing.

The format is right-handed, in metres and radians, and points lie in the LiDAR's frame (the infrastructure's is a virtual
one, upright, with x ahead). What comes out lies in the agent's frame, whose z = 0 is the road. The two sweeps of a
pair have their own time stamps. The format has neither the height of a LiDAR (found in the cloud, unless the index has our
``lidar_height_m``), nor a speed (found from the poses), nor an agent's estimate of its own error (reads as zero).
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from manyeyes.datasets.base import RecordingReader, require_index
from manyeyes.datasets.dair_v2x.index import (
    DEFAULT_OPTIONS,
    DairIndex,
    DairOptions,
    DairPair,
    SideFrame,
    Sides,
    find_dair_root,
    read_index,
    read_split_ids,
)
from manyeyes.datasets.dair_v2x.json_files import (
    read_calibration,
    read_infrastructure_calibration,
    read_side_labels,
    read_world_labels,
)
from manyeyes.datasets.dair_v2x.writer import list_pair_files
from manyeyes.datasets.formats.pcd import PcdCloud, read_pcd
from manyeyes.datasets.ground_height import estimate_sensor_height
from manyeyes.datasets.manifest import BATCHES, Digests
from manyeyes.datasets.mismatch import find_copied_files
from manyeyes.datasets.missing import FileProblem
from manyeyes.datasets.registry import register_dataset
from manyeyes.datatypes import (
    AgentFrame,
    Boxes,
    GroundTruth,
    PointCloud,
    RecordingError,
    Snapshot,
    Transform,
)
from manyeyes.ops.box_iou import pairwise_iou

VEHICLE_ID, INFRASTRUCTURE_ID = 0, -1
# CoAlign's threshold for two sides' labels of one vehicle; two vehicles do not overlap at all.
_SAME_IOU = 0.05
# Range in which the road is searched: near, because a vehicle's LiDAR is tilted by a degree; farther, because a pole's does not see
# the road below it.
_VEHICLE_RANGE_M, _POLE_RANGE_M = 15.0, 40.0
_MAX_CACHED_POSES = 20_000


@register_dataset(
    "dair-v2x",
    matches=lambda path: find_dair_root(path) is not None,
    layout="folders vehicle-side and infrastructure-side",
)
class DairRecording(RecordingReader):
    """Pairs under a root in DAIR-V2X's layout; the drives (``batch_id``, ``sequence_id``) are the scenarios.

    split: of the official cooperative-split-data.json, expected in the root unless the options name a file. A pair that lacks a
    file is left out and named in ``missing_summary``, one line a kind; with strict it is an error. ``verify`` names each file
    that is absent, and each whose content does not belong to its frame.

    Replays: pairs collaborate at any distance, by the data set's own protocol. The two sweeps of a pair are some ten milliseconds
    apart, either way: an ego that does not wait would never receive an infrastructure message whose sweep is the later one. It
    waits for half the period, so that the later sweep arrives in time, and the next pair has not begun.
    """

    comm_range_m = math.inf
    latency_budget_s = 0.05

    def __init__(
        self,
        root: Path | str,
        split: str | None = None,
        options: DairOptions = DEFAULT_OPTIONS,
        *,
        strict: bool = False,
        drop_nan: bool = False,
    ) -> None:
        found = find_dair_root(Path(root))
        if found is None:
            raise RecordingError(
                f"{root}: expected a folder with vehicle-side and infrastructure-side; check the path."
            )
        self.root = found
        self.split = split
        self._options = options
        self._drop_nan = drop_nan
        self._sides = Sides(found)
        ids = None if split is None else read_split_ids(found, split, options.split_file)
        self._index: DairIndex = read_index(found, self._sides, ids, options)
        self.scenarios = tuple(self._index.pairs)
        self.missing_summary, self.missing_files = self._index.missing_summary, self._index.missing_files
        if not self.scenarios or (strict and self.missing_summary):
            more = f" and {len(self.missing_summary) - 1} more" if len(self.missing_summary) > 1 else ""
            first = f"{self.missing_summary[0]}{more}" if self.missing_summary else "no pair is listed"
            raise RecordingError(f"{found}: expected whole pairs of sweeps; {first}. Download what is missing.")
        self._heights: dict[tuple[str, bool], float] = {}
        self._poses: dict[tuple[Path, ...], Transform] = {}

    def length(self, scenario: str) -> int:
        """Return how many pairs the drive has."""
        return len(self._pairs(scenario))

    def agents(self, scenario: str) -> tuple[int, ...]:
        """Return the vehicle and the infrastructure, always 0 and -1."""
        self._pairs(scenario)
        return (VEHICLE_ID, INFRASTRUCTURE_ID)

    def verify_contents(self, scenario: str) -> list[FileProblem]:
        """Compare a drive of the simulator with its digests; of others find the clouds that are copies of another."""
        pairs = self._index.pairs[scenario]
        number = f"{int(scenario):06d}.json" if scenario.isdecimal() else ""
        digests = Digests.read(self.root / BATCHES / number) if number else None
        whole = not any(problem.scenario == scenario for problem in self.missing_files)
        if digests is not None and (digests.by_path is not None or whole):
            files = sorted(path for pair in pairs for path in list_pair_files(self.root, pair.vehicle.id))
            return digests.check(self.root, scenario, files, f"{BATCHES}/{number}")
        clouds = {path: None for pair in pairs for path in (pair.vehicle.cloud, pair.infrastructure.cloud)}
        return find_copied_files(clouds, scenario)

    def pair(self, scenario: str, index: int) -> DairPair:
        """Return which files a snapshot comes from."""
        require_index(self, scenario, index)
        return self._index.pairs[scenario][index]

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """Return both agents, each at its own time; the truth is that of the vehicle's time, None without a label."""
        pair = self.pair(scenario, index)
        poses = self.lidar_poses(pair)
        reported_poses = poses
        if self._options.native_pose_error and pair.offset is not None:
            reported_poses = (poses[0], self._uncorrected(pair))
        sides = (pair.vehicle, pair.infrastructure)
        heights = [self._height(scenario, side, pole) for side, pole in zip(sides, (False, True))]
        frames = tuple(
            self._frame(id, side, height, reported_pose)
            for id, side, height, reported_pose in zip(self.agents(scenario), sides, heights, reported_poses)
        )
        true = [pose @ Transform.from_xyz_yaw(0, 0, -height) for pose, height in zip(poses, heights)]
        return Snapshot(scenario, index, frames, self._truth(pair, poses, Transform.stack(true)))

    def lidar_poses(self, pair: DairPair) -> tuple[Transform, Transform]:
        """Return world from the vehicle's LiDAR and from the infrastructure's virtual one, as far as the recording knows."""
        vehicle = self._vehicle_pose(pair.vehicle)
        if not all(path.is_file() for path in pair.infrastructure.motions):
            return vehicle, vehicle @ read_calibration(pair.i2v)  # which holds the correction
        unit = self._uncorrected(pair)
        if pair.offset is None:
            return vehicle, unit
        shift = torch.tensor([*pair.offset, 0.0], dtype=torch.float64)
        if not pair.offset_in_world:
            shift = vehicle.rotation @ shift
        return vehicle, Transform(unit.rotation, unit.translation + shift)

    def side_boxes(self, scenario: str, index: int) -> tuple[Boxes, Boxes]:
        """Return what the vehicle lists and what the infrastructure lists, in the world frame, by the labels of each side."""
        pair = self.pair(scenario, index)
        return self._listed(pair, self.lidar_poses(pair))

    def _pairs(self, scenario: str) -> tuple[DairPair, ...]:
        if scenario not in self._index.pairs:
            require_index(self, scenario, 0)
        return self._index.pairs[scenario]

    def _frame(self, agent: int, side: SideFrame, height: float, world_from_lidar: Transform) -> AgentFrame:
        cloud = self._cloud(side)
        xyz = cloud.xyz.copy()
        xyz[:, 2] += np.float32(height)
        time_s = None
        if cloud.time_s is not None:
            relative = cloud.time_s - side.timestamp_ns * 1e-9
            # Points carry seconds since 1970; whatever is not within a second of the sweep counts by another clock.
            time_s = torch.from_numpy(np.where(np.abs(relative) < 1, relative, 0.0).astype(np.float32))
        return AgentFrame(
            agent_id=agent,
            timestamp_ns=side.timestamp_ns,
            points=PointCloud.of(torch.from_numpy(xyz), torch.from_numpy(cloud.intensity), time_s),
            world_from_agent=world_from_lidar @ Transform.from_xyz_yaw(0, 0, -height),
            pose_covariance=torch.zeros(3, 3, dtype=torch.float64),
            sensor_height_m=height,
            speed_mps=self._speed(side) if agent == VEHICLE_ID else 0.0,
            is_infrastructure=agent == INFRASTRUCTURE_ID,
        )

    def _cloud(self, side: SideFrame) -> PcdCloud:
        """Return the sweep without points at the sensor itself, which are no returns."""
        cloud = read_pcd(side.cloud, self._drop_nan)
        met = cloud.xyz.any(axis=1)
        return PcdCloud(cloud.xyz[met], cloud.intensity[met], None if cloud.time_s is None else cloud.time_s[met])

    def _height(self, scenario: str, side: SideFrame, pole: bool) -> float:
        """Return metres from the road up to the LiDAR: stated, or found in the drive's first cloud so that it stays the same."""
        if side.height_m is not None:
            return side.height_m
        if (scenario, pole) not in self._heights:
            first = self._index.pairs[scenario][0]
            cloud = self._cloud(first.infrastructure if pole else first.vehicle)
            max_range_m = _POLE_RANGE_M if pole else _VEHICLE_RANGE_M
            self._heights[scenario, pole] = estimate_sensor_height(cloud.xyz, max_range_m)
        return self._heights[scenario, pole]

    def _vehicle_pose(self, side: SideFrame) -> Transform:
        if side.motions not in self._poses:
            if len(self._poses) >= _MAX_CACHED_POSES:
                self._poses.clear()
            novatel, lidar = side.motions
            self._poses[side.motions] = read_calibration(novatel) @ read_calibration(lidar)
        return self._poses[side.motions]

    def _uncorrected(self, pair: DairPair) -> Transform:
        """Return world from virtual LiDAR by its own calibration; ``relative_error`` counts where the pair states no offset."""
        if not all(path.is_file() for path in pair.infrastructure.motions):
            return self._vehicle_pose(pair.vehicle) @ read_calibration(pair.i2v)
        pose, (x, y) = read_infrastructure_calibration(pair.infrastructure.motions[0])
        if pair.offset is not None:
            return pose
        return Transform(pose.rotation, pose.translation + torch.tensor([x, y, 0.0], dtype=torch.float64))

    def _speed(self, side: SideFrame) -> float:
        """Return the speed since the sweep before, m/s; 0 where there is none within half a second."""
        before = self._sides.vehicle.before(side, 1)
        if before is None or not all(path.is_file() for path in before.motions):
            return 0.0
        seconds = (side.timestamp_ns - before.timestamp_ns) * 1e-9
        moved = self._vehicle_pose(side).translation - self._vehicle_pose(before).translation
        return float(moved.norm()) / seconds if 0 < seconds <= 0.5 else 0.0

    def _listed(self, pair: DairPair, poses: tuple[Transform, Transform]) -> tuple[Boxes, Boxes]:
        vehicle, unit = (read_side_labels(side.label) for side in (pair.vehicle, pair.infrastructure))
        return vehicle.transform(poses[0]), unit.transform(poses[1])

    def _truth(
        self, pair: DairPair, poses: tuple[Transform, Transform], world_from_agent: Transform
    ) -> GroundTruth | None:
        have_sides = pair.vehicle.label.is_file() and pair.infrastructure.label.is_file()
        if (self._options.labels == "cooperative" and pair.label is None) or (
            self._options.labels == "sides" and not have_sides
        ):
            return None
        listed = self._listed(pair, poses) if have_sides else (Boxes.empty(torch.float64), Boxes.empty(torch.float64))
        if self._options.labels == "sides":
            boxes = _union(*listed)
        elif pair.offset_in_world and pair.label is not None:
            boxes = read_world_labels(pair.label)
        else:
            assert pair.label is not None
            boxes = read_side_labels(pair.label).transform(poses[0])  # V2X-Seq: in the vehicle's LiDAR frame
        seen = torch.stack([_match_boxes(boxes, side) >= 0 for side in listed])
        # A label that neither side lists is in the truth all the same: it was given for the ego.
        seen[0] |= ~seen.any(0)
        return GroundTruth(_mark_own_body(boxes, poses[0]), seen, world_from_agent)


def _match_boxes(boxes: Boxes, others: Boxes) -> Tensor:
    """Return (N,) int64: the row of others that is the same vehicle, -1 for none; greatest overlaps first, each row once."""
    partner = torch.full((len(boxes),), -1, dtype=torch.int64)
    if not len(boxes) or not len(others):
        return partner
    iou = pairwise_iou(boxes.bev(), others.bev())
    order = torch.argsort(iou.flatten(), descending=True, stable=True)
    taken = torch.zeros(len(others), dtype=torch.bool)
    for at in order[iou.flatten()[order] > _SAME_IOU].tolist():
        row, column = divmod(at, len(others))
        if partner[row] < 0 and not taken[column]:
            partner[row] = column
            taken[column] = True
    return partner


def _union(vehicle: Boxes, unit: Boxes) -> Boxes:
    """Return both lists, each vehicle once, as the vehicle's side has it; ids are rows from 1."""
    both = Boxes.cat([vehicle, unit[_match_boxes(unit, vehicle) < 0]])
    id = torch.arange(1, len(both) + 1)
    return Boxes.of(both.center, both.size, both.yaw, label=both.label, id=id)


def _mark_own_body(boxes: Boxes, world_from_lidar: Transform) -> Boxes:
    """Return the box around the vehicle's own LiDAR gets the vehicle's id, so that it is not evaluated."""
    local = boxes.transform(world_from_lidar.inverse())
    around = Boxes.of(local.center * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64), local.size, local.yaw)
    own = (
        around.contains(torch.zeros(1, 3, dtype=torch.float64))[:, 0]
        if len(boxes)
        else torch.zeros(0, dtype=torch.bool)
    )
    id = torch.where(own, torch.full_like(boxes.id, VEHICLE_ID), boxes.id)
    return Boxes.of(boxes.center, boxes.size, boxes.yaw, label=boxes.label, id=id)
