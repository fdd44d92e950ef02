# SPDX-License-Identifier: Apache-2.0
"""Claims in the blind area of the ego, and observers whose sight states the place to be free::

                        A (30, 30)
             |  wall      |
             |            v
             |   B ghost (34, 14)      <- hidden from the ego by the wall
             |                    <--- C (52, 12)
    ego (0, 0) ----> car (15, 0)       D (30, -6)

Agent 1 claims the ghost; agents 2 (A), 3 (C) and 4 (D) are the others. Each sender has exact rays of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from tests.agents.trust.street import HEIGHT_M, SEEN, TENTH_NS, cars, kinds, scan, sender

from manyeyes.agents.trust.claims import Claims
from manyeyes.agents.trust.detectors.ray_evidence import RayEvidenceDetector
from manyeyes.agents.trust.interface import Assessment, Evidence, MisbehaviourInput, SenderStatus
from manyeyes.agents.trust.observers import ObserverConfig, PlacedBoxes, count_observers
from manyeyes.datatypes import AgentFrame, Boxes, Message, PointCloud, Sight, Transform
from manyeyes.datatypes.sight import NUM_SECTORS
from manyeyes.ops.lidar.free_range import measure_sight

GHOST, EAST, NORTH, SOUTH = (34.0, 14.0), (52.0, 12.0), (30.0, 30.0), (30.0, -6.0)
CLAIMER_AT = (45.0, 25.0)
WALL = Boxes.of(
    torch.tensor([[18.0, 12.0, 1.5]]).double(), torch.tensor([[0.5, 14.0, 3.0]]).double(), torch.zeros(1).double()
)
SEEN_TOO = (12.0, -10.0)
ALL_FREE = Sight(np.full(NUM_SECTORS, 255))
UNCHECKED, CORROBORATED, DISPUTED, REFUTED = (
    int(kind) for kind in (Evidence.UNCHECKED, Evidence.CORROBORATED, Evidence.DISPUTED, Evidence.REFUTED)
)
NORMAL, MALICIOUS = SenderStatus.NORMAL, SenderStatus.MALICIOUS
DETECTOR = RayEvidenceDetector()
CAR_THERE = (WALL, cars(SEEN, SEEN_TOO, GHOST))
NOTHING_THERE = (WALL, cars(SEEN, SEEN_TOO))


@lru_cache(maxsize=64)
def sight_from(place: tuple[float, float], solid: tuple[Boxes, ...] = NOTHING_THERE, yaw: float = 0.0) -> Sight:
    """The sight of an agent at a place, by exact rays among boxes along the axes of the ego."""
    boxes = Boxes.cat(list(solid))
    points = scan(replace(boxes, center=boxes.center - torch.tensor([*place, 0.0]).double()))
    points = Transform.from_xyz_yaw(0.0, 0.0, 0.0, -yaw).apply(points)
    return measure_sight(points.float(), HEIGHT_M)


@dataclass(frozen=True)
class Sender:
    """What one sender states. at: its place; error: of the pose that it states, x, y; sigma_m: as stated. late: seconds."""

    boxes: Boxes
    at: tuple[float, float]
    sight: Sight | None = None
    error: tuple[float, float] = (0.0, 0.0)
    sigma_m: float = 0.0
    sigma_yaw: float = 0.0
    late: float = 0.0
    yaw: float = 0.0
    height_m: float = 0.0


@lru_cache(maxsize=8)
def ego_points(has_car: bool) -> torch.Tensor:
    return scan(Boxes.cat(list(CAR_THERE if has_car else NOTHING_THERE)))


@dataclass
class Crossing:
    """The ego's view over time, with senders that have poses and sights of their own."""

    has_car: bool = False
    own: Boxes = field(default_factory=lambda: cars(SEEN, SEEN_TOO))
    detector: RayEvidenceDetector = DETECTOR
    state: object | None = None
    index: int = 0

    def step(self, senders: Mapping[int, Sender], faulty: Sequence[int] = ()) -> Assessment:
        now_ns = TENTH_NS * (self.index + 1)
        points = PointCloud.of(ego_points(self.has_car))
        frame = AgentFrame.of(points, Transform.identity(), 0, now_ns, sensor_height_m=HEIGHT_M)
        messages, claims = list[Message](), list[Claims]()
        for agent_id, one in sorted(senders.items()):
            x, y = one.at[0] + one.error[0], one.at[1] + one.error[1]
            pose = Transform.from_xyz_yaw(x, y, one.height_m, one.yaw)
            covariance = torch.diag(torch.tensor([one.sigma_m, one.sigma_m, one.sigma_yaw]).double() ** 2)
            sent_ns = now_ns - round(one.late * 1e9)
            messages.append(Message(agent_id, sent_ns, pose, covariance, sight=one.sight))
            stated = Claims.of(agent_id, one.boxes, np.full(len(one.boxes), 0.1))
            claims.append(replace(stated, sender_xy=(x, y)))
        content = MisbehaviourInput(
            frame, self.own, tuple(messages), lambda: tuple(claims), lambda ids: self.own, frozenset(faulty)
        )
        found = self.detector.assess(content, self.state)
        self.state, self.index = found.state, self.index + 1
        return found

    def run(self, num_frames: int, senders: Mapping[int, Sender]) -> Assessment:
        return [self.step(senders) for _ in range(num_frames)][-1]


