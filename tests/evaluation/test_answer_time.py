# SPDX-License-Identifier: Apache-2.0
"""Judging at the time of the answer, worked by hand.

t = 0        100       200      300 ms      one vehicle, 4 m x 2 m, drives at 10 m/s along x; its ego stands at the origin
x = 20 m     21 m      22 m     23 m        wait 100 ms: the answer is 1 m late; overlap (4 - 1) / (4 + 1) = 0.6
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from manyeyes.agents.agent import Perception
from manyeyes.agents.replay import ReplayConfig, ReplayStep, replay
from manyeyes.agents.strategies.registry import list_strategies
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, RecordingError, Snapshot, Transform
from manyeyes.evaluation.detection.accumulator import MetricAccumulator
from manyeyes.evaluation.detection.answer_time import answer_of
from manyeyes.evaluation.detection.compute_times import OTHER, compute_time_s, load_compute_times_ms
from manyeyes.evaluation.detection.protocols import get_protocol
from manyeyes.evaluation.detection.truth_motion import interpolate_pose, move_truth
from manyeyes.studies.replay_options import BOTH_FORMS

PERIOD_NS, SPEED = 100_000_000, 10.0
SIZE = torch.tensor([[4.0, 2.0, 1.5]], dtype=torch.float64)


class Road:
    """Four snapshots of the drawing. ego_speed: of the ego along x; turn: the vehicle turns by so many radians a frame."""

    scenarios = ("road",)

    def __init__(
        self, ego_speed: float = 0.0, turn: float = 0.0, absent_from: int = 99, velocity: float = SPEED
    ) -> None:
        self.ego_speed, self.turn, self.absent_from, self.velocity = ego_speed, turn, absent_from, velocity

    def length(self, scenario: str) -> int:
        return 4

    def eval_indices(self, scenario: str) -> range:
        return range(4)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return (0,)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        pose = Transform.from_xyz_yaw(0.1 * self.ego_speed * index, 0.0)
        frame = AgentFrame.of(PointCloud.of(torch.zeros(1, 3)), pose, 0, 5_000_000_000 + index * PERIOD_NS)
        center = torch.tensor([[20.0 + 0.1 * SPEED * index, 0.0, 0.8]], dtype=torch.float64)
        boxes = Boxes.of(
            center,
            SIZE,
            torch.tensor([self.turn * index]).double(),
            id=torch.tensor([7]),
            velocity=torch.tensor([[self.velocity, 0.0]]).double(),
        )
        boxes = boxes[:0] if index >= self.absent_from else boxes
        return Snapshot(scenario, index, (frame,), GroundTruth.of(boxes, Transform.stack([pose])))


def step_at(road: Road, index: int, wait_s: float, velocity: float | None = 0.0) -> ReplayStep:
    """The ego finds the vehicle exactly where it was at its sweep, with this velocity; None finds nothing."""
    snapshot = road.snapshot("road", index)
    assert snapshot.truth is not None
    seen = snapshot.truth.boxes.transform(snapshot.frames[0].world_from_agent.inverse())
    boxes = replace(seen, velocity=torch.tensor([[velocity or 0.0, 0.0]]).double())
    return ReplayStep("late", snapshot, 0, Perception(boxes, ()), (), (), 0.0, wait_s)


def judge(road: Road, step: ReplayStep, compute_s: float = 0.0) -> float:
    """IoU of the answer's box and truth."""
    metrics = MetricAccumulator("late", get_protocol("global-sort"))
    metrics.add(step, answer_of(step, road, compute_s))
    assert metrics.mean_answer_ms() == pytest.approx(1e3 * (step.wait_s + compute_s))
    return float(metrics.answer_frames[0].iou)


def test_a_vehicle_at_10_mps_is_one_metre_on_after_a_wait_of_100_ms() -> None:
    step = step_at(Road(), 0, 0.1)
    answer = answer_of(step, Road(), 0.0)
    assert answer.snapshot.truth is not None and answer.seconds == 0.1
    assert answer.snapshot.truth.boxes.center[0].tolist() == pytest.approx([21.0, 0.0, 0.8], abs=1e-12)
    assert answer.boxes.center[0].tolist() == pytest.approx([20.0, 0.0, 0.8], abs=1e-12)
    assert judge(Road(), step) == pytest.approx(0.6, abs=1e-12)


def test_ap_at_the_sweep_stays_and_at_the_answer_falls_between_the_thresholds() -> None:
    """IoU 0.6 counts at 0.5 and not at 0.7."""
    step, metrics = step_at(Road(), 0, 0.1), MetricAccumulator("late", get_protocol("global-sort"))
    metrics.add(step, answer_of(step, Road(), 0.0))
    (result,) = metrics.compute_results()
    assert [ap.ap for ap in result.ap] == [1.0, 1.0] and [ap.ap for ap in result.answer_ap] == [1.0, 0.0]


def test_boxes_are_moved_by_their_velocity() -> None:
    assert judge(Road(), step_at(Road(), 0, 0.1, velocity=SPEED)) == pytest.approx(1.0, abs=1e-9)
    assert judge(Road(), step_at(Road(), 0, 0.1, velocity=20.0)) == pytest.approx(0.6, abs=1e-9)


