# SPDX-License-Identifier: Apache-2.0
"""TUMTraf-V2X, written by hand: a tilted roadside LiDAR, a vehicle registered to it, OpenLABEL, no symmetry."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from manyeyes.datasets.base import count_points_in_listed_boxes
from manyeyes.datasets.formats.pcd import PcdTable, write_table
from manyeyes.datasets.registry import open_recording
from manyeyes.datasets.tumtraf import TumTrafRecording
from manyeyes.datatypes import LABELS, RecordingError

ROADSIDE, VEHICLE = "s110_lidar_ouster_south", "vehicle_lidar_robosense"
BOTH = f"{ROADSIDE}_and_{VEHICLE}_registered"
ROAD_Z = 0.2


def motion(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> np.ndarray:
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    about_z, about_y = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]),
        np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]),
    )
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = about_z @ about_y @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]]), (x, y, z)
    return out


# In the frame of the crossing; the roadside LiDAR is 7.3 m above the road, the vehicle's 2 m.
WORLD_FROM_ROADSIDE = motion(-15.9, 2.3, ROAD_Z + 7.3, 0.028, -0.03, 1.35)
WORLD_FROM_VEHICLE = motion(12.0, -6.0, ROAD_Z + 2.0, 0.01, 0.008, 2.8)
ROADSIDE_FROM_VEHICLE = np.linalg.inv(WORLD_FROM_ROADSIDE) @ WORLD_FROM_VEHICLE
# key: type, middle in the crossing's frame, size (l, w, h), yaw.
THINGS = {
    "0b04-a": ("CAR", (3.0, -1.0, ROAD_Z + 0.75), (4.3, 1.8, 1.5), 0.6),
    "77fa-b": ("BUS", (-4.0, 9.0, ROAD_Z + 1.6), (11.5, 2.5, 3.2), -1.9),
    "c1d2-c": ("PEDESTRIAN", (6.0, -9.0, ROAD_Z + 0.9), (0.7, 0.6, 1.8), 2.5),
    "e0e0-d": ("BICYCLE", (9.0, 3.0, ROAD_Z + 0.8), (1.7, 0.6, 1.6), 0.1),
    "ffff-e": ("OTHER", (0.0, 0.0, ROAD_Z + 0.5), (1.0, 1.0, 1.0), 0.0),
}
SEEN = {VEHICLE: ("0b04-a", "c1d2-c"), ROADSIDE: ("0b04-a", "77fa-b", "c1d2-c", "e0e0-d")}


def scan(sensor: str) -> np.ndarray:
    """(N, 3) in the sensor's frame: 40 points in the front left quarter of what it sees, then the road."""
    pose, rng = (WORLD_FROM_VEHICLE if sensor == VEHICLE else WORLD_FROM_ROADSIDE), np.random.default_rng(4)
    parts = []
    for key in SEEN[sensor]:
        _, center, size, yaw = THINGS[key]
        local = rng.uniform(0.5, 0.95, (40, 3)) * np.array(size) / 2
        c, s = math.cos(yaw), math.sin(yaw)
        parts.append(
            np.stack((local[:, 0] * c - local[:, 1] * s, local[:, 0] * s + local[:, 1] * c, local[:, 2]), 1) + center
        )
    road = np.concatenate((pose[:2, 3] + rng.uniform(-30, 30, (3000, 2)), np.full((3000, 1), ROAD_Z)), 1)
    road = road[np.min([np.hypot(*(road - t[1])[:, :2].T) for t in THINGS.values()], 0) > 7]
    return ((np.concatenate((*parts, road)) - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32)


def cuboid(key: str) -> list[float]:
    """x, y, z, qx, qy, qz, qw, l, w, h in the roadside LiDAR's frame; a box turns about the world's z axis, as labelled."""
    _, center, size, yaw = THINGS[key]
    roadside_from_box = np.linalg.inv(WORLD_FROM_ROADSIDE) @ motion(*center, 0, 0, yaw)
    m = roadside_from_box[:3, :3]
    w = math.sqrt(max(0.0, 1 + np.trace(m))) / 2
    x, y, z = (m[2, 1] - m[1, 2]) / (4 * w), (m[0, 2] - m[2, 0]) / (4 * w), (m[1, 0] - m[0, 1]) / (4 * w)
    return [*roadside_from_box[:3, 3].tolist(), x, y, z, w, *size]


def label(second: int, nanosecond: int, has_base: bool) -> dict[str, Any]:
    name = f"{second}_{nanosecond:09d}"
    objects = {k: {"object_data": {"name": f"{t[0]}_{k}", "type": t[0], "cuboid": {"name": "shape3D", "val": cuboid(k)}}}
               for k, t in THINGS.items()}  # fmt: skip
    transform = {
        f"{VEHICLE}_to_{ROADSIDE}": {
            "src": VEHICLE, "dst": ROADSIDE, "transform_src_to_dst": {"matrix4x4": ROADSIDE_FROM_VEHICLE.tolist()}
        }
    }  # fmt: skip
    names = [f"{second}_{nanosecond + 46:09d}_{VEHICLE}.pcd", f"{name}_{ROADSIDE}.pcd", f"{name}_{BOTH}.pcd"]
    frame = {
        "frame_properties": {"timestamp": second, "point_cloud_file_names": names, "transforms": transform},
        "objects": objects,
    }
    systems = {
        "s110_base": {"type": "scene_cs", "parent": "", "children": [ROADSIDE]},
        ROADSIDE: {
            "type": "sensor_cs",
            "parent": "s110_base",
            "pose_wrt_parent": {"matrix4x4": WORLD_FROM_ROADSIDE.ravel().tolist()},
        },
    }
    content = {"metadata": {"schema_version": "1.0.0"}, "frames": {"17": frame}}
    return {"openlabel": content | ({"coordinate_systems": systems} if has_base else {})}


def write_split(split: Path, has_base: bool = True, prefix: str = "", times: tuple[int, ...] = (0,)) -> Path:
    """Frames 0.1 s apart, as many ticks after 1688625741 s as times say."""
    for tick in times:
        second, nanosecond = 1688625741 + tick // 10, 100_000_000 * (tick % 10) + 7
        path = split / f"{prefix}labels_point_clouds" / BOTH / f"{second}_{nanosecond:09d}_{BOTH}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(label(second, nanosecond, has_base)))
        for sensor, late in ((VEHICLE, 46), (ROADSIDE, 0)):
            cloud = split / f"{prefix}point_clouds" / sensor / f"{second}_{nanosecond + late:09d}_{sensor}.pcd"
            cloud.parent.mkdir(parents=True, exist_ok=True)
            xyz = scan(sensor)
            write_table(cloud, PcdTable(("x", "y", "z", "intensity"), (*xyz.T, np.full(len(xyz), 51, np.float32))))
    return split


@pytest.mark.parametrize("prefix", ["", "_"])
def test_both_agents_and_all_types_are_read_in_the_frame_of_the_crossing(tmp_path: Path, prefix: str) -> None:
    write_split(tmp_path / "val", prefix=prefix)
    recording = open_recording(tmp_path, "val")
    assert isinstance(recording, TumTrafRecording) and recording.scenarios == ("1688625741",)
    assert recording.agents("1688625741") == (0, -1)
    snapshot = recording.snapshot("1688625741", 0)
    assert [f.agent_id for f in snapshot.frames] == [0, -1]
    assert [f.is_infrastructure for f in snapshot.frames] == [False, True]
    assert [f.timestamp_ns - 1688625741 * 10**9 for f in snapshot.frames] == [53, 7]
    for frame, pose, height in zip(snapshot.frames, (WORLD_FROM_VEHICLE, WORLD_FROM_ROADSIDE), (2.0, 7.3)):
        assert frame.sensor_height_m == pytest.approx(height, abs=0.1)
        lidar = frame.world_from_agent.apply(torch.tensor([[0.0, 0.0, frame.sensor_height_m]]).double())[0]
        assert lidar.tolist() == pytest.approx(pose[:3, 3].tolist())
        assert frame.points.intensity.unique().tolist() == pytest.approx([0.2])
        world = frame.world_from_agent.apply(frame.points.xyz.double())
        assert world[200:, 2].sub(ROAD_Z).abs().max() < 1e-3
        assert frame.points.xyz[200:, 2].abs().max() < 0.11  # the road is at zero in the agent's frame, too
    truth = snapshot.truth
    assert truth is not None
    counts = count_points_in_listed_boxes(snapshot, 0.02)
    assert bool((counts[truth.seen] == 40).all())
    for row, sensor in enumerate((VEHICLE, ROADSIDE)):
        seen = {LABELS[i] for i in truth.boxes.label[truth.seen[row]].tolist()}
        assert len(seen) == len(SEEN[sensor]) and {"car", "pedestrian"} <= seen
    by_label = {LABELS[i]: row for row, i in enumerate(truth.boxes.label.tolist())}
    assert set(by_label) == {"car", "bus", "pedestrian", "cyclist"}
    for key, name in (("0b04-a", "car"), ("77fa-b", "bus"), ("c1d2-c", "pedestrian"), ("e0e0-d", "cyclist")):
        row = by_label[name]
        assert truth.boxes.center[row].tolist() == pytest.approx(THINGS[key][1], abs=1e-6)
        assert truth.boxes.size[row].tolist() == pytest.approx(THINGS[key][2])
        assert float(truth.boxes.yaw[row]) == pytest.approx(THINGS[key][3])


def test_without_the_crossings_frame_the_roadside_lidar_is_the_world(tmp_path: Path) -> None:
    snapshot = open_recording(write_split(tmp_path / "val", has_base=False)).snapshot("1688625741", 0)
    assert snapshot.truth is not None
    counts = count_points_in_listed_boxes(snapshot, 0.1)
    assert bool((counts[snapshot.truth.seen] >= 38).all()) and int(snapshot.truth.seen.sum()) == 6
    between = snapshot.frames[1].world_from_agent.inverse() @ snapshot.frames[0].world_from_agent
    assert float(between.yaw) == pytest.approx(2.8 - 1.35, abs=0.01)


def test_gaps_part_drives_and_ids_stay(tmp_path: Path) -> None:
    recording = open_recording(write_split(tmp_path / "val", times=(0, 1, 3, 50, 51)))
    assert [(name, recording.length(name)) for name in recording.scenarios] == [("1688625741", 3), ("1688625746", 2)]
    truths = [recording.snapshot("1688625741", index).truth for index in (0, 2)]
    assert truths[0] is not None and truths[1] is not None
    assert truths[0].boxes.id.tolist() == truths[1].boxes.id.tolist() and int(truths[0].boxes.id.min()) > 1


def test_a_missing_cloud_is_named_and_the_other_agent_read_alone(tmp_path: Path) -> None:
    split = write_split(tmp_path / "val")
    gone = next((split / "point_clouds" / VEHICLE).iterdir())
    gone.unlink()
    recording = open_recording(split)
    assert [f.agent_id for f in recording.snapshot("1688625741", 0).frames] == [-1]
    assert [problem.path for problem in recording.verify().files] == [gone]
    next((split / "point_clouds" / ROADSIDE).iterdir()).unlink()
    with pytest.raises(RecordingError, match="none of its clouds"):
        recording.snapshot("1688625741", 0)


def test_a_root_with_splits_asks_for_one(tmp_path: Path) -> None:
    write_split(tmp_path / "train")
    write_split(tmp_path / "val")
    with pytest.raises(RecordingError, match=r"train, val; name one"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('"openlabel"', '"label"', "expected the key 'openlabel'"),
        ('"17"', '"18": {}, "17"', "expected one frame"),
        ("transform_src_to_dst", "transform", "transform_src_to_dst"),
        (f"{VEHICLE}_to_{ROADSIDE}", "other", "vehicle_lidar_"),
        ('"val": [', '"val": [null, ', "10 finite numbers"),
        ("4.3, 1.8, 1.5", "4.3, 0, 1.5", "no size"),
        ("{", "", "expected JSON"),
    ],
)
def test_a_damaged_label_is_named_with_the_key(tmp_path: Path, old: str, new: str, text: str) -> None:
    path = next((write_split(tmp_path / "val") / "labels_point_clouds" / BOTH).iterdir())
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(RecordingError, match=text) as caught:
        open_recording(tmp_path / "val").snapshot("1688625741", 0)
    assert str(path) in str(caught.value)
