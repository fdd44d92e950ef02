# SPDX-License-Identifier: Apache-2.0
"""DAIR-V2X's layout: a scene made by hand in the format's own terms, and what users' downloads lack."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from manyeyes.datasets.base import count_points_in_listed_boxes, iter_eval_frames
from manyeyes.datasets.dair_v2x import DairOptions, DairRecording, json_files, reader
from manyeyes.datasets.formats.pcd import PcdCloud, PcdTable, write_table
from manyeyes.datatypes import LABELS, ConfigError, RecordingError, Transform


def rotation(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """(3, 3), Rz(yaw) Ry(pitch) Rx(roll)."""
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    return about_z @ about_y @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])


# Nothing here is symmetric, so no sign can hide. The road is at z = 20.
ROAD_Z = 20.0
NOVATEL = rotation(2.1, 0.011, -0.008), np.array([2688.5, 1687.9, 21.4])
LIDAR_IN_NOVATEL = rotation(-1.5, -0.01, 0.006), np.array([0.3, 1.1, 0.5])
LIDAR = NOVATEL[0] @ LIDAR_IN_NOVATEL[0], NOVATEL[0] @ LIDAR_IN_NOVATEL[1] + NOVATEL[1]
POLE = rotation(-2.6), np.array([2712.0, 1702.0, 25.5])
OFFSET = (0.35, -0.6)
# name: type, middle on the road (x, y), yaw, size. "own" is the ego's body.
VEHICLES = {
    "own": ("Car", (2687.2, 1688.6), 0.58, (4.6, 1.9, 1.6)),
    "a": ("Car", (2700.0, 1690.0), 0.9, (4.2, 1.8, 1.5)),
    "b": ("truck", (2694.0, 1703.0), -1.2, (8.2, 2.5, 3.2)),
    "c": ("Van", (2703.0, 1698.0), 2.8, (5.4, 2.0, 2.2)),
    "d": ("Bus", (2680.0, 1694.0), 0.2, (11.0, 2.5, 3.1)),
}
VEHICLE_LISTS, POLE_LISTS = ("a", "b", "d"), ("own", "b", "c")
STAMPS = {"vehicle": 1626247179628753, "infrastructure": 1626247179611004}


def corners(name: str) -> np.ndarray:
    """(8, 3) in the world: front left, front right, rear right, rear left, bottom then top."""
    _, (x, y), yaw, (length, width, height) = VEHICLES[name]
    flat = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (length / 2, width / 2)
    flat = flat @ rotation(yaw)[:2, :2].T + (x, y)
    return np.concatenate([np.column_stack((flat, np.full(4, z))) for z in (ROAD_Z, ROAD_Z + height)])


def points_on(name: str) -> np.ndarray:
    """(60, 3) in the world, in the front left upper part of the vehicle: a mirrored or turned box misses them."""
    _, (x, y), yaw, size = VEHICLES[name]
    local = np.random.default_rng(len(name) + ord(name[0])).uniform(0.3, 0.95, (60, 3)) * np.asarray(size) / 2
    return local @ rotation(yaw).T + (x, y, ROAD_Z + size[2] / 2)


def into(pose: tuple[np.ndarray, np.ndarray], world: np.ndarray) -> np.ndarray:
    return (world - pose[1]) @ pose[0]


def world_cloud(lists: tuple[str, ...], seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    road = np.column_stack((rng.uniform(2660, 2730, 6000), rng.uniform(1665, 1730, 6000), np.full(6000, ROAD_Z)))
    apart = [np.hypot(*(road[:, :2] - VEHICLES[n][1]).T) > 7 for n in VEHICLES]
    return np.concatenate([points_on(n) for n in lists] + [road[np.logical_and.reduce(apart)]])


def side_label(name: str, pose: tuple[np.ndarray, np.ndarray]) -> dict[str, Any]:
    kind, (x, y), yaw, (length, width, height) = VEHICLES[name]
    middle = into(pose, np.array([[x, y, ROAD_Z + height / 2]]))[0]
    ahead = np.array([math.cos(yaw), math.sin(yaw), 0.0]) @ pose[0]
    return {
        "type": kind,
        "truncated_state": 0,
        "occluded_state": 1,
        "alpha": 0.1,
        "2d_box": {"xmin": 1.0, "ymin": 2.0, "xmax": 3.0, "ymax": 4.0},
        "3d_dimensions": {"h": height, "w": width, "l": length},
        "3d_location": dict(zip("xyz", middle.tolist())),
        "rotation": math.atan2(ahead[1], ahead[0]),
    }


def as_text(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: as_text(v) for k, v in value.items()}
    return str(value) if isinstance(value, (int, float)) else value


def dump(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def edit(path: Path, change: Callable[[Any], Any]) -> None:
    content = json.loads(path.read_text())
    changed = change(content)
    path.write_text(json.dumps(content if changed is None else changed))


def motion(pose: tuple[np.ndarray, np.ndarray]) -> dict[str, Any]:
    return {"rotation": pose[0].tolist(), "translation": [[v] for v in pose[1].tolist()]}


def write_root(root: Path) -> Path:
    """Two drives: batch 12 with frames 000010 and 000011 (the pole's: 000020, 000021), batch 3 with 000015 (000025)."""
    vehicle, pole, both = root / "vehicle-side", root / "infrastructure-side", root / "cooperative"
    rows: tuple[list, list, list] = ([], [], [])
    cone = {**side_label("a", LIDAR), "type": "Trafficcone"}
    flat = {**side_label("a", LIDAR), "3d_dimensions": {"h": 0, "w": 0, "l": 0}}
    # By hand the pole was moved by OFFSET: its calibration is off by as much.
    stated = POLE[0], POLE[1] - (*OFFSET, 0)
    for number, (car, unit, batch, late) in enumerate(
        (("11", "21", "12", 1), ("10", "20", "12", 0), ("15", "25", "3", 9))
    ):
        v, i = f"0000{car}", f"0000{unit}"
        stamps = {side: stamp + late * 100_000 for side, stamp in STAMPS.items()}
        for folder in (vehicle / "velodyne", pole / "velodyne"):
            folder.mkdir(parents=True, exist_ok=True)
        xyz = into(LIDAR, world_cloud(VEHICLE_LISTS, number)).astype(np.float32)
        level = (np.arange(len(xyz)) % 254 + 1).astype(np.uint8)
        seconds = stamps["vehicle"] * 1e-6 - np.linspace(0.1, 0, len(xyz))
        fields = ("x", "y", "z", "intensity", "timestamp")
        write_table(vehicle / "velodyne" / f"{v}.pcd", PcdTable(fields, (*xyz.T, level, seconds)))
        xyz = np.concatenate((np.zeros((1, 3)), into(POLE, world_cloud(POLE_LISTS, number)))).astype(np.float32)
        bright = (np.arange(len(xyz)) % 200 / 255).astype(np.float32)
        write_table(pole / "velodyne" / f"{i}.pcd", PcdTable(fields[:4], (*xyz.T, bright)))
        dump(vehicle / "calib/novatel_to_world" / f"{v}.json", motion(NOVATEL))
        dump(vehicle / "calib/lidar_to_novatel" / f"{v}.json", {"transform": motion(LIDAR_IN_NOVATEL)})
        blank = {"relative_error": {"delta_x": "", "delta_y": ""}}
        dump(pole / "calib/virtuallidar_to_world" / f"{i}.json", {**motion(stated), **blank})
        dump(vehicle / "label/lidar" / f"{v}.json", [cone, flat, *(side_label(n, LIDAR) for n in VEHICLE_LISTS)])
        dump(pole / "label/virtuallidar" / f"{i}.json", [as_text(side_label(n, POLE)) for n in POLE_LISTS])
        # Only type and corners are valid here.
        wrong = {
            "rotation": 0.019,
            "3d_dimensions": {"h": 1.0, "w": 1.0, "l": 1.0},
            "3d_location": {"x": 0, "y": 0, "z": 0},
        }
        labels = [{"type": VEHICLES[n][0], **wrong, "world_8_points": corners(n).tolist()} for n in VEHICLES]
        dump(both / "label_world" / f"{v}.json", labels)
        common = {"image_path": "image/none.jpg", "batch_id": batch}
        rows[0].append({**common, "pointcloud_path": f"velodyne/{v}.pcd", "pointcloud_timestamp": str(stamps["vehicle"]),
                        "label_lidar_std_path": f"label/lidar/{v}.json",
                        "calib_novatel_to_world_path": f"calib/novatel_to_world/{v}.json",
                        "calib_lidar_to_novatel_path": f"calib/lidar_to_novatel/{v}.json"})  # fmt: skip
        rows[1].append({**common, "pointcloud_path": f"velodyne/{i}.pcd",
                        "pointcloud_timestamp": str(stamps["infrastructure"]),
                        "label_lidar_std_path": f"label/virtuallidar/{i}.json",
                        "calib_virtuallidar_to_world_path": f"calib/virtuallidar_to_world/{i}.json"})  # fmt: skip
        rows[2].append({"vehicle_pointcloud_path": f"vehicle-side/velodyne/{v}.pcd",
                        "infrastructure_pointcloud_path": f"infrastructure-side/velodyne/{i}.pcd",
                        "vehicle_image_path": "vehicle-side/image/none.jpg",
                        "cooperative_label_path": f"cooperative/label_world/{v}.json",
                        "system_error_offset": {"delta_x": OFFSET[0], "delta_y": OFFSET[1]}})  # fmt: skip
    for folder, content in zip((vehicle, pole, both), rows):
        dump(folder / "data_info.json", content)
    dump(
        root / "cooperative-split-data.json", {"cooperative_split": {"train": ["000010", "000011"], "val": ["000015"]}}
    )
    return root


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Never written to by a test."""
    return write_root(tmp_path_factory.mktemp("dair"))


@pytest.fixture
def root(tmp_path: Path, dataset: Path) -> Path:
    """A root of the test's own."""
    return shutil.copytree(dataset, tmp_path / "own")


def faults(recording: DairRecording) -> list[str]:
    """What of the hand-made scene does not come out as it was put in."""
    snapshot = recording.snapshot("12", 0)
    truth = snapshot.truth
    assert truth is not None
    wanted = torch.from_numpy(np.stack([corners(n) for n in VEHICLES]))
    sides = recording.side_boxes("12", 0)
    lists = [[list(VEHICLES).index(n) for n in names] for names in (VEHICLE_LISTS, POLE_LISTS)]
    found = {
        "corners": bool(torch.allclose(truth.boxes.corners(), wanted, atol=1e-6, rtol=0)),
        "places": all(
            torch.allclose(
                f.world_from_agent.apply(f.points.xyz.double())[:60], torch.from_numpy(points_on(n)), atol=0.01
            )
            for f, n in zip(snapshot.frames, ("a", "own"))
        ),
        "points in boxes": count_points_in_listed_boxes(snapshot).max(1).values.tolist() == [60, 60],
        "sides": all(torch.allclose(b.corners(), wanted[rows], atol=0.1, rtol=0) for b, rows in zip(sides, lists)),
        "seen": truth.seen.tolist() == [[i in rows for i in range(5)] for rows in lists],
    }
    return [name for name, good in found.items() if not good]


def test_a_scene_round_trips(dataset: Path) -> None:
    recording = DairRecording(dataset)
    assert recording.missing_summary == ()
    assert faults(recording) == []
    assert recording.scenarios == ("3", "12")
    assert [recording.length(s) for s in recording.scenarios] == [1, 2]
    assert list(iter_eval_frames(recording)) == [("3", 0), ("12", 0), ("12", 1)]
    assert recording.agents("12") == (0, -1)
    truth = recording.snapshot("12", 0).truth
    assert truth is not None
    assert truth.boxes.label.tolist() == [0, 0, 2, 1, 3]
    assert truth.boxes.id.tolist() == [0, 2, 3, 4, 5], "the ego's own body has its id"


def transposed(monkeypatch: pytest.MonkeyPatch) -> None:
    true = json_files._motion

    def wrong(path: Path, content: Any) -> Transform:
        found = true(path, content)
        return Transform(found.rotation.mT, found.translation)

    monkeypatch.setattr(json_files, "_motion", wrong)


def mirrored(monkeypatch: pytest.MonkeyPatch) -> None:
    true = reader.read_pcd

    def wrong(path: Path, drop_nan: bool = False) -> PcdCloud:
        found = true(path, drop_nan)
        return PcdCloud(found.xyz * np.float32([1, -1, 1]), found.intensity, found.time_s)

    monkeypatch.setattr(reader, "read_pcd", wrong)


def without_correction(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        DairRecording, "lidar_poses", lambda self, p: (self._vehicle_pose(p.vehicle), self._uncorrected(p))
    )


def turned_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    true = reader.read_side_labels

    def wrong(path: Path) -> Any:
        found = true(path)
        return type(found).of(found.center, found.size, -found.yaw, label=found.label, id=found.id)

    monkeypatch.setattr(reader, "read_side_labels", wrong)


def labels_by_rotation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "read_world_labels", reader.read_side_labels)


