# SPDX-License-Identifier: Apache-2.0
"""Inbox of an agent: packets in, the newest message of each sender out. Invalid bytes are counted, never raised."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Literal

from manyeyes.comms.entropy import CodeTables
from manyeyes.comms.payloads import TokenRows
from manyeyes.comms.primitives import PacketError, Reason
from manyeyes.comms.token_format import TokenFormat, TokenRefusal
from manyeyes.comms.wire import Assembly, Fragment, decode_packet
from manyeyes.datatypes import Message

DropReason = Reason | TokenRefusal | Literal["duplicate", "expired", "full"]

RejectionReason = TokenRefusal | Literal["content_error", "quarantined", "time", "pose", "busy"]

_CLOCK_SLACK_NS = 1_000_000_000


@dataclass(frozen=True)
class DropCounts:
    """Number of dropped packets by reason.

    garbage: not a packet, or cut. version: of another wire version. checksum: bytes were changed. implausible: values
    that cannot be (NaN, cells outside the grid, captured over 1 s after arrival). contradiction: another packet of the
    same message contradicts it. wrong_model: tokens of other weights. grid, width, value: tokens that name these weights but
    lie on another grid, have other channels, or values beyond what the weights send. duplicate: a copy. expired: too old, or
    older than the newest message of this agent. full: no room for more agents or more bytes of this agent.
    """

    garbage: int = 0
    version: int = 0
    checksum: int = 0
    implausible: int = 0
    contradiction: int = 0
    wrong_model: int = 0
    grid: int = 0
    width: int = 0
    value: int = 0
    duplicate: int = 0
    expired: int = 0
    full: int = 0

    @property
    def total(self) -> int:
        """Packets not taken, for whatever reason."""
        return sum(getattr(self, f.name) for f in fields(self))

    def increment(self, reason: DropReason) -> DropCounts:
        """Return one more packet of that reason."""
        return replace(self, **{reason: getattr(self, reason) + 1})


@dataclass(frozen=True)
class Rejection:
    """Content of one sender that takes no part in a perception.

    reason: as in DropCounts, or content_error: fusing it raised an error, which is the cause; quarantined: its content did so
    shortly before; time: captured too long before or after the receiver's time; pose: its pose is implausible and could not be
    estimated; busy: beyond the number of senders that are fused at one instant. text: what was expected, what came.
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

    def age_ns(self, now_ns: int) -> int:
        """Return the age of information: now less the time of capture."""
        return now_ns - self.message.timestamp_ns


@dataclass
class _PendingMessage:
    assembly: Assembly
    packet_bytes: int
    last_arrival_ns: int | None


