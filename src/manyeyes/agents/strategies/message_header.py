# SPDX-License-Identifier: Apache-2.0
"""Header of every message: agent, timestamp, pose and body."""

from __future__ import annotations

from collections.abc import Sequence

from manyeyes.datatypes import AgentFrame, Message, Transform


def make_header(frame: AgentFrame, fingerprint: bytes) -> Message:
    """Return a message of this frame without any section."""
    return Message(
        agent_id=frame.agent_id,
        timestamp_ns=frame.timestamp_ns,
        world_from_agent=frame.world_from_agent,
        pose_covariance=frame.pose_covariance,
        fingerprint=fingerprint,
        is_infrastructure=frame.is_infrastructure,
        body=frame.body,
    )


def lag_behind_newest_s(messages: Sequence[Message]) -> list[float]:
    """Return the age of each message relative to the newest of its sender, seconds; 0 for the newest."""
    newest = {m.agent_id: m.timestamp_ns for m in sorted(messages, key=lambda m: m.timestamp_ns)}
    return [(newest[m.agent_id] - m.timestamp_ns) / 1e9 for m in messages]


def ego_from_sender(frame: AgentFrame, message: Message) -> Transform:
    """Transform from the sender's frame at its timestamp to the ego's current frame, by the prior poses of both."""
    return frame.world_from_agent.inverse() @ message.world_from_agent


def age_s(frame: AgentFrame, message: Message) -> float:
    """Return the age of a message relative to the ego's frame, seconds."""
    return (frame.timestamp_ns - message.timestamp_ns) / 1e9
