# SPDX-License-Identifier: Apache-2.0
"""Offsets of senders' clocks from the receiver's, by the arrival of their messages and by two-way queries.

An arrival less its stamp is the delay of a message plus the offset of the clocks: its minimum bounds the offset. Two-way queries
measure the offset itself up to the asymmetry of the path, which cannot be observed. They are not authenticated; hence they inform
displays, and no sender is excluded by them.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import NamedTuple

from manyeyes.comms.inbox import Arrival
from manyeyes.datatypes import ConfigError

NS_PER_S = 1_000_000_000
OFFSET_WINDOW_NS = 30 * NS_PER_S
"""Arrivals of this time are in the minimum that displays show."""
MAX_SENDERS = 64
MAX_ARRIVALS = 1_024
NUM_QUERIES = 8
"""The query with the shortest round trip of the last so many is used."""


@dataclass(frozen=True)
class SkewLimits:
    """When a sender's clock is wrong: its messages are not fused.

    max_ahead_ns: arrivals may precede their stamps by this much, the accuracy of clocks; no delay explains more. max_behind_ns: a
    larger minimum delay is no delay of a usable link. window_ns: of the minimum; a sender whose clock is corrected is fused again
    after it. min_messages: of a sender in the window, before it is excluded.
    """

    max_ahead_ns: int = 50_000_000
    max_behind_ns: int = 300_000_000
    window_ns: int = NS_PER_S
    min_messages: int = 3

    def __post_init__(self) -> None:
        if min(self.max_ahead_ns, self.max_behind_ns, self.window_ns, self.min_messages) <= 0:
            raise ConfigError(f"SkewLimits are above 0; got {self}.")


@dataclass
class _Sender:
    last_stamp_ns: int | None = None
    delays: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=MAX_ARRIVALS))


class SenderClocks:
    """Delays of the messages of each sender, the last MAX_SENDERS ones."""

    def __init__(self, limits: SkewLimits | None = None) -> None:
        self.limits = limits or SkewLimits()
        self._senders: OrderedDict[int, _Sender] = OrderedDict()

    def record(self, arrival: Arrival) -> None:
        """Record a message; the same one a second time changes nothing."""
        sender = self._senders.pop(arrival.agent_id, None) or _Sender()
        self._senders[arrival.agent_id] = sender
        if len(self._senders) > MAX_SENDERS:
            self._senders.popitem(last=False)
        if sender.last_stamp_ns != arrival.timestamp_ns:
            sender.last_stamp_ns = arrival.timestamp_ns
            sender.delays.append((arrival.arrival_ns, arrival.arrival_ns - arrival.timestamp_ns))

    def min_delay_ns(self, agent_id: int, now_ns: int, window_ns: int = OFFSET_WINDOW_NS) -> int | None:
        """Return the minimum of arrival less stamp over the last messages of a sender; None of none."""
        delays = self._recent(agent_id, now_ns, window_ns)
        return min(delays) if delays else None

    def skewed(self, now_ns: int) -> frozenset[int]:
        """Return the senders whose clock is wrong by their last messages."""
        return frozenset(agent_id for agent_id in self._senders if self._is_skewed(agent_id, now_ns))

    def clear(self) -> None:
        """Forget everything: the receiver's own clock stepped."""
        self._senders.clear()

    def _recent(self, agent_id: int, now_ns: int, window_ns: int) -> list[int]:
        sender = self._senders.get(agent_id)
        return [] if sender is None else [delay for time_ns, delay in sender.delays if now_ns - time_ns <= window_ns]

    def _is_skewed(self, agent_id: int, now_ns: int) -> bool:
        limits = self.limits
        delays = self._recent(agent_id, now_ns, limits.window_ns)
        return len(delays) >= limits.min_messages and not -limits.max_ahead_ns <= min(delays) <= limits.max_behind_ns


class ClockOffset(NamedTuple):
    """Clock of another agent less the own one, and its standard deviation, half of the round trip, nanoseconds."""

    offset_ns: int
    sigma_ns: int


class TwoWayClock:
    """Offset of one other clock by queries: sent at t0, received there at t1, answered at t2, received here at t3."""

    def __init__(self) -> None:
        self._measured: deque[ClockOffset] = deque(maxlen=NUM_QUERIES)

    def add(self, t0: int, t1: int, t2: int, t3: int) -> None:
        """Record a query; one whose times cannot be is ignored."""
        round_trip_ns = (t3 - t0) - (t2 - t1)
        if round_trip_ns >= 0 and t2 >= t1:
            self._measured.append(ClockOffset(((t1 - t0) + (t2 - t3)) // 2, max(round_trip_ns // 2, 1)))

    def estimate(self) -> ClockOffset | None:
        """Return the offset of the query with the shortest round trip; None before the first."""
        return min(self._measured, key=lambda one: one.sigma_ns, default=None)