class Inbox:
    """The newest message of each sender, complete or not.

    fingerprint: tokens of other weights are refused, other sections of the same message are not; None takes all.
    expire_ns: a message captured longer ago than this is neither taken nor given; None keeps it until a newer one comes.
    At most max_agents senders of max_agent_bytes of packets each are held: a flood of ids cannot exhaust the memory.
    Beyond it the sender with the oldest timestamp is replaced by a newer one. tables: of the codebook of these
    weights; without them coded tokens cannot be read and are refused as of other weights. token_format: refuses, beyond the
    fingerprint, tokens of another grid, width or range, and holds the tables; an agent's own inbox has it (``Agent.inbox``).
    """

    def __init__(
        self,
        fingerprint: bytes | None = None,
        expire_ns: int | None = None,
        max_agents: int = 64,
        max_agent_bytes: int = 4 << 20,
        tables: CodeTables | None = None,
        token_format: TokenFormat | None = None,
    ) -> None:
        self._token_format = token_format
        self._fingerprint = fingerprint if token_format is None else token_format.fingerprint
        self._expire_ns = expire_ns
        self._max_agents = max_agents
        self._max_agent_bytes = max_agent_bytes
        self._tables = tables if token_format is None else token_format.tables
        self._held: dict[int, _PendingMessage] = {}
        self._dropped = DropCounts()
        self._rejections: dict[int, Rejection] = {}

    @property
    def dropped(self) -> DropCounts:
        """Packets not taken so far, by reason."""
        return self._dropped

    def push(self, packet: bytes, arrival_ns: int | None = None) -> None:
        """Take one packet; whatever is wrong with it is counted and never raised."""
        try:
            fragment = decode_packet(packet, self._tables)
            refusal = self._refusal(fragment, arrival_ns)
            if refusal is None:
                token_refusal = self._token_refusal(fragment)
                if token_refusal is not None:
                    self._reject(fragment.header.agent_id, token_refusal)
                refusal = token_refusal or self._store(fragment, arrival_ns)
        except PacketError as error:
            refusal = error.reason
        if refusal is not None:
            self._dropped = self._dropped.increment(refusal)

    def received_messages(self, now_ns: int | None = None) -> tuple[ReceivedMessage, ...]:
        """Return the newest message of each agent with how much of it came, by agent id. Those expired by now_ns are dropped."""
        if now_ns is not None:
            self._held = {
                k: v for k, v in self._held.items() if not self._is_old(v.assembly.header.timestamp_ns, now_ns)
            }
        return tuple(
            ReceivedMessage(
                message=held.assembly.message(),
                received_packets=len(held.assembly.fragments),
                expected_packets=held.assembly.header.num_packets,
                last_arrival_ns=held.last_arrival_ns,
            )
            for _, held in sorted(self._held.items())
        )

    def take_rejections(self) -> tuple[Rejection, ...]:
        """Senders whose tokens were refused since the last call, the last reason of each, by agent id."""
        taken, self._rejections = self._rejections, {}
        return tuple(rejection for _, rejection in sorted(taken.items()))

    def discard(self, agent_id: int) -> None:
        """Drop the messages of one sender; its next message is accepted again."""
        self._held.pop(agent_id, None)

    def messages(self, now_ns: int | None = None) -> tuple[Message, ...]:
        """Return the newest message of each agent, as far as it came, by agent id."""
        return tuple(reception.message for reception in self.received_messages(now_ns))

    def _is_old(self, timestamp_ns: int, now_ns: int) -> bool:
        return self._expire_ns is not None and now_ns - timestamp_ns > self._expire_ns

    def _refusal(self, fragment: Fragment, arrival_ns: int | None) -> DropReason | None:
        """Why a proper packet is not wanted, evaluated by itself."""
        stamp = fragment.header.timestamp_ns
        if arrival_ns is not None:
            if self._is_old(stamp, arrival_ns):
                return "expired"
            # A stamp from the future would otherwise silence its agent id until that time has come.
            if stamp - arrival_ns > _CLOCK_SLACK_NS:
                return "implausible"
        return None

    def _token_refusal(self, fragment: Fragment) -> TokenRefusal | None:
        """Why the tokens of a packet are not of this inbox's weights; None where they are, or where it has none."""
        if not isinstance(fragment.body, TokenRows):
            return None
        if self._token_format is not None:
            return self._token_format.check_packet(fragment.header.fingerprint, fragment.body)
        others = self._fingerprint is not None and fragment.header.fingerprint != self._fingerprint
        return "wrong_model" if others else None

    def _reject(self, agent_id: int, reason: TokenRefusal) -> None:
        """Store the reason for take_rejections, of at most max_agents senders: ids are not authenticated."""
        self._rejections.pop(agent_id, None)
        if len(self._rejections) >= self._max_agents:
            del self._rejections[next(iter(self._rejections))]
        self._rejections[agent_id] = token_rejection(agent_id, reason)

    def _store(self, fragment: Fragment, arrival_ns: int | None) -> DropReason | None:
        """Put a packet with its message; the reason where there is no place for it."""
        agent, stamp, size = fragment.header.agent_id, fragment.header.timestamp_ns, len(fragment.packet)
        held = self._held.get(agent)
        if held is not None and stamp < held.assembly.header.timestamp_ns:
            return "expired"
        if held is None or stamp > held.assembly.header.timestamp_ns:
            if held is None and not self._make_room(stamp):
                return "full"
            self._held[agent] = _PendingMessage(Assembly(fragment), size, arrival_ns)
            return None
        if held.packet_bytes + size > self._max_agent_bytes:
            return "full"
        if not held.assembly.add(fragment):
            return "duplicate"
        held.packet_bytes += size
        if arrival_ns is not None:
            held.last_arrival_ns = max(arrival_ns, held.last_arrival_ns or arrival_ns)
        return None

    def _make_room(self, stamp: int) -> bool:
        """Return whether a new agent whose message is of that time may be held; the stalest agent gives way."""
        if len(self._held) < self._max_agents:
            return True
        stalest = min(self._held, key=lambda agent: (self._held[agent].assembly.header.timestamp_ns, agent))
        if self._held[stalest].assembly.header.timestamp_ns >= stamp:
            return False
        del self._held[stalest]
        return True
