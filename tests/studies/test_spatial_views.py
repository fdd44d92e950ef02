# SPDX-License-Identifier: Apache-2.0
"""Frames of a viewer: claimed, corrected and true poses, errors within the range alone, and counts."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tests.cli.test_commands import street

from manyeyes.agents.agent import Perception
from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.agents.replay import DetectionReplay, ReplayConfig, ReplayStep
from manyeyes.datatypes import BevGrid, Boxes, Snapshot, Transform
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.studies.spatial_views import show_snapshot, show_step
from manyeyes.viz.spatial_frame import SpatialFrame

OFFSET_M = 0.7


def displace(snapshot: Snapshot) -> Snapshot:
    """The second agent claims a pose that is off by 0.7 m along the world's x axis."""
    first, second = snapshot.frames
    pose = second.world_from_agent
    offset = torch.tensor([OFFSET_M, 0.0, 0.0], dtype=torch.float64)
    wrong = Transform(pose.rotation, pose.translation + offset)
    return replace(snapshot, frames=(first, replace(second, world_from_agent=wrong)))


@pytest.fixture(scope="module")
def step() -> ReplayStep:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        player = DetectionReplay("late", Detector(COSTR_TINY), ReplayConfig(pose_correction=PoseCorrection("identity")))
    (found,) = player.step(displace(street("a", 0)))
    return found


def correct(step: ReplayStep, age_ns: int = 0) -> SpatialFrame:
    """The frame of a step whose message states the true pose after correction, and is so old."""
    (one,) = step.perception.received
    assert step.snapshot.truth is not None
    message = replace(
        one.message,
        world_from_agent=step.snapshot.truth.world_from_agent[1],
        timestamp_ns=one.message.timestamp_ns - age_ns,
    )
    perception = replace(step.perception, received=(replace(one, message=message),))
    assert perception.corrections
    return show_step(replace(step, perception=perception))


def test_a_claimed_pose_is_shown_beside_the_true_one() -> None:
    first, second = show_snapshot(displace(street("a", 0))).agents
    assert first.true_pose is None and second.true_pose is not None
    assert (second.world_from_agent.translation - second.true_pose.translation).tolist() == pytest.approx(
        [OFFSET_M, 0, 0]
    )
    assert show_snapshot(displace(street("a", 0))).numbers == {"pose_error_m/claimed/-1": pytest.approx(OFFSET_M)}
    assert [agent.true_pose for agent in show_snapshot(street("a", 0)).agents] == [None, None]


def test_a_corrected_pose_is_shown_with_its_error(step: ReplayStep) -> None:
    frame = correct(step)
    assert frame.agents[1].corrected is not None
    numbers = {path: value for path, value in frame.numbers.items() if path.startswith("pose_error_m")}
    expected = {"pose_error_m/claimed/-1": OFFSET_M, "pose_error_m/corrected/-1": 0.0}
    assert numbers == pytest.approx(expected, abs=1e-3)


def test_the_pose_of_an_older_message_is_no_correction(step: ReplayStep) -> None:
    assert correct(step, age_ns=100_000_000).agents[1].corrected is None


def test_without_correction_no_pose_is_shown_as_corrected(step: ReplayStep) -> None:
    perception = Perception(step.perception.boxes, step.perception.received)
    assert [agent.corrected for agent in show_step(replace(step, perception=perception)).agents] == [None, None]


def test_vehicles_beyond_the_range_are_not_missed(step: ReplayStep) -> None:
    """One parked car at (8, 5) from the first agent, which found nothing."""
    nothing = replace(step, perception=replace(step.perception, boxes=Boxes.empty()))
    wide, narrow = BevGrid(-20.0, -20.0, -5.0, 20.0, 20.0, 5.0), BevGrid(-6.4, -6.4, -5.0, 6.4, 6.4, 5.0)
    for detection_range, kind, missed in ((None, "missed", 1.0), (wide, "missed", 1.0), (narrow, "truth", 0.0)):
        frame = show_step(nothing, detection_range=detection_range)
        assert frame.truth is not None and frame.truth.kinds == (kind,)
        assert {k: v for k, v in frame.numbers.items() if k.startswith("counts/")} == {
            "counts/matched": 0.0,
            "counts/false": 0.0,
            "counts/missed": missed,
        }
