# SPDX-License-Identifier: Apache-2.0
"""What our writer puts down in DAIR-V2X's layout, and that it comes back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from manyeyes.datasets.dair_v2x import DairRecording
from manyeyes.datasets.dair_v2x.writer import DairWriter, write_dair_index
from manyeyes.datasets.formats.pcd import read_table
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, RecordingError, Snapshot, Transform

CAR, TRUCK, OWN, UNSEEN = 40, 41, 37, 50


def tilted(x: float, y: float, z: float, yaw: float) -> Transform:
    angles = (torch.tensor(a, dtype=torch.float64) for a in (0.01, -0.02, yaw))
    return Transform.from_rpy(torch.tensor([x, y, z], dtype=torch.float64), *angles)


def drive(moved_m: float = 0.0, time_ns: int = 200_000_000) -> Snapshot:
    """Vehicle 37 and a pole; the vehicle lists a car and a truck, the pole the truck and vehicle 37; the truck moves."""
    random = torch.Generator().manual_seed(3)
    poses = (tilted(5, -3, 0.4, 0.8), Transform.from_xyz_yaw(30, 12, 0.1, -2.4))
    frames = []
    for id, pose, height in ((OWN, poses[0], 1.85), (-1, poses[1], 5.2)):
        xyz = torch.rand(400, 3, generator=random) * torch.tensor([80.0, 60.0, 4.0]) - torch.tensor([10.0, 30.0, 0.0])
        cloud = PointCloud.of(xyz, torch.rand(400, generator=random), -0.1 * torch.rand(400, generator=random))
        frames.append(AgentFrame(id, time_ns, cloud, pose, torch.zeros(3, 3), height, is_infrastructure=id < 0))
    center = torch.tensor([[15, 2, 0.9], [22 + moved_m, 9, 1.7], [5.1, -2.8, 1.1], [60, 60, 1]], dtype=torch.float64)
    size = torch.tensor([[4.3, 1.8, 1.6], [8.4, 2.5, 3.2], [4.5, 1.9, 1.5], [4, 2, 1.5]], dtype=torch.float64)
    yaw = torch.tensor([3.0, -1.1, 0.8, 0.0], dtype=torch.float64)
    boxes = Boxes.of(center, size, yaw, label=torch.tensor([0, 2, 0, 0]), id=torch.tensor([CAR, TRUCK, OWN, UNSEEN]))
    seen = torch.tensor([[True, True, False, False], [False, True, True, False]])
    return Snapshot("drive", 0, tuple(frames), GroundTruth(boxes, seen, Transform.stack(list(poses))))


def written(root: Path, snapshot: Snapshot, unit: Snapshot | None = None) -> DairRecording:
    writer = DairWriter(root, "7", "somewhere")
    writer.write(snapshot, 123, unit, offset=(0.4, -0.7))
    write_dair_index(root, [writer.rows], {"val": writer.rows.frames})
    return DairRecording(root, "val", strict=True)


def test_a_snapshot_round_trips(tmp_path: Path) -> None:
    snapshot = drive()
    found = written(tmp_path, snapshot).snapshot("7", 0)
    assert snapshot.truth is not None and found.truth is not None
    for one, other in zip(found.frames, snapshot.frames):
        assert (one.timestamp_ns, one.is_infrastructure) == (other.timestamp_ns, other.is_infrastructure)
        assert one.sensor_height_m == other.sensor_height_m
        torch.testing.assert_close(one.points.xyz, other.points.xyz, atol=1e-5, rtol=0)
        torch.testing.assert_close(one.world_from_agent.rotation, other.world_from_agent.rotation, atol=1e-12, rtol=0)
        torch.testing.assert_close(
            one.world_from_agent.translation, other.world_from_agent.translation, atol=1e-9, rtol=0
        )
    vehicle, pole = (f.points for f in found.frames)
    torch.testing.assert_close(vehicle.intensity, snapshot.frames[0].points.intensity, atol=0.5 / 255 + 1e-6, rtol=0)
    assert torch.equal(pole.intensity, snapshot.frames[1].points.intensity)
    torch.testing.assert_close(vehicle.time_s, snapshot.frames[0].points.time_s, atol=1e-6, rtol=0)
    assert found.truth.boxes.id.tolist() == [CAR, TRUCK, 0]
    assert found.truth.boxes.label.tolist() == [0, 2, 0]
    torch.testing.assert_close(found.truth.boxes.bev(), snapshot.truth.boxes[:3].bev(), atol=1e-9, rtol=0)
    torch.testing.assert_close(found.truth.boxes.corners(), snapshot.truth.boxes[:3].corners(), atol=1e-9, rtol=0)
    assert torch.equal(found.truth.seen, snapshot.truth.seen[:, :3])


def test_the_poles_sweep_of_another_instant(tmp_path: Path) -> None:
    now, then = drive(), drive(moved_m=-0.4, time_ns=160_000_000)
    recording = written(tmp_path, now, then)
    found = recording.snapshot("7", 0)
    assert [f.timestamp_ns for f in found.frames] == [200_000_000, 160_000_000]
    assert found.truth is not None and found.truth.seen.tolist() == [[True, True, False], [False, True, True]]
    vehicle, pole = recording.side_boxes("7", 0)
    assert float(found.truth.boxes.center[1, 0]) == pytest.approx(22.0)
    assert float(pole.center[0, 0]) == pytest.approx(21.6)
    assert vehicle.id.tolist() == [CAR, TRUCK]
    assert pole.id.tolist() == [TRUCK, OWN]


def test_the_files_have_the_formats_habits(tmp_path: Path) -> None:
    recording = written(tmp_path, drive())
    vehicle = read_table(tmp_path / "vehicle-side/velodyne/000123.pcd")
    pole = read_table(tmp_path / "infrastructure-side/velodyne/000123.pcd")
    assert vehicle.names == ("x", "y", "z", "intensity", "timestamp")
    assert [c.dtype.str for c in vehicle.columns] == ["<f4", "<f4", "<f4", "|u1", "<f8"]
    assert pole.names == ("x", "y", "z", "intensity")
    assert [float(c[0]) for c in pole.columns] == [0, 0, 0, 0], "the stray point at the sensor"
    assert len(pole.columns[0]) == 401 and len(recording.snapshot("7", 0).frames[1].points) == 400
    for side, folder, kind in (("vehicle", "lidar", float), ("infrastructure", "virtuallidar", str)):
        (first, *_) = json.loads((tmp_path / f"{side}-side/label/{folder}/000123.json").read_text())
        assert isinstance(first["rotation"], kind) and isinstance(first["3d_location"]["x"], kind)
    (first, *_) = json.loads((tmp_path / "cooperative/label_world/000123.json").read_text())
    corners = np.array(first["world_8_points"])
    assert (corners[4:, 2] > corners[:4, 2]).all()
    assert abs(first["rotation"] - 3.0) > 0.1, "which is not the world's yaw"
    (pair,) = json.loads((tmp_path / "cooperative/data_info.json").read_text())
    assert pair["system_error_offset"] == {"delta_x": 0.4, "delta_y": -0.7}
    assert pair["infrastructure_pointcloud_path"] == "infrastructure-side/velodyne/000123.pcd"
    (row,) = json.loads((tmp_path / "infrastructure-side/data_info.json").read_text())
    assert (row["batch_id"], row["pointcloud_timestamp"], row["intersection_loc"]) == ("7", "200000", "somewhere")
    assert not list(tmp_path.rglob(".*")), "no temporary file stays"


def test_lidar_i2v_is_the_chain_of_the_others(tmp_path: Path) -> None:
    recording = written(tmp_path, drive())
    vehicle, pole = recording.lidar_poses(recording.pair("7", 0))
    stated = json.loads((tmp_path / "cooperative/calib/lidar_i2v/000123.json").read_text())
    chain = vehicle.inverse() @ pole
    torch.testing.assert_close(torch.tensor(stated["rotation"], dtype=torch.float64), chain.rotation)
    torch.testing.assert_close(torch.tensor(stated["translation"], dtype=torch.float64)[:, 0], chain.translation)


def test_the_same_bytes_every_time(tmp_path: Path) -> None:
    for name in ("a", "b"):
        written(tmp_path / name, drive())
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(files) == 14 - 1
    assert all((tmp_path / "a" / p).read_bytes() == (tmp_path / "b" / p).read_bytes() for p in files)


def test_no_vehicle_at_all(tmp_path: Path) -> None:
    snapshot = drive()
    assert snapshot.truth is not None
    nothing = replace(snapshot, truth=replace(snapshot.truth, seen=torch.zeros(2, 4, dtype=torch.bool)))
    truth = written(tmp_path, nothing).snapshot("7", 0).truth
    assert truth is not None and len(truth.boxes) == 0 and truth.seen.shape == (2, 0)


@pytest.mark.parametrize(
    ("change", "message_match"),
    [
        (lambda s: replace(s, truth=None), "1 frames of the kind vehicle and no truth"),
        (lambda s: replace(s, frames=s.frames[:1]), "0 frames of the kind infrastructure"),
        (lambda s: replace(s, frames=(s.frames[0], s.frames[0])), "2 frames of the kind vehicle"),
    ],
)
def test_content_beyond_the_format_is_rejected(tmp_path: Path, change, message_match: str) -> None:
    with pytest.raises(RecordingError, match=message_match):
        DairWriter(tmp_path, "7").write(change(drive()), 0)
    assert list(tmp_path.iterdir()) == []
