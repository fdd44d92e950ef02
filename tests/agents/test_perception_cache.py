# SPDX-License-Identifier: Apache-2.0
"""What an agent remembers of itself: moved by its odometry, forgotten where another scenario begins."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.perception_cache import FASTEST_M, LONGEST_GAP_NS, Eyes, Sight, follows
from manyeyes.agents.strategies import method
from manyeyes.agents.velocity import FOLLOWING, TrackConfig
from manyeyes.comms.inbox import Inbox
from manyeyes.datatypes import AgentFrame, BevGrid, PointCloud, Sites, SparseBev, Transform
from manyeyes.models.detector.box_head import RAW, DecodeConfig, RawBoxes, decode
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.proposal import PROPOSAL, propose, proposed_velocity

TENTH_NS = 100_000_000


def same(a: Eyes, frame: AgentFrame, b: Eyes, other: AgentFrame) -> bool:
    """Whether both tell the very same."""
    one, two = a.see(frame).told, b.see(other).told
    return torch.equal(one.sites.key, two.sites.key) and torch.equal(one.features, two.features)


def astray(frame: AgentFrame, x: float) -> AgentFrame:
    """The same frame, its claim off, its odometry as it was."""
    pose = frame.world_from_agent
    return replace(frame, world_from_agent=Transform.from_xyz_yaw(x, 0.0) @ pose, odometry=pose)


def test_the_sweep_before_takes_part_and_only_once(drive, detector: Detector) -> None:
    before, now = drive().frame(0, 2), drive().frame(0, 3)
    eyes, fresh = Eyes(detector, tracks=None), Eyes(detector)
    eyes.see(before)
    assert not same(eyes, now, fresh, now)
    moved = before.points.transform(now.from_earlier(before))
    told = Eyes(detector).see_cloud(now.points, moved).told
    assert torch.equal(eyes.see(now).told.features, told.features)
    assert eyes.see(now) is eyes.see(now)


def test_the_sweep_before_is_moved_by_odometry_and_not_by_the_claims(drive, detector: Detector) -> None:
    """Claims that jump by 4 m from one instant to the next change nothing of what is seen or remembered."""
    before, now = drive().frame(0, 2), drive().frame(0, 3)
    honest, shaken = Eyes(detector), Eyes(detector)
    honest.see(before), shaken.see(astray(before, 2.0))
    claim = astray(now, -2.0)
    assert same(honest, now, shaken, claim)
    (mine,), (theirs,) = honest.past(now), shaken.past(claim)
    assert mine.ego_from_sender is not None and theirs.ego_from_sender is not None
    assert torch.equal(mine.ego_from_sender.matrix(), theirs.ego_from_sender.matrix())
    # Without an odometry of its own the claims are all there is, and are taken.
    lost = Eyes(detector)
    lost.see(replace(astray(before, 2.0), odometry=None))
    assert not same(honest, now, lost, replace(claim, odometry=None))


def test_the_past_is_the_last_two_instants_newest_first(drive, detector: Detector) -> None:
    eyes, frames = Eyes(detector), [drive().frame(0, i) for i in range(4)]
    assert eyes.past(frames[0]) == []
    for i, frame in enumerate(frames):
        sight = eyes.see(frame)
        past = eyes.past(frame)
        assert [round(part.age_s, 6) for part in past] == [0.1, 0.2][:i]
        assert all(part.told is not sight.told.features for part in past)
    past = eyes.past(frames[3])
    assert past[0].told is eyes.see(frames[2]).told.features
    # The drive is 0.5 m an instant, straight ahead.
    for part, metres in zip(past, (-0.5, -1.0)):
        assert part.ego_from_sender is not None and part.doubt_xy_m == part.doubt_yaw_rad == 0
        assert part.ego_from_sender.translation.tolist() == pytest.approx([metres, 0, 0], abs=1e-6)
    # Asked for an older frame, what came after it is not its past.
    assert [round(part.age_s, 6) for part in eyes.past(frames[1])] == [0.1]


def another(frame: AgentFrame) -> dict[str, AgentFrame]:
    """Frames that do not go on from one."""
    at, away = frame.timestamp_ns, Transform.from_xyz_yaw(FASTEST_M + 1, 0.0)
    return {
        "time goes back": replace(frame, timestamp_ns=at - TENTH_NS),
        "time stands still": replace(frame, timestamp_ns=at),
        "a gap": replace(frame, timestamp_ns=at + LONGEST_GAP_NS + 1),
        "a jump": replace(frame, timestamp_ns=at + TENTH_NS, world_from_agent=away @ frame.world_from_agent),
        "another agent": replace(frame, timestamp_ns=at + TENTH_NS, agent_id=9),
    }


@pytest.mark.parametrize("name", ["time goes back", "time stands still", "a gap", "a jump", "another agent"])
def test_another_scenario_is_seen_as_if_nothing_had_been_before(drive, detector: Detector, name: str) -> None:
    before = drive().frame(0, 2)
    strange = another(before)[name]
    assert not follows(strange, before)
    eyes = Eyes(detector)
    eyes.see(before)
    assert same(eyes, strange, Eyes(detector), strange) and eyes.past(strange) == []


def test_the_longest_gap_and_the_farthest_drive_still_follow(drive, detector: Detector) -> None:
    before = drive().frame(0, 2)
    late = replace(before, timestamp_ns=before.timestamp_ns + LONGEST_GAP_NS)
    there = Transform.from_xyz_yaw(FASTEST_M - 1, 0.0) @ before.world_from_agent
    far = replace(before, timestamp_ns=before.timestamp_ns + TENTH_NS, world_from_agent=there)
    assert follows(late, before) and follows(far, before)


def test_so_many_frames_are_remembered_and_no_more(drive, detector: Detector) -> None:
    eyes, frame = Eyes(detector, remember=2), drive().frame(0, 0)
    few = replace(frame, points=frame.points[:50])
    frames = [replace(few, timestamp_ns=i * TENTH_NS) for i in range(5)]
    for one in frames:
        eyes.see(one)
    assert [known for known, _ in eyes._seen] == frames[-2:]


def test_players_of_one_recording_may_look_once_between_them(drive, detector: Detector) -> None:
    known: dict = {}
    one, two = Eyes(detector, known=known), Eyes(detector, known=known)
    frames = [drive().frame(0, i) for i in (2, 3)]
    first = [one.see(frame) for frame in frames]
    copies = [replace(frame) for frame in frames]
    assert [two.see(frame) for frame in copies] == first
    assert [part.told is first[0].told.features for part in two.past(copies[1])] == [True]


def test_merged_clouds_remember_the_merged_cloud_before(drive, detector: Detector) -> None:
    eyes, before, now = Eyes(detector), drive().frame(0, 2), drive().frame(0, 3)
    assert eyes.earlier_merged(before, before.points) is None
    moved = eyes.earlier_merged(now, now.points)
    assert moved is not None
    assert torch.allclose(moved.xyz, before.points.xyz - torch.tensor([0.5, 0.0, 0.0]), atol=1e-4)
    strange = another(now)["a jump"]
    assert eyes.earlier_merged(strange, strange.points) is None


def test_an_empty_sweep_is_a_past_with_nothing_in_it(drive, detector: Detector) -> None:
    """An agent that was blind an instant ago perceives as one that was not there."""
    now = drive(1).frame(0, 3)
    blind = replace(drive(1).frame(0, 2), points=PointCloud.of(torch.zeros(0, 3)))
    agent, fresh = Agent(detector), Agent(detector)
    agent.perceive(blind)
    a, b = agent.perceive(now).boxes, fresh.perceive(now).boxes
    assert len(a) == len(b) > 0 and torch.allclose(a.bev(), b.bev(), atol=1e-4)


def test_fused_messages_echo_what_the_hearer_said(drive, detector: Detector) -> None:
    """CoSTr Eq. 1 to the letter: A hears of its own car through B. What B saw itself holds nothing of A's."""
    first, then = drive(2).frames(2), drive(2).frames(3)
    blind = PointCloud.of(torch.zeros(0, 3))
    for name, echoes in (("intermediate", False), ("fused", True)):
        a, b = (Agent(detector, method(name), budget_bytes=None) for _ in range(2))
        b.perceive(replace(first[1], points=blind), a.share(first[0]))
        inbox = Inbox(detector.fingerprint)
        for packet in b.share(replace(then[1], points=blind)):
            inbox.push(packet)
        told = [m.tokens for m in inbox.messages() if m.tokens is not None]
        assert (sum(len(t.sites) for t in told) > 0) == echoes
        if echoes:
            # Dated as what it tells of: a tenth of a second before it was sent.
            assert [m.timestamp_ns for m in inbox.messages()] == [first[1].timestamp_ns]