@pytest.mark.parametrize(
    ("break_it", "shows"),
    [
        (transposed, "places"),
        (mirrored, "places"),
        (without_correction, "places"),
        (turned_labels, "sides"),
        (labels_by_rotation, "corners"),
    ],
)
def test_a_wrong_reader_shows(
    dataset: Path, monkeypatch: pytest.MonkeyPatch, break_it: Callable[[pytest.MonkeyPatch], None], shows: str
) -> None:
    break_it(monkeypatch)
    assert shows in faults(DairRecording(dataset))


def test_clouds_times_and_heights(dataset: Path) -> None:
    recording = DairRecording(dataset)
    vehicle, pole = recording.snapshot("12", 0).frames
    assert (vehicle.timestamp_ns, pole.timestamp_ns) == (STAMPS["vehicle"] * 1000, STAMPS["infrastructure"] * 1000)
    assert vehicle.sensor_height_m == pytest.approx(LIDAR[1][2] - ROAD_Z, abs=0.25)
    assert pole.sensor_height_m == pytest.approx(POLE[1][2] - ROAD_Z, abs=0.05)
    assert not vehicle.is_infrastructure and pole.is_infrastructure
    assert (pole.points.xyz[:, :2] != 0).any(1).all(), "the stray point at the sensor is no return"
    # Two scales: 1 … 254 of 255 in the one file, 0 … 1 in the other; the stray point took the first of these.
    torch.testing.assert_close(vehicle.points.intensity[:3], torch.tensor([1.0, 2.0, 3.0]) / 255)
    torch.testing.assert_close(pole.points.intensity[:3], torch.tensor([1.0, 2.0, 3.0]) / 255)
    assert float(vehicle.points.time_s[0]) == pytest.approx(-0.1, abs=1e-5)
    assert float(vehicle.points.time_s[-1]) == pytest.approx(0.0, abs=1e-5)
    assert not pole.points.time_s.any()


