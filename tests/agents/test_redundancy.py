# SPDX-License-Identifier: Apache-2.0
"""Redundancy-aware token scores: the most confident token of each object first, objects not sent recently before others."""

from __future__ import annotations

import math
from typing import cast

import pytest
import torch
from torch import Tensor

from manyeyes.agents.agent import Agent
from manyeyes.agents.perception_cache import PerceptionCache, TokenOutput
from manyeyes.agents.strategies.intermediate import confidence_score
from manyeyes.agents.strategies.redundancy import REDUNDANCY_DECAY, SAME_OBJECT_M, novelty_score, proposed_centres
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.datatypes import AgentFrame, BevGrid, PointCloud, SparseBev, Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT, SPEED_UNIT, DecodeConfig, RawBoxes
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat, proposed_velocity

torch.set_num_threads(1)

TENTH_NS = 100_000_000
GRID = BevGrid(-32.0, -32.0, -2.0, 32.0, 32.0, 2.0, pillar=0.5).at(4)
"""Cells of 2 m."""


def make_tokens(xy: list[tuple[float, float]], confidence: list[float], speed: float = 0.0) -> SparseBev:
    """Tokens of objects at xy, each in its cell, with the given confidence, moving along x."""
    at, proposal = torch.tensor(xy), torch.zeros(len(xy), PROPOSAL_DIM)
    yx = GRID.cells(at)
    proposal[:, BOX_LAYOUT.heatmap_logit] = torch.logit(torch.tensor(confidence))[:, None]
    proposal[:, BOX_LAYOUT.offset] = (at - GRID.centers(yx)) / GRID.cell_size_m
    proposal[:, BOX_LAYOUT.velocity.start] = speed / SPEED_UNIT
    return SparseBev.from_cells(torch.cat((torch.zeros(len(xy), 4), proposal), 1), yx, GRID)


def frame(index: int, x: float = 0.0, yaw: float = 0.0, agent: int = 1) -> AgentFrame:
    pose = Transform.from_xyz_yaw(x, 0.0, 0.0, yaw)
    return AgentFrame.of(PointCloud.of(torch.zeros(1, 3)), pose, agent_id=agent, timestamp_ns=index * TENTH_NS)


def cache_of(*views: tuple[AgentFrame, SparseBev]) -> PerceptionCache:
    """A perception cache with fixed outputs for these frames, without a detector."""
    nothing = cast(RawBoxes, None)
    feature_cache = {(f.agent_id, f.timestamp_ns): TokenOutput(t, t, nothing, DecodeConfig()) for f, t in views}
    return PerceptionCache(cast(Detector, None), feature_cache=feature_cache)


def at(tokens: SparseBev, value: Tensor, x: float, y: float) -> float:
    """The value of the token whose object stands there."""
    apart = (proposed_centres(tokens) - torch.tensor([x, y])).norm(dim=1)
    assert float(apart.min()) < 1e-4
    return float(value[apart.argmin()])


def test_redundant_tokens_of_one_object_are_discounted():
    """Two vehicles: three tokens in a row around the first, one on the second."""
    now = frame(5)
    tokens = make_tokens([(0.1, 0.0), (1.9, 0.0), (-1.7, 0.0), (12.0, 3.0)], [0.9, 0.8, 0.7, 0.6])
    score = novelty_score(cache_of((now, tokens)), now)
    assert at(tokens, score, 0.1, 0.0) == pytest.approx(0.9)
    assert at(tokens, score, 1.9, 0.0) == pytest.approx(0.8 * REDUNDANCY_DECAY)
    # 3.6 m lie between this one and the second: it comes after the first alone.
    assert at(tokens, score, -1.7, 0.0) == pytest.approx(0.7 * REDUNDANCY_DECAY)
    assert at(tokens, score, 12.0, 3.0) == pytest.approx(0.6)


def test_recently_sent_objects_are_discounted_at_their_predicted_position():
    """Vehicles at 15 m/s; the agent drives 1 m and turns by 90 degrees: one was sent, the other was not."""
    then, now = frame(4), frame(5, x=1.0, yaw=math.pi / 2)
    before = make_tokens([(10.0, 4.0)], [0.9], speed=15.0)
    # (10 + 1.5, 4) in the frame of then is (10.5, 4) from the agent's new place, turned: (4, -10.5).
    tokens = make_tokens([(4.0, -10.5), (4.0, -13.0)], [0.9, 0.7])
    cache = cache_of((then, before), (now, tokens))
    cache.record_sent(then, cache.process(then).shared_tokens)
    score = novelty_score(cache, now)
    assert at(tokens, score, 4.0, -10.5) == pytest.approx(0.9 * REDUNDANCY_DECAY)
    assert at(tokens, score, 4.0, -13.0) == pytest.approx(0.7)