GRID = BevGrid(-40, -40, -1, 40, 40, 3, 1.0)
Places = list[tuple[float, float]]


def seeing(cells: Places, cars: Places, heat: float = 4.0) -> Sight:
    """A token in each cell that proposes the middle of a car; nothing moves, as far as it states."""
    yx = GRID.cells(torch.tensor(cells))
    order = (yx[:, 0] * GRID.shape[1] + yx[:, 1]).argsort()
    sites = Sites((yx[:, 0] * GRID.shape[1] + yx[:, 1])[order], GRID)
    columns = torch.zeros(len(cells), RAW.total)
    columns[:, RAW.offset] = torch.tensor(cars)[order] - sites.xy
    for column, value in ((RAW.heat, heat), (RAW.overlap, 4.0), (RAW.log_sigma_xy, -3.0)):
        columns[:, column] = value
    columns[:, RAW.axis.start] = columns[:, RAW.direction.start] = 1
    raw = RawBoxes.of(columns, sites)
    told = SparseBev(torch.cat((torch.ones(len(cells), 4), propose(raw)), 1), sites)
    return Sight(told, told, raw, DecodeConfig())


def test_tokens_are_as_fast_as_the_box_that_they_propose_and_what_is_no_box_stands() -> None:
    """Two tokens propose one car, a third another, and a fourth, farther from both than a car is wide, no box that is left."""
    cells = [(0.5, 0.5), (1.5, 0.5), (10.5, 0.5), (0.5, 3.5)]
    sight = seeing(cells, [(0.7, 0.5), (0.7, 0.5), (10.5, 0.5), (0.5, 3.5)])
    sight.raw.heat[3] = -9
    assert sorted(sight.boxes.center[:, 0].tolist()) == pytest.approx([0.7, 10.5])
    fast = torch.where(sight.boxes.center[:, :1] < 5, torch.tensor([[7.0, -1.0]]), torch.tensor([[0.0, 3.0]]))
    moved = sight.moving(fast)
    assert torch.equal(moved.boxes.velocity, fast) and torch.equal(moved.boxes.center, sight.boxes.center)
    anew = decode(moved.raw, moved.config)[0]
    assert torch.allclose(anew.velocity, fast) and torch.equal(anew.center, moved.boxes.center)
    told, before = moved.told.features, sight.told.features
    want = torch.tensor([[7.0, -1.0], [7.0, -1.0], [0.0, 3.0], [0.0, 0.0]])
    assert torch.allclose(proposed_velocity(told[:, -PROPOSAL:]), want)
    silent = seeing(cells[:1], cells[:1], heat=-9.0)
    assert torch.equal(silent.moving(torch.zeros(0, 2)).raw.velocity, torch.zeros(1, 2))
    # Of what is told, nothing else changes.
    speeds = list(range(told.shape[1]))[4:][RAW.velocity]
    rest = [c for c in range(told.shape[1]) if c not in speeds]
    sent = torch.cat((before[:, :4], propose(sight.raw)), 1)
    assert torch.equal(told[:, rest], sent[:, rest])


