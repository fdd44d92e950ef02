# SPDX-License-Identifier: Apache-2.0
"""Engine of a live agent: a function of its recorded events. Nothing here reads a clock, a file or a socket.

What depends on elapsed time (the level of overload, the time of perception, which packets came) is an argument, and is recorded
(``runtime.recorder``), so that a replay of the events computes the same bit for bit.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, field, fields, replace

from manyeyes.agents.agent import Agent, Perception
from manyeyes.agents.strategies.no_fusion import NoFusion
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.comms.drop_counts import DropCounts
from manyeyes.comms.inbox import Rejection
from manyeyes.comms.network.interface import ReceivedPacket
from manyeyes.comms.signatures.envelope import UNSIGNED, EnvelopeSize
from manyeyes.datatypes import AgentFrame
from manyeyes.runtime.authentication import PacketVerifier
from manyeyes.runtime.sender_clocks import SenderClocks

MAX_SENDERS_UNDER_LOAD = 4
_SKEWED = "the clock of this sender differs from the receiver's, by the arrivals of its messages"
UNSYNCHRONISED_NS = 1_000_000_000


@dataclass
class Engine:
    """An agent, its inbox, and what a level of overload changes of them. verifier: of received packets; None in mode off.

    Senders whose clocks are wrong (``runtime.sender_clocks``) are not fused. After a step of its own clock the agent fuses nothing
    for UNSYNCHRONISED_NS, and begins anew.
    """

    agent: Agent
    verifier: PacketVerifier | None = None
    _unsynchronised_until_ns: int | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.inbox = self.agent.inbox(authenticator=self.verifier)
        self._strategy, self._pose_correction = self.agent.strategy, self.agent.pose_correction
        self._limits, self._num_frames = self.inbox.limits, 0
        self.sender_clocks = SenderClocks()
        self.received_packets = self.received_bytes = 0

    @property
    def dropped(self) -> DropCounts:
        """Packets not taken so far, by reason."""
        return self.inbox.dropped

    def push(self, received: ReceivedPacket) -> None:
        """Take one packet of the network."""
        self.received_packets += 1
        self.received_bytes += len(received.packet)
        self.inbox.push(received.packet, received.arrival_ns, received.origin)

    def share(self, frame: AgentFrame, level: int = 0, envelope: EnvelopeSize = UNSIGNED) -> list[bytes]:
        """Begin a frame: return its packets. level: of overload, for this call and the next perceive."""
        self._set_level(level)
        budget = self.agent.budget_bytes
        half = None if budget is None or level < 2 else budget // 2
        return self.agent.share(frame, half, envelope=envelope)

    def perceive(self, frame: AgentFrame, now_ns: int) -> Perception:
        """Return boxes of the frame and of what was received by now_ns."""
        for arrival in self.inbox.arrivals():
            self.sender_clocks.record(arrival)
        if self.is_unsynchronised(now_ns):
            return self.agent.perceive(frame, (), now_ns)
        self._unsynchronised_until_ns = None
        skewed = self.sender_clocks.skewed(now_ns)
        for agent_id in skewed:
            self.inbox.discard(agent_id)
        self.agent.message_history.forget(skewed)
        perception = self.agent.perceive(frame, self.inbox, now_ns)
        rejected = [Rejection(agent_id, "skewed", _SKEWED) for agent_id in sorted(skewed)]
        return replace(perception, rejected=(*perception.rejected, *rejected)) if rejected else perception

    def is_unsynchronised(self, now_ns: int) -> bool:
        """Return whether the clock of the agent stepped shortly before a time."""
        return self._unsynchronised_until_ns is not None and now_ns < self._unsynchronised_until_ns

    def step_clock(self, now_ns: int) -> None:
        """Begin anew after a step of the agent's clock: times of what was received are those of another clock."""
        self._unsynchronised_until_ns = now_ns + UNSYNCHRONISED_NS
        self.agent.reset_history()
        self.inbox.clear()
        self.sender_clocks.clear()

    def _set_level(self, level: int) -> None:
        """Set what the agent does for one frame."""
        self._num_frames += 1
        agent, is_alone = self.agent, isinstance(self._strategy, NoFusion)
        is_corrected = level < 1 or self._num_frames % 2 == 1
        agent.pose_correction = self._pose_correction if is_corrected and level < 4 else None
        agent.strategy = self._strategy if level < 3 or is_alone else get_strategy("late" if level == 3 else "none")
        num_senders = MAX_SENDERS_UNDER_LOAD if level >= 2 else self._limits.max_fused_senders
        self.inbox.limits = replace(self._limits, max_fused_senders=min(num_senders, self._limits.max_fused_senders))


def digest_perception(perception: Perception) -> str:
    """Return a SHA-256 of all that a perception holds: every bit of the boxes, received and rejected senders, and all trust."""
    digest = hashlib.sha256()
    for one in fields(perception.boxes):
        digest.update(getattr(perception.boxes, one.name).detach().cpu().contiguous().numpy().tobytes())
    for one in perception.received:
        digest.update(struct.pack("<iqi", one.message.agent_id, one.message.timestamp_ns, one.received_packets))
    for rejection in perception.rejected:
        digest.update(f"{rejection.agent_id} {rejection.reason}\n".encode())
    for sender in () if perception.assessment is None else perception.assessment.senders:
        digest.update(struct.pack("<idd", sender.agent_id, sender.trust, sender.weight))
    if perception.evidence is not None:
        digest.update(perception.evidence.kinds.numpy().tobytes())
    return digest.hexdigest()


def digest_packets(packets: list[bytes]) -> str:
    """Return a SHA-256 of packets in their order."""
    digest = hashlib.sha256()
    for packet in packets:
        digest.update(struct.pack("<I", len(packet)) + packet)
    return digest.hexdigest()
