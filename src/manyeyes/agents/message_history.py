# SPDX-License-Identifier: Apache-2.0
"""Buffer of the last few messages of each sender: several sparse sweeps are more complete than one."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import islice

from manyeyes.agents.perception_cache import HISTORY_FRAMES
from manyeyes.datatypes import Message

MAX_AGE_NS = 500_000_000
MAX_DELAY_NS = 500_000_000
"""A message is stored for MAX_AGE_NS + MAX_DELAY_NS, since a later message of its sender may arrive so much delayed."""


class MessageHistory:
    """The last messages of each sender, as received.

    Messages older than max_age_ns are not fused. What is stored of a sender depends on its own messages and the ego's clock alone.
    """

    def __init__(self, max_age_ns: int = MAX_AGE_NS) -> None:
        self._max_age_ns = max_age_ns
        self._messages: dict[int, tuple[Message, ...]] = {}
        self._now_ns = 0

    @property
    def senders(self) -> frozenset[int]:
        """Senders of the stored messages."""
        return frozenset(self._messages)

    def update_and_get(
        self, received: Sequence[Message], now_ns: int, untrusted: Collection[int] = ()
    ) -> list[Message]:
        """Return each received message, followed by up to HISTORY_FRAMES older ones of its sender, newest first; then the last
        messages of senders without a current message, while they are no older than max_age_ns at now_ns.

        A message received again with more of its packets replaces itself; a timestamp that decreases clears the history of its
        sender, and a decreasing now_ns that of all. now_ns: of the ego's clock; messages that differ from it by more than
        MAX_DELAY_NS + max_age_ns are neither returned nor stored. untrusted: senders whose history is cleared.
        """
        if now_ns < self._now_ns:
            self._messages = {}
        self._now_ns = now_ns
        found: list[Message] = []
        by_sender = {sender: messages for sender, messages in self._messages.items() if sender not in untrusted}
        current = [message for message in received if self._can_be_stored(message)]
        for message in current:
            earlier = by_sender.get(message.agent_id, ())
            if earlier and message.timestamp_ns < earlier[0].timestamp_ns:
                earlier = ()
            older = (
                m for m in earlier if m.timestamp_ns < message.timestamp_ns and self._is_recent(m, message.timestamp_ns)
            )
            by_sender[message.agent_id] = (message, *islice(older, HISTORY_FRAMES))
            found += by_sender[message.agent_id]
        self._messages = {
            sender: messages for sender, messages in by_sender.items() if self._can_be_stored(messages[0])
        }
        silent = self._messages.keys() - {message.agent_id for message in current}
        return found + [
            m
            for sender in sorted(silent)
            for m in self._messages[sender][:HISTORY_FRAMES]
            if self._is_recent(m, now_ns)
        ]

    def forget(self, senders: Collection[int]) -> None:
        """Forget the messages of senders."""
        self._messages = {sender: messages for sender, messages in self._messages.items() if sender not in senders}

    def _is_recent(self, message: Message, time_ns: int) -> bool:
        return abs(time_ns - message.timestamp_ns) <= self._max_age_ns

    def _can_be_stored(self, message: Message) -> bool:
        return abs(self._now_ns - message.timestamp_ns) <= self._max_age_ns + MAX_DELAY_NS
