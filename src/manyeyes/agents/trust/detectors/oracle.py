# SPDX-License-Identifier: Apache-2.0
"""Oracle: it gets the ids of malicious senders, and excludes them from the first frame. An upper bound, not a defence."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from manyeyes.agents.trust.interface import (
    Assessment,
    MisbehaviourDetector,
    MisbehaviourInput,
    SenderAssessment,
    SenderStatus,
)
from manyeyes.agents.trust.registry import register_misbehaviour_detector


@register_misbehaviour_detector("oracle")
@dataclass(frozen=True)
class OracleDetector(MisbehaviourDetector):
    """malicious: agent ids of the malicious senders; none by default."""

    malicious: frozenset[int] = frozenset()

    def excluded(self, state: object | None, agent_ids: Collection[int], now_ns: int) -> frozenset[int]:
        """Return the malicious ones of some senders."""
        return self.malicious.intersection(agent_ids)

    def assess(self, received: MisbehaviourInput, state: object | None) -> Assessment:
        """Return weight 0 of malicious senders, and weight 1 of the others."""
        return Assessment(tuple(map(self._assess_sender, received.agent_ids)))

    def _assess_sender(self, agent_id: int) -> SenderAssessment:
        if agent_id not in self.malicious:
            return SenderAssessment(agent_id, 1.0)
        return SenderAssessment(agent_id, 0.0, 0.0, SenderStatus.MALICIOUS, "known to be malicious")
