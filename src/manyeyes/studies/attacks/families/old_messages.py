# SPDX-License-Identifier: Apache-2.0
"""Old and foreign content: an earlier own message with a new stamp, and the content of another agent under the own identity."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

from manyeyes.datatypes import Message
from manyeyes.studies.attacks.interface import AlterMessage, AttackInput, AttackKey, AttackOutput, Knowledge


@dataclass(frozen=True)
class ReplayAttack:
    """Send the content and pose of the own message of age_s before, with the stamp of now; nothing until there is one."""

    age_s: float = 0.5
    num_pseudonyms: int = 0
    knowledge: Knowledge = "black-box"

    def begin(self, key: AttackKey) -> AlterMessage:
        """Return the attack of one malicious agent."""
        return _Replay(self.age_s)


@dataclass
class _Replay:
    age_s: float
    kept: deque[Message] = field(default_factory=deque)

    def __call__(self, given: AttackInput) -> AttackOutput:
        self.kept.append(given.message)
        latest_ns = given.message.timestamp_ns - round(self.age_s * 1e9)
        while len(self.kept) > 1 and self.kept[1].timestamp_ns <= latest_ns:
            self.kept.popleft()
        # The oldest of all while none is old enough.
        return AttackOutput(replace(self.kept[0], timestamp_ns=given.message.timestamp_ns))


@dataclass(frozen=True)
class CopyAttack:
    """Send the newest content of another agent, with that agent's pose, under the own identity and the stamp of now."""

    num_pseudonyms: int = 0
    knowledge: Knowledge = "black-box"

    def begin(self, key: AttackKey) -> AlterMessage:
        """Return the attack of one malicious agent."""
        return copy_message


def copy_message(given: AttackInput) -> AttackOutput:
    """Copy the received message with the most content; the own one before any was received."""
    if not given.received:
        return AttackOutput(given.message)
    source = max(given.received, key=lambda m: (_count_content(m), -m.agent_id))
    own = given.message
    copied = replace(source, agent_id=own.agent_id, timestamp_ns=own.timestamp_ns, body=own.body, request=own.request)
    return AttackOutput(replace(copied, is_infrastructure=own.is_infrastructure, token_score=None))


def _count_content(message: Message) -> int:
    tokens = 0 if message.tokens is None else len(message.tokens.sites)
    return tokens + (0 if message.objects is None else len(message.objects))
