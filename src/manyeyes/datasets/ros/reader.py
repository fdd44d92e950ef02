# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS, read: rosbag2 (SQLite and MCAP) and ROS 1, with a small ``ros.toml`` that names the topics of each agent.

The stamps of headers count, not the times in the bag. The world is the frame that the poses are given in. Points are right-handed
in the LiDAR's frame, those that are not finite are no returns. Poses are interpolated to the time of the sweep.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from manyeyes.datasets.base import RecordingReader, require_index
from manyeyes.datasets.box_table import BoxTable
from manyeyes.datasets.ground_height import estimate_sensor_height
from manyeyes.datasets.lidar_frame import make_lidar_frame, merge_listed_boxes
from manyeyes.datasets.registry import register_dataset
from manyeyes.datasets.ros.bag import BagIndex, find_settings, read_index, read_sweep
from manyeyes.datasets.ros.settings import SETTINGS, AgentTopics, RosSettings
from manyeyes.datatypes import AgentFrame, RecordingError, Snapshot, Transform
from manyeyes.datatypes.extras import import_extra

MAX_OFFSET_NS = 50_000_000
"""Sweeps of two agents belong to one snapshot if their times differ by no more."""
_SPEED_SPAN_NS = 50_000_000
_POLE_RANGE_M = 40.0


def contains_bags(path: Path) -> bool:
    """Return whether a folder, or one or two levels below it, has a ros.toml."""
    return any(next(path.glob(f"{below}{SETTINGS}"), None) is not None for below in ("", "*/", "*/*/"))


@register_dataset("ros", matches=contains_bags, layout=f"{SETTINGS} beside a rosbag2, .mcap or .bag")
class RosbagRecording(RecordingReader):
    """Bags under a root: one with its ros.toml, several in folders, or splits of them; each is a scenario.

    The ego is the first agent of the file, its sweeps are the snapshots; of every other agent the sweep within MAX_OFFSET_NS of the
    ego's that is nearest in time, if there is one. Bags are indexed when their scenario is first used, and a cloud is read from the
    bag when it is asked for. Truth stands in tables of boxes, if the file names any.
    """

    def __init__(self, root: Path | str, split: str | None = None) -> None:
        self.root = Path(root)
        folder = self.root if split is None else self.root / split
        if not folder.is_dir():
            raise RecordingError(
                f"{folder}: no such folder, expected bags with {SETTINGS}; check the path and the split."
            )
        import_extra("rosbags", "ros", "Reading ROS bags")
        files = find_settings(folder, SETTINGS)
        if not files:
            splits = sorted({p.parent.parent.name for p in folder.glob(f"*/*/{SETTINGS}")})
            raise RecordingError(
                f"{folder}: no {SETTINGS} in it; it has splits: {', '.join(splits) or 'none'}; name one."
            )
        self._settings = {path.absolute().parent.name: RosSettings.read(path) for path in files}
        self.scenarios = tuple(self._settings)
        self._indices: dict[str, BagIndex] = {}
        self._heights: dict[tuple[str, int], float] = {}
        self._boxes: dict[Path, BoxTable] = {}

    def length(self, scenario: str) -> int:
        """Return how many sweeps of the ego have a pose."""
        return len(self._index(scenario).sweeps[0].timestamp_ns)

    def agents(self, scenario: str) -> tuple[int, ...]:
        """Return the ids of all agents, in the order of the file."""
        return tuple(agent.id for agent in self._of(scenario).agents)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """Read the ego's sweep and those of others at its time; without truth where no agent has a table of boxes."""
        require_index(self, scenario, index)
        settings, bag = self._of(scenario), self._index(scenario)
        now = int(bag.sweeps[0].timestamp_ns[index])
        rows = [(0, index)]
        for agent in range(1, len(settings.agents)):
            offset = np.abs(bag.sweeps[agent].timestamp_ns - now)
            if len(offset) and offset.min() <= MAX_OFFSET_NS:
                rows.append((agent, int(offset.argmin())))
        frames = tuple(self._frame(scenario, agent, row) for agent, row in rows)
        listed = [
            self._table(settings.agents[agent]).at(frame.timestamp_ns, frame.agent_id)
            for (agent, _), frame in zip(rows, frames)
        ]
        has_truth = any(agent.boxes is not None for agent in settings.agents)
        return Snapshot(scenario, index, frames, merge_listed_boxes(listed, frames) if has_truth else None)

    def _of(self, scenario: str) -> RosSettings:
        if scenario not in self._settings:
            known = ", ".join(self.scenarios[:8])
            raise RecordingError(f"No scenario '{scenario}' in this recording; it holds {known}: choose one of them.")
        return self._settings[scenario]

    def _index(self, scenario: str) -> BagIndex:
        if scenario not in self._indices:
            settings = self._of(scenario)
            index = read_index(settings)
            if not len(index.sweeps[0].timestamp_ns):
                ego = settings.agents[0]
                raise RecordingError(
                    f"{settings.path}: no sweep of {ego.points} has a pose of {ego.pose or '/tf'} at its time; compare the "
                    "stamps of their headers, or raise max_pose_gap_ms."
                )
            self._indices[scenario] = index
        return self._indices[scenario]

    def _table(self, agent: AgentTopics) -> BoxTable:
        if agent.boxes is None:
            return BoxTable.empty()
        if agent.boxes not in self._boxes:
            self._boxes[agent.boxes] = BoxTable.read(agent.boxes)
        return self._boxes[agent.boxes]

    def _frame(self, scenario: str, agent: int, row: int) -> AgentFrame:
        settings, bag = self._settings[scenario], self._indices[scenario]
        topics, sweeps = settings.agents[agent], bag.sweeps[agent]
        time = int(sweeps.timestamp_ns[row])
        world_from_body = bag.world_from_body(agent, time, settings.max_pose_gap_ns)
        assert world_from_body is not None  # by the index
        cloud = read_sweep(settings, topics, time, int(sweeps.logged_ns[row]))
        key = scenario, agent
        if topics.sensor_height_m is None and key not in self._heights:
            first = (
                cloud
                if row == 0
                else read_sweep(settings, topics, int(sweeps.timestamp_ns[0]), int(sweeps.logged_ns[0]))
            )
            self._heights[key] = estimate_sensor_height(first.xyz, _POLE_RANGE_M if topics.is_infrastructure else 25.0)
        height = self._heights[key] if topics.sensor_height_m is None else topics.sensor_height_m
        world_from_lidar = world_from_body @ topics.body_from_lidar
        speed = self._speed(scenario, agent, time)
        return make_lidar_frame(
            cloud, world_from_lidar, height, topics.id, time, speed, topics.is_infrastructure, topics.body
        )

    def _speed(self, scenario: str, agent: int, timestamp_ns: int) -> float:
        """Return metres per second between 50 ms before and after, or as near as poses are known; 0 without two poses."""
        bag, gap = self._indices[scenario], self._settings[scenario].max_pose_gap_ns
        times = (timestamp_ns - _SPEED_SPAN_NS, timestamp_ns, timestamp_ns + _SPEED_SPAN_NS)
        known: list[tuple[int, Transform]] = [
            (t, p) for t in times if (p := bag.world_from_body(agent, t, gap)) is not None
        ]
        seconds = (known[-1][0] - known[0][0]) * 1e-9
        moved = known[-1][1].translation - known[0][1].translation
        return float(torch.linalg.vector_norm(moved)) / seconds if seconds > 0 else 0.0
