# SPDX-License-Identifier: Apache-2.0
"""Evidence on each box of a result, and the bound on scores of boxes that rest on one sender and cannot be checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.agents.trust.association import find_nearest
from manyeyes.agents.trust.interface import Assessment, Evidence
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
    xy = boxes.center[:, :2].double().numpy()
    kinds, trust = np.zeros(len(xy), np.uint8), np.zeros(len(xy))
    trust_of = {sender.agent_id: sender.trust for sender in assessment.senders}
    used = [claims for claims in assessment.claims if assessment.weights.get(claims.agent_id, 0.0) > 0]
    is_near = list[NDArray[np.bool_]]()
    for claims in used:
        is_used = claims.kinds != Evidence.REFUTED
        nearest = find_nearest(xy, claims.claims.xy[is_used], SAME_PLACE_M)
        is_near.append(nearest >= 0)
        # Of several claims at one place, the one of the highest value decides.
        kinds = np.maximum(kinds, np.append(claims.kinds[is_used], np.uint8(0))[nearest])
        trust = np.maximum(trust, is_near[-1] * trust_of[claims.agent_id])
    is_own = find_nearest(xy, own.center[own.score >= MIN_OWN_SCORE, :2].double().numpy(), OWN_PLACE_M) >= 0
    kinds[is_own], trust[is_own] = Evidence.OWN, 1.0
    senders = _collect_senders([claims.agent_id for claims in used], is_near, len(xy))
    return ResultEvidence(torch.from_numpy(kinds), senders, torch.from_numpy(trust))


def _collect_senders(
    agent_ids: Sequence[int], is_near: Sequence[NDArray[np.bool_]], count: int
) -> tuple[tuple[int, ...], ...]:
    found: list[tuple[int, ...]] = [()] * count
    for agent_id, near in zip(agent_ids, is_near):
        for row in np.flatnonzero(near).tolist():
            found[row] += (agent_id,)
    return tuple(found)


def bound_scores(boxes: Boxes, evidence: ResultEvidence) -> tuple[Boxes, ResultEvidence]:
    """Return the boxes with bounded scores, by falling score, and their evidence.

    MAX_UNCHECKED_SCORE bounds the score of a disputed box, and of an unchecked one that rests on one sender without a trust of
    MIN_TRUST.
    """
    is_unchecked = (evidence.kinds == Evidence.UNCHECKED) & (evidence.trust < MIN_TRUST)
    is_bounded = is_unchecked | (evidence.kinds == Evidence.DISPUTED)
    rows = (is_bounded & (boxes.score > MAX_UNCHECKED_SCORE)).nonzero()[:, 0].tolist()
    rows = [row for row in rows if len(evidence.senders[row]) == 1 or evidence.kinds[row] == Evidence.DISPUTED]
    if not rows:
        return boxes, evidence
    score = boxes.score.clone()
    score[rows] = MAX_UNCHECKED_SCORE
    order = score.argsort(descending=True, stable=True)
    return replace(boxes, score=score)[order], evidence[order]
