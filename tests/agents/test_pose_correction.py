# SPDX-License-Identifier: Apache-2.0
"""Pose correction of received messages: a street of cars, and a perception cache with fixed boxes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.pose_correction import MessageUse, PoseCorrection, extract_message_boxes
from manyeyes.agents.strategies.late import LateFusion
from manyeyes.datatypes import AgentBody, AgentFrame, Boxes, ConfigError, Message, PointCloud, SparseBev, Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT, DecodeConfig, RawBoxes, decode
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.pose.pose_monitor import PoseHealth
from manyeyes.pose.types import PoseStatus

EGO = Transform.from_xyz_yaw(100.0, 50.0, 0.0, 0.3)
OTHERS = (
    Transform.from_xyz_yaw(112.0, 58.0, 0.0, 2.8),
    Transform.from_xyz_yaw(90.0, 40.0, 0.0, -1.0),
    Transform.from_xyz_yaw(105.0, 35.0, 0.0, 1.5),
)


def cars(count: int, seed: int) -> Boxes:
    """Cars in the world, within 25 m of the ego."""
    rng = np.random.default_rng(seed)
    center = np.column_stack((100 + rng.uniform(-25, 25, count), 50 + rng.uniform(-25, 25, count), np.full(count, 0.8)))
    size = np.column_stack((rng.uniform(4, 5.2, count), rng.uniform(1.7, 2.1, count), np.full(count, 1.6)))
    found = Boxes.of(torch.from_numpy(center), torch.from_numpy(size), torch.from_numpy(rng.uniform(-3, 3, count)))
    sure = torch.full((count,), 0.1, dtype=torch.float64)
    return replace(found, sigma_xy=sure, sigma_yaw=sure * 0.2, p_flip=sure * 0.1)


class FixedBoxesCache(PerceptionCache):
    """A perception cache with fixed boxes that decodes as the detector does."""

    def __init__(self, boxes: Boxes, detector: Detector | None = None) -> None:
        super().__init__(detector or Detector(COSTR_TINY))
        self.boxes = boxes

    def process(self, frame: AgentFrame) -> Any:
        return self

    def decode(self, raw: RawBoxes) -> Boxes:
        return decode(raw, DecodeConfig())[0]


def frame(time_ns: int = 0) -> AgentFrame:
    return replace(AgentFrame.of(PointCloud.of(torch.zeros(1, 3)), EGO, agent_id=1), timestamp_ns=time_ns)


def cache_of(world: Boxes) -> PerceptionCache:
    return FixedBoxesCache(world.transform(EGO.inverse()))


def message_of(
    world: Boxes,
    pose: Transform,
    agent_id: int = 2,
    off: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sigma: float = 1.0,
    time_ns: int = 0,
) -> Message:
    """Boxes of the world as seen from a pose, with a prior pose that is off by x, y (m), yaw (rad)."""
    x, y, yaw = off
    prior_pose = Transform(
        Transform.from_xyz_yaw(0, 0, 0, yaw).rotation @ pose.rotation,
        pose.translation + torch.tensor([x, y, 0.0], dtype=torch.float64),
    )
    covariance = torch.diag(torch.tensor([sigma, sigma, math.radians(sigma)], dtype=torch.float64) ** 2)
    return Message(agent_id, time_ns, prior_pose, covariance, objects=world.transform(pose.inverse()))


def pose_error(message: Message, pose: Transform) -> tuple[float, float]:
    """Metres and degrees between a message's pose and the true pose."""
    turn = float((message.world_from_agent.yaw - pose.yaw + math.pi) % (2 * math.pi) - math.pi)
    return float((message.world_from_agent.translation - pose.translation).norm()), math.degrees(abs(turn))


@pytest.mark.slow
def test_a_wrong_prior_pose_is_corrected_and_its_covariance_updated() -> None:
    world = cars(12, 0)
    message = message_of(world, OTHERS[0], off=(1.2, -0.8, 0.02))
    found = PoseCorrection().correct(frame(), cache_of(world), [message], {})
    (kept,), (verdict,) = found.messages, found.corrections
    assert verdict.use is MessageUse.CORRECTED and verdict.estimate.status is PoseStatus.OK and verdict.sigma_m < 0.2
    assert pose_error(message, OTHERS[0])[0] > 1.4
    metres, degrees = pose_error(kept, OTHERS[0])
    assert metres < 0.05 and degrees < 0.05
    assert float(torch.linalg.eigvalsh(kept.pose_covariance).max()) < 0.02
    assert kept.objects is message.objects


