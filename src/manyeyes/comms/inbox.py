# SPDX-License-Identifier: Apache-2.0
"""Inbox of an agent: packets in, the newest message of each sender out. Invalid bytes are counted, never raised."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from manyeyes.comms.admission import Admission, Authenticator
from manyeyes.comms.drop_counts import DropCounts, DropReason
from manyeyes.comms.entropy import CodeTables
from manyeyes.comms.network.interface import UNKNOWN_ORIGIN, Origin
from manyeyes.comms.primitives import PacketError
from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.comms.sender_table import SenderTable
from manyeyes.comms.token_format import TokenFormat, TokenRefusal
from manyeyes.datatypes import Message

RejectionReason = (
    TokenRefusal | Literal["content_error", "quarantined", "time", "cells", "pose", "busy", "untrusted", "skewed"]
)


@dataclass(frozen=True)
class Rejection:
    """Content of one sender that takes no part in a perception.

    reason: as in DropCounts, or content_error: fusing it raised an error, which is the cause; quarantined: its content did so
    shortly before; time: captured too long before or after the receiver's time; pose: its pose is implausible and could not be
    estimated; cells: more tokens in one message than are fused; busy: beyond the number of senders that are fused at one instant;
    untrusted: a misbehaviour detector excludes it; skewed: its clock is wrong by the arrivals of its messages.
    text: what was expected, what came.
    """

    agent_id: int
    reason: RejectionReason
    text: str
    cause: Exception | None = field(default=None, compare=False)


def token_rejection(agent_id: int, reason: TokenRefusal) -> Rejection:
    """Return the rejection of a sender's tokens."""
    return Rejection(agent_id, reason, _TOKEN_TEXTS[reason])


_TOKEN_TEXTS: dict[TokenRefusal, str] = {
    "wrong_model": "tokens of other weights than the receiver's; send with the same weights",
    "grid": "tokens name the receiver's weights but lie on another grid",
    "width": "tokens name the receiver's weights but have another number of channels",
    "value": "token values lie beyond the range that the weights send, or are NaN",
}


@dataclass(frozen=True)
class ReceivedMessage:
    """One agent's newest message as far as it came. last_arrival_ns is None where no arrival time was given."""

    message: Message
    received_packets: int
    expected_packets: int
    last_arrival_ns: int | None

    @property
    def complete(self) -> bool:
        """Every packet of the message came and was of use."""
        return self.received_packets == self.expected_packets

    @property
    def num_tokens(self) -> int:
        """Number of tokens of the message."""
        return 0 if self.message.tokens is None else len(self.message.tokens.sites)

    def age_ns(self, now_ns: int) -> int:
        """Return the age of information: now less the time of capture."""
        return now_ns - self.message.timestamp_ns


class Arrival(NamedTuple):
    """The newest message of a sender, and the time of its last packet."""

    agent_id: int
    timestamp_ns: int
    arrival_ns: int


