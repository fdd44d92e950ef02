# SPDX-License-Identifier: Apache-2.0
"""No misbehaviour detection: every sender has weight 1."""

from __future__ import annotations

from dataclasses import dataclass

from manyeyes.agents.trust.interface import Assessment, MisbehaviourDetector, MisbehaviourInput, SenderAssessment
from manyeyes.agents.trust.registry import register_misbehaviour_detector


@register_misbehaviour_detector("none")
@dataclass(frozen=True)
class NoMisbehaviourDetection(MisbehaviourDetector):
    """The baseline without a defence: results are those of an agent without a misbehaviour detector, bit for bit."""

    def assess(self, received: MisbehaviourInput, state: object | None) -> Assessment:
        """Return trust 1 and weight 1 of every sender."""
        return Assessment(tuple(SenderAssessment(agent_id, 1.0) for agent_id in received.agent_ids))
