# SPDX-License-Identifier: Apache-2.0
"""Clouds that are copies of others or miss their boxes; recordings in which neither is unusual are left alone."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from manyeyes.datasets.mismatch import find_copied_files, find_mismatched_files
from manyeyes.datasets.opv2v import Opv2vRecording, Opv2vWriter
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform


def scene(index: int, cars: int = 8, hit: Callable[[int, int], bool] = lambda agent, car: True) -> Snapshot:
    """Two agents among cars in a row, one point cloud of its own each; hit: whether an agent has points of a car it lists."""
    rng = torch.Generator().manual_seed(index)
    frames, poses = [], []
    for agent in (0, 1):
        pose = Transform.from_xyz_yaw(30.0 * agent, 3.0 * agent, 0, 0.7 * agent)
        bodies = [torch.rand(40, 3, generator=rng) + torch.tensor([8.0 * k, 6.0, 0.3]) for k in range(cars)]
        bodies = [body if hit(agent, k) else body + 100.0 for k, body in enumerate(bodies)]
        ground = (torch.rand(400, 3, generator=rng) - 0.5) * torch.tensor([200.0, 200.0, 0.01]) - torch.tensor(
            [0, 0, 2.0]
        )
        cloud = PointCloud.of(pose.inverse().apply(torch.cat([ground, *bodies]).double()).float())
        poses.append(pose)
        frames.append(AgentFrame(agent, index * 100_000_000, cloud, pose, torch.zeros(3, 3)))
    center = torch.tensor([[8.0 * k + 0.5, 6.5, 0.8] for k in range(cars)], dtype=torch.float64).reshape(cars, 3)
    boxes = Boxes.of(center, torch.tensor([[2.0, 2.0, 1.6]]).double().expand(cars, 3), torch.zeros(cars).double(),
                     id=torch.arange(10, 10 + cars))  # fmt: skip
    seen = torch.ones(2, cars, dtype=torch.bool)
    return Snapshot("s", index, tuple(frames), GroundTruth(boxes, seen, Transform.stack(poses)))


def write(folder: Path, frames: int = 4, **changes: object) -> Path:
    writer = Opv2vWriter(folder / "s")
    for index in range(frames):
        writer.write(scene(index, **changes))  # pyright: ignore[reportArgumentType]
    return folder


def found(folder: Path) -> list[str]:
    """Names of the mismatched files, without the caches of a verdict."""
    recording = Opv2vRecording(folder, use_cache=False)
    return sorted(str(problem.path.relative_to(folder)) for problem in recording.verify().files)


def test_an_honest_recording_has_none(tmp_path: Path) -> None:
    assert found(write(tmp_path)) == []


def test_exchanged_clouds_of_two_agents_miss_their_boxes(tmp_path: Path) -> None:
    root = write(tmp_path)
    one, two = root / "s" / "0" / "000002.pcd", root / "s" / "1" / "000002.pcd"
    first, second = one.read_bytes(), two.read_bytes()
    one.write_bytes(second)
    two.write_bytes(first)
    assert found(root) == ["s/0/000002.pcd", "s/1/000002.pcd"]


def test_a_copied_cloud_is_named_and_not_the_original(tmp_path: Path) -> None:
    root = write(tmp_path)
    (root / "s" / "0" / "000000.pcd").write_bytes((root / "s" / "1" / "000006.pcd").read_bytes())
    assert found(root) == ["s/0/000000.pcd"]


def test_an_empty_cloud_is_named(tmp_path: Path) -> None:
    root, empty = write(tmp_path / "a"), write(tmp_path / "b", 1, cars=0)
    text = (empty / "s" / "0" / "000000.pcd").read_bytes().split(b"DATA binary\n")[0] + b"DATA binary\n"
    text = text.replace(b"WIDTH 400", b"WIDTH 0").replace(b"POINTS 400", b"POINTS 0")
    (root / "s" / "1" / "000004.pcd").write_bytes(text)
    assert found(root) == ["s/1/000004.pcd"]


def test_data_that_list_vehicles_by_distance_are_left_alone(tmp_path: Path) -> None:
    assert found(write(tmp_path, hit=lambda agent, car: car % 2 == 0)) == []


@pytest.mark.parametrize(("unmet", "named"), [(2, []), (3, ["s/1/000000.pcd"])])
def test_few_occluded_vehicles_are_no_mismatch(tmp_path: Path, unmet: int, named: list[str]) -> None:
    writer = Opv2vWriter(tmp_path / "s")
    for index in range(4):
        hidden = unmet if index == 0 else 0
        writer.write(scene(index, hit=lambda agent, car, hidden=hidden: agent == 0 or car >= hidden))
    assert found(tmp_path) == named


def test_a_stationary_agent_may_repeat_a_cloud(tmp_path: Path) -> None:
    root = write(tmp_path, 2)
    for name in ("000002.pcd", "000002.yaml"):
        for agent in ("0", "1"):
            (root / "s" / agent / name).write_bytes((root / "s" / agent / f"000000{name[6:]}").read_bytes())
    assert found(root) == []


def test_small_files_of_equal_bytes_mean_nothing(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a", "b", "c", "d")]
    for path, content in zip(paths, (b"x" * 100, b"x" * 100, b"y" * 5000, b"y" * 5000)):
        path.write_bytes(content)
    assert [problem.path.name for problem in find_copied_files(paths, "s")] == ["d"]


def test_a_recording_without_truth_is_compared_by_bytes_alone(tmp_path: Path) -> None:
    root = write(tmp_path)
    path = root / "s" / "0" / "000002.pcd"
    path.write_bytes((root / "s" / "1" / "000002.pcd").read_bytes())
    recording = Opv2vRecording(root, use_cache=False)
    clouds = [{0: root / "s" / "0" / f"00000{k}.pcd", 1: root / "s" / "1" / f"00000{k}.pcd"} for k in (0, 2, 4, 6)]

    def read(index: int) -> Snapshot:
        snapshot = recording.snapshot("s", index)
        return Snapshot(snapshot.scenario, snapshot.index, snapshot.frames, None)

    (problem,) = find_mismatched_files(read, "s", clouds)
    assert problem.path in (path, root / "s" / "1" / "000002.pcd")
