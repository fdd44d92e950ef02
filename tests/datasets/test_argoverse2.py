# SPDX-License-Identifier: Apache-2.0
"""Argoverse 2 on two real sweeps (tests only: CC BY-NC-SA 4.0), and on small logs of our own."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from manyeyes.agents.level_frame import LevelledFrame
from manyeyes.cli.main import main
from manyeyes.datasets.argoverse2 import Argoverse2Recording
from manyeyes.datasets.base import count_points_in_listed_boxes
from manyeyes.datatypes import LABELS, ConfigError, MissingExtraError, RecordingError, Snapshot
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY

pyarrow = pytest.importorskip("pyarrow", reason="needs the 'av2' extra")
from pyarrow import feather  # noqa: E402

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "av2"
LOG = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
SWEEPS = (315966265259836000, 315966265360032000)
real = pytest.mark.skipif(not SHARED.is_dir(), reason="the real Argoverse 2 log is not beside the repository")


@pytest.fixture(scope="module")
def recording() -> Argoverse2Recording:
    return Argoverse2Recording(SHARED, gap=1)


@pytest.fixture(scope="module")
def pair(recording: Argoverse2Recording) -> Snapshot:
    return recording.snapshot(LOG, 0)


@real
@pytest.mark.parametrize("sweep", SWEEPS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_in_each_of_the_81_boxes_are_as_many_as_av2_counted(
    recording: Argoverse2Recording, sweep: int, dtype: torch.dtype
) -> None:
    labelled = recording.annotations(LOG, sweep)
    inside = labelled.boxes.to(dtype).contains(recording.points(LOG, sweep).xyz.to(dtype)).sum(-1)
    assert len(labelled.boxes) == len(labelled.category) == 81
    assert torch.equal(inside, labelled.interior_points)
    assert int((inside > 0).sum()) == 71 and int(inside.sum()) > 1000


@real
def test_the_log_as_a_recording(recording: Argoverse2Recording, pair: Snapshot) -> None:
    assert recording.scenarios == (LOG,)
    assert "3b3570b4" in recording.missing_summary[0] and "0 sweeps" in recording.missing_summary[0]
    assert recording.length(LOG) == 1 and recording.eval_indices(LOG) == range(1) and recording.agents(LOG) == (0, 1)
    assert recording.sweeps(LOG) == SWEEPS
    assert [f.agent_id for f in pair.frames] == [0, 1] and tuple(f.timestamp_ns for f in pair.frames) == SWEEPS
    assert [len(f.points) for f in pair.frames] == [99_229, 99_466]
    for frame in pair.frames:
        assert frame.points.intensity.min() >= 0 and frame.points.intensity.max() <= 1
        assert 0.09 < frame.points.time_s.max() - frame.points.time_s.min() < 0.11  # one turn at 10 Hz
    assert Argoverse2Recording(SHARED / LOG).scenarios == (LOG,)


@real
def test_ground_truth_lists_objects_by_class_and_the_agents_with_returns(
    recording: Argoverse2Recording, pair: Snapshot
) -> None:
    assert pair.truth is not None
    assert len(pair.truth.boxes) == len(pair.truth.boxes.id.unique()) == 72
    assert torch.bincount(pair.truth.boxes.label, minlength=7).tolist() == [44, 0, 3, 0, 15, 7, 3]
    vehicles = replace(pair, truth=pair.truth.of_classes())
    assert vehicles.truth is not None and len(vehicles.truth.boxes) == 47
    counts = count_points_in_listed_boxes(vehicles, 0.1)
    # Boxes are those of the ego's time; what drives on for 0.1 s still holds points of the second sweep, almost always.
    assert int((counts[0] == 0).sum()) == 0 and int((counts[1] == 0).sum()) <= 2
    assert counts.max() > 500 and vehicles.truth.seen.sum(1).tolist() == [40, 40]
    assert int((count_points_in_listed_boxes(pair, 0.1)[0] == 0).sum()) == 0


@real
def test_zero_is_the_road_under_the_agent(pair: Snapshot) -> None:
    for frame in pair.frames:
        xyz = frame.points.xyz.double()
        near = xyz[((xyz[:, :2] - torch.tensor([1.35, 0.0])).norm(dim=-1) < 8) & (xyz[:, 2].abs() < 0.3)]
        plane = torch.cat((near[:, :2], torch.ones(len(near), 1, dtype=torch.float64)), 1)
        for _ in range(5):  # least squares, then again on what lies within 6 cm
            fit = torch.linalg.lstsq(plane, near[:, 2:]).solution
            close = (plane @ fit - near[:, 2:]).abs()[:, 0] < 0.06
            plane, near = plane[close], near[close]
        assert len(near) > 3000 and abs(float(fit[2])) < 0.03


@real
def test_the_second_sweep_lies_on_the_first_by_the_true_relative_pose(pair: Snapshot) -> None:
    spatial = pytest.importorskip("scipy.spatial")
    first, second = pair.frames
    relative = first.world_from_agent.inverse() @ second.world_from_agent
    tree = spatial.cKDTree(first.points.xyz.numpy())
    cloud = second.points.xyz.double()[::5]

    def distance(points: torch.Tensor) -> float:
        still = (points[:, 2] > 0.5) & (points[:, :2].norm(dim=-1) < 50)  # walls and parked cars, not the road's rings
        return float(np.median(tree.query(points[still].numpy())[0]))

    moved, unmoved, backwards = (distance(c) for c in (relative.apply(cloud), cloud, relative.inverse().apply(cloud)))
    assert moved < 0.05  # float16 gives 3 cm at 50 m
    assert unmoved > 1.6 * moved and backwards > 2.5 * moved
    # AV2's own relative motion, shipped with the pair, maps the first onto the second, in the frame of the axle.
    stated = torch.from_numpy(np.load(SHARED / LOG / "ego_motion.npz")["ego_motion"][0]).double()
    assert torch.allclose(relative.inverse().rotation, stated[:3, :3], atol=1e-4)
    assert torch.allclose(relative.inverse().translation, stated[:3, 3], atol=5e-3)
    assert first.speed_mps == pytest.approx(float(stated[:3, 3].norm()) / 0.1, abs=0.3)


def write_log(folder: Path, yaw: float = 1.0, speed: float = 10.0) -> Path:
    """Three sweeps of an ego that drives along its own x axis, a car, a bus and a walker standing in the city."""
    (folder / "sensors" / "lidar").mkdir(parents=True)
    times = np.array([1_000_000_000, 1_100_000_000, 1_200_000_000])
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    ego = np.array([500.0, 300.0]) + np.arange(3)[:, None] * 0.1 * speed * ahead
    still = np.array([[20.0, 4.0], [30.0, -5.0], [8.0, 2.0]])  # in the first ego frame
    rows = []
    for i, time in enumerate(times):
        inside = still - (0.1 * speed * i, 0)
        axes = {"x": inside[:, 0], "y": inside[:, 1], "z": np.full(3, 0.5)}
        columns = {k: v.astype(np.float16) for k, v in axes.items()}
        columns |= {"intensity": np.full(3, 51, np.uint8), "laser_number": np.zeros(3, np.uint8)}
        columns["offset_ns"] = np.full(3, 20_000_000, np.int32)
        feather.write_feather(pyarrow.table(columns), folder / "sensors" / "lidar" / f"{time}.feather")
        for track, category, place in zip("cab", ("REGULAR_VEHICLE", "BUS", "PEDESTRIAN"), inside):
            rows.append((time, track, category, 4.0, 2.0, 1.6, 1.0, 0.0, 0.0, 0.0, *place, 0.5, 1))
    names = "timestamp_ns track_uuid category length_m width_m height_m qw qx qy qz tx_m ty_m tz_m num_interior_pts"
    table = {n: [r[i] for r in rows] for i, n in enumerate(names.split())}
    feather.write_feather(pyarrow.table(table), folder / "annotations.feather")
    poses = {"timestamp_ns": times, "qw": np.full(3, np.cos(yaw / 2)), "qx": np.zeros(3), "qy": np.zeros(3)}
    poses |= {"qz": np.full(3, np.sin(yaw / 2)), "tx_m": ego[:, 0], "ty_m": ego[:, 1], "tz_m": np.full(3, 10.0)}
    feather.write_feather(pyarrow.table(poses), folder / "city_SE3_egovehicle.feather")
    return folder


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "logs" / "abc")


def test_a_log_by_hand(log: Path) -> None:
    recording = Argoverse2Recording(log.parent, gap=1)
    assert recording.scenarios == ("abc",) and recording.length("abc") == 2
    snapshot = recording.snapshot("abc", 1)
    assert [f.timestamp_ns for f in snapshot.frames] == [1_100_000_000, 1_200_000_000]
    first = snapshot.frames[0]
    assert first.speed_mps == pytest.approx(10.0)
    assert first.points.intensity.tolist() == pytest.approx([0.2] * 3)
    assert first.points.time_s.tolist() == pytest.approx([0.02] * 3)
    # 0.5 m above the axle is 0.83 m above the road, and the road is at 10 - 0.33 m in the city.
    assert first.points.xyz[0].tolist() == pytest.approx([19, 4, 0.83])
    assert first.world_from_agent.translation[2] == pytest.approx(9.67)
    assert snapshot.truth is not None
    # In the order of their tracks.
    assert [LABELS[i] for i in snapshot.truth.boxes.label] == ["bus", "pedestrian", "car"]
    assert snapshot.truth.boxes.yaw.tolist() == pytest.approx([1.0, 1.0, 1.0])
    wanted = 500 + 20 * np.cos(1.0) - 4 * np.sin(1.0), 300 + 20 * np.sin(1.0) + 4 * np.cos(1.0), 10.5
    assert snapshot.truth.boxes.center[2].tolist() == pytest.approx(wanted)
    assert count_points_in_listed_boxes(snapshot).tolist() == [[1, 1, 1], [1, 1, 1]]
    # Two sweeps apart, and no label is no truth.
    assert Argoverse2Recording(log, gap=2).snapshot("abc", 0).frames[1].timestamp_ns == 1_200_000_000
    (log / "annotations.feather").unlink()
    assert Argoverse2Recording(log, gap=1).snapshot("abc", 0).truth is None


def test_without_a_gap_a_log_has_one_agent(log: Path) -> None:
    recording = Argoverse2Recording(log)
    assert recording.length("abc") == 3 and recording.agents("abc") == (0,)
    snapshot = recording.snapshot("abc", 2)
    assert [(f.agent_id, f.timestamp_ns) for f in snapshot.frames] == [(0, 1_200_000_000)]
    assert snapshot.truth is not None and snapshot.truth.seen.tolist() == [[True, True, True]]
    with pytest.raises(ConfigError, match="gap of at least 0 sweeps; got -1"):
        Argoverse2Recording(log, gap=-1)


def test_a_track_of_the_later_sweep_alone_is_in_the_truth(log: Path) -> None:
    table = feather.read_table(log / "annotations.feather")
    keep = [
        not (t == "c" and n == 1_000_000_000)
        for t, n in zip(*(table[k].to_pylist() for k in ("track_uuid", "timestamp_ns")))
    ]
    feather.write_feather(table.filter(pyarrow.array(keep)), log / "annotations.feather")
    truth = Argoverse2Recording(log, gap=1).snapshot("abc", 0).truth
    assert truth is not None and truth.seen.tolist() == [[True, True, False], [True, True, True]]


def test_a_bicycle_with_a_rider_counts_once_and_other_objects_do_not(log: Path) -> None:
    path = log / "annotations.feather"
    rows = feather.read_table(path).to_pylist()
    first = next(row for row in rows if row["timestamp_ns"] == 1_000_000_000)
    added = [
        ("d", "BICYCLE", 40.0), ("e", "BICYCLIST", 40.3), ("f", "BICYCLE", 44.0), ("g", "MOTORCYCLE", 50.0),
        ("h", "BOLLARD", 55.0), ("i", "WHEELED_RIDER", 60.0), ("j", "OFFICIAL_SIGNALER", 65.0), ("k", "RAILED_VEHICLE", 70.0),
        ("l", "REGULAR_VEHICLE", 40.2),
    ]  # fmt: skip
    rows += [first | {"track_uuid": track, "category": category, "tx_m": x} for track, category, x in added]
    feather.write_feather(pyarrow.Table.from_pylist(rows), path)
    recording = Argoverse2Recording(log)
    truth = recording.snapshot("abc", 0).truth
    assert truth is not None
    found = [LABELS[i] for i in truth.boxes.label]
    assert found == ["bus", "pedestrian", "car", "cyclist", "cyclist", "motorcyclist", "cyclist", "pedestrian", "car"]
    labelled = recording.annotations("abc", 1_000_000_000)
    vehicles = [c for c, is_vehicle in zip(labelled.category, labelled.is_vehicle.tolist()) if is_vehicle]
    assert vehicles == ["REGULAR_VEHICLE", "BUS", "REGULAR_VEHICLE"]


def _drop_column(path: Path, name: str) -> None:
    feather.write_feather(feather.read_table(path).drop_columns([name]), path)


def _first(log: Path) -> Path:
    return log / "sensors" / "lidar" / "1000000000.feather"


def _nan(path: Path) -> None:
    table = feather.read_table(path)
    column = pyarrow.array(np.array([np.nan, 1, np.nan], np.float16))
    feather.write_feather(table.set_column(0, "x", column), path)


def _shift_poses(log: Path) -> None:
    path = log / "city_SE3_egovehicle.feather"
    table = feather.read_table(path)
    feather.write_feather(
        table.set_column(0, "timestamp_ns", pyarrow.array(table["timestamp_ns"].to_numpy() + 1)), path
    )


@pytest.mark.parametrize(
    ("damage", "message_match"),
    [
        (lambda log: (log / "city_SE3_egovehicle.feather").unlink(), "city_SE3_egovehicle.feather: no such file"),
        (lambda log: _first(log).write_bytes(_first(log).read_bytes()[:90]), "1000000000.feather: expected a feather"),
        (lambda log: _first(log).write_bytes(b""), "1000000000.feather: expected a feather"),
        (lambda log: _drop_column(_first(log), "offset_ns"), "expected the columns offset_ns, found x, y, z"),
        (lambda log: _nan(_first(log)), "1000000000.feather: 2 of 3 points are NaN"),
        (_shift_poses, "no pose at the sweep's time 1000000000"),
    ],
)
def test_damage_is_named(log: Path, damage: Callable[[Path], object], message_match: str) -> None:
    damage(log)
    with pytest.raises(RecordingError) as caught:
        Argoverse2Recording(log.parent, gap=1).snapshot("abc", 0)
    assert message_match in str(caught.value) and "\n" not in str(caught.value)


def test_a_root_without_logs_is_refused(log: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no such folder"):
        Argoverse2Recording(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match=r"no usable Argoverse 2 log .*3 sweeps.*more than 3"):
        Argoverse2Recording(log.parent, gap=3)
    with pytest.raises(RecordingError, match="No scenario 'x'"):
        Argoverse2Recording(log.parent).length("x")
    with pytest.raises(RecordingError, match="index from 0 to 1"):
        Argoverse2Recording(log.parent, gap=1).snapshot("abc", 2)


def test_splits_are_folders_of_logs(log: Path) -> None:
    assert Argoverse2Recording(log.parent.parent, "logs").scenarios == ("abc",)
    with pytest.raises(RecordingError, match="it has splits: logs"):
        Argoverse2Recording(log.parent.parent)
    with pytest.raises(RecordingError, match=r"val: no such folder.*check the path and the split"):
        Argoverse2Recording(log.parent, "val")


def test_view_replay_and_evaluate_open_a_log_of_one_agent_and_say_so(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        checkpoint.save(Detector(COSTR_TINY), tmp_path / "tiny.safetensors", {})
    played = ("--weights", tmp_path / "tiny.safetensors", "--methods", "none", "early", "--out", tmp_path / "out")
    timing = ("--workers", 1, "--timing-frames", 0)
    for words in (
        ("view", log, "--out", tmp_path / "frame.png", "--width", 320),
        ("replay", log.parent, "--no-animate", *played),
        ("evaluate", "--data", log.parent.parent, "--split", "logs", *timing, *played),
    ):
        assert main([str(word) for word in words]) == 0
        text = " ".join(capsys.readouterr().out.split())
        assert "note: no scenario has a second agent: nothing is shared" in text
    assert main(["pose", str(log), "--out", str(tmp_path)]) == 1
    assert "'abc' has one agent, poses are corrected between two" in capsys.readouterr().err
    none, early = json.loads((tmp_path / "out" / "results.json").read_text())["result"]["stats"]
    # The car of three sweeps; the bus is out of range.
    assert none["ap_summaries"] == early["ap_summaries"] and none["ap_summaries"][0]["n_gt"] == 3


def test_without_pyarrow_a_recording_is_not_opened(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'manyeyes\[av2\]'"):
        Argoverse2Recording(log.parent, gap=1)


@real
def test_the_fitted_road_is_under_the_vehicles(pair: Snapshot) -> None:
    """Boxes are labelled by people: on levelled frames their bottoms lie on z = 0, up to 50 m; on AV2's own frames they do not."""
    assert pair.truth is not None
    for row, frame in enumerate(pair.frames):
        level = LevelledFrame.of(frame)
        assert level.levelled is not frame
        error_m = []
        for some in (frame, level.levelled):
            boxes = pair.truth.boxes[pair.truth.seen[row]].transform(some.world_from_agent.inverse())
            distance = boxes.center[:, :2].norm(dim=1)
            bottom = boxes.center[:, 2] - boxes.size[:, 2] / 2
            error_m.append(float(bottom[(distance > 25) & (distance < 50)].abs().mean()))
        assert error_m[0] > 0.25 and error_m[1] < 0.15


@real
def test_the_body_is_ahead_of_the_rear_axle_and_holds_no_return(pair: Snapshot) -> None:
    for frame in pair.frames:
        assert frame.body is not None and frame.body.center == pytest.approx((1.34, 0.0, 0.74))
        assert not frame.body.contains(frame.points.xyz).any()
