# SPDX-License-Identifier: Apache-2.0
"""Hand-made steps, counted, and differences of hand-made results."""

import math

import pytest
import torch

from manyeyes.agents.agent import Perception
from manyeyes.agents.replay import ReplayStep, SentPackets
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.evaluation.detection.accumulator import MethodResult, MetricAccumulator
from manyeyes.evaluation.detection.average_precision import PROTOCOLS
from manyeyes.evaluation.statistics.comparison import compare_methods

PROTOCOL = PROTOCOLS["global-sort"]
SPOTS = ((10.0, 3.0), (20.0, -3.0), (30.0, 3.0), (40.0, -3.0))


def boxes(spots: tuple[tuple[float, float], ...]) -> Boxes:
    center = torch.tensor([[x, y, 0.8] for x, y in spots], dtype=torch.float64).reshape(-1, 3)
    size = torch.tensor([4.5, 1.9, 1.6], dtype=torch.float64).expand(len(spots), 3)
    score = torch.linspace(0.9, 0.6, max(1, len(spots)), dtype=torch.float64)[: len(spots)]
    return Boxes.of(center, size, torch.zeros(len(spots)).double(), score, id=torch.arange(len(spots)))


def step(method: str, scenario: str, index: int, found: int, sent_bytes: int, age_s: float = 0.1) -> ReplayStep:
    """Two agents at the origin, four cars, the first ``found`` of which are detected exactly."""
    cloud = PointCloud.of(torch.zeros(1, 3))
    frames = tuple(
        AgentFrame(100 + i, index, cloud, Transform.identity(), torch.zeros(3, 3, dtype=torch.float64))
        for i in range(2)
    )
    truth = GroundTruth(boxes(SPOTS), torch.ones(2, 4, dtype=torch.bool), Transform.identity(2))
    # The ego's own message is on the air too, and must not be counted as one that it receives.
    sent = tuple(
        SentPackets(a, (size,) if size else (), took)
        for a, size, took in ((100, 7 * sent_bytes, 0.01), (101, sent_bytes, 0.03))
    )
    ages = (age_s,) if sent_bytes else ()
    return ReplayStep(
        method, Snapshot(scenario, index, frames, truth), 0, Perception(boxes(SPOTS[:found]), ()), sent, ages, 0.05
    )


def accumulate(method: str, found: list[int], sent_bytes: int = 1000) -> MethodResult:
    """One scenario an entry of found, two frames each."""
    tally = MetricAccumulator(method, PROTOCOL)
    for number, hits in enumerate(found):
        for index in range(2):
            tally.add(step(method, f"s{number}", index, hits, sent_bytes))
    return tally.compute_result()


def test_ap_bytes_age_and_times_are_those_of_the_steps() -> None:
    result = accumulate("late", [2, 4])
    assert result.ap[0].ap == pytest.approx(0.75) and result.ap[1].n_gt == 16
    assert result.intervals[0].value == pytest.approx(0.75) and result.intervals[0].num_scenarios == 2
    assert result.communication.bytes_per_message == 1000 and result.communication.num_messages == 4
    assert (result.age_ms, result.share_ms, result.perceive_ms) == pytest.approx((100, 20, 50))


def test_an_agent_that_sends_nothing_has_no_message_age_or_share_time() -> None:
    result = accumulate("none", [1], sent_bytes=0)
    assert result.communication.num_messages == 0 and result.communication.num_ego_frames == 2
    assert math.isnan(result.age_ms) and math.isnan(result.share_ms) and result.perceive_ms == pytest.approx(50)


def test_a_method_is_compared_with_every_other_at_both_thresholds() -> None:
    fused = [1, 1, 4, 1, 4]
    results = [accumulate("none", [2] * 5), accumulate("intermediate", fused)]
    half, seven = compare_methods(results, PROTOCOL)
    assert (half.description, half.metric, seven.metric) == ("intermediate - none", "AP@0.5", "AP@0.7")
    assert half.interval.value == pytest.approx(sum(fused) / 20 - 0.5) and half.interval.num_scenarios == 5
    assert half.interval.low < half.interval.value < half.interval.high


def test_without_the_method_there_is_nothing_to_compare() -> None:
    assert compare_methods([accumulate("none", [1]), accumulate("late", [2])], PROTOCOL) == ()
    assert compare_methods([accumulate("intermediate", [1])], PROTOCOL) == ()