def honest(k: int, *more: tuple[float, float]) -> Boxes:
    """The cars that the ego sees, as sender k detects them, and more."""
    return cars(*((x + 0.05 * k, y - 0.04 * k) for x, y in (SEEN, SEEN_TOO)), *more)


def sees(k: int, place: tuple[float, float], solid: tuple[Boxes, ...] = NOTHING_THERE, **options) -> Sender:
    return Sender(honest(k), place, sight_from(place, solid), **options)


CLAIMER = Sender(honest(1, GHOST), CLAIMER_AT)
WITH_TWO = {1: CLAIMER, 2: sees(2, NORTH), 3: sees(3, EAST)}


def without_ghost(senders: Mapping[int, Sender]) -> dict[int, Sender]:
    return {agent_id: replace(one, boxes=one.boxes[:2], sight=None) for agent_id, one in senders.items()}


def after_trust(senders: Mapping[int, Sender], has_car: bool = False) -> Crossing:
    """A crossing where all senders gained trust by true claims."""
    crossing = Crossing(has_car)
    found = crossing.run(5, without_ghost(senders))
    assert all(s.trust >= 0.8 for s in found.senders)
    return crossing


def ghost_kind(found: Assessment, agent_id: int = 1) -> int:
    return kinds(found, agent_id)[2]