@pytest.mark.slow
def test_a_conflicting_prior_pose_is_replaced_and_its_sender_reported() -> None:
    world = cars(12, 0)
    found = PoseCorrection().correct(
        frame(), cache_of(world), [message_of(world, OTHERS[0], off=(15.0, 4.0, 1.0), sigma=0.3)], {}
    )
    (verdict,) = found.corrections
    assert verdict.estimate.status is PoseStatus.CONFLICT and verdict.health.health is PoseHealth.OFFSET
    assert pose_error(found.messages[0], OTHERS[0])[0] < 0.05


@pytest.mark.parametrize("sigma, use", [(0.2, MessageUse.PRIOR), (0.6, MessageUse.UNCERTAIN)])
def test_without_common_objects_only_a_certain_prior_pose_is_used(sigma: float, use: MessageUse) -> None:
    message = message_of(cars(9, 1), OTHERS[0], sigma=sigma)
    found = PoseCorrection().correct(frame(), cache_of(cars(9, 2)), [message], {})
    assert found.corrections[0].use is use and found.corrections[0].estimate.status is PoseStatus.NO_MATCH
    assert [m is message for m in found.messages] == ([True] if use is MessageUse.PRIOR else [])
    assert not found.corrections[0].untrusted


def test_an_uncertain_heading_counts_at_a_distance() -> None:
    message = replace(
        message_of(cars(9, 1), OTHERS[0]), pose_covariance=torch.diag(torch.tensor([0, 0, 0.03**2])).double()
    )
    assert not PoseCorrection().correct(frame(), cache_of(cars(9, 2)), [message], {}).messages
    assert PoseCorrection(lever_arm_m=10.0).correct(frame(), cache_of(cars(9, 2)), [message], {}).messages


def test_earlier_objects_are_propagated_to_the_current_time() -> None:
    """All cars drove on by 3 m since the sender's frame; without their velocity the fit would be off by as much."""
    world = cars(12, 3)
    then = replace(world, velocity=torch.tensor([[10.0, 0.0]], dtype=torch.float64).expand(12, 2))
    message = message_of(then, OTHERS[1], off=(0.5, 0.5, 0.0))
    now = frame(300_000_000)
    found = PoseCorrection().correct(now, cache_of(then.after(0.3)), [message], {})
    assert pose_error(found.messages[0], OTHERS[1])[0] < 0.1
    stopped = replace(then.transform(OTHERS[1].inverse()), velocity=torch.zeros(12, 2, dtype=torch.float64))
    still = replace(message, objects=stopped)
    assert (
        pose_error(PoseCorrection().correct(now, cache_of(then.after(0.3)), [still], {}).messages[0], OTHERS[1])[0]
        > 0.3
    )


def test_tokens_propose_the_boxes_that_objects_hold() -> None:
    grid = Detector(COSTR_TINY).token_grid
    rows = torch.zeros(4, BOX_LAYOUT.total)
    rows[:, BOX_LAYOUT.heatmap_logit], rows[:, BOX_LAYOUT.iou_logit], rows[:, BOX_LAYOUT.axis.start] = 5.0, 5.0, 1.0
    yx = torch.tensor([[2, 3], [20, 9], [9, 25], [30, 30]])
    tokens = SparseBev.from_cells(torch.cat((torch.randn(4, 8), rows), 1), yx, grid)
    proposed = extract_message_boxes(
        cache_of(cars(1, 0)), replace(message_of(cars(1, 0), EGO), objects=None, tokens=tokens)
    )
    wanted = {tuple(p) for p in grid.centers(yx).tolist()}
    assert {tuple(p) for p in proposed.center[:, :2].tolist()} == wanted
    assert len(extract_message_boxes(cache_of(cars(1, 0)), replace(message_of(cars(1, 0), EGO), objects=None))) == 0


