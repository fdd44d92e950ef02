# SPDX-License-Identifier: Apache-2.0
"""share → bytes → perceive: the path that training sees, and what it does with bytes it cannot trust."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.collaboration import METHODS, method
from manyeyes.agents.eyes import Eyes
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, PointCloud, Transform
from manyeyes.models.box_head import RawBoxes
from manyeyes.models.detector import Detector
from manyeyes.models.fusion.gather import Tokens
from manyeyes.models.presets import COSTR_TINY
from manyeyes.training.samples import Sample
from manyeyes.training.step import forward, loss_terms
from manyeyes.training.targets import TargetConfig


def make_scene(agents: int) -> Sample:
    """Eight cars on a plane, their surfaces sampled, seen whole by every agent from its own place and heading."""
    rng = torch.Generator().manual_seed(3)
    center = torch.cat(((torch.rand(8, 2, generator=rng) - 0.5) * 36, torch.full((8, 1), 0.8)), 1)
    yaw = (torch.rand(8, generator=rng) - 0.5) * 2 * math.pi
    boxes = Boxes.of(center, torch.tensor([4.5, 1.9, 1.6]).repeat(8, 1), yaw, id=torch.arange(8))
    surface = torch.rand(8, 120, 3, generator=rng) - 0.5
    face = torch.randint(0, 3, (8, 120, 1), generator=rng)
    surface.scatter_(2, face, surface.gather(2, face).sign() * 0.5)
    local = surface * boxes.size[:, None]
    c, s = yaw.cos()[:, None], yaw.sin()[:, None]
    moved = torch.stack(
        (local[..., 0] * c - local[..., 1] * s, local[..., 0] * s + local[..., 1] * c, local[..., 2]), -1
    )
    ground = torch.cat(((torch.rand(1500, 2, generator=rng) - 0.5) * 50, torch.zeros(1500, 1)), 1)
    points = torch.cat(((moved + center[:, None]).flatten(0, 1), ground))
    poses = [Transform.identity(), Transform.from_xyz_yaw(6, -3, 0, 0.7), Transform.from_xyz_yaw(-9, 4, 0.2, -2.0)][
        :agents
    ]
    clouds = tuple(PointCloud.of(pose.inverse().apply(points)) for pose in poses)
    return Sample(clouds, tuple(poses), tuple(boxes.transform(pose.inverse()) for pose in poses), boxes)


@pytest.fixture(scope="module")
def detector() -> Detector:
    """Tiny weights whose norms have seen something; a low threshold so that there is much to compare."""
    torch.manual_seed(0)
    config = replace(COSTR_TINY, prune_threshold=0.08)
    model = Detector(config)
    with torch.no_grad():
        for p in model.fusion.placement.outer.parameters():
            p.normal_(std=0.1)
        for _ in range(40):
            loss_terms(model, [make_scene(3)], TargetConfig(), 0.0)
    model.fingerprint = b"testtest"
    return model.eval().requires_grad_(False)


def frames_of(sample: Sample, world: Transform | None = None) -> list[AgentFrame]:
    world = world or Transform.identity()
    return [
        AgentFrame.of(c, world @ t, agent_id=i) for i, (c, t) in enumerate(zip(sample.clouds, sample.ego_from_agent))
    ]


class RecordingEyes(Eyes):
    """Keeps the raw boxes that the ego decoded last."""

    raw: RawBoxes

    def fuse(self, tokens: Tokens) -> RawBoxes:
        self.raw = super().fuse(tokens)
        return self.raw


@pytest.mark.parametrize("agents", [1, 2, 3])
def test_training_forward_equals_share_bytes_perceive(detector: Detector, agents: int) -> None:
    """With float32 features, what training computes and what the bytes give agree within 1e-5, site by site."""
    sample = make_scene(agents)
    with torch.no_grad():
        trained = forward(detector, [sample]).together
    frames = frames_of(sample, Transform.from_xyz_yaw(1234.5, -678.9, 3.0, 0.4))
    eyes = RecordingEyes(detector)
    packets = [p for f in frames[1:] for p in Agent(detector, precision="float32", budget_bytes=None).share(f)]
    Agent(detector, precision="float32", eyes=eyes).perceive(frames[0], packets)
    rows = trained.sites.batch == 0
    assert int(rows.sum()) > 20
    assert torch.equal(trained.sites.key[rows], eyes.raw.sites.key)
    for name in ("heat", "offset", "z", "log_size", "axis", "direction", "log_sigma_xy", "overlap"):
        a, b = getattr(trained, name)[rows], getattr(eyes.raw, name)
        assert torch.allclose(a, b, atol=1e-5), (name, float((a - b).abs().max()))


def test_collaborators_change_what_the_ego_sees(detector: Detector) -> None:
    frames = frames_of(make_scene(2))
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


def test_a_message_never_exceeds_its_budget(detector: Detector) -> None:
    frame = frames_of(make_scene(1))[0]
    free = sum(map(len, Agent(detector, budget_bytes=None).share(frame)))
    for budget in (0, 200, 1000, free // 2, free):
        sent = sum(map(len, Agent(detector, budget_bytes=budget).share(frame)))
        # An agent with no room for a cell still says where it is: the header.
        assert sent <= max(budget, 200), (budget, sent)


def test_tokens_of_other_weights_change_nothing(detector: Detector) -> None:
    frames = frames_of(make_scene(2))
    packets = Agent(detector).share(frames[1])
    ego = Agent(detector)
    alone = ego.perceive(frames[0]).boxes
    detector.fingerprint = b"othertes"
    strange = ego.perceive(frames[0], packets)
    detector.fingerprint = b"testtest"
    assert torch.equal(alone.bev(), strange.boxes.bev())


def test_an_agent_does_not_hear_itself_nor_report_its_own_body(detector: Detector) -> None:
    frame = frames_of(make_scene(1))[0]
    agent = Agent(detector)
    assert agent.perceive(frame, agent.share(frame)).heard == ()
    boxes = agent.perceive(frame).boxes
    assert not bool(((boxes.center[:, 0].abs() <= 2.6) & (boxes.center[:, 1].abs() <= 1.3)).any())


def test_late_fusion_keeps_one_box_of_two_that_overlap(detector: Detector) -> None:
    """What another says of the very same boxes adds none; the same boxes far aside add all."""
    frame = frames_of(make_scene(1))[0]
    eyes, late = Eyes(detector), method("late")
    said = late.say(eyes, frame)
    assert said is not None and said.objects is not None
    own = eyes.see(frame).boxes
    assert len(late.hear(eyes, frame, [said])) == len(own) > 0
    far = replace(said, world_from_agent=Transform.from_xyz_yaw(0.0, 200.0))
    assert len(late.hear(eyes, frame, [far])) == len(own) + len(said.objects)


def test_an_unknown_method_lists_the_known() -> None:
    with pytest.raises(ConfigError, match="alone, late, intermediate, early"):
        method("telepathy")
