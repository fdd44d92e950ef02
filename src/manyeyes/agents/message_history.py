# SPDX-License-Identifier: Apache-2.0
"""What an agent remembers of the others: the last few messages of each, since one sweep of few beams does not say everything."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import islice

from manyeyes.agents.perception_cache import REMEMBERED
from manyeyes.datatypes import Message

KEPT_NS = 500_000_000


class Memory:
    """The last messages of each sender, as they were heard. What is older than keep_ns is forgotten."""

    def __init__(self, keep_ns: int = KEPT_NS) -> None:
        self._keep_ns = keep_ns
        self._held: dict[int, tuple[Message, ...]] = {}
        self._now_ns = 0

    def recall(self, heard: Sequence[Message], now_ns: int, distrusted: Collection[int] = ()) -> list[Message]:
        """Each message heard, and behind it up to REMEMBERED older ones of its sender, newest first; then the last ones of those
        who fell silent, or whose message of now nobody could place, while they are no older than keep_ns at now_ns.

        A message heard again, with more of its packets, takes its own place; a time that goes back begins anew. distrusted:
        senders who are forgotten.
        """
        if now_ns < self._now_ns:
            self._held = {}
        self._now_ns = now_ns
        found: list[Message] = []
        held = {who: said for who, said in self._held.items() if who not in distrusted}
        for message in heard:
            known = held.get(message.agent_id, ())
            if known and message.timestamp_ns < known[0].timestamp_ns:
                known = ()
            older = (m for m in known if m.timestamp_ns < message.timestamp_ns and self._near(m, message.timestamp_ns))
            held[message.agent_id] = (message, *islice(older, REMEMBERED))
            found += held[message.agent_id]
        latest = max((message.timestamp_ns for message in heard), default=now_ns)
        self._held = {who: said for who, said in held.items() if self._near(said[0], latest)}
        silent = self._held.keys() - {message.agent_id for message in heard}
        return found + [m for who in sorted(silent) for m in self._held[who][:REMEMBERED] if self._near(m, now_ns)]

    def _near(self, message: Message, time_ns: int) -> bool:
        return abs(time_ns - message.timestamp_ns) <= self._keep_ns
