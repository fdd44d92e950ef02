# SPDX-License-Identifier: Apache-2.0
"""Orphans, and trust in the selection of what is fused, on hand-made tokens and objects."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch

from manyeyes.agents.fusion_selection import MIN_SHARE, select_for_fusion
from manyeyes.agents.perception_cache import BoxOutput, PerceptionCache
from manyeyes.agents.trust.claims import Claims
from manyeyes.agents.trust.detectors.ray_evidence import RayEvidenceDetector
from manyeyes.agents.trust.interface import AssessedClaims, Assessment, Evidence, SenderAssessment
from manyeyes.agents.trust.orphans import MAX_SCORE, Orphans, bound_orphans, find_orphans
from manyeyes.agents.trust.sender_state import TrustState
from manyeyes.comms.inbox import ReceivedMessage
from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, Message, PointCloud, Sites, SparseBev, Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import PROPOSAL_DIM

GRID = BevGrid(-51.2, -51.2, -3.0, 51.2, 51.2, 1.0, 0.4, 4)
NOW_NS = 10**9
FRAME = AgentFrame.of(PointCloud.of(torch.zeros(0, 3)), Transform.identity(), 0, NOW_NS)
OWN, PROPOSED, ORPHANS = (10.0, 0.0), (20.0, 5.0), ((-20.0, 5.0), (-25.0, -9.0), (5.0, -30.0))


def cars(*places: tuple[float, float], score: float = 0.9) -> Boxes:
    center = torch.tensor([[x, y, 0.8] for x, y in places]).reshape(-1, 3)
    size = torch.tensor([4.5, 1.9, 1.6]).repeat(len(places), 1)
    return Boxes.of(center, size, torch.zeros(len(places)), torch.full((len(places),), score))


def message(agent_id: int, heat_at: dict[tuple[float, float], float]) -> Message:
    """A message with one token at each place, which proposes an object there with a heat logit."""
    places = torch.tensor(list(heat_at))
    column, row = (((places[:, k] + 51.2 - 0.2) / GRID.cell_size_m).round().long() for k in range(2))
    key = row * GRID.shape[1] + column
    features = torch.zeros(len(places), 4 + PROPOSAL_DIM)
    features[:, -PROPOSAL_DIM:][:, BOX_LAYOUT.heatmap_logit] = torch.tensor(list(heat_at.values()))[:, None]
    order = key.argsort()
    tokens = SparseBev(features[order], Sites(key[order], GRID))
    pose = Transform.identity()
    return Message(agent_id, NOW_NS, pose, torch.zeros(3, 3).double(), tokens=tokens)


def cache(*own: tuple[float, float]) -> PerceptionCache:
    """A cache that detects cars at places in every frame."""
    stand_in = SimpleNamespace(process=lambda frame: BoxOutput(cars(*own)), previous_outputs=lambda frame: [])
    return cast(PerceptionCache, stand_in)


def find(fused: Boxes, sent: list[Message]) -> Orphans:
    """The orphans, which there are, of an ego that detects nothing."""
    found = find_orphans(FRAME, fused, cache(), sent)
    assert found is not None
    return found


def test_a_box_that_no_agent_proposes_is_an_orphan_and_its_score_is_bounded():
    fused = cars(OWN, PROPOSED, *ORPHANS)
    sent = message(1, {PROPOSED: 2.0, ORPHANS[0]: -6.0, ORPHANS[1]: -6.0, ORPHANS[2]: -6.0})
    found = find_orphans(FRAME, fused, cache(OWN), [sent])
    assert found is not None and found.rows.tolist() == [False, False, True, True, True]
    bounded = bound_orphans(fused, found)
    assert bounded.score.tolist() == pytest.approx([0.9, 0.9, MAX_SCORE, MAX_SCORE, MAX_SCORE])
    assert bounded.center[:2, 0].tolist() == [OWN[0], PROPOSED[0]]


def test_three_orphans_among_the_tokens_of_one_sender_alone_are_its_fault():
    fused, heats = cars(*ORPHANS), dict.fromkeys(ORPHANS, -6.0)
    one, other = message(1, heats), message(2, {ORPHANS[0]: -6.0})
    assert find(fused, [one]).senders == {1}
    assert find(fused, [one, other]).senders == frozenset()
    assert find(cars(*ORPHANS[:2]), [one]).senders == frozenset()


def test_proposals_own_detections_low_scores_and_clouds_make_no_orphans():
    heats = dict.fromkeys(ORPHANS, 0.0)
    assert find_orphans(FRAME, cars(*ORPHANS), cache(), [message(1, heats)]) is None
    assert find_orphans(FRAME, cars(*ORPHANS), cache(*ORPHANS), []) is None
    assert find_orphans(FRAME, cars(*ORPHANS, score=MAX_SCORE), cache(), []) is None
    cloud = replace(message(1, heats), tokens=None, points=PointCloud.of(torch.zeros(1, 3)))
    assert find_orphans(FRAME, cars(*ORPHANS), cache(), [cloud]) is None
    assert find_orphans(FRAME, cars(*ORPHANS), cache(), []) is not None


def test_sent_objects_are_proposals():
    sent = replace(message(1, dict.fromkeys(ORPHANS, -6.0)), tokens=None, objects=cars(*ORPHANS))
    assert find_orphans(FRAME, cars(*ORPHANS), cache(), [sent]) is None


def test_a_claim_of_a_sender_of_full_weight_is_a_proposal_and_a_refuted_one_or_one_of_less_weight_is_none():
    claims = Claims.of(1, cars(*ORPHANS), np.full(3, 0.1))
    for weight, kind, is_none in ((1.0, Evidence.UNCHECKED, True), (0.9, 0, False), (1.0, Evidence.REFUTED, False)):
        assessed = AssessedClaims(claims, np.full(3, kind, np.uint8))
        assessment = Assessment((SenderAssessment(1, 0.7, weight),), (assessed,))
        assert (find_orphans(FRAME, cars(*ORPHANS), cache(), [], assessment) is None) is is_none


def test_orphans_lower_the_trust_in_their_sender_by_a_fault():
    detector = RayEvidenceDetector()
    state = TrustState.start(FRAME)
    after = detector.record_orphans(state, [1])
    assert isinstance(after, TrustState)
    assert after.trust_of(1, detector.trust).mean == pytest.approx(2.0 / 4.0)
    assert after.trust_of(2, detector.trust).mean == pytest.approx(2.0 / 3.0)
    assert detector.record_orphans(state, []) is state


def received(agent_id: int, num_tokens: int) -> ReceivedMessage:
    keys = torch.arange(num_tokens)
    tokens = SparseBev(torch.zeros(num_tokens, 4 + PROPOSAL_DIM), Sites(keys, GRID))
    one = Message(agent_id, NOW_NS, Transform.identity(), torch.zeros(3, 3).double(), tokens=tokens)
    return ReceivedMessage(one, 1, 1, NOW_NS)


def test_where_there_are_too_many_tokens_a_sender_of_low_trust_gives_way():
    limits = replace(ReceiverLimits(), max_fused_tokens=1_200)
    senders = [received(1, 700), received(2, 700), received(3, 700)]
    kept = select_for_fusion(FRAME, senders, {}, limits, {2: 0.0, 3: 0.5})[0]
    assert [one.num_tokens for one in kept] == [1_200 - MIN_SHARE - 350, MIN_SHARE, 350]
    assert [one.num_tokens for one in select_for_fusion(FRAME, senders, {}, limits)[0]] == [400, 400, 400]


def test_trust_changes_nothing_where_all_tokens_fit():
    senders = [received(1, 300), received(2, 300)]
    kept = select_for_fusion(FRAME, senders, {}, ReceiverLimits(), {2: 0.0})[0]
    assert [one.num_tokens for one in kept] == [300, 300]


def test_an_excluded_sender_is_fused_last():
    limits = replace(ReceiverLimits(), max_fused_senders=1)
    kept, left_out = select_for_fusion(FRAME, [received(1, 3), received(2, 3)], {1: (0, 0)}, limits, {1: 0.0})
    assert [one.message.agent_id for one in kept] == [2] and [one.agent_id for one in left_out] == [1]
