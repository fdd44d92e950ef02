# SPDX-License-Identifier: Apache-2.0
"""KITTI's three layouts, written by hand in their own axes: one scene, two cars and a pedestrian, no symmetry."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from manyeyes.datasets.base import count_points_in_listed_boxes
from manyeyes.datasets.kitti import KittiRecording
from manyeyes.datasets.registry import open_recording
from manyeyes.datatypes import LABELS, RecordingError

# type, middle in the LiDAR's frame (the road is at z = -1.73), size (l, w, h), yaw.
THINGS = (
    ("Car", (12.0, 3.0, -0.98), (4.2, 1.7, 1.5), 0.4),
    ("Van", (-9.0, -6.0, -0.63), (5.1, 1.9, 2.2), -2.1),
    ("Pedestrian", (7.0, -4.0, -0.88), (0.7, 0.6, 1.7), 1.2),
)
# p_camera = CAMERA @ p_lidar: x right, y down, z ahead, and a camera 0.27 m ahead of and 0.08 m below the LiDAR, slightly turned.
TURN = 0.01
CAMERA = np.array(
    [
        [math.sin(TURN), -math.cos(TURN), 0, 0.004],
        [0, 0, -1, -0.08],
        [math.cos(TURN), math.sin(TURN), 0, -0.27],
    ]
)


def scan() -> np.ndarray:
    """(N, 4): 50 points in the front left quarter of each thing, the road, and intensity by row."""
    rng, parts = np.random.default_rng(1), []
    for _, center, size, yaw in THINGS:
        local = rng.uniform(0.5, 0.95, (50, 3)) * np.array(size) / 2
        c, s = math.cos(yaw), math.sin(yaw)
        parts.append(
            np.stack((local[:, 0] * c - local[:, 1] * s, local[:, 0] * s + local[:, 1] * c, local[:, 2]), 1) + center
        )
    road = np.concatenate((rng.uniform(-30, 30, (800, 2)), np.full((800, 1), -1.73)), 1)
    road = road[np.min([np.hypot(*(road - thing[1])[:, :2].T) for thing in THINGS], 0) > 4]
    xyz = np.concatenate((*parts, road))
    return np.concatenate((xyz, np.linspace(0, 0.9, len(xyz))[:, None]), 1).astype("<f4")


def write(path: Path, content: str | bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())


def row(numbers: np.ndarray) -> str:
    return " ".join(f"{v:.12e}" for v in np.asarray(numbers).ravel())


def write_object(root: Path, stems: tuple[str, ...] = ("000003", "000007")) -> Path:
    lines = ["DontCare -1 -1 -10 503 169 590 190 -1 -1 -1 -1000 -1000 -1000 -10"]
    for kind, center, (length, width, height), yaw in THINGS:
        bottom = CAMERA @ (center[0], center[1], center[2] - height / 2, 1)
        ahead = CAMERA[:, :3] @ (math.cos(yaw), math.sin(yaw), 0)
        ry = math.atan2(-ahead[2], ahead[0])
        lines.append(f"{kind} 0.00 0 -1.57 1 2 3 4 {height} {width} {length} {row(bottom)} {ry:.12f}")
    for stem in stems:
        write(root / "training" / "velodyne" / f"{stem}.bin", scan().tobytes())
        write(root / "training" / "label_2" / f"{stem}.txt", "\n".join(lines) + "\n")
        calibration = f"P0: {row(np.eye(3, 4))}\nR0_rect: {row(np.eye(3))}\nTr_velo_to_cam: {row(CAMERA)}\n\n"
        write(root / "training" / "calib" / f"{stem}.txt", calibration)
    return root


def check_boxes(recording: KittiRecording, scenario: str, index: int) -> None:
    snapshot = recording.snapshot(scenario, index)
    assert snapshot.truth is not None
    assert count_points_in_listed_boxes(snapshot, 0.02).tolist() == [[50, 50, 50]]
    lidar = snapshot.truth.boxes.transform(snapshot.frames[0].world_from_agent.inverse())
    for box, (kind, center, size, yaw) in enumerate(THINGS):
        assert LABELS[int(lidar.label[box])] == kind.lower()
        assert lidar.center[box].tolist() == pytest.approx((center[0], center[1], center[2] + 1.73), abs=1e-3)
        assert lidar.size[box].tolist() == pytest.approx(size)
        assert float(lidar.yaw[box]) == pytest.approx(yaw, abs=2e-3)


def test_object_detection_is_read_frame_by_frame(tmp_path: Path) -> None:
    recording = open_recording(write_object(tmp_path), "training")
    assert isinstance(recording, KittiRecording) and recording.scenarios == ("000003", "000007")
    assert recording.length("000003") == 1 and recording.agents("000003") == (0,)
    check_boxes(recording, "000003", 0)
    frame = recording.snapshot("000007", 0).frames[0]
    assert frame.points.intensity.tolist() == pytest.approx(scan()[:, 3].tolist())
    assert frame.points.xyz[150:, 2].abs().max() < 1e-5 and frame.sensor_height_m == 1.73
    assert open_recording(tmp_path).scenarios == recording.scenarios  # one part needs no name
    write(tmp_path / "testing" / "velodyne" / "000000.bin", scan().tobytes())
    write(tmp_path / "testing" / "calib" / "000000.txt", "")
    assert open_recording(tmp_path, "testing").snapshot("000000", 0).truth is None
    with pytest.raises(RecordingError, match=r"training, testing.*name one as split"):
        open_recording(tmp_path)


def write_odometry(root: Path, poses: bool = True) -> np.ndarray:
    """Two sweeps of sequence 07; return world_from_lidar (2, 4, 4) as the files say it."""
    turn = 0.3
    moved = np.array(  # of the camera: 2 m to its right, 0.5 m down, 9 m ahead, a turn about its y axis
        [[math.cos(turn), 0, math.sin(turn), 2.0], [0, 1, 0, 0.5], [-math.sin(turn), 0, math.cos(turn), 9.0]]
    )
    folder = root / "sequences" / "07"
    for stem in ("000000", "000001"):
        write(folder / "velodyne" / f"{stem}.bin", scan().tobytes())
    write(folder / "calib.txt", f"P0: {row(np.eye(3, 4))}\nTr: {row(CAMERA)}\n")
    write(folder / "times.txt", "0.000000e+00\n1.037800e-01\n")
    if poses:
        write(root / "poses" / "07.txt", f"{row(np.eye(3, 4))}\n{row(moved)}\n")
    camera, pose = np.eye(4), np.eye(4)
    camera[:3], pose[:3] = CAMERA, moved
    return np.stack((np.eye(4), np.linalg.inv(camera) @ pose @ camera))


def test_odometry_is_read_in_the_axes_of_the_first_sweep(tmp_path: Path) -> None:
    expected = write_odometry(tmp_path)
    recording = open_recording(tmp_path)
    assert isinstance(recording, KittiRecording) and recording.scenarios == ("07",) and recording.length("07") == 2
    second = recording.snapshot("07", 1)
    assert second.truth is None and second.frames[0].timestamp_ns == 103_780_000
    lidar = second.frames[0].world_from_agent.matrix() @ torch.tensor(
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1.73], [0, 0, 0, 1.0]], dtype=torch.float64
    )
    assert lidar.numpy() == pytest.approx(expected[1], abs=1e-9)
    x, y, z = lidar[:3, 3].tolist()  # the camera's right is the LiDAR's right, its down is down
    assert x > 8 and y < -1.5 and z < -0.4
    assert second.frames[0].speed_mps == pytest.approx(np.linalg.norm(expected[1][:3, 3]) / 0.10378)
    for place in (tmp_path / "sequences", tmp_path / "sequences" / "07"):
        assert open_recording(place).scenarios == ("07",)


def write_raw(root: Path) -> Path:
    drive = root / "2011_09_26" / "2011_09_26_drive_0005_sync"
    # latitude, longitude, altitude, roll, pitch, yaw (0 to the east), then values that are not used.
    places = (
        "49.011212804408 8.4228850417969 112.83 0.02 -0.01 0.6",
        "49.011262804408 8.4229850417969 113.13 0.03 0.01 0.7",
    )
    for index, place in enumerate(places):
        write(drive / "velodyne_points" / "data" / f"{index:010d}.bin", scan().tobytes())
        write(drive / "oxts" / "data" / f"{index:010d}.txt", f"{place} {' '.join(['0.5'] * 24)}\n")
    write(
        drive / "velodyne_points" / "timestamps.txt", "2011-09-26 13:02:25.951199337\n2011-09-26 13:02:26.054000000\n"
    )
    write(
        root / "2011_09_26" / "calib_imu_to_velo.txt",
        f"calib_time: 25-May-2012\nR: {row(np.eye(3))}\nT: -0.8 0.3 -0.7\n",
    )
    items = "".join(
        f"<item><objectType>{kind}</objectType><h>{h}</h><w>{w}</w><l>{length}</l><first_frame>1</first_frame><poses><count>1</count>"
        f"<item><tx>{x}</tx><ty>{y}</ty><tz>{z - h / 2}</tz><rx>0</rx><ry>0</ry><rz>{yaw}</rz></item></poses></item>"
        for kind, (x, y, z), (length, w, h), yaw in THINGS
    )
    text = f"<!DOCTYPE boost_serialization><boost_serialization><tracklets>{items}</tracklets></boost_serialization>"
    write(drive / "tracklet_labels.xml", text)
    return drive


def test_raw_drives_are_read_with_gps_and_tracklets(tmp_path: Path) -> None:
    drive = write_raw(tmp_path)
    recording = open_recording(tmp_path)
    assert isinstance(recording, KittiRecording) and recording.scenarios == (drive.name,)
    first, second = (recording.snapshot(drive.name, index) for index in range(2))
    assert first.truth is not None and len(first.truth.boxes) == 0
    check_boxes(recording, drive.name, 1)
    assert second.frames[0].timestamp_ns - first.frames[0].timestamp_ns == 102_800_663
    east, north, up = (
        second.frames[0].world_from_agent.translation - first.frames[0].world_from_agent.translation
    ).tolist()
    # 5e-5 degrees to the north are 5.6 m, 1e-4 to the east 7.3 m at this latitude; the IMU is 0.8 m ahead of the LiDAR's frame.
    assert (east, north, up) == pytest.approx((7.3, 5.57, 0.3), abs=0.15)
    assert float(second.frames[0].world_from_agent.yaw) == pytest.approx(0.7, abs=1e-3)
    # T takes a point of the IMU's frame to the LiDAR's: the LiDAR is 0.8 m ahead, 0.3 m to the right and 0.7 m above the IMU.
    lidar = first.frames[0].world_from_agent.apply(torch.tensor([[0.0, 0.0, 1.73]]).double())[0]
    ahead = math.cos(0.6) * lidar[0] + math.sin(0.6) * lidar[1]
    assert float(ahead) == pytest.approx(0.8, abs=0.03) and float(lidar[2]) == pytest.approx(0.7, abs=0.03)


@pytest.mark.parametrize(
    ("gone", "text"),
    [("training/calib/000003.txt", "000003.txt"), ("training/label_2/000003.txt", "000003.txt")],
)
def test_a_frame_that_lacks_a_file_is_left_out_and_named(tmp_path: Path, gone: str, text: str) -> None:
    (write_object(tmp_path) / gone).unlink()
    recording = open_recording(tmp_path)
    assert recording.scenarios == ("000007",) and recording.missing_files[0].path == tmp_path / gone
    assert text in recording.missing_summary[0]


def test_a_sequence_without_poses_is_an_error_that_names_the_file(tmp_path: Path) -> None:
    write_odometry(tmp_path, poses=False)
    with pytest.raises(RecordingError, match=r"poses/07\.txt.*Download"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("path", "content", "text"),
    [
        ("training/calib/000003.txt", "R0_rect: 1 2\n", "9 finite numbers at R0_rect"),
        ("training/calib/000003.txt", "nothing\n", "R0_rect or R_rect"),
        ("training/calib/000003.txt", f"R0_rect: {'0 ' * 9}\nTr_velo_to_cam: {'1 ' * 12}", "no rigid motion"),
        ("training/label_2/000003.txt", "Car 0 0 0 1 2 3 4 1.5\n", "14 finite numbers at line 1"),
        ("training/velodyne/000003.bin", "12345", "multiple of 16"),
    ],
)
def test_damaged_files_are_named_with_the_place(tmp_path: Path, path: str, content: str, text: str) -> None:
    write(write_object(tmp_path) / path, content)
    with pytest.raises(RecordingError, match=text) as caught:
        open_recording(tmp_path).snapshot("000003", 0)
    assert str(tmp_path / path) in str(caught.value)


def test_damaged_tracklets_are_named(tmp_path: Path) -> None:
    drive = write_raw(tmp_path)
    write(drive / "tracklet_labels.xml", "<tracklets")
    with pytest.raises(RecordingError, match=r"tracklet_labels\.xml: expected KITTI's tracklets"):
        open_recording(tmp_path).snapshot(drive.name, 0)


def test_folders_of_kitti_are_of_no_other_layout(tmp_path: Path) -> None:
    """Sequences and drives are named by numbers, as agents of OPV2V are; vehicle-side of DAIR-V2X has a velodyne, too."""
    write_odometry(tmp_path / "odometry")
    write_object(tmp_path / "object")
    for root in ("odometry", "object"):
        assert isinstance(open_recording(tmp_path / root), KittiRecording)
    write(tmp_path / "dair" / "vehicle-side" / "velodyne" / "000001.pcd", "")
    assert not KittiRecording.matches(tmp_path / "dair")