class Inbox:
    """The newest message of each sender, complete or not; packets that the receiver's checks refuse are counted and dropped.

    fingerprint: tokens of other weights are refused, other sections of the same message are not; None takes all. tables: of the
    codebook of these weights; without them coded tokens cannot be read and are refused as of other weights. token_format: refuses,
    beyond the fingerprint, tokens of another grid, width or range, and holds the tables; an agent's own inbox has it
    (``Agent.inbox``). limits: bounds of all checks. authenticator: which packets are authentic; None accepts all unsigned
    ones, and reads no signed ones.

    Times are those of the receiver's clock: without arrival_ns and now_ns no stamp is checked against it.
    """

    def __init__(
        self,
        fingerprint: bytes | None = None,
        tables: CodeTables | None = None,
        token_format: TokenFormat | None = None,
        limits: ReceiverLimits | None = None,
        authenticator: Authenticator | None = None,
    ) -> None:
        self.limits = limits or ReceiverLimits()
        self._tables = tables if token_format is None else token_format.tables
        self._admission = Admission(self.limits, fingerprint, token_format, authenticator)
        self._senders = SenderTable(self.limits)
        self._dropped = Counter[DropReason]()
        self._rejections: dict[int, Rejection] = {}

    @property
    def dropped(self) -> DropCounts:
        """Packets not taken so far, by reason."""
        return DropCounts(**self._dropped)

    def push(self, packet: bytes, arrival_ns: int | None = None, origin: Origin = UNKNOWN_ORIGIN) -> None:
        """Take one packet; whatever is wrong with it is counted and never raised. origin: of the network that it came from."""
        try:
            refusal = self._take(packet, arrival_ns, origin)
        except PacketError as error:
            refusal = error.reason
        if refusal is not None:
            self._dropped[refusal] += 1

    def received_messages(self, now_ns: int | None = None) -> tuple[ReceivedMessage, ...]:
        """Return the newest message of each agent, as far as it came, by agent id; those out of date at now_ns are dropped."""
        self._senders.begin_instant(now_ns)
        return tuple(
            ReceivedMessage(
                message=held.assembly.message(),
                received_packets=len(held.assembly.fragments),
                expected_packets=held.assembly.header.num_packets,
                last_arrival_ns=held.last_arrival_ns,
            )
            for held in self._senders.current_messages()
        )

    def complete_senders(self, since_ns: int) -> frozenset[int]:
        """Return the senders whose newest message was captured at since_ns or later, and is complete. Nothing changes."""
        held = (message.assembly for message in self._senders.current_messages())
        return frozenset(
            assembly.header.agent_id
            for assembly in held
            if assembly.header.timestamp_ns >= since_ns and len(assembly.fragments) == assembly.header.num_packets
        )

    def arrivals(self) -> tuple[Arrival, ...]:
        """Return the newest message of each sender with its arrival, without those that came without one. Nothing changes."""
        return tuple(
            Arrival(held.assembly.header.agent_id, held.timestamp_ns, held.last_arrival_ns)
            for held in self._senders.current_messages()
            if held.last_arrival_ns is not None
        )

    def peek(self) -> tuple[Message, ...]:
        """Return the newest message of each sender, as far as it came, whatever its age. Nothing changes."""
        return tuple(held.assembly.message() for held in self._senders.current_messages())

    def take_rejections(self) -> tuple[Rejection, ...]:
        """Senders whose tokens were refused since the last call, the last reason of each, by agent id."""
        taken, self._rejections = self._rejections, {}
        return tuple(rejection for _, rejection in sorted(taken.items()))

    def clear(self) -> None:
        """Drop the messages of all senders, and forget the senders: their times are those of another clock."""
        self._senders.clear()
        self._rejections.clear()

    def set_trust(self, trust: Mapping[int, float]) -> None:
        """Set the trust in senders, in [0, 1] by agent id: where no place is free, those of the lowest trust give way first."""
        self._senders.set_trust(trust)

    def discard(self, agent_id: int) -> None:
        """Drop the messages of one sender; its next message is accepted again."""
        self._senders.discard(agent_id)

    def messages(self, now_ns: int | None = None) -> tuple[Message, ...]:
        """Return the newest message of each agent, as far as it came, by agent id."""
        return tuple(reception.message for reception in self.received_messages(now_ns))

    def _take(self, packet: bytes, arrival_ns: int | None, origin: Origin) -> DropReason | None:
        """Take a packet that passes all checks; the reason of the first that it does not pass."""
        envelope = self._admission.open(packet, arrival_ns, origin)
        if isinstance(envelope, str):
            return envelope
        agent_id = envelope.header.agent_id
        if self._senders.exceeds_rate(agent_id, len(envelope.packet), arrival_ns):
            return "rate"
        refusal = self._senders.check_stamp(envelope)
        if refusal is not None:
            return refusal
        fragment = self._admission.read(envelope, self._tables)
        if isinstance(fragment, str):
            if fragment in _TOKEN_TEXTS:
                self._reject(agent_id, fragment)
            return fragment
        return self._senders.store(fragment, arrival_ns)

    def _reject(self, agent_id: int, reason: TokenRefusal) -> None:
        """Store the reason for take_rejections, of at most max_senders senders: ids are not authenticated."""
        self._rejections.pop(agent_id, None)
        if len(self._rejections) >= self.limits.max_senders:
            del self._rejections[next(iter(self._rejections))]
        self._rejections[agent_id] = token_rejection(agent_id, reason)
