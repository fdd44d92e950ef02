# SPDX-License-Identifier: Apache-2.0
"""OPV2V's layout: a scene made by hand in CARLA's own terms, our own writer, and what users' downloads lack."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from manyeyes.datasets.base import count_points_in_listed_boxes, iter_eval_frames
from manyeyes.datasets.formats.pcd import write_pcd
from manyeyes.datasets.frame_reader import as_frame_reader
from manyeyes.datasets.opv2v import Opv2vRecording, Opv2vWriter, dialect, reader
from manyeyes.datatypes import LABELS, AgentFrame, Boxes, GroundTruth, PointCloud, RecordingError, Snapshot, Transform

# CARLA's world, left-handed, degrees: [x, y, z, roll, yaw, pitch]. Nothing here is symmetric, so no sign can hide.
LIDARS = {
    641: (100.0, 50.0, 2.2, 0.5, 30.0, -1.0),
    1045: (130.0, 35.0, 2.1, -0.7, -140.0, 1.5),
    -1: (110.0, 70.0, 4.6, 0.0, 75.0, 0.0),
}
HEIGHTS = {641: 1.9, 1045: 1.8, -1: 4.3}
# id: location on the road, yaw, extent. 641 and 1045 are the agents' own bodies.
VEHICLES = {
    641: ((100.4, 50.3, 0.3), 30.0, (2.45, 1.05, 0.75)),
    1045: ((130.0, 35.0, 0.3), -140.0, (2.3, 1.0, 0.8)),
    700: ((118.0, 44.0, 0.3), 25.0, (2.4, 1.0, 0.75)),
    701: ((112.0, 61.0, 0.3), 118.0, (5.2, 1.9, 2.1)),
    702: ((125.0, 58.0, 0.3), -63.0, (1.9, 0.8, 0.7)),
    703: ((96.0, 38.0, 0.3), 170.0, (3.0, 1.05, 1.25)),
}
LISTS = {641: (1045, 700, 701, 703), 1045: (641, 700, 702), -1: (1045, 641, 701, 702)}
CENTER_Z = {id: extent[2] for id, (_, _, extent) in VEHICLES.items()}


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MANYEYES_CACHE", str(tmp_path_factory.mktemp("cache")))


def world_from_lidar(pose: tuple[float, ...]) -> np.ndarray:
    """(4, 4), left-handed, as the format defines it."""
    roll, yaw, pitch = np.radians(pose[3:])
    cr, sr, cy, sy, cp, sp = np.cos(roll), np.sin(roll), np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr],
        [sp, -cp * sr, cp * cr],
    ]
    matrix[:3, 3] = pose[:3]
    return matrix


def points_on(id: int) -> np.ndarray:
    """60 points (60, 3) in CARLA's world, in the front left quarter of the vehicle's sides: a mirrored box misses them."""
    location, yaw, extent = VEHICLES[id]
    rng = np.random.default_rng(id)
    local = rng.uniform(0.55, 0.95, (60, 3)) * extent * (1, -1, 1)  # y is to the right here
    c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    turned = np.stack((local[:, 0] * c - local[:, 1] * s, local[:, 0] * s + local[:, 1] * c, local[:, 2]), -1)
    return turned + location + (0, 0, CENTER_Z[id])


def scan(agent: int) -> np.ndarray:
    """The agent's points in its LiDAR's frame, y to the right: its listed vehicles, then the road."""
    rng = np.random.default_rng(5)
    road = np.stack((rng.uniform(80, 150, 9000), rng.uniform(20, 90, 9000), np.full(9000, 0.3)), -1)
    # None under a vehicle but the scanning one, so that what lies in a box is the vehicle's own.
    apart = [np.hypot(*(road - VEHICLES[id][0])[:, :2].T) > 6 for id in VEHICLES if id != agent]
    road = road[np.logical_and.reduce(apart)][:3000]
    world = np.concatenate([points_on(id) for id in LISTS[agent]] + [road])
    lidar_from_world = np.linalg.inv(world_from_lidar(LIDARS[agent]))
    return (world @ lidar_from_world[:3, :3].T + lidar_from_world[:3, 3]).astype(np.float32)


def write_ascii(path: Path, xyz: np.ndarray, red: int = 200) -> None:
    value = f"{red * 65536 * 2.0**-149:.9g}"
    n = len(xyz)
    header = (
        "VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA ascii\n"
    )
    path.write_text(header + "".join(f"{x:.6f} {y:.6f} {z:.6f} {value}\n" for x, y, z in xyz.tolist()))


def metadata(agent: int) -> dict[str, Any]:
    lidar = LIDARS[agent]
    # The place of the vehicle: under its LiDAR along the LiDAR's own axis, and half a metre ahead, as in OpenCDA.
    ego = (world_from_lidar(lidar) @ (0.5, 0, -HEIGHTS[agent], 1))[:3].tolist() + list(lidar[3:])
    vehicles = {
        id: {
            "angle": [0.0, VEHICLES[id][1], 0.0],
            "center": [0.0, 0.0, CENTER_Z[id]],
            "extent": list(VEHICLES[id][2]),
            "location": list(VEHICLES[id][0]),
            "speed": 36.0,
        }
        for id in LISTS[agent]
    }
    camera = {"cords": list(lidar), "extrinsic": np.eye(4).tolist(), "intrinsic": np.eye(3).tolist()}
    return {
        "RSU": agent < 0,
        "camera0": camera,
        "ego_speed": -18.0,
        "lidar_pose": list(lidar),
        "plan_trajectory": [[1.0, 2.0, 3.0]],
        "predicted_ego_pos": ego,
        "true_ego_pos": ego,
        "vehicles": vehicles,
    }


def write_scenario(folder: Path, stems: tuple[str, ...] = ("00068", "00070"), write: Callable = write_ascii) -> Path:
    for agent in LIDARS:
        (folder / str(agent)).mkdir(parents=True)
        for stem in stems:
            write(folder / str(agent) / f"{stem}.pcd", scan(agent))
            (folder / str(agent) / f"{stem}_camera0.png").touch()
            (folder / str(agent) / f"{stem}.yaml").write_text(yaml.safe_dump(metadata(agent)))
    (folder / "data_protocol.yaml").write_text(
        "additional: ''\ncurrent_time: 2021_08_16_22_26_00\nvehicle_base: &base\n  sensing: {lidar: {channels: 64}}\n"
        "  points: &points [1, 2]\nscenario:\n  single_cav_list:\n  - <<: *base\n    destination: *points\n"
        "world:\n  fixed_delta_seconds: &delta 0.05\n  tick: *delta\n"
    )
    return folder


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """root/train/<scenario>, root/test/<two scenarios>; never written to by a test."""
    root = tmp_path_factory.mktemp("opv2v")
    write_scenario(root / "train" / "2021_08_16_22_26_54")
    write_scenario(root / "test" / "2021_08_18_19_48_05")
    write_scenario(root / "test" / "2021_08_20_21_10_24", ("000068",), lambda p, xyz: write_pcd(p, xyz, xyz[:, 0] * 0))
    return root


@pytest.fixture
def scenario(tmp_path: Path, dataset: Path) -> Path:
    """A scenario's folder of the test's own."""
    return shutil.copytree(dataset / "train" / "2021_08_16_22_26_54", tmp_path / "drive")


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    content = yaml.safe_load(path.read_text())
    change(content)
    path.write_text(yaml.safe_dump(content))


def test_the_scene_in_right_handed_terms(dataset: Path) -> None:
    recording = Opv2vRecording(dataset, "train")
    assert recording.scenarios == ("2021_08_16_22_26_54",) and recording.missing_summary == ()
    name = recording.scenarios[0]
    # String order puts 1045 before 641; infrastructure is last although '-' sorts first.
    assert recording.agents(name) == (1045, 641, -1)
    assert recording.length(name) == 2 and recording.eval_indices(name) == range(2)
    snapshot = recording.snapshot(name, 1)
    assert [f.agent_id for f in snapshot.frames] == [1045, 641, -1]
    assert [f.is_infrastructure for f in snapshot.frames] == [False, False, True]
    assert {f.timestamp_ns for f in snapshot.frames} == {3_500_000_000}
    assert [f.sensor_height_m for f in snapshot.frames] == pytest.approx([1.8, 1.9, 4.3], abs=1e-9)
    assert [f.speed_mps for f in snapshot.frames] == pytest.approx([-5.0] * 3)
    truth = snapshot.truth
    assert truth is not None and truth.boxes.id.tolist() == [641, 700, 701, 702, 703, 1045]
    for row, frame in enumerate(snapshot.frames):
        assert set(truth.boxes.id[truth.seen[row]].tolist()) == set(LISTS[frame.agent_id])
        assert frame.points.intensity.unique().tolist() == pytest.approx([200 / 255])
        assert len(frame.points) == len(scan(frame.agent_id))
    bus = truth.boxes[2:3]
    assert bus.center[0].tolist() == pytest.approx([112.0, -61.0, 0.3 + 2.1])
    assert bus.size[0].tolist() == pytest.approx([10.4, 3.8, 4.2])
    assert bus.yaw[0].item() == pytest.approx(-math.radians(118.0))
    assert [LABELS[i] for i in truth.boxes.label.tolist()] == ["car", "car", "bus", "car", "van", "car"]


def test_the_road_is_at_zero_in_every_agents_frame(dataset: Path) -> None:
    snapshot = Opv2vRecording(dataset / "train").snapshot("2021_08_16_22_26_54", 0)
    for frame in snapshot.frames:
        world = frame.world_from_agent.apply(frame.points.xyz.double())
        assert world[-3000:, 2].sub(0.3).abs().max() < 1e-4  # the road's own height in the world
        under = frame.points.xyz[-3000:][frame.points.xyz[-3000:, :2].norm(dim=-1) < 5]
        assert len(under) and under[:, 2].abs().max() < 0.3  # the LiDARs are tilted by up to 1.7 degrees


def test_every_listed_vehicles_points_lie_in_its_box_in_every_agents_frame(dataset: Path) -> None:
    snapshot = Opv2vRecording(dataset / "train").snapshot("2021_08_16_22_26_54", 0)
    assert snapshot.truth is not None
    counts = count_points_in_listed_boxes(snapshot)
    assert bool((counts[snapshot.truth.seen] == 60).all())
    assert bool((counts[~snapshot.truth.seen] == -1).all())


def _right_handed_pose(pose: tuple[float, ...]) -> Transform:
    x, y, z, roll, yaw, pitch = pose
    angles = torch.tensor([roll, pitch, yaw]).double().deg2rad()
    return Transform.from_rpy(torch.tensor([x, y, z]).double(), *angles)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("mirror_points", lambda xyz: np.array(xyz, np.float32)),
        ("transform_from_carla", _right_handed_pose),
        ("transform_from_carla", lambda pose: opv2v_mirror(pose, 4)),
        ("transform_from_carla", lambda pose: opv2v_mirror(pose, 1)),
    ],
    ids=["points not mirrored", "poses not mirrored", "yaw of the wrong sense", "y of the wrong sign"],
)
def test_a_mirrored_reader_fails_that_test(
    dataset: Path, monkeypatch: pytest.MonkeyPatch, name: str, wrong: Any
) -> None:
    for module in (reader, dialect):
        monkeypatch.setattr(module, name, wrong, raising=False)
    snapshot = Opv2vRecording(dataset / "train").snapshot("2021_08_16_22_26_54", 0)
    assert snapshot.truth is not None
    counts = count_points_in_listed_boxes(snapshot)
    for row in range(len(snapshot.frames)):
        assert (counts[row][snapshot.truth.seen[row]] < 60).all()


def opv2v_mirror(pose: tuple[float, ...], entry: int) -> Transform:
    from manyeyes.datasets.opv2v.carla import transform_from_carla

    return transform_from_carla([-v if i == entry else v for i, v in enumerate(pose)])


def test_scenario_split_and_folder_of_scenarios_are_all_roots(dataset: Path) -> None:
    two = ("2021_08_18_19_48_05", "2021_08_20_21_10_24")
    assert Opv2vRecording(dataset, "test").scenarios == two
    assert Opv2vRecording(dataset / "test").scenarios == two
    assert Opv2vRecording(dataset / "test" / two[1]).scenarios == two[1:]
    recording = Opv2vRecording(dataset / "test")
    assert list(iter_eval_frames(recording)) == [(two[0], 0), (two[0], 1), (two[1], 0)]
    ascii_points = recording.snapshot(two[0], 0).frames[0].points.xyz
    assert recording.snapshot(two[1], 0).frames[0].points.xyz == pytest.approx(ascii_points, abs=2e-6)


def test_history_frames_are_not_evaluated(scenario: Path) -> None:
    edit(scenario / "data_protocol.yaml", lambda c: c.update(history_frames=1))
    assert Opv2vRecording(scenario).eval_indices("drive") == range(1, 2)
    edit(scenario / "data_protocol.yaml", lambda c: c.update(history_frames=9))
    assert list(Opv2vRecording(scenario).eval_indices("drive")) == []
    (scenario / "data_protocol.yaml").unlink()
    assert Opv2vRecording(scenario).eval_indices("drive") == range(2)
    (scenario / "data_protocol.yaml").write_text("world: {fixed_delta_seconds: quick}")
    with pytest.raises(RecordingError, match=r"data_protocol\.yaml: expected world\.fixed_delta_seconds.*'quick'"):
        Opv2vRecording(scenario).eval_indices("drive")


def test_opening_reads_no_cloud_and_no_yaml(scenario: Path) -> None:
    for path in scenario.rglob("0*"):
        path.write_bytes(b"")
    recording = Opv2vRecording(scenario)
    assert recording.length("drive") == 2 and recording.eval_indices("drive") == range(2)


def test_yaml_is_parsed_once_and_again_when_it_changes(scenario: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Path] = []

    def counting(path: Path) -> Mapping[Any, Any]:
        calls.append(path)
        return yaml.safe_load(path.read_text())

    monkeypatch.setattr("manyeyes.datasets.opv2v.metadata.load_yaml", counting)
    first = Opv2vRecording(scenario).snapshot("drive", 0)
    parsed = [p for p in calls if p.name != "data_protocol.yaml"]
    assert len(parsed) == 3
    again = Opv2vRecording(scenario).snapshot("drive", 0)
    assert [p for p in calls if p.name != "data_protocol.yaml"] == parsed
    assert first.truth is not None and again.truth is not None
    for name in ("center", "size", "yaw", "label", "id"):
        assert torch.equal(getattr(first.truth.boxes, name), getattr(again.truth.boxes, name))
    edit(scenario / "641" / "00068.yaml", lambda c: c.update(ego_speed=72.0))
    assert Opv2vRecording(scenario).snapshot("drive", 0).frames[1].speed_mps == pytest.approx(20.0)


def test_without_a_cache_nothing_is_written(scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MANYEYES_CACHE", str(tmp_path / "none"))
    Opv2vRecording(scenario, use_cache=False).snapshot("drive", 0)
    assert not (tmp_path / "none").exists()
    Opv2vRecording(scenario, cache_folder=tmp_path / "mine").snapshot("drive", 0)
    assert (tmp_path / "mine").is_dir() and not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("root", "split", "message_match"),
    [
        ("nowhere", None, "nowhere: no such folder"),
        (".", "validate", "no split 'validate'; it has test, train"),
        ("test", "train", "holds scenarios itself"),
        (".", None, "holds several splits (test, train)"),
        ("train/2021_08_16_22_26_54/641", None, "no scenario in it"),
    ],
)
def test_a_wrong_root_is_refused_by_kind(dataset: Path, root: str, split: str | None, message_match: str) -> None:
    with pytest.raises(RecordingError) as caught:
        Opv2vRecording(dataset / root, split)
    assert message_match in str(caught.value) and "\n" not in str(caught.value)


def test_the_split_val_is_the_folder_validate(dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(dataset / "train", tmp_path / "validate")
    assert Opv2vRecording(tmp_path, "val").scenarios == Opv2vRecording(dataset, "train").scenarios
    for split in ("validate", "test"):
        with pytest.raises(RecordingError, match=f"no split '{split}'; it has val:"):
            Opv2vRecording(tmp_path, split)
    (tmp_path / "validate").rename(tmp_path / "val")
    assert len(Opv2vRecording(tmp_path, "val").scenarios) == 1


def test_unknown_scenario_and_index(dataset: Path) -> None:
    recording = Opv2vRecording(dataset, "test")
    with pytest.raises(RecordingError, match=r"No scenario 'x'.*2021_08_18_19_48_05"):
        recording.length("x")
    with pytest.raises(RecordingError, match="index from 0 to 1"):
        recording.snapshot("2021_08_18_19_48_05", 2)


def test_a_frame_is_that_of_the_snapshot(dataset: Path) -> None:
    recording = Opv2vRecording(dataset, "train")
    name = recording.scenarios[0]
    assert as_frame_reader(recording) is recording
    for index in range(2):
        frames = recording.snapshot(name, index).frames
        assert recording.present_agents(name, index) == tuple(frame.agent_id for frame in frames) == (1045, 641, -1)
        for frame in frames:
            alone = recording.frame(name, index, frame.agent_id)
            assert (alone.agent_id, alone.timestamp_ns) == (frame.agent_id, frame.timestamp_ns)
            assert torch.equal(alone.points.xyz, frame.points.xyz)
            assert torch.equal(alone.world_from_agent.translation, frame.world_from_agent.translation)


def test_no_other_agents_files_are_read_for_a_frame(scenario: Path) -> None:
    recording = Opv2vRecording(scenario, use_cache=False)
    shutil.rmtree(scenario / "1045")
    assert len(recording.frame("drive", 0, 641).points) == len(scan(641))
    with pytest.raises((RecordingError, OSError)):
        recording.snapshot("drive", 0)


def test_an_agent_without_the_frame_is_refused_by_name(scenario: Path) -> None:
    (scenario / "641" / "00068.pcd").unlink()
    recording = Opv2vRecording(scenario)
    assert recording.present_agents("drive", 0) == (1045, -1)
    with pytest.raises(RecordingError, match="Agent 641 has no frame 0 of 'drive'; choose one of 1045, -1"):
        recording.frame("drive", 0, 641)


def _remove(*names: str) -> Callable[[Path], None]:
    return lambda folder: [(folder / n).unlink() for n in names] and None


@pytest.mark.parametrize(
    ("damage", "message_match", "agents"),
    [
        (_remove("641/00068.pcd"), "641: 1 of 2 frames lack their pcd, the first is 00068", [1045, -1]),
        (_remove("641/00068.yaml"), "641: 1 of 2 frames lack their yaml, the first is 00068", [1045, -1]),
        (_remove("641/00068.yaml", "641/00068.pcd"), "641: lacks 1 of the ego's 2 frames", [1045, -1]),
        (_remove("641/00068.yaml", "641/00070.yaml"), "641: 2 of 2 frames lack their yaml", [1045, -1]),
        (_remove("1045/00070.yaml", "1045/00070.pcd"), "641: has 1 frames that the ego 1045 lacks", [1045, 641, -1]),
        (_remove("1045/00068.pcd", "1045/00070.pcd"), "1045: 2 of 2 frames lack their pcd", [641, -1]),
        (lambda folder: shutil.rmtree(folder / "641") or (folder / "641").mkdir(), "641: holds neither", [1045, -1]),
    ],
)
def test_a_partial_scenario_is_usable_and_reports_what_is_missing(
    scenario: Path, damage: Callable[[Path], None], message_match: str, agents: list[int]
) -> None:
    damage(scenario)
    recording = Opv2vRecording(scenario)
    assert any(message_match in line for line in recording.missing_summary), recording.missing_summary
    assert [f.agent_id for f in recording.snapshot("drive", 0).frames] == agents
    with pytest.raises(RecordingError) as caught:
        Opv2vRecording(scenario, strict=True)
    assert recording.missing_summary[0] in str(caught.value)


def test_an_empty_scenario_among_whole_ones_is_reported(dataset: Path, tmp_path: Path) -> None:
    root = shutil.copytree(dataset / "test", tmp_path / "root")
    (root / "2021_09_09_13_20_58").mkdir()
    recording = Opv2vRecording(root)
    assert len(recording.scenarios) == 2
    assert "2021_09_09_13_20_58: no agent with a whole frame" in recording.missing_summary[0]
    for path in root.rglob("*.pcd"):
        path.unlink()
    with pytest.raises(RecordingError, match=r"expected whole scenarios; .* lack their pcd"):
        Opv2vRecording(root)


@pytest.mark.parametrize(
    ("change", "message_match"),
    [
        (lambda c: c.pop("lidar_pose"), "expected the key 'lidar_pose' with 6 numbers, found none"),
        (lambda c: c.update(lidar_pose=[1, 2, 3]), "expected 6 finite numbers at 'lidar_pose', found [1, 2, 3]"),
        (lambda c: c.update(lidar_pose=[1, 2, 3, 4, 5, float("nan")]), "expected 6 finite numbers at 'lidar_pose'"),
        (lambda c: c.update(ego_speed="fast"), "expected 1 finite numbers at 'ego_speed', found 'fast'"),
        (lambda c: c.pop("vehicles"), "expected the key 'vehicles'"),
        (lambda c: c["vehicles"][700].pop("extent"), "expected the key 'vehicles.700.extent' with 3 numbers"),
        (lambda c: c["vehicles"].update({700: 5}), "expected a mapping at 'vehicles.700', found 5"),
        (lambda c: c["vehicles"].update(car=c["vehicles"][700]), "whole number as id of 'vehicles.car'"),
    ],
)
def test_a_faulty_yaml_names_file_and_key(
    scenario: Path, change: Callable[[dict[str, Any]], object], message_match: str
) -> None:
    path = scenario / "641" / "00070.yaml"
    edit(path, change)
    recording = Opv2vRecording(scenario)
    recording.snapshot("drive", 0)
    with pytest.raises(RecordingError) as caught:
        recording.snapshot("drive", 1)
    assert message_match in str(caught.value) and str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["lidar_pose: [1, 2", "- 1\n- 2\n", "", "lidar_pose: *unknown\n"])
def test_a_file_that_is_no_yaml_mapping_is_named(scenario: Path, text: str) -> None:
    (scenario / "641" / "00068.yaml").write_text(text)
    with pytest.raises(RecordingError, match=r"00068\.yaml: expected .*yaml.*found"):
        Opv2vRecording(scenario).snapshot("drive", 0)


def test_truncated_and_nan_clouds_are_named(scenario: Path) -> None:
    path = scenario / "641" / "00068.pcd"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-5]))
    with pytest.raises(RecordingError, match=r"641/00068\.pcd: truncated, expected 3240 lines.*found 3235"):
        Opv2vRecording(scenario).snapshot("drive", 0)
    path.write_text("".join(lines[:-5]) + "nan nan nan 0\n" * 5)
    with pytest.raises(RecordingError, match=r"641/00068\.pcd: 5 of 3240 points are NaN.*drop_nan=True"):
        Opv2vRecording(scenario).snapshot("drive", 0)
    frames = Opv2vRecording(scenario, drop_nan=True).snapshot("drive", 0).frames
    assert [len(f.points) for f in frames] == [3180, 3235, 3240]


def test_numbers_written_as_words_of_yaml_1_1_are_numbers(scenario: Path) -> None:
    path = scenario / "641" / "00068.yaml"
    text = path.read_text()
    assert "ego_speed: -18.0" in text
    path.write_text(text.replace("ego_speed: -18.0", "ego_speed: 36e-1"))  # yaml 1.1 reads a string here
    assert Opv2vRecording(scenario).snapshot("drive", 0).frames[1].speed_mps == pytest.approx(1.0)


def test_an_agents_own_box_is_ignored(scenario: Path) -> None:
    edit(scenario / "641" / "00068.yaml", lambda c: c["vehicles"].update({641: c["vehicles"][700]}))
    truth = Opv2vRecording(scenario).snapshot("drive", 0).truth
    assert truth is not None and truth.boxes.id.tolist()[0] == 641
    assert truth.seen[:, 0].tolist() == [True, False, True]  # 1045 and the pole list it, 641 does not
    assert truth.boxes.center[0, :2].tolist() == pytest.approx([100.4, -50.3])


@pytest.mark.parametrize("pose", [None, "sensor"])
def test_the_height_of_a_pole_is_estimated_from_its_cloud_without_a_pose(scenario: Path, pose: str | None) -> None:
    for stem in ("00068", "00070"):
        edit(
            scenario / "-1" / f"{stem}.yaml",
            lambda c: c.update(true_ego_pos=c["lidar_pose"]) if pose else c.pop("true_ego_pos"),
        )
    recording = Opv2vRecording(scenario)
    assert recording.snapshot("drive", 0).frames[2].sensor_height_m == pytest.approx(4.3, abs=1e-4)
    assert bool((count_points_in_listed_boxes(recording.snapshot("drive", 0)) != 0).all())
    # The first cloud decides for all frames, whichever is read first: else the road would jump.
    write_ascii(scenario / "-1" / "00070.pcd", scan(-1) + (0, 0, 1))
    assert Opv2vRecording(scenario).snapshot("drive", 1).frames[2].sensor_height_m == pytest.approx(4.3, abs=1e-4)
    write_ascii(scenario / "-1" / "00068.pcd", scan(-1)[:50])
    assert Opv2vRecording(scenario).snapshot("drive", 1).frames[2].sensor_height_m == 1.9


def drive_frame(index: int = 0, agents: tuple[int, ...] = (1, 10, 9, -2)) -> Snapshot:
    """Four agents anywhere, boxes with ids in order, every box seen by an agent."""
    rng = np.random.default_rng(index)
    count = 12
    boxes = Boxes.of(
        torch.from_numpy(rng.normal(0, 800, (count, 3))),
        torch.from_numpy(rng.uniform(1, 12, (count, 3))),
        torch.from_numpy(rng.uniform(-3.1, 3.1, count)),
        label=torch.arange(count) % 4,
        id=torch.arange(count) + 20,
    )
    frames, poses = [], []
    for agent in agents:
        angles = torch.from_numpy(rng.uniform((-0.1, -0.1, -3.1), (0.1, 0.1, 3.1)))
        pose = Transform.from_rpy(torch.from_numpy(rng.normal(0, 1000, 3)), *angles)
        cloud = PointCloud.of(
            torch.from_numpy(rng.normal(0, 40, (500, 3))), torch.from_numpy(rng.integers(0, 256, 500) / 255)
        )
        time = 1_000_000_000 + index * 100_000_000
        height = 5.1 if agent < 0 else 1.73
        frames.append(
            AgentFrame(agent, time, cloud, pose, torch.zeros(3, 3, dtype=torch.float64), height, 1e-6, agent < 0)
        )
        poses.append(pose)
    seen = torch.from_numpy(rng.uniform(size=(len(agents), count)) < 0.5)
    seen[0, ~seen.any(0)] = True
    return Snapshot("drive", index, tuple(frames), GroundTruth(boxes, seen, Transform.stack(poses)))


def assert_same(one: Snapshot, other: Snapshot) -> None:
    assert (one.scenario, one.index) == (other.scenario, other.index)
    assert one.truth is not None and other.truth is not None and torch.equal(one.truth.seen, other.truth.seen)
    for name in ("center", "size", "yaw", "score"):
        assert torch.allclose(getattr(one.truth.boxes, name), getattr(other.truth.boxes, name), atol=1e-4, rtol=0)
    assert torch.equal(one.truth.boxes.label, other.truth.boxes.label)
    assert torch.equal(one.truth.boxes.id, other.truth.boxes.id)
    assert len(one.frames) == len(other.frames)
    for a, b in zip(one.frames, other.frames):
        assert (a.agent_id, a.timestamp_ns, a.is_infrastructure) == (b.agent_id, b.timestamp_ns, b.is_infrastructure)
        assert torch.allclose(a.world_from_agent.matrix(), b.world_from_agent.matrix(), atol=1e-4, rtol=0)
        assert (a.sensor_height_m, a.speed_mps) == pytest.approx((b.sensor_height_m, b.speed_mps), abs=1e-6)
        assert torch.allclose(a.points.xyz, b.points.xyz, atol=1e-3, rtol=0)
        assert torch.equal(a.points.intensity, b.points.intensity)
        assert torch.equal(b.points.time_s, torch.zeros(len(b.points)))


def test_written_recordings_round_trip(tmp_path: Path) -> None:
    snapshots = [drive_frame(i) for i in range(3)]
    writer = Opv2vWriter(tmp_path / "drive")
    for snapshot in snapshots:
        writer.write(snapshot)
    writer.close({"history_frames": 1, "seed": np.int64(3), "towns": ("Town05",)})
    assert sorted(p.name for p in tmp_path.rglob("*.pcd"))[::4] == ["000020.pcd", "000022.pcd", "000024.pcd"]
    recording = Opv2vRecording(tmp_path / "drive", strict=True)
    assert recording.eval_indices("drive") == range(1, 3)
    for index, snapshot in enumerate(snapshots):
        assert_same(snapshot, recording.snapshot("drive", index))
    protocol = yaml.safe_load((tmp_path / "drive" / "data_protocol.yaml").read_text())
    assert protocol == {
        "history_frames": 1,
        "seed": 3,
        "towns": ["Town05"],
        "world": {"fixed_delta_seconds": 0.05},
    }


def test_the_writers_yaml_has_every_key_of_the_format_but_cameras(tmp_path: Path) -> None:
    snapshot = drive_frame()
    speeds = torch.arange(12) * 1.0
    Opv2vWriter(tmp_path).write(snapshot, speeds)
    for row, frame in enumerate(snapshot.frames):
        content = yaml.safe_load((tmp_path / str(frame.agent_id) / "000020.yaml").read_text())
        wanted = set(metadata(641)) - {"camera0"}
        assert set(content) == wanted and content["RSU"] is (frame.agent_id < 0)
        assert content["ego_speed"] == pytest.approx(3.6e-6)  # a number, not the string that yaml 1.1 sees in 3.6e-06
        assert content["plan_trajectory"] == []
        assert snapshot.truth is not None
        assert list(content["vehicles"]) == snapshot.truth.boxes.id[snapshot.truth.seen[row]].tolist()
        for id, vehicle in content["vehicles"].items():
            assert set(vehicle) == {"angle", "center", "extent", "location", "speed", "obj_type"}
            assert vehicle["speed"] == pytest.approx(3.6 * (id - 20))
        height = world_from_lidar(tuple(content["lidar_pose"])) @ (0, 0, -frame.sensor_height_m, 1)
        assert content["true_ego_pos"][:3] == pytest.approx(height[:3])


def test_the_same_snapshot_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        writer = Opv2vWriter(tmp_path / name)
        writer.write(drive_frame())
        writer.close({})
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(files) == 9
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


@pytest.mark.parametrize("lists_agents", [False, True])
def test_an_agent_never_lists_itself_but_others_list_it(tmp_path: Path, lists_agents: bool) -> None:
    snapshot = drive_frame(agents=(1, 21))
    assert snapshot.truth is not None
    truth = replace(snapshot.truth, seen=torch.ones(2, 12, dtype=torch.bool))
    Opv2vWriter(tmp_path / "drive", lists_agents=lists_agents).write(replace(snapshot, truth=truth))
    found = Opv2vRecording(tmp_path / "drive").snapshot("drive", 0).truth
    assert found is not None and found.boxes.id.tolist() == list(range(20, 32))
    assert found.seen[0].all() and found.seen[1].tolist() == [id != 21 for id in range(20, 32)]


def test_agents_bodies_stand_apart_from_vehicles_as_opv2v_has_them(tmp_path: Path) -> None:
    snapshot = drive_frame(agents=(22, 21, -1))
    assert snapshot.truth is not None
    snapshot = replace(snapshot, truth=replace(snapshot.truth, seen=torch.ones(3, 12, dtype=torch.bool)))
    for name, lists_agents in (("apart", False), ("listed", True)):
        Opv2vWriter(tmp_path / name, lists_agents=lists_agents).write(snapshot)
    for agent in (22, 21, -1):
        apart, listed = (
            yaml.safe_load((tmp_path / name / str(agent) / "000020.yaml").read_text()) for name in ("apart", "listed")
        )
        bodies = apart.pop("agent_bodies")
        assert set(bodies) == {21, 22} - {agent} and not {21, 22} & set(apart["vehicles"])
        assert listed["vehicles"] == apart["vehicles"] | bodies and "agent_bodies" not in listed
        assert {key: value for key, value in listed.items() if key != "vehicles"} == {
            key: value for key, value in apart.items() if key != "vehicles"
        }
    one, other = (Opv2vRecording(tmp_path / name).snapshot(name, 0) for name in ("apart", "listed"))
    assert_same(replace(one, scenario="listed"), other)


def test_damaged_bodies_of_agents_are_named(tmp_path: Path) -> None:
    Opv2vWriter(tmp_path / "drive").write(drive_frame(agents=(1, 21)))
    edit(tmp_path / "drive" / "1" / "000020.yaml", lambda c: c.update(agent_bodies=[1]))
    with pytest.raises(RecordingError, match="a mapping at 'agent_bodies'"):
        Opv2vRecording(tmp_path / "drive").snapshot("drive", 0)
    edit(tmp_path / "drive" / "1" / "000020.yaml", lambda c: c.update(agent_bodies={21: {"angle": [0, 0, 0]}}))
    with pytest.raises(RecordingError, match=r"'agent_bodies.21.location' with 3 numbers"):
        Opv2vRecording(tmp_path / "drive").snapshot("drive", 0)


def test_the_true_pose_and_the_reported_pose_are_written(tmp_path: Path) -> None:
    snapshot = drive_frame(agents=(1,))
    reported = replace(snapshot.frames[0], world_from_agent=Transform.from_xyz_yaw(7.0, 8.0, 9.0, 0.5))
    Opv2vWriter(tmp_path / "drive").write(replace(snapshot, frames=(reported,)))
    assert_same(snapshot, Opv2vRecording(tmp_path / "drive").snapshot("drive", 0))
    content = yaml.safe_load((tmp_path / "drive" / "1" / "000020.yaml").read_text())
    assert content["predicted_ego_pos"] == pytest.approx([7, -8, 9, 0, -math.degrees(0.5), 0])


def test_a_frame_without_truth_lists_nothing(tmp_path: Path) -> None:
    Opv2vWriter(tmp_path / "drive").write(replace(drive_frame(), truth=None))
    truth = Opv2vRecording(tmp_path / "drive").snapshot("drive", 0).truth
    assert truth is not None and len(truth.boxes) == 0 and truth.seen.shape == (4, 0)


@pytest.mark.parametrize(
    ("change", "message_match"),
    [
        (lambda s: replace(s, frames=(replace(s.frames[0], timestamp_ns=1_010_000_000),)), "multiple of 0.05 s"),
        (lambda s: replace(s, frames=s.frames[:1] * 2), "ids that occur once"),
        (lambda s: replace(s, frames=(replace(s.frames[0], agent_id=-5),)), "a vehicle: OPV2V gives infrastructure"),
        (lambda s: replace(s, frames=(replace(s.frames[3], agent_id=5),)), "is infrastructure: OPV2V gives"),
        (lambda s: replace(s, truth=replace(s.truth, boxes=replace(s.truth.boxes, id=s.truth.boxes.id * 0))), "once"),
    ],
)
def test_the_writer_rejects_content_beyond_the_format(
    tmp_path: Path, change: Callable[[Snapshot], Snapshot], message_match: str
) -> None:
    with pytest.raises(RecordingError, match=message_match):
        Opv2vWriter(tmp_path).write(change(drive_frame()))


def test_the_protocol_must_agree_with_the_frames(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"is 0\.1, but the frames were written with 0\.05"):
        Opv2vWriter(tmp_path).close({"world": {"fixed_delta_seconds": 0.1}})


def test_the_body_lies_half_a_metre_ahead_of_the_lidar(dataset: Path, scenario: Path) -> None:
    frames = Opv2vRecording(dataset, "train").snapshot("2021_08_16_22_26_54", 0).frames
    for frame in frames[:2]:
        assert frame.body is not None and frame.body.center == pytest.approx((0.5, 0.0, 0.75), abs=1e-6)
        assert frame.body.yaw_rad == pytest.approx(0.0, abs=1e-6)
    assert frames[2].is_infrastructure and frames[2].body is None
    edit(scenario / "641" / "00068.yaml", lambda c: c.pop("true_ego_pos"))
    edit(scenario / "1045" / "00068.yaml", lambda c: c.update(true_ego_pos=[0.0] * 6))
    assert [frame.body for frame in Opv2vRecording(scenario).snapshot("drive", 0).frames] == [None] * 3