@pytest.mark.parametrize(("wait_s", "compute_s"), [(0.1, 0.05), (0.0, 0.15), (0.05, 0.1)])
def test_between_annotated_frames_the_truth_is_interpolated(wait_s: float, compute_s: float) -> None:
    """150 ms: 1.5 m, overlap 2.5 / 5.5."""
    answer = answer_of(step_at(Road(), 1, wait_s), Road(), compute_s)
    assert answer.snapshot.truth is not None and answer.snapshot.index == 2
    assert float(answer.snapshot.truth.boxes.center[0, 0]) == pytest.approx(22.5, abs=1e-9)
    assert judge(Road(), step_at(Road(), 1, wait_s), compute_s) == pytest.approx(2.5 / 5.5, abs=1e-9)


def test_positions_are_those_of_the_next_frame_not_of_the_stated_velocity() -> None:
    road = Road(velocity=0.0)
    moved = move_truth(road, road.snapshot("road", 0), 0, 5_050_000_000)
    assert moved.truth is not None and float(moved.truth.boxes.center[0, 0]) == pytest.approx(20.5, abs=1e-9)


def test_after_the_last_frame_and_of_what_the_next_frame_lacks_the_velocity_counts() -> None:
    for road, index in ((Road(), 3), (Road(absent_from=1), 0)):
        moved = move_truth(road, road.snapshot("road", index), 0, 5_000_000_000 + index * PERIOD_NS + 50_000_000)
        assert moved.truth is not None
        assert float(moved.truth.boxes.center[0, 0]) == pytest.approx(20.5 + index, abs=1e-9)


@pytest.mark.parametrize("index", [1, 3])
def test_the_egos_own_motion_is_that_of_its_true_poses(index: int) -> None:
    """The ego follows at 10 m/s: in its frame of the answer the vehicle is where it was, and the box it found 1 m behind."""
    road = Road(ego_speed=SPEED)
    answer = answer_of(step_at(road, index, 0.1), road, 0.0)
    assert answer.snapshot.truth is not None
    ego = answer.snapshot.truth.world_from_agent[0].translation
    assert float(ego[0]) == pytest.approx(index + 1.0, abs=1e-9)
    assert float(answer.boxes.center[0, 0]) == pytest.approx(19.0, abs=1e-9)
    assert judge(road, step_at(road, index, 0.1)) == pytest.approx(0.6, abs=1e-9)


def test_headings_go_the_shorter_way_around_modulo_pi() -> None:
    for turn, expected in ((0.2, 0.1), (math.pi - 0.2, -0.1), (2 * math.pi + 0.2, 0.1)):
        road = Road(turn=turn)
        moved = move_truth(road, road.snapshot("road", 0), 0, 5_050_000_000)
        assert moved.truth is not None and float(moved.truth.boxes.yaw) == pytest.approx(expected, abs=1e-6)


def test_poses_are_interpolated_on_both_ends_and_beyond() -> None:
    zero = torch.zeros(3, dtype=torch.float64)
    start = Transform.from_rpy(zero, *torch.tensor([0.02, -0.03, 0.4]).double())
    end = Transform.from_rpy(zero + 2, *torch.tensor([-0.01, 0.05, 0.9]).double())
    for fraction, expected in ((0.0, start), (1.0, end)):
        torch.testing.assert_close(
            interpolate_pose(start, end, fraction).matrix(), expected.matrix(), atol=1e-12, rtol=0
        )
    flat = [Transform.from_xyz_yaw(0, 0, 0, yaw) for yaw in (0.1, 0.3)]
    assert float(interpolate_pose(*flat, 2.0).yaw) == pytest.approx(0.5) and torch.equal(
        interpolate_pose(start, start, 0.7).rotation, start.rotation
    )


def test_a_recording_without_truth_is_refused() -> None:
    snapshot = replace(Road().snapshot("road", 0), truth=None)
    with pytest.raises(RecordingError, match="no truth"):
        move_truth(Road(), snapshot, 0, 5_050_000_000)


class Blind:
    """A detector that finds nothing."""

    def __init__(self) -> None:
        from manyeyes.datatypes import BevGrid

        self.fingerprint, self.grid = bytes(8), BevGrid(-100.0, -40.0, -3.0, 100.0, 40.0, 1.0)
        self.detection_range = self.grid

    def detect(self, cloud: PointCloud, earlier: PointCloud | None) -> Boxes:
        return Boxes.empty()


def test_an_ego_that_fuses_no_messages_does_not_wait() -> None:
    steps = replay(Road(), "road", Blind(), ("no-fusion", "late"), ReplayConfig(latency_budget_s=0.1))
    assert {(step.method, step.wait_s) for step in steps} == {("no-fusion", 0.0), ("late", 0.1)}


def test_compute_times_are_those_that_the_benchmark_measured() -> None:
    """Rounded to 5 ms; all rows of the main table are listed, and strategies that are not have the time of our default."""
    times = load_compute_times_ms()
    assert set(BOTH_FORMS) <= set(times) <= {*list_strategies(), OTHER}
    stored = Path(__file__).parents[2] / "benchmarks" / "results" / "step_methods.json"
    measured = {row["method"]: row["step_ms"] for row in json.loads(stored.read_text())["result"]["rows"]}
    assert {name: 5 * round(ms / 5) for name, ms in measured.items()} == {k: v for k, v in times.items() if k != OTHER}
    assert times[OTHER] == times["intermediate-temporal"]
    assert compute_time_s("none") == compute_time_s("no-fusion") and compute_time_s("theirs") == times[OTHER] / 1e3
