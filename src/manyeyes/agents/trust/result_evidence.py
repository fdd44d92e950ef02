# SPDX-License-Identifier: Apache-2.0
"""Evidence on each box of a result, and the bound on scores of boxes that rest on one sender and cannot be checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
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
    senders = _collect_senders([claims.agent_id for claims in used], is_near)
    return ResultEvidence(torch.from_numpy(kinds), senders, torch.from_numpy(trust))


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


def _collect_senders(agent_ids: Sequence[int], is_near: NDArray[np.bool_]) -> tuple[tuple[int, ...], ...]:
    """Return for each of N boxes the agents that claim it; is_near: (S, N)."""
    found: list[tuple[int, ...]] = [()] * is_near.shape[1]
    for sender, row in np.argwhere(is_near).tolist():
        found[row] += (agent_ids[sender],)
    return tuple(found)


def bound_scores(boxes: Boxes, evidence: ResultEvidence) -> tuple[Boxes, ResultEvidence]:
    """Return the boxes with bounded scores, by falling score, and their evidence.

    MAX_UNCHECKED_SCORE bounds the score of a disputed box, and of an unchecked one that rests on one sender without a trust of
    MIN_TRUST.
    """
    kinds = evidence.kinds.numpy()
    is_disputed = kinds == _DISPUTED
    is_bounded = is_disputed | ((kinds == _UNCHECKED) & (evidence.trust.numpy() < MIN_TRUST))
    is_bounded &= boxes.score.numpy() > MAX_UNCHECKED_SCORE
    rows = [row for row in np.flatnonzero(is_bounded).tolist() if is_disputed[row] or len(evidence.senders[row]) == 1]
    if not rows:
        return boxes, evidence
    score = boxes.score.clone()
    score[rows] = MAX_UNCHECKED_SCORE
    order = score.argsort(descending=True, stable=True)
    return replace(boxes, score=score)[order], evidence[order]
