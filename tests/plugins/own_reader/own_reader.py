"""A reader of clouds in .npz files, with their poses in a table."""

from pathlib import Path

import numpy as np

from manyeyes import AgentFrame, Boxes, PointCloud, RecordingReader, Snapshot, Transform, register_dataset
from manyeyes.datatypes import GroundTruth


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