def test_repeated_tokens_count_once_and_expire_with_the_history():
    frames = [frame(i) for i in range(6)]
    standing = make_tokens([(5.0, 5.0)], [0.8])
    cache = cache_of(*((f, standing) for f in frames))
    for last in (0, 1, 2):
        cache.record_sent(frames[last], standing)
        assert novelty_score(cache, frames[last + 1]).tolist() == pytest.approx([0.8 * REDUNDANCY_DECAY])
    cache.record_sent(frames[3], standing.keep(torch.tensor([False])))
    assert novelty_score(cache, frames[4]).tolist() == pytest.approx([0.8 * REDUNDANCY_DECAY])
    cache.record_sent(frames[4], standing.keep(torch.tensor([False])))
    assert novelty_score(cache, frames[5]).tolist() == pytest.approx([0.8])


def test_recording_a_frame_again_replaces_its_sent_tokens():
    frames, standing = [frame(i) for i in range(2)], make_tokens([(5.0, 5.0)], [0.8])
    cache = cache_of(*((f, standing) for f in frames))
    cache.record_sent(frames[0], standing)
    assert novelty_score(cache, frames[0]).tolist() == pytest.approx([0.8])
    cache.record_sent(frames[0], standing.keep(torch.tensor([False])))
    assert novelty_score(cache, frames[1]).tolist() == pytest.approx([0.8])


@pytest.mark.parametrize("later", [frame(4), frame(1, x=31.0), frame(1, agent=2), frame(-1)])
def test_after_a_gap_a_leap_or_another_agent_all_is_new(later: AgentFrame):
    first, standing = frame(0), make_tokens([(5.0, 5.0)], [0.8])
    cache = cache_of(
        (first, standing), (later, make_tokens([(5.0 - float(later.world_from_agent.translation[0]), 5.0)], [0.8]))
    )
    cache.record_sent(first, standing)
    assert novelty_score(cache, later).tolist() == pytest.approx([0.8])


def test_against_loops_over_tokens(drive, detector: Detector):
    """Token by token: the number of more confident tokens of the same object in this message, and in the last two messages."""
    frames = [drive().frame(1, i) for i in range(4)]
    cache = PerceptionCache(detector)
    rng = torch.Generator().manual_seed(0)
    sent = []
    for f in frames[:-1]:
        tokens_then = cache.process(f).shared_tokens
        kept = tokens_then.keep(torch.rand(len(tokens_then.sites), generator=rng) < 0.15)
        cache.record_sent(f, kept)
        sent.append((f, kept))
    now = frames[-1]
    tokens = cache.process(now).shared_tokens
    heat, place = proposed_heat(tokens.features[:, -PROPOSAL_DIM:]).tolist(), proposed_centres(tokens).tolist()
    sent_centres = []
    for f, kept in sent[-2:]:
        seconds = (now.timestamp_ns - f.timestamp_ns) / 1e9
        for (x, y), (vx, vy) in zip(
            proposed_centres(kept).tolist(), proposed_velocity(kept.features[:, -PROPOSAL_DIM:]).tolist()
        ):
            there = torch.tensor([[x + vx * seconds, y + vy * seconds, 0.0]]).double()
            sent_centres.append(now.now_from_earlier(f).apply(there)[0, :2].tolist())
    expected, again = [], 0
    for h, p in zip(heat, place):
        num_earlier = sum(other > h and math.dist(p, q) < SAME_OBJECT_M for other, q in zip(heat, place))
        old = any(math.dist(p, q) < SAME_OBJECT_M for q in sent_centres)
        again += old
        expected.append(REDUNDANCY_DECAY ** (num_earlier + old) / (1 + math.exp(-h)))
    assert 0 < again < len(heat) > 20
    torch.testing.assert_close(novelty_score(cache, now), torch.tensor(expected), atol=1e-5, rtol=1e-5)


def test_a_small_budget_covers_more_objects_than_confidence_selection(drive, detector: Detector):
    """And one frame shared twice, once within less, is the same bytes: only what went out at earlier instants counts."""

    def objects(name: str) -> int:
        agent, places = Agent(detector, get_strategy(name), "float16", budget_bytes=700), []
        for i in range(3):
            f = drive(speed_mps=0.0, agent_mps=0.0).frame(1, i)
            agent.share(f, 400)
            packets = agent.share(f)
            assert packets == agent.share(f) and sum(map(len, packets)) <= 700
            (received,) = Agent(detector).perceive(drive().frame(0, i), packets).received
            assert received.message.tokens is not None
            places.append(proposed_centres(received.message.tokens))
        found: list[Tensor] = []
        for place in torch.cat(places):
            if all(float((place - other).norm()) >= SAME_OBJECT_M for other in found):
                found.append(place)
        return len(found)

    assert objects("intermediate-temporal") > objects("intermediate-confidence-temporal")


def test_no_tokens_give_no_scores(drive, detector: Detector):
    now = frame(0)
    none = make_tokens([(0.0, 0.0)], [0.5]).keep(torch.tensor([False]))
    cache = cache_of((now, none))
    assert novelty_score(cache, now).shape == confidence_score(cache, now).shape == (0,)