def test_a_stated_height_takes_precedence_over_the_ground(root: Path) -> None:
    edit(
        root / "vehicle-side/data_info.json", lambda rows: [row.update(lidar_height_m="2.25") for row in rows] and None
    )
    frame = DairRecording(root).snapshot("12", 0).frames[0]
    assert frame.sensor_height_m == 2.25
    road = frame.world_from_agent.translation - torch.from_numpy(LIDAR[1])
    torch.testing.assert_close(road, torch.from_numpy(-2.25 * LIDAR[0][:, 2]))


def test_speed_is_that_of_the_poses(root: Path) -> None:
    path = root / "vehicle-side/calib/novatel_to_world/000011.json"
    edit(path, lambda c: c.update(translation=[2688.5 + 0.6, 1687.9 + 0.8, 21.4]))
    recording = DairRecording(root)
    assert recording.snapshot("12", 0).frames[0].speed_mps == 0.0
    assert recording.snapshot("12", 1).frames[0].speed_mps == pytest.approx(10.0, abs=1e-3)


def test_splits_are_those_of_the_users_file(dataset: Path, tmp_path: Path) -> None:
    assert DairRecording(dataset, "train").scenarios == ("12",)
    assert DairRecording(dataset, "val").scenarios == ("3",)
    bare = tmp_path / "bare.json"
    bare.write_text('["000011", "000099"]')
    recording = DairRecording(dataset, "mine", DairOptions(split_file=bare))
    assert recording.length("12") == 1
    assert "1 of the split's 2 frames are not in it, the first is 000099" in recording.missing_summary[0]
    with pytest.raises(RecordingError, match=r"no split 'test'; it has train, val: choose"):
        DairRecording(dataset, "test")
    with pytest.raises(
        RecordingError, match=r"official cooperative-split-data.json there \(pairs: train 4813, val 1783"
    ):
        DairRecording(dataset, "mine", DairOptions(split_file=tmp_path / "none.json"))


