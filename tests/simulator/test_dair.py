# SPDX-License-Identifier: Apache-2.0
"""A simulated crossing in DAIR-V2X's layout: the simulator's truth comes back, and a wrong reader does not hide."""

import hashlib
import json
import math
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("libsumo", reason="scenarios need the sim extra")

from manyeyes.datasets.dair_v2x import DairRecording, json_files, reader
from manyeyes.datasets.formats.pcd import PcdCloud, read_table
from manyeyes.datatypes import ConfigError, RecordingError, Transform
from manyeyes.simulator import dair
from manyeyes.simulator.dair import record_dair
from manyeyes.simulator.presets import make_jobs, simulation_preset
from manyeyes.simulator.record import Job, RecordingProgress, make_first_scenario
from manyeyes.simulator.scene.scenario import ScenarioSpec, SimulatedScenario

pytestmark = pytest.mark.slow


SPEC = ScenarioSpec(
    town="generated-1",
    seed=7,
    name="one",
    vehicles=1,
    frames=2,
    history_frames=0,
    roadside_chance=1.0,
    lidar="dair-vehicle",
    roadside_lidar="dair-infrastructure",
    min_vehicles=6,
)
JOBS = [Job("train", SPEC), Job("val", replace(SPEC, name="two", frames=1))]


