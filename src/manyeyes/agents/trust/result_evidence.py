# SPDX-License-Identifier: Apache-2.0
"""Evidence on each box of a result, and the bound on scores of boxes that rest on one sender which nobody can check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from manyeyes.agents.trust.interface import AssessedClaims, Assessment, Evidence
from manyeyes.datatypes import Boxes

SAME_PLACE_M = 2.0
"""A result rests on the claims whose centres are closer."""
OWN_PLACE_M, MIN_OWN_SCORE = 1.0, 0.3
"""A result within OWN_PLACE_M of an own detection of MIN_OWN_SCORE is the ego's own."""
MIN_TRUST, MAX_UNCHECKED_SCORE = 0.8, 0.49
"""Maximum score of a result that is unchecked and rests on one sender of less than MIN_TRUST, or that is disputed."""


@dataclass(frozen=True)
class ResultEvidence:
    """Evidence on N boxes of a result.

    kinds: (N,) uint8 of Evidence. senders: ids of the senders whose claims each box rests on. trust: (N,) the highest trust
    among them; 1 of own detections, 0 without any sender.
    """

    kinds: Tensor
    senders: tuple[tuple[int, ...], ...]
    trust: Tensor

    def __getitem__(self, rows: Tensor) -> ResultEvidence:
        return ResultEvidence(self.kinds[rows], tuple(self.senders[row] for row in rows.tolist()), self.trust[rows])


def find_result_evidence(boxes: Boxes, own: Boxes, assessment: Assessment | None) -> ResultEvidence | None:
    """Return the evidence on boxes (N) in the ego's frame; None where claims are not assessed. own: its detections."""
    if assessment is None or assessment.claims is None:
        return None
    xy = boxes.center[:, :2].double()
    kinds, trust = torch.zeros(len(boxes), dtype=torch.uint8), torch.zeros(len(boxes), dtype=torch.float64)
    is_near = list[Tensor]()
    trust_of = {sender.agent_id: sender.trust for sender in assessment.senders}
    used = [claims for claims in assessment.claims if assessment.weights.get(claims.agent_id, 0.0) > 0]
    for claims in used:
        near, kind = _find_claims_near(xy, claims)
        # Of several claims at one place, the one of the highest value decides.
        kinds = torch.maximum(kinds, kind)
        trust = torch.where(near, trust.clamp_min(trust_of[claims.agent_id]), trust)
        is_near.append(near)
    mine = own[own.score >= MIN_OWN_SCORE].center[:, :2].double()
    is_own = (torch.cdist(xy, mine) <= OWN_PLACE_M).any(1)
    kinds[is_own], trust[is_own] = Evidence.OWN, 1.0
    return ResultEvidence(kinds, _collect_senders([claims.agent_id for claims in used], is_near, len(boxes)), trust)


def _find_claims_near(xy: Tensor, claims: AssessedClaims) -> tuple[Tensor, Tensor]:
    """Return (N,) bool, whether a claim that is not refuted is near each place (N, 2), and (N,) uint8, the evidence on it."""
    is_used = claims.evidence != Evidence.REFUTED
    evidence, places = claims.evidence[is_used], claims.boxes.center[is_used, :2].double()
    if not len(places):
        return torch.zeros(len(xy), dtype=torch.bool), torch.zeros(len(xy), dtype=torch.uint8)
    nearest = torch.cdist(xy, places).min(1)
    near = nearest.values <= SAME_PLACE_M
    return near, torch.where(near, evidence[nearest.indices], 0)


def _collect_senders(agent_ids: Sequence[int], is_near: Sequence[Tensor], count: int) -> tuple[tuple[int, ...], ...]:
    found: list[list[int]] = [[] for _ in range(count)]
    for agent_id, near in zip(agent_ids, is_near):
        for row in near.nonzero()[:, 0].tolist():
            found[row].append(agent_id)
    return tuple(map(tuple, found))


def bound_scores(boxes: Boxes, evidence: ResultEvidence) -> tuple[Boxes, ResultEvidence]:
    """Return the boxes with bounded scores, by falling score, and their evidence.

    MAX_UNCHECKED_SCORE bounds the score of a disputed box, and of an unchecked one that rests on one sender without a trust of
    MIN_TRUST.
    """
    is_single = torch.tensor([len(senders) == 1 for senders in evidence.senders], dtype=torch.bool)
    is_unchecked = (evidence.kinds == Evidence.UNCHECKED) & is_single & (evidence.trust < MIN_TRUST)
    is_bounded = is_unchecked | (evidence.kinds == Evidence.DISPUTED)
    if not bool((boxes.score[is_bounded] > MAX_UNCHECKED_SCORE).any()):
        return boxes, evidence
    score = torch.where(is_bounded, boxes.score.clamp_max(MAX_UNCHECKED_SCORE), boxes.score)
    order = score.argsort(descending=True, stable=True)
    return replace(boxes, score=score)[order], evidence[order]
