# SPDX-License-Identifier: Apache-2.0
"""ROS bags, written by rosbags and read back: three storages, four types of poses and tf, no symmetry."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from manyeyes.datasets.base import count_points_in_listed_boxes
from manyeyes.datasets.registry import open_recording
from manyeyes.datasets.ros import RosbagRecording
from manyeyes.datasets.ros.bag import Track
from manyeyes.datasets.ros.messages import StampedPose
from manyeyes.datatypes import MissingExtraError, RecordingError

rosbags = pytest.importorskip("rosbags", reason="the extra 'ros' is not installed")

T0 = 1_700_000_000_123_456_789
CAR = ((58.0, 4.0, 1.1), (4.4, 1.9, 1.6), 0.7)  # middle, size, yaw
# x, y, yaw of the body at T0 and m/s ahead; the LiDAR is mounted 1 m ahead, 0.2 m to the left and 1.7 m above it, turned.
EGO = (50.0, -8.0, 0.9, 6.0)
MOUNT = (1.0, 0.2, 1.7, 0.01, -0.02, 0.3)
ROADSIDE = (70.0, 10.0, 5.3, 0.02, 0.01, -2.2)  # x, y, z, roll, pitch, yaw
STORAGES = ("sqlite3", "mcap", "bag")


def matrix(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> np.ndarray:
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    about_z, about_y = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]),
        np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]),
    )
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = about_z @ about_y @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]]), (x, y, z)
    return out


def body_at(seconds: float) -> np.ndarray:
    x, y, yaw, speed = EGO
    return matrix(x + speed * seconds * math.cos(yaw), y + speed * seconds * math.sin(yaw), 0.3, 0, 0, yaw)


def ego_lidar(seconds: float) -> np.ndarray:
    return body_at(seconds) @ matrix(*MOUNT)


def quaternion(turn: np.ndarray) -> tuple[float, float, float, float]:
    w = math.sqrt(max(1e-12, 1 + np.trace(turn[:3, :3]))) / 2
    return w, *(float(turn[i, j] - turn[j, i]) / (4 * w) for i, j in ((2, 1), (0, 2), (1, 0)))


def scan(pose: np.ndarray) -> np.ndarray:
    """(N, 3) in the LiDAR's frame: 50 points in the front left quarter of the car, the road, two rows of NaN."""
    rng = np.random.default_rng(3)
    center, size, yaw = CAR
    local = rng.uniform(0.5, 0.95, (50, 3)) * np.array(size) / 2
    c, s = math.cos(yaw), math.sin(yaw)
    car = np.stack((local[:, 0] * c - local[:, 1] * s, local[:, 0] * s + local[:, 1] * c, local[:, 2]), 1) + center
    road = np.concatenate((pose[:2, 3] + rng.uniform(-20, 20, (900, 2)), np.full((900, 1), 0.3)), 1)
    road = road[np.hypot(*(road - center)[:, :2].T) > 5]
    xyz = (np.concatenate((car, road)) - pose[:3, 3]) @ pose[:3, :3]
    return np.concatenate((xyz, np.full((2, 3), np.nan)))


