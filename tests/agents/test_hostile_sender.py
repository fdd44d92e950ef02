# SPDX-License-Identifier: Apache-2.0
"""One hostile sender among three honest ones: perceive does not raise, and the honest and the own detections stay.

Attacks are those of ``tests.probes.hostile``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from tests.probes.hostile import ATTACKS, HOSTILE_ID, attack_packets

from manyeyes import Agent, Boxes
from manyeyes.agents.agent import Perception
from manyeyes.agents.isolation import FIRST_QUARANTINE_NS
from manyeyes.agents.own_detections import MIN_RESTORED_SCORE
from manyeyes.agents.strategies import early
from manyeyes.agents.strategies.message_header import make_header
from manyeyes.agents.strategies.registry import FusionStrategy, get_strategy, list_strategies
from manyeyes.agents.trust.detectors.ray_evidence import RayEvidenceDetector
from manyeyes.comms import wire
from manyeyes.comms.inbox import Inbox
from manyeyes.datatypes import AgentFrame, Message, PointCloud, Sites, SparseBev, Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.detector import Detector

INSTANTS = range(2, 5)
TENTH_NS = 100_000_000
SENDERS = (1, 2, 3)


@dataclass(frozen=True)
class Scene:
    """An ego and three honest senders at three instants, and their packets; the encoding of tokens is exact."""

    frames: tuple[AgentFrame, ...]
    packets: tuple[tuple[list[bytes], ...], ...]

    def perceive(
        self, ego: Agent, hostile: Callable[[Sequence[bytes], int], Sequence[bytes]] = lambda packets, now_ns: ()
    ) -> list[Perception]:
        """Perceive all instants. hostile: packets that are sent before the honest ones, from those of the first sender."""
        found = []
        for frame, sent in zip(self.frames, self.packets):
            bad = hostile(sent[0], frame.timestamp_ns)
            found.append(ego.perceive(frame, [*bad, *(packet for packets in sent for packet in packets)]))
        return found


@pytest.fixture(scope="module")
def scene_of(detector) -> Callable[[str, type], Scene]:
    @cache
    def make(name: str, drive: type) -> Scene:
        agents = {i: Agent(detector, get_strategy(name), "float32" if name != "late" else None) for i in SENDERS}
        some = drive(4)
        packets = [tuple(agents[i].share(some.frame(i, index)) for i in SENDERS) for index in INSTANTS]
        return Scene(tuple(some.frame(0, index) for index in INSTANTS), tuple(packets))

    return make


def same(one: Boxes, other: Boxes) -> bool:
    return torch.equal(one.bev(), other.bev()) and torch.equal(one.score, other.score)


def nearest_m(boxes: Boxes, found: Boxes) -> torch.Tensor:
    """Distance (N,) of each box to the nearest found one."""
    return torch.cdist(boxes.center[:, :2].double(), found.center[:, :2].double()).min(1).values


TIMES = {
    "an hour old": -3600 * 10**9,
    "10 s old": -(10**10),
    "earliest": None,
    "0.9 s ahead": 9 * TENTH_NS,
    "latest": None,
}


def restated(packets: Sequence[bytes], agent_id: int = HOSTILE_ID, **fields: object) -> list[bytes]:
    """The packets of a message as of the hostile sender, with other fields."""
    return wire.encode(replace(decoded(packets), agent_id=agent_id, **fields), token_encoding="float32")


def at_time(what: str) -> Callable[[Sequence[bytes], int], list[bytes]]:
    fixed, offset = {"earliest": -(2**63), "latest": 2**63 - 1}, TIMES[what]
    return lambda packets, now_ns: restated(packets, timestamp_ns=fixed.get(what, now_ns + (offset or 0)))


@pytest.mark.parametrize("what", TIMES)
@pytest.mark.parametrize("name", ["late", "intermediate-temporal"])
def test_messages_far_from_the_time_of_the_frame_change_nothing(
    drive, detector, scene_of, name: str, what: str
) -> None:
    """Plain packets had no time of arrival: messages of an hour ago were fused, and one of 0.9 s ahead cleared the history."""
    scene = scene_of(name, drive)
    clean = scene.perceive(Agent(detector, get_strategy(name)))
    struck = scene.perceive(Agent(detector, get_strategy(name)), at_time(what))
    assert all(same(a.boxes, b.boxes) for a, b in zip(clean, struck))
    assert all({r.message.agent_id for r in p.received} == set(SENDERS) for p in struck)


def test_a_message_that_the_inbox_holds_is_not_fused_after_its_time(drive, detector, scene_of) -> None:
    """An inbox that keeps messages until newer ones come, of a caller that states no time."""
    scene, ego, inbox = scene_of("late", drive), Agent(detector, get_strategy("late")), Inbox()
    for packet in scene.packets[0][0]:
        inbox.push(packet)
    assert len(ego.perceive(scene.frames[0], inbox).received) == 1
    later = replace(scene.frames[0], timestamp_ns=scene.frames[0].timestamp_ns + 6 * TENTH_NS)
    assert ego.perceive(later, inbox).received == ()


def upside_down(pose: Transform) -> Transform:
    zero = torch.zeros((), dtype=torch.float64)
    return pose @ Transform.from_rpy(torch.zeros(3).double(), zero + np.pi, zero, zero)


POSES: dict[str, Callable[[Transform], Transform]] = {
    "1e6 m above": lambda pose: Transform(pose.rotation, pose.translation + torch.tensor([0.0, 0.0, 1e6]).double()),
    "60 m below": lambda pose: Transform(pose.rotation, pose.translation - torch.tensor([0.0, 0.0, 60.0]).double()),
    "9e7 m away": lambda pose: Transform(pose.rotation, pose.translation + torch.tensor([9e7, 9e7, 0.0]).double()),
    "upside down": upside_down,
}


@pytest.mark.parametrize("what", POSES)
@pytest.mark.parametrize("name", ["late", "intermediate-temporal", "early"])
def test_a_sender_of_implausible_pose_changes_nothing_and_is_named(
    drive, detector, scene_of, name: str, what: str
) -> None:
    """25 to 47 % of the honest boxes were left."""
    scene, pose = scene_of(name, drive), drive(4).frame(1, 3).world_from_agent
    clean = scene.perceive(Agent(detector, get_strategy(name)))
    struck = scene.perceive(
        Agent(detector, get_strategy(name)), lambda packets, _: restated(packets, world_from_agent=POSES[what](pose))
    )
    assert all(same(a.boxes, b.boxes) for a, b in zip(clean, struck))
    assert all([(r.agent_id, r.reason) for r in p.rejected] == [(HOSTILE_ID, "pose")] for p in struck)


ATTACKS_OF = {
    "late": (
        "1,000 boxes a packet beyond 150 m", "1,000 boxes a sender beyond 150 m", "1,000 boxes around the ego",
        "boxes of full size at one place", "64 invented ids", "objects with descriptors at their extremes",
        "empty message 0.999 s later", "64 invented ids 0.999 s ahead", "5,000 empty packets",
    ),
    "intermediate-temporal": (
        "features of 1e+20", "features of 3e+38", "float16 features of 60000", "one channel", "another grid",
        "another stride", "a channel too many", "largest covariance at 1e8 m", "stamps going back", "features of 32",
        "all cells by 8", "int8 features of the largest scale",
    ),
    "early": ("points at the extremes", "200,000 points at one place", "position of 1e8 m"),
}  # fmt: skip


@pytest.mark.parametrize("name, attack", [(name, attack) for name, attacks in ATTACKS_OF.items() for attack in attacks])
def test_no_attack_removes_an_own_detection(drive, confident, scene_of, name: str, attack: str) -> None:
    scene, ego = scene_of(name, drive), Agent(confident, get_strategy(name))
    found = scene.perceive(ego, lambda packets, now_ns: attack_packets(attack, packets, now_ns))
    for frame, perception in zip(scene.frames, found):
        own = ego.perception_cache.process(frame).boxes
        own = own[(own.score >= MIN_RESTORED_SCORE) & (own.center[:, :2].abs() > torch.tensor([3.7, 2.4])).any(1)]
        assert len(own) and float(nearest_m(own, perception.boxes).max()) <= 1.0


SIGHTS = {
    "sight of the largest ranges": None,
    "sight of nothing": None,
    "sight of NaN as float32": None,
    "sight of the largest covariance": "pose",
    "sight at 1e8 m": "implausible",
    "sight from 900 m away": None,
    "sight from 40 m above": None,
    "sight of a sender upside down": "pose",
    "sight of NaN, a float32 a sector": "garbage",
    "sight of a sector too few": "garbage",
    "sight of a sector too many": "garbage",
    "sight of 60,000 sectors": "garbage",
    "sight cut in the middle": "garbage",
    "sight without a body": "garbage",
    "two sights in a message": "contradiction",
    "sights of 100 senders": "busy",
}
"""What is refused of each hostile sight; None: nothing, it is a sight like others."""


@dataclass(frozen=True)
class SightScene:
    """A scene where the honest senders send sights, and the ego assesses senders.

    What a false sight of a trusted sender does to claims is in ``tests.agents.trust.test_observers``.
    """

    scene: Scene
    detector: Detector

    def perceive(self, attack: str | None) -> tuple[list[Perception], Counter[str]]:
        """Perceive all instants, beside an attack or without any; return what the inboxes dropped, too."""
        defence = RayEvidenceDetector()
        ego, dropped, found = Agent(self.detector, get_strategy("late"), misbehaviour=defence), Counter[str](), []
        for frame, sent in zip(self.scene.frames, self.scene.packets):
            inbox = ego.inbox()
            bad = [] if attack is None else attack_packets(attack, sent[0], frame.timestamp_ns)
            for packet in (*(packet for packets in sent for packet in packets), *bad):
                inbox.push(packet, frame.timestamp_ns)
            found.append(ego.perceive(frame, inbox, frame.timestamp_ns))
            dropped.update({reason: count for reason, count in vars(inbox.dropped).items() if count})
        return found, dropped


@pytest.fixture(scope="module")
def with_sights(drive, detector) -> SightScene:
    agents = {i: Agent(detector, get_strategy("late"), send_sight=True) for i in SENDERS}
    packets = [tuple(agents[i].share(drive(4).frame(i, index)) for i in SENDERS) for index in INSTANTS]
    return SightScene(Scene(tuple(drive(4).frame(0, index) for index in INSTANTS), tuple(packets)), detector)


@pytest.mark.parametrize("attack", SIGHTS)
def test_a_hostile_sight_changes_no_box_and_no_honest_sender_and_is_refused_where_it_is_wrong(
    with_sights, attack: str
) -> None:
    clean, _ = with_sights.perceive(None)
    struck, dropped = with_sights.perceive(attack)
    rejected = Counter(r.reason for p in struck for r in p.rejected)
    assert set(dropped) | set(rejected) == ({SIGHTS[attack]} if SIGHTS[attack] else set())
    for before, after in zip(clean, struck):
        assert before.assessment is not None and after.assessment is not None
        honest = [
            {s.agent_id: (s.trust, s.weight, s.status) for s in one.assessment.senders if s.agent_id in SENDERS}
            for one in (before, after)
        ]
        assert honest[0] == honest[1] and len(honest[0]) == len(SENDERS)
        assert same(before.boxes, after.boxes)


def test_hostile_sights_are_all_named() -> None:
    assert {name for name in ATTACKS if "sight" in name} == set(SIGHTS)


@st.composite
def random_messages(draw: st.DrawFn) -> list[tuple[int, int]]:
    """Seeds of up to four messages and the senders that state them."""
    return draw(st.lists(st.tuples(st.integers(1, 6), st.integers(0, 2**32 - 1)), min_size=1, max_size=4))


def random_message(detector, frame: AgentFrame, agent_id: int, seed: int) -> Message:
    """Any content that the wire format and the detector's token format can hold, near the ego."""
    random = np.random.default_rng(seed)
    x, y, yaw = random.uniform(-20, 20), random.uniform(-20, 20), random.uniform(-3, 3)
    pose = frame.world_from_agent @ Transform.from_xyz_yaw(x, y, random.uniform(-3, 3), yaw)
    grid = detector.token_grid
    cells = grid.shape[0] * grid.shape[1]
    key = torch.from_numpy(np.sort(random.choice(cells, random.integers(1, cells), replace=False)))
    scale = float(random.choice([0.5, 3.0, 32.0]))
    features = torch.from_numpy(random.uniform(-scale, scale, (len(key), detector.token_channels))).float()
    count = int(random.integers(0, 200))
    center = np.column_stack((random.uniform(-30, 30, (count, 2)), np.zeros(count)))
    size = random.uniform(0.1, 25.0, (count, 3))
    objects = Boxes.of(torch.from_numpy(center), torch.from_numpy(size), torch.from_numpy(random.uniform(-3, 3, count)))
    points = PointCloud.of(torch.from_numpy(random.uniform(-25, 25, (2000, 3))))
    stamp = frame.timestamp_ns + int(random.integers(-5, 2)) * TENTH_NS
    return Message(
        agent_id, stamp, pose, torch.zeros(3, 3).double(), detector.fingerprint,
        tokens=SparseBev(features, Sites(key, grid, 1)), objects=objects, points=points,
    )  # fmt: skip


