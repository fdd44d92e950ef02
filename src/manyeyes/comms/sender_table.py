# SPDX-License-Identifier: Apache-2.0
"""Messages of all senders that a receiver holds, within its bounds of rate, content and memory.

Ids of senders are not authenticated. Hence no sender takes a place or memory from one that is received regularly, and a packet
without content, or with an earlier stamp, displaces no message of its own sender. Of messages of one instant the longest is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from manyeyes.comms.drop_counts import ContentRefusal, DropReason
from manyeyes.comms.map_payload import ElementRows
from manyeyes.comms.payloads import NONE, ObjectRows, PointRows, TokenRows
from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.comms.wire import Assembly, Envelope, Fragment, count_bitmap_bytes
from manyeyes.datatypes.message import RequestMap

REGULAR_MESSAGES = 3
"""Number of messages from which on a sender is received regularly."""
PROVISIONAL_FRACTION = 0.25
"""Fraction of the places, the last ones, whose senders give way to new ones until they are received regularly."""
MIN_TRUST, UNKNOWN_TRUST = 0.3, 2 / 3
"""A sender of less than MIN_TRUST gives way to new ones wherever its place is; one that was not assessed has UNKNOWN_TRUST."""
_PACKET_BYTES = 1024
"""Memory of the objects of one packet, besides its content."""
_BYTES_PER_CODE_BYTE = 32
"""A byte of a code stands for 8 floats at most."""
_BYTES_PER_OBJECT, _BYTES_PER_POINT = 224, 20
_BYTES_PER_LINE, _BYTES_PER_LINE_POINT, _BYTES_PER_RING_BYTE = 256, 32, 16


class _Amount(NamedTuple):
    """What one packet adds to its message. content: the bounded kind, None of none; number: how much of it; memory: bytes."""

    content: ContentRefusal | None
    number: int
    memory: int


@dataclass
class HeldMessage:
    """A message as far as it came. memory: bytes, with what parsing makes of them; last_arrival_ns: None without arrivals."""

    assembly: Assembly
    packet_bytes: int
    memory: int
    counts: dict[ContentRefusal, int]
    last_arrival_ns: int | None

    @property
    def timestamp_ns(self) -> int:
        """Time of capture of the message."""
        return self.assembly.header.timestamp_ns


@dataclass
class SenderEntry:
    """One sender: its message, or two of one instant; number of its messages; what arrived in the current instant.

    last_packet: number of its last packet, among the packets of all senders.
    """

    messages: list[HeldMessage] = field(default_factory=list)
    num_messages: int = 0
    last_packet: int = 0
    last_arrival_ns: int | None = None
    instant_start_ns: int | None = None
    instant_packets: int = 0
    instant_bytes: int = 0

    @property
    def memory(self) -> int:
        """Bytes of its messages."""
        return sum(message.memory for message in self.messages)

    @property
    def current(self) -> HeldMessage:
        """The longest message; at equal length the newest."""
        return max(self.messages, key=lambda message: (message.packet_bytes, message.timestamp_ns))


class SenderTable:
    """Senders by id, in the order in which they got their places."""

    def __init__(self, limits: ReceiverLimits) -> None:
        self._limits = limits
        self._senders: dict[int, SenderEntry] = {}
        self._num_packets = 0
        self._trust: Mapping[int, float] = {}
        # Half of the memory is divided evenly, so that no sender exhausts that of others; the rest is for senders that need more.
        self._shared_memory = limits.max_total_bytes // 2
        self._own_memory = self._shared_memory // limits.max_senders
        self._max_counts: dict[ContentRefusal, int] = {
            "cells": limits.max_cells,
            "objects": limits.max_objects,
            "points": limits.max_points,
            "map_elements": limits.max_map_elements,
        }

    def current_messages(self) -> list[HeldMessage]:
        """Return the current message of each sender, by id."""
        return [sender.current for _, sender in sorted(self._senders.items()) if sender.messages]

    def clear(self) -> None:
        """Remove all senders and their trust."""
        self._senders.clear()
        self._trust = {}

    def set_trust(self, trust: Mapping[int, float]) -> None:
        """Set the trust in senders, in [0, 1] by agent id, in place of all before; it decides who gives way to a new sender."""
        self._trust = dict(trust)

    def discard(self, agent_id: int) -> None:
        """Drop the messages of a sender."""
        if agent_id in self._senders:
            self._senders[agent_id].messages = []

    def exceeds_rate(self, agent_id: int, size: int, arrival_ns: int | None) -> bool:
        """Count a packet of a sender; return whether that is too much for this instant. Unknown senders have no count yet."""
        sender, limits = self._senders.get(agent_id), self._limits
        if sender is None:
            return False
        begin = sender.instant_start_ns
        if arrival_ns is not None and (begin is None or arrival_ns - begin >= limits.instant_ns):
            sender.instant_start_ns, sender.instant_packets, sender.instant_bytes = arrival_ns, 0, 0
        sender.instant_packets += 1
        sender.instant_bytes += size
        return sender.instant_packets > limits.max_instant_packets or sender.instant_bytes > limits.max_instant_bytes

    def begin_instant(self, now_ns: int | None) -> None:
        """Begin a new instant of all senders; drop messages, and senders, that are out of date at now_ns, None: none."""
        limits = self._limits
        for agent_id, sender in list(self._senders.items()):
            sender.instant_packets = sender.instant_bytes = 0
            if now_ns is None:
                continue
            sender.messages = [
                message
                for message in sender.messages
                if -limits.max_skew_ns <= now_ns - message.timestamp_ns <= limits.max_age_ns
            ]
            if not sender.messages and self._is_silent(sender, now_ns):
                del self._senders[agent_id]

    def check_stamp(self, envelope: Envelope) -> DropReason | None:
        """Return why the stamp of a packet excludes the message that it begins; the body is not needed."""
        sender, stamp = self._senders.get(envelope.header.agent_id), envelope.header.timestamp_ns
        if sender is None or not sender.messages or any(m.timestamp_ns == stamp for m in sender.messages):
            return None
        newest = max(message.timestamp_ns for message in sender.messages)
        if stamp <= newest - self._limits.min_stamp_spacing_ns:
            return "superseded"
        is_recent = stamp - newest <= self._limits.max_age_ns
        if envelope.kind == NONE and is_recent and any(m.assembly.has_content for m in sender.messages):
            return "empty"
        same_instant = self._same_instant(sender, stamp)
        shortest = min((message.packet_bytes for message in same_instant), default=0)
        return "superseded" if len(same_instant) > 1 and len(envelope.packet) <= shortest else None

    def _same_instant(self, sender: SenderEntry, stamp: int) -> list[HeldMessage]:
        """Return the messages of a sender that a new one does not supersede."""
        newest = max((message.timestamp_ns for message in sender.messages), default=stamp)
        return [m for m in sender.messages if m.timestamp_ns > max(stamp, newest) - self._limits.min_stamp_spacing_ns]

    def store(self, fragment: Fragment, arrival_ns: int | None) -> DropReason | None:
        """Put a packet with its message; the reason where there is no place for it. A contradiction is a PacketError."""
        agent_id, stamp = fragment.header.agent_id, fragment.header.timestamp_ns
        sender = self._senders.get(agent_id)
        held = None
        for message in () if sender is None else sender.messages:
            if message.timestamp_ns == stamp:
                held = message
        if held is not None and held.assembly.has_copy(fragment):
            return "duplicate"
        amount, size = _measure(fragment, held), len(fragment.packet)
        reason = self._exceeded_bound(amount, size, held)
        if reason is not None:
            return reason
        if sender is None or held is None:
            new = SenderEntry(instant_start_ns=arrival_ns, instant_packets=1, instant_bytes=size)
            return self._begin_message(sender or new, fragment, amount, arrival_ns)
        memory = held.memory if len(sender.messages) == 1 else sender.memory
        if not self._has_memory(sender, memory + amount.memory):
            return "full"
        held.assembly.add(fragment)
        held.packet_bytes += size
        held.memory += amount.memory
        if amount.content is not None:
            held.counts[amount.content] = held.counts.get(amount.content, 0) + amount.number
        if arrival_ns is not None and (held.last_arrival_ns is None or arrival_ns > held.last_arrival_ns):
            held.last_arrival_ns = arrival_ns
        self._record_arrival(sender, arrival_ns)
        return None

    def _exceeded_bound(self, amount: _Amount, size: int, held: HeldMessage | None) -> DropReason | None:
        """Return the bound of a message that a packet exceeds."""
        if size + (0 if held is None else held.packet_bytes) > self._limits.max_message_bytes:
            return "message_size"
        content = amount.content
        if content is None:
            return None
        count = amount.number + (0 if held is None else held.counts.get(content, 0))
        return content if count > self._max_counts[content] else None

    def _begin_message(
        self, sender: SenderEntry, fragment: Fragment, amount: _Amount, arrival_ns: int | None
    ) -> DropReason | None:
        """Begin a message of a sender with its first packet, which passed check_stamp; the reason where a bound excludes it."""
        same_instant, size = self._same_instant(sender, fragment.header.timestamp_ns), len(fragment.packet)
        if len(same_instant) > 1:
            same_instant.remove(min(same_instant, key=lambda message: message.packet_bytes))
        if not self._has_memory(sender, sum(m.memory for m in same_instant) + amount.memory):
            return "full"
        if fragment.header.agent_id not in self._senders and not self._make_place(arrival_ns):
            return "full"
        counts: dict[ContentRefusal, int] = {} if amount.content is None else {amount.content: amount.number}
        message = HeldMessage(Assembly(fragment), size, amount.memory, counts, arrival_ns)
        sender.num_messages += not same_instant
        sender.messages = [*same_instant, message]
        self._senders[fragment.header.agent_id] = sender
        self._record_arrival(sender, arrival_ns)
        return None

    def _record_arrival(self, sender: SenderEntry, arrival_ns: int | None) -> None:
        self._num_packets += 1
        sender.last_packet = self._num_packets
        if arrival_ns is not None and (sender.last_arrival_ns is None or arrival_ns > sender.last_arrival_ns):
            sender.last_arrival_ns = arrival_ns

    def _has_memory(self, sender: SenderEntry, memory: int) -> bool:
        """Return whether the messages of a sender may take this much memory."""
        excess = memory - self._own_memory
        if excess <= 0:
            return True
        others = sum(max(0, s.memory - self._own_memory) for s in self._senders.values() if s is not sender)
        return excess + others <= self._shared_memory

    def _make_place(self, arrival_ns: int | None) -> bool:
        """Return whether there is a place for a new sender.

        A sender that has been silent gives way, else one of less than MIN_TRUST, else, in the last places, one that is not received
        regularly: of several the one of the lowest trust, and of these the one whose last packet is the oldest.
        """
        if len(self._senders) < self._limits.max_senders:
            return True
        num_provisional = max(1, int(PROVISIONAL_FRACTION * self._limits.max_senders))
        last = list(self._senders.items())[-num_provisional:]
        leaving = [item for item in self._senders.items() if self._is_silent(item[1], arrival_ns)]
        leaving = leaving or [item for item in self._senders.items() if self._trust_of(item[0]) < MIN_TRUST]
        leaving = leaving or [item for item in last if item[1].num_messages < REGULAR_MESSAGES]
        if not leaving:
            return False
        del self._senders[min(leaving, key=lambda item: (self._trust_of(item[0]), item[1].last_packet))[0]]
        return True

    def _trust_of(self, agent_id: int) -> float:
        return self._trust.get(agent_id, UNKNOWN_TRUST)

    def _is_silent(self, sender: SenderEntry, now_ns: int | None) -> bool:
        """Return whether nothing came from a sender for max_silence_ns; unknown without a clock, hence False."""
        if now_ns is None:
            return False
        return sender.last_arrival_ns is None or now_ns - sender.last_arrival_ns > self._limits.max_silence_ns


def _measure(fragment: Fragment, held: HeldMessage | None) -> _Amount:
    """Measure the content of a packet."""
    body, memory = fragment.body, _PACKET_BYTES + len(fragment.packet)
    if isinstance(body, TokenRows):
        count, is_code = len(body.key), body.encoding in ("codebook", "clusters")
        memory += len(body.scales) + len(body.values)
        memory += count * (16 + body.width * (_BYTES_PER_CODE_BYTE if is_code else 4))
        if held is None or "cells" not in held.counts:
            memory += count_bitmap_bytes(body.grid)
        return _Amount("cells", count, memory)
    if isinstance(body, ObjectRows):
        return _Amount("objects", len(body.rows), memory + body.rows.nbytes + len(body.rows) * _BYTES_PER_OBJECT)
    if isinstance(body, PointRows):
        return _Amount("points", len(body.rows), memory + body.rows.nbytes + len(body.rows) * _BYTES_PER_POINT)
    if isinstance(body, ElementRows):
        points = sum(len(line) for line in body.lines)
        memory += points * _BYTES_PER_LINE_POINT + len(body.lines) * _BYTES_PER_LINE
        return _Amount("map_elements", len(body.lines), memory + len(body.rings) * _BYTES_PER_RING_BYTE)
    if isinstance(body, RequestMap):
        return _Amount(None, 0, memory + 4 * body.confidence.numel())
    return _Amount(None, 0, memory)
