# SPDX-License-Identifier: Apache-2.0
"""What the misbehaviour detector of one ego remembers of senders. A sender under another id is unknown, hence starts anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from manyeyes.agents.isolation import Quarantine
from manyeyes.agents.trust.association import Floats
from manyeyes.agents.trust.beta_trust import BetaTrust, TrustConfig, decay
from manyeyes.agents.trust.claim_tracks import ClaimTracks, move_tracks
from manyeyes.agents.trust.copies import StatedContent
from manyeyes.agents.trust.disputes import Disputes
from manyeyes.agents.trust.omissions import OwnObjects
from manyeyes.datatypes import AgentFrame, Transform

MAX_SENDERS = 256
MAX_SILENCE_NS = 60_000_000_000
"""A sender that was silent for longer is forgotten: its trust has decayed to the prior."""
NEVER_NS = -(1 << 63)
MAX_GAP_NS = 1_000_000_000
"""After a longer gap of the ego's frames positions are forgotten; trust is not."""


@dataclass(frozen=True)
class SenderMemory:
    """One sender: its trust at updated_ns; the capture time of its last message; tracks of its claims; objects that it omits.

    reason: of its exclusion; empty if it is not excluded. keeps_confirmed: it was excluded for refuted claims; those that others
    confirm are still fused. contents: of its last messages; copies: which of them were copies, the newest first; contested: in
    which of them a few senders alone claimed several objects that the ego refutes; excess: which of them had too many unconfirmed
    claims. contradicted_ns: when its stated pose was last contradicted.
    """

    trust: BetaTrust
    updated_ns: int
    captured_ns: int
    tracks: ClaimTracks
    omitted: OwnObjects
    reason: str = ""
    keeps_confirmed: bool = False
    contents: tuple[StatedContent, ...] = ()
    copies: tuple[bool, ...] = ()
    contested: tuple[bool, ...] = ()
    excess: tuple[bool, ...] = ()
    contradicted_ns: int = NEVER_NS


UNKNOWN_SENDER = SenderMemory(BetaTrust(*TrustConfig().prior), 0, NEVER_NS, ClaimTracks.empty(), OwnObjects.empty())
"""Before the first message of a sender."""


@dataclass(frozen=True)
class TrustState:
    """All senders by id, excluded ones, disputed places and the ego's own objects; positions are in the ego's frame at now_ns."""

    now_ns: int
    odometry: Transform
    own: OwnObjects
    senders: Mapping[int, SenderMemory] = field(default_factory=dict[int, SenderMemory])
    exclusions: Quarantine = field(default_factory=Quarantine)
    disputes: Disputes = field(default_factory=Disputes.empty)

    @classmethod
    def start(cls, frame: AgentFrame) -> TrustState:
        """Return the state before the first frame."""
        return cls(frame.timestamp_ns, frame.odometry or frame.world_from_agent, OwnObjects.empty())

    def trust_of(self, agent_id: int, config: TrustConfig) -> BetaTrust:
        """Return the trust in a sender now."""
        memory = self.senders.get(agent_id)
        if memory is None:
            return BetaTrust(*config.prior)
        return decay(memory.trust, (self.now_ns - memory.updated_ns) * 1e-9, config)


def advance(state: TrustState, frame: AgentFrame, own: OwnObjects) -> tuple[TrustState, Floats, Floats]:
    """Return the state in the ego's frame of now, and the motion to it: rotation (2, 2) and shift (2,). own: objects of now."""
    gap_ns, odometry = frame.timestamp_ns - state.now_ns, frame.odometry or frame.world_from_agent
    now_from_world, before = odometry.rotation.numpy().T, state.odometry
    rotation = np.ascontiguousarray((now_from_world @ before.rotation.numpy())[:2, :2])
    shift = (now_from_world @ (before.translation.numpy() - odometry.translation.numpy()))[:2]
    is_continued = 0 <= gap_ns <= MAX_GAP_NS
    seconds = gap_ns * 1e-9 if is_continued else 0.0
    senders = {
        agent_id: replace(memory, tracks=move_tracks(memory.tracks, rotation, shift, seconds))
        if is_continued
        else replace(memory, tracks=ClaimTracks.empty(), omitted=OwnObjects.empty())
        for agent_id, memory in state.senders.items()
        if abs(frame.timestamp_ns - memory.updated_ns) <= MAX_SILENCE_NS
    }
    disputes = state.disputes.move(rotation, shift, frame.timestamp_ns) if is_continued else Disputes.empty()
    earlier = state.own if is_continued else OwnObjects.empty()
    objects = earlier.follow(own, rotation, shift, seconds)
    return TrustState(frame.timestamp_ns, odometry, objects, senders, state.exclusions, disputes), rotation, shift


def forget_oldest(senders: Mapping[int, SenderMemory]) -> Mapping[int, SenderMemory]:
    """Return at most MAX_SENDERS senders, the last received ones."""
    newest = sorted(senders, key=lambda agent_id: (-senders[agent_id].updated_ns, agent_id))[:MAX_SENDERS]
    return {agent_id: senders[agent_id] for agent_id in sorted(newest)}