@pytest.mark.parametrize("name", list_strategies())
def test_own_detections_survive_any_inbox(drive, confident, name: str) -> None:
    """Each own box of score 0.3 or more has a result within 1 m."""
    frame, ego = drive(1).frame(0, 2), Agent(confident, get_strategy(name))
    own = ego.perception_cache.process(frame).boxes
    own = own[(own.score >= MIN_RESTORED_SCORE) & (own.center[:, :2].abs() > torch.tensor([3.7, 2.4])).any(1)]
    assert len(own) > 30

    @settings(max_examples=8, deadline=None)  # an example takes 50 ms
    @given(random_messages())
    def check(messages: list[tuple[int, int]]) -> None:
        packets = [
            packet
            for agent_id, seed in messages
            for packet in wire.encode(random_message(confident, frame, agent_id, seed), token_encoding="float32")
        ]
        found = Agent(confident, get_strategy(name), perception_cache=ego.perception_cache).perceive(frame, packets)
        assert float(nearest_m(own, found.boxes).max()) <= 1.0

    check()


@pytest.fixture(scope="module")
def confident(detector):
    """The detector with 150 boxes of score 0.3 or more in a frame."""
    changed = deepcopy(detector)
    with torch.no_grad():
        changed.head.out.bias[BOX_LAYOUT.heatmap_logit] += 1.0
    return changed