@pytest.fixture(scope="module", autouse=True)
def scenes_made_once() -> Iterator[None]:
    """Making a scene takes seconds; every test of this process shares them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dair, "make_first_scenario", remembered)
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, scenes_made_once: None) -> Path:
    return record_dair(JOBS, tmp_path_factory.mktemp("dair"), workers=1).parent


@lru_cache
def remembered(spec: ScenarioSpec, towns: str | None, roadside: bool) -> SimulatedScenario:
    return make_first_scenario(spec, towns, roadside)


def files(root: Path) -> dict[str, bytes]:
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def unmet(recording: DairRecording) -> int:
    """How many vehicles that a side lists hold none of its points."""
    count = 0
    for frame, boxes in zip(recording.snapshot("0", 1).frames, recording.side_boxes("0", 1)):
        local = boxes.transform(frame.world_from_agent.inverse())
        count += int((local.contains(frame.points.xyz.double(), 0.1).sum(1) == 0).sum())
    return count


def test_the_simulators_ground_truth_round_trips(made: Path) -> None:
    recording = DairRecording(made, strict=True)
    assert recording.scenarios == ("0", "1")
    assert DairRecording(made, "train").scenarios == ("0",) and DairRecording(made, "val").length("1") == 1
    scenario = dair.make_first_scenario(replace(SPEC, frames=10, rate_hz=50.0), None, roadside=True)
    read = recording.snapshot("0", 1)
    assert read.truth is not None
    vehicle = scenario.snapshot(9)
    lag = (read.frames[0].timestamp_ns - read.frames[1].timestamp_ns) // 20_000_000
    assert lag in (0, 1)
    unit = scenario.snapshot(9 - lag)
    for one, two in zip(read.frames, (vehicle.frames[0], unit.frames[1])):
        assert one.timestamp_ns == two.timestamp_ns
        torch.testing.assert_close(one.points.xyz, two.points.xyz, atol=1e-4, rtol=0)
        torch.testing.assert_close(one.points.intensity, two.points.intensity, atol=0.003, rtol=0)
        torch.testing.assert_close(one.world_from_agent.matrix(), two.world_from_agent.matrix(), atol=1e-9, rtol=0)
    assert read.frames[0].speed_mps == pytest.approx(vehicle.frames[0].speed_mps, abs=0.5)
    true, earlier = vehicle.truth, unit.truth
    assert true is not None and earlier is not None
    by_pole = torch.isin(true.boxes.id, earlier.boxes.id[earlier.seen[1]])
    either = true.seen[0] | by_pole
    own = true.boxes.id[either] == scenario.agents[0]
    assert torch.equal(read.truth.boxes.id, torch.where(own, 0, true.boxes.id[either]))
    assert torch.equal(read.truth.boxes.label, true.boxes.label[either])
    torch.testing.assert_close(read.truth.boxes.corners(), true.boxes[either].corners(), atol=1e-9, rtol=0)
    assert torch.equal(read.truth.seen, torch.stack([true.seen[0], by_pole])[:, either])


def test_a_tilted_sensor_is_read_back_as_such(tmp_path: Path) -> None:
    spec = replace(SPEC, lidar="dair-pandar40p", frames=1)
    dair.record_dair([Job("train", spec)], tmp_path)
    read = DairRecording(tmp_path, strict=True).snapshot("0", 0)
    scenario = dair.make_first_scenario(replace(spec, frames=5, rate_hz=50.0), None, roadside=True)
    true = scenario.snapshot(4).frames[0]
    pose = read.frames[0].world_from_agent
    torch.testing.assert_close(pose.matrix(), true.world_from_agent.matrix(), atol=1e-9, rtol=0)
    assert math.degrees(math.atan2(-float(pose.rotation[2, 0]), float(pose.rotation[2, 2]))) == pytest.approx(0.78)
    torch.testing.assert_close(read.frames[0].points.xyz, true.points.xyz, atol=1e-4, rtol=0)


def test_a_mirrored_or_transposed_reader_shows(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert unmet(DairRecording(made)) == 0
    read_pcd, motion = reader.read_pcd, json_files._motion

    def mirrored(path: Path, drop_nan: bool = False) -> PcdCloud:
        found = read_pcd(path, drop_nan)
        return PcdCloud(found.xyz * np.float32([1, -1, 1]), found.intensity, found.time_s)

    def transposed(path: Path, content: object) -> Transform:
        found = motion(path, content)
        return Transform(found.rotation.mT, found.translation)

    with monkeypatch.context() as patch:
        patch.setattr(reader, "read_pcd", mirrored)
        assert unmet(DairRecording(made)) > 5
    # Points and labels of one side turn together: it is the two sides that no longer agree.
    whole = DairRecording(made).snapshot("0", 1).truth
    assert whole is not None
    with monkeypatch.context() as patch:
        patch.setattr(json_files, "_motion", transposed)
        truth = DairRecording(made).snapshot("0", 1).truth
        assert truth is not None
        assert int((truth.seen & whole.seen).sum()) < int(whole.seen.sum()) // 2


def test_the_sensors_are_those_of_dair(made: Path) -> None:
    vehicle = read_table(made / "vehicle-side/velodyne/000000.pcd")
    pole = read_table(made / "infrastructure-side/velodyne/000000.pcd")
    assert vehicle.names == ("x", "y", "z", "intensity", "timestamp") and pole.names == ("x", "y", "z", "intensity")
    x, y, z = (c.astype(np.float64) for c in vehicle.columns[:3])
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    assert len(np.unique(np.rint(elevation / (23 / 39)))) == 40, "forty beams"
    assert float(pole.columns[0].min()) >= 0, "it looks one way"
    assert float(pole.columns[3].min()) >= 0 and float(pole.columns[3].max()) <= 1
    assert vehicle.columns[3].max() > 100


def test_the_manifest_counts_and_hashes_what_is_there(made: Path) -> None:
    content = json.loads((made / "manifest.json").read_text())
    assert content["format"] == "DAIR-V2X"
    assert [(s["batch"], s["name"], s["split"], s["frames"]) for s in content["scenarios"]] == [
        (0, "one", "train", 2),
        (1, "two", "val", 1),
    ]
    stems = {0: ("000000", "000001"), 1: ("000002",)}
    for entry in content["scenarios"]:
        inside = {n: d for n, d in files(made).items() if Path(n).stem in stems[entry["batch"]] and "batches" not in n}
        lines = [f"{hashlib.sha256(data).hexdigest()}  {name}" for name, data in inside.items()]
        assert entry["sha256"] == hashlib.sha256("\n".join(lines).encode()).hexdigest()
        assert entry["files"] == len(inside) == 9 * entry["frames"]
        assert entry["bytes"] == sum(map(len, inside.values()))


def test_finished_drives_are_kept_and_missing_ones_simulated_again(made: Path) -> None:
    before = files(made)
    kept = (made / "batches/000000.json").stat().st_mtime_ns
    (made / "batches/000001.json").unlink()
    (made / "manifest.json").rename(made / "manifest.partial.json")
    (made / "vehicle-side/velodyne/000002.pcd").unlink()
    seen: list[RecordingProgress] = []
    record_dair(JOBS, made, workers=1, progress=seen.append)
    assert files(made) == before
    assert (made / "batches/000000.json").stat().st_mtime_ns == kept
    assert [p.name for p in seen] == ["train/one", "val/two"]


def test_another_run_is_refused_and_nothing_changes(made: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(made, tmp_path / "copy"))
    before = files(root)
    with pytest.raises(ConfigError, match=r"2 finished scenarios of no named settings .* this run makes 2 of seed 5"):
        record_dair(JOBS, root, settings={"seed": 5})
    with pytest.raises(ConfigError, match=r"batches/000000.json has seed 7 instead of 8"):
        record_dair([Job("train", replace(SPEC, seed=8)), JOBS[1]], root)
    shutil.rmtree(root / "batches")
    (root / "manifest.json").unlink()
    with pytest.raises(ConfigError, match="1 scenario folder that no run of 'manyeyes simulate' for this layout wrote"):
        record_dair(JOBS, root)
    shutil.copytree(made / "batches", root / "batches")
    shutil.copyfile(made / "manifest.json", root / "manifest.json")
    assert files(root) == before


@pytest.mark.parametrize("older", [False, True])
def test_damaged_files_of_finished_drives_are_named(made: Path, tmp_path: Path, older: bool) -> None:
    root = Path(shutil.copytree(made, tmp_path / "copy"))
    path = root / "vehicle-side" / "velodyne" / "000001.pcd"
    path.write_bytes(path.read_bytes()[::-1])
    if older:  # a version that noted the digest of all files together
        batch = root / "batches" / "000000.json"
        content = json.loads(batch.read_text())
        del content["files"]
        batch.write_text(json.dumps(content))
    assert [problem.kind for problem in DairRecording(root).verify().files] == ["mismatched"]
    with pytest.raises(RecordingError, match=r"mismatched in the finished scenario train/one .* add --repair"):
        record_dair(JOBS, root)
    record_dair(JOBS, root, on_repair=lambda problem: None)
    assert files(root) == files(made)
    assert DairRecording(root).verify().count == 0


def test_lost_drives_and_index_files_are_repaired_by_the_manifest(made: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(made, tmp_path / "copy"))
    damaged = ("batches/000001.json", "vehicle-side/data_info.json", "cooperative/data_info.json")
    (root / damaged[0]).unlink()
    with pytest.raises(RecordingError, match=r"000001.json: missing in the finished scenario val/two .* add --repair"):
        record_dair(JOBS, root)
    repaired: list[str] = []
    record_dair(JOBS, root, on_repair=lambda problem: repaired.append(problem.path.relative_to(root).as_posix()))
    (root / damaged[1]).unlink()
    (root / damaged[2]).write_text("[]")
    with pytest.raises(
        RecordingError, match=r"vehicle-side.data_info.json: missing .*; also .*cooperative.* add --repair"
    ):
        record_dair(JOBS, root)
    record_dair(JOBS, root, on_repair=lambda problem: repaired.append(problem.path.relative_to(root).as_posix()))
    assert files(root) == files(made) and repaired == list(damaged)


def test_two_processes_write_the_same_bytes(made: Path, tmp_path: Path) -> None:
    record_dair(JOBS, tmp_path, workers=2)
    assert files(tmp_path) == files(made)


def test_the_preset_is_one_vehicle_and_a_pole() -> None:
    jobs = make_jobs(simulation_preset("dair-crossing"), 0)
    assert {job.split: sum(j.split == job.split for j in jobs) for job in jobs} == {"train": 24, "val": 8, "test": 8}
    for job in jobs:
        assert (job.spec.vehicles, job.spec.roadside_chance) == (1, 1.0)
        assert (job.spec.lidar, job.spec.roadside_lidar) == ("dair-vehicle", "dair-infrastructure")
        assert job.spec.history_frames == 0


@pytest.mark.parametrize(
    ("change", "workers", "message"),
    [(lambda s: s, 0, "workers >= 1"), (lambda s: replace(s, vehicles=2), 1, "one vehicle a drive")],
)
def test_misuse_is_named(
    tmp_path: Path, change: Callable[[ScenarioSpec], ScenarioSpec], workers: int, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        record_dair([Job("train", change(SPEC))], tmp_path, workers=workers)
