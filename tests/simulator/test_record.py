# SPDX-License-Identifier: Apache-2.0
import hashlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml

pytest.importorskip("libsumo", reason="scenarios need the sim extra")

from manyeyes.datasets.base import count_points_in_listed_boxes
from manyeyes.datasets.opv2v import Opv2vRecording
from manyeyes.datatypes import ConfigError
from manyeyes.simulator.record import Job, RecordingProgress, record
from manyeyes.simulator.scene.scenario import ScenarioSpec, make_scenario
from manyeyes.simulator.scene.towns import load_town

pytestmark = pytest.mark.slow


SPEC = ScenarioSpec(
    "generated-1",
    7,
    "one",
    vehicles=1,
    frames=2,
    history_frames=1,
    roadside_chance=1.0,
    min_vehicles=6,
    intensity="material",
)
JOBS = [
    Job("train", SPEC),
    Job("train", replace(SPEC, name="two", seed=8, roadside_cameras="dair-infrastructure-small")),
]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(JOBS, tmp_path_factory.mktemp("one"), workers=1).parent


def files(root: Path) -> dict[str, bytes]:
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def test_two_processes_write_the_same_bytes(made: Path, tmp_path: Path) -> None:
    seen: list[RecordingProgress] = []
    record(JOBS, tmp_path, workers=2, progress=seen.append)
    assert files(tmp_path) == files(made)
    assert [p.done for p in seen] == [1, 2]


def test_the_manifest_states_where_bodies_of_agents_are(made: Path) -> None:
    assert json.loads((made / "manifest.json").read_text())["settings"] == {"agent_bodies": "apart"}
    assert all(b"agent_bodies:" in content for name, content in files(made).items() if name.endswith("-1/000000.yaml"))


def test_a_recording_that_lists_agents_goes_on_as_it_was_begun(tmp_path: Path) -> None:
    """As recordings of versions before the setting, whose manifest does not have it."""
    record([replace(JOBS[0], lists_agents=True), JOBS[1]], tmp_path)
    begun = files(tmp_path)
    assert json.loads(begun["manifest.json"])["settings"] == {} and not any(
        b"agent_bodies" in f for f in begun.values()
    )
    shutil.rmtree(tmp_path / "train" / "two")
    record(JOBS, tmp_path, on_repair=lambda problem: None)
    assert files(tmp_path) == begun
    (tmp_path / "manifest.json").unlink()
    record(JOBS, tmp_path)
    assert files(tmp_path) == begun
    assert Opv2vRecording(tmp_path, "train").snapshot("two", 0).truth is not None


def test_the_reader_returns_the_simulators_own_truth(made: Path) -> None:
    recording = Opv2vRecording(made, "train", strict=True, use_cache=False)
    assert recording.scenarios == ("one", "two")
    assert list(recording.eval_indices("one")) == [1]
    scenario = make_scenario(SPEC, load_town("generated-1"))
    read, true = recording.snapshot("one", 1), scenario.snapshot(1)
    assert read.truth is not None
    assert true.truth is not None
    listed = true.truth.seen.any(0)
    order = true.truth.boxes.id[listed].argsort()
    torch.testing.assert_close(read.truth.boxes.center, true.truth.boxes.center[listed][order], atol=1e-9, rtol=0)
    assert torch.equal(read.truth.boxes.label, true.truth.boxes.label[listed][order])
    for one, two in zip(read.frames, true.frames):
        torch.testing.assert_close(one.points.xyz, two.points.xyz, atol=1e-4, rtol=0)
        torch.testing.assert_close(one.points.intensity, two.points.intensity, atol=0.003, rtol=0)
    assert int((count_points_in_listed_boxes(read) == 0).sum()) == 0


def test_pictures_lie_beside_the_clouds_as_they_were_taken(made: Path) -> None:
    assert len(list((made / "train" / "two" / "-1").glob("*_camera0.png"))) == 2
    assert not list((made / "train" / "one").rglob("*.png"))
    read = Opv2vRecording(made, "train", strict=True, use_cache=False, images=True).snapshot("two", 0).frames[-1]
    true = make_scenario(JOBS[1].spec, load_town("generated-1")).snapshot(0).frames[-1]
    (one,), (two,) = read.images, true.images
    assert torch.equal(one.rgb, two.rgb)
    assert one.rgb.shape == (3, 270, 480)
    torch.testing.assert_close(
        one.camera.agent_from_camera.matrix(), two.camera.agent_from_camera.matrix(), atol=1e-9, rtol=0
    )