def test_a_third_agent_corrects_an_agent_without_common_objects() -> None:
    """The ego shares no object with the second sender; the first shares some with both."""
    near, far = cars(9, 4), cars(9, 5)
    messages = [
        message_of(Boxes.cat([near, far]), OTHERS[0], 2, (0.6, 0.5, 0.01)),
        message_of(far, OTHERS[1], 3, (-1.0, 0.9, -0.02), sigma=1.5),
    ]
    alone = PoseCorrection().correct(frame(), cache_of(near), messages[1:], {})
    assert alone.corrections[0].use is MessageUse.UNCERTAIN and not alone.messages
    both = PoseCorrection().correct(frame(), cache_of(near), messages, {})
    assert [v.use for v in both.corrections] == [MessageUse.CORRECTED, MessageUse.CORRECTED]
    assert all(pose_error(m, p)[0] < 0.1 for m, p in zip(both.messages, OTHERS))


def shifted(world: Boxes, x: float, y: float) -> Boxes:
    return replace(world, center=world.center + torch.tensor([x, y, 0.0], dtype=torch.float64))


def test_an_inconsistent_agent_is_left_out() -> None:
    """A sender shows each of three agents the objects of that one alone, each set displaced in its own way."""
    all_see, parts = cars(8, 6), [cars(8, 7), cars(8, 8), cars(8, 9)]
    lie = Boxes.cat([shifted(parts[0], 3.0, 0.0), shifted(parts[1], 0.0, -4.0), shifted(parts[2], -5.0, 2.0)])
    messages = [
        message_of(Boxes.cat([all_see, parts[1]]), OTHERS[0], 2, sigma=0.4),
        message_of(Boxes.cat([all_see, parts[2]]), OTHERS[1], 3, sigma=0.4),
        message_of(lie, OTHERS[2], 4, sigma=0.4),
    ]
    found = PoseCorrection().correct(frame(), cache_of(Boxes.cat([all_see, parts[0]])), messages, {})
    assert [v.use for v in found.corrections] == [MessageUse.CORRECTED, MessageUse.CORRECTED, MessageUse.INCONSISTENT]
    assert [m.agent_id for m in found.messages] == [2, 3]
    assert [v.untrusted for v in found.corrections] == [False, False, True]
    assert all(pose_error(m, p)[0] < 0.1 for m, p in zip(found.messages, OTHERS))


def monitored(offsets: Sequence[float], world: Boxes, last: Boxes) -> Any:
    """Corrections over time of a sender with a prior pose error in x; in the last frame its boxes differ."""
    states, found = {}, None
    for n, off in enumerate(offsets):
        visible = last if n == len(offsets) - 1 else world
        message = message_of(visible, OTHERS[0], off=(off, 0.0, 0.0), sigma=0.2, time_ns=n * 100_000_000)
        found = PoseCorrection().correct(frame(n * 100_000_000), cache_of(world), [message], states)
        states = found.states
    return found


def test_a_prior_with_an_offset_is_not_used_without_common_objects() -> None:
    world, strange = cars(10, 10), cars(10, 11)
    honest, caught = monitored([0.0] * 6, world, strange), monitored([2.0] * 6, world, strange)
    assert honest.corrections[0].use is MessageUse.PRIOR and honest.corrections[0].health.health is PoseHealth.SOUND
    assert (
        caught.corrections[0].use is MessageUse.UNCERTAIN and caught.corrections[0].health.health is PoseHealth.OFFSET
    )
    assert caught.corrections[0].untrusted and not honest.corrections[0].untrusted


def test_a_repeated_message_is_counted_once_and_a_new_drive_resets_the_monitor() -> None:
    world = cars(10, 12)
    message = message_of(world, OTHERS[0], time_ns=500_000_000, sigma=0.2)
    first = PoseCorrection().correct(frame(500_000_000), cache_of(world), [message], {})
    again = PoseCorrection().correct(frame(600_000_000), cache_of(world), [message], first.states)
    assert again.corrections[0].health.num_frames == 1
    earlier = replace(message, timestamp_ns=0)
    again = PoseCorrection().correct(frame(), cache_of(world), [earlier], again.states)
    assert again.corrections[0].health.num_frames == 1 and again.states[2].monitor.time_s.tolist() == [0.0]


