# SPDX-License-Identifier: Apache-2.0
"""History of an agent's own frames: propagated by odometry, cleared at a new scenario."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.perception_cache import MAX_EGO_STEP_M, MAX_GAP_NS, PerceptionCache, TokenOutput
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.agents.velocity import DEFAULT_VELOCITY_CONFIG, VelocityConfig
from manyeyes.comms.inbox import Inbox
from manyeyes.datatypes import AgentFrame, BevGrid, PointCloud, Sites, SparseBev, Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT, DecodeConfig, RawBoxes, decode
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.proposal import PROPOSAL_DIM, make_proposals, proposed_velocity

TENTH_NS = 100_000_000


def same(a: PerceptionCache, frame: AgentFrame, b: PerceptionCache, other: AgentFrame) -> bool:
    """Whether both caches give the same tokens."""
    one, two = a.process(frame).shared_tokens, b.process(other).shared_tokens
    return torch.equal(one.sites.key, two.sites.key) and torch.equal(one.features, two.features)


def with_pose_error(frame: AgentFrame, x: float) -> AgentFrame:
    """The same frame with an error of its prior pose and correct odometry."""
    pose = frame.world_from_agent
    return replace(frame, world_from_agent=Transform.from_xyz_yaw(x, 0.0) @ pose, odometry=pose)


def test_the_sweep_before_takes_part_and_only_once(drive, detector: Detector) -> None:
    before, now = drive().frame(0, 2), drive().frame(0, 3)
    cache, fresh = PerceptionCache(detector, velocity_config=None), PerceptionCache(detector)
    cache.process(before)
    assert not same(cache, now, fresh, now)
    moved = before.points.transform(now.now_from_earlier(before))
    shared_tokens = PerceptionCache(detector).run_detector(now.points, moved).shared_tokens
    assert torch.equal(cache.process(now).shared_tokens.features, shared_tokens.features)
    assert cache.process(now) is cache.process(now)


def test_the_previous_sweep_is_transformed_by_odometry_not_by_prior_poses(drive, detector: Detector) -> None:
    """Prior poses that jump by 4 m between frames change no output and no history."""
    before, now = drive().frame(0, 2), drive().frame(0, 3)
    honest, shaken = PerceptionCache(detector), PerceptionCache(detector)
    honest.process(before), shaken.process(with_pose_error(before, 2.0))
    claim = with_pose_error(now, -2.0)
    assert same(honest, now, shaken, claim)
    (mine,), (theirs,) = honest.previous_tokens(now), shaken.previous_tokens(claim)
    assert mine.ego_from_sender is not None and theirs.ego_from_sender is not None
    assert torch.equal(mine.ego_from_sender.matrix(), theirs.ego_from_sender.matrix())
    # Without an odometry of its own the claims are all there is, and are taken.
    lost = PerceptionCache(detector)
    lost.process(replace(with_pose_error(before, 2.0), odometry=None))
    assert not same(honest, now, lost, replace(claim, odometry=None))


def test_the_past_is_the_last_two_instants_newest_first(drive, detector: Detector) -> None:
    cache, frames = PerceptionCache(detector), [drive().frame(0, i) for i in range(4)]
    assert cache.previous_tokens(frames[0]) == []
    for i, frame in enumerate(frames):
        output = cache.process(frame)
        past = cache.previous_tokens(frame)
        assert [round(part.age_s, 6) for part in past] == [0.1, 0.2][:i]
        assert all(part.tokens is not output.shared_tokens.features for part in past)
    past = cache.previous_tokens(frames[3])
    assert past[0].tokens is cache.process(frames[2]).shared_tokens.features
    # The drive is 0.5 m an instant, straight ahead.
    for part, metres in zip(past, (-0.5, -1.0)):
        assert part.ego_from_sender is not None and part.sigma_xy_m == part.sigma_yaw_rad == 0
        assert part.ego_from_sender.translation.tolist() == pytest.approx([metres, 0, 0], abs=1e-6)
    # Asked for an older frame, what came after it is not its past.
    assert [round(part.age_s, 6) for part in cache.previous_tokens(frames[1])] == [0.1]


def discontinuous_frames(frame: AgentFrame) -> dict[str, AgentFrame]:
    """Frames that are not consecutive to one."""
    at, away = frame.timestamp_ns, Transform.from_xyz_yaw(MAX_EGO_STEP_M + 1, 0.0)
    return {
        "time goes back": replace(frame, timestamp_ns=at - TENTH_NS),
        "time stands still": replace(frame, timestamp_ns=at),
        "a gap": replace(frame, timestamp_ns=at + MAX_GAP_NS + 1),
        "a jump": replace(frame, timestamp_ns=at + TENTH_NS, world_from_agent=away @ frame.world_from_agent),
        "another agent": replace(frame, timestamp_ns=at + TENTH_NS, agent_id=9),
    }


@pytest.mark.parametrize("name", ["time goes back", "time stands still", "a gap", "a jump", "another agent"])
def test_a_new_scenario_starts_without_history(drive, detector: Detector, name: str) -> None:
    before = drive().frame(0, 2)
    strange = discontinuous_frames(before)[name]
    cache = PerceptionCache(detector)
    assert not cache.is_consecutive(strange, before)
    cache.process(before)
    assert same(cache, strange, PerceptionCache(detector), strange) and cache.previous_tokens(strange) == []


def test_the_longest_gap_and_the_farthest_drive_still_follow(drive, detector: Detector) -> None:
    before = drive().frame(0, 2)
    late = replace(before, timestamp_ns=before.timestamp_ns + MAX_GAP_NS)
    there = Transform.from_xyz_yaw(MAX_EGO_STEP_M - 1, 0.0) @ before.world_from_agent
    far = replace(before, timestamp_ns=before.timestamp_ns + TENTH_NS, world_from_agent=there)
    cache = PerceptionCache(detector)
    assert cache.is_consecutive(late, before) and cache.is_consecutive(far, before)


def test_motions_are_those_of_the_frames_and_computed_once(drive, detector: Detector) -> None:
    frames, cache = [drive().frame(0, k) for k in range(3)], PerceptionCache(detector)
    for now, before in ((2, 1), (2, 0), (1, 0), (2, 0)):
        motion, wanted = cache.motion_since(frames[now], frames[before]), frames[now].now_from_earlier(frames[before])
        assert torch.equal(motion.rotation, wanted.rotation) and torch.equal(motion.translation, wanted.translation)
        assert cache.motion_since(frames[now], frames[before]) is motion


def test_at_most_max_frames_are_cached(drive, detector: Detector) -> None:
    cache, frame = PerceptionCache(detector, max_frames=2), drive().frame(0, 0)
    few = replace(frame, points=frame.points[:50])
    frames = [replace(few, timestamp_ns=i * TENTH_NS) for i in range(5)]
    for one in frames:
        cache.process(one)
    assert [known for known, _ in cache._outputs] == frames[-2:]


def test_several_replays_of_one_recording_share_a_feature_cache(drive, detector: Detector) -> None:
    feature_cache: dict = {}
    one, two = (
        PerceptionCache(detector, feature_cache=feature_cache),
        PerceptionCache(detector, feature_cache=feature_cache),
    )
    frames = [drive().frame(0, i) for i in (2, 3)]
    first = [one.process(frame) for frame in frames]
    copies = [replace(frame) for frame in frames]
    assert [two.process(frame) for frame in copies] == first
    assert [part.tokens is first[0].shared_tokens.features for part in two.previous_tokens(copies[1])] == [True]


def test_merged_clouds_have_a_past_of_their_own_which_a_failed_perception_restores(drive, detector: Detector) -> None:
    cache, before, now = PerceptionCache(detector), drive().frame(0, 2), drive().frame(0, 3)
    merged = [replace(f, points=PointCloud.cat([f.points, f.points])) for f in (before, now)]
    cache.merged.process(merged[0])
    kept = cache.history
    first = cache.merged.process(merged[1])
    assert [frame is merged[0] for frame, _ in cache.merged.previous_outputs(merged[1])] == [True]
    assert cache.previous_outputs(before) == [], "the agent's own sweeps are apart"
    cache.history = kept
    again = cache.merged.process(replace(merged[1]))
    assert torch.equal(again.boxes.center, first.boxes.center) and torch.equal(again.boxes.score, first.boxes.score)
    strange = discontinuous_frames(now)["a jump"]
    cache.merged.process(strange)
    assert cache.merged.previous_outputs(strange) == []


def test_an_empty_sweep_is_a_past_with_nothing_in_it(drive, detector: Detector) -> None:
    """A previous frame without points is equivalent to no previous frame."""
    now = drive(1).frame(0, 3)
    blind = replace(drive(1).frame(0, 2), points=PointCloud.of(torch.zeros(0, 3)))
    agent, fresh = Agent(detector), Agent(detector)
    agent.perceive(blind)
    a, b = agent.perceive(now).boxes, fresh.perceive(now).boxes
    assert len(a) == len(b) > 0 and torch.allclose(a.bev(), b.bev(), atol=1e-4)


def test_multi_hop_messages_echo_the_receivers_own_tokens(drive, detector: Detector) -> None:
    """CoSTr Eq. 1 to the letter: A receives its own car through B. B's own tokens contain none of A's."""
    first, then = drive(2).frames(2), drive(2).frames(3)
    blind = PointCloud.of(torch.zeros(0, 3))
    for name, echoes in (("intermediate-temporal", False), ("intermediate-multihop-temporal", True)):
        a, b = (Agent(detector, get_strategy(name), budget_bytes=None) for _ in range(2))
        b.perceive(replace(first[1], points=blind), a.share(first[0]))
        inbox = Inbox(detector.fingerprint)
        for packet in b.share(replace(then[1], points=blind)):
            inbox.push(packet)
        received_tokens = [m.tokens for m in inbox.messages() if m.tokens is not None]
        assert (sum(len(t.sites) for t in received_tokens) > 0) == echoes
        if echoes:
            # The timestamp of its content: a tenth of a second before it was sent.
            assert [m.timestamp_ns for m in inbox.messages()] == [first[1].timestamp_ns]


GRID = BevGrid(-40, -40, -1, 40, 40, 3, 1.0)
Places = list[tuple[float, float]]


def output_of(cells: Places, cars: Places, heat: float = 4.0) -> TokenOutput:
    """A token in each cell that proposes the middle of a car; nothing moves, as far as it states."""
    yx = GRID.cells(torch.tensor(cells))
    order = (yx[:, 0] * GRID.shape[1] + yx[:, 1]).argsort()
    sites = Sites((yx[:, 0] * GRID.shape[1] + yx[:, 1])[order], GRID)
    columns = torch.zeros(len(cells), BOX_LAYOUT.total)
    columns[:, BOX_LAYOUT.offset] = torch.tensor(cars)[order] - sites.xy
    for column, value in (
        (BOX_LAYOUT.heatmap_logit, heat),
        (BOX_LAYOUT.iou_logit, 4.0),
        (BOX_LAYOUT.log_sigma_xy, -3.0),
    ):
        columns[:, column] = value
    columns[:, BOX_LAYOUT.axis.start] = columns[:, BOX_LAYOUT.direction.start] = 1
    raw = RawBoxes.of(columns, sites)
    tokens = SparseBev(torch.cat((torch.ones(len(cells), 4), make_proposals(raw)), 1), sites)
    return TokenOutput(tokens, tokens, raw, DecodeConfig())


def test_tokens_have_the_velocity_of_their_box_and_others_are_stationary() -> None:
    """Two tokens propose one car, a third another, and a fourth, farther from both than a car is wide, no box that is left."""
    cells = [(0.5, 0.5), (1.5, 0.5), (10.5, 0.5), (0.5, 3.5)]
    output = output_of(cells, [(0.7, 0.5), (0.7, 0.5), (10.5, 0.5), (0.5, 3.5)])
    output.raw.heatmap_logit[3] = -9
    assert sorted(output.boxes.center[:, 0].tolist()) == pytest.approx([0.7, 10.5])
    fast = torch.where(output.boxes.center[:, :1] < 5, torch.tensor([[7.0, -1.0]]), torch.tensor([[0.0, 3.0]]))
    moved = output.with_velocity(fast)
    assert torch.equal(moved.boxes.velocity, fast) and torch.equal(moved.boxes.center, output.boxes.center)
    again = decode(moved.raw, moved.config)[0]
    assert torch.allclose(again.velocity, fast) and torch.equal(again.center, moved.boxes.center)
    features, before = moved.shared_tokens.features, output.shared_tokens.features
    want = torch.tensor([[7.0, -1.0], [7.0, -1.0], [0.0, 3.0], [0.0, 0.0]])
    assert torch.allclose(proposed_velocity(features[:, -PROPOSAL_DIM:]), want)
    silent = output_of(cells[:1], cells[:1], heat=-9.0)
    assert torch.equal(silent.with_velocity(torch.zeros(0, 2)).raw.velocity, torch.zeros(1, 2))
    # No other part of the tokens changes.
    speeds = list(range(features.shape[1]))[4:][BOX_LAYOUT.velocity]
    rest = [c for c in range(features.shape[1]) if c not in speeds]
    assert torch.equal(features[:, rest], before[:, rest])


class ScriptedCache(PerceptionCache):
    """Sees what is written."""

    def __init__(
        self,
        detector: Detector,
        script: list[TokenOutput],
        velocity_config: VelocityConfig | None = DEFAULT_VELOCITY_CONFIG,
    ) -> None:
        super().__init__(detector, velocity_config=velocity_config)
        self.script = iter(script)

    def run_detector(self, cloud: PointCloud, earlier: PointCloud | None = None) -> TokenOutput:
        return next(self.script)


def test_boxes_are_associated_over_frames_of_one_scenario(detector: Detector) -> None:
    """The agent drives at 5 m/s past a car that stands and behind one that drives at 8 m/s; no velocity is stated."""
    nothing, frames, script = PointCloud.of(torch.zeros(0, 3)), [], []
    for k in range(5):
        pose = Transform.from_xyz_yaw(0.5 * k, 0.0)
        frames.append(AgentFrame.of(nothing, pose, timestamp_ns=k * TENTH_NS))
        cars = [(20.3 - 0.5 * k, 5.2), (5.1 + 0.3 * k, -4.7)]
        script.append(output_of(cars, cars))
    strange = discontinuous_frames(frames[-1])["a gap"]
    cache = ScriptedCache(detector, [*script, script[-1]])
    boxes = [cache.process(frame).boxes for frame in frames]
    stands, drives = (boxes[-1][boxes[-1].center[:, 1] * side > 0].velocity[0].tolist() for side in (1, -1))
    assert stands == [0, 0] and drives == pytest.approx([8, 0], abs=0.4)
    assert not boxes[0].velocity.any() and not cache.process(strange).boxes.velocity.any()
    stated = ScriptedCache(detector, script, velocity_config=None)
    assert not any(stated.process(frame).boxes.velocity.any() for frame in frames)
