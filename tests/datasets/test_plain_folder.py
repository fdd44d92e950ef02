# SPDX-License-Identifier: Apache-2.0
"""Plain folders of clouds and tables, written by hand: poses without symmetry, three types of clouds, what is missing."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from manyeyes.datasets.base import count_points_in_listed_boxes
from manyeyes.datasets.formats.pcd import write_pcd
from manyeyes.datasets.plain_folder import FolderRecording
from manyeyes.datasets.registry import open_recording
from manyeyes.datatypes import LABELS, RecordingError

T0 = 1_700_000_000_000_000_123  # does not fit a float64
# x, y, z, roll, pitch, yaw of the LiDARs, 1.8, 2.0 and 5 m above a road at z = 0.3.
POSES = {
    3: (40.0, -7.0, 2.1, 0.02, -0.03, 0.5),
    4: (58.0, 6.0, 2.3, -0.01, 0.02, -2.4),
    -1: (50.0, -12.0, 5.3, 0.0, 0.01, 1.5),
}
HEIGHTS = {3: 1.8, 4: 2.0, -1: 5.0}
# id: label, middle, size, yaw, velocity.
THINGS = {
    50: ("car", (48.0, 1.0, 1.0), (4.4, 1.8, 1.4), 0.9, (2.0, 1.0)),
    51: ("Cyclist", (52.0, -4.0, 1.2), (1.8, 0.7, 1.7), -1.3, (0.0, 0.0)),
}


def rotation(roll: float, pitch: float, yaw: float) -> np.ndarray:
    cr, sr, cp, sp, cy, sy = (*(f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin)),)
    about_z, about_y = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]),
        np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]),
    )
    return about_z @ about_y @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])


def quaternion(matrix: np.ndarray) -> list[float]:
    """w, x, y, z, by the trace, which is far from -1 here or made so by the largest component."""
    w = math.sqrt(max(0.0, 1 + np.trace(matrix))) / 2
    x = math.copysign(
        math.sqrt(max(0.0, 1 + matrix[0, 0] - matrix[1, 1] - matrix[2, 2])) / 2, matrix[2, 1] - matrix[1, 2]
    )
    y = math.copysign(
        math.sqrt(max(0.0, 1 - matrix[0, 0] + matrix[1, 1] - matrix[2, 2])) / 2, matrix[0, 2] - matrix[2, 0]
    )
    z = math.copysign(
        math.sqrt(max(0.0, 1 - matrix[0, 0] - matrix[1, 1] + matrix[2, 2])) / 2, matrix[1, 0] - matrix[0, 1]
    )
    return [w, x, y, z]


def scan(agent: int) -> np.ndarray:
    """(N, 3) in the LiDAR's frame: 40 points in the front left quarter of each thing, then the road."""
    rng, parts = np.random.default_rng(2), []
    for _, center, size, yaw, _ in THINGS.values():
        local = rng.uniform(0.5, 0.95, (40, 3)) * np.array(size) / 2
        c, s = math.cos(yaw), math.sin(yaw)
        parts.append(
            np.stack((local[:, 0] * c - local[:, 1] * s, local[:, 0] * s + local[:, 1] * c, local[:, 2]), 1) + center
        )
    road = np.concatenate((rng.uniform(-20, 20, (600, 2)) + POSES[agent][:2], np.full((600, 1), 0.3)), 1)
    road = road[np.min([np.hypot(*(road - thing[1])[:, :2].T) for thing in THINGS.values()], 0) > 4]
    world = np.concatenate((*parts, road))
    return ((world - POSES[agent][:3]) @ rotation(*POSES[agent][3:])).astype(np.float32)


