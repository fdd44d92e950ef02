# SPDX-License-Identifier: Apache-2.0
"""share → bytes → perceive: the path that training sees, and what it does with bytes it cannot trust."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import ClassVar

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.level_frame import FrameLeveller
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.intermediate import IntermediateFusion
from manyeyes.agents.strategies.registry import get_strategy, list_strategies
from manyeyes.comms import payloads
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.wire import TokenEncoding
from manyeyes.datatypes import AgentFrame, ConfigError, Message, PointCloud, Transform
from manyeyes.models.detector.box_head import RawBoxes
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.fusion.token_merge import FusedBev
from manyeyes.models.fusion.transform_tokens import AgentTokens, Tokens
from manyeyes.training.detector.samples import AgentView, AugmentConfig, DegradationConfig, make_sample
from manyeyes.training.detector.step import forward

NOW = 5


class RecordingCache(PerceptionCache):
    """Stores the last fused tokens; uses num_frames previous frames, and the detector's own velocities."""

    raw: RawBoxes
    fused_tokens: Tokens
    fused_past: Tokens | None

    def __init__(self, detector: Detector, num_frames: int) -> None:
        super().__init__(detector, velocity_config=None)
        self.level, self.num_frames = FrameLeveller(None), num_frames

    def previous_tokens(self, frame: AgentFrame, num_frames: int = 2) -> list[AgentTokens]:
        return super().previous_tokens(frame, self.num_frames)

    def fuse(self, tokens: Tokens, past: Tokens | None = None) -> tuple[FusedBev, RawBoxes]:
        self.fused_tokens, self.fused_past = tokens, past
        fused, self.raw = super().fuse(tokens, past)
        return fused, self.raw


def packets_and_messages(
    drive, detector: Detector, views: Sequence[AgentView], first: int
) -> tuple[list[bytes], list[Message]]:
    """Packets and messages of the agents of these views, with the timestamp and prior pose of each view."""
    ego, packets, inbox = drive.frame(0, NOW).world_from_agent, [], Inbox(detector.fingerprint)
    for view in views:
        then = NOW - round(view.age_s / 0.1)
        cache = PerceptionCache(detector, velocity_config=None)
        cache.level = FrameLeveller(None)
        (true,) = (f for f in drive.frames(then) if torch.equal(f.points.xyz, view.cloud.xyz))
        sender = Agent(
            detector,
            token_encoding="float32",
            budget_bytes=None,
            perception_cache=cache,
        )
        if then > first:
            sender.share(drive.frame(true.agent_id, then - 1))
        sigma = torch.tensor([view.sigma_xy_m, view.sigma_xy_m, view.sigma_yaw_rad]).double()
        noisy_frame = replace(true, odometry=true.world_from_agent, world_from_agent=ego @ view.ego_from_view)
        packets += sender.share(replace(noisy_frame, pose_covariance=(sigma**2).diag()))
    for packet in packets:
        inbox.push(packet)
    return packets, list(inbox.messages())


def with_received_sigmas(drive, views: Sequence[AgentView], messages: list[Message]) -> tuple[AgentView, ...]:
    """The views with the received standard deviations, which are sent as codes of one byte."""
    ego, result = drive.frame(0, NOW).world_from_agent, []
    for view in views:
        place = (ego @ view.ego_from_view).translation
        message = min(messages, key=lambda m: float(place.dist(m.world_from_agent.translation)))
        sigma = message.pose_covariance.diagonal().sqrt().tolist()
        assert sigma[0] == pytest.approx(view.sigma_xy_m, rel=0.1) and sigma[2] == pytest.approx(
            view.sigma_yaw_rad, rel=0.1
        )
        result.append(replace(view, sigma_xy_m=sigma[0], sigma_yaw_rad=sigma[2]))
    return tuple(result)


