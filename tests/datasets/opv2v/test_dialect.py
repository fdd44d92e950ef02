# SPDX-License-Identifier: Apache-2.0
"""V2V4Real and V2X-Real: scenes made by hand in their own terms, right-handed, with poses that have no symmetry."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from manyeyes.datasets.base import count_points_in_listed_boxes
from manyeyes.datasets.formats.pcd import PcdTable, write_table
from manyeyes.datasets.opv2v import Opv2vRecording
from manyeyes.datasets.opv2v.dialect import OPV2V, V2V4REAL, V2X_REAL, pose_of_matrix
from manyeyes.datasets.registry import open_recording
from manyeyes.datatypes import LABELS, RecordingError


@dataclass(frozen=True)
class Thing:
    """An object in the right-handed world: middle, size (l, w, h) in metres, yaw in radians."""

    type: str
    center: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float


# [x, y, z, roll, yaw, pitch]; the LiDARs stand 1.9 and 2.1 m above a road at z = 0.4.
LIDARS = {0: (812.0, -305.0, 2.3, 0.8, 37.0, -1.2), 1: (836.0, -290.0, 2.5, -0.5, -151.0, 0.9)}
V2X_LIDARS = {1: LIDARS[0], 2: LIDARS[1], -1: (820.0, -310.0, 5.4, 0.3, 100.0, 0.4)}
THINGS = {
    7: Thing("Car", (824.0, -301.0, 1.2), (4.5, 1.9, 1.5), 0.7),
    8: Thing("Truck", (815.0, -284.0, 2.1), (8.4, 2.6, 3.3), -1.1),
    9: Thing("Pedestrian", (830.0, -296.0, 1.3), (0.6, 0.5, 1.7), 2.0),
}


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MANYEYES_CACHE", str(tmp_path_factory.mktemp("cache")))


def matrix_of(pose: tuple[float, ...]) -> np.ndarray:
    """(4, 4) of [x, y, z, roll, yaw, pitch], as OPV2V's layout defines it."""
    r, y, p = np.radians(pose[3:])
    about_z = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
    about_y = np.array([[np.cos(p), 0, -np.sin(p)], [0, 1, 0], [np.sin(p), 0, np.cos(p)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(r), np.sin(r)], [0, -np.sin(r), np.cos(r)]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = about_z @ about_y @ about_x, pose[:3]
    return matrix


def points_on(thing: Thing, seed: int) -> np.ndarray:
    """60 points in the front left quarter of a thing, in the world: a mirrored box misses them."""
    local = np.random.default_rng(seed).uniform(0.55, 0.95, (60, 3)) * np.array(thing.size) / 2
    c, s = math.cos(thing.yaw), math.sin(thing.yaw)
    turned = np.stack((local[:, 0] * c - local[:, 1] * s, local[:, 0] * s + local[:, 1] * c, local[:, 2]), -1)
    return turned + thing.center


def scan(matrix: np.ndarray) -> np.ndarray:
    """(N, 3) in the LiDAR's frame: all things, and the road around the LiDAR but not under a thing."""
    rng = np.random.default_rng(3)
    road = np.concatenate((matrix[:2, 3] + rng.uniform(-20, 20, (4000, 2)), np.full((4000, 1), 0.4)), 1)
    road = road[np.min([np.hypot(*(road - t.center)[:, :2].T) for t in THINGS.values()], 0) > 6]
    world = np.concatenate([*(points_on(thing, id) for id, thing in THINGS.items()), road])
    return ((world - matrix[:3, 3]) @ matrix[:3, :3]).astype(np.float32)


def entry(thing: Thing, lidar_from_world: np.ndarray, **more: Any) -> dict[str, Any]:
    center = lidar_from_world[:3, :3] @ thing.center + lidar_from_world[:3, 3]
    ahead = lidar_from_world[:3, :3] @ (math.cos(thing.yaw), math.sin(thing.yaw), 0)
    return {
        "angle": [0.0, math.degrees(math.atan2(ahead[1], ahead[0])), 0.0],
        "center": [0.0, 0.0, 0.0],
        "extent": [s / 2 for s in thing.size],
        "location": center.tolist(),
        "obj_type": thing.type,
        **more,
    }


def write_v2v4real(scenario: Path, plain: bool = False, numpy1: bool = True) -> Path:
    """Two vehicles; matrices as numpy arrays of numpy 1 (or 2), or as lists; the pedestrian is linked by no one."""
    for agent, pose in LIDARS.items():
        folder, matrix = scenario / str(agent), matrix_of(pose)
        folder.mkdir(parents=True)
        xyz = scan(matrix)
        gray = np.full(len(xyz), 51, np.float32)
        write_table(folder / "000003.pcd", PcdTable(("x", "y", "z", "intensity"), (*xyz.T, gray)))
        links = {7: 0, 8: 1, 9: -1}
        vehicles = {id + agent: entry(thing, np.linalg.inv(matrix), ass_id=links[id]) for id, thing in THINGS.items()}
        content = {
            "lidar_pose": matrix.tolist() if plain else matrix,
            "vehicles": vehicles,
            "ego_speed": np.float64(18.0),
        }
        text = yaml.dump(content)
        assert plain or "numpy._core" in text
        (folder / "000003.yaml").write_text(text.replace("numpy._core", "numpy.core") if numpy1 else text)
    return scenario


def write_v2x_real(scenario: Path, binary: bool = True) -> Path:
    for agent, pose in V2X_LIDARS.items():
        folder, matrix = scenario / str(agent), matrix_of(pose)
        folder.mkdir(parents=True)
        xyz = scan(matrix)
        gray = np.full(len(xyz), 51, np.float32)
        if binary:
            (folder / "000003.bin").write_bytes(np.concatenate((xyz, gray[:, None]), 1).astype("<f4").tobytes())
        else:
            write_table(folder / "000003.pcd", PcdTable(("x", "y", "z", "intensity"), (*xyz.T, gray)))
        vehicles = {id: entry(thing, np.eye(4)) for id, thing in THINGS.items()}
        vehicles[30] = entry(Thing("FireHydrant", (826.0, -311.0, 0.7), (0.4, 0.4, 0.6), 0.0), np.eye(4))
        (folder / "000003.yaml").write_text(yaml.safe_dump({"lidar_pose": list(pose), "vehicles": vehicles}))
    return scenario


def check_scene(recording: Any, scenario: str) -> Any:
    """Poses, boxes, types and points are those of the scene; return the snapshot."""
    snapshot = recording.snapshot(scenario, 0)
    truth = snapshot.truth
    assert truth is not None
    counts = count_points_in_listed_boxes(snapshot, 0.02)
    assert bool((counts[truth.seen] == 60).all()) and counts.shape[0] == len(snapshot.frames)
    kinds = [LABELS[label] for label in truth.boxes.label.tolist()]
    assert set(kinds) == {"car", "truck", "pedestrian"}
    for label, center, size, yaw in zip(kinds, truth.boxes.center, truth.boxes.size, truth.boxes.yaw):
        thing = next(t for t in THINGS.values() if t.type.lower() == label)
        assert center.tolist() == pytest.approx(thing.center, abs=1e-6)
        assert size.tolist() == pytest.approx(thing.size)
        assert float(yaw) == pytest.approx(thing.yaw, abs=2e-3)  # the LiDARs are tilted by up to 1.2 degrees
    for frame in snapshot.frames:
        assert frame.points.intensity.unique().tolist() == pytest.approx([0.2])
        assert frame.timestamp_ns == 300_000_000
        world = frame.world_from_agent.apply(frame.points.xyz.double())
        assert world[180:, 2].sub(0.4).abs().max() < 1e-3
    return snapshot


@pytest.mark.parametrize("plain", [False, True], ids=["numpy tags", "lists"])
def test_v2v4real_is_read_with_its_matrices_and_local_boxes(tmp_path: Path, plain: bool) -> None:
    write_v2v4real(tmp_path / "test" / "testoutput_CAV_data_2022-03-15-09-54-40_1", plain)
    recording = open_recording(tmp_path, "test")
    assert isinstance(recording, Opv2vRecording)
    (scenario,) = recording.scenarios
    assert recording.dialect(scenario) is V2V4REAL
    snapshot = check_scene(recording, scenario)
    assert [frame.agent_id for frame in snapshot.frames] == [0, 1]
    assert [frame.sensor_height_m for frame in snapshot.frames] == pytest.approx([1.9, 2.1], abs=0.5)
    assert snapshot.frames[0].speed_mps == pytest.approx(5.0)
    for frame, pose in zip(snapshot.frames, LIDARS.values()):
        lidar = frame.world_from_agent.apply(torch.tensor([[0.0, 0.0, frame.sensor_height_m]]).double())[0]
        assert lidar.tolist() == pytest.approx(pose[:3], abs=1e-6)
    # Linked objects are one box, seen by both; the pedestrian without a link is one box of each agent.
    assert snapshot.truth.seen.sum(0).tolist() == [2, 2, 1, 1]
    assert not set(snapshot.truth.boxes.id.tolist()) & {0, 1}


def test_arrays_of_numpy_2_are_read_as_those_of_numpy_1(tmp_path: Path) -> None:
    write_v2v4real(tmp_path / "a", numpy1=False)
    check_scene(Opv2vRecording(tmp_path), "a")


def test_v2v4real_is_recognised_by_content_where_names_do_not_differ(tmp_path: Path) -> None:
    recording = Opv2vRecording(write_v2v4real(tmp_path / "renamed"))
    assert recording.dialect("renamed") is V2V4REAL
    check_scene(recording, "renamed")


@pytest.mark.parametrize(("name", "binary"), [("2023-03-17-15-53-02_1_0", True), ("other", True), ("other", False)])
def test_v2x_real_is_read_with_its_four_agents_types_and_world_boxes(tmp_path: Path, name: str, binary: bool) -> None:
    write_v2x_real(tmp_path / name, binary)
    recording = open_recording(tmp_path)
    assert isinstance(recording, Opv2vRecording) and recording.dialect(name) is V2X_REAL
    snapshot = check_scene(recording, name)
    assert [frame.agent_id for frame in snapshot.frames] == [1, 2, -1]
    assert [frame.is_infrastructure for frame in snapshot.frames] == [False, False, True]
    assert snapshot.truth.boxes.id.tolist() == [7, 8, 9] and bool(snapshot.truth.seen.all())


@pytest.mark.parametrize("dialect", [OPV2V, V2X_REAL], ids=["left-handed", "boxes in the world"])
def test_another_dialect_misses_the_points(tmp_path: Path, dialect: Any) -> None:
    recording = Opv2vRecording(write_v2v4real(tmp_path / "a"), dialect=dialect)
    snapshot = recording.snapshot("a", 0)
    counts = count_points_in_listed_boxes(snapshot, 0.02)
    assert snapshot.truth is not None and (counts[snapshot.truth.seen] < 60).any()


def test_a_box_around_the_lidar_is_the_agents_own_body(tmp_path: Path) -> None:
    write_v2x_real(tmp_path / "2023-03-17-15-53-02_1_0")
    path = tmp_path / "2023-03-17-15-53-02_1_0" / "2" / "000003.yaml"
    content = yaml.safe_load(path.read_text())
    body = Thing("Car", (811.3, -305.4, 1.2), (4.6, 1.9, 1.6), math.radians(37))
    content["vehicles"][44] = entry(body, np.eye(4))
    path.write_text(yaml.safe_dump(content))
    truth = open_recording(tmp_path).snapshot("2023-03-17-15-53-02_1_0", 0).truth
    assert truth is not None and truth.boxes.id.tolist() == [7, 8, 9, 1]


def test_six_numbers_and_their_matrix_are_one_pose() -> None:
    for pose in (*LIDARS.values(), *V2X_LIDARS.values()):
        assert pose_of_matrix(matrix_of(pose)) == pytest.approx(pose)
        assert V2X_REAL.world_from_lidar(pose).matrix().numpy() == pytest.approx(matrix_of(pose))


def test_an_opv2v_pose_as_a_matrix_stands_for_its_six_numbers(tmp_path: Path) -> None:
    """Capitalised types and links are of real recordings; without them a matrix is in CARLA's axes."""
    poses = []
    for name, value in (("six", list(LIDARS[0])), ("matrix", matrix_of(LIDARS[0]).tolist())):
        folder = tmp_path / name / "641"
        folder.mkdir(parents=True)
        write_table(folder / "000003.pcd", PcdTable(("x", "y", "z"), tuple(np.ones((3, 5), np.float32))))
        (folder / "000003.yaml").write_text(yaml.safe_dump({"lidar_pose": value, "vehicles": {}}))
        recording = Opv2vRecording(tmp_path / name)
        assert recording.dialect(name) is OPV2V
        poses.append(recording.snapshot(name, 0).frames[0].world_from_agent.matrix())
    assert torch.allclose(poses[0], poses[1], atol=1e-9)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ((np.eye(4) * 2).tolist(), "no rigid motion"),
        (np.diag([1.0, -1.0, 1.0, 1.0]).tolist(), "no rigid motion"),
        (np.eye(3).tolist(), "6 numbers or a 4x4 matrix"),
        ([[0.0, 1.0, 2.0, math.nan]] * 4, "6 numbers or a 4x4 matrix"),
        (np.eye(5).tolist(), "6 numbers or a 4x4 matrix"),
    ],
)
def test_a_matrix_that_is_no_pose_is_refused(tmp_path: Path, value: Any, text: str) -> None:
    (tmp_path / "a" / "0").mkdir(parents=True)
    (tmp_path / "a" / "0" / "000003.yaml").write_text(yaml.safe_dump({"lidar_pose": value, "vehicles": {}}))
    (tmp_path / "a" / "0" / "000003.pcd").touch()
    with pytest.raises(RecordingError, match=text) as caught:
        Opv2vRecording(tmp_path / "a").snapshot("a", 0)
    assert "lidar_pose" in str(caught.value) and "000003.yaml" in str(caught.value)