def test_an_agent_fuses_boxes_from_where_their_sender_is() -> None:
    """share → bytes → perceive with late fusion: what only the other sees lies where it really is."""
    known, hidden = cars(12, 13), cars(3, 14)
    detector = Detector(COSTR_TINY).eval()
    other = Agent(
        detector,
        LateFusion(),
        perception_cache=FixedBoxesCache(Boxes.cat([known, hidden]).transform(OTHERS[0].inverse()), detector),
    )
    claimed = message_of(known, OTHERS[0], off=(1.5, 1.0, 0.03), sigma=1.2)
    packets = other.share(
        replace(frame(), agent_id=2, world_from_agent=claimed.world_from_agent, pose_covariance=claimed.pose_covariance)
    )
    wanted = hidden.transform(EGO.inverse()).center[:, :2]
    missed = {}
    for aligner in (None, PoseCorrection()):
        ego = Agent(
            detector,
            LateFusion(),
            perception_cache=FixedBoxesCache(known.transform(EGO.inverse()), detector),
            pose_correction=aligner,
        )
        found = ego.perceive(frame(), packets)
        missed[aligner is None] = float(torch.cdist(wanted, found.boxes.center[:, :2]).amin(1).max())
        assert len(found.corrections) == (aligner is not None) and len(found.received) == 1
    assert missed[False] < 0.1 and missed[True] > 1.0


@pytest.mark.parametrize("strategy, uses_history", [(LateFusion(), False), (LateFusion(uses_history=True), True)])
def test_history_bridges_an_unlocalised_or_lost_message(strategy: LateFusion, uses_history: bool) -> None:
    """A valid prior at first; then an uninformative prior without common objects; then no message."""
    known, hidden = cars(12, 13), cars(3, 14)
    detector = Detector(COSTR_TINY).eval()
    wanted = hidden.transform(EGO.inverse()).center[:, :2]
    ego = Agent(
        detector,
        strategy,
        perception_cache=FixedBoxesCache(known.transform(EGO.inverse()), detector),
        pose_correction=PoseCorrection(propagate_s=0),
    )
    missed = []
    for tenth, seen in enumerate((Boxes.cat([known, hidden]), hidden, None)):
        packets = []
        if seen is not None:
            other = Agent(
                detector, strategy, perception_cache=FixedBoxesCache(seen.transform(OTHERS[0].inverse()), detector)
            )
            claim = message_of(seen, OTHERS[0], off=(1.5, 1.0, 0.03), sigma=1.2)
            where = {"world_from_agent": claim.world_from_agent, "pose_covariance": claim.pose_covariance}
            packets = other.share(replace(frame(tenth * 100_000_000), agent_id=2, **where))
        found = ego.perceive(frame(tenth * 100_000_000), packets)
        missed.append(float(torch.cdist(wanted, found.boxes.center[:, :2]).amin(1).max()))
    assert missed[0] < 0.1 and [m < 0.2 for m in missed[1:]] == [uses_history, uses_history]


def propagated_run(drive: Sequence[Boxes], steps_ms: Sequence[int], **settings: Any) -> list[Any]:
    """Corrections of a sender that moves 1 m a message with a prior error of 1.5 m; drive: its boxes at each message."""
    landmarks, states, found = cars(12, 13), {}, []
    at_ms = 0
    for n, (visible, step) in enumerate(zip(drive, steps_ms)):
        at_ms += step
        pose = Transform(
            OTHERS[0].rotation, OTHERS[0].translation + torch.tensor([1.0 * n, 0.0, 0.0], dtype=torch.float64)
        )
        message = message_of(visible, pose, off=(1.5 * (-1) ** n, 1.0, 0.03), sigma=1.2, time_ns=at_ms * 1_000_000)
        one = PoseCorrection(**settings).correct(frame(at_ms * 1_000_000), cache_of(landmarks), [message], states)
        states = one.states
        found.append((one.corrections[0], pose_error(one.messages[0], pose)[0] if one.messages else None))
    return found


def test_a_sender_without_common_objects_is_propagated_from_its_last_pose() -> None:
    known, hidden, strange = cars(12, 13), cars(6, 14), cars(6, 15)
    drive = [Boxes.cat([known, hidden]), hidden, hidden]
    (first, _), *later = propagated_run(drive, (0, 100, 100))
    assert all(verdict.use is MessageUse.CORRECTED and off < 0.15 for verdict, off in later)
    sigmas = [first.sigma_m, *(verdict.sigma_m for verdict, _ in later)]
    assert sigmas == sorted(sigmas) and sigmas[0] < sigmas[2]
    # Not what fits nothing that it saw before, not after long, not where nothing was placed, not if it is not asked for.
    for seen, steps, settings in (
        ([drive[0], strange], (0, 100), {}),
        (drive[:2], (0, 600), {}),
        ([hidden, hidden], (0, 100), {}),
        (drive[:2], (0, 100), {"propagate_s": 0.0}),
    ):
        assert propagated_run(seen, steps, **settings)[-1][0].use is MessageUse.UNCERTAIN
    with pytest.raises(ConfigError, match="sigma_speed_mps"):
        PoseCorrection(sigma_speed_mps=0.0)