def test_the_sights_of_the_scene_are_what_they_should_be():
    """That of the ego ends at the wall; those of the others reach beyond the place, and end before a car there."""
    toward = lambda one: int(math.degrees(math.atan2(GHOST[1] - one[1], GHOST[0] - one[0])) % 360 // 2)  # noqa: E731
    for place, is_open in (((0.0, 0.0), False), (NORTH, True), (EAST, True), (SOUTH, True)):
        distance = math.dist(place, GHOST)
        free, blocked = (sight_from(place, solid).free_m[toward(place)] for solid in (NOTHING_THERE, CAR_THERE))
        assert (free > distance + 4) == is_open and blocked < distance


def test_two_trusted_observers_refute_what_the_ego_cannot_see():
    found = after_trust(WITH_TWO).step(WITH_TWO)
    assert kinds(found, 1) == [Evidence.SUPPORTED, Evidence.SUPPORTED, REFUTED]
    assert kinds(found, 2) == kinds(found, 3) == [Evidence.SUPPORTED] * 2


def test_without_sights_it_stays_unchecked():
    blind = {agent_id: replace(one, sight=None) for agent_id, one in WITH_TWO.items()}
    assert ghost_kind(after_trust(blind).run(10, blind)) == UNCHECKED


def test_one_observer_is_not_enough():
    one = {**WITH_TWO, 3: replace(WITH_TWO[3], sight=None)}
    found = after_trust(one).run(10, one)
    assert ghost_kind(found) == UNCHECKED and sender(found, 1).status is NORMAL
    own_sight = {**one, 1: replace(CLAIMER, sight=ALL_FREE)}
    assert ghost_kind(after_trust(own_sight).step(own_sight)) == UNCHECKED, "the claimer is no observer"


def test_a_observer_of_low_trust_is_not_enough():
    assert ghost_kind(Crossing().step(WITH_TWO)) == UNCHECKED, "no sender is trusted yet"
    crossing = after_trust({1: CLAIMER, 2: WITH_TWO[2]})
    assert ghost_kind(crossing.step({**WITH_TWO, 3: replace(WITH_TWO[3], boxes=cars())})) == UNCHECKED


def test_an_accused_or_faulty_observer_is_not_enough():
    refuted = {**WITH_TWO, 3: replace(WITH_TWO[3], boxes=honest(3, (12.0, -5.0)))}
    found = after_trust(WITH_TWO).step(refuted)
    assert kinds(found, 3)[2] == REFUTED and ghost_kind(found) == UNCHECKED
    assert ghost_kind(after_trust(WITH_TWO).step(WITH_TWO, faulty=[3])) == UNCHECKED


def test_an_honest_occluded_car_is_not_refuted():
    """The free ranges of the observers end before it."""
    true = {1: CLAIMER, 2: sees(2, NORTH, CAR_THERE), 3: sees(3, EAST, CAR_THERE), 4: sees(4, SOUTH, CAR_THERE)}
    found = after_trust(true, has_car=True).run(20, true)
    assert ghost_kind(found) == UNCHECKED and sender(found, 1).trust > 0.8
    assert all(s.status is NORMAL for s in found.senders)


@pytest.mark.parametrize("offset", [(3.8, 0.0), (-3.8, 0.0), (0.0, 3.8), (0.0, -3.8), (2.7, 2.7)])
def test_pose_errors_of_observers_do_not_refute_a_true_car(offset):
    """Poses off by 3.8 m at a standard deviation of 0.7 m: five of them, and more than the width of the car."""
    true = {
        1: CLAIMER,
        2: sees(2, NORTH, CAR_THERE, error=offset, sigma_m=0.7),
        3: sees(3, EAST, CAR_THERE, error=offset, sigma_m=0.7),
    }
    # Without the check by which the ego finds that both observers miss its own cars.
    crossing = Crossing(True, detector=replace(DETECTOR, observers=ObserverConfig(min_own_score=1.1)))
    crossing.run(5, without_ghost(true))
    assert ghost_kind(crossing.step(true)) == UNCHECKED
    assert ghost_kind(after_trust(true, has_car=True).step(true)) == UNCHECKED


def test_a_observer_of_large_pose_error_concludes_nothing():
    for options in ({"sigma_m": 1.2}, {"sigma_yaw": 0.08}):
        unsure = {**WITH_TWO, 3: replace(WITH_TWO[3], **options)}
        assert ghost_kind(after_trust(WITH_TWO).step(unsure)) == UNCHECKED
    small = {**WITH_TWO, 3: replace(WITH_TWO[3], sigma_m=0.4, sigma_yaw=0.007)}
    assert ghost_kind(after_trust(WITH_TWO).step(small)) == REFUTED


def is_refuted_beyond(gap_m: float, sigma_m: float, config: ObserverConfig) -> bool:
    """Whether one sight refutes a car ahead whose footprint lies gap_m within the free range of 40 m, at its corners.

    sigma_m: of the claim; poses are exact.
    """
    place = Message(2, 0, Transform.identity(), torch.zeros(3, 3).double(), sight=Sight(np.full(NUM_SECTORS, 80)))
    half = np.array([2.25, 0.95]) + gap_m
    ahead = math.sqrt(40.0**2 - half[1] ** 2) - half[0]
    claims = [
        Claims.of(1, cars((ahead, 0.0)), np.array([sigma_m])),
        replace(Claims.of(2, cars(), np.zeros(0)), sender_xy=(50.0, 0.0)),
    ]
    frame = AgentFrame.of(PointCloud.of(torch.zeros(0, 3)), Transform.identity(), 0, 0)
    messages = (replace(place, agent_id=1, sight=None), place)
    nothing = PlacedBoxes(np.zeros((0, 7)), np.zeros((0, 2)), np.zeros(0))
    counts = count_observers(frame, messages, claims, nothing, {2}, (0.02, 0.6, 2.0), replace(config, min_observers=1))
    return bool(counts[0][0])


@pytest.mark.parametrize("min_sigma_m", [0.1, 0.3, 0.6])
@pytest.mark.parametrize("sigma_m", [0.0, 0.2, 0.5])
def test_the_margin_is_that_of_the_larger_standard_deviation_of_claim_and_bound(min_sigma_m, sigma_m):
    """A claim that is stated without error has that of min_sigma_m; one of a larger error keeps its own."""
    config = ObserverConfig(min_sigma_m=min_sigma_m)
    margin_m = config.margin_m + config.num_sigmas * max(sigma_m, min_sigma_m)
    assert is_refuted_beyond(margin_m + 0.01, sigma_m, config)
    assert not is_refuted_beyond(margin_m - 0.01, sigma_m, config)


def test_a_turned_observer_counts_alike():
    """A car beside the place leaves room for one along it, not across it."""
    beside = (WALL, cars(SEEN, SEEN_TOO, (GHOST[0], GHOST[1] - 3.6)))
    for yaw in (2.0, math.pi / 4, -math.pi / 4):
        turned = {**WITH_TWO, 3: replace(sees(3, EAST), sight=sight_from(EAST, beside, yaw), yaw=yaw)}
        assert ghost_kind(after_trust(WITH_TWO).step(turned)) == REFUTED
    across = replace(honest(1, GHOST), yaw=torch.tensor([0.0, 0.0, math.pi / 2]).double())
    assert ghost_kind(after_trust(WITH_TWO).step({**turned, 1: replace(CLAIMER, boxes=across)})) == UNCHECKED


def test_claims_are_compared_at_the_time_of_the_sweep_of_a_late_observer():
    """A car of 25 m/s stood 7.5 m farther back 0.3 s before: there late sights end, and they state its place of now to be free."""
    before = (WALL, cars(SEEN, SEEN_TOO, (GHOST[0] - 7.5, GHOST[1])))
    moving = replace(honest(1, GHOST), velocity=torch.tensor([[0.0, 0.0], [0.0, 0.0], [25.0, 0.0]]).double())
    late = {1: CLAIMER, 2: sees(2, NORTH, before, late=0.3), 3: sees(3, EAST, before, late=0.3)}
    assert ghost_kind(after_trust(late).step(late)) == REFUTED, "one that stood there since would have been seen"
    driving = {**late, 1: replace(CLAIMER, boxes=moving)}
    assert ghost_kind(after_trust(late).step(driving)) == UNCHECKED


def test_a_observer_on_another_level_concludes_nothing():
    above = {**WITH_TWO, 3: replace(WITH_TWO[3], height_m=2.0)}
    assert ghost_kind(after_trust(WITH_TWO).step(above)) == UNCHECKED


def test_two_observers_that_copy_each_other_or_share_a_place_are_one():
    copies = {**WITH_TWO, 3: replace(WITH_TWO[3], boxes=WITH_TWO[2].boxes)}
    # Not by an exact copy alone: the sights of both are their own.
    assert ghost_kind(after_trust(WITH_TWO).step(copies)) == UNCHECKED
    beside = (NORTH[0] + 1.0, NORTH[1])
    shared = {**WITH_TWO, 3: sees(3, beside)}
    assert ghost_kind(after_trust(shared).step(shared)) == UNCHECKED


def test_a_false_sight_refutes_neither_what_the_ego_sees_nor_what_one_other_observer_does_not_deny():
    """Agent 3 states that all is free; agent 1 claims a true car that the ego cannot see, agent 2 the one that it sees."""
    false = {1: CLAIMER, 2: sees(2, NORTH, CAR_THERE), 3: replace(sees(3, EAST, CAR_THERE), sight=ALL_FREE)}
    found = after_trust(false, has_car=True).run(20, false)
    assert kinds(found, 1) == [Evidence.SUPPORTED, Evidence.SUPPORTED, UNCHECKED]
    assert kinds(found, 2) == [Evidence.SUPPORTED] * 2
    assert all(s.status is NORMAL and s.trust > 0.8 for s in found.senders)


def false_only_there(place: tuple[float, float]) -> Sight:
    """A sight that is true but where the hidden car stands: there it is as if nothing was."""
    return sight_from(place, NOTHING_THERE)


def test_one_false_sight_beside_an_honest_one_neither_refutes_nor_accuses():
    false = {1: CLAIMER, 2: sees(2, NORTH, CAR_THERE), 3: replace(sees(3, EAST), sight=false_only_there(EAST))}
    found = after_trust(false, has_car=True).run(20, false)
    assert ghost_kind(found) == UNCHECKED and all(s.status is NORMAL and s.trust > 0.8 for s in found.senders)


def test_a_sight_over_what_the_ego_detects_is_not_used():
    false = {**WITH_TWO, 3: replace(WITH_TWO[3], sight=ALL_FREE)}
    assert ghost_kind(after_trust(WITH_TWO).step(false)) == UNCHECKED


TWO_COLLUDE = {
    1: Sender(honest(1, GHOST), CLAIMER_AT),
    2: replace(sees(2, NORTH), sight=false_only_there(NORTH)),
    3: replace(sees(3, EAST), sight=false_only_there(EAST)),
    4: Sender(honest(4), SOUTH, sight_from(SOUTH, CAR_THERE)),
    5: Sender(honest(5), (60.0, -20.0), sight_from((60.0, -20.0), CAR_THERE)),
}
"""Agents 2 and 3 collude; 1, 4 and 5 are honest, and only 1 detects the hidden car."""


def test_two_colluders_in_an_honest_majority_remove_a_hidden_car_but_accuse_no_sender():
    """The price: what one honest agent alone detects is lost. The limit: its sender keeps its trust and its place."""
    found = after_trust(TWO_COLLUDE, has_car=True).run(20, TWO_COLLUDE)
    assert ghost_kind(found) == REFUTED
    assert sender(found, 1).status is NORMAL and sender(found, 1).trust > 0.8 and sender(found, 1).weight == 1.0


def test_two_colluders_cannot_refute_what_a_trusted_third_agent_claims_too():
    seconded = {**TWO_COLLUDE, 4: replace(TWO_COLLUDE[4], boxes=honest(4, (GHOST[0] + 0.2, GHOST[1] - 0.2)))}
    found = after_trust(TWO_COLLUDE, has_car=True).run(20, seconded)
    assert ghost_kind(found) == ghost_kind(found, 4) == DISPUTED
    assert all(s.status is NORMAL and s.trust > 0.8 for s in found.senders)


def test_two_colluders_that_are_the_majority_accuse_an_honest_sender():
    """Stated, not hidden: where malicious agents are the majority and the ego sees nothing, the result is wrong."""
    few = {agent_id: TWO_COLLUDE[agent_id] for agent_id in (1, 2, 3)}
    found = after_trust(few, has_car=True).run(5, few)
    assert sender(found, 1).status is MALICIOUS


def test_a_false_claimer_is_named_by_a_majority_of_observers_within_three_frames():
    many = {**WITH_TWO, 4: sees(4, SOUTH)}
    crossing = after_trust(many)
    first = crossing.step(many)
    assert ghost_kind(first) == REFUTED and sender(first, 1).status is NORMAL
    found = crossing.run(2, many)
    assert sender(found, 1).status is MALICIOUS
    assert all(s.status is NORMAL and s.trust > 0.8 for s in found.senders if s.agent_id != 1)


def test_excluded_senders_are_not_counted_in_the_majority():
    named = {**WITH_TWO, 4: Sender(honest(4, (12.0, -5.0)), SOUTH)}
    crossing = after_trust(named)
    assert sender(crossing.run(5, {4: named[4]}), 4).status is MALICIOUS
    # Two of four are no majority, two of three are.
    assert sender(crossing.run(5, named), 1).status is MALICIOUS


def test_claims_of_low_score_accuse_no_sender():
    many = {**WITH_TWO, 4: sees(4, SOUTH)}
    low = replace(CLAIMER, boxes=Boxes.cat([honest(1), cars(GHOST, score=0.45)]))
    found = after_trust(many).run(10, {**many, 1: low})
    assert ghost_kind(found) == REFUTED and sender(found, 1).status is NORMAL


def test_evidence_of_the_ego_comes_first():
    """The ego detects the car: sights that miss it are not used, and change nothing."""
    crossing = after_trust(TWO_COLLUDE, has_car=True)
    crossing.own = cars(SEEN, SEEN_TOO, GHOST)
    found = crossing.run(5, TWO_COLLUDE)
    assert ghost_kind(found) == Evidence.SUPPORTED and all(s.status is NORMAL for s in found.senders)
