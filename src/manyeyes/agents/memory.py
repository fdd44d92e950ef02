# SPDX-License-Identifier: Apache-2.0
"""What an agent remembers of the others: the last few messages of each, since one sweep of few beams does not say everything."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

from manyeyes.agents.eyes import REMEMBERED
from manyeyes.comms.inbox import Reception
from manyeyes.datatypes import Message

KEPT_NS = 500_000_000


class Memory:
    """The last messages of each sender, as they were heard. What is older than keep_ns is forgotten."""

    def __init__(self, keep_ns: int = KEPT_NS) -> None:
        self._keep_ns = keep_ns
        self._held: dict[int, tuple[Message, ...]] = {}

    def recall(self, heard: Sequence[Reception]) -> list[Message]:
        """Each message heard, and behind it up to REMEMBERED older ones of its sender, newest first.

        A message heard again, with more of its packets, takes its own place; a time that goes back begins anew.
        """
        found: list[Message] = []
        for message in (reception.message for reception in heard):
            known = self._held.get(message.agent_id, ())
            if known and message.timestamp_ns < known[0].timestamp_ns:
                known = ()
            older = (m for m in known if m.timestamp_ns < message.timestamp_ns and self._near(m, message))
            self._held[message.agent_id] = (message, *islice(older, REMEMBERED))
            found += self._held[message.agent_id]
        if found:
            latest = max(found, key=lambda message: message.timestamp_ns)
            self._held = {who: said for who, said in self._held.items() if self._near(said[0], latest)}
        return found

    def _near(self, one: Message, other: Message) -> bool:
        return abs(other.timestamp_ns - one.timestamp_ns) <= self._keep_ns
