# SPDX-License-Identifier: Apache-2.0
"""A deferred snapshot equals the whole one, and reads no cloud before its points are used."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

import pytest
import torch

from manyeyes.datasets.deferred import DeferredCloud, DeferredReader, read_deferred
from manyeyes.datasets.mixed import MixedRecording
from manyeyes.datasets.opv2v import Opv2vRecording
from manyeyes.datasets.opv2v.writer import Opv2vWriter
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, RecordingError, Snapshot, Transform
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.training.detector.samples import AugmentConfig, DegradationConfig, SampleStream

AGENTS = (1, 2, 3)


def write_recording(root: Path, frames: int = 6) -> Path:
    """One scenario of three agents, 400 points each, and five vehicles that every agent lists."""
    random = torch.Generator().manual_seed(0)
    writer = Opv2vWriter(root / "drive", 0.05)
    for index in range(frames):
        poses = [Transform.from_xyz_yaw(6.0 * a + 0.3 * index, a, 0.0, 0.2 * a) for a in AGENTS]
        clouds = [PointCloud.of(10 * torch.randn(400, 3, generator=random)) for _ in AGENTS]
        agents = tuple(
            AgentFrame(a, index * 100_000_000, cloud, pose, torch.zeros(3, 3))
            for a, cloud, pose in zip(AGENTS, clouds, poses)
        )
        center = torch.tensor([[4.0 * i, 3.0, 0.8] for i in range(5)], dtype=torch.float64)
        boxes = Boxes.of(center, center * 0 + 2.0, center[:, 0] * 0, id=torch.arange(10, 15))
        writer.write(Snapshot("drive", index, agents, GroundTruth.of(boxes, Transform.stack(poses))))
    writer.close({})
    return root


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("deferred"))


def assert_equal(a: object, b: object) -> None:
    if isinstance(a, torch.Tensor):
        assert isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    elif dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            assert_equal(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, tuple):
        assert isinstance(b, tuple) and len(a) == len(b)
        for pair in zip(a, b):
            assert_equal(*pair)
    else:
        assert a == b


def test_a_deferred_snapshot_equals_the_whole_one(root: Path) -> None:
    recording = Opv2vRecording(root, use_cache=False)
    assert isinstance(recording, DeferredReader)
    for index in range(recording.length("drive")):
        assert_equal(read_deferred(recording, "drive", index), recording.snapshot("drive", index))


def test_a_mixture_leaves_clouds_unread(root: Path) -> None:
    mixed = MixedRecording([Opv2vRecording(root, use_cache=False), Opv2vRecording(root, use_cache=False)])
    for name in mixed.scenarios:
        snapshot = read_deferred(mixed, name, 1)
        assert all(isinstance(frame.points, DeferredCloud) for frame in snapshot.frames)
        assert_equal(snapshot, mixed.snapshot(name, 1))


def test_no_cloud_is_read_before_its_points_are_used(root: Path, tmp_path: Path) -> None:
    write_recording(tmp_path, frames=1)
    snapshot = read_deferred(Opv2vRecording(tmp_path, use_cache=False), "drive", 0)
    for path in tmp_path.rglob("*.pcd"):
        path.unlink()
    assert len(snapshot.frames) == 3 and snapshot.truth is not None
    with pytest.raises(RecordingError, match="no such file"):
        len(snapshot.frames[0].points)


def test_a_cloud_is_read_once() -> None:
    calls = []
    cloud = DeferredCloud(lambda: (calls.append(1), PointCloud.of(torch.ones(2, 3)))[1])
    assert not calls
    assert len(cloud) == 2 and cloud.xyz.sum() == 6 and not cloud.intensity.any()
    assert copy.copy(cloud).xyz is cloud.xyz
    assert len(calls) == 1
    with pytest.raises(AttributeError):
        _ = cloud.colour  # pyright: ignore[reportAttributeAccessIssue]


def test_changes_of_one_truth_do_not_reach_the_next(root: Path) -> None:
    recording = Opv2vRecording(root, use_cache=False)
    first = read_deferred(recording, "drive", 0)
    assert first.truth is not None
    expected = first.truth.boxes.center.clone()
    first.truth.boxes.center.zero_()
    first.frames[0].world_from_agent.translation.zero_()
    again = recording.snapshot("drive", 0)
    assert again.truth is not None
    assert torch.equal(again.truth.boxes.center, expected)
    assert again.frames[0].world_from_agent.translation.any()


@dataclasses.dataclass(frozen=True)
class WholeSnapshots:
    """A recording that cannot leave clouds unread."""

    recording: Opv2vRecording

    @property
    def scenarios(self) -> tuple[str, ...]:
        return self.recording.scenarios

    def length(self, scenario: str) -> int:
        return self.recording.length(scenario)

    def eval_indices(self, scenario: str) -> range:
        return self.recording.eval_indices(scenario)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return self.recording.agents(scenario)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        return self.recording.snapshot(scenario, index)


def test_samples_are_the_same_as_of_whole_snapshots(root: Path) -> None:
    recording = Opv2vRecording(root, use_cache=False)
    whole = WholeSnapshots(recording)
    assert not isinstance(whole, DeferredReader)
    degradation = DegradationConfig(ego_history=2, delay_prob=0.5, pose_noise_prob=0.5)
    streams = [SampleStream(r, COSTR_TINY.grid, AugmentConfig(), 3, degradation) for r in (recording, whole)]
    for number in range(8):
        assert_equal(*(stream.draw(number) for stream in streams))