ROADS = {
    "one sweep": (3, 1, DegradationConfig()),
    "two sweeps": (3, 2, DegradationConfig()),
    "past": (2, 4, DegradationConfig(ego_history=2)),
    "alone with a past": (1, 4, DegradationConfig(ego_history=2)),
    "late": (3, 4, DegradationConfig(delay_prob=1.0, max_delay_frames=2)),
    "pose noise": (2, 2, DegradationConfig(pose_noise_prob=1.0)),
    "sender history": (3, 4, DegradationConfig(ego_history=2, sender_history=1)),
    "all": (
        3,
        5,
        DegradationConfig(ego_history=2, sender_history=1, delay_prob=1.0, max_delay_frames=2, pose_noise_prob=1.0),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ROADS)
def test_training_forward_equals_share_bytes_perceive(drive, detector: Detector, name: str) -> None:
    """With float32 features, what training computes and what the bytes give agree within 1e-5, site by site.

    Boxes are not followed: training sees two sweeps of an instant, and the velocities that the detector states. Frames are not
    levelled on either side, since the poses of views are those of the recording.
    """
    check_forward_against_bytes(drive, detector, *ROADS[name])


@pytest.mark.parametrize("fusion", ["max/bare", "attfuse/bare"])
def test_a_bare_fusion_computes_in_training_what_its_bytes_give(drive, detector: Detector, fusion: str) -> None:
    check_forward_against_bytes(drive, make_bare(detector, fusion), *ROADS["late"])


def test_a_bare_message_costs_its_features_and_is_not_remembered(drive, detector: Detector) -> None:
    """float16: two bytes a channel instead of those of the proposal too; an earlier message changes nothing."""
    bare, some = make_bare(detector, "max/bare"), drive(2)
    packets = [
        Agent(m, token_encoding="float16", budget_bytes=None).share(some.frame(1, NOW)) for m in (bare, detector)
    ]
    messages = [read_whole(Agent(m), p) for m, p in zip((bare, detector), packets)]
    (tokens, same), (own, whole) = (len(m.tokens.sites) for m in messages), (sum(map(len, p)) for p in packets)
    channels = detector.encoder.out_channels
    assert tokens == same > 20 and messages[0].tokens.features.shape == (tokens, channels)
    assert whole - own >= 2 * PROPOSAL_DIM * tokens and 2 * channels * tokens <= own < 2.4 * channels * tokens
    early = Agent(bare, token_encoding="float16").share(some.frame(1, NOW - 1))
    boxes = []
    for before in ((), early):
        ego = Agent(bare, token_encoding="float16")
        ego.perceive(some.frame(0, NOW - 1), before)
        boxes.append(ego.perceive(some.frame(0, NOW), packets[0]).boxes.center)
    assert torch.equal(*boxes)


def read_whole(agent: Agent, packets: list[bytes]) -> Message:
    inbox = agent.inbox()
    for packet in packets:
        inbox.push(packet)
    (message,) = inbox.messages()
    return message


def make_bare(detector: Detector, fusion: str) -> Detector:
    """The same encoder and head with a bare fusion."""
    torch.manual_seed(1)
    bare = Detector(replace(detector.config, fusion=fusion))
    bare.load_state_dict(detector.state_dict(), strict=False)
    bare.fingerprint = b"testbare"
    return bare.eval().requires_grad_(False)


def check_forward_against_bytes(drive, detector: Detector, agents: int, moments: int, road: DegradationConfig) -> None:
    some, first = drive(agents), NOW + 1 - moments
    seen = [some.snapshot(i) for i in range(first, NOW + 1)]
    sample = make_sample(seen, 0, detector.config.grid, AugmentConfig.none(), ("same", 1), road)
    packets, messages = packets_and_messages(some, detector, sample.views[1:], first)
    before, older = packets_and_messages(some, detector, sample.sender_history, first)
    assert len(sample.sender_history) == road.sender_history * (agents - 1)
    views = (sample.views[0], *with_received_sigmas(some, sample.views[1:], messages))
    with torch.no_grad():
        trained = forward(
            detector,
            [replace(sample, views=views, sender_history=with_received_sigmas(some, sample.sender_history, older))],
        ).fused_boxes
    cache = RecordingCache(detector, road.ego_history)
    ego = Agent(detector, token_encoding="float32", perception_cache=cache)
    for index in range(first, NOW):
        ego.perceive(some.frame(0, index), before if index == NOW - 1 else ())
    ego.perceive(some.frame(0, NOW), packets)
    # The case matches its name, and there are tokens to compare.
    fused_tokens = cache.fused_tokens
    assert len(sample.views) == agents and len(sample.ego_history) == road.ego_history and len(trained.sites) > 20
    aged = bool(road.delay_prob or road.ego_history or road.sender_history)
    assert bool(fused_tokens.age.any()) == aged and bool(fused_tokens.sigma_m.any()) == bool(road.pose_noise_prob)
    assert (cache.fused_past is not None and len(cache.fused_past.features) > 20) == bool(road.ego_history)
    assert torch.equal(trained.sites.key, cache.raw.sites.key)
    for name in (f.name for f in fields(RawBoxes) if f.name != "sites"):
        a, b = getattr(trained, name), getattr(cache.raw, name)
        if not isinstance(a, torch.Tensor):
            assert a == b, name
            continue
        assert torch.allclose(a, b, atol=1e-5), (name, float((a - b).abs().max()))


def test_messages_of_collaborators_change_the_boxes(drive, detector: Detector) -> None:
    frames = drive(2).frames()
    blind = replace(frames[0], points=PointCloud.of(torch.tensor([[1.0, 1.0, 0.0]])))
    packets = Agent(detector).share(frames[1])
    assert len(Agent(detector).perceive(blind, packets).boxes) > len(Agent(detector).perceive(blind).boxes)


@pytest.mark.parametrize("name", list_strategies())
def test_an_empty_cloud_and_an_empty_inbox_give_no_error(detector: Detector, name: str) -> None:
    empty = AgentFrame.of(PointCloud.of(torch.zeros(0, 3)), Transform.identity(), agent_id=7)
    agent = Agent(detector, get_strategy(name))
    packets = agent.share(empty)
    found = Agent(detector, get_strategy(name)).perceive(replace(empty, agent_id=8), packets)
    assert len(found.boxes) == 0


def test_a_message_never_exceeds_its_budget(drive, detector: Detector) -> None:
    frame = drive(1).frame(0, 3)
    free = sum(map(len, Agent(detector, budget_bytes=None).share(frame)))
    for budget in (0, 200, 1000, free // 2, free):
        sent = sum(map(len, Agent(detector, budget_bytes=budget).share(frame)))
        # An agent without room for a cell still sends the header.
        assert sent <= max(budget, 200), (budget, sent)


def test_tokens_of_other_weights_change_nothing(drive, detector: Detector) -> None:
    frames = drive(2).frames()
    packets = Agent(detector).share(frames[1])
    alone = Agent(detector).perceive(frames[0]).boxes
    detector.fingerprint = b"othertes"
    strange = Agent(detector).perceive(frames[0], packets)
    detector.fingerprint = b"testtest"
    assert torch.equal(alone.bev(), strange.boxes.bev())


def test_an_agent_ignores_its_own_message_and_its_own_body(drive, detector: Detector) -> None:
    frame = drive(1).frame(0, 3)
    agent = Agent(detector)
    assert agent.perceive(frame, agent.share(frame)).received == ()
    boxes = agent.perceive(frame).boxes
    assert not bool(((boxes.center[:, 0].abs() <= 2.6) & (boxes.center[:, 1].abs() <= 1.3)).any())


def test_late_fusion_keeps_one_box_of_two_that_overlap(drive, detector: Detector) -> None:
    """Received copies of the same boxes add none; displaced copies add all within the ego's range."""
    frame = drive(1).frame(0, 3)
    cache, late = PerceptionCache(detector), get_strategy("late")
    message = late.compose_message(cache, frame)
    assert message is not None and message.objects is not None
    own = cache.process(frame).boxes
    assert len(late.fuse(cache, frame, [message])) == len(own) > 0
    aside = replace(message, world_from_agent=frame.world_from_agent @ Transform.from_xyz_yaw(0.0, 200.0))
    assert len(late.fuse(cache, frame, [aside])) == len(own)
    lattice = torch.cartesian_prod(torch.arange(-24.0, 25.0), torch.arange(-24.0, 25.0), torch.tensor([0.8]))
    free = lattice[torch.cdist(lattice[:, :2], own.center[:, :2]).min(1).values.argmax()][None]
    one = replace(message, objects=replace(own[:1], center=free, size=torch.tensor([[0.5, 0.5, 1.5]])))
    assert len(late.fuse(cache, frame, [one])) == len(own) + 1


def test_an_unknown_strategy_lists_the_known_ones() -> None:
    with pytest.raises(
        ConfigError, match="No strategy is called 'telepathy'; known: .*" + ", ".join(list_strategies())
    ):
        get_strategy("telepathy")


class Objects(IntermediateFusion):
    """Intermediate fusion that sends its boxes too, and keeps what was recorded as sent."""

    sent: ClassVar[list[Message]] = []

    def compose_message(self, cache, frame, requests=()):
        message = super().compose_message(cache, frame, requests)
        return replace(message, objects=cache.process(frame).boxes[:20])

    def record_sent(self, cache, frame, message):
        self.sent.append(message)


@pytest.mark.parametrize("encoding", ["float16", "int8"])
def test_share_encodes_each_section_once_and_records_the_selected_tokens(
    drive, detector: Detector, encoding: TokenEncoding, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = {"pack_object_bodies": 0, "pack_token_bodies": 0}

    def count(name: str) -> None:
        packed = getattr(payloads, name)

        def counted(*arguments):
            calls[name] += 1
            return packed(*arguments)

        monkeypatch.setattr(payloads, name, counted)

    for name in calls:
        count(name)
    Objects.sent.clear()
    packets = Agent(detector, Objects(), encoding, budget_bytes=2500).share(drive(1).frame(0, 3))
    assert calls == {"pack_object_bodies": 1, "pack_token_bodies": 1} and sum(map(len, packets)) <= 2500
    inbox = Inbox(detector.fingerprint)
    for packet in packets:
        inbox.push(packet)
    assert packets
    (message,), (sent,) = inbox.messages(), Objects.sent
    assert message.tokens is not None and sent.tokens is not None and message.objects is not None
    assert len(message.tokens.sites) > 0 and torch.equal(message.tokens.sites.key, sent.tokens.sites.key)


def test_tokens_without_a_score_are_selected_in_the_order_of_their_cells(drive, detector: Detector) -> None:
    class Unscored(IntermediateFusion):
        def compose_message(self, cache, frame, requests=()):
            return replace(super().compose_message(cache, frame, requests), token_score=None)

    frame = drive(1).frame(0, 3)
    cache = PerceptionCache(detector)
    packets = Agent(detector, Unscored(), "float16", 1000, cache).share(frame)
    inbox = Inbox(detector.fingerprint)
    for packet in packets:
        inbox.push(packet)
    keys = inbox.messages()[0].tokens.sites.key
    own = cache.process_tokens(frame).shared_tokens.sites.key
    assert 0 < len(keys) < len(own) and torch.equal(keys, own[: len(keys)])