class BagWriter:
    """Writes one bag of a storage with rosbags."""

    def __init__(self, path: Path, storage: str) -> None:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.is_ros1 = storage == "bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE)
        if self.is_ros1:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
            self.writer: Any = rosbag1.Writer(path)
        else:
            plugin = rosbag2.StoragePlugin.MCAP if storage == "mcap" else rosbag2.StoragePlugin.SQLITE3
            self.writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        self.connections: dict[str, Any] = {}
        self.writer.open()

    def make(self, name: str, *values: Any, **named: Any) -> Any:
        return self.store.types[name](*values, **named)

    def header(self, time: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", time // 10**9, time % 10**9)
        return self.make("std_msgs/msg/Header", *((0,) if self.is_ros1 else ()), stamp, frame)

    def write(self, topic: str, kind: str, message: Any, time: int) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], time + 3_000_000, serialize(message, kind))  # logged 3 ms later

    def cloud(self, topic: str, time: int, xyz: np.ndarray, frame: str = "lidar", level: float = 51.0) -> None:
        """x, y, z at bytes 0, 4, 8, intensity at 16 and Ouster's t at 20, of 28."""
        fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 16, 7), ("t", 20, 6)]
        kind = np.dtype(
            {
                "names": [f[0] for f in fields],
                "formats": ["<f4"] * 4 + ["<u4"],
                "offsets": [f[1] for f in fields],
                "itemsize": 28,
            }
        )
        rows = np.zeros(len(xyz), kind)
        rows["x"], rows["y"], rows["z"] = xyz.T
        rows["intensity"], rows["t"] = level, np.linspace(0, 9e7, len(xyz)).astype(np.uint32)
        listed = [self.make("sensor_msgs/msg/PointField", n, offset, datatype, 1) for n, offset, datatype in fields]
        message = self.make(
            "sensor_msgs/msg/PointCloud2", self.header(time, frame), 1, len(xyz), listed, False, 28, 28 * len(xyz),
            rows.view(np.uint8).reshape(-1), False,
        )  # fmt: skip
        self.write(topic, "sensor_msgs/msg/PointCloud2", message, time)

    def pose(self, topic: str, time: int, pose: np.ndarray, kind: str = "geometry_msgs/msg/PoseStamped") -> None:
        w, *xyz = quaternion(pose)
        point = self.make("geometry_msgs/msg/Point", *pose[:3, 3].tolist())
        inner = self.make("geometry_msgs/msg/Pose", point, self.make("geometry_msgs/msg/Quaternion", *xyz, w))
        header = self.header(time, "map")
        if kind.endswith("PoseStamped"):
            message = self.make(kind, header, inner)
        elif kind.endswith("TransformStamped"):
            message = self.transform(time, pose, "map", "base")
        else:
            with_error = self.make("geometry_msgs/msg/PoseWithCovariance", inner, np.zeros(36))
            message = (
                self.make(kind, header, with_error)
                if "Pose" in kind
                else self.make(kind, header, "base", with_error, self.twist())
            )
        self.write(topic, kind, message, time)

    def twist(self) -> Any:
        zero = self.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        return self.make(
            "geometry_msgs/msg/TwistWithCovariance", self.make("geometry_msgs/msg/Twist", zero, zero), np.zeros(36)
        )

    def transform(self, time: int, pose: np.ndarray, parent: str, child: str) -> Any:
        w, *xyz = quaternion(pose)
        place = self.make("geometry_msgs/msg/Vector3", *pose[:3, 3].tolist())
        inner = self.make("geometry_msgs/msg/Transform", place, self.make("geometry_msgs/msg/Quaternion", *xyz, w))
        return self.make("geometry_msgs/msg/TransformStamped", self.header(time, parent), child, inner)

    def tf(self, topic: str, time: int, *links: tuple[np.ndarray, str, str]) -> None:
        transforms = [self.transform(time, *link) for link in links]
        self.write(topic, "tf2_msgs/msg/TFMessage", self.make("tf2_msgs/msg/TFMessage", transforms), time)


BOXES = "timestamp_ns,id,label,x,y,z,length,width,height,yaw\n"


def write_drive(folder: Path, storage: str = "mcap", kind: str = "geometry_msgs/msg/PoseStamped") -> Path:
    """Three sweeps of the ego 0.1 s apart, poses at 0.05 s before and after each; a roadside unit by tf, 0.02 s later."""
    folder.mkdir(parents=True, exist_ok=True)
    name = "drive.bag" if storage == "bag" else "drive"
    bag = BagWriter(folder / name, storage)
    bag.tf(
        "/tf_static", T0 - 10**9, (matrix(*ROADSIDE), "mast", "unit/lidar"), (matrix(0, 0, 0, 0, 0, 0.0), "map", "mast")
    )
    rows = []
    for sweep in range(3):
        seconds = 0.1 * sweep
        time = T0 + 100_000_000 * sweep
        for offset in (-0.05, 0.05):
            bag.pose("/ego/pose", time + round(offset * 1e9), body_at(seconds + offset), kind)
        bag.cloud("/ego/points", time, scan(ego_lidar(seconds)))
        bag.cloud("/unit/points", time + 20_000_000, scan(matrix(*ROADSIDE)), level=0.5)
        rows += [",".join(map(str, (time + late, 9, "car", *CAR[0], *CAR[1], CAR[2]))) for late in (0, 20_000_000)]
    bag.writer.close()
    (folder / "boxes.csv").write_text(BOXES + "\n".join(rows) + "\n")
    (folder / "ros.toml").write_text(
        f'bags = ["{name}"]\n\n[[agent]]\nid = 4\npoints = "/ego/points"\npose = "/ego/pose"\nbody_from_lidar = {list(MOUNT)}\n'
        'sensor_height_m = 1.7\nboxes = "boxes.csv"\n\n'
        '[[agent]]\nid = -1\npoints = "/unit/points"\ntf = ["map", "unit/lidar"]\nsensor_height_m = 5.0\nboxes = "boxes.csv"\n'
    )
    return folder


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_is_read_with_the_poses_and_points_that_were_written(tmp_path: Path, storage: str) -> None:
    write_drive(tmp_path / "drive", storage)
    recording = open_recording(tmp_path)
    assert isinstance(recording, RosbagRecording) and recording.scenarios == ("drive",)
    assert recording.agents("drive") == (4, -1) and recording.length("drive") == 3
    snapshot = recording.snapshot("drive", 1)
    ego, unit = snapshot.frames
    assert (ego.timestamp_ns - T0, unit.timestamp_ns - T0) == (100_000_000, 120_000_000)
    assert (ego.is_infrastructure, unit.is_infrastructure) == (False, True)
    assert ego.speed_mps == pytest.approx(6.0) and unit.speed_mps == 0
    for frame, pose, level in ((ego, ego_lidar(0.1), 0.2), (unit, matrix(*ROADSIDE), 0.5)):
        lidar = frame.world_from_agent.matrix().numpy() @ matrix(0, 0, frame.sensor_height_m, 0, 0, 0)
        assert lidar == pytest.approx(pose, abs=1e-6)
        assert len(frame.points) == len(scan(pose)) - 2 and frame.points.intensity.unique().tolist() == pytest.approx(
            [level]
        )
        world = frame.world_from_agent.apply(frame.points.xyz.double())
        assert world[50:, 2].sub(0.3).abs().max() < 1e-4
        assert (
            float(frame.points.time_s.max()) == pytest.approx(0.09, abs=1e-3) and float(frame.points.time_s.min()) == 0
        )
    assert count_points_in_listed_boxes(snapshot, 0.01).tolist() == [[50], [50]]


