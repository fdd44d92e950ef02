# SPDX-License-Identifier: Apache-2.0
"""The order in which tokens are said: the surest word on each object, and on those first that were not spoken of just now."""

from __future__ import annotations

import math
from typing import cast

import pytest
import torch
from torch import Tensor

from manyeyes.agents.agent import Agent
from manyeyes.agents.perception_cache import Eyes, Sight
from manyeyes.agents.strategies import method
from manyeyes.agents.strategies.intermediate import confidence
from manyeyes.agents.strategies.redundancy import AGAIN, SAME_OBJECT_M, centres, unsaid
from manyeyes.datatypes import AgentFrame, BevGrid, PointCloud, SparseBev, Transform
from manyeyes.models.detector.box_head import RAW, SPEED_UNIT, DecodeConfig, RawBoxes
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.proposal import PROPOSAL, proposed_heat, proposed_velocity

torch.set_num_threads(1)

TENTH_NS = 100_000_000
GRID = BevGrid(-32.0, -32.0, -2.0, 32.0, 32.0, 2.0, pillar=0.5).at(4)
"""Cells of 2 m."""


def told(xy: list[tuple[float, float]], sure: list[float], speed: float = 0.0) -> SparseBev:
    """Tokens whose objects stand at xy, each in the cell there, sure of themselves as told, driving along x."""
    at, proposal = torch.tensor(xy), torch.zeros(len(xy), PROPOSAL)
    yx = GRID.cells(at)
    proposal[:, RAW.heat] = torch.logit(torch.tensor(sure))[:, None]
    proposal[:, RAW.offset] = (at - GRID.centers(yx)) / GRID.cell
    proposal[:, RAW.velocity.start] = speed / SPEED_UNIT
    return SparseBev.from_cells(torch.cat((torch.zeros(len(xy), 4), proposal), 1), yx, GRID)


def frame(index: int, x: float = 0.0, yaw: float = 0.0, agent: int = 1) -> AgentFrame:
    pose = Transform.from_xyz_yaw(x, 0.0, 0.0, yaw)
    return AgentFrame.of(PointCloud.of(torch.zeros(1, 3)), pose, agent_id=agent, timestamp_ns=index * TENTH_NS)


def eyes_that_saw(*views: tuple[AgentFrame, SparseBev]) -> Eyes:
    """Eyes that need no detector: what they make of these frames is known."""
    nothing = cast(RawBoxes, None)
    known = {(f.agent_id, f.timestamp_ns): Sight(t, t, nothing, DecodeConfig()) for f, t in views}
    return Eyes(cast(Detector, None), known=known)


def at(tokens: SparseBev, value: Tensor, x: float, y: float) -> float:
    """The value of the token whose object stands there."""
    apart = (centres(tokens) - torch.tensor([x, y])).norm(dim=1)
    assert float(apart.min()) < 1e-4
    return float(value[apart.argmin()])


def test_of_one_object_the_surest_word_counts_whole_and_each_further_one_less():
    """Two vehicles: three tokens in a row around the first, one on the second."""
    now = frame(5)
    tokens = told([(0.1, 0.0), (1.9, 0.0), (-1.7, 0.0), (12.0, 3.0)], [0.9, 0.8, 0.7, 0.6])
    worth = unsaid(eyes_that_saw((now, tokens)), now)
    assert at(tokens, worth, 0.1, 0.0) == pytest.approx(0.9)
    assert at(tokens, worth, 1.9, 0.0) == pytest.approx(0.8 * AGAIN)
    # 3.6 m lie between this one and the second: it comes after the first alone.
    assert at(tokens, worth, -1.7, 0.0) == pytest.approx(0.7 * AGAIN)
    assert at(tokens, worth, 12.0, 3.0) == pytest.approx(0.6)


def test_what_was_said_just_now_is_worth_less_where_it_should_be_by_now():
    """Vehicles at 15 m/s; the agent drives 1 m and turns by 90 degrees: one was said, of the other it was not spoken."""
    then, now = frame(4), frame(5, x=1.0, yaw=math.pi / 2)
    before = told([(10.0, 4.0)], [0.9], speed=15.0)
    # (10 + 1.5, 4) in the frame of then is (10.5, 4) from the agent's new place, turned: (4, -10.5).
    tokens = told([(4.0, -10.5), (4.0, -13.0)], [0.9, 0.7])
    eyes = eyes_that_saw((then, before), (now, tokens))
    eyes.said(then, eyes.see(then).told)
    worth = unsaid(eyes, now)
    assert at(tokens, worth, 4.0, -10.5) == pytest.approx(0.9 * AGAIN)
    assert at(tokens, worth, 4.0, -13.0) == pytest.approx(0.7)


