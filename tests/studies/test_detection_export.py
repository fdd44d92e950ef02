# SPDX-License-Identifier: Apache-2.0
"""manyeyes export: the files of both formats hold what a replay finds, in their own frames of reference."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from manyeyes.agents.agent import Perception
from manyeyes.agents.replay import ReplayStep
from manyeyes.cli.main import main
from manyeyes.datasets.kitti import KittiRecording
from manyeyes.datasets.kitti.result_files import KittiCalibration, read_calibration, read_results
from manyeyes.datasets.nuscenes_results import read_results as read_nuscenes
from manyeyes.datasets.opv2v import Opv2vRecording, Opv2vWriter
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.studies.detection_export import KittiExport, NuscenesExport

BOXES = Boxes.of(
    [[12.0, 3.0, 0.75], [-9.0, -6.0, 1.1]], [[4.2, 1.7, 1.5], [5.1, 1.9, 2.2]], [0.4, -2.1], [0.4, 0.8], [0, 1]
)


def snapshot(scenario: str = "s", index: int = 3) -> Snapshot:
    pose = Transform.from_xyz_yaw(100.0, -50.0, 7.0, 2.0)
    frame = AgentFrame.of(np.ones((5, 3)), pose, 0, index * 10**8, sensor_height_m=2.1)
    truth = GroundTruth(Boxes.empty(torch.float64), torch.ones(1, 0, dtype=torch.bool), Transform.stack([pose]))
    return Snapshot(scenario, index, (frame,), truth)


def step(of: Snapshot, boxes: Boxes) -> ReplayStep:
    return ReplayStep("late", of, 0, Perception(boxes, ()), (), (), 0.0)


def test_kitti_without_calibrations_gets_a_camera_at_the_lidar(tmp_path: Path) -> None:
    export = KittiExport(tmp_path, ("late",), Recording())
    export.add(step(snapshot(), BOXES), BOXES)
    export.close()
    assert export.counts == {"late": 2}
    found = sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*.txt"))
    assert found == ["late/s/calib/000003.txt", "late/s/data/000003.txt"]
    calibration = read_calibration(tmp_path / found[0])
    read = read_results(tmp_path / found[1], calibration, 2.1)
    assert torch.allclose(read.center, BOXES.center[[1, 0]].double(), atol=2e-4)
    # 12 m ahead, 3 m to the left: x = -3, z = 12, and the road is 2.1 m below the camera.
    assert (tmp_path / found[1]).read_text().splitlines()[1].split()[11:14] == ["-3.0000", "2.1000", "12.0000"]


class Recording(Opv2vRecording):
    """A recording whose files are not read."""

    def __init__(self) -> None:
        self.scenarios = ("s",)


def test_kitti_frames_keep_their_numbers_and_calibrations(tmp_path: Path) -> None:
    root = tmp_path / "kitti" / "training"
    for name, content in (("velodyne/000012.bin", np.ones((4, 4), "<f4").tobytes()), ("label_2/000012.txt", b"")):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)
    turned = KittiCalibration.of_lidar()
    turned = replace(turned, camera_from_lidar=turned.camera_from_lidar @ Transform.from_xyz_yaw(-0.3, 0.1, 0.1, 0.02))
    (root / "calib").mkdir()
    (root / "calib" / "000012.txt").write_text(turned.to_text())
    recording = KittiRecording(tmp_path / "kitti")
    export = KittiExport(tmp_path / "out", ("late",), recording)
    export.add(step(recording.snapshot("000012", 0), BOXES), BOXES)
    path = tmp_path / "out" / "late" / "data" / "000012.txt"
    assert [p for p in (tmp_path / "out").rglob("*") if p.is_file()] == [path]
    assert torch.allclose(read_results(path, turned, 1.73).center, BOXES.center[[1, 0]].double(), atol=2e-4)


def test_nuscenes_boxes_are_in_the_world(tmp_path: Path) -> None:
    export = NuscenesExport(tmp_path, ("late",))
    export.add(step(snapshot(), BOXES), BOXES)
    export.add(step(snapshot(index=4), BOXES), BOXES[:0])
    export.close()
    samples = read_nuscenes(tmp_path / "late" / "results_nusc.json")
    assert set(samples) == {"s_000003", "s_000004"} and len(samples["s_000004"]) == 0
    best = samples["s_000003"][:1]
    c, s = math.cos(2.0), math.sin(2.0)
    assert best.center[0].tolist() == pytest.approx([100 - 9 * c + 6 * s, -50 - 9 * s - 6 * c, 8.1])
    assert float(best.yaw) == pytest.approx(-0.1) and best.size[0].tolist() == pytest.approx([5.1, 1.9, 2.2])


def test_the_command_writes_both_formats_of_the_same_boxes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    writer = Opv2vWriter(tmp_path / "data" / "test" / "a")
    for index in range(3):
        pose, other = Transform.from_xyz_yaw(1.0 * index, 0, 0, 0.3), Transform.from_xyz_yaw(15, 4, 0, 3.0)
        clouds = [
            (torch.rand(900, 3, generator=torch.Generator().manual_seed(10 * id + index)) - 0.5)
            * torch.tensor([50, 50, 0.02])
            for id in (5, 6)
        ]
        frames = tuple(
            AgentFrame(id, index * 10**8, PointCloud.of(cloud, torch.full((900,), 0.5)), p, torch.zeros(3, 3))
            for id, p, cloud in ((5, pose, clouds[0]), (6, other, clouds[1]))
        )
        writer.write(Snapshot("a", index, frames, None))
    writer.close({"history_frames": 1})
    with torch.random.fork_rng():
        torch.manual_seed(0)
        checkpoint.save(Detector(COSTR_TINY), tmp_path / "tiny.safetensors", {})
    weights = tmp_path / "tiny.safetensors"
    words = ["export", tmp_path / "data", "--split", "test", "--weights", weights, "--methods", "late"]
    for kind in ("kitti", "nuscenes"):
        assert main([str(word) for word in (*words, "--format", kind, "--out", tmp_path / kind)]) == 0
    assert "late: " in capsys.readouterr().out
    samples = read_nuscenes(tmp_path / "nuscenes" / "late" / "results_nusc.json")
    assert set(samples) == {"a_000001", "a_000002"}
    counts = json.loads((tmp_path / "kitti" / "export.json").read_text())["result"]["boxes"]
    assert counts == {"late": sum(map(len, samples.values()))} and counts["late"] > 0
    recording = Opv2vRecording(tmp_path / "data", "test")
    for token, boxes in samples.items():
        frame = recording.snapshot("a", int(token[-6:])).frames[0]
        path = tmp_path / "kitti" / "late" / "a" / "data" / f"{token[-6:]}.txt"
        found = read_results(path, KittiCalibration.of_lidar(), frame.sensor_height_m)
        moved = found.transform(frame.world_from_agent)
        assert torch.allclose(moved.center, boxes.center, atol=1e-3) and torch.allclose(
            found.score, boxes.score, atol=1e-5
        )
    assert main([str(word) for word in (*words, "--scenario", "b", "--out", tmp_path / "b")]) == 1
    assert "no scenario 'b'" in capsys.readouterr().err