class Scripted(Eyes):
    """Sees what is written."""

    def __init__(self, detector: Detector, script: list[Sight], tracks: TrackConfig | None = FOLLOWING) -> None:
        super().__init__(detector, tracks=tracks)
        self.script = iter(script)

    def see_cloud(self, cloud: PointCloud, earlier: PointCloud | None = None) -> Sight:
        return next(self.script)


def test_boxes_are_followed_over_the_ground_until_another_scenario_begins(detector: Detector) -> None:
    """The agent drives at 5 m/s past a car that stands and behind one that drives at 8 m/s; no velocity is stated."""
    nothing, frames, script = PointCloud.of(torch.zeros(0, 3)), [], []
    for k in range(5):
        pose = Transform.from_xyz_yaw(0.5 * k, 0.0)
        frames.append(AgentFrame.of(nothing, pose, timestamp_ns=k * TENTH_NS))
        cars = [(20.3 - 0.5 * k, 5.2), (5.1 + 0.3 * k, -4.7)]
        script.append(seeing(cars, cars))
    strange = another(frames[-1])["a gap"]
    eyes = Scripted(detector, [*script, script[-1]])
    boxes = [eyes.see(frame).boxes for frame in frames]
    stands, drives = (boxes[-1][boxes[-1].center[:, 1] * side > 0].velocity[0].tolist() for side in (1, -1))
    assert stands == [0, 0] and drives == pytest.approx([8, 0], abs=0.4)
    assert not boxes[0].velocity.any() and not eyes.see(strange).boxes.velocity.any()
    stated = Scripted(detector, script, tracks=None)
    assert not any(stated.see(frame).boxes.velocity.any() for frame in frames)
