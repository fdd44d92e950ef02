# SPDX-License-Identifier: Apache-2.0
"""Hand-made cases of evidence and trust, on the street of ``tests.agents.trust.street``."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tests.agents.trust.street import (
    CAR,
    FREE,
    FREE_TOO,
    HIDDEN,
    OTHER_AGENT,
    SEEN,
    SEEN_TOO,
    Street,
    cars,
    kinds,
    scan,
    sender,
    wall,
)

from manyeyes.agents.isolation import FIRST_QUARANTINE_NS
from manyeyes.agents.trust.detectors.ray_evidence import RayEvidenceDetector
from manyeyes.agents.trust.interface import Evidence, SenderStatus
from manyeyes.datatypes import Boxes

DETECTOR = RayEvidenceDetector()
HONEST, MALICIOUS, NORMAL = cars(SEEN, SEEN_TOO), SenderStatus.MALICIOUS, SenderStatus.NORMAL
PRIOR = 2 / 3


def raised(boxes: Boxes, height_m: float) -> Boxes:
    return replace(boxes, center=boxes.center + torch.tensor([0.0, 0.0, height_m], dtype=torch.float64))


def drop_around(points: torch.Tensor, place: tuple[float, float], radius_m: float) -> torch.Tensor:
    """Returns (N, 3) without those of the ground around a place."""
    near = (points[:, :2] - torch.tensor(place).double()).norm(dim=1) <= radius_m
    return points[~near | (points[:, 2] > 0.1)]


@pytest.fixture
def street() -> Street:
    return Street(DETECTOR)


def test_a_car_on_ground_that_the_ego_sees_through_is_refuted_and_its_sender_named_within_three_frames(street):
    claims = {1: cars(SEEN, SEEN_TOO, FREE)}
    first = street.step(claims)
    assert kinds(first, 1) == [Evidence.SUPPORTED, Evidence.SUPPORTED, Evidence.REFUTED]
    assert sender(first, 1).status is NORMAL and sender(first, 1).trust < PRIOR
    third = street.run(2, claims)
    assert sender(third, 1).status is MALICIOUS and sender(third, 1).weight == 0.0
    assert DETECTOR.excluded(street.state, [1, 2], 300_000_000) == {1}


@pytest.mark.parametrize("height_m", [-2.6, -0.7, 0.7, 2.0])
def test_a_false_car_stated_below_or_above_the_road_is_refuted_all_the_same(street, height_m):
    claims = {1: Boxes.cat([HONEST, raised(cars(FREE), height_m)])}
    assert kinds(street.step(claims), 1)[2] == Evidence.REFUTED
    assert sender(street.run(2, claims), 1).status is MALICIOUS


def test_a_claim_as_high_as_a_bridge_or_without_flat_ground_around_it_is_not_checked(street):
    assert kinds(street.step({1: raised(cars(FREE), 6.0)}), 1) == [Evidence.UNCHECKED]
    # A car in a hollow, 2 m lower, beyond the edge of which the ego sees no ground.
    hollow = Street(DETECTOR, spoil=lambda points, _: drop_around(points, FREE, 3.0))
    assert kinds(Street(DETECTOR).step({1: raised(cars(FREE), -2.0)}), 1) == [Evidence.REFUTED]
    assert kinds(hollow.step({1: raised(cars(FREE), -2.0)}), 1) == [Evidence.UNCHECKED]


def test_an_occluded_honest_claim_costs_nothing(street):
    assert kinds(street.step({1: cars(HIDDEN)}), 1) == [Evidence.UNCHECKED]
    found = street.run(20, {1: cars(HIDDEN)})
    assert sender(found, 1).trust == pytest.approx(PRIOR) and sender(found, 1).weight == pytest.approx(0.99, abs=0.01)
    supported = street.run(5, {1: cars(SEEN, HIDDEN)})
    assert sender(supported, 1).trust > 0.8


def test_returns_of_an_undetected_car_support_a_claim(street):
    street.own = cars(SEEN_TOO)
    assert kinds(street.step({1: cars(SEEN)}), 1) == [Evidence.SUPPORTED]


def test_returns_of_a_wall_beside_a_false_car_do_not_support_it(street):
    fence = replace(cars((12.0, -7.45)), size=torch.tensor([[9.0, 0.2, CAR[2]]]).double())
    street.solid = Boxes.cat([street.solid, fence])
    claims = {1: cars(SEEN, SEEN_TOO, FREE)}
    assert kinds(street.step(claims), 1)[2] == Evidence.REFUTED
    assert sender(street.run(2, claims), 1).status is MALICIOUS


@pytest.mark.parametrize("offset", [(0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5), (0.3, 0.4)])
def test_a_true_car_that_is_stated_half_a_metre_off_is_supported(street, offset):
    street.own = cars(SEEN_TOO)
    assert kinds(street.step({1: cars((SEEN[0] + offset[0], SEEN[1] + offset[1]))}), 1) == [Evidence.SUPPORTED]


@pytest.mark.parametrize("score", [0.45, 0.75])
def test_low_scores_are_refuted_but_accuse_no_sender(street, score):
    found = street.run(10, {1: cars(FREE, score=score)})
    assert kinds(found, 1) == [Evidence.REFUTED]
    assert sender(found, 1).status is NORMAL and sender(found, 1).trust == pytest.approx(PRIOR)


@pytest.mark.parametrize("offset", [(0.3, 0.2), (0.2, -2.2), (-1.7, 2.3), (2.3, -2.1)])
def test_the_ego_itself_as_others_see_it_at_a_wrong_pose_accuses_no_sender(street, offset):
    """Its own vehicle is among what others report; displaced, it lies where the rays of the ego pass."""
    found = street.run(20, {1: cars(SEEN, SEEN_TOO, offset)}, sigma_m=0.6)
    assert kinds(found, 1)[2] in (Evidence.REFUTED, Evidence.UNCHECKED)
    assert sender(found, 1).status is NORMAL and sender(found, 1).trust > 0.8


def test_a_false_car_beside_a_roadside_unit_is_not_the_ego(street):
    street.is_infrastructure = True
    assert sender(street.run(5, {1: cars(SEEN, SEEN_TOO, (0.2, -2.2))}, sigma_m=0.6), 1).status is MALICIOUS


def test_one_attacker_among_three_is_named_and_the_others_are_not(street):
    claims = {1: cars(SEEN, SEEN_TOO, HIDDEN), 2: cars(SEEN, SEEN_TOO, FREE), 3: HONEST}
    found = street.run(5, claims)
    assert [s.agent_id for s in found.senders if s.status is MALICIOUS] == [2]
    assert all(s.weight == 1.0 and s.trust > 0.8 for s in found.senders if s.agent_id != 2)


def test_two_refuted_claims_name_a_trusted_sender_after_two_frames(street):
    street.run(10, {1: HONEST})
    claims = {1: cars(SEEN, SEEN_TOO, FREE, FREE_TOO)}
    assert sender(street.step(claims), 1).status is NORMAL
    assert sender(street.step(claims), 1).reason == "2 claims were refuted repeatedly"


def test_a_claim_that_flickers_is_one_claim(street):
    found = [street.step({1: cars(SEEN, SEEN_TOO, FREE) if index % 2 == 0 else HONEST}) for index in range(5)]
    assert sender(found[-1], 1).status is MALICIOUS


def test_claims_at_ever_new_places_end_in_low_trust(street):
    places = [(10.0 + 4 * (index % 6), -6.0 - 3 * (index // 6)) for index in range(12)]
    found = [street.step({1: cars(place)}) for place in places]
    assert sender(found[-1], 1).weight == 0.0


def test_where_two_trusted_views_contradict_each_other_no_trust_changes(street):
    """Agents 1 and 2 detect a car that the rays of the ego pass through, as an attacker can arrange (TrustFlip)."""
    street.run(5, {1: HONEST, 2: HONEST})
    before = street.step({1: HONEST, 2: HONEST})
    claims = {1: cars(SEEN, SEEN_TOO, FREE), 2: cars(SEEN, (12.1, 12.1), (12.2, -6.1))}
    found = street.run(20, claims)
    assert kinds(found, 1)[2] == kinds(found, 2)[2] == Evidence.DISPUTED
    for agent_id in (1, 2):
        assert sender(found, agent_id).status is NORMAL
        assert sender(found, agent_id).trust >= sender(before, agent_id).trust - 1e-9


def test_a_copy_of_a_claim_does_not_dispute_it(street):
    """The second sender repeats the first: one source, not two."""
    street.run(5, {1: HONEST, 2: HONEST})
    claims = cars(SEEN, SEEN_TOO, FREE)
    found = street.run(5, {1: claims, 2: claims})
    assert [s.status for s in found.senders] == [MALICIOUS, MALICIOUS]


def test_evidence_that_turns_within_a_second_is_disputed(street):
    street.run(3, {1: cars(SEEN)})
    street.solid, street.own = Boxes.cat([cars(SEEN_TOO, HIDDEN), wall()]), cars(SEEN_TOO)
    found = street.run(4, {1: cars(SEEN)})
    assert kinds(found, 1) == [Evidence.DISPUTED] and sender(found, 1).status is NORMAL
    found = street.run(30, {1: cars(SEEN)})
    assert sender(found, 1).status is MALICIOUS


def test_a_colluding_pair_of_unknown_senders_cannot_corroborate_each_other(street):
    claims = {1: cars(FREE), 2: cars((12.3, -6.2))}
    found = street.run(3, claims)
    assert [s.status for s in found.senders] == [MALICIOUS, MALICIOUS]


def test_a_colluding_pair_with_trust_disputes_a_place_and_its_claim_is_marked(street):
    """The price of fairness in disputes: the pair is not named, but its claim is never given as checked."""
    street.run(5, {1: HONEST, 2: HONEST, 3: HONEST})
    claims = {1: cars(SEEN, SEEN_TOO, FREE), 2: cars(SEEN, (12.1, 12.1), (12.3, -6.2)), 3: HONEST}
    found = street.run(10, claims)
    assert kinds(found, 1)[2] == Evidence.DISPUTED
    assert all(s.status is NORMAL for s in found.senders)


ONE_OF_A_PAIR = cars(SEEN, SEEN_TOO, FREE, FREE_TOO)
OTHER_OF_A_PAIR = cars(SEEN, (12.1, 12.1), (12.3, -6.2), (18.2, -8.1))


@pytest.mark.parametrize("num_others", [0, 1, 2])
def test_a_pair_that_supports_each_other_at_two_places_is_named_where_it_is_a_minority(street, num_others):
    others = {agent_id: cars((15.2, 0.1), (12.2, 12.2 + agent_id / 30)) for agent_id in range(3, 3 + num_others)}
    honest = {1: HONEST, 2: cars((15.1, 0.0), (12.0, 12.1)), **others}
    street.run(5, honest)
    found = street.run(10, {**honest, 1: ONE_OF_A_PAIR, 2: OTHER_OF_A_PAIR})
    named = [one.agent_id for one in found.senders if one.status is MALICIOUS]
    assert named == ([1, 2] if num_others == 2 else [])
    if named:
        assert "few other senders claim them" in sender(found, 1).reason and sender(found, 1).keeps_confirmed


def test_a_pair_is_named_after_three_messages_and_only_for_confident_claims(street):
    honest = {agent_id: cars((15.0 + agent_id / 20, 0.0), (12.0, 12.0 + agent_id / 30)) for agent_id in range(1, 5)}
    weak = Street(DETECTOR)
    for one in (street, weak):
        one.run(5, honest)
    pair = {**honest, 1: ONE_OF_A_PAIR, 2: OTHER_OF_A_PAIR}
    assert sender(street.run(2, pair), 1).status is NORMAL and sender(street.step(pair), 1).status is MALICIOUS
    low = {a: replace(pair[a], score=torch.full((4,), 0.75).double()) for a in (1, 2)}
    assert sender(weak.run(10, {**honest, **low}), 1).status is NORMAL


def test_identities_at_one_place_or_in_a_chain_do_not_corroborate_each_other(street):
    """One attacker under several identities, whose boxes differ by centimetres, after honest messages of all of them."""
    places = {agent_id: (OTHER_AGENT[0], OTHER_AGENT[1] + 1.5 * agent_id) for agent_id in (1, 2, 3)}
    street.sender_places = places
    honest = {agent_id: cars((15.0 + agent_id / 20, 0.0), (12.0, 12.0 + agent_id / 20)) for agent_id in places}
    street.run(5, honest)
    lies = {a: Boxes.cat([honest[a], cars((12.0, -6.0 - a / 20))]) for a in places}
    assert all(one.status is MALICIOUS for one in street.run(5, lies).senders)
    assert kinds(street.step({**lies, 1: Boxes.cat([honest[1], cars(HIDDEN)])}), 1)[2] == Evidence.UNCHECKED


def test_a_third_agent_of_high_trust_corroborates_what_the_ego_cannot_see(street):
    street.run(5, {1: HONEST, 2: HONEST})
    claims = {1: cars(SEEN, SEEN_TOO, HIDDEN), 2: cars((15.1, 0.1), (12.1, 12.1), (30.4, 15.2))}
    assert kinds(street.step(claims), 1)[2] == Evidence.CORROBORATED
    assert kinds(Street(DETECTOR).step(claims), 1)[2] == Evidence.UNCHECKED


def test_a_weak_claim_of_a_third_agent_neither_corroborates_nor_disputes(street):
    street.run(5, {1: HONEST, 2: HONEST})
    weak = Boxes.cat([cars((15.1, 0.1), (12.1, 12.1)), cars((30.4, 15.2), (12.3, -6.2), score=0.45)])
    claims = {1: cars(SEEN, SEEN_TOO, HIDDEN, FREE), 2: weak}
    assert kinds(street.step(claims), 1)[2:] == [Evidence.UNCHECKED, Evidence.REFUTED]
    found = street.run(2, claims)
    assert sender(found, 1).status is MALICIOUS and sender(found, 2).status is NORMAL


def test_trust_decays_to_the_prior(street):
    high = sender(street.run(10, {1: HONEST}), 1).trust
    later = sender(street.run(50, {1: cars(HIDDEN)}), 1).trust
    last = sender(street.run(450, {1: Boxes.empty(torch.float64)}), 1).trust
    assert high > later > PRIOR + 0.05 and last == pytest.approx(PRIOR, abs=0.01)


def test_a_new_pseudonym_starts_from_the_prior(street):
    street.run(5, {1: HONEST, 2: cars(FREE)})
    found = street.step({7: cars(HIDDEN), 8: cars(HIDDEN)})
    assert [(s.trust, s.status) for s in found.senders] == [(pytest.approx(PRIOR), NORMAL)] * 2


def test_an_excluded_sender_returns_with_half_trust_and_is_excluded_twice_as_long_if_it_goes_on(street):
    term = FIRST_QUARANTINE_NS // 100_000_000
    assert sender(street.step({1: cars(FREE)}), 1).reason == "low trust"
    assert sender(street.run(term, {1: HONEST}), 1).weight == 0.0
    back = sender(street.step({1: HONEST}), 1)
    assert back.status is NORMAL and back.trust == 0.5 and 0 < back.weight < 1
    assert sender(street.step({1: cars(FREE)}), 1).status is MALICIOUS
    assert sender(street.run(2 * term, {1: HONEST}), 1).status is MALICIOUS
    assert sender(street.step({1: HONEST}), 1).status is NORMAL


def test_an_object_that_a_complete_list_omits_in_free_sight_lowers_trust(street):
    seen_only = {1: cars(SEEN_TOO)}
    honest = Street(DETECTOR, street.solid, street.own)
    free = honest.run(12, {1: HONEST}, is_complete=True)
    silent = street.run(12, seen_only, is_complete=True)
    budget = Street(DETECTOR, street.solid, street.own).run(12, seen_only)
    assert sender(silent, 1).trust < 0.75 < sender(budget, 1).trust < sender(free, 1).trust


def test_an_object_hidden_from_the_sender_is_not_omitted(street):
    """The sender stands behind the wall."""
    behind = street.run(12, {1: cars(HIDDEN)}, is_complete=True, sender_xy=(30.0, 12.0))
    assert sender(behind, 1).trust == pytest.approx(PRIOR)


def test_senders_with_faulty_poses_are_not_malicious(street):
    found = street.run(10, {1: cars(FREE)}, faulty=[1])
    assert sender(found, 1).status is SenderStatus.FAULTY and sender(found, 1).trust == pytest.approx(PRIOR)


def pass_windows(points: torch.Tensor, index: int) -> torch.Tensor:
    """Rays to the upper 45 % of the cars return from behind them, as through glass."""
    behind = scan(wall())
    is_window = torch.zeros(len(points), dtype=torch.bool)
    for x, y in (SEEN, SEEN_TOO):
        near = (points[:, 0] - x).abs() < CAR[0] / 2 + 0.05
        near &= (points[:, 1] - y).abs() < CAR[1] / 2 + 0.05
        is_window |= near & (points[:, 2] > 0.55 * CAR[2])
    return torch.where(is_window[:, None], behind, points)


def rain(points: torch.Tensor, index: int) -> torch.Tensor:
    """A quarter of the rays return from drops within 20 m instead."""
    rng = torch.Generator().manual_seed(index)
    part = torch.rand(len(points), 1, generator=rng, dtype=torch.float64)
    origin = torch.tensor([0.0, 0.0, 1.9]).double()
    length = (points - origin).norm(dim=1, keepdim=True)
    drop = origin + (points - origin) * (20.0 * part / length).clamp_max(1.0)
    is_drop = torch.rand(len(points), 1, generator=rng, dtype=torch.float64) < 0.25
    return torch.where(is_drop, drop, points)


def dark(points: torch.Tensor, index: int) -> torch.Tensor:
    """The cars return nothing: those rays are lost."""
    is_lost = torch.zeros(len(points), dtype=torch.bool)
    for x, y in (SEEN, SEEN_TOO):
        is_lost |= (points[:, :2] - torch.tensor([x, y]).double()).abs().amax(1) < 2.4
    return points[~is_lost | (points[:, 2] < 0.05)]


@pytest.mark.parametrize("spoil", [pass_windows, rain, dark])
def test_glass_rain_and_dark_cars_do_not_accuse_honest_senders(spoil):
    """The ego does not detect the cars, so that rays alone decide."""
    street = Street(DETECTOR, own=Boxes.empty(torch.float64), spoil=spoil)
    found = street.run(30, {1: HONEST, 2: cars((15.3, 0.2), (12.2, 11.8), HIDDEN)}, sigma_m=0.4)
    assert all(s.status is NORMAL and s.weight > 0.98 for s in found.senders)


@pytest.mark.parametrize("spoil", [pass_windows, rain])
def test_a_false_car_is_named_in_glass_and_rain_too(spoil):
    street = Street(DETECTOR, spoil=spoil)
    assert sender(street.run(5, {1: cars(FREE)}), 1).status is MALICIOUS


def test_a_message_that_is_assessed_again_adds_no_evidence(street, monkeypatch):
    first = street.step({1: cars(FREE)})
    street.index -= 1
    again = street.step({1: cars(FREE)})
    assert sender(again, 1).trust == pytest.approx(sender(first, 1).trust)


def hidden_cars(num_cars: int, score: float) -> Boxes:
    """Cars behind the wall, 0.3 m apart: the ego sees none of their places."""
    return cars(*((30.0 + 0.3 * k, 15.0) for k in range(num_cars)), score=score)


@pytest.mark.parametrize(("score", "limit"), [(0.9, 6), (0.6, 20)])
def test_a_message_of_many_more_unconfirmed_than_confirmed_objects_is_not_fused(street, score, limit):
    """Two confirmed ones allow one more."""
    claims = {1: Boxes.cat([cars(SEEN, SEEN_TOO, score=score), hidden_cars(limit + 1, score)])}
    assert sender(street.run(5, claims), 1).weight > 0.9
    claims = {1: Boxes.cat([cars(SEEN, SEEN_TOO, score=score), hidden_cars(limit + 2, score)])}
    found = street.step(claims)
    assert sender(found, 1).weight == 0.0 and sender(found, 1).reason == "too many of its claims are unconfirmed"


def test_unconfirmed_objects_change_no_trust_and_name_no_sender_and_its_content_returns(street):
    trust = sender(street.run(10, {1: HONEST, 2: HONEST}), 1).trust
    excess = {1: Boxes.cat([HONEST, hidden_cars(40, 0.9)]), 2: HONEST}
    found = street.step(excess)
    assert sender(found, 1).status is NORMAL and sender(found, 1).trust == pytest.approx(trust, abs=0.01)
    assert sender(found, 2).weight == 1.0
    weights = [sender(street.step({1: HONEST, 2: HONEST}), 1).weight for _ in range(5)]
    assert weights == [0.0, 0.0, 0.0, 0.0, 1.0]


def test_of_a_named_sender_with_an_excess_nothing_is_kept(street):
    claims = {1: Boxes.cat([cars(SEEN, SEEN_TOO, FREE), hidden_cars(3, 0.9)])}
    found = sender(street.run(3, claims), 1)
    assert found.status is MALICIOUS and found.keeps_confirmed
    found = sender(street.step({1: Boxes.cat([claims[1], hidden_cars(20, 0.9)])}), 1)
    assert found.status is MALICIOUS and not found.keeps_confirmed


def test_a_message_that_is_assessed_again_counts_once_among_the_last_five(street):
    street.step({1: Boxes.cat([HONEST, hidden_cars(40, 0.9)])})
    street.run(4, {1: HONEST})
    street.index -= 1
    assert sender(street.step({1: HONEST}), 1).weight == 0.0
    assert sender(street.step({1: HONEST}), 1).weight > 0.9


def test_a_sender_with_wrong_poses_and_an_excess_stays_faulty(street):
    found = sender(street.step({1: Boxes.cat([HONEST, hidden_cars(40, 0.9)])}, faulty=[1]), 1)
    assert found.weight == 0.0 and found.status is SenderStatus.FAULTY
