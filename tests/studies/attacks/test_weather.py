# SPDX-License-Identifier: Apache-2.0
"""Returns through glass and in rain, on clouds drawn by hand."""

import numpy as np
import pytest
import torch

from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, Snapshot, Transform
from manyeyes.studies.attacks._weather_kernels import find_window_returns
from manyeyes.studies.attacks.weather import GlassReturns, RainReturns, make_weather

CAR = Boxes.of([[10.0, 0.0, 1.0]], [[4.0, 2.0, 2.0]], [0.0]).to(torch.float64)


def frame_of(points: torch.Tensor) -> AgentFrame:
    return AgentFrame.of(points, Transform.identity(), sensor_height_m=2.0)


def unit(count: int, first: float) -> torch.Tensor:
    return torch.tensor([[first, 0.5, 0.5]], dtype=torch.float64).expand(count, 3)


def test_glass_changes_returns_of_windows_alone() -> None:
    window, door, ground = (8.0, 0.0, 1.4), (8.0, 0.0, 0.6), (5.0, 3.0, 0.0)
    frame = frame_of(torch.tensor([window, door, ground]))
    lost, behind, kept = (GlassReturns().apply(frame, CAR, unit(3, first)).xyz for first in (0.1, 0.5, 0.9))
    assert torch.equal(lost, frame.points.xyz[1:]) and torch.equal(kept, frame.points.xyz)
    assert torch.equal(behind[1:], frame.points.xyz[1:])
    # The return moves 7.5 m farther along its ray.
    sensor = torch.tensor([0.0, 0.0, 2.0])
    before, after = frame.points.xyz[0] - sensor, behind[0] - sensor
    assert float(after.norm() - before.norm()) == pytest.approx(7.5, abs=1e-4)
    assert torch.allclose(before / before.norm(), after / after.norm(), atol=1e-6)


def test_returns_of_windows_are_those_that_vehicles_contain_in_a_band_of_their_height() -> None:
    rng = np.random.default_rng(4)
    points = torch.from_numpy(rng.uniform((-20, -20, -0.5), (20, 20, 3), (30_000, 3))).float()
    boxes = Boxes.of(
        rng.uniform((-15, -15, 0.5), (15, 15, 1.2), (12, 3)), rng.uniform(1, 5, (12, 3)), rng.uniform(-3, 3, 12)
    )
    columns = torch.cat((boxes.center, boxes.size, boxes.yaw[:, None]), 1)
    found = find_window_returns(points.numpy(), columns.numpy(), 0.55, 0.9, 0.1)
    share = (points[None, :, 2] - (boxes.center[:, 2:] - boxes.size[:, 2:] / 2)) / boxes.size[:, 2:]
    expected = (boxes.contains(points.double(), 0.1) & (share >= 0.55) & (share <= 0.9)).any(0)
    assert 100 < expected.sum() < 15_000 and np.array_equal(found, expected.numpy())


def test_rain_loses_far_returns_first_and_adds_near_drops() -> None:
    frame = frame_of(torch.tensor([[5.0, 0.0, 2.0], [80.0, 0.0, 2.0]]))
    draws = torch.tensor([[0.5, 0.9, 0.5]] * 2, dtype=torch.float64)
    # exp(-2 * 0.005 * 5) = 0.95 and exp(-2 * 0.005 * 80) = 0.45.
    assert RainReturns().apply(frame, CAR, draws).xyz[:, 0].tolist() == [5.0]
    in_drop = torch.tensor([[0.5, 0.001, 0.5]] * 2, dtype=torch.float64)
    assert RainReturns().apply(frame, CAR, in_drop).xyz[:, 0].tolist() == pytest.approx([4.5, 4.5])


def test_weather_is_keyed_and_clean_is_the_snapshot_itself() -> None:
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 40
    frames = tuple(AgentFrame.of(points, Transform.identity(), agent_id=k) for k in (1, 2))
    truth = GroundTruth.of(CAR, Transform.stack([Transform.identity()] * 2))
    snapshot = Snapshot("a", 3, frames, truth)
    assert make_weather("clean", 0)(snapshot) is snapshot
    first, again = (make_weather("rain", 0)(snapshot) for _ in range(2))
    assert torch.equal(first.frames[0].points.xyz, again.frames[0].points.xyz)
    assert len(first.frames[0].points) != len(first.frames[1].points) or not torch.equal(
        first.frames[0].points.xyz, first.frames[1].points.xyz
    )
    assert len(make_weather("rain", 1)(snapshot).frames[0].points) > 0