class Fragile(FusionStrategy):
    """Late fusion that fails with some senders, or with several of them together."""

    uses_history = True

    def __init__(self, *groups: set[int]) -> None:
        self.groups, self.late, self.calls = groups, get_strategy("late"), 0

    def fuse(self, cache, frame, messages):
        self.calls += 1
        if any(group <= {m.agent_id for m in messages} for group in self.groups):
            raise RuntimeError("an unexpected shape")
        return self.late.fuse(cache, frame, messages)


def decoded(packets: Sequence[bytes]) -> Message:
    inbox = Inbox()
    for packet in packets:
        inbox.push(packet)
    return inbox.messages()[0]


def test_of_two_senders_that_fail_together_only_the_newer_is_excluded(drive, detector, scene_of) -> None:
    """All senders were excluded, and the history was cleared."""
    scene = scene_of("late", drive)
    ego, honest = Agent(detector, Fragile({1, HOSTILE_ID})), Agent(detector, Fragile())
    struck = scene.perceive(ego, lambda packets, _: restated(packets))
    clean = scene.perceive(honest)
    assert all(same(a.boxes, b.boxes) for a, b in zip(clean, struck))
    assert [[(r.agent_id, r.reason) for r in p.rejected] for p in struck] == [
        [(HOSTILE_ID, "content_error")],
        [(HOSTILE_ID, "quarantined")],
        [(HOSTILE_ID, "quarantined")],
    ]