@pytest.mark.parametrize(
    "kind",
    ["geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped"],
)
def test_poses_of_other_types_are_the_same(tmp_path: Path, kind: str) -> None:
    frame = open_recording(write_drive(tmp_path / "drive", kind=kind)).snapshot("drive", 2).frames[0]
    lidar = frame.world_from_agent.matrix().numpy() @ matrix(0, 0, frame.sensor_height_m, 0, 0, 0)
    assert lidar == pytest.approx(ego_lidar(0.2), abs=1e-6)


def test_an_mcap_file_without_its_folder_is_read(tmp_path: Path) -> None:
    write_drive(tmp_path / "a")
    mcap = next((tmp_path / "a" / "drive").glob("*.mcap"))
    mcap.rename(tmp_path / "a" / "alone.mcap")
    settings = tmp_path / "a" / "ros.toml"
    settings.write_text(settings.read_text().replace('"drive"', '"alone.mcap"'))
    assert open_recording(tmp_path / "a").length("a") == 3


def test_intensities_are_divided_by_the_stated_maximum(tmp_path: Path) -> None:
    settings = write_drive(tmp_path / "a") / "ros.toml"
    settings.write_text(settings.read_text().replace("id = 4\n", "id = 4\nintensity_max = 102\n"))
    assert open_recording(tmp_path).snapshot("a", 0).frames[0].points.intensity.unique().tolist() == [0.5]


def test_the_body_of_the_vehicle_is_in_the_frame(tmp_path: Path) -> None:
    settings = write_drive(tmp_path / "a") / "ros.toml"
    text = settings.read_text()
    settings.write_text(text.replace("id = 4\n", "id = 4\nbody = [0.4, -0.1, 4.6, 1.9, 1.5]\n"))
    ego, unit = open_recording(tmp_path).snapshot("a", 0).frames
    assert unit.body is None and ego.body is not None
    assert (ego.body.center, ego.body.size) == ((0.4, -0.1, 0.75), (4.6, 1.9, 1.5))
    settings.write_text(text.replace("id = 4\n", "id = 4\nbody = [0.4, -0.1, 4.6, -1.9, 1.5]\n"))
    with pytest.raises(RecordingError, match=r"ros\.toml: agent\[0\]\.body is no body"):
        open_recording(tmp_path)


def test_without_boxes_there_is_no_truth_and_without_a_height_it_is_found(tmp_path: Path) -> None:
    settings = write_drive(tmp_path / "a") / "ros.toml"
    text = settings.read_text().replace('boxes = "boxes.csv"\n', "").replace("sensor_height_m = 1.7\n", "")
    settings.write_text(text)
    snapshot = open_recording(tmp_path).snapshot("a", 0)
    assert snapshot.truth is None and snapshot.frames[0].sensor_height_m == pytest.approx(1.7, abs=0.8)