def test_the_manifest_counts_and_hashes_what_is_there(made: Path) -> None:
    content = json.loads((made / "manifest.json").read_text())
    assert [s["name"] for s in content["scenarios"]] == ["one", "two"]
    for entry in content["scenarios"]:
        folder = made / "train" / entry["name"]
        inside = {n: d for n, d in files(folder).items() if n != "scenario.json"}
        lines = [f"{hashlib.sha256(data).hexdigest()}  {name}" for name, data in inside.items()]
        digests = json.loads((folder / "scenario.json").read_text())["files"]
        assert digests == {name: hashlib.sha256(data).hexdigest() for name, data in inside.items()}
        assert entry["sha256"] == hashlib.sha256("\n".join(lines).encode()).hexdigest()
        assert entry["bytes"] == sum(map(len, inside.values()))
        pictures = 2 * (entry["name"] == "two")
        assert entry["files"] == len(inside) == 2 * 2 * 2 + 1 + pictures
        assert 40_000 < entry["returns"] < 60_000
        assert entry["moving"] >= 0.5


def test_finished_scenarios_are_kept_and_half_written_ones_redone(made: Path) -> None:
    before = files(made)
    kept = (made / "train" / "one" / "scenario.json").stat().st_mtime_ns
    (made / "train" / "two").rename(made / "train" / "two.partial")
    (made / "train" / "two.partial" / "scenario.json").unlink()
    (made / "manifest.json").unlink()
    record(JOBS, made, workers=1)
    assert files(made) == before
    assert (made / "train" / "one" / "scenario.json").stat().st_mtime_ns == kept


def test_recordings_from_before_intensity_laws_are_continued(made: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(made, tmp_path / "old"))
    for path in root.glob("*/*/scenario.json"):
        content = json.loads(path.read_text())
        del content["spec"]["intensity"], content["spec"]["sensor_mix"]
        path.write_text(json.dumps(content))
    before = (root / "train" / "one" / "scenario.json").stat().st_mtime_ns
    record(JOBS, root)
    assert (root / "train" / "one" / "scenario.json").stat().st_mtime_ns == before
    with pytest.raises(ConfigError, match="intensity"):
        record([replace(job, spec=replace(job.spec, intensity="carla")) for job in JOBS], root)


def test_mixed_sensors_are_read_back_with_tilt_height_and_exact_intensity(tmp_path: Path) -> None:
    spec = replace(SPEC, sensor_mix="all", rate_hz=20.0)
    record([Job("train", spec)], tmp_path)
    scenario = make_scenario(spec, load_town("generated-1"))
    true = scenario.snapshot(1)
    read = Opv2vRecording(tmp_path, "train", strict=True, use_cache=False).snapshot("one", 1)
    protocol = yaml.safe_load((tmp_path / "train" / "one" / "data_protocol.yaml").read_text())
    for one, two in zip(read.frames, true.frames, strict=True):
        torch.testing.assert_close(one.world_from_agent.matrix(), two.world_from_agent.matrix(), atol=1e-9, rtol=0)
        torch.testing.assert_close(one.points.xyz, two.points.xyz, atol=1e-4, rtol=0)
        assert torch.equal(one.points.intensity, two.points.intensity)
        assert one.sensor_height_m == pytest.approx(two.sensor_height_m, abs=1e-6)
        assert one.timestamp_ns == two.timestamp_ns == 50_000_000
        lidar = scenario.lidar(one.agent_id)
        assert protocol["lidar"][str(one.agent_id)] == lidar.describe()
        tilt = math.degrees(float(one.world_from_agent.rotation[2, 2].clamp(max=1).acos()))
        if one.is_infrastructure:
            assert tilt == pytest.approx(math.degrees(math.hypot(lidar.roll_rad, lidar.pitch_rad)), abs=0.01)
            assert 4.0 <= one.sensor_height_m <= 7.0


def test_misuse_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="workers >= 1"):
        record(JOBS, tmp_path, workers=0)
    with pytest.raises(ConfigError, match="one name"):
        record([JOBS[0], JOBS[0]], tmp_path)


_POOL = """
import multiprocessing, os, time
from concurrent.futures import ProcessPoolExecutor
from manyeyes._workers import start_worker
with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), start_worker) as pool:
    print(pool.submit(os.getpid).result(), flush=True)
    pool.submit(time.sleep, 100).result()
"""


def test_a_worker_ends_when_its_run_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", _POOL], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        worker = int(process.stdout.readline())
        process.kill()
    for _ in range(300):
        if not Path(f"/proc/{worker}").exists():
            return
        time.sleep(0.1)
    os.kill(worker, signal.SIGKILL)
    raise AssertionError("it lives on")