def test_a_quarantined_sender_costs_no_fusion_and_returns_after_its_time(drive, detector, scene_of) -> None:
    scene = scene_of("late", drive)
    strategy = Fragile({HOSTILE_ID})
    ego = Agent(detector, strategy)
    scene.perceive(ego, lambda packets, _: restated(packets))
    # Four senders: all fail; the first two; the third; the fourth fails. Then one fusion an instant.
    assert strategy.calls <= 6 + 2
    strategy.groups = ()
    later = scene.frames[0].timestamp_ns + FIRST_QUARANTINE_NS + TENTH_NS
    frame = replace(scene.frames[0], timestamp_ns=later)
    perception = ego.perceive(frame, restated(scene.packets[0][0], timestamp_ns=later))
    assert perception.rejected == () and len(perception.received) == 1


def test_a_failing_message_of_the_history_is_its_senders_rejection(drive, detector, scene_of) -> None:
    """The strategy fails on what was received before, although nothing is received now."""
    scene, strategy = scene_of("late", drive), Fragile()
    ego = Agent(detector, strategy)
    scene.perceive(ego)
    strategy.groups = ({2},)
    last = scene.frames[-1]
    frame = replace(last, timestamp_ns=last.timestamp_ns + TENTH_NS)
    perception = ego.perceive(frame, [])
    assert [(r.agent_id, r.reason) for r in perception.rejected] == [(2, "content_error")]
    assert ego.message_history.senders == {1, 3}


