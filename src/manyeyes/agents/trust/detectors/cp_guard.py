# SPDX-License-Identifier: Apache-2.0
"""Consistency test of groups, after CP-Guard (Hu et al., "CP-Guard: Malicious Agent Detection and Defense in Collaborative Bird's
Eye View Perception", AAAI 2025) and CP-uniGuard (arXiv 2506.22890).

A group of senders is fused with the ego and compared with the ego alone; an inconsistent group is halved, until single senders are
accepted or excluded. The number of malicious senders need not be known. The threshold follows the losses of accepted groups in two
sliding windows, a short and a long one. Written from the papers' description; the loss is ours, on boxes instead of maps.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from statistics import fmean, pstdev

from manyeyes.agents.trust.agreement import consistency_loss
from manyeyes.agents.trust.interface import (
    Assessment,
    MisbehaviourDetector,
    MisbehaviourInput,
    SenderAssessment,
    SenderStatus,
)
from manyeyes.agents.trust.registry import register_misbehaviour_detector


@dataclass(frozen=True)
class LossWindow:
    """Losses of accepted groups, newest last."""

    losses: tuple[float, ...] = field(default=())


@register_misbehaviour_detector("cp-guard")
@dataclass(frozen=True)
class CpGuardDetector(MisbehaviourDetector):
    """start_threshold: of the loss before there are losses. min_threshold, max_threshold: its bounds. num_sigmas: standard
    deviations of the windows' losses above their means. short_window, long_window: numbers of losses. min_score: of compared boxes.
    """

    start_threshold: float = 0.6
    min_threshold: float = 0.4
    max_threshold: float = 0.8
    num_sigmas: float = 2.0
    short_window: int = 10
    long_window: int = 50
    min_score: float = 0.3

    def assess(self, received: MisbehaviourInput, state: object | None) -> Assessment:
        """Return weight 0 of senders that are inconsistent with the ego by themselves, and weight 1 of the others."""
        window = state if isinstance(state, LossWindow) else LossWindow()
        threshold, accepted, losses = self._threshold(window), dict[int, float](), list[float]()
        excluded: dict[int, float] = {}
        pending = [received.agent_ids] if received.agent_ids else []
        while pending:
            group = pending.pop()
            loss = consistency_loss(received.own, received.fuse(group), self.min_score)
            if loss <= threshold:
                accepted |= dict.fromkeys(group, loss)
                losses.append(loss)
            elif len(group) == 1:
                excluded[group[0]] = loss
            else:
                middle = len(group) // 2
                pending += [group[middle:], group[:middle]]
        senders = tuple(
            SenderAssessment(a, 1 - accepted[a])
            if a in accepted
            else SenderAssessment(a, 1 - excluded[a], 0.0, SenderStatus.MALICIOUS, f"loss {excluded[a]:.2f}")
            for a in received.agent_ids
        )
        return Assessment(senders, state=LossWindow((*window.losses, *losses)[-self.long_window :]))

    def _threshold(self, window: LossWindow) -> float:
        """Return the threshold from both windows; the larger one, so that a change of the scene excludes no sender."""
        if len(window.losses) < 2:
            return self.start_threshold
        parts = (window.losses[-self.short_window :], window.losses)
        value = max(fmean(part) + self.num_sigmas * pstdev(part) for part in parts)
        return min(max(value, self.min_threshold), self.max_threshold)