def test_the_official_archives_folder_is_found(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "cooperative-vehicle-infrastructure").symlink_to(dataset)
    assert DairRecording(tmp_path, "val").scenarios == ("3",)


def test_an_older_sweep_of_the_pole(dataset: Path) -> None:
    recording = DairRecording(dataset, options=DairOptions(delay_frames=1))
    assert recording.scenarios == ("12",)
    vehicle, pole = recording.snapshot("12", 0).frames
    assert vehicle.timestamp_ns - pole.timestamp_ns == (100_000 + 17_749) * 1000
    assert "2 of 3 pairs lack an infrastructure sweep 1 earlier" in recording.missing_summary[0]


def test_the_reported_roadside_pose_lacks_the_correction(dataset: Path) -> None:
    snapshot = DairRecording(dataset, options=DairOptions(native_pose_error=True)).snapshot("12", 0)
    assert snapshot.truth is not None
    gap = snapshot.truth.world_from_agent.translation[1] - snapshot.frames[1].world_from_agent.translation
    torch.testing.assert_close(gap, torch.tensor([*OFFSET, 0.0], dtype=torch.float64))
    assert torch.equal(snapshot.truth.world_from_agent.translation[0], snapshot.frames[0].world_from_agent.translation)


@pytest.mark.parametrize("offset", ["", {"delta_x": "", "delta_y": ""}, None])
def test_a_blank_offset_is_none(root: Path, offset: object) -> None:
    edit(
        root / "cooperative/data_info.json",
        lambda rows: [row.update(system_error_offset=offset) for row in rows] and None,
    )
    recording = DairRecording(root)
    place = recording.lidar_poses(recording.pair("12", 0))[1].translation
    torch.testing.assert_close(place, torch.from_numpy(POLE[1] - (*OFFSET, 0)))


