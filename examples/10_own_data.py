# SPDX-License-Identifier: Apache-2.0
"""Bring recordings of your own: a reader of clouds in .npz files with their poses in a table, and methods on what it reads."""

import sys
import tempfile
from pathlib import Path

import numpy as np

from manyeyes import (
    AgentFrame,
    Boxes,
    PointCloud,
    Recording,
    RecordingReader,
    Snapshot,
    Transform,
    benchmark,
    open_recording,
    register_dataset,
)
from manyeyes.datatypes import GroundTruth
from manyeyes.simulator.presets import simulate


def has_poses(root: Path) -> bool:
    return any(next(root.glob(place), None) for place in ("*/poses.csv", "*/*/poses.csv"))


@register_dataset("npz", matches=has_poses, layout="folders <scenario> with poses.csv")
class NpzRecording(RecordingReader):
    """<scenario>/poses.csv: index, agent, time_s, x, y, z, yaw; clouds <index>-<agent>.npz; true boxes <index>.npz."""

    def __init__(self, root: Path | str, split: str | None = None) -> None:
        tables = sorted(Path(root, split or "").glob("*/poses.csv"))
        self.folders = {table.parent.name: table.parent for table in tables}
        self.poses = {table.parent.name: np.genfromtxt(table, delimiter=",", names=True) for table in tables}
        self.scenarios = tuple(self.folders)

    def length(self, scenario: str) -> int:
        return int(self.poses[scenario]["index"].max()) + 1

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        frames, table, folder = [], self.poses[scenario], self.folders[scenario]
        for row in table[table["index"] == index]:
            agent, pose = int(row["agent"]), Transform.from_xyz_yaw(*(float(row[k]) for k in ("x", "y", "z", "yaw")))
            cloud = np.load(folder / f"{index}-{agent}.npz")
            points = PointCloud.of(cloud["points"], cloud["intensity"])
            frames.append(AgentFrame.of(points, pose, agent, round(row["time_s"] * 1e9)))
        truth = np.load(folder / f"{index}.npz")
        boxes = Boxes.of(truth["center"], truth["size"], truth["yaw"], id=truth["id"])
        world_from_agent = Transform.stack([frame.world_from_agent for frame in frames])
        return Snapshot(scenario, index, tuple(frames), GroundTruth.of(boxes, world_from_agent))


def write_clouds(recording: Recording, folder: Path, num_frames: int) -> None:
    """Write the first frames of each scenario; from your sensors and your localisation."""
    for scenario in recording.scenarios:
        (folder / scenario).mkdir(parents=True)
        rows = ["index,agent,time_s,x,y,z,yaw"]
        for index in range(min(num_frames, recording.length(scenario))):
            snapshot = recording.snapshot(scenario, index)
            for frame in snapshot.frames:
                numbers = (*frame.world_from_agent.translation.tolist(), float(frame.world_from_agent.yaw))
                rows.append(",".join(map(str, (index, frame.agent_id, frame.timestamp_ns * 1e-9, *numbers))))
                cloud = {"points": frame.points.xyz, "intensity": frame.points.intensity}
                np.savez(folder / scenario / f"{index}-{frame.agent_id}.npz", **cloud)
            boxes = snapshot.truth.boxes
            np.savez(
                folder / scenario / f"{index}.npz", center=boxes.center, size=boxes.size, yaw=boxes.yaw, id=boxes.id
            )
        (folder / scenario / "poses.csv").write_text("\n".join(rows))


if __name__ == "__main__":
    drive = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp()) / "drive"
    if not drive.exists():
        simulate("smoke-opv2v", drive)
    clouds = Path(tempfile.mkdtemp())
    write_clouds(open_recording(drive, "test"), clouds, num_frames=12)
    recording = open_recording(clouds)
    print(type(recording).__name__, *recording.scenarios)
    print(benchmark(recording, methods=["no-fusion", "late", "early"]))