def test_the_number_of_fused_senders_and_tokens_is_bounded(drive, detector, scene_of) -> None:
    """32 senders that name every cell took a minute."""
    scene = scene_of("intermediate-temporal", drive)
    ego = Agent(detector, get_strategy("intermediate-temporal"))
    ego.limits = replace(ego.limits, max_fused_senders=5, max_fused_tokens=200)
    counts: list[list[int]] = []
    fuse = ego.strategy.fuse

    class Counting(FusionStrategy):
        uses_history = False

        def fuse(self, cache, frame, messages):
            counts.append([len(m.tokens.sites) for m in messages if m.tokens is not None])
            return fuse(cache, frame, messages)

    ego.strategy = Counting()
    many = [restated(scene.packets[0][0], 100 + k) for k in range(9)]
    perception = ego.perceive(scene.frames[0], [packet for packets in many for packet in packets])
    assert len(counts[-1]) == 5 and sum(counts[-1]) <= 200 and min(counts[-1]) >= 30
    assert [r.reason for r in perception.rejected] == ["busy"] * 4


@pytest.mark.parametrize("strategy", ["late", "intermediate-temporal"])
def test_later_senders_displace_none_that_was_fused_before(drive, detector, scene_of, strategy) -> None:
    """Also after the later ones were fused in places that were free for an instant."""
    scene, ego = scene_of(strategy, drive), Agent(detector, get_strategy(strategy))
    ego.limits = replace(ego.limits, max_fused_senders=4)
    for n, (frame, sent) in enumerate(zip(scene.frames, scene.packets)):
        nearest = [restated(sent[0], 100 + k, world_from_agent=frame.world_from_agent) for k in range(9)]
        present = (sent, sent[:1], sent)[n]
        perception = ego.perceive(frame, [p for packets in (*(nearest if n else ()), *present) for p in packets])
        fused = {r.message.agent_id for r in perception.received}
        assert len(fused) == (3 if n == 0 else 4) and fused >= ({1} if n == 1 else {1, 2, 3})


def test_tokens_of_a_message_with_too_many_are_excluded(drive, detector, scene_of) -> None:
    """The whole section: a message that names every cell left less than half of the honest boxes."""
    scene = scene_of("intermediate-temporal", drive)
    message = decoded(scene.packets[0][0])
    count = len(message.tokens.sites)
    for limit, rejected in ((count, []), (count - 1, [(1, "cells")])):
        ego = Agent(detector, get_strategy("intermediate-temporal"))
        ego.limits = replace(ego.limits, max_fused_message_tokens=limit)
        perception = ego.perceive(scene.frames[0], scene.packets[0][0])
        assert [(r.agent_id, r.reason) for r in perception.rejected] == rejected
        assert (perception.received[0].message.tokens is None) is bool(rejected)


def test_empty_messages_take_no_place_of_messages_with_content(drive, detector, scene_of) -> None:
    scene, ego = scene_of("late", drive), Agent(detector, get_strategy("late"))
    message = replace(decoded(scene.packets[0][0]), objects=None)
    ego.limits = replace(ego.limits, max_fused_senders=3)
    empty = [wire.encode(replace(message, agent_id=-k))[0] for k in range(5, 0, -1)]
    perception = ego.perceive(scene.frames[0], [*empty, *(p for packets in scene.packets[0] for p in packets)])
    assert [r.message.agent_id for r in perception.received] == [1, 2, 3]


def test_a_cloud_much_larger_than_the_egos_is_thinned_out(drive, detector, monkeypatch) -> None:
    monkeypatch.setattr(early, "MIN_POINT_LIMIT", 1000)
    some, sizes = drive(1), []
    ego = Agent(detector, get_strategy("early"))
    frame = replace(some.frame(0, 2), points=some.frame(0, 2).points[:300])
    message = replace(make_header(some.frame(1, 2), detector.fingerprint), points=PointCloud.of(torch.rand(5000, 3)))
    run_detector = ego.perception_cache.merged.run_detector

    def count(cloud: PointCloud, before: PointCloud | None = None):
        sizes.append(len(cloud))
        return run_detector(cloud, before)

    monkeypatch.setattr(ego.perception_cache.merged, "run_detector", count)
    ego.perceive(frame, wire.encode(message))
    assert max(sizes) == 300 + 1000