def test_an_offset_in_text_counts_and_relative_error_stands_in(root: Path) -> None:
    calibration = root / "infrastructure-side/calib/virtuallidar_to_world/000020.json"
    edit(calibration, lambda c: c.update(relative_error={"delta_x": "0.1", "delta_y": 0.2}))
    recording = DairRecording(root)
    assert "places" not in faults(recording), "what the pair states goes before relative_error"
    edit(root / "cooperative/data_info.json", lambda rows: rows[1].update(system_error_offset=""))
    recording = DairRecording(root)
    place = recording.lidar_poses(recording.pair("12", 0))[1].translation
    torch.testing.assert_close(place, torch.from_numpy(POLE[1] - (*OFFSET, 0) + (0.1, 0.2, 0)))
    offset = {"delta_x": str(OFFSET[0]), "delta_y": str(OFFSET[1])}
    edit(root / "cooperative/data_info.json", lambda rows: rows[1].update(system_error_offset=offset))
    assert faults(DairRecording(root)) == []


def test_lidar_i2v_replaces_a_missing_calibration(root: Path) -> None:
    turn = LIDAR[0].T @ POLE[0]
    i2v = turn, LIDAR[0].T @ (POLE[1] - LIDAR[1])
    dump(root / "cooperative/calib/lidar_i2v/000010.json", motion(i2v))
    shutil.rmtree(root / "infrastructure-side/calib")
    recording = DairRecording(root)
    assert faults(recording) == []
    assert recording.scenarios == ("12",), "the others have neither"