def write_cloud(path: Path, xyz: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    gray = np.full(len(xyz), 0.2, np.float32)
    if path.suffix == ".bin":
        path.write_bytes(np.concatenate((xyz, 255 * gray[:, None]), 1).astype("<f4").tobytes())
    elif path.suffix == ".pcd":
        write_pcd(path, xyz, gray)
    else:
        np.savez(path, points=xyz, intensity=gray)


def write_agent(folder: Path, agent: int, times: tuple[int, ...], suffix: str = ".bin", angles: bool = False) -> None:
    """Write one agent that stands still; angles: roll, pitch and yaw instead of a quaternion."""
    for time in times:
        write_cloud(folder / "clouds" / f"{time}{suffix}", scan(agent))
    place, turn = POSES[agent][:3], list(POSES[agent][3:]) if angles else quaternion(rotation(*POSES[agent][3:]))
    head = "timestamp_ns,x,y,z," + ("roll,pitch,yaw" if angles else "qw,qx,qy,qz") + ",sensor_height_m,speed_mps"
    rows = [",".join(map(repr, (time, *place, *turn, HEIGHTS[agent], 3.5))) for time in times]
    (folder / "poses.csv").write_text("\n".join([head, *rows]) + "\n")
    lines = ["timestamp_ns,id,label,x,y,z,length,width,height,yaw,vx,vy"]
    for time in times:
        for id, (label, center, size, yaw, velocity) in THINGS.items():
            lines.append(",".join(map(str, (time, id, label, *center, *size, yaw, *velocity))))
        lines.append(f"{time},{agent},car,{place[0]},{place[1]},1,4,2,1.5,0,0,0")
        lines.append(f"{time},60,traffic cone,50,0,0.5,0.3,0.3,0.6,0,0,0")
    (folder / "boxes.csv").write_text("\n".join(lines) + "\n")


def write_scenario(folder: Path) -> Path:
    write_agent(folder / "3", 3, (T0, T0 + 100_000_000))
    write_agent(folder / "4", 4, (T0 + 30_000_000,), ".npz", angles=True)
    write_agent(folder / "-1", -1, (T0 + 110_000_000, T0 - 40_000_000), ".pcd")
    return folder


def test_agents_are_read_with_their_poses_boxes_and_intensities(tmp_path: Path) -> None:
    write_scenario(tmp_path / "val" / "drive")
    recording = open_recording(tmp_path, "val")
    assert isinstance(recording, FolderRecording) and recording.scenarios == ("drive",)
    assert recording.agents("drive") == (3, 4, -1) and recording.length("drive") == 2
    snapshot = recording.snapshot("drive", 0)
    assert [frame.agent_id for frame in snapshot.frames] == [3, 4, -1]
    assert [frame.timestamp_ns - T0 for frame in snapshot.frames] == [0, 30_000_000, -40_000_000]
    assert [frame.is_infrastructure for frame in snapshot.frames] == [False, False, True]
    truth = snapshot.truth
    assert truth is not None
    counts = count_points_in_listed_boxes(snapshot, 0.01)
    things = torch.isin(truth.boxes.id, torch.tensor([50, 51]))
    assert counts[:, things].tolist() == [[40, 40]] * 3 and bool(truth.seen[:, things].all())
    rows = truth.boxes[things]
    assert [LABELS[label] for label in rows.label] == ["car", "cyclist"]
    assert rows.center.tolist() == [list(thing[1]) for thing in THINGS.values()]
    assert rows.size.tolist() == [list(thing[2]) for thing in THINGS.values()]
    assert rows.yaw.tolist() == [0.9, -1.3] and rows.velocity.tolist() == [[2, 1], [0, 0]]
    for frame in snapshot.frames:
        assert frame.points.intensity.unique().tolist() == pytest.approx([0.2])
        assert frame.sensor_height_m == HEIGHTS[frame.agent_id] and frame.speed_mps == 3.5
        world = frame.world_from_agent.apply(frame.points.xyz.double())
        assert world[80:, 2].sub(0.3).abs().max() < 1e-4
        lidar = frame.world_from_agent.apply(torch.tensor([[0.0, 0.0, frame.sensor_height_m]]).double())[0]
        assert lidar.tolist() == pytest.approx(POSES[frame.agent_id][:3])


def test_an_agents_own_body_is_not_its_truth_and_other_objects_are_left_out(tmp_path: Path) -> None:
    truth = open_recording(write_scenario(tmp_path / "drive")).snapshot("drive", 0).truth
    assert truth is not None and set(truth.boxes.id.tolist()) == {50, 51}


def test_an_agent_without_a_sweep_in_time_is_absent(tmp_path: Path) -> None:
    second = open_recording(write_scenario(tmp_path / "drive")).snapshot("drive", 1)
    assert [frame.agent_id for frame in second.frames] == [3, -1]


def test_one_agent_alone_lies_in_the_folder_itself(tmp_path: Path) -> None:
    write_agent(tmp_path / "walk", 3, (T0,), angles=True)
    recording = open_recording(tmp_path / "walk")
    assert recording.scenarios == ("walk",) and recording.agents("walk") == (0,)
    (tmp_path / "walk" / "boxes.csv").unlink()
    assert open_recording(tmp_path).snapshot("walk", 0).truth is None


def test_the_height_is_found_in_the_cloud_where_no_column_states_it(tmp_path: Path) -> None:
    write_agent(tmp_path / "walk", 3, (T0,))
    path = tmp_path / "walk" / "poses.csv"
    path.write_text("\n".join(",".join(line.split(",")[:-2]) for line in path.read_text().splitlines()))
    assert open_recording(tmp_path).snapshot("walk", 0).frames[0].sensor_height_m == pytest.approx(1.8, abs=0.8)


def test_the_body_of_the_vehicle_is_in_the_frame(tmp_path: Path) -> None:
    write_agent(tmp_path / "walk", 3, (T0,))
    path = tmp_path / "walk" / "poses.csv"
    head, row = path.read_text().splitlines()
    path.write_text(f"{head},body_x,body_y,body_length,body_width,body_height\n{row},0.4,-0.1,4.6,1.9,1.5\n")
    body = open_recording(tmp_path).snapshot("walk", 0).frames[0].body
    assert body is not None and (body.center, body.size) == ((0.4, -0.1, 0.75), (4.6, 1.9, 1.5))
    path.write_text(f"{head},body_x,body_y,body_length,body_width,body_height\n{row},0.4,-0.1,-4.6,1.9,1.5\n")
    with pytest.raises(RecordingError, match="body_x to body_height is no body"):
        open_recording(tmp_path)


def test_clouds_may_have_names_of_their_own(tmp_path: Path) -> None:
    write_agent(tmp_path / "walk", 3, (T0,))
    (tmp_path / "walk" / "clouds" / f"{T0}.bin").rename(tmp_path / "walk" / "clouds" / "000000.bin")
    path = tmp_path / "walk" / "poses.csv"
    head, row = path.read_text().splitlines()
    path.write_text(f"{head},cloud\n{row},clouds/000000.bin\n")
    assert len(open_recording(tmp_path).snapshot("walk", 0).frames[0].points) == len(scan(3))
    path.write_text(f"{head},cloud\n{row},../../secret.bin\n")
    with pytest.raises(RecordingError, match="no file in the agent's folder"):
        open_recording(tmp_path)


def test_a_missing_cloud_is_named_and_its_row_left_out(tmp_path: Path) -> None:
    gone = write_scenario(tmp_path / "drive") / "3" / "clouds" / f"{T0}.bin"
    gone.unlink()
    recording = open_recording(tmp_path)
    assert recording.length("drive") == 1 and [p.path for p in recording.missing_files] == [gone]
    assert "1 of 2 clouds" in recording.missing_summary[0]


@pytest.mark.parametrize(
    ("file", "old", "new", "text"),
    [
        ("poses.csv", "timestamp_ns", "time", "columns timestamp_ns"),
        ("poses.csv", "qw", "w", "qw, qx, qy, qz or roll, pitch, yaw"),
        ("poses.csv", str(T0), "1.5e9", "whole number at 'timestamp_ns' in row 2"),
        ("poses.csv", "40.0", "nan", "finite number at 'x' in row 2"),
        ("poses.csv", "40.0,", "", "values in row 2"),
        ("poses.csv", "0.968", "3.968", "length"),
        ("boxes.csv", "4.4", "-4.4", "size of 0 or below"),
        ("boxes.csv", "label", "class", "columns label"),
    ],
)
def test_a_table_that_cannot_be_used_is_named_with_its_column_and_row(
    tmp_path: Path, file: str, old: str, new: str, text: str
) -> None:
    write_agent(tmp_path / "walk", 3, (T0,))
    path = tmp_path / "walk" / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(RecordingError, match=text) as caught:
        open_recording(tmp_path)
    assert str(path) in str(caught.value)


def test_two_rows_of_one_time_and_agents_without_a_number_are_refused(tmp_path: Path) -> None:
    write_scenario(tmp_path / "drive")
    path = tmp_path / "drive" / "3" / "poses.csv"
    path.write_text(path.read_text() + path.read_text().splitlines()[1] + "\n")
    with pytest.raises(RecordingError, match=f"two rows of the time {T0}"):
        open_recording(tmp_path)
    (tmp_path / "drive" / "3").rename(tmp_path / "drive" / "ego")
    with pytest.raises(RecordingError, match="named by a number"):
        open_recording(tmp_path)
