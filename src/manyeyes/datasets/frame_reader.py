# SPDX-License-Identifier: Apache-2.0
"""One agent's frame without those of the others: a cloud is some megabytes, and training on single frames needs one of many."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from manyeyes.datasets.base import Recording
from manyeyes.datatypes import AgentFrame


@runtime_checkable
class FrameReader(Protocol):
    """A recording that reads frames one by one, as they stand in its snapshots."""

    def present_agents(self, scenario: str, index: int) -> tuple[int, ...]:
        """Return the ids of the agents that have this frame, in the order of the snapshot's frames."""
        ...

    def frame(self, scenario: str, index: int, agent_id: int) -> AgentFrame:
        """Return the frame of one agent."""
        ...


@dataclass(frozen=True)
class SnapshotFrameReader:
    """Single frames of a recording that knows snapshots alone: the whole one is read each time."""

    recording: Recording

    def present_agents(self, scenario: str, index: int) -> tuple[int, ...]:
        """Return the ids of the agents that have this frame, in the order of the snapshot."""
        return tuple(frame.agent_id for frame in self.recording.snapshot(scenario, index).frames)

    def frame(self, scenario: str, index: int, agent_id: int) -> AgentFrame:
        """Return the frame of one agent, from the whole snapshot."""
        frames = self.recording.snapshot(scenario, index).frames
        return next(frame for frame in frames if frame.agent_id == agent_id)


def as_frame_reader(recording: Recording) -> FrameReader:
    """Return the recording itself where it reads frames one by one, else its snapshots taken apart."""
    return recording if isinstance(recording, FrameReader) else SnapshotFrameReader(recording)