def test_labels_of_the_sides_as_truth(dataset: Path) -> None:
    truth = DairRecording(dataset, options=DairOptions(labels="sides")).snapshot("12", 0).truth
    assert truth is not None
    assert truth.boxes.label.tolist() == [0, 2, 3, 0, 1], (
        "each vehicle once: a, b, d by the vehicle, own and c by the pole"
    )
    assert truth.seen.tolist() == [[True, True, True, False, False], [False, True, False, True, True]]
    assert truth.boxes.id.tolist() == [1, 2, 3, 0, 5]


def test_another_release_of_the_labels(root: Path) -> None:
    shutil.copytree(root / "cooperative/label_world", root / "cooperative/label_world_backup")
    edit(root / "cooperative/label_world_backup/000010.json", lambda rows: rows[:2])
    truth = DairRecording(root, options=DairOptions(label_folder="label_world_backup")).snapshot("12", 0).truth
    assert truth is not None
    assert len(truth.boxes) == 2


def test_v2x_seq_names_frames_and_corrects_in_the_vehicles_frame(root: Path) -> None:
    shift = LIDAR[0].T @ (*OFFSET, 0)

    def pairs(rows: list) -> list:
        named = [
            (Path(r["vehicle_pointcloud_path"]).stem, Path(r["infrastructure_pointcloud_path"]).stem) for r in rows
        ]
        delta = {"delta_x": shift[0], "delta_y": shift[1]}
        return [{"vehicle_frame": v, "infrastructure_frame": i, "vehicle_sequence": "7", "infrastructure_sequence": "7",
                 "system_error_offset": delta} for v, i in named]  # fmt: skip

    edit(root / "cooperative/data_info.json", pairs)
    for side in ("vehicle-side", "infrastructure-side"):
        edit(root / side / "data_info.json", lambda rows: [{**r, "sequence_id": r.pop("batch_id")} for r in rows])
    for frame in ("000010", "000011", "000015"):
        labels = [{**side_label(n, LIDAR), "track_id": f"00{t}"} for t, n in enumerate(VEHICLES)]
        dump(root / f"cooperative/label/{frame}.json", labels)
    recording = DairRecording(root)
    truth = recording.snapshot("12", 0).truth
    assert truth is not None
    assert truth.boxes.id.tolist() == [0, 2, 3, 4, 5]
    wanted = torch.from_numpy(np.stack([corners(n) for n in VEHICLES]))
    torch.testing.assert_close(truth.boxes.corners(), wanted, atol=0.1, rtol=0)
    place = recording.lidar_poses(recording.pair("12", 0))[1].translation
    # The correction is level in the vehicle's LiDAR frame, which is tilted by a hundredth.
    torch.testing.assert_close(place, torch.from_numpy(POLE[1]), atol=0.02, rtol=0)