def corrections_after(steps: Sequence[tuple[Boxes, Boxes, float]], sigma: float = 0.2) -> list[Any]:
    """Corrections of a sender at rest; steps: the ego's boxes, the sender's boxes and the error of its prior in x."""
    states, corrections = {}, []
    for n, (ego_boxes, other_boxes, off) in enumerate(steps):
        message = message_of(other_boxes, OTHERS[0], off=(off, 0.0, 0.0), sigma=sigma, time_ns=n * 100_000_000)
        one = PoseCorrection().correct(frame(n * 100_000_000), cache_of(ego_boxes), [message], states)
        states = one.states
        corrections.append((one.corrections[0], pose_error(one.messages[0], OTHERS[0])[0] if one.messages else None))
    return corrections


def test_one_measurement_does_not_overturn_a_prior_that_the_last_corrected_pose_supports() -> None:
    """The ego's boxes agree with the sender's at a pose 30 m away, as false boxes can."""
    world = cars(12, 13)
    false = shifted(world, 30.0, 5.0)
    (alone, far), *_ = corrections_after([(false, world, 0.0)])
    assert alone.estimate.status is PoseStatus.CONFLICT and far > 25
    *_, (rejected, off), (after, off_after) = corrections_after(
        [(world, world, 0.1), (false, world, 0.0), (cars(9, 2), world, 0.0)]
    )
    assert rejected.estimate.status is PoseStatus.AMBIGUOUS and off < 0.3
    assert rejected.health.health is PoseHealth.SOUND and rejected.health.num_frames == 1
    assert after.use is not MessageUse.UNCERTAIN and off_after < 0.3


def test_a_measurement_overturns_a_prior_that_leaves_the_last_corrected_pose() -> None:
    world = cars(12, 13)
    *_, (jumped, off) = corrections_after([(world, world, 0.1), (world, world, 30.0)])
    assert jumped.estimate.status is PoseStatus.CONFLICT and off < 0.1


@pytest.mark.parametrize("sigma, is_stated", [(0.01, True), (1.2, False)])
def test_without_common_objects_the_more_certain_of_prior_and_propagated_pose_is_used(
    sigma: float, is_stated: bool
) -> None:
    world = cars(12, 13)
    *_, (last, off) = corrections_after([(world, world, 0.0), (cars(9, 2), world, sigma)], sigma)
    assert last.use is (MessageUse.PRIOR if is_stated else MessageUse.CORRECTED)
    assert off == pytest.approx(sigma) if is_stated else off < 0.2


def test_a_measured_pose_too_uncertain_to_be_used_is_still_propagated() -> None:
    """The pose of the first message is not used, and yet rejects the false one of the second."""
    world = cars(12, 13)
    false = shifted(world, 30.0, 5.0)
    strict = PoseCorrection(max_sigma_m=0.01)
    first = strict.correct(frame(), cache_of(world), [message_of(world, OTHERS[0], off=(1.0, 0.0, 0.0))], {})
    assert first.corrections[0].use is MessageUse.UNCERTAIN and not first.messages
    now = message_of(world, OTHERS[0], off=(-1.0, 0.0, 0.0), time_ns=100_000_000)
    (second,) = PoseCorrection().correct(frame(100_000_000), cache_of(false), [now], first.states).corrections
    assert second.estimate.status is PoseStatus.AMBIGUOUS and second.health.num_frames == 1


def test_the_propagated_pose_takes_the_place_of_a_certain_prior_whose_sender_had_an_offset() -> None:
    world = cars(12, 13)
    steps = [*([(world, world, 2.0)] * 4), (world, world, 0.0), (cars(9, 2), world, 0.0)]
    (*_, (last, off)) = corrections_after(steps, 0.05)
    assert last.health.health is PoseHealth.OFFSET
    assert last.use is MessageUse.CORRECTED and off < 0.2


