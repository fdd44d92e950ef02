# SPDX-License-Identifier: Apache-2.0
"""The head of every message: who, when, from where."""

from __future__ import annotations

from collections.abc import Sequence

from manyeyes.datatypes import AgentFrame, Message, Transform


def make_header(frame: AgentFrame, fingerprint: bytes) -> Message:
    """A message of this frame with no section yet."""
    return Message(
        agent_id=frame.agent_id,
        timestamp_ns=frame.timestamp_ns,
        world_from_agent=frame.world_from_agent,
        pose_covariance=frame.pose_covariance,
        fingerprint=fingerprint,
        is_infrastructure=frame.is_infrastructure,
    )


def lag_behind_newest_s(messages: Sequence[Message]) -> list[float]:
    """Seconds that each message lies behind the newest of its sender: 0 for what is news, more for what is remembered."""
    newest = {m.agent_id: m.timestamp_ns for m in sorted(messages, key=lambda m: m.timestamp_ns)}
    return [(newest[m.agent_id] - m.timestamp_ns) / 1e9 for m in messages]


def ego_from_sender(frame: AgentFrame, message: Message) -> Transform:
    """From the sender's frame when it looked to the ego's now, by the claimed poses of both."""
    return frame.world_from_agent.inverse() @ message.world_from_agent


def age_s(frame: AgentFrame, message: Message) -> float:
    """How long before the ego's frame the sender looked, seconds."""
    return (frame.timestamp_ns - message.timestamp_ns) / 1e9