def test_people_are_kept_behind_the_vehicles_whose_ids_they_do_not_change(root: Path) -> None:
    """V2X-Seq's ten types: four of vehicles, four of people, and two that are neither."""
    before = DairRecording(root).snapshot("12", 0).truth
    people = ("Pedestrian", "Cyclist", "Tricyclist", "Motorcyclist", "Barrowlist", "TrafficCone")
    spots = {f"p{n}": (kind, (2690.0 + 3 * n, 1700.0), 0.4 * n, (1.8, 0.7, 1.6)) for n, kind in enumerate(people)}
    VEHICLES.update(spots)
    try:
        path = root / "vehicle-side/label/lidar/000010.json"
        edit(path, lambda rows: [*(side_label(n, LIDAR) for n in spots), *rows])
    finally:
        for name in spots:
            del VEHICLES[name]
    boxes = json_files.read_side_labels(path)
    names = [LABELS[label] for label in boxes.label.tolist()]
    assert names[-4:] == ["pedestrian", "cyclist", "cyclist", "motorcyclist"]
    assert set(names[:-4]) <= {"car", "van", "truck", "bus"} and boxes.id.tolist()[:-4] == list(
        range(1, len(names) - 3)
    )
    assert len(set(boxes.id.tolist())) == len(boxes) and len(boxes.of_classes()) == len(names) - 4
    after = DairRecording(root).snapshot("12", 0).truth
    assert before is not None and after is not None and torch.equal(before.boxes.center, after.boxes.center)
    sides = DairRecording(root, options=DairOptions(labels="sides")).snapshot("12", 0).truth
    assert sides is not None and len(sides.of_classes(("pedestrian", "cyclist")).boxes) == 4


def test_a_partial_download_is_usable_and_reports_what_is_missing(root: Path) -> None:
    (root / "vehicle-side/velodyne/000011.pcd").unlink()
    (root / "cooperative/label_world/000015.json").unlink()
    recording = DairRecording(root)
    assert [recording.length(s) for s in ("3", "12")] == [1, 1]
    lost, unlabelled = recording.missing_summary
    assert "1 of 3 pairs lack their vehicle-side/velodyne file, the first is" in lost and "000011.pcd; left out" in lost
    assert "1 of 3 pairs lack their cooperative label and have no truth" in unlabelled
    assert recording.snapshot("3", 0).truth is None
    with pytest.raises(RecordingError, match=r"expected whole pairs of sweeps; .*000011.pcd; left out and 1 more"):
        DairRecording(root, strict=True)


def test_an_index_that_names_strange_frames(root: Path) -> None:
    edit(root / "infrastructure-side/data_info.json", lambda rows: rows[1:])
    recording = DairRecording(root)
    assert recording.length("12") == 1
    assert "infrastructure-side/data_info.json has no frame 000021; left out" in recording.missing_summary[0]


def test_nothing_usable_is_an_error(root: Path, tmp_path: Path) -> None:
    with pytest.raises(
        RecordingError, match="expected a folder with vehicle-side and infrastructure-side; check the path"
    ):
        DairRecording(tmp_path / "nowhere")
    shutil.rmtree(root / "infrastructure-side/velodyne")
    with pytest.raises(RecordingError, match="3 of 3 pairs lack their infrastructure-side/velodyne file"):
        DairRecording(root)
    (root / "cooperative/data_info.json").unlink()
    with pytest.raises(RecordingError, match=r"missing: cooperative/data_info.json. Download what is missing"):
        DairRecording(root)
    with pytest.raises(ConfigError, match="labels 'cooperative' or 'sides' and delay_frames >= 0"):
        DairRecording(root, options=DairOptions(delay_frames=-1))


def set_in(*keys: Any, to: Any) -> Callable[[Any], None]:
    def change(content: Any) -> None:
        for key in keys[:-1]:
            content = content[key]
        content[keys[-1]] = to

    return change


def without(*keys: Any) -> Callable[[Any], None]:
    def change(content: Any) -> None:
        for key in keys[:-1]:
            content = content[key]
        del content[keys[-1]]

    return change


UNIT_LABEL = "infrastructure-side/label/virtuallidar/000020.json"
NOVATEL_FILE = "vehicle-side/calib/novatel_to_world/000010.json"
WORLD_LABEL = "cooperative/label_world/000010.json"


