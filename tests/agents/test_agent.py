# SPDX-License-Identifier: Apache-2.0
"""share → bytes → perceive: the path that training sees, and what it does with bytes it cannot trust."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.perception_cache import Eyes
from manyeyes.agents.strategies import METHODS, method
from manyeyes.comms.inbox import Inbox
from manyeyes.datatypes import AgentFrame, ConfigError, Message, PointCloud, Transform
from manyeyes.models.detector.box_head import RawBoxes
from manyeyes.models.detector.detector import Detector
from manyeyes.models.fusion.transform_tokens import Part, Tokens
from manyeyes.training.detector.samples import AugmentConfig, RoadConfig, View, make_sample
from manyeyes.training.detector.step import forward

NOW = 5


class RecordingEyes(Eyes):
    """Keeps what the ego fused last; looks back at so many instants, and states velocities as the detector does."""

    raw: RawBoxes
    heard: Tokens
    remembered: Tokens | None

    def __init__(self, detector: Detector, instants: int) -> None:
        super().__init__(detector, tracks=None)
        self.instants = instants

    def past(self, frame: AgentFrame, instants: int = 2) -> list[Part]:
        return super().past(frame, self.instants)

    def fuse(self, tokens: Tokens, past: Tokens | None = None) -> RawBoxes:
        self.heard, self.remembered = tokens, past
        self.raw = super().fuse(tokens, past)
        return self.raw


def told_by_bytes(drive, detector: Detector, views: Sequence[View], first: int) -> tuple[list[bytes], list[Message]]:
    """Packets of those who had these views, and what they say: each looked when, and claims to be where, its view has it."""
    ego, packets, inbox = drive.frame(0, NOW).world_from_agent, [], Inbox(detector.fingerprint)
    for view in views:
        then = NOW - round(view.age_s / 0.1)
        (true,) = (f for f in drive.frames(then) if torch.equal(f.points.xyz, view.now.xyz))
        sender = Agent(detector, precision="float32", budget_bytes=None, eyes=Eyes(detector, tracks=None))
        if then > first:
            sender.share(drive.frame(true.agent_id, then - 1))
        sigma = torch.tensor([view.doubt_xy_m, view.doubt_xy_m, view.doubt_yaw_rad]).double()
        claim = replace(true, odometry=true.world_from_agent, world_from_agent=ego @ view.ego_from_view)
        packets += sender.share(replace(claim, pose_covariance=(sigma**2).diag()))
    for packet in packets:
        inbox.push(packet)
    return packets, list(inbox.messages())


def as_said(drive, views: Sequence[View], messages: list[Message]) -> tuple[View, ...]:
    """The views with the doubts that arrived: a standard deviation travels as a code of one byte."""
    ego, said = drive.frame(0, NOW).world_from_agent, []
    for view in views:
        place = (ego @ view.ego_from_view).translation
        message = min(messages, key=lambda m: float(place.dist(m.world_from_agent.translation)))
        sigma = message.pose_covariance.diagonal().sqrt().tolist()
        assert sigma[0] == pytest.approx(view.doubt_xy_m, rel=0.1) and sigma[2] == pytest.approx(
            view.doubt_yaw_rad, rel=0.1
        )
        said.append(replace(view, doubt_xy_m=sigma[0], doubt_yaw_rad=sigma[2]))
    return tuple(said)


ROADS = {
    "one sweep": (3, 1, RoadConfig()),
    "two sweeps": (3, 2, RoadConfig()),
    "past": (2, 4, RoadConfig(past=2)),
    "alone with a past": (1, 4, RoadConfig(past=2)),
    "late": (3, 4, RoadConfig(late_share=1.0, late_frames=2)),
    "astray": (2, 2, RoadConfig(astray_share=1.0)),
    "said before": (3, 4, RoadConfig(past=2, said=1)),
    "all": (3, 5, RoadConfig(past=2, said=1, late_share=1.0, late_frames=2, astray_share=1.0)),
}


@pytest.mark.parametrize("name", ROADS)
def test_training_forward_equals_share_bytes_perceive(drive, detector: Detector, name: str) -> None:
    """With float32 features, what training computes and what the bytes give agree within 1e-5, site by site.

    Boxes are not followed: training sees two sweeps of an instant, and the velocities that the detector states.
    """
    agents, moments, road = ROADS[name]
    some, first = drive(agents), NOW + 1 - moments
    seen = [some.snapshot(i) for i in range(first, NOW + 1)]
    sample = make_sample(seen, 0, detector.config.grid, AugmentConfig.none(), ("same", 1), road)
    packets, messages = told_by_bytes(some, detector, sample.views[1:], first)
    before, older = told_by_bytes(some, detector, sample.said, first)
    assert len(sample.said) == road.said * (agents - 1)
    views = (sample.views[0], *as_said(some, sample.views[1:], messages))
    with torch.no_grad():
        trained = forward(detector, [replace(sample, views=views, said=as_said(some, sample.said, older))]).together
    eyes = RecordingEyes(detector, road.past)
    ego = Agent(detector, precision="float32", eyes=eyes)
    for index in range(first, NOW):
        ego.perceive(some.frame(0, index), before if index == NOW - 1 else ())
    ego.perceive(some.frame(0, NOW), packets)
    # The case is what its name says, and there is something to compare.
    heard = eyes.heard
    assert len(sample.views) == agents and len(sample.past) == road.past and len(trained.sites) > 20
    aged = bool(road.late_share or road.past or road.said)
    assert bool(heard.age.any()) == aged and bool(heard.doubt.any()) == bool(road.astray_share)
    assert (eyes.remembered is not None and len(eyes.remembered.features) > 20) == bool(road.past)
    assert torch.equal(trained.sites.key, eyes.raw.sites.key)
    for name in (f.name for f in fields(RawBoxes) if f.name != "sites"):
        a, b = getattr(trained, name), getattr(eyes.raw, name)
        assert torch.allclose(a, b, atol=1e-5), (name, float((a - b).abs().max()))


def test_collaborators_change_what_the_ego_sees(drive, detector: Detector) -> None:
    frames = drive(2).frames()
    blind = replace(frames[0], points=PointCloud.of(torch.tensor([[1.0, 1.0, 0.0]])))
    packets = Agent(detector).share(frames[1])
    assert len(Agent(detector).perceive(blind, packets).boxes) > len(Agent(detector).perceive(blind).boxes)


@pytest.mark.parametrize("name", METHODS)
def test_an_empty_cloud_and_an_empty_inbox_give_no_error(detector: Detector, name: str) -> None:
    empty = AgentFrame.of(PointCloud.of(torch.zeros(0, 3)), Transform.identity(), agent_id=7)
    agent = Agent(detector, method(name))
    packets = agent.share(empty)
    found = Agent(detector, method(name)).perceive(replace(empty, agent_id=8), packets)
    assert len(found.boxes) == 0


def test_a_message_never_exceeds_its_budget(drive, detector: Detector) -> None:
    frame = drive(1).frame(0, 3)
    free = sum(map(len, Agent(detector, budget_bytes=None).share(frame)))
    for budget in (0, 200, 1000, free // 2, free):
        sent = sum(map(len, Agent(detector, budget_bytes=budget).share(frame)))
        # An agent with no room for a cell still says where it is: the header.
        assert sent <= max(budget, 200), (budget, sent)


def test_tokens_of_other_weights_change_nothing(drive, detector: Detector) -> None:
    frames = drive(2).frames()
    packets = Agent(detector).share(frames[1])
    ego = Agent(detector)
    alone = ego.perceive(frames[0]).boxes
    detector.fingerprint = b"othertes"
    strange = ego.perceive(frames[0], packets)
    detector.fingerprint = b"testtest"
    assert torch.equal(alone.bev(), strange.boxes.bev())


def test_an_agent_does_not_hear_itself_nor_report_its_own_body(drive, detector: Detector) -> None:
    frame = drive(1).frame(0, 3)
    agent = Agent(detector)
    assert agent.perceive(frame, agent.share(frame)).heard == ()
    boxes = agent.perceive(frame).boxes
    assert not bool(((boxes.center[:, 0].abs() <= 2.6) & (boxes.center[:, 1].abs() <= 1.3)).any())


def test_late_fusion_keeps_one_box_of_two_that_overlap(drive, detector: Detector) -> None:
    """What another says of the very same boxes adds none; the same boxes aside add all that lie in the ego's range."""
    frame = drive(1).frame(0, 3)
    eyes, late = Eyes(detector), method("late")
    said = late.say(eyes, frame)
    assert said is not None and said.objects is not None
    own = eyes.see(frame).boxes
    assert len(late.hear(eyes, frame, [said])) == len(own) > 0
    aside = replace(said, world_from_agent=frame.world_from_agent @ Transform.from_xyz_yaw(0.0, 200.0))
    assert len(late.hear(eyes, frame, [aside])) == len(own)
    lattice = torch.cartesian_prod(torch.arange(-24.0, 25.0), torch.arange(-24.0, 25.0), torch.tensor([0.8]))
    free = lattice[torch.cdist(lattice[:, :2], own.center[:, :2]).min(1).values.argmax()][None]
    one = replace(said, objects=replace(own[:1], center=free, size=torch.tensor([[0.5, 0.5, 1.5]])))
    assert len(late.hear(eyes, frame, [one])) == len(own) + 1


def test_an_unknown_method_lists_the_known() -> None:
    with pytest.raises(ConfigError, match=", ".join(METHODS)):
        method("telepathy")
