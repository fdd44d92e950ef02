# SPDX-License-Identifier: Apache-2.0
"""Baselines that compare whole results: ROBOSAC-like consensus and a CP-Guard-like consistency test, on hand-made boxes."""

from __future__ import annotations

import math

import pytest
import torch
from tests.agents.trust.street import FREE, FREE_TOO, HIDDEN, SEEN, SEEN_TOO, Street, cars, sender

from manyeyes.agents.trust.agreement import consistency_loss, jaccard
from manyeyes.agents.trust.detectors.cp_guard import CpGuardDetector
from manyeyes.agents.trust.detectors.robosac import RobosacDetector
from manyeyes.agents.trust.interface import SenderStatus
from manyeyes.datatypes import Boxes

HONEST = cars(SEEN, SEEN_TOO)
FALSE = cars(*((10.0 + 5 * n, -10.0) for n in range(6)))


def test_the_subset_size_is_that_of_the_papers_formula():
    assert RobosacDetector().subset_size == 1
    detector = RobosacDetector(num_trials=20, malicious_fraction=0.2)
    honest_prob = (1 - 0.2) ** detector.subset_size
    assert detector.subset_size == math.floor(math.log(1 - 0.01 ** (1 / 20)) / math.log(0.8)) == 7
    assert 1 - (1 - honest_prob) ** 20 >= 0.99


def test_robosac_uses_a_subset_that_agrees_and_no_other():
    street = Street(RobosacDetector(min_agreement=0.5))
    for _ in range(10):
        found = street.step({1: FALSE, 2: FALSE, 3: HONEST})
        assert found.weights[1] == found.weights[2] == 0.0
    assert Street(RobosacDetector(min_agreement=0.5)).step({1: FALSE}).weights == {1: 0.0}
    assert Street(RobosacDetector()).step({3: HONEST}).weights == {3: 1.0}
    assert Street(RobosacDetector()).step({}).senders == ()


def test_robosac_is_a_function_of_frame_and_seed():
    claims = dict.fromkeys(range(6), HONEST)
    one, same, other = (
        [s.weight for _ in range(5) for s in street.step(claims).senders]
        for street in (Street(RobosacDetector()), Street(RobosacDetector()), Street(RobosacDetector(seed=1)))
    )
    assert one == same != other and sum(one) == 5


def test_cp_guard_finds_the_inconsistent_senders_of_a_group():
    street = Street(CpGuardDetector())
    found = street.run(5, {1: HONEST, 2: FALSE, 3: cars(SEEN, SEEN_TOO, HIDDEN), 4: HONEST})
    assert [s.agent_id for s in found.senders if s.status is SenderStatus.MALICIOUS] == [2]
    assert sender(found, 2).trust < sender(found, 3).trust < sender(found, 1).trust == 1.0
    assert street.step({}).senders == ()


def test_cp_guard_raises_its_threshold_where_honest_senders_add_much():
    detector, street = CpGuardDetector(start_threshold=0.7), Street(CpGuardDetector(start_threshold=0.7))
    claims = {1: cars(SEEN, SEEN_TOO, HIDDEN, FREE, FREE_TOO)}
    found = street.run(3, claims)
    assert sender(found, 1).weight == 1.0
    assert Street(CpGuardDetector(start_threshold=0.4)).step(claims).weights == {1: 0.0}
    assert detector._threshold(street.state) == pytest.approx(0.6)  # type: ignore[arg-type]


def test_agreement_of_equal_disjoint_and_empty_sets():
    none = Boxes.empty(torch.float64)
    assert jaccard(HONEST, HONEST) == jaccard(none, none) == 1.0 and jaccard(HONEST, FALSE) == 0.0
    assert jaccard(HONEST, cars(SEEN, FREE)) == pytest.approx(1 / 3)
    assert consistency_loss(HONEST, HONEST, 0.3) == consistency_loss(none, none, 0.3) == 0.0
    assert consistency_loss(HONEST, none, 0.3) == 1.0
    assert consistency_loss(HONEST, cars(SEEN, SEEN_TOO, score=0.45), 0.3) == pytest.approx(0.5)
    assert consistency_loss(none, cars(FREE, score=0.2), 0.3) == 0.0