@pytest.mark.parametrize(
    ("file", "change", "message_match"),
    [
        (UNIT_LABEL, set_in(1, "rotation", to="north"), r"expected a number at '\[1\].rotation', found 'north'"),
        (UNIT_LABEL, set_in(0, "3d_location", "y", to="nan"), r"expected a number at '\[0\].3d_location.y', found 'nan'"),
        (UNIT_LABEL, without(2, "3d_dimensions"), r"expected the key '\[2\].3d_dimensions', found none"),
        (UNIT_LABEL, without(2, "3d_dimensions", "w"), r"expected the key '\[2\].3d_dimensions.w', found none"),
        (UNIT_LABEL, set_in(0, "type", to=7), r"expected a text at '\[0\].type', found 7"),
        (UNIT_LABEL, set_in(0, "track_id", to="-3"), r"expected a whole number >= 0 at '\[0\].track_id', found '-3'"),
        (UNIT_LABEL, set_in(0, to="car"), "expected a list of JSON objects, found other things in it"),
        (WORLD_LABEL, without(3, "world_8_points"), r"expected the key '\[3\].world_8_points', found none"),
        (WORLD_LABEL, set_in(3, "world_8_points", to=[[0, 0, 0]]), r"expected 8 x 3 finite numbers at '\[3\].world_8_points'"),
        (WORLD_LABEL, set_in(1, "world_8_points", to=corners("a")[::-1].tolist()), r"expected at '\[1\].* the corners front left"),
        (WORLD_LABEL, set_in(1, "world_8_points", to=corners("a")[[1, 0, 3, 2, 5, 4, 7, 6]].tolist()), "corners front left"),
        (NOVATEL_FILE, without("translation"), "expected the key 'translation', found none"),
        (NOVATEL_FILE, set_in("translation", to=[["x"], [1], [2]]), "expected 3 finite numbers at 'translation', found"),
        (NOVATEL_FILE, set_in("rotation", to=np.diag([1, -1, 1]).tolist()), "'rotation' is no rotation .* determinant -1.000"),
        (NOVATEL_FILE, set_in("rotation", to=np.diag([1, 1.1, 1]).tolist()), "expected an orthonormal, right-handed matrix"),
        ("cooperative/data_info.json", without(1, "vehicle_pointcloud_path"), r"expected the key '\[1\].vehicle_pointcloud_path'"),
        ("cooperative/data_info.json", set_in(1, "system_error_offset", "delta_x", to="?"), "system_error_offset.delta_x', found"),
        ("vehicle-side/data_info.json", set_in(1, "pointcloud_timestamp", to="noon"), "'000010.pointcloud_timestamp', found"),
    ],
)  # fmt: skip
def test_damaged_files_are_named_with_field_and_remedy(
    root: Path, file: str, change: Callable, message_match: str
) -> None:
    edit(root / file, change)
    with pytest.raises(RecordingError, match=message_match) as caught:
        DairRecording(root).snapshot("12", 0)
    assert file in str(caught.value) and "\n" not in str(caught.value)
    assert str(caught.value).endswith("copy or download the file again.")


def test_broken_json_and_truncated_clouds_are_named(root: Path) -> None:
    label, cloud = root / UNIT_LABEL, root / "vehicle-side/velodyne/000011.pcd"
    cloud.write_bytes(cloud.read_bytes()[:-1000])
    with pytest.raises(RecordingError, match=r"000011.pcd: truncated, expected \d+ bytes of compressed points"):
        DairRecording(root).snapshot("12", 1)
    label.write_text('[{"type": ')
    with pytest.raises(RecordingError, match=r"000020.json: expected JSON, found something else \(Expecting value"):
        DairRecording(root).snapshot("12", 0)


def test_rounded_rotations_become_true_ones(root: Path) -> None:
    edit(root / NOVATEL_FILE, lambda c: c.update(rotation=np.round(NOVATEL[0], 3).tolist()))
    recording = DairRecording(root)
    turn = recording.lidar_poses(recording.pair("12", 0))[0].rotation
    torch.testing.assert_close(turn @ turn.mT, torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(turn, torch.from_numpy(LIDAR[0]), atol=2e-3, rtol=0)
