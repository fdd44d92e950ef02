# SPDX-License-Identifier: Apache-2.0
"""A recording made of nothing but arithmetic: cars whose sides return points, seen by every agent alike."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.training.trainer import Task, Trainer


@dataclass(frozen=True)
class ToyRecording:
    """scenarios of `frames` snapshots at 10 Hz; cars drive ahead, up to `speed_mps`, and agents all to the world's north.

    Agents are spread around the world's origin and look their own ways; every one of them sees every car whole.
    """

    agents_n: int = 3
    frames: int = 2
    scenarios: tuple[str, ...] = ("toy_0", "toy_1")
    cars: int = 6
    radius_m: float = 18.0
    points_per_car: int = 60
    ground_points: int = 300
    speed_mps: float = 10.0
    agent_mps: float = 4.0

    def length(self, scenario: str) -> int:
        return self.frames

    def eval_indices(self, scenario: str) -> range:
        return range(self.frames)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return tuple(range(self.agents_n))

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        key = (scenario, index)
        u = keyed_uniform((self.cars, 5), "toy cars", scenario, 0)
        angle = (torch.arange(self.cars) + 0.3 * u[:, 0]) * 2 * math.pi / self.cars
        center = torch.stack((angle.cos(), angle.sin(), angle * 0), 1) * self.radius_m * (0.5 + 0.5 * u[:, 1:2])
        size = torch.tensor([4.4, 1.9, 1.6], dtype=torch.float64) * (0.9 + 0.2 * u[:, 2:3])
        center[:, 2] = size[:, 2] / 2 + 1.0
        yaw = 2 * math.pi * u[:, 3]
        velocity = self.speed_mps * u[:, 4:] * torch.stack((yaw.cos(), yaw.sin()), 1)
        boxes = Boxes.of(center, size, yaw, id=torch.arange(self.cars) + 100, velocity=velocity).after(0.1 * index)
        poses = [self._pose(i, scenario, index) for i in range(self.agents_n)]
        frames = tuple(
            AgentFrame.of(self._cloud(boxes, pose, i, key), pose, agent_id=i, timestamp_ns=index * 100_000_000)
            for i, pose in enumerate(poses)
        )
        seen = torch.ones(self.agents_n, self.cars, dtype=torch.bool)
        return Snapshot(scenario, index, frames, GroundTruth(boxes, seen, Transform.stack(poses)))

    def _pose(self, agent: int, scenario: str, index: int) -> Transform:
        u = keyed_uniform((3,), "toy pose", agent, scenario, 0).tolist()
        north = 0.1 * index * self.agent_mps
        return Transform.from_xyz_yaw(6 * u[0] - 3, 6 * u[1] - 3 + north, 1.0, 2 * math.pi * u[2])

    def _cloud(self, boxes: Boxes, pose: Transform, agent: int, key: tuple[str, int]) -> PointCloud:
        """Points on the sides of all cars, a centimetre within, and on the ground under them, in the agent's frame."""
        n, p = len(boxes), self.points_per_car
        u = keyed_uniform((n, p, 3), "toy points", agent, *key)
        local = u - 0.5
        side = torch.arange(p) % 2
        local[..., 0] = torch.where(side == 0, local[..., 0].sign() * 0.5, local[..., 0])
        local[..., 1] = torch.where(side == 1, local[..., 1].sign() * 0.5, local[..., 1])
        local = local * (boxes.size[:, None] - 0.02)
        c, s = boxes.yaw.cos()[:, None], boxes.yaw.sin()[:, None]
        turned = torch.stack(
            (local[..., 0] * c - local[..., 1] * s, local[..., 0] * s + local[..., 1] * c, local[..., 2]), -1
        )
        ground = (keyed_uniform((self.ground_points, 3), "toy ground", agent, *key) - 0.5) * 50
        ground[:, 2] = 0.95
        world = torch.cat(((turned + boxes.center[:, None]).flatten(0, 1), ground))
        return PointCloud.of(pose.inverse().apply(world))


@pytest.fixture
def toy() -> type[ToyRecording]:
    return ToyRecording


def same_state(a: torch.nn.Module, b: torch.nn.Module) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a.state_dict().values(), b.state_dict().values(), strict=True))


@pytest.fixture
def check_resumption() -> Callable[[Callable[[], Task[Any, Any, Any]], Path], None]:
    """Compare four steps in one run with two steps, a third that is lost, and two more: equal bit for bit."""

    def check(make_task: Callable[[], Task[Any, Any, Any]], folder: Path) -> None:
        whole, broken = (Trainer(make_task(), folder / name) for name in ("whole", "broken"))
        for _ in range(4):
            whole.advance()
        for step in range(3):
            broken.advance()
            if step == 1:
                broken.save()
        resumed = Trainer(make_task(), folder / "broken")
        assert resumed.step == 2 and not same_state(resumed.model, broken.model)
        assert [resumed.advance().step for _ in range(2)] == [3, 4]
        assert same_state(resumed.model, whole.model) and same_state(resumed.average, whole.average)
        for mine, theirs in zip(resumed.optimiser.state.values(), whole.optimiser.state.values(), strict=True):
            assert all(torch.equal(mine[key], theirs[key]) for key in ("exp_avg", "exp_avg_sq"))

    return check
