# SPDX-License-Identifier: Apache-2.0
"""What an ego makes of others' claimed poses before it fuses: a street of cars, eyes that are told what to see."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.perception_cache import Eyes
from manyeyes.agents.pose_correction import Aligner, Use, boxes_of
from manyeyes.agents.strategies import Late
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, Message, PointCloud, SparseBev, Transform
from manyeyes.models.detector.box_head import RAW, DecodeConfig, RawBoxes, decode
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.pose.pose_monitor import Health
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
    found = Boxes.of(*map(torch.from_numpy, (center, size)), torch.from_numpy(rng.uniform(-3, 3, count)))
    sure = torch.full((count,), 0.1, dtype=torch.float64)
    return replace(found, sigma_xy=sure, sigma_yaw=sure * 0.2, flip=sure * 0.1)


class ToldEyes(Eyes):
    """An ego that sees given boxes and decodes as the detector does."""

    def __init__(self, boxes: Boxes, detector: Detector | None = None) -> None:
        super().__init__(detector or Detector(COSTR_TINY))
        self.boxes = boxes

    def see(self, frame: AgentFrame) -> Any:
        return self

    def decode(self, raw: RawBoxes) -> Boxes:
        return decode(raw, DecodeConfig())[0]


def frame(time_ns: int = 0) -> AgentFrame:
    return replace(AgentFrame.of(PointCloud.of(torch.zeros(1, 3)), EGO, agent_id=1), timestamp_ns=time_ns)


def eyes(world: Boxes) -> Eyes:
    return ToldEyes(world.transform(EGO.inverse()))


def said(
    world: Boxes,
    pose: Transform,
    agent_id: int = 2,
    off: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sigma: float = 1.0,
    time_ns: int = 0,
) -> Message:
    """Boxes of the world as seen from a pose, claimed to be seen from a pose that is off by x, y (m), yaw (rad)."""
    x, y, yaw = off
    claimed = Transform(
        Transform.from_xyz_yaw(0, 0, 0, yaw).rotation @ pose.rotation,
        pose.translation + torch.tensor([x, y, 0.0], dtype=torch.float64),
    )
    covariance = torch.diag(torch.tensor([sigma, sigma, math.radians(sigma)], dtype=torch.float64) ** 2)
    return Message(agent_id, time_ns, claimed, covariance, objects=world.transform(pose.inverse()))


def apart(message: Message, pose: Transform) -> tuple[float, float]:
    """Metres and degrees between what a message says of its pose and the pose."""
    turn = float((message.world_from_agent.yaw - pose.yaw + math.pi) % (2 * math.pi) - math.pi)
    return float((message.world_from_agent.translation - pose.translation).norm()), math.degrees(abs(turn))


def test_a_wrong_claim_is_corrected_and_its_error_stated_anew() -> None:
    world = cars(12, 0)
    message = said(world, OTHERS[0], off=(1.2, -0.8, 0.02))
    found = Aligner().align(frame(), eyes(world), [message], {})
    (kept,), (verdict,) = found.messages, found.verdicts
    assert verdict.use is Use.CORRECTED and verdict.estimate.status is PoseStatus.OK and verdict.sigma_m < 0.2
    assert apart(message, OTHERS[0])[0] > 1.4
    metres, degrees = apart(kept, OTHERS[0])
    assert metres < 0.05 and degrees < 0.05
    assert float(torch.linalg.eigvalsh(kept.pose_covariance).max()) < 0.02
    assert kept.objects is message.objects


def test_a_claim_that_is_refuted_is_replaced_and_its_sender_named() -> None:
    world = cars(12, 0)
    found = Aligner().align(frame(), eyes(world), [said(world, OTHERS[0], off=(15.0, 4.0, 1.0), sigma=0.3)], {})
    (verdict,) = found.verdicts
    assert verdict.estimate.status is PoseStatus.CONFLICT and verdict.health.health is Health.OFFSET
    assert apart(found.messages[0], OTHERS[0])[0] < 0.05


@pytest.mark.parametrize("sigma, use", [(0.2, Use.CLAIMED), (0.6, Use.UNSURE)])
def test_without_common_objects_only_a_claim_that_is_sure_is_used(sigma: float, use: Use) -> None:
    message = said(cars(9, 1), OTHERS[0], sigma=sigma)
    found = Aligner().align(frame(), eyes(cars(9, 2)), [message], {})
    assert found.verdicts[0].use is use and found.verdicts[0].estimate.status is PoseStatus.NO_MATCH
    assert [m is message for m in found.messages] == ([True] if use is Use.CLAIMED else [])
    assert not found.verdicts[0].distrusted


def test_an_uncertain_heading_counts_at_a_distance() -> None:
    message = replace(said(cars(9, 1), OTHERS[0]), pose_covariance=torch.diag(torch.tensor([0, 0, 0.03**2])).double())
    assert not Aligner().align(frame(), eyes(cars(9, 2)), [message], {}).messages
    assert Aligner(reach_m=10.0).align(frame(), eyes(cars(9, 2)), [message], {}).messages


def test_objects_seen_earlier_are_moved_to_now() -> None:
    """All cars drove on by 3 m since the sender looked; without their velocity the fit would be off by as much."""
    world = cars(12, 3)
    then = replace(world, velocity=torch.tensor([[10.0, 0.0]], dtype=torch.float64).expand(12, 2))
    message = said(then, OTHERS[1], off=(0.5, 0.5, 0.0))
    now = frame(300_000_000)
    found = Aligner().align(now, eyes(then.after(0.3)), [message], {})
    assert apart(found.messages[0], OTHERS[1])[0] < 0.1
    still = replace(message, objects=replace(message.objects, velocity=torch.zeros(12, 2, dtype=torch.float64)))
    assert apart(Aligner().align(now, eyes(then.after(0.3)), [still], {}).messages[0], OTHERS[1])[0] > 0.3


def test_tokens_propose_the_boxes_that_objects_would_say() -> None:
    grid = Detector(COSTR_TINY).token_grid
    rows = torch.zeros(4, RAW.total)
    rows[:, RAW.heat], rows[:, RAW.overlap], rows[:, RAW.axis.start] = 5.0, 5.0, 1.0
    yx = torch.tensor([[2, 3], [20, 9], [9, 25], [30, 30]])
    tokens = SparseBev.from_cells(torch.cat((torch.randn(4, 8), rows), 1), yx, grid)
    proposed = boxes_of(eyes(cars(1, 0)), replace(said(cars(1, 0), EGO), objects=None, tokens=tokens))
    wanted = {tuple(p) for p in grid.centers(yx).tolist()}
    assert {tuple(p) for p in proposed.center[:, :2].tolist()} == wanted
    assert len(boxes_of(eyes(cars(1, 0)), replace(said(cars(1, 0), EGO), objects=None))) == 0


def test_a_third_agent_corrects_whom_the_ego_cannot_recognise() -> None:
    """The ego shares no object with the second sender; the first shares some with both."""
    near, far = cars(9, 4), cars(9, 5)
    messages = [
        said(Boxes.cat([near, far]), OTHERS[0], 2, (0.6, 0.5, 0.01)),
        said(far, OTHERS[1], 3, (-1.0, 0.9, -0.02), sigma=1.5),
    ]
    alone = Aligner().align(frame(), eyes(near), messages[1:], {})
    assert alone.verdicts[0].use is Use.UNSURE and not alone.messages
    both = Aligner().align(frame(), eyes(near), messages, {})
    assert [v.use for v in both.verdicts] == [Use.CORRECTED, Use.CORRECTED]
    assert all(apart(m, p)[0] < 0.1 for m, p in zip(both.messages, OTHERS))


def shifted(world: Boxes, x: float, y: float) -> Boxes:
    return replace(world, center=world.center + torch.tensor([x, y, 0.0], dtype=torch.float64))


def test_who_fits_nobody_in_one_way_is_left_out() -> None:
    """A sender shows each of three agents the objects of that one alone, each set displaced in its own way."""
    all_see, parts = cars(8, 6), [cars(8, 7), cars(8, 8), cars(8, 9)]
    lie = Boxes.cat([shifted(parts[0], 3.0, 0.0), shifted(parts[1], 0.0, -4.0), shifted(parts[2], -5.0, 2.0)])
    messages = [
        said(Boxes.cat([all_see, parts[1]]), OTHERS[0], 2, sigma=0.4),
        said(Boxes.cat([all_see, parts[2]]), OTHERS[1], 3, sigma=0.4),
        said(lie, OTHERS[2], 4, sigma=0.4),
    ]
    found = Aligner().align(frame(), eyes(Boxes.cat([all_see, parts[0]])), messages, {})
    assert [v.use for v in found.verdicts] == [Use.CORRECTED, Use.CORRECTED, Use.CONTRADICTED]
    assert [m.agent_id for m in found.messages] == [2, 3]
    assert [v.distrusted for v in found.verdicts] == [False, False, True]
    assert all(apart(m, p)[0] < 0.1 for m, p in zip(found.messages, OTHERS))


def watched(offsets: Sequence[float], world: Boxes, last: Boxes) -> Any:
    """Verdicts over time about a sender whose claim is off by so much in x; in the last frame its boxes are others."""
    states, found = {}, None
    for n, off in enumerate(offsets):
        seen = last if n == len(offsets) - 1 else world
        message = said(seen, OTHERS[0], off=(off, 0.0, 0.0), sigma=0.2, time_ns=n * 100_000_000)
        found = Aligner().align(frame(n * 100_000_000), eyes(world), [message], states)
        states = found.states
    return found


def test_a_sender_whose_claims_were_off_is_not_believed_where_objects_are_silent() -> None:
    world, strange = cars(10, 10), cars(10, 11)
    honest, caught = watched([0.0] * 6, world, strange), watched([2.0] * 6, world, strange)
    assert honest.verdicts[0].use is Use.CLAIMED and honest.verdicts[0].health.health is Health.SOUND
    assert caught.verdicts[0].use is Use.UNSURE and caught.verdicts[0].health.health is Health.OFFSET
    assert caught.verdicts[0].distrusted and not honest.verdicts[0].distrusted


def test_a_message_heard_twice_says_nothing_new_and_a_new_drive_begins_anew() -> None:
    world = cars(10, 12)
    message = said(world, OTHERS[0], time_ns=500_000_000, sigma=0.2)
    first = Aligner().align(frame(500_000_000), eyes(world), [message], {})
    again = Aligner().align(frame(600_000_000), eyes(world), [message], first.states)
    assert again.verdicts[0].health.frames == 1
    earlier = replace(message, timestamp_ns=0)
    anew = Aligner().align(frame(), eyes(world), [earlier], again.states)
    assert anew.verdicts[0].health.frames == 1 and anew.states[2].watch.time.tolist() == [0.0]


def test_an_agent_fuses_boxes_from_where_their_sender_is() -> None:
    """share → bytes → perceive with late fusion: what only the other sees lies where it really is."""
    known, hidden = cars(12, 13), cars(3, 14)
    detector = Detector(COSTR_TINY).eval()
    other = Agent(detector, Late(), eyes=ToldEyes(Boxes.cat([known, hidden]).transform(OTHERS[0].inverse()), detector))
    claimed = said(known, OTHERS[0], off=(1.5, 1.0, 0.03), sigma=1.2)
    packets = other.share(
        replace(frame(), agent_id=2, world_from_agent=claimed.world_from_agent, pose_covariance=claimed.pose_covariance)
    )
    wanted = hidden.transform(EGO.inverse()).center[:, :2]
    missed = {}
    for aligner in (None, Aligner()):
        ego = Agent(detector, Late(), eyes=ToldEyes(known.transform(EGO.inverse()), detector), aligner=aligner)
        found = ego.perceive(frame(), packets)
        missed[aligner is None] = float(torch.cdist(wanted, found.boxes.center[:, :2]).amin(1).max())
        assert len(found.verdicts) == (aligner is not None) and len(found.heard) == 1
    assert missed[False] < 0.1 and missed[True] > 1.0


@pytest.mark.parametrize("way, remembers", [(Late(), False), (Late("remembering", instants=2), True)])
def test_who_cannot_be_placed_or_is_lost_is_where_it_was_if_the_method_remembers(way: Late, remembers: bool) -> None:
    """First all is well; then the claim says nothing and there is no object in common; then nothing comes."""
    known, hidden = cars(12, 13), cars(3, 14)
    detector = Detector(COSTR_TINY).eval()
    wanted = hidden.transform(EGO.inverse()).center[:, :2]
    ego = Agent(detector, way, eyes=ToldEyes(known.transform(EGO.inverse()), detector), aligner=Aligner(follow_s=0))
    missed = []
    for tenth, seen in enumerate((Boxes.cat([known, hidden]), hidden, None)):
        packets = []
        if seen is not None:
            other = Agent(detector, way, eyes=ToldEyes(seen.transform(OTHERS[0].inverse()), detector))
            claim = said(seen, OTHERS[0], off=(1.5, 1.0, 0.03), sigma=1.2)
            where = {"world_from_agent": claim.world_from_agent, "pose_covariance": claim.pose_covariance}
            packets = other.share(replace(frame(tenth * 100_000_000), agent_id=2, **where))
        found = ego.perceive(frame(tenth * 100_000_000), packets)
        missed.append(float(torch.cdist(wanted, found.boxes.center[:, :2]).amin(1).max()))
    assert missed[0] < 0.1 and [m < 0.2 for m in missed[1:]] == [remembers, remembers]


def told_on(drive: Sequence[Boxes], steps_ms: Sequence[int], **settings: Any) -> list[Any]:
    """What becomes of a sender that drives on by 1 m a message, its claims 1.5 m off; drive: what it sees at each."""
    known, states, found = cars(12, 13), {}, []
    at_ms = 0
    for n, (seen, step) in enumerate(zip(drive, steps_ms)):
        at_ms += step
        pose = Transform(
            OTHERS[0].rotation, OTHERS[0].translation + torch.tensor([1.0 * n, 0.0, 0.0], dtype=torch.float64)
        )
        message = said(seen, pose, off=(1.5 * (-1) ** n, 1.0, 0.03), sigma=1.2, time_ns=at_ms * 1_000_000)
        one = Aligner(**settings).align(frame(at_ms * 1_000_000), eyes(known), [message], states)
        states = one.states
        found.append((one.verdicts[0], apart(one.messages[0], pose)[0] if one.messages else None))
    return found


def test_a_sender_whom_nobody_recognises_is_followed_from_where_it_was_placed() -> None:
    known, hidden, strange = cars(12, 13), cars(6, 14), cars(6, 15)
    drive = [Boxes.cat([known, hidden]), hidden, hidden]
    (first, _), *later = told_on(drive, (0, 100, 100))
    assert all(verdict.use is Use.CORRECTED and off < 0.15 for verdict, off in later)
    sigmas = [first.sigma_m, *(verdict.sigma_m for verdict, _ in later)]
    assert sigmas == sorted(sigmas) and sigmas[0] < sigmas[2]
    # Not what fits nothing that it saw before, not after long, not where nothing was placed, not if it is not asked for.
    for seen, steps, settings in (
        ([drive[0], strange], (0, 100), {}),
        (drive[:2], (0, 600), {}),
        ([hidden, hidden], (0, 100), {}),
        (drive[:2], (0, 100), {"follow_s": 0.0}),
    ):
        assert told_on(seen, steps, **settings)[-1][0].use is Use.UNSURE
    with pytest.raises(ConfigError, match="pace_mps"):
        Aligner(pace_mps=0.0)


def test_nobody_heard_and_unknown_correctors() -> None:
    found = Aligner().align(frame(), eyes(cars(5, 0)), [], {})
    assert (found.messages, found.verdicts, dict(found.states)) == ((), (), {})
    with pytest.raises(ConfigError, match="known: vote, given"):
        Aligner(corrector="magic")


def body(pose: Transform) -> Boxes:
    """The vehicle that carries an agent there."""
    one = torch.ones(1, dtype=torch.float64)
    found = Boxes.of(
        pose.translation[None] + torch.tensor([0.0, 0.0, 0.8]), torch.tensor([[4.6, 1.85, 1.6]]), one * float(pose.yaw)
    )
    return replace(found, sigma_xy=0.1 * one, sigma_yaw=0.02 * one, flip=0.01 * one)


def meeting(pole: bool, late_ns: int) -> Any:
    """Ego and sender share one car, and see each other; a claim 0.8 m off."""
    shared, sender = cars(1, 14), OTHERS[0]
    told = Boxes.cat([shared, body(EGO)])
    message = replace(said(told, sender, off=(0.6, -0.5, 0.01)), is_infrastructure=pole)
    seen = eyes(Boxes.cat([shared, body(sender)]))
    return Aligner().align(frame(late_ns), seen, [message], {}), sender


def test_vehicles_that_see_each_other_are_landmarks_themselves() -> None:
    found, sender = meeting(pole=False, late_ns=0)
    (verdict,) = found.verdicts
    assert verdict.use is Use.CORRECTED and verdict.estimate.inliers == 3
    assert apart(found.messages[0], sender)[0] < 0.15
    # A pole is no vehicle that the ego could have seen, and where a sender was it may not be any more.
    for pole, late_ns in ((True, 0), (False, 100_000_000)):
        (verdict,) = meeting(pole, late_ns)[0].verdicts
        assert verdict.estimate.inliers < 3