def test_the_state_of_a_sender_that_left_expires() -> None:
    world, strange = cars(10, 12), cars(10, 11)
    messages = [message_of(world, OTHERS[0], sigma=0.2), message_of(strange, OTHERS[1], agent_id=3, sigma=0.2)]
    states = PoseCorrection().correct(frame(), cache_of(world), messages, {}).states
    assert [(a, len(s.monitor.time_s), s.last_corrected is None) for a, s in states.items()] == [
        (2, 1, False),
        (3, 0, True),
    ]

    def state_after(seconds: float) -> list[tuple[int, bool]]:
        left = PoseCorrection().correct(frame(round(seconds * 1e9)), cache_of(world), [], states).states
        return [(a, s.last_corrected is None) for a, s in left.items()]

    assert [state_after(s) for s in (1.4, 1.6, 59.0, 61.0)] == [[(2, False)], [(2, True)], [(2, True)], []]


def test_no_messages_and_unknown_correctors() -> None:
    found = PoseCorrection().correct(frame(), cache_of(cars(5, 0)), [], {})
    assert (found.messages, found.corrections, dict(found.states)) == ((), (), {})
    with pytest.raises(ConfigError, match=r"known: clipper, coalign, .*voting"):
        PoseCorrection(corrector="magic")


def body(pose: Transform) -> Boxes:
    """The vehicle that carries an agent there."""
    one = torch.ones(1, dtype=torch.float64)
    found = Boxes.of(
        pose.translation[None] + torch.tensor([0.0, 0.0, 0.8]), torch.tensor([[4.6, 1.85, 1.6]]), one * float(pose.yaw)
    )
    return replace(found, sigma_xy=0.1 * one, sigma_yaw=0.02 * one, p_flip=0.01 * one)


def mutual_detection(pole: bool, late_ns: int) -> Any:
    """Ego and sender share one car and detect each other; a prior error of 0.8 m."""
    shared, sender = cars(1, 14), OTHERS[0]
    sent_boxes = Boxes.cat([shared, body(EGO)])
    message = replace(message_of(sent_boxes, sender, off=(0.6, -0.5, 0.01)), is_infrastructure=pole)
    cache = cache_of(Boxes.cat([shared, body(sender)]))
    return PoseCorrection().correct(frame(late_ns), cache, [message], {}), sender


def test_vehicles_that_detect_each_other_are_landmarks() -> None:
    found, sender = mutual_detection(pole=False, late_ns=0)
    (verdict,) = found.corrections
    assert verdict.use is MessageUse.CORRECTED and verdict.estimate.inliers == 3
    assert pose_error(found.messages[0], sender)[0] < 0.15
    # A pole is no vehicle that the ego could have seen, and where a sender was it may not be any more.
    for pole, late_ns in ((True, 0), (False, 100_000_000)):
        (verdict,) = mutual_detection(pole, late_ns)[0].corrections
        assert verdict.estimate.inliers < 3


def test_bodies_that_are_not_stated_are_estimated_over_time_of_senders_and_of_the_ego() -> None:
    """Both agents detect ten cars and each other; the middles are 1.5 m ahead of the frames' origins."""
    world, body = cars(10, 12), AgentBody.standing(1.5, 0.0, (4.5, 1.9, 1.6))
    sender, ego = (body.boxes(torch.float64).transform(pose) for pose in (OTHERS[0], EGO))
    states: Any = {}
    for n in range(4):
        message = message_of(Boxes.cat([world, ego]), OTHERS[0], sigma=0.2, time_ns=n * 1_000_000_000)
        cache = cache_of(Boxes.cat([world, sender]))
        stated = PoseCorrection().correct(frame(n * 1_000_000_000), cache, [replace(message, body=body)], {}).states
        states = PoseCorrection().correct(frame(n * 1_000_000_000), cache, [message], states).states
        assert stated[2].body is None and stated[1].body is not None
    for agent in (1, 2):
        found = states[agent].body
        assert found is not None and found.num_measurements == 4 and found.sigma_m() < 0.25
        np.testing.assert_allclose(found.xy, [1.5, 0.0], atol=0.1)
    # A minute without measurements ends the estimate.
    assert not PoseCorrection().correct(frame(70_000_000_000), cache_of(world), [], states).states