def test_said_twice_counts_once_and_what_listeners_forgot_is_new_again():
    frames = [frame(i) for i in range(6)]
    standing = told([(5.0, 5.0)], [0.8])
    eyes = eyes_that_saw(*((f, standing) for f in frames))
    for last in (0, 1, 2):
        eyes.said(frames[last], standing)
        assert unsaid(eyes, frames[last + 1]).tolist() == pytest.approx([0.8 * AGAIN])
    eyes.said(frames[3], standing.keep(torch.tensor([False])))
    assert unsaid(eyes, frames[4]).tolist() == pytest.approx([0.8 * AGAIN])
    eyes.said(frames[4], standing.keep(torch.tensor([False])))
    assert unsaid(eyes, frames[5]).tolist() == pytest.approx([0.8])


def test_the_same_frame_said_anew_takes_the_first_word_back():
    frames, standing = [frame(i) for i in range(2)], told([(5.0, 5.0)], [0.8])
    eyes = eyes_that_saw(*((f, standing) for f in frames))
    eyes.said(frames[0], standing)
    assert unsaid(eyes, frames[0]).tolist() == pytest.approx([0.8])
    eyes.said(frames[0], standing.keep(torch.tensor([False])))
    assert unsaid(eyes, frames[1]).tolist() == pytest.approx([0.8])


@pytest.mark.parametrize("later", [frame(4), frame(1, x=31.0), frame(1, agent=2), frame(-1)])
def test_after_a_gap_a_leap_or_another_agent_all_is_new(later: AgentFrame):
    first, standing = frame(0), told([(5.0, 5.0)], [0.8])
    eyes = eyes_that_saw(
        (first, standing), (later, told([(5.0 - float(later.world_from_agent.translation[0]), 5.0)], [0.8]))
    )
    eyes.said(first, standing)
    assert unsaid(eyes, later).tolist() == pytest.approx([0.8])


def test_against_loops_over_tokens(drive, detector: Detector):
    """Token by token: how many surer ones of this message, and whether any of the last two, speak of the same place."""
    frames = [drive().frame(1, i) for i in range(4)]
    eyes = Eyes(detector)
    rng = torch.Generator().manual_seed(0)
    spoken = []
    for f in frames[:-1]:
        seen = eyes.see(f).told
        kept = seen.keep(torch.rand(len(seen.sites), generator=rng) < 0.15)
        eyes.said(f, kept)
        spoken.append((f, kept))
    now = frames[-1]
    tokens = eyes.see(now).told
    heat, place = proposed_heat(tokens.features[:, -PROPOSAL:]).tolist(), centres(tokens).tolist()
    known = []
    for f, kept in spoken[-2:]:
        seconds = (now.timestamp_ns - f.timestamp_ns) / 1e9
        for (x, y), (vx, vy) in zip(centres(kept).tolist(), proposed_velocity(kept.features[:, -PROPOSAL:]).tolist()):
            there = torch.tensor([[x + vx * seconds, y + vy * seconds, 0.0]]).double()
            known.append(now.from_earlier(f).apply(there)[0, :2].tolist())
    expected, again = [], 0
    for h, p in zip(heat, place):
        words = sum(other > h and math.dist(p, q) < SAME_OBJECT_M for other, q in zip(heat, place))
        old = any(math.dist(p, q) < SAME_OBJECT_M for q in known)
        again += old
        expected.append(AGAIN ** (words + old) / (1 + math.exp(-h)))
    assert 0 < again < len(heat) > 20
    torch.testing.assert_close(unsaid(eyes, now), torch.tensor(expected), atol=1e-5, rtol=1e-5)


def test_few_bytes_speak_of_more_objects_in_three_messages_than_the_surest_tokens_do(drive, detector: Detector):
    """And one frame shared twice, once within less, is the same bytes: only what went out at earlier instants counts."""

    def objects(name: str) -> int:
        agent, places = Agent(detector, method(name), "float16", budget_bytes=700), []
        for i in range(3):
            f = drive(speed_mps=0.0, agent_mps=0.0).frame(1, i)
            agent.share(f, 400)
            packets = agent.share(f)
            assert packets == agent.share(f) and sum(map(len, packets)) <= 700
            (heard,) = Agent(detector).perceive(drive().frame(0, i), packets).heard
            assert heard.message.tokens is not None
            places.append(centres(heard.message.tokens))
        found: list[Tensor] = []
        for place in torch.cat(places):
            if all(float((place - other).norm()) >= SAME_OBJECT_M for other in found):
                found.append(place)
        return len(found)

    assert objects("intermediate") > objects("confidence")


def test_no_tokens_are_no_worth(drive, detector: Detector):
    now = frame(0)
    none = told([(0.0, 0.0)], [0.5]).keep(torch.tensor([False]))
    eyes = eyes_that_saw((now, none))
    assert unsaid(eyes, now).shape == confidence(eyes, now).shape == (0,)
