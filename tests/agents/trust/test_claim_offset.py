# SPDX-License-Identifier: Apache-2.0
"""A common offset of claims, and copies of content: on hand-made places and on the street of ``tests.agents.trust.street``."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from tests.agents.trust.street import SEEN, SEEN_TOO, Street, cars, sender

from manyeyes.agents.trust._claim_offset_kernels import list_pairs, score_shift
from manyeyes.agents.trust.claim_offset import OffsetConfig, find_offset
from manyeyes.agents.trust.claims import Claims
from manyeyes.agents.trust.copies import CopyConfig, StatedContent, add_contents, find_copies
from manyeyes.agents.trust.detectors.ray_evidence import RayEvidenceDetector
from manyeyes.agents.trust.interface import SenderStatus

CONFIG, HERE = OffsetConfig(), (20.0, 5.0)
PLACES = ((15.0, 0.0), (12.0, 12.0), (28.0, -9.0), (8.0, -14.0), (-17.0, 6.0), (-9.0, -11.0))


def scattered(seed: int, num: int = 12) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-40.0, 40.0, (num, 2))


def turned(xy: np.ndarray, degrees: float) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return (xy - HERE) @ np.array([[c, s], [-s, c]]) + HERE


@pytest.mark.parametrize("seed", range(20))
def test_a_shift_of_two_metres_is_found_and_one_of_the_prior_noise_is_not(seed):
    rng, seen = np.random.default_rng(seed), scattered(seed)
    claims = seen[:9] + rng.normal(0.0, 0.15, (9, 2))
    angle = rng.uniform(0.0, 2 * math.pi)
    direction = np.array([math.cos(angle), math.sin(angle)])
    assert find_offset(claims, seen, HERE, CONFIG).contradicts(CONFIG) is False
    assert find_offset(claims + 0.8 * direction, seen, HERE, CONFIG).contradicts(CONFIG) is not True
    found = find_offset(claims + 2.2 * direction, seen, HERE, CONFIG)
    assert found.contradicts(CONFIG) is True
    assert found.metres == pytest.approx(2.2, abs=0.35) and found.num_pairs >= 8


@pytest.mark.parametrize("degrees", [-5.0, 5.0])
def test_a_turned_pose_is_found(degrees):
    # 5 degrees displace what is 15 to 60 m from the sender by 1.3 to 5.2 m.
    seen = scattered(3)
    assert find_offset(turned(seen, degrees), seen, HERE, CONFIG).contradicts(CONFIG) is True
    assert find_offset(turned(seen, 0.4), seen, HERE, CONFIG).contradicts(CONFIG) is False


def test_claims_that_the_ego_does_not_detect_show_nothing():
    seen = scattered(5, 8)
    elsewhere = seen[:6] + 100.0
    assert find_offset(elsewhere, seen, HERE, CONFIG).contradicts(CONFIG) is None
    assert find_offset(seen[:3] + 2.2, seen, HERE, CONFIG).contradicts(CONFIG) is None


def test_new_objects_beside_consistent_ones_are_no_offset():
    """A row of parked cars that the ego detects in part fits after a shift by one place, but better without."""
    row = np.stack((np.arange(8) * 2.6, np.full(8, 10.0)), 1)
    assert find_offset(row, row[1:7], HERE, CONFIG).contradicts(CONFIG) is False


def test_a_displaced_pose_is_a_fault_without_weight_and_no_accusation():
    street = Street(RayEvidenceDetector(), own=cars(*PLACES))
    honest = {1: cars(*PLACES)}
    assert sender(street.run(3, honest), 1).weight == 1.0
    trust = sender(street.run(1, honest), 1).trust
    moved = cars(*((x + 1.3, y + 1.7) for x, y in PLACES))
    found = sender(street.run(8, {1: moved}), 1)
    assert (found.status, found.weight) == (SenderStatus.FAULTY, 0.0)
    assert found.trust <= trust  # displaced claims near detections are no support
    back = sender(street.step(honest), 1)
    assert (back.status, back.weight) == (SenderStatus.NORMAL, 1.0)


def test_the_agreement_is_that_of_all_pairs():
    """The compiled loop with lists of pairs, against all pairs of claims and detections."""
    claims, seen = scattered(7, 15), scattered(8, 15)
    for shift in scattered(9, 20) / 10.0:
        distance = np.linalg.norm(seen[None] - claims[:, None] - shift, axis=2)
        expected = (1 - (distance.min(1).clip(max=12.0) / 12.0) ** 2).sum()
        first, offsets = list_pairs(claims, seen, 100.0)
        score, number, _ = score_shift(first, offsets, np.zeros((15, 2)), shift[0], shift[1], 12.0)
        assert score == pytest.approx(expected) and number == (distance.min(1) < 12.0).sum() > 0


def stated(agent_id: int, xy: np.ndarray) -> Claims:
    one = Claims.of(agent_id, cars(*map(tuple, xy)), np.full(len(xy), 0.1))
    return replace(one, stated_xy=xy)


def test_content_that_another_agent_sent_before_is_a_copy():
    config, first, second = CopyConfig(), scattered(1, 6), scattered(2, 6)
    earlier = {1: (StatedContent(100, first),), 2: (StatedContent(100, second),)}
    now = (stated(1, second), stated(2, second + 0.05), stated(3, first[:4]))
    assert find_copies(now, (200, 200, 200), earlier, config) == {1: 2, 3: 1}


def test_a_message_that_was_compared_before_and_own_content_are_no_copies():
    config, xy = CopyConfig(), scattered(1, 6)
    earlier = {1: (StatedContent(100, xy),), 2: (StatedContent(100, xy),)}
    assert find_copies((stated(1, xy), stated(2, xy)), (100, 100), earlier, config) == {}
    assert find_copies((stated(1, xy),), (200,), {1: earlier[1]}, config) == {}


def test_few_equal_positions_are_chance():
    config, xy = CopyConfig(), scattered(1, 6)
    half = np.concatenate((xy[:3], xy[3:] + 1.0))
    most = np.concatenate((xy[:4], xy[4:] + 1.0))
    for other, num_known, expected in ((xy, 2, {}), (half, 6, {}), (most, 6, {1: 2}), (xy, 6, {1: 2})):
        earlier = {2: (StatedContent(100, other[:num_known]),)}
        assert find_copies((stated(1, xy[:num_known]),), (200,), earlier, config) == expected


def test_the_contents_of_the_last_messages_are_kept_once():
    contents: tuple[StatedContent, ...] = ()
    for time_ns in (1, 2, 2, 3, 4, 5):
        contents = add_contents(contents, stated(1, scattered(time_ns, 3)), time_ns)
    assert [content.timestamp_ns for content in contents] == [5, 4, 3, 2]


def test_a_sender_that_copies_again_and_again_is_named_and_its_source_is_not():
    """The copy comes a frame later; from its first frame on it has no weight."""
    street = Street(RayEvidenceDetector())
    contents = [scattered(index, 5) for index in range(8)]
    claims = {1: cars(SEEN, SEEN_TOO), 2: cars(SEEN, SEEN_TOO)}
    found = []
    for index in range(1, 6):
        street.stated = {1: contents[index], 2: contents[index - 1]}
        found.append(street.step(claims))
    weights = [sender(one, 2).weight for one in found]
    assert weights[0] == 1.0 and weights[1:] == [0.0] * 4
    assert [sender(one, 2).status is SenderStatus.MALICIOUS for one in found] == [False, False, False, True, True]
    assert all(sender(one, 1).weight == 1.0 and sender(one, 1).status is SenderStatus.NORMAL for one in found)


@pytest.mark.parametrize("seed", range(12))
def test_the_search_that_skips_shifts_with_few_pairs_finds_what_trying_all_of_them_finds(seed):
    rng, seen = np.random.default_rng(seed), scattered(seed, 25)
    size = rng.integers(6, 16)
    claims = np.concatenate(
        (seen[:size] + rng.normal(0.0, 0.3, (size, 2)) + rng.uniform(-3.0, 3.0, 2), scattered(99, 6))
    )
    found = find_offset(claims, seen, HERE, CONFIG)
    first, offsets = list_pairs(claims, seen, CONFIG.search_m)
    near, far = score_shift(first, offsets, np.zeros_like(claims), 0.0, 0.0, CONFIG.tolerance_m)[0], 0.0
    for degrees in np.arange(-4, 5) * CONFIG.turn_step_deg:
        moved = turned(claims, degrees) - claims
        for row, (begin, end) in enumerate(pairwise(first)):
            for shift in offsets[begin:end] - moved[row]:
                score, _, metres = score_shift(first, offsets, moved, shift[0], shift[1], CONFIG.tolerance_m)
                near, far = (max(near, score), far) if metres <= CONFIG.max_offset_m else (near, max(far, score))
    # The search ends early where no offset is possible; elsewhere both agreements are those of all shifts.
    is_early = found.displaced == 0.0
    assert is_early or (found.consistent, found.displaced) == (pytest.approx(near), pytest.approx(far))
    is_wrong = far > CONFIG.ratio * near + CONFIG.margin
    assert found.contradicts(CONFIG) is True if is_wrong else found.contradicts(CONFIG) is not True
