# SPDX-License-Identifier: Apache-2.0
"""What each form fuses: the present alone, or the last frames too, of the ego and of senders."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.early import MIN_POINT_LIMIT, merge_clouds
from manyeyes.agents.strategies.intermediate import IntermediateFusion
from manyeyes.agents.strategies.names import TEMPORAL
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, Message, PointCloud, Transform
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY

TENTH_NS = 100_000_000


def frame(at: int, *points: float) -> AgentFrame:
    """An agent at the origin that sees points on the x axis."""
    cloud = PointCloud.of(torch.tensor([[x, 0.0, 1.0] for x in points]).view(-1, 3))
    return AgentFrame.of(cloud, Transform.identity(), 0, at * TENTH_NS)


def message(at: int, *points: float) -> Message:
    return replace(
        Message(5, at * TENTH_NS, Transform.from_xyz_yaw(10.0, 0.0), torch.zeros(3, 3).double()),
        points=frame(at, *points).points,
    )


class PointDetector:
    """A box of score 0.8 at each point of the sweep."""

    fingerprint, detection_range = bytes(8), BevGrid(-100.0, -40.0, -3.0, 100.0, 40.0, 1.0)
    grid, score_calibration = detection_range, None

    def detect(self, cloud: PointCloud, earlier: PointCloud | None) -> Boxes:
        n = len(cloud)
        size = torch.tensor([[4.5, 1.9, 1.6]]).expand(n, 3)
        return replace(Boxes.of(cloud.xyz, size, torch.zeros(n)), score=torch.full((n,), 0.8))


def found(name: str, steps: list[tuple[AgentFrame, list[Message]]]) -> list[list[float]]:
    """Places of boxes, frame by frame."""
    cache, strategy = PerceptionCache(PointDetector()), get_strategy(name)
    out = []
    for now, messages in steps:
        cache.process(now)
        out.append(sorted(round(x, 3) for x in strategy.fuse(cache, now, messages).center[:, 0].tolist()))
    return out


def test_no_fusion_forgets_and_its_temporal_form_remembers_two_frames() -> None:
    """A car at 20 m is seen in the first frame alone; another at 40 m always."""
    steps = [(frame(0, 20, 40), []), (frame(1, 40), []), (frame(2, 40), []), (frame(3, 40), [])]
    assert found("no-fusion", steps) == [[20, 40], [40], [40], [40]]
    assert found("no-fusion-temporal", steps) == [[20, 40], [20, 40], [20, 40], [40]]


def test_early_fusion_detects_on_the_present_merged_cloud_and_its_temporal_form_on_three() -> None:
    """The sender, 10 m ahead, sends a car at its 20 m in the first frame alone."""
    steps = [(frame(0, 40), [message(0, 20.0)]), *((frame(k, 40), []) for k in (1, 2, 3))]
    assert found("early", steps) == [[30, 40], [40], [40], [40]]
    assert found("early-temporal", steps) == [[30, 40], [30, 40], [30, 40], [40]]


def test_clouds_are_merged_in_the_egos_frame_and_thinned_out() -> None:
    merged = merge_clouds(frame(3, 1.0), [message(3, -4.0)])
    assert merged.points.xyz[:, 0].tolist() == [1.0, 6.0] and merged.timestamp_ns == 3 * TENTH_NS
    flood = replace(message(3), points=PointCloud.of(torch.zeros(3 * MIN_POINT_LIMIT, 3)))
    assert len(merge_clouds(frame(3), [flood]).points) == MIN_POINT_LIMIT


@pytest.fixture(scope="module")
def detector() -> Detector:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Detector(COSTR_TINY).eval()


def sweep(at: int, agent_id: int = 0) -> AgentFrame:
    rng = torch.Generator().manual_seed(at + 10 * agent_id)
    xyz = (torch.rand(300, 3, generator=rng) - 0.5) * torch.tensor([30.0, 20.0, 2.0])
    return AgentFrame.of(PointCloud.of(xyz), Transform.from_xyz_yaw(2.0 * agent_id, 0.0), agent_id, at * TENTH_NS)


def test_intermediate_fusion_takes_own_past_tokens_in_its_temporal_form_alone(detector) -> None:
    cache, frames = PerceptionCache(detector), [sweep(k) for k in range(3)]
    outputs = [cache.process_tokens(f) for f in frames]
    counts = [len(o.shared_tokens.sites) for o in outputs]
    tokens, past = IntermediateFusion().gather(cache, frames[2], ())
    assert past is None and len(tokens.xy) == counts[2] and not tokens.age.any()
    tokens, past = IntermediateFusion(uses_history=True).gather(cache, frames[2], ())
    assert past is not None and len(tokens.xy) == sum(counts) and len(past.xy) == sum(counts[:2])


def test_without_messages_the_temporal_form_of_no_fusion_is_that_of_intermediate(detector) -> None:
    """The ego alone with the memory of intermediate fusion; untrained weights find enough to compare."""
    played = {}
    for name in ("no-fusion-temporal", "intermediate-temporal"):
        agent = Agent(detector, get_strategy(name))
        played[name] = [agent.perceive(sweep(k)).boxes for k in range(3)][-1]
    a, b = played["no-fusion-temporal"], played["intermediate-temporal"]
    assert len(a) and torch.equal(a.center, b.center) and torch.equal(a.score, b.score)


@pytest.mark.parametrize("name", ["intermediate", "late", "late-weighted", "intermediate-multihop"])
def test_one_frame_alone_is_the_same_in_both_forms(detector, name) -> None:
    one, other = (Agent(detector, get_strategy(n)) for n in (name, name + TEMPORAL))
    packets = Agent(detector, get_strategy(name)).share(sweep(0, 3))
    a, b = one.perceive(sweep(0), packets).boxes, other.perceive(sweep(0), packets).boxes
    assert len(a)
    assert torch.equal(a.center, b.center) and torch.equal(a.score, b.score)


def test_memory_does_not_need_the_frame_to_be_processed_before(detector) -> None:
    cache = PerceptionCache(detector)
    counts = [len(cache.process_tokens(sweep(k)).shared_tokens.sites) for k in range(2)]
    _, past = IntermediateFusion(uses_history=True).gather(cache, sweep(2), ())
    assert past is not None and len(past.xy) == sum(counts)


@pytest.mark.parametrize("name", ["intermediate", "intermediate-temporal"])
def test_tokens_below_the_least_score_of_the_weights_are_not_sent_without_any_budget(name) -> None:
    """The sender's own boxes stay as they are."""
    now = sweep(0)

    def play(least: float) -> tuple[torch.Tensor, Boxes]:
        torch.manual_seed(0)
        agent = Agent(Detector(replace(COSTR_TINY, min_sent_score=least)).eval(), get_strategy(name), budget_bytes=None)
        message = get_strategy(name).compose_message(agent.perception_cache, now)
        assert message is not None and message.token_score is not None
        return message.token_score, agent.perceive(now).boxes

    every, own = play(0.0)
    least = float(every.median())
    sent, same = play(least)
    assert torch.equal(sent, every[every >= least]) and 0 < len(sent) < len(every)
    assert len(own) and torch.equal(own.center, same.center)
