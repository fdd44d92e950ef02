# SPDX-License-Identifier: Apache-2.0
"""Agents level their frames: points, poses, messages and boxes agree, whatever the tilt of the sensor."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from manyeyes.agents.agent import Agent
from manyeyes.agents.level_frame import FrameLeveller, LevelledFrame, SnapshotLeveller, find_levelling
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.datatypes.camera import Camera, CameraImage
from manyeyes.models.detector.protocols import BoxDetector

CAR = (25.0, -6.0)
"""Middle of the only object, in the world."""


class Tall(BoxDetector):
    """One box of a car around the points more than 1 m above z = 0: ground on a tilted sensor is one, too."""

    grid = BevGrid(-60.0, -60.0, -3.0, 60.0, 60.0, 3.0)

    def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
        high = points.xyz[points.xyz[:, 2] > 1.0]
        if previous is not None:
            assert not len(high) or (previous.xyz[:, 2] > 1.0).any()
        rows = min(1, len(high))
        size = torch.tensor([[4.5, 1.9, 1.6]]).expand(rows, 3)
        return Boxes.of(high.mean(0, keepdim=True)[:rows], size, torch.full((rows,), 0.3), torch.full((rows,), 0.9))


def tilt(roll_deg: float, pitch_deg: float, up_m: float = 0.0) -> Transform:
    zero = torch.zeros((), dtype=torch.float64)
    angles = zero + math.radians(roll_deg), zero + math.radians(pitch_deg), zero
    return Transform.from_rpy(torch.tensor([0.0, 0.0, up_m], dtype=torch.float64), *angles)


def sweep(seed: int = 0, car: tuple[float, float] = CAR, noise_m: float = 0.01) -> Tensor:
    """Points (N, 3) in the world: level road around (12, 0), and a car of 1.5 m."""
    rng = torch.Generator().manual_seed(seed)
    radius, angle = (torch.rand(6000, generator=rng) * span for span in (45.0, 2 * math.pi))
    road = torch.stack((12 + radius * angle.cos(), radius * angle.sin(), noise_m * torch.randn(6000, generator=rng)), 1)
    body = (torch.rand(200, 3, generator=rng) - 0.5) * torch.tensor([4.0, 1.6, 0.6]) + torch.tensor([*car, 1.4])
    return torch.cat((road, body)).double()


def frame_of(
    agent_id: int, pose: Transform, tilted: Transform | None = None, index: int = 0, world: Tensor | None = None
) -> AgentFrame:
    """An upright agent at a pose, or one whose frame is tilted: z = 0 is then not the road."""
    points = PointCloud.of(pose.inverse().apply(sweep(index) if world is None else world))
    upright = AgentFrame.of(points, pose, agent_id=agent_id, timestamp_ns=index * 100_000_000)
    return upright if tilted is None else upright.moved(tilted)


POSES = (Transform.from_xyz_yaw(0.0, 0.0, 0.0, 0.2), Transform.from_xyz_yaw(30.0, 10.0, 0.0, -2.0))
TILTS = [tilt(3.0, 0.0), tilt(0.0, -3.0), tilt(1.0, 2.0, 0.4)]


def test_a_level_frame_is_the_same_object() -> None:
    frame = frame_of(0, POSES[0])
    found = FrameLeveller()(frame)
    assert found.levelled is frame and found.levelled_from_agent is None
    snapshot = Snapshot("level", 0, (frame,))
    assert SnapshotLeveller()(snapshot) is snapshot


@pytest.mark.parametrize("tilted", TILTS)
def test_a_levelled_frame_is_the_upright_one(tilted: Transform) -> None:
    upright, frame = frame_of(0, POSES[0]), frame_of(0, POSES[0], tilted)
    level = LevelledFrame.of(frame)
    assert level.levelled is not frame and level.levelled_from_agent is not None
    # Points stay where they are in the world, and the road is z = 0 up to 45 m.
    for some in (frame, level.levelled):
        world = some.world_from_agent.apply(some.points.xyz.double())
        assert torch.allclose(world, upright.world_from_agent.apply(upright.points.xyz.double()), atol=1e-4)
    assert float(level.levelled.points.xyz[:6000, 2].abs().max()) < 0.1
    assert level.levelled.sensor_height_m == pytest.approx(upright.sensor_height_m, abs=0.03)
    assert abs(float(level.levelled.world_from_agent.yaw - frame.world_from_agent.yaw)) < 0.002


def test_moving_a_frame_keeps_motion_by_odometry_and_pixels() -> None:
    camera = Camera(torch.tensor([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]).double(), tilt(100.0, 5.0), 100, 80)
    image = CameraImage(camera, torch.zeros(3, 80, 100, dtype=torch.uint8))
    then, now = (
        replace(frame_of(0, POSES[0]), odometry=Transform.from_xyz_yaw(x, 1.0, 0.1, 0.1 * x), images=(image,))
        for x in (0.0, 1.0)
    )
    point = torch.tensor([[10.0, 3.0, 1.0]], dtype=torch.float64)
    here = now.now_from_earlier(then).apply(point)
    moved_then, moved_now = then.moved(TILTS[0]), now.moved(TILTS[2])
    assert torch.allclose(moved_now.now_from_earlier(moved_then).apply(TILTS[0].apply(point)), TILTS[2].apply(here))
    pixel, depth = camera.project(point)
    again = moved_then.images[0].camera.project(TILTS[0].apply(point))
    assert torch.allclose(again[0], pixel) and torch.allclose(again[1], depth)


@pytest.mark.parametrize("tilted", TILTS)
@pytest.mark.parametrize("name", ["no-fusion", "late", "early"])
def test_boxes_of_a_tilted_agent_come_back_in_its_own_frame(name: str, tilted: Transform) -> None:
    ego = Agent(Tall(), get_strategy(name))
    for index in range(2):
        frame = frame_of(0, POSES[0], tilted, index)
        packets = Agent(Tall(), get_strategy(name)).share(frame_of(1, POSES[1], TILTS[1], index))
        boxes = ego.perceive(frame, packets).boxes
        assert len(boxes) == 1
        there = boxes.to(torch.float64).transform(frame.world_from_agent)
        assert there.center[0].tolist() == pytest.approx([*CAR, 1.4], abs=0.15)
        assert float(there.yaw[0]) == pytest.approx(0.3 + 0.2, abs=0.01)


def test_without_levelling_the_road_of_a_tilted_sensor_is_an_object() -> None:
    frame = frame_of(0, POSES[0], TILTS[0])
    cache = PerceptionCache(Tall())
    cache.level = FrameLeveller(None)
    boxes = Agent(Tall(), get_strategy("no-fusion"), perception_cache=cache).perceive(frame).boxes
    there = boxes.to(torch.float64).transform(frame.world_from_agent)
    assert math.dist(there.center[0, :2].tolist(), CAR) > 5.0


def test_share_and_perceive_level_a_frame_once_and_never_twice() -> None:
    level, frame = FrameLeveller(), frame_of(0, POSES[0], TILTS[0])
    first, again = level(frame), level(frame)
    assert first is again and first.levelled is not frame
    assert level(first.levelled).levelled is first.levelled
    # Nor by another agent, which has not seen the frame before.
    assert find_levelling(first.levelled) is None


def test_packets_carry_the_pose_of_the_levelled_frame() -> None:
    frame = frame_of(1, POSES[1], TILTS[2])
    ego = Agent(Tall(), get_strategy("late"))
    perception = ego.perceive(frame_of(0, POSES[0]), Agent(Tall(), get_strategy("late")).share(frame))
    (received,) = perception.received
    up = received.message.world_from_agent.rotation[:, 2]
    assert float(up[2]) > math.cos(math.radians(0.2)) > float(frame.world_from_agent.rotation[2, 2])
    assert received.message.objects is not None
    placed = received.message.objects.to(torch.float64).transform(received.message.world_from_agent)
    # An object stands on z = 0 of the frame that its message states: its height is not sent.
    assert placed.center[0].tolist() == pytest.approx([*CAR, 0.8], abs=0.15)


def test_ground_that_is_hidden_leaves_the_frame() -> None:
    rng = torch.Generator().manual_seed(1)
    wall = torch.stack((torch.full((3000,), 4.0), *((torch.rand(3000, generator=rng) - 0.5) * s for s in (20, 4))), 1)
    frame = AgentFrame.of(PointCloud.of(wall), Transform.identity())
    assert FrameLeveller()(frame).levelled is frame


def test_true_poses_move_with_levelled_frames() -> None:
    frames = tuple(frame_of(i, pose, TILTS[i]) for i, pose in enumerate(POSES))
    off = Transform.from_xyz_yaw(0.5, -0.2, 0.0, 0.01)
    true = Transform.stack([off @ frame.world_from_agent for frame in frames])
    box = Boxes.of(
        torch.tensor([[*CAR, 1.4]]).double(), torch.tensor([[4.5, 1.9, 1.6]]).double(), torch.zeros(1).double()
    )
    level = SnapshotLeveller()
    snapshot = level(Snapshot("two", 3, frames, GroundTruth.of(box, true)))
    assert snapshot.truth is not None
    for row, frame in enumerate(snapshot.frames):
        expected = off @ frame.world_from_agent
        assert torch.allclose(snapshot.truth.world_from_agent[row].matrix(), expected.matrix(), atol=1e-9)
        assert float(frame.points.xyz[:6000, 2].abs().max()) < 0.1
    # The fit of a frame is kept by its name: other points under it are not fitted again.
    other = replace(frames[0], points=frames[0].points[:10])
    again = level(Snapshot("two", 3, (other, frames[1])))
    assert torch.equal(again.frames[0].world_from_agent.matrix(), snapshot.frames[0].world_from_agent.matrix())