def test_sweeps_without_a_pose_are_left_out(tmp_path: Path) -> None:
    settings = write_drive(tmp_path / "a") / "ros.toml"
    settings.write_text("max_pose_gap_ms = 20\n" + settings.read_text())
    with pytest.raises(RecordingError, match=r"no sweep of /ego/points has a pose of /ego/pose.*max_pose_gap_ms"):
        open_recording(tmp_path).length("a")


def change(old: str, new: str) -> Callable[[str], str]:
    return lambda text: text.replace(old, new)


@pytest.mark.parametrize(
    ("edit", "text"),
    [
        (change('"/ego/points"', '"/points"'), r"no topic /points in the bag, which has /ego/points \(PointCloud2\)"),
        (
            change('points = "/ego/points"', 'points = "/ego/pose"'),
            "of the type geometry_msgs/msg/PoseStamped, expected PointCloud2",
        ),
        (
            change('pose = "/ego/pose"', 'pose = "/ego/points"'),
            "of the type sensor_msgs/msg/PointCloud2, expected PoseStamped",
        ),
        (change('"unit/lidar"', '"lidar"'), "/tf does not lead from 'map' to 'lidar'"),
        (change('["map"', '["world"'), "'map' has no parent there"),
    ],
)
def test_topics_and_frames_that_are_not_there_list_those_that_are(tmp_path: Path, edit: Any, text: str) -> None:
    settings = write_drive(tmp_path / "a") / "ros.toml"
    settings.write_text(edit(settings.read_text()))
    with pytest.raises(RecordingError, match=text) as caught:
        open_recording(tmp_path).length("a")
    assert str(settings) in str(caught.value)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("bags = [", "expected TOML"),
        ("bags = []\n", "a list of file names at 'bags'"),
        ('bags = ["none"]\n[[agent]]\nid = 0\npoints = "/p"\npose = "/q"\n', "no bag"),
        ('bags = ["."]\n', r"tables \[\[agent\]\]"),
        ('bags = ["."]\n[[agent]]\nid = "a"\n', "a whole number at 'agent\\[0\\].id'"),
        ('bags = ["."]\n[[agent]]\nid = 0\npoints = "/p"\n', "either 'pose' or 'tf'"),
        (
            'bags = ["."]\n[[agent]]\nid = 0\npoints = "/p"\npose = "/q"\nheight = 2\n',
            "unknown key 'agent\\[0\\].height'",
        ),
        ('bags = ["."]\n[[agent]]\nid = 0\npoints = "/p"\npose = "/q"\nbody_from_lidar = [1]\n', "six numbers"),
        ('bags = ["."]\n' + 2 * '[[agent]]\nid = 0\npoints = "/p"\npose = "/q"\n', "two agents have one id"),
    ],
)
def test_settings_that_cannot_be_used_name_the_key(tmp_path: Path, content: str, text: str) -> None:
    (tmp_path / "ros.toml").write_text(content)
    with pytest.raises(RecordingError, match=text) as caught:
        open_recording(tmp_path)
    assert "ros.toml" in str(caught.value)


def test_a_damaged_bag_is_named(tmp_path: Path) -> None:
    write_drive(tmp_path / "a")
    for path in (tmp_path / "a" / "drive").glob("*.mcap"):
        path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(RecordingError, match=r"ros\.toml: drive.* cannot be read"):
        open_recording(tmp_path).length("a")


def test_without_the_extra_the_pip_line_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_drive(tmp_path / "a")
    for name in ("rosbags", "rosbags.highlevel", "rosbags.typesys"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match=r"pip install 'manyeyes\[ros\]'"):
        open_recording(tmp_path)


def test_poses_between_two_lie_on_the_line_and_the_great_circle() -> None:
    half = (math.cos(0.4), 0.0, 0.0, math.sin(0.4))  # a turn of 0.8 about z
    track = Track.of(
        [
            StampedPose(1000, (2.0, 0.0, 1.0), tuple(-v for v in half), "a", "b"),  # type: ignore[arg-type]
            StampedPose(0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), "a", "b"),
        ]
    )
    pose = track.at(250, 1000)
    assert pose is not None and pose.translation.tolist() == [0.5, 0, 0.25] and float(pose.yaw) == pytest.approx(0.2)
    assert track.at(250, 999) is None and track.at(1400, 1000) is not None and track.at(1600, 1000) is None
    both = track.at(1000, 10)
    assert both is not None and float(both.yaw) == pytest.approx(0.8)
    assert torch.allclose(both.rotation @ both.rotation.mT, torch.eye(3, dtype=torch.float64))
