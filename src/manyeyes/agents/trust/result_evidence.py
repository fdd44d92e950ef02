# SPDX-License-Identifier: Apache-2.0
"""Evidence on each box of a result, and the bound on scores of boxes that rest on one sender and cannot be checked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from manyeyes.agents.trust._association_kernels import find_supporting_claims
from manyeyes.agents.trust.association import find_nearest
from manyeyes.agents.trust.interface import AssessedClaims, Assessment, Evidence
from manyeyes.datatypes import Boxes

SAME_PLACE_M = 2.0
"""A result rests on the claims whose centres are closer."""
OWN_PLACE_M, MIN_OWN_SCORE = 1.0, 0.3
"""A result within OWN_PLACE_M of an own detection of MIN_OWN_SCORE is the ego's own."""
# Members of an enumeration are slow to read.
_OWN, _REFUTED = int(Evidence.OWN), int(Evidence.REFUTED)
_UNCHECKED, _DISPUTED = int(Evidence.UNCHECKED), int(Evidence.DISPUTED)
MIN_TRUST, MAX_UNCHECKED_SCORE = 0.8, 0.49
"""Maximum score of a result that is unchecked and rests on one sender of less than MIN_TRUST, or that is disputed."""


@dataclass(frozen=True)
class ResultEvidence:
    """Evidence on N boxes of a result.

    kinds: (N,) uint8 of Evidence. agent_ids: S senders; claims: (S, N) bool, whether a box rests on a claim of each. trust: (N,)
    the highest trust among those; 1 of own detections, 0 without any sender.
    """

    kinds: Tensor
    agent_ids: tuple[int, ...]
    claims: Tensor
    trust: Tensor

    def __getitem__(self, rows: Tensor) -> ResultEvidence:
        return ResultEvidence(self.kinds[rows], self.agent_ids, self.claims[:, rows], self.trust[rows])

    @cached_property
    def senders(self) -> tuple[tuple[int, ...], ...]:
        """Ids of the senders whose claims each box rests on."""
        found: list[tuple[int, ...]] = [()] * self.claims.shape[1]
        for sender, row in self.claims.nonzero().tolist():
            found[row] += (self.agent_ids[sender],)
        return tuple(found)


def find_result_evidence(boxes: Boxes, own: Boxes, assessment: Assessment | None) -> ResultEvidence | None:
    """Return the evidence on boxes (N) in the ego's frame; None where claims are not assessed. own: its detections."""
    if assessment is None or assessment.claims is None:
        return None
    xy = boxes.center[:, :2].double().contiguous().numpy()
    trust_of = {sender.agent_id: sender.trust for sender in assessment.senders}
    used = _list_fused_claims(assessment)
    # Of several claims at one place, the one of the highest value decides.
    kinds, trust, is_near = find_supporting_claims(
        xy,
        np.concatenate([np.zeros((0, 2)), *(claims.claims.xy for claims in used)]),
        np.concatenate([np.zeros(0, np.uint8), *(claims.kinds for claims in used)]),
        np.cumsum([0, *(len(claims.kinds) for claims in used)]),
        np.array([trust_of[claims.agent_id] for claims in used], np.float64),
        _REFUTED,
        SAME_PLACE_M,
    )
    seen = own.center[own.score >= MIN_OWN_SCORE, :2].double().numpy()
    is_own = find_nearest(xy, seen, OWN_PLACE_M) >= 0
    kinds[is_own], trust[is_own] = _OWN, 1.0
    agent_ids = tuple(claims.agent_id for claims in used)
    return ResultEvidence(torch.from_numpy(kinds), agent_ids, torch.from_numpy(is_near), torch.from_numpy(trust))


def _list_fused_claims(assessment: Assessment) -> list[AssessedClaims]:
    """List the claims of senders of a positive weight, and the confirmed ones of excluded senders that keep them."""
    keeps_confirmed = {sender.agent_id for sender in assessment.senders if sender.keeps_confirmed}
    found = list[AssessedClaims]()
    for one in assessment.claims or ():
        if assessment.weights.get(one.agent_id, 0.0) > 0:
            found.append(one)
        elif one.agent_id in keeps_confirmed:
            found.append(AssessedClaims(one.claims[one.is_confirmed], one.kinds[one.is_confirmed]))
    return found


def bound_scores(boxes: Boxes, evidence: ResultEvidence) -> tuple[Boxes, ResultEvidence]:
    """Return the boxes with bounded scores, by falling score, and their evidence.

    MAX_UNCHECKED_SCORE bounds the score of a disputed box, and of an unchecked one that rests on one sender without a trust of
    MIN_TRUST.
    """
    kinds = evidence.kinds.numpy()
    is_disputed = kinds == _DISPUTED
    is_bounded = is_disputed | ((kinds == _UNCHECKED) & (evidence.trust.numpy() < MIN_TRUST))
    is_bounded &= boxes.score.numpy() > MAX_UNCHECKED_SCORE
    if is_bounded.any():
        is_bounded &= is_disputed | (evidence.claims.sum(0).numpy() == 1)
    rows = np.flatnonzero(is_bounded)
    if not len(rows):
        return boxes, evidence
    score = boxes.score.clone()
    score[rows] = MAX_UNCHECKED_SCORE
    order = score.argsort(descending=True, stable=True)
    return replace(boxes, score=score)[order], evidence[order]
