# SPDX-License-Identifier: Apache-2.0
"""What is left of an excluded sender: its claims that others confirm, on the street of ``tests.agents.trust.street``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.agents.trust.street import FREE, HEIGHT_M, HIDDEN, SEEN, SEEN_TOO, TENTH_NS, Street, cars, sender

from manyeyes.agents.trust.detectors.ray_evidence import LOW_TRUST, RayEvidenceDetector
from manyeyes.agents.trust.fusion_weights import weigh_received
from manyeyes.agents.trust.interface import Assessment, Evidence, SenderStatus
from manyeyes.agents.trust.result_evidence import find_result_evidence
from manyeyes.comms.inbox import ReceivedMessage
from manyeyes.datatypes import AgentFrame, Boxes, Message, PointCloud, Transform

DETECTOR = RayEvidenceDetector()
HONEST = cars(SEEN, SEEN_TOO)
MIXED = cars(SEEN, SEEN_TOO, HIDDEN, FREE)


@pytest.fixture
def street() -> Street:
    return Street(DETECTOR)


def fused(found: Assessment, street: Street, stated: Boxes) -> tuple[Boxes | None, list[str]]:
    """What is fused of the objects that agent 1 states, and why not all of it."""
    now_ns = TENTH_NS * street.index
    frame = AgentFrame.of(PointCloud.of(torch.zeros(0, 3)), Transform.identity(), 0, now_ns, sensor_height_m=HEIGHT_M)
    covariance = torch.zeros(3, 3).double()
    message = Message(
        1, now_ns, Transform.identity(), covariance, objects=stated, points=PointCloud.of(torch.zeros(2, 3))
    )
    kept, rejected = weigh_received(frame, [ReceivedMessage(message, 1, 1, now_ns)], found)
    assert all(one.message.points is None for one in kept)
    return kept[0].message.objects if kept else None, [one.reason for one in rejected]


def test_claims_of_a_named_sender_that_the_ego_or_a_third_agent_confirms_are_fused_and_no_others(street):
    """True claims that others confirm are no less true beside a false one, and their loss would cost more than the false one."""
    claims = {1: MIXED, 2: HONEST}
    found = street.run(5, claims)
    assert sender(found, 1).status is SenderStatus.MALICIOUS and sender(found, 1).weight == 0.0
    objects, reasons = fused(found, street, MIXED)
    assert objects is not None and reasons == ["untrusted"]
    assert objects.center[:, :2].tolist() == [list(SEEN), list(SEEN_TOO)]
    # A trusted third agent confirms what the ego does not see.
    found = street.run(2, {1: MIXED, 2: cars((15.2, 0.1), (12.1, 12.1), (30.3, 15.1))})
    objects, _ = fused(found, street, MIXED)
    assert objects is not None and objects.center[:, :2].tolist() == [list(SEEN), list(SEEN_TOO), list(HIDDEN)]


def test_a_result_at_a_confirmed_claim_of_a_named_sender_rests_on_it(street):
    """Returns alone confirm nothing of a named sender: a flood of false objects finds walls to stand at."""
    street.own = cars(SEEN_TOO)
    found = street.run(5, {1: MIXED})
    objects, _ = fused(found, street, MIXED)
    assert objects is not None and objects.center[:, :2].tolist() == [list(SEEN_TOO)]
    evidence = find_result_evidence(MIXED, street.own, found)
    assert evidence is not None
    assert evidence.kinds.tolist() == [Evidence.UNCHECKED, Evidence.OWN, Evidence.UNCHECKED, Evidence.UNCHECKED]
    assert evidence.senders == ((), (1,), (), ())


def test_nothing_is_fused_of_a_named_sender_without_confirmed_claims(street):
    found = street.run(5, {1: cars(HIDDEN, FREE)})
    assert sender(found, 1).status is SenderStatus.MALICIOUS
    assert fused(found, street, cars(HIDDEN, FREE)) == (None, ["untrusted"])


def test_nothing_is_fused_of_faulty_senders_and_of_those_excluded_for_other_reasons_than_refuted_claims(street):
    assert sender(street.run(3, {2: MIXED}), 2).keeps_confirmed
    assert not sender(street.step({2: MIXED}, faulty=[2]), 2).keeps_confirmed
    for _ in range(8):  # features made against fusion
        street.state = DETECTOR.record_orphans(street.state, [1])
    low = sender(street.step({1: HONEST}), 1)
    assert low.reason == LOW_TRUST and not low.keeps_confirmed


def test_nothing_is_fused_of_a_copier(street):
    contents = [np.random.default_rng(index).uniform(-40.0, 40.0, (5, 2)) for index in range(7)]
    found = []
    for index in range(1, 7):
        street.stated = {1: contents[index], 2: contents[index - 1]}
        found.append(sender(street.step({1: HONEST, 2: MIXED}), 2))
    assert [one.status is SenderStatus.MALICIOUS for one in found].count(True) >= 3
    assert not any(one.keeps_confirmed for one in found[1:])


def test_refuted_claims_near_confirmed_ones_are_not_fused(street):
    beside = (SEEN[0], SEEN[1] + 1.5)
    found = street.run(5, {1: MIXED})
    claims = found.claims
    assert claims is not None
    kinds = claims[0].kinds.copy()
    kinds[1] = Evidence.REFUTED
    denied = replace(found, claims=(replace(claims[0], kinds=kinds),))
    objects, _ = fused(denied, street, cars(SEEN, SEEN_TOO, beside))
    assert objects is not None and objects.center[:, :2].tolist() == [list(SEEN), list(beside)]
